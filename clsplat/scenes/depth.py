# SPDX-License-Identifier: Apache-2.0
"""Known depths of a scene's views: of the points that COLMAP saw in each photograph, or of maps beside them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.depth import DepthUse
from clsplat.errors import InputError, examples, warn
from clsplat.files import is_file
from clsplat.images.depth_maps import EXTENSIONS, map_header, read_map
from clsplat.scenes import colmap
from clsplat.scenes.beside import bases_of, beside, owned
from clsplat.scenes.data_set import pixels_of
from clsplat.scenes.known_depth import KnownDepth, sampled
from clsplat.scenes.picture_names import match

if TYPE_CHECKING:
    from clsplat.scenes.data_set import Lens
    from clsplat.scenes.scene import Scene, View

FOLDERS = ("depths", "depth")
"""Names of the folder of depth maps, beside the photographs' or in it."""
LEAST_POINTS = 10
"""Points of a photograph that its relative map is fitted to, at least."""
SEEN = 0.1
"""Part of the points that are in their photographs at least. A fisheye of 200 degrees keeps 0.4 when it is undistorted;
of cameras in another frame a thousandth was left."""
APART = 5.0
"""Factor by which the scale of a relative map may differ from the median of the photographs'."""


def with_depths(scene: Scene, use: DepthUse) -> Scene:
    """The scene whose training views have what is known of their depths; itself if they have it already.

    Warns of photographs of which nothing is known. Raises InputError for points without tracks, maps that are missing,
    do not read, have another shape than their photograph, or fit none.
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
        warn(f"{scene.name}: of {len(without):,} photograph(s) no depths are known ({examples(without)})")
    views = [replace(view, depth=known.get(view.name) if view.split == "train" else None) for view in scene.views]
    return replace(scene, views=views, depth_use=use)


def _tracked(scene: Scene, asked: str) -> dict[str, KnownDepth]:
    """Points that COLMAP saw in each photograph, weighted by their error e in pixels: 1/(1 + e^2)."""
    model = None if scene.source is None else colmap.find_model(scene.source)
    if model is None:
        raise InputError(f"{scene.name}: {asked} wants to know which photographs show a point, expected a COLMAP model")
    tracks = colmap.read_tracks(model)
    weights = 1 / (1 + np.square(np.maximum(tracks.errors, 0.0)))
    tracked = {name: rows for name, rows in tracks.by_image.items() if len(rows)}
    if not tracked:
        raise InputError(f"{model}: no point has a track, and {asked} goes by them; export the model with tracks")
    names = match([view.name for view in scene.train_views], tracked).names
    rows = {name: tracked[theirs] for name, theirs in names.items()}
    known = {name: KnownDepth(tracks.points[which], weights[which]) for name, which in rows.items()}
    if not known:
        raise InputError(
            f"{model}: has photographs such as {examples(sorted(tracked))}, and none of the scene's "
            f"({examples([view.name for view in scene.train_views])}), expected the same; {asked} goes by their points"
        )
    _check_frame(scene, known, model)
    return known


def _check_frame(scene: Scene, known: Mapping[str, KnownDepth], model: Path) -> None:
    """Raise InputError where hardly a point is in the photographs that show it: cameras of another file may be in
    another frame."""
    seen = whole = 0
    for view in scene.train_views:
        if view.name in known:
            camera = view.camera.before(scene.near)
            seen += int(np.count_nonzero(pixels_of(known[view.name].points, camera, view.lens)[2]))
            whole += len(known[view.name].points)
    if seen < SEEN * whole:
        raise InputError(
            f"{model}: of {whole:,} points that its photographs show {seen:,} are in these by the scene's cameras, "
            "expected most of them: take cameras and points of one model"
        )


def _mapped(scene: Scene, use: DepthUse) -> dict[str, KnownDepth]:
    """Depth maps of the photographs, relative ones with the scale and offset that the points give them."""
    told = {view.name: view.depth_file for view in scene.views if view.depth_file}
    files = {**_beside(scene.views, told, strict=not scene.missing), **told}
    if not files:
        raise InputError(
            f"{scene.name}: --depth maps, and there are none; expected depths/IMAGE.png, .exr or .npy beside images/, "
            "or 'depth_file_path' in transforms.json"
        )
    nothing = (np.empty((0, 3)), np.empty(0))
    lenses, known = {view.name: view.lens for view in scene.views}, {}
    for name, path in files.items():
        width, height, whole = map_header(path)
        _check_shape(path, width, height, lenses[name])
        known[name] = KnownDepth(*nothing, path, use.unit if whole else 1.0, whole=whole)
    if use.maps == "relative":
        return _fitted(scene, known)
    return {name: one for name, one in known.items() if one.measured(read_map(_path(one))).any()}


def _check_shape(path: Path, width: int, height: int, lens: Lens) -> None:
    if abs(width * lens.height - height * lens.width) > max(lens.width, lens.height):
        raise InputError(
            f"{path}: the depth map is {width} x {height} pixels, expected the shape of its photograph's "
            f"{lens.width} x {lens.height}; make it of that shape"
        )


def _fitted(scene: Scene, known: dict[str, KnownDepth]) -> dict[str, KnownDepth]:
    """Relative maps, which grow with nearness, with scale and offset by medians over the points of each photograph.
    Left out, with a warning: those of few points, and of a scale far from the others'."""
    points, fits = _tracked(scene, "--depth-maps relative"), {}
    for view in scene.train_views:
        if view.name not in known or view.name not in points:
            continue
        pixels, near, _ = points[view.name].at(view.camera, view.lens)
        values = sampled(read_map(_path(known[view.name])), view.camera, view.lens).ravel()[pixels]
        good = np.isfinite(values)
        if good.sum() >= LEAST_POINTS:
            (aim, by_aim), (middle, by) = (_middle(each[good].astype(np.float64)) for each in (near, values))
            if by > 0:
                fits[view.name] = (by_aim / by, aim - middle * by_aim / by)
    usual = float(np.median([scale for scale, _ in fits.values()])) if fits else 0.0
    good_fits = {name: fit for name, fit in fits.items() if 1 / APART <= fit[0] / usual <= APART}
    if not good_fits:
        raise InputError(
            f"{scene.name}: no relative depth map agrees with the points, expected values that grow with nearness "
            "(disparity); --depth-maps metric takes them for depths"
        )
    return {name: replace(known[name], fit=fit) for name, fit in good_fits.items()}


def _path(known: KnownDepth) -> Path:
    assert known.path is not None
    return known.path


def _middle(values: Float64) -> tuple[float, float]:
    """Median, and mean absolute distance from it."""
    median = float(np.median(values))
    return median, float(np.abs(values - median).mean())


def _beside(views: Sequence[View], told: Mapping[str, Path], *, strict: bool) -> dict[str, Path]:
    """Maps in the folder beside the photographs, or in theirs, by the views' names. A map is called as its photograph,
    with or without that one's extension, or with _depth behind. told: maps that a file names, to pass over. Raises
    InputError for one that fits no photograph, if strict, and for two of one."""
    if all(view.name in told for view in views):
        return {}
    for base in bases_of(views):
        folder = beside(base, FOLDERS)
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
        if path.suffix.lower() in EXTENSIONS and not path.name.startswith(".") and is_file(path):
            yield path
