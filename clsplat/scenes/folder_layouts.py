# SPDX-License-Identifier: Apache-2.0
"""Detection of a data set's layout (COLMAP, Blender, nerfstudio, surveys, photos), and reading of its images and their
split."""

from __future__ import annotations

import codecs
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from clsplat.config.training import Missing
from clsplat.errors import InputError, examples, warn
from clsplat.files.documents import is_file, open_input
from clsplat.images.reading import companions, find_images
from clsplat.scenes.dataset import DataSet, PosedImage
from clsplat.scenes.photo_files import (
    DOWNSCALED_FOLDER_FACTORS,
    by_label,
    called,
    find_pictures,
    has_pictures,
    or_smaller,
)
from clsplat.scenes.photo_names import legible, match
from clsplat.scenes.point_files import clouds_beside
from clsplat.scenes.readers import colmap, transforms
from clsplat.scenes.readers.scene_place import georeferenced
from clsplat.scenes.readers.surveys.formats import SURVEY_FILES, check_names, survey_of
from clsplat.scenes.sfm.video_frames import find_videos
from clsplat.scenes.sidecar_files import inside
from clsplat.scenes.video.reading import is_video_name

Kind = Literal["colmap", "blender", "transforms", "survey", "photos"]

COLMAP_IMAGE_FOLDER = "images"
"""Name of the picture folder of a COLMAP model."""
OTHER_IMAGE_FOLDERS = ("input", "inputs", "image", "img", "imgs", "rgb", "color", "frames", "photos", "pictures")
"""Names of the picture folder in other programs' data sets, in order of precedence. 3DGS' convert.py reads input/."""
MODEL_FOLDERS = ("sparse", "colmap", "distorted")
"""Names of folders that hold a COLMAP model without pictures. Users may give such a folder instead of the scene's."""
HELD_OUT_LIST_FILE = "test.txt"
"""File with the names of the held-out pictures, one per line.

It lies next to a COLMAP model (3DGS authors' code, hierarchical-3d-gaussians) or a transforms.json (LichtFeld).
"""
MAX_HELD_OUT_LIST_BYTES = 64 << 20
"""Maximum size of HELD_OUT_LIST_FILE in bytes."""


def detect(path: Path) -> Kind:
    """Return the layout of a scene's folder, camera file or video. Raises InputError if no layout fits.

    A video, and a folder with photographs, videos or both, has the layout "photos".
    """
    path = Path(path)
    if path.is_file():
        if is_video_name(path):
            return "photos"
        if survey_of(path) is not None:
            return "survey"
        if path.suffix.lower() != ".json":
            raise InputError(
                f"{path}: is a file, expected a scene's folder, a transforms.json, {SURVEY_FILES} or a video"
            )
        return "blender" if path.name == "transforms_train.json" else "transforms"
    if not path.is_dir():
        raise InputError(f"{path}: no such folder, expected a scene")
    if (path / "transforms_train.json").is_file():
        return "blender"
    model = colmap.find_model(path)
    # nerfstudio makes transforms.json from a model in colmap/, whose pictures may be larger than those of
    # transforms.json. So transforms.json is preferred.
    if model is not None and not (model.is_relative_to(path / "colmap") and (path / "transforms.json").is_file()):
        return "colmap"
    if (path / "transforms.json").is_file():
        return "transforms"
    if survey_of(path) is not None:
        return "survey"
    if find_images(path) or find_videos(path)[0]:
        return "photos"
    raise InputError(
        f"{path}: no images found, nor sparse/, transforms_train.json or transforms.json, nor cameras of a survey; "
        f"expected a COLMAP, Blender, nerfstudio or instant-ngp scene, {SURVEY_FILES}, or a folder of photos or videos"
    )


def read_colmap(path: Path, chosen: str | Path | None, missing: Missing) -> tuple[DataSet, list[Path]]:
    """Read a COLMAP model and find its pictures. Returns the data set, and folders with downscaled copies of pictures.

    chosen: folder with the pictures, relative to `path`; None searches for it.
    missing: how many pictures may be missing, as for `find_pictures`.
    Raises InputError if the model, its pictures or its georeference.json cannot be read.
    """
    model_path = colmap.find_model(path)
    assert model_path is not None  # `detect` has checked this
    model = colmap.read_model(model_path)
    folder = _picture_folder(path, chosen, model_path, model.images)
    _add_pictures(model, folder, model_path, missing)
    model.images = _held_out(model, model_path / HELD_OUT_LIST_FILE)
    model.clouds = clouds_beside([model_path, path])
    smaller = (
        []
        if chosen is not None
        else [folder.with_name(f"{folder.name}_{factor}") for factor in DOWNSCALED_FOLDER_FACTORS]
    )
    model = georeferenced(model, path, [model_path, path])
    return model, [candidate for candidate in smaller if candidate.is_dir()]


