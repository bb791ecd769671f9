# SPDX-License-Identifier: Apache-2.0
"""Choice of a shot: the frames that `clsplat render`'s arguments ask for."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.camera import Camera
from clsplat.config.training import Lenses
from clsplat.errors import InputError, examples
from clsplat.files import is_file, parse_json, read_document
from clsplat.gaussians import Gaussians
from clsplat.scenes import colmap, transforms
from clsplat.scenes.camera_checks import cameras_of
from clsplat.scenes.colmap import find_model, read_cameras
from clsplat.scenes.data_set import PANORAMA, PosedImage
from clsplat.scenes.strays import FACTOR, stray_cameras
from clsplat.scenes.transforms import read_poses
from clsplat.shots.around import among, cameras_around, parse_up
from clsplat.shots.cameras_json import NAME, read_cameras_json
from clsplat.shots.clsplat_json import VERSION_KEY, read_keyed
from clsplat.shots.generated import PATHS
from clsplat.shots.nerfstudio import read_camera_path
from clsplat.shots.shot import MOST_FRAMES, Frame, Shot, named, numbered, photographs
from clsplat.shots.usd import read_usd
from clsplat.shots.usd_settings import window_named
from clsplat.shots.viewpoints import COLMAP_UP

COUNT = 120
"""Frames of a generated path: five seconds at 24 a second."""
USD = (".usd", ".usda", ".usdc", ".usdz")
EXPECTED = (
    "a COLMAP model's folder, a transforms.json, a nerfstudio camera_path.json, a cameras.json of a 3DGS training, a "
    "clsplat camera file (.json) or a USD stage"
)


def read_shot(
    path: Path,
    *,
    size: tuple[int | None, int | None] = (None, None),
    usd_camera: str | None = None,
    lenses: Lenses = "undistort",
) -> Shot:
    """The frames of any camera file, found out from what is in it; docs/cameras.md describes each.

    size: the width and height that will be asked for, for formats that have none of their own (USD; transforms.json
    without its pictures). usd_camera: which camera of a USD stage. lenses: of photographs, as of `load_scene`. Raises
    InputError, naming the file, for one that is missing, of no known kind, damaged or without frames.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such folder or file, expected {EXPECTED}")
    is_usd = path.suffix.lower() in USD
    if usd_camera is not None and not is_usd:
        raise InputError(f"--usd-camera {usd_camera}: {path} is no USD stage, expected it with one only")
    if path.is_dir():
        return _read_folder(path, size, lenses)
    if is_usd:
        return read_usd(path, size, usd_camera)
    if path.suffix.lower() == ".json":
        return _read_json(path, size, lenses)
    raise InputError(f"{path}: has the extension {path.suffix or 'none'!r}, expected {EXPECTED}")


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
) -> Shot:
    """The shot that --cameras, --path and --count ask for together.

    path: turntable, spiral or through: `count` frames of that path, made from the cameras; else the cameras themselves.
    applied: names of what the call applies of a stage beside, of which it is not warned. distort: the
    cameras are those of photographs as they were taken, their lenses with them. Raises InputError.
    """
    if count is not None and path is None:
        raise InputError(f"--count {count}: expected --path with it, the files of cameras have their own frames")
    _check_count(count)
    if distort and path is not None:
        raise InputError(f"--distort: is of the photographs' own cameras, expected it without --path {path}")
    if distort:
        shot = Shot(photographs(photographed(cameras, size)))
    else:
        shot = read_shot(cameras, size=size, usd_camera=usd_camera, lenses=lenses)
    if path is not None:
        if not (first := shot.frames[0].camera).kind.flat:
            raise InputError(
                f"{cameras}: its cameras are {first.projection}, --path needs perspective or orthographic ones"
            )
        shot = shot.without_optics()
        unapplied = (*shot.unapplied, *window_named(shot.window))
        near, told = _without_strays(shot.frames, cameras)
        shot = Shot(_path(path, near, count), (*shot.warnings, *told), unapplied=unapplied)
    if applied:
        shot = replace(shot, unapplied=tuple(text for text in shot.unapplied if text.partition(" (")[0] not in applied))
    return shot


def _without_strays(frames: Sequence[Frame], source: Path) -> tuple[list[Camera], tuple[str, ...]]:
    """The cameras of frames but for strays, and the warning that names these."""
    far = stray_cameras([frame.camera for frame in frames])
    near = [frame.camera for frame, stray in zip(frames, far, strict=True) if not stray]
    if not far.any():
        return near, ()
    names = examples(frame.name for frame, stray in zip(frames, far, strict=True) if stray)
    text = f"{source}: the cameras of {names} stand over {FACTOR:g} times as far off as the others"
    return near, (f"{text}, and the path is made of the others",)


