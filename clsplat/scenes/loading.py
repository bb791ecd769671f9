# SPDX-License-Identifier: Apache-2.0
"""Loading of scenes (`load_scene`): pictures with cameras at the working size, held-out views, checks, and points.

`folder_layouts.detect` decides which layout a folder has, also if several would fit.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.checks import misfit
from clsplat.config.cli_defaults import TEST_EVERY, TEST_MOST
from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.config.orientation import AS_IN_FILES, FrameUse
from clsplat.config.training import Lenses, Missing, TrainConfig
from clsplat.errors import InputError, examples, plain, warn
from clsplat.files.documents import digest
from clsplat.images.reading import image_size
from clsplat.models.edit import decompose
from clsplat.progress import Progress
from clsplat.scenes.camera_checks import camera_checks
from clsplat.scenes.dataset import DataSet, Lens, PosedImage, SceneFrame
from clsplat.scenes.folder_layouts import Kind, detect, read_colmap, read_survey, read_transforms
from clsplat.scenes.orientation.new_frame import in_frame, new_frame
from clsplat.scenes.outliers import OUTLIER_DISTANCE_RATIO
from clsplat.scenes.readers.scene_place import georeference_by_gps, georeferenced
from clsplat.scenes.scene import Scene, Split, View
from clsplat.scenes.sfm.reconstruct import reconstruct
from clsplat.scenes.sfm.video_frames import reconstruction_folder
from clsplat.scenes.start.point_cloud import with_cloud_beside, without_stray_points
from clsplat.scenes.supervision.masks import after_sfm, for_sfm, masks_of

DEFAULT_MAX_SIDE_PX = 1600
"""Default maximum of a picture's longest side in pixels."""
MAX_ASPECT_RATIO_CHANGE = 1.5
"""Largest factor by which the aspect ratios of a picture and its camera may differ; for 4:3 and 16:9 it is 1.33.

A file whose ratio differs more, or that is rotated, counts as another picture.
"""
SIDE_ROUNDING_PX = 2.5
"""Largest difference between a camera's side and its picture's, in pixels of the camera, that rounding may cause."""
BLENDER_CUBE_HALF_SIDE = 1.3
"""Half the side, in world units, of the cube for random points in Blender's scenes. This is the 3DGS authors' value."""


def load_scene(
    path: str | Path,
    *,
    resolution: int = 0,
    test_every: int = TEST_EVERY,
    test_most: int = TEST_MOST,
    images: str | Path | None = None,
    lenses: Lenses = "undistort",
    work_dir: Path | None = None,
    progress: Progress | None = None,
    masks: MaskUse = NO_MASKS,
    missing: Missing = "few",
    frame: FrameUse | SceneFrame = AS_IN_FILES,
    frames: int | None = None,
) -> Scene:
    """Read a scene's cameras, points and picture headers. `View.load` reads the pixels.

    path: a folder in a layout that `detect` knows, a transforms.json, a survey's file of cameras, or a video.
    resolution: longest side of the views in pixels, never larger than the pictures. 0 keeps their size up to 1600.
    test_every: every n-th view, by name, is held out; 0 for none. A split in the data set takes precedence.
    test_most: maximum number of held-out views. Of more, an even selection is held out. 0 for no maximum.
    images: another folder with the pictures, relative to `path`, such as "images_4". By default, images_2, images_4 or
        images_8 of a COLMAP scene is used instead of larger pictures if its pictures have exactly the requested size.
        Such a folder of any size is used if there are no other pictures.
    lenses: "undistort" turns fisheyes into pinhole cameras, "native" keeps them.
    work_dir: output of structure from motion, by default NAME_colmap next to `path`.
    progress: function that is called with the name of a stage, and the fraction that is done, or None if unknown.
    masks: the meaning of masks and alpha channels (`clsplat.scenes.supervision.masks`). With masks, downscaled pictures
        are not used, and structure from motion finds no features in masked pixels.
    missing: how many listed pictures may be missing: "few" (a tenth), "skip" (all but one) or "error" (none).
    frame: a change of the files' frame, such as `FrameUse("up")`, or the frame of an earlier run, which the scene gets.
    frames: number of frames to take from each video. None uses frames that were taken before, of any number. If
        there are none, the video's length and motion decide the number.

    A folder of photographs or videos, and a video, goes through `clsplat.scenes.sfm.reconstruct` first. An earlier
    result for the same photographs is reused.

    Raises InputError that names the file for invalid input: see `detect`, `colmap.read_model` and
    `transforms.read_transforms`. Also raises it for listed pictures that are missing or have another size than their
    camera, and for headers that do not decode.

    `Scene.warnings` reports unlisted pictures, except for masks, depths and the like (`reading.companions`). It also
    reports pictures on both sides of the split, missing pictures, and pictures found under other names. Outliers
    (`outliers`) and implausible cameras (`camera_checks`) are reported too.
    """
    path = Path(path)
    _check_counts(resolution=resolution, test_every=test_every, test_most=test_most)
    kind = detect(path)
    _check_kind(path, kind, images, frames)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        files = _reframed(_read(path, kind, images, missing, masks, work_dir, frames, progress), path, frame)
        views = _views(files, path, resolution, (test_every, test_most), lenses)
        scene = _scene(files, path, kind, views)
        # Outlier cameras are not checked, because `_scene` has already warned of them.
        near_views = [view for view in views if view.name not in scene.stray_cameras]
        for doubt in camera_checks([(view.name, view.camera, view.lens) for view in near_views], scene.points):
            warn(doubt)
    scene.warnings = [plain(str(warning.message)) for warning in caught]
    return scene


