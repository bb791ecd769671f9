# SPDX-License-Identifier: Apache-2.0
"""Writing of the demo's town as a COLMAP scene: photographs, masks, cameras, and points with tracks."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.demo.ray_caster import write_jpeg
from clsplat.demo.town.blocks import block_generator, city_block
from clsplat.demo.town.colmap_model import (
    UNKNOWN_POINT,
    ModelImage,
    ModelPoints,
    write_cameras,
    write_images,
    write_points,
)
from clsplat.demo.town.flights import TownPhotograph, lenses, photographs
from clsplat.demo.town.photography import Observations, take
from clsplat.demo.town.settings import TownConfig
from clsplat.demo.town.textures import textures
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write, move_into_place, work_folder
from clsplat.files.documents import is_file
from clsplat.files.locks import abandoned
from clsplat.images.writing import write_image
from clsplat.progress import CountedFraction, Progress, no_progress
from clsplat.scenes.dataset import Lens

TOWN_RECORD_FILE = "town.json"
"""File in a town's folder with the town's settings and counts. A folder with this file may be replaced."""
EXACT_POSES_FOLDER = "exact"
"""Folder with the exact cameras as a COLMAP model without points. It is written if `TownConfig.pose_noise` is not 0."""
MAX_TOWN_WORKERS = 8
"""Largest default number of threads. More threads would wait for the interpreter lock, and take more memory."""
MIN_TRACK_LENGTH = 2
"""Smallest number of photographs that must show a point for the COLMAP model to contain it."""


def write_town(
    output: Path,
    config: TownConfig,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write a town to the folder `output`. Returns its record, as in TOWN_RECORD_FILE.

    The folder has `images/`, `sparse/0/`, and `masks/` if there are moving cars. It is created when all files are
    complete. Equal settings give equal bytes, and a larger town includes the photographs of a smaller one.

    overwrite: replace an earlier town.
    workers: number of threads, which changes no bytes; None for one per core, up to MAX_TOWN_WORKERS.
    progress: function that is called with a text and the completed fraction.
    Raises InputError for invalid settings and for a folder that must not be replaced, and ClsplatError if a file
    cannot be written. After KeyboardInterrupt no files remain. Files of a killed call are removed by the next call.
    """
    config.check()
    check_folder(output, overwrite=overwrite)
    for left in abandoned([output]):
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
    try:
        with work_folder(output) as work:
            result = work / "result"
            result.mkdir()
            planned = [
                shot for j in range(config.rows) for i in range(config.columns) for shot in photographs(config, i, j)
            ]
            planned.sort(key=lambda shot: shot.name)
            seen = _take_all(result, config, planned, workers or min(os.cpu_count() or 1, MAX_TOWN_WORKERS), progress)
            points = _write_model(result, config, planned, seen)
            record = {"town": config.record(), "photographs": len(planned), "points": points}
            atomic_write(result / TOWN_RECORD_FILE, (json.dumps(record, indent=2) + "\n").encode())
            check_folder(output, overwrite=overwrite)  # another process may have created the folder
            move_into_place((result, output))
    except KeyboardInterrupt as error:
        error.args = ("before the town was complete: no file of it is left, and the same command starts anew",)
        raise
    return record


def check_folder(output: Path, *, overwrite: bool) -> None:
    """Raise InputError unless `output` is missing, an empty folder, or a town that `overwrite` allows to replace."""
    if not (output.exists() or output.is_symlink()):
        return
    if not output.is_dir():
        raise InputError(f"{output}: is a file, expected a folder for the town or a new name")
    if not any(output.iterdir()):
        return
    if not is_file(output / TOWN_RECORD_FILE):
        raise InputError(f"{output}: is neither empty nor a town of clsplat demo, expected a new or an empty folder")
    if not overwrite:
        raise InputError(f"{output}: exists already; name another folder, or give --overwrite to replace it")


def _take_all(
    result: Path, config: TownConfig, planned: Sequence[TownPhotograph], workers: int, progress: Progress
) -> list[Observations]:
    """Ray-cast and write all photographs. Returns the points that each photograph shows.

    result: folder of the town while it is written. workers: number of threads.
    """
    for i, j in sorted({(shot.i, shot.j) for shot in planned}):
        for folder in ("images", "masks") if config.cars else ("images",):
            (result / folder / f"{i:04d}_{j:04d}").mkdir(parents=True)
    progress("painting the town", 0.0)
    textures(config.seed)
    seen: list[Observations] = []
    # Threads run in parallel, because NumPy releases the interpreter lock.
    pool = ThreadPoolExecutor(workers, "clsplat-town")
    try:
        for done, observations in enumerate(pool.map(partial(_take_and_write, result, config), planned), 1):
            seen.append(observations)
            os.utime(result.parent)  # a recent time shows other machines that the folder is in use
            progress("taking photographs", CountedFraction(done, len(planned), "taken"))
    finally:
        pool.shutdown(cancel_futures=True)
    return seen


