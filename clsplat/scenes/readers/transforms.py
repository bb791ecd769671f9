# SPDX-License-Identifier: Apache-2.0
"""Reading of transforms.json of Blender synthetic (NeRF), nerfstudio and instant-ngp data sets.

Poses are `world_from_camera` with OpenGL's camera axes (x right, y up, z backward). They are converted to COLMAP's
camera axes; the world frame is the file's (docs/conventions.md, Scenes).
"""

from __future__ import annotations

import math
import os
import posixpath
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from clsplat.arrays import Float64, numbers
from clsplat.camera import Camera, model_with, names_of
from clsplat.config.training import Lenses, Missing
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file, load_document
from clsplat.images.reading import IMAGE_SUFFIXES, image_size
from clsplat.scenes.camera_checks import cameras_of
from clsplat.scenes.camera_json import EXPORT_AGAIN_ADVICE, Keys, objects, short
from clsplat.scenes.dataset import (
    MAX_COORDINATE,
    DataSet,
    Lens,
    PosedImage,
    check_lens,
    given_in_parts,
    in_pixels,
)
from clsplat.scenes.photo_files import FALLBACK_FOLDER_FACTORS, called, find_pictures, or_smaller
from clsplat.scenes.photo_names import DRIVE_PREFIX, match
from clsplat.scenes.point_files import clouds_beside, read_point_cloud

COLMAP_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""Rotation from OpenGL's camera axes to COLMAP's."""
NGP_SCALE, NGP_OFFSET = 0.33, 0.5
"""Default scale and offset of instant-ngp, whose positions are scale * p + offset for positions p of the file."""
LAST_ROW_TOLERANCE = 1e-6
"""Maximum deviation of a pose's last row from 0 0 0 1. Products of float32 matrices deviate by less."""
MAX_TRANSFORMS_BYTES = 512 << 20
"""Largest size of a transforms.json in bytes. A frame takes about 1 KB, and 3 KB of memory (MAX_PARSED_BYTES)."""
FOCAL_ANGLE_TOLERANCE = 0.02
"""Relative tolerance between a focal length and the angle of view in the same file.

Tools round angles, and some compute them before they refine the lens.
"""


def read_transforms(
    path: Path, *, masks: bool = False, images: Path | None = None, missing: Missing = "few"
) -> DataSet:
    """Read one transforms.json.

    docs/conventions.md (Scenes) lists the keys that are read, in the file or in each frame. `file_path` is relative to
    the file. nerfstudio's `ply_file_path`, `train_filenames`, `val_filenames` and `test_filenames` are honoured.
    Pictures are held out if `val_filenames` or `test_filenames` lists them, or if `train_filenames` is there and does
    not list them.

    masks: True if masks are used. If False, a warning says that the file's masks are ignored.
    images: another folder with the same pictures.
    missing: how many listed pictures may be missing, as for `find_pictures`.
    Warns of ignored keys and of contradictions. Raises InputError that names the file and the key for invalid JSON, for
    a key that is missing or has the wrong type, and for missing pictures.
    """
    document = _document(path)
    readers = _readers(path, document)
    files = _pictures(path, readers, images, missing)
    there = [(keys, file) for keys, file in zip(readers, files, strict=True) if file is not None]
    gone = [_plain(keys.text("file_path")) for keys, file in zip(readers, files, strict=True) if file is None]
    data = DataSet(_images(path, there, gone), missing=gone)
    if not masks and any("mask_path" in keys.frame for keys in readers):
        warn(f"{path}: 'mask_path' is not used without --masks; give --masks ignore or transparent to use it")
    data.box = _ngp_box(Keys(path, None, {}, document))
    data.clouds = clouds_beside([path.parent])
    cloud = document.get("ply_file_path")
    if isinstance(cloud, str) and cloud:
        _inside(path.parent, cloud, f"{path}: 'ply_file_path'")
        file = path.parent / cloud.replace("\\", "/")
        if not is_file(file) and (found := match([_plain(cloud)], _clouds_below(path.parent)).names):
            file = path.parent / found[_plain(cloud)]
        if is_file(file):
            data.points, data.colors = read_point_cloud(file)
            data.clouds = [other for other in data.clouds if not other.samefile(file)]
        else:
            instead = data.clouds[0].name if data.clouds else "random ones"
            warn(f"{path}: the points of its 'ply_file_path' are missing: {file}; using {instead}")
    return data


