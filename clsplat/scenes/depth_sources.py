# SPDX-License-Identifier: Apache-2.0
"""Depths in a scene's photographs: known depths for the depth loss, from COLMAP's tracks or depth maps, and the scene's
length unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.depth import DepthUse
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file
from clsplat.images.depth_maps import DEPTH_MAP_SUFFIXES, map_header, read_map
from clsplat.models.edit import moved
from clsplat.scenes.dataset import nearest_around, occlusion_cell, pixels_of, tracked_in_view
from clsplat.scenes.readers import colmap
from clsplat.scenes.sidecar_files import bases_of, beside, owned
from clsplat.scenes.supervision.depth_samples import KnownDepth, sampled

if TYPE_CHECKING:
    from clsplat.scenes.dataset import Lens
    from clsplat.scenes.scene import Scene, View

DEPTH_FOLDERS = ("depths", "depth")
"""Names of the depth map folder, next to the photographs' folder or inside it."""
MIN_DEPTH_FIT_POINTS = 10
"""Minimum number of points in a photograph for a fit of its relative depth map (disparities)."""
MAX_DEPTH_SCALE_RATIO = 5.0
"""Largest factor by which the scale fitted to a relative depth map may differ from the median scale of all maps."""
DEPTH_TO_UNIT = 1.4
"""Largest length unit, as a multiple of the median depth (`length_unit_of`).

In scenes that are photographed from all around, the extent is at most 1.29 times the median depth. So their length unit
is the extent.
"""
NEAR_PER_EXTENT = 1e-6
"""Least depth of the points that the length unit is computed from, as a fraction of the extent."""
MAX_SAMPLED_VIEWS = 200
"""Maximum number of training photographs, evenly spaced, whose depths give the length unit."""
MAX_SAMPLED_POINTS = 100_000
"""Maximum number of points that are projected into each photograph for the length unit, in scenes without tracks."""


def with_depths(scene: Scene, use: DepthUse) -> Scene:
    """Return a copy of the scene with known depths in its training views; `scene` itself if it already has them.

    Warns of photographs without known depths. Raises InputError for points without tracks. Also raises it for maps that
    are missing, do not decode, have another shape than their photograph, or fit no photograph.
    """
    if scene.depth_use == use:
        return scene
    if not use:
        known: dict[str, KnownDepth] = {}
    elif use.source == "points":
        known = _tracked(scene, f"--depth {use.source}")
    else:
        known = _mapped(scene, use)
    without = [view.name for view in scene.train_views if view.name not in known]
    if use and without:
        warn(
            f"{scene.name}: no depths are known for {len(without):,} photograph(s) ({examples(without)}), which get no "
            "depth loss"
        )
    views = [replace(view, depth=known.get(view.name) if view.split == "train" else None) for view in scene.views]
    return replace(scene, views=views, depth_use=use)


def _tracked(scene: Scene, asked: str) -> dict[str, KnownDepth]:
    """Return the points that COLMAP observed in each photograph, by view name.

    The weight of a point with a reprojection error of e pixels is 1/(1 + e^2).

    asked: the option that needs the points, for messages.
    """
    if (read := _tracks_of(scene)) is None:
        raise InputError(f"{scene.name}: {asked} needs to know which photographs show a point, expected a COLMAP model")
    model, tracks = read
    weights = 1 / (1 + np.square(np.maximum(tracks.errors, 0.0)))
    tracked = sorted(tracks.tracked)
    if not tracked:
        raise InputError(f"{model}: no point has a track, and {asked} needs tracks; export the model with them")
    shown = tracks.shown_in([view.name for view in scene.train_views])
    known = {name: KnownDepth(tracks.points[rows], weights[rows]) for name, rows in shown.items()}
    if not known:
        raise InputError(
            f"{model}: has photographs such as {examples(tracked)} but none of the scene's "
            f"({examples([view.name for view in scene.train_views])}); expected the same names, as {asked} uses the "
            "points of the model's photographs"
        )
    _check_frame(scene, known, model)
    return known


