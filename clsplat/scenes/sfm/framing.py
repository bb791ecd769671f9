# SPDX-License-Identifier: Apache-2.0
"""Frame of a reconstruction: turns and scales the COLMAP model that structure from motion wrote, and records it."""

from __future__ import annotations

import shutil
from pathlib import Path

from clsplat.config.orientation import FrameUse, Orient
from clsplat.errors import InputError, warn
from clsplat.files.atomic import atomic_write, move_into_place, work_folder
from clsplat.files.documents import is_file
from clsplat.scenes.dataset import SceneFrame
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE, read_georeference
from clsplat.scenes.orientation.frame_record import FRAME_RECORD_FILE, read_frame
from clsplat.scenes.orientation.new_frame import new_frame
from clsplat.scenes.readers.colmap import read_model

MODEL_FOLDER = Path("sparse", "0")
"""Folder of the COLMAP model in a result of structure from motion."""


def turn_new(scene: Path, photos: Path, use: FrameUse, where: object) -> None:
    """Turn a new reconstruction upright, unless `use.orient` is "none". The scale is not set here.

    If no up direction can be found, the reconstruction keeps COLMAP's axes, with a warning instead of an error, so that
    the result is not lost. Arguments as for `set_frame`.
    """
    if use.orient == "none":
        return
    try:
        set_frame(scene, photos, FrameUse("up"), where)
    except InputError as error:
        warn(f"{error}; it is kept in COLMAP's frame")


def photograph_of(photos: Path, name: str) -> Path:
    """Return the photograph as it was taken, for its metadata. name: its name in the scene, such as IMG.heic.jpg."""
    taken = photos / name
    return taken if is_file(taken) else taken.with_suffix("") if is_file(taken.with_suffix("")) else taken


def scale_new(scene: Path, photos: Path, use: FrameUse) -> None:
    """Set the scale of a new, complete reconstruction, if `use` has one.

    Raises InputError if the scale cannot be found. The result then stays as it is, unscaled.
    """
    if not use.scale:
        return
    axes: Orient | None = None if use.orient == "none" else "up"
    try:
        set_frame(scene, photos, FrameUse(axes, use.scale), scene)
    except InputError as error:
        raise InputError(f"{error}; the cameras are recovered, give another --scale to the same command") from None


def set_frame(scene: Path, photos: Path, use: FrameUse, where: object) -> SceneFrame:
    """Change the frame of a reconstruction. Returns the new frame. If it equals the present frame, no file changes.

    The model's folder is replaced as a whole, so that cameras, points and frame.json always fit together.

    scene: folder of the result. photos: folder of the photographs as they were taken, for their metadata.
    where: the name of the scene for messages.
    Raises InputError and warns like `new_frame`.
    """
    folder = scene / MODEL_FOLDER
    if not use:
        return read_frame(folder)
    data = read_model(folder)
    files = {image.name: photograph_of(photos, image.name) for image in data.images}
    frame = new_frame(where, data, files, use, data.frame, turned=True)
    change = frame.change_from(data.frame)
    if change is None:
        return data.frame
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    model.transform(pycolmap.Sim3d(change[:3]))
    with work_folder(folder) as work:
        made = work / "result"
        shutil.copytree(folder, made, ignore=shutil.ignore_patterns(FRAME_RECORD_FILE))
        model.write(made)
        atomic_write(made / FRAME_RECORD_FILE, frame.content())
        if (place := read_georeference(folder / GEOREFERENCE_FILE)) is not None:
            atomic_write(made / GEOREFERENCE_FILE, place.moved(change).content())
        move_into_place((made, folder))
    return frame