def _clouds_below(folder: Path) -> list[str]:
    """Return the paths of the PLY files in a folder and its direct sub-folders, relative to the folder."""
    files = [file for pattern in ("*", "*/*") for file in folder.glob(pattern) if file.suffix.lower() == ".ply"]
    return sorted(file.relative_to(folder).as_posix() for file in files)


def _pictures(path: Path, readers: list[Keys], images: Path | None, missing: Missing) -> list[Path | None]:
    """Find the picture of each frame; None for pictures that are left out.

    readers: the JSON values of each frame. images, missing: as for `read_transforms`.
    Warns and raises InputError like `find_pictures`. Also raises InputError for a name that leads out of the folder and
    matches no picture in the folder.
    """
    listed, folder = [_plain(keys.text("file_path")) for keys in readers], path.parent
    if images is not None:
        return find_pictures(listed, [None] * len(listed), images, path, missing)
    exact = [_find_file(keys) if is_inside(folder, keys.text("file_path")) else None for keys in readers]
    lost = [file for file in exact if file is not None and not is_file(file)]
    if lost and (copies := _smaller_folders(lost, folder)):
        for usual, copy in copies.items():
            warn(f"{path}: the pictures are read from {copy}, as there are none in {usual}")
        exact = [_moved(file, copies) for file in exact]
    try:
        return find_pictures(listed, exact, folder, path, missing)
    except InputError:
        for keys, file in zip(readers, exact, strict=True):
            if file is None:
                _inside(folder, keys.text("file_path"), keys.where)
        raise


def _smaller_folders(lost: list[Path], folder: Path) -> dict[Path, Path]:
    """Return downscaled copies of picture folders, such as images_2. The keys are the folders that they replace.

    A folder is replaced if it has no pictures, but a downscaled copy has pictures.

    lost: missing pictures, whose folders are considered.
    folder: folder of the transforms.json.
    """
    names = {parent for file in lost for parent in file.parents if folder in parent.parents}
    found = {name: or_smaller(name) for name in sorted(names)}
    return {name: copy for name, copy in found.items() if copy != name}


def _moved(file: Path | None, copies: Mapping[Path, Path]) -> Path | None:
    """Return the path of a picture in a downscaled copy of its folder; `file` itself if there is no copy.

    copies: maps folders to their downscaled copies. If several folders in a path have copies, the outermost is used.
    """
    usual = next((parent for parent in reversed(file.parents) if parent in copies), None) if file is not None else None
    return file if file is None or usual is None else copies[usual] / file.relative_to(usual)


def read_poses(path: Path, size: tuple[int, int] | None = None, lenses: Lenses = "undistort") -> dict[str, Camera]:
    """Read the cameras of a transforms.json, keyed by image name, in the order of the file.

    Pictures need not exist if the file has `w` and `h`. Otherwise a missing picture is assumed to have `size`, (width,
    height). Raises InputError like `read_transforms`. Warns of contradictory keys and of implausible lenses.
    """
    return cameras_of(read_images(path, size), lenses)


def read_images(path: Path, size: tuple[int, int] | None = None) -> list[PosedImage]:
    """Read the images of a transforms.json, in the order of the file. Pictures need not exist.

    size: (width, height) of missing pictures; needed if the file has no `w` and `h`.
    """
    readers = _readers(path, _document(path))
    with warnings.catch_warnings():  # no warnings of missing pictures: only names are needed
        warnings.simplefilter("ignore")
        try:
            files = _pictures(path, readers, None, "skip")
        except InputError:
            files = [None] * len(readers)
    return _images(path, [(keys, file or _within(keys)) for keys, file in zip(readers, files, strict=True)], size=size)