def _check_frame(scene: Scene, known: Mapping[str, KnownDepth], model: Path) -> None:
    """Raise InputError if the cameras project hardly any tracked point into the photographs of the point's track.

    The cameras and the points of `model` then have different world frames.

    known: points that COLMAP observed in each view, by the view's name.
    """
    views = [view for view in scene.train_views if view.name in known]
    seen, whole, enough = tracked_in_view(
        (view.camera.before(scene.near), view.lens, known[view.name].points) for view in views
    )
    if not enough:
        raise InputError(
            f"{model}: the scene's cameras project {seen:,} of {whole:,} tracked points into their photographs, "
            "expected most of them; take cameras and points from the same model"
        )


def _mapped(scene: Scene, use: DepthUse) -> dict[str, KnownDepth]:
    """Return the depth maps of the photographs, by view name. Relative maps get a scale and offset by `_fitted`."""
    told = {view.name: view.depth_file for view in scene.views if view.depth_file}
    files = {**_beside(scene.views, told, strict=not scene.missing), **told}
    if not files:
        raise InputError(
            f"{scene.name}: has no depth maps for --depth maps; expected depths/IMAGE.png, .exr or .npy beside "
            "images/, or 'depth_file_path' in transforms.json"
        )
    nothing = (np.empty((0, 3)), np.empty(0))
    lenses, known = {view.name: view.lens for view in scene.views}, {}
    for name, path in files.items():
        width, height, whole = map_header(path)
        _check_shape(path, width, height, lenses[name])
        known[name] = KnownDepth(*nothing, path, scene.file_unit * (use.unit if whole else 1.0), whole=whole)
    if use.maps == "relative":
        return _fitted(scene, known)
    return {name: one for name, one in known.items() if one.measured(read_map(_path(one))).any()}


def _check_shape(path: Path, width: int, height: int, lens: Lens) -> None:
    if abs(width * lens.height - height * lens.width) > max(lens.width, lens.height):
        raise InputError(
            f"{path}: the depth map has {width}x{height} pixels, expected the aspect ratio of its photograph, "
            f"{lens.width}x{lens.height}; make it again with that ratio"
        )


def _fitted(scene: Scene, known: dict[str, KnownDepth]) -> dict[str, KnownDepth]:
    """Return the relative maps with scales and offsets that convert their values to inverse depths.

    They are fitted to the inverse depths of COLMAP's points in each photograph. The offset comes from medians, the
    scale from mean absolute deviations. Maps with few points, or with a scale far from the others, are left out, and
    `with_depths` warns of them.

    known: the maps by view name.
    """
    points, fits = _tracked(scene, "--depth-maps relative"), {}
    for view in scene.train_views:
        if view.name not in known or view.name not in points:
            continue
        pixels, near, _ = points[view.name].at(view.camera, view.lens)
        values = sampled(read_map(_path(known[view.name])), view.camera, view.lens).ravel()[pixels]
        good = np.isfinite(values)
        if good.sum() >= MIN_DEPTH_FIT_POINTS:
            (aim, by_aim), (middle, by) = (_middle(each[good].astype(np.float64)) for each in (near, values))
            if by > 0:
                fits[view.name] = (by_aim / by, aim - middle * by_aim / by)
    usual = float(np.median([scale for scale, _ in fits.values()])) if fits else 0.0
    good_fits = {
        name: fit for name, fit in fits.items() if 1 / MAX_DEPTH_SCALE_RATIO <= fit[0] / usual <= MAX_DEPTH_SCALE_RATIO
    }
    if not good_fits:
        raise InputError(
            f"{scene.name}: no relative depth map agrees with the points, expected values that grow with nearness "
            "(disparity); if the values are depths, use --depth-maps metric"
        )
    return {name: replace(known[name], fit=fit) for name, fit in good_fits.items()}


def _path(known: KnownDepth) -> Path:
    assert known.path is not None
    return known.path


def _middle(values: Float64) -> tuple[float, float]:
    """Return the median of the values, and their mean absolute deviation from it."""
    median = float(np.median(values))
    return median, float(np.abs(values - median).mean())


