# SPDX-License-Identifier: Apache-2.0
"""Points from which training starts: point clouds (--points), points on the sky (--sky), and the colours of both.

Clouds are checked against the cameras and thinned to one point per voxel. Sky points lie on a sphere around the scene,
where photographs show the sky; SKY_RADIUS_RATIO of `config.points` gives its radius. Points without
colours take the median colour of the photographs that show them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.points import SKY_RADIUS_RATIO, StartPoints
from clsplat.errors import InputError, warn
from clsplat.images.alpha import composite
from clsplat.models.edit import moved
from clsplat.scenes.dataset import nearest_around, occlusion_cell, pixels_of
from clsplat.scenes.outliers import MAX_OUTLIER_POINT_FRACTION, OUTLIER_DISTANCE_RATIO, strays
from clsplat.scenes.point_files import UNCOLOURED_GREY, Cloud, of_one_colour, read_cloud

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene, View

MAX_CHECKED_CLOUD_POINTS = 20_000
"""Maximum number of a cloud's points that are checked against the cameras, evenly spaced."""
MIN_CLOUD_POINTS_IN_VIEW = 0.05
"""Minimum fraction of a cloud's points that the training photographs show."""
MAX_CLOUD_DEPTH_RATIO = 30.0
"""Largest ratio, either way, of the cloud's median distance to that of the scene's points. The distances are from the
cameras that see the points."""
MAX_CLOUD_DISTANCE_EXTENTS = 1000.0
"""Maximum distance of a cloud from the cameras, in scene extents. It applies if the scene has no points."""
VOXEL_SIZE_TOLERANCE = 0.02
"""Relative amount by which the voxel size of a thinned cloud may exceed the smallest sufficient size."""
MAX_VOXELS_PER_SIDE = 1 << 20
"""Maximum number of voxels along the longest side of a cloud's bounding box, so that a voxel's three indices fit in 64
bits."""
SKY_IMAGE_SIDE_PX = 400
"""Longer side in pixels to which larger photographs are reduced to find the sky. A sky point covers several pixels of
the full size."""
SKY_RADIUS_QUANTILE = 0.95
"""Quantile of the points' distances from the middle of the cameras. The radius of the sky sphere is proportional to it,
or to the scene's extent if that is larger."""
SKY_OVERSAMPLING = 4
"""Number of candidate directions on the half sphere, per requested point."""
SKYLINE_COLUMNS = 24
"""Number of column strips of a photograph. In each strip, the sky is above all points."""
MIN_SKY_VOTE_FRACTION = 0.5
"""A direction is sky if at least this fraction of the photographs that show it have sky there."""
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5.0))
"""Angle in radians between successive points of a spiral that covers a sphere evenly."""
COLOUR_VIEWS_PER_POINT = 15
"""Number of nearest photographs that give a point its colour.

In photographs farther away, the colour of a point is mixed with its surroundings. With fewer photographs, a
photograph in which something hides the point would have too much weight.
"""
OCCLUSION_DEPTH_RATIO = 1.05
"""A point counts as occluded if its depth is over this many times that of the nearest point in its occlusion cell."""
HIDDEN_POINT_RANK = 1e30
"""Factor that makes the ranks of occluded points larger than the ranks of all visible points.

The photographs with the lowest ranks give a point its colour. Where the point is visible, its rank is depth / focal
length. Where it is occluded, its rank is this factor times its depth relative to the nearest point.
"""
UNSEEN_GREY = UNCOLOURED_GREY
"""Grey value of points that no photograph shows."""


def with_points(scene: Scene, start: StartPoints) -> Scene:
    """Return a copy of the scene with the points from which training starts; `scene` itself if it already has them.

    Raises InputError for a file that cannot be read, and for a cloud that is not where the cameras look.
    """
    if scene.start == start:
        return scene
    points, colors, grey = scene.points, scene.point_colors, np.zeros(len(scene.points), np.bool_)
    if start.file:
        path = Path(start.file)
        cloud = _in_world(read_cloud(path), scene)
        check_place(cloud.points, scene, path)
        kept = without_stray_points(cloud.points, scene, path)
        if not kept.all():
            cloud = Cloud(cloud.points[kept], None if cloud.colors is None else cloud.colors[kept])
        cloud = thinned(cloud, start.limit)
        own_colors = np.full(cloud.points.shape, UNSEEN_GREY, np.float32) if cloud.colors is None else cloud.colors
        own_grey = np.full(len(cloud.points), cloud.colors is None)
        if start.use == "replace":
            points, colors, grey = cloud.points, own_colors, own_grey
        else:
            points, colors = np.concatenate([points, cloud.points]), np.concatenate([colors, own_colors])
            grey = np.concatenate([grey, own_grey])
    elif start.limit:
        own = thinned(Cloud(points, colors), start.limit)
        assert own.colors is not None
        points, colors, grey = own.points, own.colors, np.zeros(len(own.points), np.bool_)
    if start.sky:
        sky, shade = sky_points(scene, start.sky)
        points, colors = np.concatenate([points, sky]), np.concatenate([colors, shade])
        grey = np.concatenate([grey, np.zeros(len(sky), np.bool_)])
    return replace(scene, points=points, point_colors=colors, colourless=grey if grey.any() else None, start=start)


