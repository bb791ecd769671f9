# SPDX-License-Identifier: Apache-2.0
"""Reading of camera files of any format, and choice of the shot that the arguments of `clsplat render` ask for.

A shot has at most MAX_SHOT_FRAMES frames (`shots.shot`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.orientation import AS_IN_FILES, FrameUse
from clsplat.config.training import Lenses
from clsplat.errors import InputError, examples
from clsplat.files.documents import is_file, parse_json, read_document
from clsplat.gaussians import Gaussians
from clsplat.models.edit import decompose, transform_camera
from clsplat.models.formats.usd import USD_SUFFIXES
from clsplat.scenes.camera_checks import cameras_of
from clsplat.scenes.dataset import SOURCE_FRAME, PosedImage, SceneFrame
from clsplat.scenes.orientation.frame_record import read_frame
from clsplat.scenes.orientation.level import COLMAP_UP
from clsplat.scenes.outliers import OUTLIER_DISTANCE_RATIO, stray_cameras
from clsplat.scenes.readers import colmap, transforms
from clsplat.scenes.readers.colmap import find_model, read_cameras
from clsplat.scenes.readers.surveys.formats import SURVEY_FILES, survey_of
from clsplat.scenes.readers.transforms import read_poses
from clsplat.shots.default_orbit import among, cameras_around, parse_up
from clsplat.shots.generated import PATH_GENERATORS
from clsplat.shots.readers.cameras_json import CAMERAS_JSON_NAME, read_cameras_json
from clsplat.shots.readers.clsplat_json import CAMERAS_VERSION_KEY, read_keyed
from clsplat.shots.readers.nerfstudio import read_camera_path
from clsplat.shots.readers.usd import read_usd
from clsplat.shots.readers.usd_settings import window_named
from clsplat.shots.shot import MAX_SHOT_FRAMES, Frame, Shot, named, numbered, photographs

DEFAULT_PATH_FRAMES = 120
"""Default number of frames of a generated path such as a turntable: five seconds at 24 fps."""
EXPECTED_CAMERA_SOURCES = (
    f"a COLMAP model's folder, a transforms.json, {SURVEY_FILES}, a nerfstudio camera_path.json, a cameras.json of a "
    "3DGS training, a clsplat camera file (.json) or a USD stage"
)


def read_shot(
    path: Path,
    *,
    size: tuple[int | None, int | None] = (None, None),
    usd_camera: str | None = None,
    lenses: Lenses = "undistort",
) -> Shot:
    """Read the frames of any camera file, whose format is recognised from its content. docs/cameras.md describes the
    formats.

    size: requested width and height, for files that do not give a size (USD; transforms.json without its pictures).
    usd_camera: path or name of the camera to use in a USD stage.
    lenses: how lenses of photographs are treated, as in `load_scene`.
    Raises InputError, naming the file, if it is missing, of an unknown kind, damaged or without frames.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such folder or file, expected {EXPECTED_CAMERA_SOURCES}")
    is_usd = path.suffix.lower() in USD_SUFFIXES
    if usd_camera is not None and not is_usd:
        raise InputError(f"--usd-camera {usd_camera}: {path} is not a USD stage, expected this flag with USD only")
    if path.is_dir():
        return _read_folder(path, size, lenses)
    if (survey := survey_of(path)) is not None:
        return Shot(named(cameras_of(survey.images(), lenses)))
    if is_usd:
        return read_usd(path, size, usd_camera)
    if path.suffix.lower() == ".json":
        return _read_json(path, size, lenses)
    raise InputError(f"{path}: has the extension {path.suffix or 'none'!r}, expected {EXPECTED_CAMERA_SOURCES}")