def read_survey(path: Path, chosen: str | Path | None, missing: Missing) -> DataSet:
    """Read the cameras of a survey (`readers.surveys.formats`) and find its pictures.

    chosen, missing: as for `read_colmap`.
    Raises InputError if the cameras or their pictures cannot be read, and for positions in degrees.
    """
    found = survey_of(path)
    assert found is not None  # `detect` has checked this
    cameras, top = found.cameras, found.top
    if chosen is not None and not (top / chosen).is_dir():
        raise InputError(f"{top / chosen}: no such folder, expected the photographs of {cameras}")
    data = found.read(None if chosen is None else top / chosen)
    beside = found.format.is_folder and chosen is None
    folder = top if beside else _picture_folder(top, chosen, cameras, data.images)
    _add_pictures(data, folder, cameras, missing, labels=True)
    check_names(cameras, data.images)  # IMG.xmp and IMG.jpg.xmp are cameras of one photograph
    data.images = _held_out(data, top / HELD_OUT_LIST_FILE)
    data.clouds = clouds_beside([cameras if found.format.is_folder else cameras.parent, top])
    return data


def _add_pictures(data: DataSet, folder: Path, listed_in: Path, missing: Missing, *, labels: bool = False) -> None:
    """Set the path of each image, and leave out images without a picture. Warns of pictures that are not listed.

    folder: the folder with the pictures.
    listed_in: the file or folder with the cameras, for messages.
    missing: how many pictures may be missing, as for `find_pictures`.
    labels: True if names may lack the extension, as Metashape's labels do. Then a file with any extension is taken
        without a warning.
    """
    present = find_images(folder)
    if not present:
        raise InputError(f"{folder}: no images found, expected the {len(data.images)} images of {listed_in}")
    listed = [image.name for image in data.images]
    labelled = by_label(folder, present) if labels else {}
    exact = [labelled.get(name, folder / name) for name in listed]
    files = find_pictures(listed, exact, folder, listed_in, missing, present)
    names = [called(name, folder / name, file, folder) for name, file in zip(listed, files, strict=True)]
    posed = zip(data.images, names, files, strict=True)
    data.images = [
        replace(image, name=name, path=file, listed=legible(image.name))
        for image, name, file in posed
        if file is not None
    ]
    data.missing = [legible(name) for name, file in zip(listed, files, strict=True) if file is None]
    _warn_of_unlisted(present, data, listed_in, folder)


def read_transforms(path: Path, kind: Kind, chosen: str | Path | None, missing: Missing, *, masks: bool) -> DataSet:
    """Read the data set of one transforms.json, or of Blender's two files for training and test.

    kind: "transforms" or "blender".
    chosen: folder with the pictures, relative to `path`; None to use the paths in the file.
    missing: how many pictures may be missing, as for `find_pictures`.
    masks: True if masks are used.
    Raises InputError if a file or its pictures cannot be read.
    """
    folder = path.parent if path.is_file() else path
    images = None if chosen is None else folder / chosen
    if images is not None and not images.is_dir():
        raise InputError(f"{images}: no such folder, expected the images of {path}")
    if kind == "blender":
        listed_in = folder / "transforms_*.json"
        data = transforms.read_blender(folder, images=images, missing=missing)
    else:
        listed_in = path if path.is_file() else folder / "transforms.json"
        data = transforms.read_transforms(listed_in, masks=masks, images=images, missing=missing)
    if not any(image.split for image in data.images):
        data.images = _held_out(data, folder / HELD_OUT_LIST_FILE)
    parents = {image.path.parent for image in data.images}
    present = [file for parent in parents for file in find_images(parent, deep=False)]
    _warn_of_unlisted(present, data, listed_in, folder)
    return data