def with_cloud_beside(scene: Scene) -> Scene:
    """Give a scene without points the points of a cloud in its folder. Returns a copy of the scene.

    The first cloud that lies where the scene's cameras look is used. Warns of this cloud, and of clouds that cannot be
    read or lie elsewhere.
    """
    for index, path in enumerate(scene.clouds):
        try:
            cloud = _in_world(read_cloud(path), scene)
            check_place(cloud.points, scene, path)
        except InputError as error:
            warn(f"{error}; it is not used")
            continue
        warn(f"{path}: its {len(cloud.points):,} points are used, as the scene itself has no points")
        colors = np.full(cloud.points.shape, UNSEEN_GREY, np.float32) if cloud.colors is None else cloud.colors
        return replace(scene, points=cloud.points, point_colors=colors, clouds=scene.clouds[index + 1 :])
    return replace(scene, clouds=()) if scene.clouds else scene


def _in_world(cloud: Cloud, scene: Scene) -> Cloud:
    """Return the points of a file, which are in the frame of the scene's files, in the scene's frame."""
    change = scene.world_from_files
    return cloud if change is None else Cloud(moved(cloud.points, change), cloud.colors)


def without_stray_points(points: Float64, scene: Scene, where: object) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, 3) that are not outliers by distance from the middle of the cameras.

    where: the file or scene that the points are from, for the warning about outliers.
    """
    middle, spread, _ = scene.spread
    kept = ~strays(points, MAX_OUTLIER_POINT_FRACTION, spread, middle)
    if not kept.all():
        far = points[~kept]
        first = " ".join(f"{value:.4g}" for value in far[0])
        warn(
            f"{where}: {len(far):,} of {len(points):,} points lie over {OUTLIER_DISTANCE_RATIO:g} times as far away "
            f"as the others, such as the point {first}; they are left out"
        )
    return kept


def check_place(points: Float64, scene: Scene, path: Path) -> None:
    """Raise InputError for points (N, 3) of a cloud that do not fit the scene's cameras.

    Points fit if enough of them are in a training photograph. Their median distance from the cameras that see them must
    be close to the median distance of the scene's own points.
    """
    sample = _spread(points)
    seen, depths = _seen(sample, scene)
    advice = "expected points with the axes, scale and origin of the scene's cameras"
    if seen < max(MIN_CLOUD_POINTS_IN_VIEW * len(sample), 1):
        raise InputError(
            f"{path}: only {100 * seen / len(sample):.1f} % of its points lie in a training photograph; their middle "
            f"is {_where(points)}, and that of the cameras is {_where(_centres(scene))}; {advice}"
        )
    if len(scene.points):
        _, usual = _seen(_spread(scene.points), scene)
    else:
        usual = scene.extent if depths > MAX_CLOUD_DISTANCE_EXTENTS * scene.extent else depths
    if usual > 0 and not 1 / MAX_CLOUD_DEPTH_RATIO <= depths / usual <= MAX_CLOUD_DEPTH_RATIO:
        raise InputError(
            f"{path}: the middle of its points is {_where(points)}, and their distance from the cameras that see them "
            f"is {depths:.3g}, but that of the scene's points is {usual:.3g}; {advice}"
        )


def _spread(points: Float64) -> Float64:
    return points[:: -(-len(points) // MAX_CHECKED_CLOUD_POINTS)]


def _seen(points: Float64, scene: Scene) -> tuple[int, float]:
    """Return how many of the points (N, 3) training photographs show, and the median of their distances from the
    cameras that see them."""
    anywhere = np.zeros(len(points), np.bool_)
    distances: list[Float64] = []
    for view in scene.train_views:
        *_, inside = pixels_of(points, view.camera.before(scene.near), view.lens)
        anywhere |= inside
        distances.append(np.linalg.norm(points[inside] - view.camera.position, axis=1))
    every = np.concatenate(distances)
    return int(anywhere.sum()), float(np.median(every)) if len(every) else 0.0


def _centres(scene: Scene) -> Float64:
    return np.stack([view.camera.position for view in scene.train_views])


def _where(points: Float64) -> str:
    """Return the median position of points and their median distance from it, as text: "1 2 3 (median distance 4)"."""
    middle = np.median(points, axis=0)
    place = " ".join(f"{value:.4g}" for value in middle)
    return f"{place} (median distance {np.median(np.linalg.norm(points - middle, axis=1)):.3g})"


def thinned(cloud: Cloud, limit: int) -> Cloud:
    """Reduce a cloud to at most `limit` points: the mean position and colour of each occupied voxel.

    The voxel size is the smallest sufficient one, within VOXEL_SIZE_TOLERANCE. A cloud within the limit is unchanged.
    """
    points = cloud.points
    if len(points) <= limit:
        return cloud
    low = points.min(axis=0)
    side = float((points - low).max())
    if side == 0:
        return Cloud(points[:1], None if cloud.colors is None else cloud.colors[:1])
    fine, coarse = side / MAX_VOXELS_PER_SIDE, side * 1.01  # one voxel of the coarse size holds all points
    if (cells := _cells(points, low, fine)).max() < limit:
        coarse = fine
    while coarse > fine * (1 + VOXEL_SIZE_TOLERANCE):
        middle = (fine * coarse) ** 0.5
        if _cells(points, low, middle).max() < limit:
            coarse = middle
        else:
            fine = middle
    cells = _cells(points, low, coarse)
    places = low + _means(points - low, cells)
    return Cloud(places, None if cloud.colors is None else _means(cloud.colors, cells).astype(np.float32))


def _cells(points: Float64, low: Float64, voxel: float) -> NDArray[np.int64]:
    """Return the index (N,) of each point's voxel among the occupied voxels.

    low: (3,), corner of the grid. voxel: side of a voxel. Both are in world units.
    """
    at = np.floor((points - low) / voxel).astype(np.int64)
    _, cells = np.unique((at[:, 0] << 42) | (at[:, 1] << 21) | at[:, 2], return_inverse=True)
    return np.asarray(cells.reshape(-1), np.int64)


def _means(values: NDArray[Any], cells: NDArray[np.int64]) -> Float64:
    """Return the mean (voxels, 3) of the points' values (N, 3) in each voxel. cells: (N,), voxel of each point."""
    counts = np.bincount(cells)
    return np.stack([np.bincount(cells, values[:, axis]) / counts for axis in range(3)], axis=1)