def _within(keys: Keys) -> Path:
    """Return the path of a picture that need not exist: the listed path, without ".." and drive if it leads out of the
    folder."""
    listed = keys.text("file_path")
    if not listed.isprintable():
        _inside(keys.path.parent, listed, keys.where)
    return _find_file(keys) if is_inside(keys.path.parent, listed) else keys.path.parent / _plain(listed)


def _document(path: Path) -> dict[str, Any]:
    return load_document(path, "a transforms.json", "'frames'", MAX_TRANSFORMS_BYTES)


def _readers(path: Path, document: dict[str, Any]) -> list[Keys]:
    if not (frames := objects(document, "frames")):
        raise InputError(f"{path}: has no 'frames' (a list of pictures with their poses); {EXPORT_AGAIN_ADVICE}")
    return [Keys(path, f"frame {index}", frame, document) for index, frame in enumerate(frames)]


def _images(
    path: Path, frames: list[tuple[Keys, Path]], missing: Sequence[str] = (), *, size: tuple[int, int] | None = None
) -> list[PosedImage]:
    """Return the images of a file's frames.

    frames: the JSON values and the picture file of each frame.
    missing: names of missing pictures, which the file's split may list.
    size: (width, height) of missing pictures; needed if the file has no `w` and `h`.
    Warns of contradictory keys.
    """
    images: dict[str, PosedImage] = {}
    in_parts = []
    for keys, file in frames:
        listed = _plain(keys.text("file_path"))
        exact = _find_file(keys)
        name = called(listed, None, file, path.parent)
        if exact == file or not file.is_relative_to(path.parent):
            name = listed + file.name[len(PurePosixPath(listed).name) :]  # with the file's extension
        lens, parts = _lens(keys, file, size)
        in_parts += [name] if parts else []
        rotation, translation, _ = opengl_pose(keys.frame.get("transform_matrix"), keys.where, "'transform_matrix'")
        if name in images:
            raise InputError(f"{path}: lists {name} twice, expected each picture once; remove one of its frames")
        mask, depth = (_file_of(keys, key) for key in ("mask_path", "depth_file_path"))
        images[name] = PosedImage(name, lens, rotation, translation, file, mask=mask, depth=depth, listed=listed)
    readers = [keys for keys, _ in frames]
    if in_parts:
        warn(f"{path}: {given_in_parts(in_parts)}")
    _warn_of_contradictions(path, readers, list(images.values()))
    return _split(path, readers, list(images.values()), missing)


def _split(path: Path, readers: list[Keys], images: list[PosedImage], missing: Sequence[str]) -> list[PosedImage]:
    """Return the images, split into training and test images by nerfstudio's keys; unchanged without such keys.

    The keys are `train_filenames`, `test_filenames` and `val_filenames`.

    missing: names of missing pictures, which the keys may list.
    """
    names = [*(image.name for image in images), *missing]
    known = dict(zip(names, names, strict=True))
    known |= {_plain(keys.text("file_path")): image.name for keys, image in zip(readers, images, strict=True)}
    listed = []
    for key in ("train_filenames", "test_filenames", "val_filenames"):
        given = readers[0].document.get(key) or []
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            raise InputError(f"{path}: '{key}' is {short(given)}, expected a list of file names; correct or remove it")
        found = {name: known[name] for name in map(_plain, given) if name in known}
        found |= match([name for name in map(_plain, given) if name not in known], names).names
        if lost := [name for name in given if _plain(name) not in found]:
            warn(f"{path}: '{key}' lists {examples(lost)}, but no frame has such a 'file_path'; these are ignored")
        listed.append(set(found.values()))
    train, held_out = listed[0], listed[1] | listed[2]
    if not (train or held_out):
        return images
    trained = (train or set(known.values())) - held_out
    if not trained:
        raise InputError(
            f"{path}: 'test_filenames' and 'val_filenames' hold out all {len(images)} pictures, expected some to train "
            "on; remove these keys to split with --test-every"
        )
    return [replace(image, split="train" if image.name in trained else "test") for image in images]


