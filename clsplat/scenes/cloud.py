# SPDX-License-Identifier: Apache-2.0
"""Clouds of points to start from: checked against the cameras, thinned by voxels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.config.points import StartPoints
from clsplat.errors import InputError, warn
from clsplat.scenes.data_set import pixels_of
from clsplat.scenes.initialise import UNSEEN
from clsplat.scenes.point_files import Cloud, read_cloud
from clsplat.scenes.sky import sky_points
from clsplat.scenes.strays import FACTOR, MOST_POINTS, strays

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

LOOKED_AT = 20_000
"""Points of a cloud that are held against the cameras, spread evenly."""
IN_VIEW = 0.05
"""Share of a cloud's points, at least, that the training photographs show."""
APART = 30.0
"""Factor by which the depths of a cloud and of the scene's points, as the photographs see them, may differ."""
FAR = 1000.0
"""Distance of a cloud from the cameras, in the scene's extents, where the scene has no points."""
CLOSE = 0.02
"""Part by which the voxel is at most larger than it need be."""
CELLS = 1 << 20
"""Voxels along the longest side of the box, at most: three such numbers are one of 64 bits."""


def with_points(scene: Scene, start: StartPoints) -> Scene:
    """The scene with the points that training starts from; itself if it has them already.

    Raises InputError for a file that cannot be read, and for a cloud that lies elsewhere than what the cameras see.
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
        own_colors = np.full(cloud.points.shape, UNSEEN, np.float32) if cloud.colors is None else cloud.colors
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
    """A scene without points, with those of the first file beside it that has some where its cameras look; itself where
    there is none. Warns of files that do not read, or lie elsewhere."""
    for index, path in enumerate(scene.clouds):
        try:
            cloud = read_cloud(path)
            check_place(cloud.points, scene, path)
        except InputError as error:
            warn(f"{error}; it is not used")
            continue
        warn(f"{path}: its {len(cloud.points):,} points are the scene's, which names none")
        colors = np.full(cloud.points.shape, UNSEEN, np.float32) if cloud.colors is None else cloud.colors
        return replace(scene, points=cloud.points, point_colors=colors, clouds=scene.clouds[index + 1 :])
    return replace(scene, clouds=()) if scene.clouds else scene


def without_stray_points(points: Float64, scene: Scene, where: object) -> NDArray[np.bool_]:
    """(N,): False for points (N, 3) that are strays beside the others and the scene's cameras. Warns of them; where:
    what they are of."""
    middle, spread, _ = scene.spread
    kept = ~strays(points, MOST_POINTS, spread, middle)
    if not kept.all():
        far = points[~kept]
        first = " ".join(f"{value:.4g}" for value in far[0])
        warn(
            f"{where}: {len(far):,} of {len(points):,} points lie over {FACTOR:g} times as far off as the others, such "
            f"as {first}, and are left out"
        )
    return kept


def check_place(points: Float64, scene: Scene, path: Path) -> None:
    """Raise InputError for a cloud of points (N, 3) that the training photographs do not show, or that lies far in
    front of or behind what they do."""
    looked = _spread(points)
    seen, depths = _seen(looked, scene)
    advice = "expected points in the scene's frame, as its cameras: the same axes, scale and origin"
    if seen < max(IN_VIEW * len(looked), 1):
        raise InputError(
            f"{path}: {100 * seen / len(looked):.1f} % of its points lie in a training photograph, {_where(points)}, "
            f"and the cameras stand {_where(_centres(scene))}; {advice}"
        )
    if len(scene.points):
        _, usual = _seen(_spread(scene.points), scene)
    else:
        usual = scene.extent if depths > FAR * scene.extent else depths
    if usual > 0 and not 1 / APART <= depths / usual <= APART:
        raise InputError(
            f"{path}: its points are {depths:.3g} from the cameras that see them, {_where(points)}, and what the scene "
            f"has is {usual:.3g}; {advice}"
        )


def _spread(points: Float64) -> Float64:
    return points[:: -(-len(points) // LOOKED_AT)]


def _seen(points: Float64, scene: Scene) -> tuple[int, float]:
    """How many points are in a training photograph, and the median distance from the cameras that see them."""
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
    """Such as "about 1 2 3 within 4"."""
    middle = np.median(points, axis=0)
    place = " ".join(f"{value:.4g}" for value in middle)
    return f"about {place} within {np.median(np.linalg.norm(points - middle, axis=1)):.3g}"


def thinned(cloud: Cloud, limit: int) -> Cloud:
    """At most `limit` points, one for each voxel that has some: the mean of their places and of their colours. The
    voxel is the smallest that is small enough, to CLOSE of its side; a cloud of no more points stays as it is."""
    points = cloud.points
    if len(points) <= limit:
        return cloud
    low = points.min(axis=0)
    side = float((points - low).max())
    if side == 0:
        return Cloud(points[:1], None if cloud.colors is None else cloud.colors[:1])
    fine, coarse = side / CELLS, side * 1.01  # in one voxel of the latter they are all
    if (cells := _cells(points, low, fine)).max() < limit:
        coarse = fine
    while coarse > fine * (1 + CLOSE):
        middle = (fine * coarse) ** 0.5
        if _cells(points, low, middle).max() < limit:
            coarse = middle
        else:
            fine = middle
    cells = _cells(points, low, coarse)
    places = low + _means(points - low, cells)
    return Cloud(places, None if cloud.colors is None else _means(cloud.colors, cells).astype(np.float32))


def _cells(points: Float64, low: Float64, voxel: float) -> NDArray[np.int64]:
    """Number (N,) of each point's voxel among those that have points."""
    at = np.floor((points - low) / voxel).astype(np.int64)
    _, cells = np.unique((at[:, 0] << 42) | (at[:, 1] << 21) | at[:, 2], return_inverse=True)
    return np.asarray(cells.reshape(-1), np.int64)


def _means(values: NDArray[Any], cells: NDArray[np.int64]) -> Float64:
    """Means (voxels, 3) of values (N, 3), added up in the order of the file."""
    counts = np.bincount(cells)
    return np.stack([np.bincount(cells, values[:, axis]) / counts for axis in range(3)], axis=1)