def sky_points(scene: Scene, count: int) -> tuple[Float64, Float32]:
    """Return at most `count` points (N, 3) on a sphere around the scene, in directions of the sky, and colours (N, 3).

    A direction above the horizon is sky if, in most photographs that show it, no scene point lies above it in the
    same strip of columns. Colours are means over the photographs that show sky there.

    Raises InputError if there is no such direction, no common up direction, or no points in the scene.
    """
    if len(scene.points) == 0:
        raise InputError(
            f"{scene.name}: --sky needs points to find the sky above them, and the scene has none; leave out --sky"
        )
    cameras = [view.camera for view in scene.train_views]
    middle, *_ = scene.spread
    up = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
    if (length := float(np.linalg.norm(up))) < 0.1:
        raise InputError(f"{scene.name}: --sky needs cameras with a common up direction; leave out --sky")
    radius = SKY_RADIUS_RATIO * max(
        float(np.quantile(np.linalg.norm(scene.points - middle, axis=1), SKY_RADIUS_QUANTILE)), scene.extent
    )
    directions = half_sphere(SKY_OVERSAMPLING * count, up / length)
    places = middle + radius * directions
    sums, votes, shown = np.zeros((len(places), 3)), np.zeros(len(places)), np.zeros(len(places))
    for view in scene.train_views:
        factor = min(SKY_IMAGE_SIDE_PX / max(view.camera.width, view.camera.height), 1.0)
        width, height = (max(round(factor * side), 1) for side in (view.camera.width, view.camera.height))
        camera = view.camera.resized(width, height).before(scene.near)
        rows, columns, inside = pixels_of(places, camera, view.lens)
        shown += inside
        if not inside.any():
            continue
        is_sky = rows < _skyline(scene.points, camera, view)[columns]
        there = np.flatnonzero(inside)[is_sky]
        if len(there):
            picture = composite(view.load(width, height), np.zeros(3))
            sums[there] += picture[rows[is_sky], columns[is_sky]]
            votes[there] += 1
    chosen = np.flatnonzero((votes > 0) & (votes >= MIN_SKY_VOTE_FRACTION * shown))
    if len(chosen) == 0:
        raise InputError(f"{scene.name}: --sky: no photograph shows sky above its points; leave out --sky")
    if len(chosen) > count:
        chosen = chosen[np.linspace(0, len(chosen) - 1, count).astype(int)]
    colors: Float32 = np.clip(sums[chosen] / votes[chosen, None], 0, 1).astype(np.float32)
    return places[chosen], colors