def photographed(path: Path, size: tuple[int | None, int | None] = (None, None)) -> list[PosedImage]:
    """The photographs' own cameras, with their lenses, of a COLMAP model or a transforms.json. Raises InputError for
    another source of cameras, for panoramas, which no pinhole shows, and as `read_shot`."""
    images: list[PosedImage] | None = None
    if path.is_dir():
        listed = sorted(file.name for file in path.glob("transforms*.json"))
        model = find_model(path)
        if model is not None and not (listed and "colmap" in model.relative_to(path).parts):
            images = colmap.read_images(path)
        elif listed == ["transforms.json"]:
            images = transforms.read_images(path / listed[0], _both(size))
    elif path.suffix.lower() == ".json" and "frames" in _parsed(path):
        images = transforms.read_images(path, _both(size))
    if images is None:
        raise InputError(f"{path}: has no lenses of photographs, expected a COLMAP model's folder or a transforms.json")
    if wrong := [image.name for image in images if image.lens.model == PANORAMA]:
        raise InputError(f"{path}: {examples(wrong)} are panoramas, which no straight picture is bent to")
    cameras_of(images)  # warns of those that cannot be right
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
) -> Shot:
    """The shot that --path, --count and --up ask for without --cameras: among the photographs' own cameras where these
    are known and no direction is given that is up, else around the model, as `cameras_around`. Raises InputError."""
    among_own = bool(own) and up is None
    path = check_around(path, among_own=among_own)
    _check_count(count)
    if among_own:
        return Shot(_path(path, among(own, size), count))
    found = cameras_around(gaussians, COLMAP_UP if up is None else parse_up(up), size)
    return Shot(_path(path, found, count))


def check_around(path: str | None, *, among_own: bool = False) -> str:
    """The path, which goes around a model, or among the photographs' own cameras. Raises InputError for one that needs
    cameras, and for none."""
    if path is None:
        raise InputError(
            "--cameras is missing, expected cameras to render from; or --path turntable or spiral alone, for a path "
            "around the model"
        )
    if path == "through" and not among_own:
        raise InputError("--path through: goes through cameras, expected --cameras with it")
    return path


def _check_count(count: int | None) -> None:
    if count is not None and not 1 <= count <= MOST_FRAMES:
        raise InputError(f"--count {count}: expected 1 to {MOST_FRAMES:,} frames")


def _path(path: str, cameras: Sequence[Camera], count: int | None) -> tuple[Frame, ...]:
    return numbered(PATHS[path](cameras, COUNT if count is None else count))


def _read_folder(path: Path, size: tuple[int | None, int | None], lenses: Lenses) -> Shot:
    listed = sorted(file.name for file in path.glob("transforms*.json"))
    if listed:
        # a model below colmap/ beside a transforms.json is nerfstudio's, in a world that is not the file's
        model = find_model(path)
        if model is None or "colmap" in model.relative_to(path).parts:
            if listed != ["transforms.json"]:
                raise InputError(f"{path}: holds {examples(listed)}, expected one of them to be named by --cameras")
            return _read_json(path / listed[0], size, lenses)
    if is_file(path / NAME) and find_model(path) is None:
        return _read_json(path / NAME, size, lenses)
    cameras = read_cameras(path, lenses)
    if not cameras:
        raise InputError(f"{path}: has no images, expected at least one")
    return Shot(named(cameras))


def _read_json(path: Path, size: tuple[int | None, int | None], lenses: Lenses) -> Shot:
    document = _parsed(path)
    if isinstance(document, list):
        return read_cameras_json(path, document, size)
    if VERSION_KEY in document:
        return read_keyed(path, document)
    if "camera_path" in document or "keyframes" in document:
        return read_camera_path(path, document)
    if "frames" not in document:
        raise InputError(
            f"{path}: has neither '{VERSION_KEY}' (a clsplat camera file) nor 'camera_path' (nerfstudio's) nor "
            "'frames' (a transforms.json), expected one of them"
        )
    return Shot(named(read_poses(path, _both(size), lenses)))


def _parsed(path: Path) -> dict[str, Any] | list[Any]:
    """The JSON object or list in a file. Raises InputError."""
    try:
        document = parse_json(read_document(path, "a file of cameras"), once=True)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}; expected a file of cameras") from None
    if not isinstance(document, dict | list):
        keys = f"'frames', 'camera_path' or '{VERSION_KEY}'"
        raise InputError(f"{path}: holds no JSON object, expected one with {keys}, or a list of cameras")
    return document