def load_scene_of(
    config: TrainConfig,
    path: str | Path,
    *,
    masks: MaskUse | None = None,
    frame: FrameUse | SceneFrame = AS_IN_FILES,
    frames: int | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Read a scene with the size, split, masks and lenses of a training's settings, as `load_scene` does.

    masks: the meaning of masks and alpha channels; None for that of the settings.
    For the other arguments, errors and warnings, see `load_scene`.
    """
    return load_scene(
        path,
        resolution=config.resolution,
        test_every=config.test_every,
        test_most=config.test_most,
        lenses=config.lenses,
        masks=config.mask_use if masks is None else masks,
        missing=config.missing,
        frame=frame,
        frames=frames,
        progress=progress,
    )


def _check_kind(path: Path, kind: Kind, images: str | Path | None, frames: int | None) -> None:
    """Raise InputError for arguments of `load_scene` that do not apply to the layout `kind`."""
    if frames is not None and kind != "photos":
        raise InputError(f"--frames {frames}: {path} is a scene with cameras, expected a video or a folder with videos")
    if images is not None and kind == "photos":
        raise InputError(
            f"{path}: is a folder of photos; another folder of images can be chosen only for a scene with cameras"
        )


def _check_counts(**counts: int) -> None:
    """Raise InputError for an argument of `load_scene` that is no integer of at least 0."""
    for name, number in counts.items():
        if (expected := misfit(int, number)) or number < 0:
            raise InputError(f"{name} {number}: expected {expected or '0 or more'}")


@dataclass(frozen=True)
class _SceneFiles:
    """A data set whose picture headers have not been read yet.

    source: the folder from which the data set was read. For photographs it is the result of structure from motion.
    smaller: folders of downscaled pictures that may be used instead of the data set's pictures.
    masks: the meaning of masks and alpha channels in `source`.
    world_from_files: (4, 4), the similarity from the frame of the files to that of `data`; None if they are equal.
    """

    data: DataSet
    source: Path
    smaller: Sequence[Path]
    masks: MaskUse
    world_from_files: Float64 | None = None


def _read(
    path: Path,
    kind: Kind,
    images: str | Path | None,
    missing: Missing,
    masks: MaskUse,
    work_dir: Path | None,
    frames: int | None,
    progress: Progress | None,
) -> _SceneFiles:
    """Read a data set of the layout `kind`. For photographs, run structure from motion first.

    images, missing, masks, work_dir, frames, progress: as for `load_scene`.
    """
    if kind in ("blender", "transforms", "survey"):
        if kind == "survey":
            data = read_survey(path, images, missing)
        else:
            data = read_transforms(path, kind, images, missing, masks=masks.masks != "none")
        return _SceneFiles(georeferenced(data, path, [path if path.is_dir() else path.parent]), path, (), masks)
    folder = path
    if kind == "photos":
        photos = path.resolve()
        folder = work_dir or reconstruction_folder(photos)
        folder = reconstruct(photos, folder, masks=for_sfm(masks), frames=frames, progress=progress)
        masks = after_sfm(masks, folder)
    data, smaller = read_colmap(folder, images, missing)
    return _SceneFiles(data, folder, smaller if masks == NO_MASKS else (), masks)


def _reframed(files: _SceneFiles, path: Path, frame: FrameUse | SceneFrame) -> _SceneFiles:
    """Return the data set in another frame. frame: as for `load_scene`."""
    data = files.data
    if isinstance(frame, FrameUse):
        frame.check()
        if not frame:
            return files
        photographs = {image.name: image.path for image in data.images}
        frame = new_frame(path, data, photographs, frame, data.frame, turned=False)
    change = frame.change_from(data.frame)
    if change is not None:
        data = in_frame(data, change)
    return replace(files, data=replace(data, frame=frame), world_from_files=change)


def _views(files: _SceneFiles, path: Path, resolution: int, test_views: tuple[int, int], lenses: Lenses) -> list[View]:
    """Return the data set's views, sorted by name, with split and masks.

    Warns of held-out pictures that are copies of training pictures, and of pictures that do not have their camera's
    aspect ratio.

    test_views: test_every and test_most, as for `load_scene`.
    resolution, lenses: as for `load_scene`.
    """
    data = files.data
    posed = sorted(data.images, key=lambda image: image.name)
    of_pictures = masks_of(files.masks, posed, path, strict=not data.missing)
    own_split = any(image.split for image in posed)
    held_out_names = frozenset(_held_out(sorted([*(image.rank for image in posed), *data.missing]), *test_views))
    views = []
    for image in posed:
        held_out = image.split == "test" if own_split else image.rank in held_out_names
        view = _view(image, "test" if held_out else "train", resolution, files.smaller, lenses)
        views.append(replace(view, mask=of_pictures.get(image.name), depth_file=image.depth).stamped())
    _warn_of_copies(views)
    _warn_of_uneven(posed, views)
    return views


def _held_out(names: Sequence[str], every: int, most: int) -> Sequence[str]:
    """Return the names to hold out: every `every`-th of the sorted names; none if `every` is 0.

    most: maximum number of names. If there are more, an evenly spaced selection is returned. 0 for no maximum.
    """
    chosen = names[::every] if every > 0 else []
    if not 0 < most < len(chosen):
        return chosen
    return [chosen[index * len(chosen) // most] for index in range(most)]


def _scene(files: _SceneFiles, path: Path, kind: Kind, views: list[View]) -> Scene:
    """Return the scene of the views, with points and bounds for random points. Warns of outliers and missing points."""
    data = files.data
    cube = np.full(3, BLENDER_CUBE_HALF_SIDE)
    whole = path.resolve()
    name = whole.name if path.is_dir() else whole.stem if kind == "photos" else whole.parent.name  # a video's own name
    scene = Scene(name, views, data.points, data.colors, (-cube, cube), source=files.source, clouds=tuple(data.clouds))
    scene.missing = tuple(data.missing)
    scene.frame, scene.world_from_files = data.frame, files.world_from_files
    scene.georeference = data.georeference or georeference_by_gps(data.frame)
    if files.world_from_files is not None:
        scene.file_unit, _, shift = decompose(files.world_from_files)
        scene.bounds = shift - scene.file_unit * cube, shift + scene.file_unit * cube
    if len(scene.points) == 0:
        scene = with_cloud_beside(scene)
        if not len(scene.points) and kind in ("colmap", "survey", "photos"):
            warn(f"{path}: has no points; training starts from random points")
    if kind != "blender":
        near = [view.camera for view in views if view.name not in scene.stray_cameras]
        scene.bounds = camera_bounds(near, data.box)
    return without_strays(scene)


def without_strays(scene: Scene) -> Scene:
    """Return a copy of a scene without outlier points. Warns of outlier points and outlier cameras."""
    if scene.stray_cameras:
        warn(
            f"{scene.name}: {len(scene.stray_cameras):,} camera(s) are over {OUTLIER_DISTANCE_RATIO:g} times as far "
            f"away as the others ({examples(sorted(scene.stray_cameras))}) and do not affect the scene's size; if "
            "their poses are wrong, correct them or leave these photographs out"
        )
    kept = without_stray_points(scene.points, scene, scene.name)
    return scene if kept.all() else replace(scene, points=scene.points[kept], point_colors=scene.point_colors[kept])


def camera_bounds(cameras: list[Camera], box: tuple[Float64, Float64] | None = None) -> tuple[Float64, Float64]:
    """Return the corners (low, high) of a cube for random points, around the point that the cameras face.

    The cube's centre is the point nearest to all optical axes. If the axes are parallel, a weak pull towards a point
    ahead of the cameras determines the centre. The cube holds all cameras. It is three times as large if the cameras
    face away from its centre (outward from one place).

    box: corners (low, high) of a box to which the cube is clipped, if they overlap.
    """
    centres = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    mean = centres.mean(axis=0)
    spread = float(np.linalg.norm(centres - mean, axis=1).max()) or 1.0
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = mean + spread * axes.mean(axis=0)
    pull = 1e-2
    matrix = across.mean(axis=0) + pull * np.eye(3)
    focus = np.linalg.solve(matrix, (across @ centres[:, :, None]).mean(axis=0)[:, 0] + pull * ahead)
    half = max(float(np.linalg.norm(centres - focus, axis=1).max()), spread)
    if np.median(np.sum((focus - centres) * axes, axis=1)) <= 0:
        half *= 3
    low, high = focus - half, focus + half
    if box is not None:
        inner_low, inner_high = np.maximum(low, box[0]), np.minimum(high, box[1])
        if (inner_low < inner_high).all():
            return inner_low, inner_high
    return low, high


def _warn_of_copies(views: list[View]) -> None:
    """Warn of held-out pictures that are also training pictures: their scores do not measure unseen viewpoints."""
    by_size: dict[int, list[View]] = {}
    for view in views:
        by_size.setdefault(view.path.stat().st_size, []).append(view)
    copies = []
    for same in by_size.values():
        if len({view.split for view in same}) > 1:
            trained = {digest(view.path): view.name for view in reversed(same) if view.split == "train"}
            held_out = [(view.name, trained.get(digest(view.path))) for view in same if view.split == "test"]
            copies += [f"{name} is {other}" for name, other in held_out if other is not None]
    if copies:
        warn(
            f"{len(copies)} of the held-out pictures are also training pictures, with another name, so that their "
            f"scores mean little: {examples(sorted(copies))}; remove the copies"
        )


def _view(image: PosedImage, split: Split, resolution: int, smaller: Sequence[Path], lenses: Lenses) -> View:
    """Return the view of an image at the working size. Reads and checks the picture's header.

    resolution, lenses: as for `load_scene`.
    smaller: folders with downscaled copies of the pictures; a copy of the working size is used.
    """
    lens, upright = _fit(image.path, image.lens)
    camera = lens.camera(image.rotation, image.translation, lenses)
    longest = max(camera.width, camera.height)
    scale = min(1.0, (resolution or DEFAULT_MAX_SIDE_PX) / longest)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    path = image.path
    if scale < 1 and lens.is_pinhole and not upright:
        for folder in smaller:
            candidate = folder / image.name
            if candidate.is_file() and _stands_in(candidate, width, height, lens):
                path = candidate
                width, height = image_size(path, orient=False)
                lens = lens.resized(width, height)
                break
    return View(image.name, camera.resized(width, height), path, split, lens, upright)


def _warn_of_uneven(images: Sequence[PosedImage], views: Sequence[View]) -> None:
    """Warn of pictures whose width and height differ from their camera's by different factors.

    The camera is scaled by both factors, as in gsplat. However, such a picture may also belong to another camera.
    """
    uneven = []
    for image, view in zip(images, views, strict=True):
        across, down = view.lens.width / image.lens.width, view.lens.height / image.lens.height
        by_one = max(abs(across - down) * image.lens.width, abs(across - down) * image.lens.height)
        if by_one > SIDE_ROUNDING_PX:
            uneven.append((image.name, across, down))
    if uneven:
        _, across, down = uneven[0]
        warn(
            f"{examples(name for name, *_ in uneven)}: has {across:.4g} times the width and {down:.4g} times the "
            "height of its camera, which is scaled by these factors; do the cameras belong to these pictures?"
        )


def _stands_in(path: Path, width: int, height: int, lens: Lens) -> bool:
    """Return True if a picture is downscaled and has the requested size, to within 1 pixel on the shorter side.

    lens: the lens at the size of the original picture.
    """
    size = image_size(path, orient=False)
    near = abs(size[0] - width) <= 1 and abs(size[1] - height) <= 1
    return near and max(size) == max(width, height) and max(size) < max(lens.width, lens.height)


def _fit(path: Path, lens: Lens) -> tuple[Lens, bool]:
    """Return the lens at the file's size, and True if the picture must be rotated by its EXIF orientation.

    COLMAP, instant-ngp and nerfstudio use the pixels as stored. If only the rotated picture has the camera's aspect
    ratio, the cameras are from a tool that rotates pictures, so that the picture is rotated here too. Raises InputError
    if the aspect ratio differs by more than MAX_ASPECT_RATIO_CHANGE.
    """
    stored = image_size(path, orient=False)
    if stored == (lens.width, lens.height):
        return lens, False
    turned = image_size(path, orient=True)
    if turned == (lens.width, lens.height):
        return lens, True
    for size, upright in ((stored, False), (turned, True)):
        scale = max(size) / max(lens.width, lens.height)
        if abs(lens.width * scale - size[0]) <= 1 and abs(lens.height * scale - size[1]) <= 1:
            return lens.resized(*size), upright
    if 1 / MAX_ASPECT_RATIO_CHANGE <= stored[0] / lens.width / (stored[1] / lens.height) <= MAX_ASPECT_RATIO_CHANGE:
        return lens.resized(*stored), False
    raise InputError(
        f"{path}: has {stored[0]}x{stored[1]} pixels, expected its camera's size, {lens.width}x{lens.height}, or "
        "that aspect ratio; are these the pictures from which the cameras were computed?"
    )
