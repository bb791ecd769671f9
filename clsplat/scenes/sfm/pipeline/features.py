# SPDX-License-Identifier: Apache-2.0
"""SIFT features of photographs with pycolmap, and the cameras that the photographs share."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pycolmap

from clsplat.scenes.sfm.pipeline import database as sfm_database

MIN_OPENCV_PHOTOS = 20
"""Minimum number of photographs of one camera for fitting the eight parameters of OPENCV.

For a phone's distorted photographs, the reprojection error is 0.477 px with OPENCV and 0.493 px with SIMPLE_RADIAL.
"""
SAMPLED_PHOTOS, MIN_SAMPLED_FROM = 16, 64
"""Number of photographs whose features decide the size of the others in `extract_sift`, and the number of photographs
from which such a sample is taken."""
SIDE_STEP_PX = 4
"""Divisor of the sides of reduced photographs in pixels. VLFeat blurs four columns at a time if their number is a
multiple of four, otherwise one by one. It blurs the transposed picture too, so that the number of rows counts as
well."""
ALL_FEATURES = 1 << 20
"""Limit of the features of a photograph that no photograph reaches."""

Batch = tuple[list[str], pycolmap.CameraMode, pycolmap.ImageReaderOptions]
"""Names of photographs, the mode of their cameras, and options with their lens model."""


def camera_batches(groups: Sequence[list[str]], camera_model: str) -> list[Batch]:
    """Return the photographs' names in batches for pycolmap, with the mode and the lens model of their cameras.

    groups: names of the photographs of each camera.
    camera_model: COLMAP's name of the lens model, or "auto", as in `SfmSettings`.
    """
    singles = [names[0] for names in groups if len(names) == 1]
    batches = [(names, pycolmap.CameraMode.SINGLE) for names in groups if len(names) > 1]
    if singles:  # in one call, as only the photographs of one call are processed in parallel
        batches.append((singles, pycolmap.CameraMode.PER_IMAGE))
    found = []
    for names, mode in batches:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = camera_model
        if camera_model == "auto":
            shared = mode == pycolmap.CameraMode.SINGLE and len(names) >= MIN_OPENCV_PHOTOS
            reader.camera_model = "OPENCV" if shared else "SIMPLE_RADIAL"
        found.append((names, mode, reader))
    return found


def extract_sift(database: Path, task: dict[str, Any]) -> None:
    """Extract the SIFT features of every photograph into the database.

    Photographs with more features than are kept lose the smallest later. So if the median photograph of a sample has
    more, the features of the others are extracted from photographs reduced to `sufficient_size`, which takes less time.

    task: see `sfm.reconstruct.sfm_task`.
    """
    batches = camera_batches(task["groups"], task["camera_model"])
    sample = set(_spread([name for names, _, _ in batches for name in names], SAMPLED_PHOTOS))
    size = task["max_image_size"]
    if sample:
        sampled = [([name for name in names if name in sample], *rest) for names, *rest in batches]
        _extract(database, task, sampled, size, ALL_FEATURES)
        size = sufficient_size(sfm_database.feature_counts_and_sizes(database), task["max_features"], size)
    others = [([name for name in names if name not in sample], *rest) for names, *rest in batches]
    _extract(database, task, others, size, task["max_features"])


def sufficient_size(sample: Sequence[tuple[int, int, int]], most: int, largest: int) -> int:
    """Return the longer side in pixels to which photographs are reduced, so that about `most` features remain.

    The number of features of a photograph grows with its area, or more slowly. Photographs with the proportions of the
    median photograph get sides that are multiples of SIDE_STEP_PX.

    sample: for some photographs, the number of features, the width and the height in pixels.
    most: number of features of a photograph that are kept.
    largest: maximum of the result, which is also the longer side to which larger photographs of the sample were
        reduced.
    """
    features = statistics.median(count for count, _, _ in sample)
    if features <= most:
        return largest
    _, width, height = sorted(sample, key=lambda photo: max(photo[1:]))[len(sample) // 2]
    longer, shorter = max(width, height), min(width, height)
    size = math.floor(min(longer, largest) * math.sqrt(most / features))
    for side in range(size - size % SIDE_STEP_PX, size // 2, -SIDE_STEP_PX):
        if round(side * shorter / longer) % SIDE_STEP_PX == 0:
            return side
    return size


def _spread(names: Sequence[str], count: int) -> list[str]:
    """Return `count` of the names, evenly spread, or none of fewer than MIN_SAMPLED_FROM names."""
    if len(names) < MIN_SAMPLED_FROM:
        return []
    return [names[index * len(names) // count] for index in range(count)]


def _extract(database: Path, task: dict[str, Any], batches: Sequence[Batch], size: int, features: int) -> None:
    """Extract the SIFT features of the photographs in some batches into the database.

    size: longer side in pixels to which larger photographs are reduced.
    features: number of features of a photograph from which pycolmap leaves out its smaller scales.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = task["threads"]
    options.max_image_size = size
    options.sift.max_num_features = features
    for names, mode, reader in batches:
        if not names:
            continue
        if task["masks"]:
            reader.mask_path = Path(task["work"]) / "masks"
        pycolmap.extract_features(
            database_path=database,
            image_path=task["photos"],
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        if mode == pycolmap.CameraMode.SINGLE:  # more photographs of the batch may follow
            reader.existing_camera_id = sfm_database.camera_of(database, names[0])
