# SPDX-License-Identifier: Apache-2.0
"""antimatter15's .splat: 32 bytes a Gaussian, little-endian, no header.

https://github.com/antimatter15/splat (convert.py and main.js). A record:

- position: 3 float32, in the axes of the 3DGS PLY.
- scale: 3 float32, standard deviations, not logs.
- red, green, blue, opacity: 4 bytes. The colour is that of SH coefficient 0, clamped to [0, 1]. Higher coefficients are
  not stored.
- quaternion: w x y z in 4 bytes, 128 (q + 1) for each component q of the unit quaternion.

A written file keeps the model's order; other writers sort by size and opacity.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.files.atomic import atomic_writer
from clsplat.files.documents import open_input
from clsplat.gaussians import Gaussians
from clsplat.models.codec import values
from clsplat.models.codec.values import IO_BLOCK_ROWS

UNIT_QUATERNION_TOLERANCE = 0.1
"""Largest excess of a quaternion's length over 1. Rounding to bytes makes unit quaternions at most 0.02 longer."""

SPLAT_RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quaternions", "u1", 4)])


def read(path: Path) -> Gaussians:
    """Read a .splat file.

    Raises InputError for an empty file, a partial record, or negative scales of a few Gaussians
    (`values.all_to_log_scales`).
    """
    with open_input(path, "a .splat file") as file:
        size = os.fstat(file.fileno()).st_size
        count, over = divmod(size, SPLAT_RECORD.itemsize)
        if over or not count:
            raise InputError(f"{path}: has {size} bytes, expected {SPLAT_RECORD.itemsize} for each of its Gaussians")
        _check_first(values.read_rows(file, SPLAT_RECORD, min(IO_BLOCK_ROWS, count), path), path)
        file.seek(0)
        result = values.empty(count, 0)
        for rows in values.row_blocks(count):
            block = values.read_rows(file, SPLAT_RECORD, rows.stop - rows.start, path)
            result.means[rows] = block["means"]
            result.log_scales[rows] = block["scales"]
            result.sh[rows, 0] = values.coefficients(block["rgba"][:, :3] / 255)
            result.opacity_logits[rows] = values.byte_logits()[block["rgba"][:, 3]]
            result.quaternions[rows] = block["quaternions"].astype(np.float32) / 128 - 1
    values.to_log_scales(result, path)
    return result


def _check_first(block: Any, path: Path) -> None:
    """Raise InputError if most of a file's first records, `block`, have an invalid rotation.

    The format has no header to check.
    """
    lengths = np.linalg.norm(block["quaternions"].astype(np.float32) / 128 - 1, axis=1)
    if np.median(lengths) > 1 + UNIT_QUATERNION_TOLERANCE:
        raise InputError(f"{path}: not a .splat file (rotations of length {np.median(lengths):.2f}, expected 1)")


def write(path: Path, gaussians: Gaussians) -> None:
    """Write a .splat file atomically."""
    values.check_writable(path, gaussians)
    with atomic_writer(path, SPLAT_RECORD.itemsize * len(gaussians)) as file:
        for rows in values.row_blocks(len(gaussians)):
            block: Any = np.empty(rows.stop - rows.start, SPLAT_RECORD)
            block["means"] = values.world_means(gaussians, rows)
            with np.errstate(over="ignore"):  # scales too large for float32 are clamped
                scales = np.exp(gaussians.log_scales[rows].astype(np.float64))
            block["scales"] = np.minimum(scales, np.finfo(np.float32).max)
            block["rgba"][:, :3] = values.to_bytes(values.colours(gaussians.sh[rows, 0]))
            block["rgba"][:, 3] = values.to_bytes(values.opacities(gaussians.opacity_logits[rows]))
            unit = values.unit_quaternions(gaussians.quaternions[rows])
            block["quaternions"] = np.clip(np.rint(unit * 128 + 128), 0, 255)
            file.write(block.tobytes())