def choose_shot(
    cameras: Path,
    *,
    path: str | None = None,
    count: int | None = None,
    size: tuple[int | None, int | None] = (None, None),
    usd_camera: str | None = None,
    lenses: Lenses = "undistort",
    applied: Collection[str] = (),
    distort: bool = False,
    frame: FrameUse | SceneFrame = AS_IN_FILES,
) -> Shot:
    """The shot that --cameras, --path and --count ask for together.

    path: turntable, spiral or through, for a path generated from the cameras; None for the cameras themselves.
    count: number of frames of a generated path; None for DEFAULT_PATH_FRAMES.
    size, usd_camera, lenses: as in `read_shot`.
    applied: names of the USD stage's settings that the caller applies itself, so that they need no warning.
    distort: use the photographs' own cameras, including the distortion of their lenses.
    frame: the frame that the shot gets: a model's, or AS_IN_FILES. The cameras must be of the model's own scene.
    Raises InputError.
    """
    if count is not None and path is None:
        raise InputError(f"--count {count}: expected --path with it, as camera files have their own frames")
    _check_count(count)
    if distort and path is not None:
        raise InputError(f"--distort: applies to the photographs' own cameras, expected it without --path {path}")
    if distort:
        shot = Shot(photographs(photographed(cameras, size)))
    else:
        shot = read_shot(cameras, size=size, usd_camera=usd_camera, lenses=lenses)
    change, up = _change_and_up(cameras, frame)
    if path is not None:
        if not (first := shot.frames[0].camera).model.flat:
            raise InputError(
                f"{cameras}: its cameras are {first.projection}, --path needs perspective or orthographic ones"
            )
        shot = shot.without_optics()
        unapplied = (*shot.unapplied, *window_named(shot.window))
        near, told = _without_strays(shot.frames, cameras)
        shot = Shot(_path(path, near, count, up), (*shot.warnings, *told), unapplied=unapplied)
    if applied:
        shot = replace(shot, unapplied=tuple(text for text in shot.unapplied if text.partition(" (")[0] not in applied))
    if change is not None:
        moved = (replace(one, camera=transform_camera(one.camera, change)) for one in shot.frames)
        shot = replace(shot, frames=tuple(moved))
    return shot


def _change_and_up(cameras: Path, frame: FrameUse | SceneFrame) -> tuple[Float64 | None, Float64 | None]:
    """Return the similarity (4, 4) from the frame of a scene's files to `frame`, and up (3,) in the frame of the files.

    cameras, frame: as for `choose_shot`. The similarity is None if the frames are equal. Up is None if it is not known,
        and for a file of cameras.
    """
    is_folder = cameras.is_dir()
    model = find_model(cameras) if is_folder else None
    files = SOURCE_FRAME if model is None else read_frame(model)
    wanted = frame if isinstance(frame, SceneFrame) else files
    change = wanted.change_from(files)
    if files.upright:
        return change, np.array(COLMAP_UP)
    if change is None or not wanted.upright or not is_folder:
        return change, None
    return change, decompose(change)[1].T @ COLMAP_UP


def _without_strays(frames: Sequence[Frame], source: Path) -> tuple[list[Camera], tuple[str, ...]]:
    """Return the cameras of the frames except outliers, and a warning that names the outliers, if there are any.

    source: file or folder of the cameras, for the warning.
    """
    far = stray_cameras([frame.camera for frame in frames])
    near = [frame.camera for frame, stray in zip(frames, far, strict=True) if not stray]
    if not far.any():
        return near, ()
    names = examples(frame.name for frame, stray in zip(frames, far, strict=True) if stray)
    far_away = f"over {OUTLIER_DISTANCE_RATIO:g} times as far from the middle as the others"
    return near, (f"{source}: the cameras of {names} are {far_away}, and the path is made without them",)


def photographed(path: Path, size: tuple[int | None, int | None] = (None, None)) -> list[PosedImage]:
    """Read the photographs' cameras, with the distortion of their lenses.

    path: a COLMAP model, a transforms.json, or the cameras of a survey.
    size: width and height in pixels, for a transforms.json that gives no size; used only if both are given.
    Raises InputError like `read_shot`, for other sources of cameras, and for panoramas, which cannot be warped from a
    pinhole picture.
    """
    images: list[PosedImage] | None = None
    if path.is_dir():
        listed = sorted(file.name for file in path.glob("transforms*.json"))
        model = find_model(path)
        if model is not None and not (listed and "colmap" in model.relative_to(path).parts):
            images = colmap.read_images(path)
        elif listed == ["transforms.json"]:
            images = transforms.read_images(path / listed[0], _both(size))
        elif not listed and (survey := survey_of(path)) is not None:
            images = survey.images()
    elif (survey := survey_of(path)) is not None:
        images = survey.images()
    elif path.suffix.lower() == ".json" and "frames" in _parsed(path):
        images = transforms.read_images(path, _both(size))
    if images is None:
        raise InputError(
            f"{path}: has no cameras of photographs with their lens distortion, expected {SURVEY_FILES}, a COLMAP "
            "model's folder or a transforms.json"
        )
    if wrong := [image.name for image in images if image.lens.is_panorama]:
        raise InputError(f"{path}: {examples(wrong)} are panoramas, which cannot be warped from a pinhole picture")
    cameras_of(images)  # called for its warnings on implausible cameras
    return images