def _warn_of_contradictions(path: Path, readers: list[Keys], images: list[PosedImage]) -> None:
    for axis in "xy":
        focal, angle = f"fl_{axis}", f"camera_angle_{axis}"
        contradictions = []
        for keys, image in zip(readers, images, strict=True):
            used, other = keys.number(focal), keys.get(angle)
            # Compare only values from one place: both from the frame, or both from the file's top level.
            alike = (keys.frame.get(focal) is None) == (keys.frame.get(angle) is None)
            if used and alike and isinstance(other, int | float) and 0 < other < math.pi:
                size = image.lens.width if axis == "x" else image.lens.height
                meant = 0.5 * size / math.tan(0.5 * other)
                if abs(used / meant - 1) > FOCAL_ANGLE_TOLERANCE:
                    contradictions.append(f"{image.name} ({used:g}, not {meant:.4g})")
        if contradictions:
            warn(f"{path}: '{focal}' is used; it contradicts '{angle}' for {examples(contradictions)}")
    shutters = [keys.get("rolling_shutter") for keys in readers]
    if any(any(value) if isinstance(value, list) else value for value in shutters):
        warn(f"{path}: 'rolling_shutter' is ignored; all rows are assumed to be exposed at the same time")


def read_blender(folder: Path, *, images: Path | None = None, missing: Missing = "few") -> DataSet:
    """Read transforms_train.json and, if it exists, transforms_test.json, whose pictures are held out.

    transforms_val.json is not used.
    images: another folder with the same pictures.
    missing: how many listed pictures may be missing, as for `find_pictures`.
    Raises InputError like `read_transforms`.
    """
    train = read_transforms(folder / "transforms_train.json", images=images, missing=missing)
    held_out = folder / "transforms_test.json"
    if not held_out.is_file():
        return train
    test = read_transforms(held_out, images=images, missing=missing)
    names = {image.name for image in train.images}
    for image in test.images:
        if image.name in names:
            raise InputError(
                f"{held_out}: lists {image.name}, which is a training picture too; keep it in one file only"
            )
    both = [replace(image, split="train") for image in train.images]
    both += [replace(image, split="test") for image in test.images]
    return replace(train, images=both, missing=train.missing + test.missing)


def _plain(listed: str) -> str:
    """Return the name in a file_path, with forward slashes and without a leading "./", "../" or "C:/"."""
    text = DRIVE_PREFIX.sub("", posixpath.normpath(listed.replace("\\", "/")))
    return "/".join(part for part in text.split("/") if part not in ("", ".", ".."))


def _find_file(keys: Keys) -> Path:
    """Return the path of a frame's picture.

    If `file_path` lacks the extension, the first known one is added for which a file exists. If none exists, the path
    is returned as listed.
    """
    path = Path(os.path.normpath(keys.path.parent / keys.text("file_path").replace("\\", "/")))
    if is_file(path) or not path.name:
        return path
    for extension in (*IMAGE_SUFFIXES, *(extension.upper() for extension in IMAGE_SUFFIXES)):
        candidate = path.with_name(path.name + extension)
        if is_file(candidate):
            return candidate
    return path


def _file_of(keys: Keys, key: str) -> Path | None:
    """Return the path that a frame gives under `key`, for a mask or depth map; None if it lacks the key."""
    listed = keys.frame.get(key)
    if not isinstance(listed, str) or not listed:
        return None
    _inside(keys.path.parent, listed, f"{keys.where}: {key!r}")
    return Path(os.path.normpath(keys.path.parent / listed.replace("\\", "/")))