def _picture_folder(path: Path, chosen: str | Path | None, model_path: Path, images: Sequence[PosedImage]) -> Path:
    """Find the folder with the pictures of a COLMAP model.

    This is images/ if it has pictures. Otherwise a downscaled copy such as images_2, folders named in
    OTHER_IMAGE_FOLDERS, and the scene's folder are searched in this order. The first folder with a picture that the
    model lists is used, else the first folder with any pictures. Warns if the folder is not images/.

    chosen: folder with the pictures, relative to `path`; None to search.
    Returns an empty images/ if no folder has pictures. Raises InputError if there is no images/ either.
    """
    if chosen is not None:
        if not (folder := path / chosen).is_dir():
            raise InputError(f"{folder}: no such folder, expected the images of {model_path}")
        return folder
    # If the model's own folder or sparse/ was given, the folder of pictures is in one of the folders above it.
    above = [path, *path.resolve().parents[:2]] if model_path == path or path.name in MODEL_FOLDERS else [path]
    usual = [inside(parent, (COLMAP_IMAGE_FOLDER,)) or parent / COLMAP_IMAGE_FOLDER for parent in above]
    if own := next((folder for folder in usual if has_pictures(folder)), None):
        return own
    copies = [copy for folder in usual if (copy := or_smaller(folder)) != folder]
    named = [inside(parent, (name,)) for parent in above for name in OTHER_IMAGE_FOLDERS]
    others = [folder for folder in named if folder is not None and has_pictures(folder)]
    bare = [parent for parent in above if find_images(parent, deep=False)]  # RealityScan has no sub-folder for pictures
    found = [*copies, *others, *bare]
    listed = [folder for folder in found if any(is_file(folder / image.name) for image in images)]
    if listed or found:
        folder = (listed or found)[0]
        warn(f"{model_path}: the pictures are read from {folder}, as there are none in {usual[0]}")
        return folder
    if not (empty := [folder for folder in usual if folder.is_dir()]):
        raise InputError(f"{usual[0]}: no such folder, expected the {len(images)} images of {model_path}")
    return empty[0]


def _warn_of_unlisted(present: Iterable[Path], data: DataSet, listed_in: Path, folder: Path) -> None:
    listed = {image.path for image in data.images}
    unlisted = sorted(path for path in present if path not in listed)
    pictures = {*listed, *(folder / name for name in data.missing)}
    known = companions(unlisted, pictures, folder) if unlisted else set()
    if unlisted := [path for path in unlisted if path not in known]:
        warn(
            f"{listed_in}: does not list {len(unlisted):,} image(s) of its folder, which are not used: "
            f"{examples(unlisted)}"
        )


def _held_out(data: DataSet, path: Path) -> list[PosedImage]:
    """Return the images, split by the list of held-out names in the file `path`; unchanged if there is no such file.

    Names are matched to pictures by `photo_names.match`. Warns of names that match no picture. Raises InputError if
    no training picture is left.
    """
    path = next((each for each in path.parent.iterdir() if each.name.lower() == path.name), path)
    if not is_file(path):
        return data.images
    lines = [line.strip("\ufeff \t").strip("\"',").strip() for line in _text(path).splitlines()]
    names = list(dict.fromkeys(line for line in lines if line and not line.startswith("#")))
    found = match(names, [*(image.name for image in data.images), *data.missing])
    if lost := [legible(name) for name in names if name not in found.names]:
        none = "; the list is not used" if not found.names else "; these lines are ignored"
        warn(f"{path}: lists {examples(lost)} to hold out, but no picture has such a name{none}")
    held_out = set(found.names.values())
    if not held_out:
        return data.images
    if held_out <= set(data.missing):
        warn(f"{path}: all pictures that it holds out are missing; held-out quality will not be measured")
    images = [replace(image, split="test" if image.name in held_out else "train") for image in data.images]
    if all(image.split == "test" for image in images):
        raise InputError(
            f"{path}: holds out all {len(images)} pictures, expected some to train on; remove it to split with "
            "--test-every"
        )
    return images


def _text(path: Path) -> str:
    """Decode a text file in UTF-8 or UTF-16. Bytes of another encoding become surrogates, for `photo_names.match`."""
    with open_input(path, "a list of pictures") as file:
        raw = file.read(MAX_HELD_OUT_LIST_BYTES + 1)
    if len(raw) > MAX_HELD_OUT_LIST_BYTES:
        raise InputError(f"{path}: has more than {MAX_HELD_OUT_LIST_BYTES} bytes, expected a list of pictures")
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return raw.decode("utf-16", "replace")
    return raw.decode("utf-8-sig", "surrogateescape")