def _take_and_write(result: Path, config: TownConfig, shot: TownPhotograph) -> Observations:
    taken = take(config, shot)
    write_jpeg(result / "images" / shot.name, taken.pixels)
    if taken.mask is not None:
        write_image(result / "masks" / f"{shot.name}.png", taken.mask.astype(np.uint8) * 255)
    return taken.seen


def _write_model(
    result: Path, config: TownConfig, planned: Sequence[TownPhotograph], seen: Sequence[Observations]
) -> int:
    """Write the COLMAP model: cameras, images and points. Returns the number of points.

    result: folder of the town while it is written.
    planned, seen: the photographs, and the points that each of them shows.
    """
    sparse = result / "sparse" / "0"
    sparse.mkdir(parents=True)
    points, of_image = _tracks(config, seen)
    air, street = lenses(config)
    write_cameras(sparse / "cameras.bin", [air, street])
    noisy = [_image(config, shot, air, _noise(config, shot)) for shot in planned]
    for image, observations, numbers in zip(noisy, seen, of_image, strict=True):
        image.pixels, image.points = observations.pixels, numbers
    write_images(sparse / "images.bin", len(noisy), noisy)
    write_points(sparse / "points3D.bin", points)
    if config.pose_noise:
        exact = result / EXACT_POSES_FOLDER
        exact.mkdir()
        write_cameras(exact / "cameras.bin", [air, street])
        write_images(exact / "images.bin", len(planned), (_image(config, shot, air, np.zeros(3)) for shot in planned))
    return len(points.places)


def _noise(config: TownConfig, shot: TownPhotograph) -> Float64:
    """Draw the random error (3,), in metres, that the written position of a photograph's camera gets."""
    return block_generator(config.seed, 6, shot.i, shot.j, shot.index).normal(0, 1, 3) * config.pose_noise


def _image(config: TownConfig, shot: TownPhotograph, air: Lens, error: Float64) -> ModelImage:
    """Return a photograph's entry in the COLMAP model, without observations.

    air: lens of the photographs from the air, which is camera 1 of the model.
    error: (3,), metres to add to the camera's position.
    """
    rotation = shot.camera.rotation
    position = shot.camera.position + np.array(config.origin) + error
    none = np.zeros((0, 2)), np.zeros(0, np.uint64)
    return ModelImage(shot.name, 1 if shot.lens == air else 2, rotation, -rotation @ position, *none)


def _tracks(config: TownConfig, seen: Sequence[Observations]) -> tuple[ModelPoints, list[NDArray[np.uint64]]]:
    """Collect the observations of all photographs into points with tracks.

    Returns the points of the COLMAP model, and for each photograph the point numbers (k,) of its observations.
    """
    lengths = np.array([len(each.points) for each in seen])
    rows = np.concatenate([np.column_stack([each.blocks, each.points]) for each in seen])
    known, inverse, counts = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    inverse, kept = inverse.ravel(), counts >= MIN_TRACK_LENGTH
    sums = np.stack(
        [
            np.bincount(inverse, np.concatenate([each.colours[:, channel] for each in seen]), len(known))
            for channel in range(3)
        ],
        axis=1,
    )
    order = np.argsort(inverse, kind="stable")
    order = order[kept[inverse[order]]]
    image = np.repeat(np.arange(1, len(seen) + 1), lengths)
    observation = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    points = ModelPoints(
        _places(config, known[kept]),
        np.rint(sums[kept] / counts[kept, None]).astype(np.uint8),
        np.concatenate([[0], np.cumsum(counts[kept])]),
        image[order],
        observation[order],
    )
    numbers = np.where(kept, np.cumsum(kept), 0).astype(np.uint64)
    of_all = np.where(kept[inverse], numbers[inverse], UNKNOWN_POINT)
    return points, np.split(of_all, np.cumsum(lengths)[:-1])


def _places(config: TownConfig, points: NDArray[np.int32]) -> Float64:
    """Return the world coordinates (n, 3) of points.

    points: (n, 3), the two indices of a point's block and the point's index in the block, sorted by block.
    """
    places = np.empty((len(points), 3))
    steps = np.flatnonzero((points[1:, :2] != points[:-1, :2]).any(axis=1)) + 1
    for rows in np.split(np.arange(len(points)), steps):
        if len(rows):
            block = city_block(config.seed, int(points[rows[0], 0]), int(points[rows[0], 1]))
            places[rows] = block.points[points[rows, 2]] + block.corner
    return np.asarray(places + config.origin)