def is_inside(folder: Path, listed: str) -> bool:
    """Return True if a listed file name stays below the folder of the file that lists it."""
    root = folder.absolute()  # Links are not resolved: a link in the scene's folder may lead anywhere.
    path = Path(os.path.normpath(root / listed.replace("\\", "/")))
    return listed.isprintable() and path.is_relative_to(os.path.normpath(root))


def _inside(folder: Path, listed: str, where: str) -> None:
    """Raise InputError if a listed file name leads out of the folder of the file that lists it."""
    if not is_inside(folder, listed):
        raise InputError(
            f"{where}: {short(listed)} is not a path inside the scene's folder {folder}; move the file into that "
            "folder, or put a link there"
        )


def _lens(keys: Keys, file: Path, size: tuple[int, int] | None) -> tuple[Lens, bool]:
    """Return the lens of a frame, and True if it was given in fractions of the picture's size.

    size: (width, height) of missing pictures; needed if the frame has no `w` and `h`.
    """
    width, height = keys.number("w"), keys.number("h")
    if width is None or height is None:
        if not file.is_file():
            if size is None:
                raise InputError(
                    f"{keys.where}: has no 'w' and 'h', and its picture {file} does not exist; give both --width and "
                    "--height"
                )
            actual = size
        else:
            actual = _full_size(keys, file)
        if width is not None:  # compute the missing side from the picture's aspect ratio
            height = width * actual[1] / actual[0]
        elif height is not None:
            width = height * actual[0] / actual[1]
        else:
            width, height = actual
    assert height is not None
    named = model_with("transforms", keys.get("camera_model"))
    if named is not None and named.wraps:
        sides = round(width), round(height)
        return check_lens(Lens(named.lenses[0].name, *sides, tuple(map(float, sides))), keys.where), False
    fx = _focal(keys, "fl_x", "camera_angle_x", width)
    fy = _focal(keys, "fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        raise InputError(
            f"{keys.where}: has neither 'fl_x' nor 'camera_angle_x', expected the focal length in pixels or the "
            "horizontal angle of view in radians; add one of them to the file"
        )
    core = [
        fx if fx is not None else fy,
        fy if fy is not None else fx,
        keys.require("cx", width / 2),
        keys.require("cy", height / 2),
    ]
    model, extra = _distortion(keys)
    params = tuple(float(value) for value in (*core, *extra) if value is not None)
    return in_pixels(check_lens(Lens(model, round(width), round(height), params), keys.where))


def _full_size(keys: Keys, file: Path) -> tuple[int, int]:
    """Return the size of a frame's picture; for a picture in images_2 or the like, the size before downscaling."""
    width, height = image_size(file, orient=False)
    listed = PurePosixPath(_plain(keys.text("file_path"))).parts
    for part in file.parts:
        name, _, factor = part.rpartition("_")
        if name in listed and part not in listed and factor.isdecimal() and int(factor) in FALLBACK_FOLDER_FACTORS:
            return width * int(factor), height * int(factor)
    return width, height


def _focal(keys: Keys, focal: str, angle: str, size: float) -> float | None:
    if (value := keys.number(focal)) is not None:
        return value
    if (value := keys.number(angle)) is None:
        return None
    if not 0 < value < math.pi:
        raise keys.wrong(angle, "an angle between 0 and pi, in radians")
    return 0.5 * size / math.tan(0.5 * value)