def _both(size: tuple[int | None, int | None]) -> tuple[int, int] | None:
    width, height = size
    return (width, height) if width is not None and height is not None else None


def shot_around(
    gaussians: Gaussians,
    path: str | None,
    *,
    count: int | None = None,
    size: tuple[int | None, int | None] = (None, None),
    up: str | None = None,
    own: Sequence[Camera] = (),
    level: bool = False,
) -> Shot:
    """Return the shot that --path, --count and --up ask for if --cameras is not given.

    level: True if up is -y in the frame of the cameras `own`; otherwise it is estimated.
    The path goes among the photographs' cameras `own` if these are known and `up` is None. Otherwise it goes around the
    model, as in `cameras_around`. Raises InputError.

    path: turntable, spiral or through; None is an error. count: number of frames; None for DEFAULT_PATH_FRAMES.
    size: as in `among` or `cameras_around`. up: text of --up (`parse_up`); None for the default.
    """
    among_own = bool(own) and up is None
    path = check_around(path, among_own=among_own)
    _check_count(count)
    if among_own:
        return Shot(_path(path, among(own, size), count, np.array(COLMAP_UP) if level else None))
    found = cameras_around(gaussians, COLMAP_UP if up is None else parse_up(up), size)
    return Shot(_path(path, found, count))


def check_around(path: str | None, *, among_own: bool = False) -> str:
    """Check the kind of path that --path gives when --cameras is not given, and return it.

    among_own: True if the path goes among the photographs' cameras; False if it goes around the model.
    Raises InputError for None, and for a path that needs --cameras.
    """
    if path is None:
        raise InputError(
            "--cameras is missing, expected cameras to render from; or --path turntable or spiral alone, for a path "
            "around the model"
        )
    if path == "through" and not among_own:
        raise InputError("--path through: goes through cameras, expected --cameras with it")
    return path


def _check_count(count: int | None) -> None:
    if count is not None and not 1 <= count <= MAX_SHOT_FRAMES:
        raise InputError(f"--count {count}: expected 1 to {MAX_SHOT_FRAMES:,} frames")


def _path(path: str, cameras: Sequence[Camera], count: int | None, up: Float64 | None = None) -> tuple[Frame, ...]:
    return numbered(PATH_GENERATORS[path](cameras, DEFAULT_PATH_FRAMES if count is None else count, up))


def _read_folder(path: Path, size: tuple[int | None, int | None], lenses: Lenses) -> Shot:
    listed = sorted(file.name for file in path.glob("transforms*.json"))
    if listed:
        # nerfstudio keeps a COLMAP model in colmap/, but trains in the world of its transforms.json
        model = find_model(path)
        if model is None or "colmap" in model.relative_to(path).parts:
            if listed != ["transforms.json"]:
                raise InputError(f"{path}: holds {examples(listed)}, expected --cameras to name one of them")
            return _read_json(path / listed[0], size, lenses)
    if find_model(path) is None:
        if (survey := survey_of(path)) is not None:
            return Shot(named(cameras_of(survey.images(), lenses)))
        if is_file(path / CAMERAS_JSON_NAME):
            return _read_json(path / CAMERAS_JSON_NAME, size, lenses)
    cameras = read_cameras(path, lenses)
    if not cameras:
        raise InputError(f"{path}: has no images, expected at least one")
    return Shot(named(cameras))


def _read_json(path: Path, size: tuple[int | None, int | None], lenses: Lenses) -> Shot:
    document = _parsed(path)
    if isinstance(document, list):
        return read_cameras_json(path, document, size)
    if CAMERAS_VERSION_KEY in document:
        return read_keyed(path, document)
    if "camera_path" in document or "keyframes" in document:
        return read_camera_path(path, document)
    if "frames" not in document:
        raise InputError(
            f"{path}: has neither '{CAMERAS_VERSION_KEY}' (a clsplat camera file) nor 'camera_path' (nerfstudio's) nor "
            "'frames' (a transforms.json), expected one of them"
        )
    return Shot(named(read_poses(path, _both(size), lenses)))


def _parsed(path: Path) -> dict[str, Any] | list[Any]:
    """Read the JSON object or list in a file of cameras. Raises InputError."""
    try:
        document = parse_json(read_document(path, "a file of cameras"), once=True)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}; expected a file of cameras") from None
    if not isinstance(document, dict | list):
        keys = f"'frames', 'camera_path' or '{CAMERAS_VERSION_KEY}'"
        raise InputError(f"{path}: is not a JSON object, expected one with {keys}, or a list of cameras")
    return document