def half_sphere(count: int, up: Float64) -> Float64:
    """Return directions (count, 3), evenly spaced over the half sphere around `up`, on a golden-angle spiral."""
    height = (np.arange(count) + 0.5) / count
    level, angle = np.sqrt(1 - height**2), _GOLDEN_ANGLE * np.arange(count)
    aside = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(up, aside)
    east /= np.linalg.norm(east)
    along = np.outer(level * np.cos(angle), east) + np.outer(level * np.sin(angle), np.cross(up, east))
    return np.asarray(along + np.outer(height, up))


def _skyline(points: Float64, camera: Camera, view: View) -> NDArray[np.int64]:
    """Return, for each column of a picture, the row above which it shows no scene points.

    The row is the same for all columns of a strip, and also lies above the points of the neighbouring strips. If these
    strips have no points, the row is 0, so that nothing counts as sky: a wall without features has no points either.
    """
    rows, columns, _ = pixels_of(points, camera, view.lens)
    part = np.minimum(columns * SKYLINE_COLUMNS // camera.width, SKYLINE_COLUMNS - 1)
    tops = np.full(SKYLINE_COLUMNS + 2, camera.height)
    np.minimum.at(tops, part + 1, rows)
    tops = np.minimum(np.minimum(tops[:-2], tops[1:-1]), tops[2:])
    tops[tops == camera.height] = 0
    margin = camera.height // 40
    return np.asarray(np.maximum(tops[np.arange(camera.width) * SKYLINE_COLUMNS // camera.width] - margin, 0))


def is_colourless(scene: Scene) -> bool:
    """Return True if points lack colours: if some are marked as colourless, or all have the same colour."""
    return scene.colourless is not None or of_one_colour(scene.point_colors)


def photographed(scene: Scene, background: ArrayLike) -> Float32:
    """Return colours (N, 3) float32 in [0, 1] of the scene's points. Points with colours of their own keep them.

    A colour is the median per channel over the nearest COLOUR_VIEWS_PER_POINT training photographs that show the point,
    at the training size. A photograph does not show a point that is masked or occluded in it. A point that is occluded
    in all photographs uses the photographs in which it is least occluded.

    background: colour (3,) behind transparent photographs.
    """
    count = len(scene.points)
    ranks, colors = (
        np.full((count, COLOUR_VIEWS_PER_POINT), np.inf),
        np.full((count, COLOUR_VIEWS_PER_POINT, 3), np.inf, np.float32),
    )
    for view in scene.train_views:
        camera, picture = view.camera.before(scene.near), view.load_masked()
        rows, columns, inside = pixels_of(scene.points, camera, view.lens)
        which, depths = np.flatnonzero(inside), camera.depths_of(scene.points[inside])
        behind = depths / nearest_around(rows, columns, depths, occlusion_cell(camera, len(which)))
        rank = np.where(behind <= OCCLUSION_DEPTH_RATIO, depths / camera.fx, HIDDEN_POINT_RANK * behind)
        pixels = picture[rows, columns]
        counts = pixels[:, 4] > 0 if pixels.shape[1] == 5 else np.ones(len(which), np.bool_)
        last = ranks[which].argmax(axis=1)
        kept = counts & (rank < ranks[which, last])
        which, last = which[kept], last[kept]
        ranks[which, last] = rank[kept]
        colors[which, last] = composite(pixels[None, kept, :4], background)[0]
    shown = ranks < HIDDEN_POINT_RANK
    colors[~shown & shown.any(axis=1, keepdims=True)] = np.inf
    medians = np.clip(_medians(colors), 0, 1)
    return medians if scene.colourless is None else np.where(scene.colourless[:, None], medians, scene.point_colors)


def _medians(colors: Float32) -> Float32:
    """Return the median per channel of each point's finite colours, (N, 3); UNSEEN_GREY if there are none.

    colors: (N, K, 3), infinite where a point has fewer than K colours. The function sorts the array.
    """
    counts = np.isfinite(colors).all(axis=2).sum(axis=1)[:, None, None]
    colors.sort(axis=1)
    middles = np.concatenate([np.maximum(counts - 1, 0) // 2, counts // 2], axis=1)
    medians = np.take_along_axis(colors, middles, axis=1).mean(axis=1)
    return np.asarray(np.where(counts[:, 0] > 0, medians, np.float32(UNSEEN_GREY)))