def _distortion(keys: Keys) -> tuple[str, list[float]]:
    """Return COLMAP's name of a frame's camera model, and the distortion coefficients."""
    model = keys.get("camera_model") or ""
    k1, k2, k3, k4, k5, k6, p1, p2 = (
        keys.number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    )
    named = model_with("transforms", model)
    if (named is not None and not named.flat) or keys.get("is_fisheye") is True:
        if k5 or k6:
            raise InputError(
                f"{keys.where}: has 'k5' or 'k6' for a fisheye, expected k1 to k4 only; undistort the pictures first"
            )
        if p1 or p2:  # THIN_PRISM_FISHEYE has tangential terms; without them it equals OPENCV_FISHEYE
            return "THIN_PRISM_FISHEYE", [k1, k2, p1, p2, k3, k4, 0.0, 0.0]
        return "OPENCV_FISHEYE", [k1, k2, k3, k4]
    if named is None:
        listed = ", ".join(filter(None, names_of("transforms")))
        raise InputError(f"{keys.where}: unknown 'camera_model' {short(model)}, expected one of {listed}")
    if not any((k1, k2, k3, k4, k5, k6, p1, p2)):
        return "PINHOLE", []
    if k4 and model != "FULL_OPENCV":
        # k4 is ambiguous: in nerfstudio the coefficient of r^8, in OpenCV a coefficient of the denominator.
        raise InputError(
            f"{keys.where}: 'k4' is {k4} in a perspective camera, expected 0; undistort the pictures first"
        )
    if k3 or k4 or k5 or k6:
        return "FULL_OPENCV", [k1, k2, p1, p2, k3, k4, k5, k6]
    return "OPENCV", [k1, k2, p1, p2]


def opengl_pose(given: object, where: str, what: str) -> tuple[Float64, Float64, float]:
    """Convert a `world_from_cam` matrix (4, 4) or (3, 4) in OpenGL's axes.

    where, what: the file with the frame in it, and the matrix's key, for messages.
    Returns the rotation (3, 3) and translation (3,) of `cam_from_world`, without scale, and the scale of the matrix.
    Raises InputError for a matrix that is not a pose.
    """
    if given is None:
        raise InputError(f"{where}: has no {what} (the 4 x 4 pose); {EXPORT_AGAIN_ADVICE}")
    matrix = numbers(given)
    if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) < MAX_COORDINATE).all():
        raise InputError(f"{where}: {what} is {short(given)}, expected 3 x 4 or 4 x 4 finite numbers")
    # If the camera object was scaled, its scale is in the matrix. Poses have no scale.
    determinant = float(np.linalg.det(matrix[:3, :3]))
    scale = float(np.cbrt(determinant))
    axes = matrix[:3, :3] / scale if determinant > 0 else np.zeros((3, 3))
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-2:
        raise InputError(
            f"{where}: {what} contains no rotation (determinant {determinant:.3g}), expected "
            "world_from_camera in OpenGL's axes; check how it was exported"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > LAST_ROW_TOLERANCE:
        columns = not matrix[:3, 3].any() and abs(matrix[3, 3] - 1) <= LAST_ROW_TOLERANCE
        advice = "it is written column by column, so transpose it" if columns else "check how it was exported"
        raise InputError(
            f"{where}: {what} has the last row {short(matrix[3].tolist())}, expected 0 0 0 1, with the position in the "
            f"last column; {advice}"
        )
    u, _, v = np.linalg.svd(axes)
    cam_from_world: Float64 = (u @ v @ COLMAP_FROM_OPENGL).T
    return cam_from_world, -cam_from_world @ matrix[:3, 3], scale


def _ngp_box(keys: Keys) -> tuple[Float64, Float64] | None:
    side = keys.number("aabb_scale")
    if side is None or side <= 0:
        return None
    scale, offset = keys.get("scale"), keys.get("offset")
    try:
        shift = np.broadcast_to(np.array(NGP_OFFSET if offset is None else offset, np.float64), 3)
        factor = float(NGP_SCALE if scale is None else scale)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"{keys.where}: 'scale' is {short(scale)}, 'offset' is {short(offset)}, expected a number and three numbers"
        ) from None
    if not (1 / MAX_COORDINATE < factor < MAX_COORDINATE and (np.abs(shift) < MAX_COORDINATE).all()):
        raise InputError(f"{keys.where}: 'scale' is {factor}, 'offset' is {shift.tolist()}, expected a scale above 0")
    return (0.5 - side / 2 - shift) / factor, (0.5 + side / 2 - shift) / factor