def _beside(views: Sequence[View], told: Mapping[str, Path], *, strict: bool) -> dict[str, Path]:
    """Find each view's depth map in a folder next to the photographs' folder or inside it. The keys are view names.

    A map is named like its photograph, with or without the photograph's extension, or with _depth or .depth after the
    stem.

    told: the maps that the data set names, by view name. These files are skipped.
    strict: raise InputError for a map that fits no photograph.
    Raises InputError for two maps of one photograph.
    """
    if all(view.name in told for view in views):
        return {}
    for base in bases_of(views):
        folder = beside(base, DEPTH_FOLDERS)
        if folder is None:
            continue
        known: dict[str, str] = {}
        for view in views:
            plain = PurePosixPath(view.path.relative_to(base).as_posix())
            stem = str(plain.with_suffix(""))
            for key in (str(plain), stem, f"{stem}_depth", f"{stem}.depth"):
                known.setdefault(key, view.name)
        example = next(iter(sorted(known)))
        return owned(folder, _maps_in(folder), known, "depth map", example, without=told.values(), strict=strict)
    return {}


def _maps_in(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in DEPTH_MAP_SUFFIXES and not path.name.startswith(".") and is_file(path):
            yield path


def _tracks_of(scene: Scene) -> tuple[Path, colmap.Tracks] | None:
    """Return the folder of the COLMAP model that the scene was read from, and its tracks; None for other scenes."""
    model = None if scene.source is None else colmap.find_model(scene.source)
    if model is None:
        return None
    tracks = colmap.read_tracks(model)
    if scene.world_from_files is not None:
        tracks = replace(tracks, points=moved(tracks.points, scene.world_from_files))
    return model, tracks


def length_unit_of(scene: Scene) -> float:
    """Return the scene's length unit, in world units: the extent, but at most `DEPTH_TO_UNIT` times the median depth.

    The median is first over the points that a training photograph shows, then over the photographs. COLMAP's tracks
    tell which points a photograph shows. Without tracks, it shows the nearest point in each cell of pixels.
    """
    medians = [float(np.median(depths)) for depths in _depths(scene) if len(depths)]
    unit = DEPTH_TO_UNIT * float(np.median(medians)) if medians else np.inf
    return min(unit, scene.extent) if unit > 0 else scene.extent


def _depths(scene: Scene) -> Iterator[Float64]:
    """Yield, for each sampled training photograph, the depths (k,) of the points that it shows."""
    views = scene.train_views
    views = views[:: max(-(-len(views) // MAX_SAMPLED_VIEWS), 1)]
    tracked = _tracked_points(scene, views)
    points = scene.points[:: max(-(-len(scene.points) // MAX_SAMPLED_POINTS), 1)]
    for view in views:
        if tracked:
            depths = view.camera.depths_of(tracked.get(view.name, np.empty((0, 3))))
            yield depths[depths > 0]
        elif len(points):
            yield _nearest(points, view, NEAR_PER_EXTENT * scene.extent)


def _tracked_points(scene: Scene, views: Sequence[View]) -> dict[str, Float64]:
    """Return the points (k, 3) that tracks observe in each view, by view name.

    The result is empty without tracks, or if the points have another world frame than the cameras.
    """
    if not len(scene.points) or (read := _tracks_of(scene)) is None:
        return {}
    _, tracks = read
    found = {name: tracks.points[rows] for name, rows in tracks.shown_in([view.name for view in views]).items()}
    near = NEAR_PER_EXTENT * scene.extent
    shown = [view for view in views if view.name in found]
    *_, enough = tracked_in_view((view.camera.before(near), view.lens, found[view.name]) for view in shown)
    return found if enough else {}


def _nearest(points: Float64, view: View, near: float) -> Float64:
    """Return the depths (k,) of the points that a view shows: in each cell of pixels, the nearest of `points` (N, 3).

    near: points at less than this depth are ignored; a camera's own near plane takes precedence.
    """
    camera = view.camera.before(near)
    rows, columns, inside = pixels_of(points, camera, view.lens)
    depths = camera.depths_of(points[inside])
    around = nearest_around(rows, columns, depths, occlusion_cell(camera, len(depths)))
    nearest: Float64 = depths[depths == around]
    return nearest
