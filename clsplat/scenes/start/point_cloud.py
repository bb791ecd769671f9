# SPDX-License-Identifier: Apache-2.0
"""Point clouds from which training starts. They are checked against the cameras and thinned to one point per voxel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.config.points import StartPoints
from clsplat.errors import InputError, warn
from clsplat.scenes.dataset import pixels_of
from clsplat.scenes.outliers import MAX_OUTLIER_POINT_FRACTION, OUTLIER_DISTANCE_RATIO, strays
from clsplat.scenes.point_files import Cloud, read_cloud
from clsplat.scenes.start.initialise import UNSEEN_GREY
from clsplat.scenes.start.sky_points import sky_points

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

MAX_CHECKED_CLOUD_POINTS = 20_000
"""Maximum number of a cloud's points that are checked against the cameras, evenly spaced."""
MIN_CLOUD_POINTS_IN_VIEW = 0.05
"""Minimum fraction of a cloud's points that the training photographs show."""
MAX_CLOUD_DEPTH_RATIO = 30.0
"""Largest factor by which the distances of the cloud and of the scene's points from the cameras that see them may
differ."""
MAX_CLOUD_DISTANCE_EXTENTS = 1000.0
"""Maximum distance of a cloud from the cameras, in scene extents. It applies if the scene has no points."""
VOXEL_SIZE_TOLERANCE = 0.02
"""Relative amount by which the voxel size may exceed the smallest sufficient size."""
MAX_VOXELS_PER_SIDE = 1 << 20
"""Maximum number of voxels along the longest side of the box, so that three indices fit in 64 bits."""


def with_points(scene: Scene, start: StartPoints) -> Scene:
    """Copy of the scene with the points from which training starts; `scene` itself if it already has them.

    Raises InputError for a file that cannot be read, and for a cloud that is not where the cameras look.
    """
    if scene.start == start:
        return scene
    points, colors, grey = scene.points, scene.point_colors, np.zeros(len(scene.points), np.bool_)
    if start.file:
        path = Path(start.file)
        cloud = read_cloud(path)
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
    """Copy of a scene without points, with the points of a cloud from its folder if one lies where its cameras look.

    The first such cloud is used. Warns of the cloud that is used, and of clouds that cannot be read or lie elsewhere.
    """
    for index, path in enumerate(scene.clouds):
        try:
            cloud = read_cloud(path)
            check_place(cloud.points, scene, path)
        except InputError as error:
            warn(f"{error}; it is not used")
            continue
        warn(f"{path}: its {len(cloud.points):,} points are used, as the scene names no points")
        colors = np.full(cloud.points.shape, UNSEEN_GREY, np.float32) if cloud.colors is None else cloud.colors
        return replace(scene, points=cloud.points, point_colors=colors, clouds=scene.clouds[index + 1 :])
    return replace(scene, clouds=()) if scene.clouds else scene


def without_stray_points(points: Float64, scene: Scene, where: object) -> NDArray[np.bool_]:
    """Mark the points (N, 3) that are not outliers, as compared with all points and the scene's cameras. Returns (N,).

    where: origin of the points, for the warning about outliers.
    """
    middle, spread, _ = scene.spread
    kept = ~strays(points, MAX_OUTLIER_POINT_FRACTION, spread, middle)
    if not kept.all():
        far = points[~kept]
        first = " ".join(f"{value:.4g}" for value in far[0])
        warn(
            f"{where}: {len(far):,} of {len(points):,} points lie over {OUTLIER_DISTANCE_RATIO:g} times as far off "
            f"as the others, such as the point {first}; they are left out"
        )
    return kept


def check_place(points: Float64, scene: Scene, path: Path) -> None:
    """Raise InputError for a cloud (N, 3) that the training photographs do not show, or that is much nearer to the
    cameras or farther away than the scene's points."""
    sample = _spread(points)
    seen, depths = _seen(sample, scene)
    advice = "expected points with the axes, scale and origin of the scene's cameras"
    if seen < max(MIN_CLOUD_POINTS_IN_VIEW * len(sample), 1):
        raise InputError(
            f"{path}: only {100 * seen / len(sample):.1f} % of its points lie in a training photograph; the points lie "
            f"{_where(points)}, and the cameras {_where(_centres(scene))}; {advice}"
        )
    if len(scene.points):
        _, usual = _seen(_spread(scene.points), scene)
    else:
        usual = scene.extent if depths > MAX_CLOUD_DISTANCE_EXTENTS * scene.extent else depths
    if usual > 0 and not 1 / MAX_CLOUD_DEPTH_RATIO <= depths / usual <= MAX_CLOUD_DEPTH_RATIO:
        raise InputError(
            f"{path}: its points lie {_where(points)}, at a distance of {depths:.3g} from the cameras that see them, "
            f"and the scene's points at {usual:.3g}; {advice}"
        )


def _spread(points: Float64) -> Float64:
    return points[:: -(-len(points) // MAX_CHECKED_CLOUD_POINTS)]


def _seen(points: Float64, scene: Scene) -> tuple[int, float]:
    """The number of points that at least one training photograph shows, and their median distance from the cameras that
    see them."""
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
    """Text such as "about 1 2 3 within 4"."""
    middle = np.median(points, axis=0)
    place = " ".join(f"{value:.4g}" for value in middle)
    return f"about {place} within {np.median(np.linalg.norm(points - middle, axis=1)):.3g}"


def thinned(cloud: Cloud, limit: int) -> Cloud:
    """Reduce a cloud to at most `limit` points: for each occupied voxel, the mean position and colour.

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
    """Index (N,) of each point's voxel among the occupied voxels."""
    at = np.floor((points - low) / voxel).astype(np.int64)
    _, cells = np.unique((at[:, 0] << 42) | (at[:, 1] << 21) | at[:, 2], return_inverse=True)
    return np.asarray(cells.reshape(-1), np.int64)


def _means(values: NDArray[Any], cells: NDArray[np.int64]) -> Float64:
    """Mean per voxel, (voxels, 3), of values (N, 3). They are summed in the order of the file."""
    counts = np.bincount(cells)
    return np.stack([np.bincount(cells, values[:, axis]) / counts for axis in range(3)], axis=1)
