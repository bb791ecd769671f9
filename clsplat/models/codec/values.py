# SPDX-License-Identifier: Apache-2.0
"""Helpers of the model formats: conversion of values to bytes, reading of rows, Morton order, checks of contents.

Byte formats store colours as 0.5 + C0 times SH coefficient 0, and opacities from 0 to 1 (Kerbl et al. 2023).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.chunks.order import MORTON_BITS_PER_AXIS, every_third_bit
from clsplat.errors import InputError, warn
from clsplat.gaussians import Gaussians
from clsplat.spherical_harmonics import SH_C0

IO_BLOCK_ROWS = 1 << 15
"""Number of rows that are read or written at once. It is a multiple of the chunk size of the compressed PLY."""
MIN_SCALE = 2.0**-149
"""The smallest float32. It replaces a scale of 0, whose log would be infinite."""
LOG_SCALES_MIN_NEGATIVE_SHARE = 0.01
"""Least fraction of Gaussians with a negative scale at which all scales of a file count as logs.

Nearly all logs are negative if the unit is a metre. Linear scales are negative only in a few damaged Gaussians.
"""
MAX_UNCHECKED_GAUSSIANS = 1 << 20
"""Number of Gaussians up to which a compressed file may have any length. Above it a file needs a byte per Gaussian.

Every real file has more bytes, because the position of a Gaussian takes several. A decompression bomb has fewer.
"""
OTHER_QUATERNION_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Row i lists the indices of a quaternion's components other than component i."""
MAX_FLOAT_HIGHLIGHT = 2.0
"""Largest float colour up to which white is taken to be 1, unless all colours are whole numbers."""
UNIT_COLOUR_SHARE = 0.95
"""Fraction of a file's float colours. If at least this fraction is at most 1, then 1 is white, however bright the
other colours are."""
UNIT_RANGE_TOLERANCE = 1e-3
"""Largest tolerated excess of opacities over [0, 1], and of colours over white as a fraction of white. Averaging and
rounding to half floats cause it."""
GAUSSIAN_ARRAY_NOUNS = ("a position", "a rotation", "a scale", "an opacity", "a colour")
"""Nouns for the arrays of `Gaussians`, for messages."""


def empty(count: int, degree: int) -> Gaussians:
    """Uninitialised model of `count` Gaussians with SH coefficients up to `degree`."""
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3))
    arrays: list[Any] = [np.empty(shape, np.float32) for shape in shapes]
    return Gaussians(*arrays)


def row_blocks(count: int, most: int = IO_BLOCK_ROWS) -> Iterator[slice]:
    """Slices that divide the rows 0 to `count` into blocks of at most `most` rows."""
    return (slice(start, min(start + most, count)) for start in range(0, count, most))


def world_means(gaussians: Gaussians, rows: slice | NDArray[Any] = slice(None)) -> Float64:
    """Means (n, 3) in world coordinates, of all Gaussians or of the given rows."""
    return gaussians.means[rows] + gaussians.origin


def to_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert values in [0, 1] to bytes 0 to 255; other values are clamped."""
    return np.asarray(np.clip(np.rint(values * 255), 0, 255).astype(np.uint8))


def opacities(logits: Float32) -> Float64:
    """Return opacities, 0 to 1, from logits."""
    with np.errstate(over="ignore"):  # exp overflows for very negative logits; their opacity becomes 0
        values: Float64 = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return values


def logits(opacity: NDArray[Any]) -> Float32:
    """Logits from opacities in [0, 1]. 0 and 1 move halfway to the next float32, so that their logits are finite."""
    p = np.clip(opacity.astype(np.float64), 2.0**-150, 1 - 2.0**-25)
    return (np.log(p) - np.log1p(-p)).astype(np.float32)


def byte_logits() -> Float32:
    """Logits (256,) of the opacities that bytes 0 to 255 encode.

    0 and 255 become 0.25 and 254.75 before the conversion. These round to the same bytes, and have finite logits.
    """
    steps = np.arange(256, dtype=np.float64)
    steps[0], steps[-1] = 0.25, 254.75
    return logits(steps / 255)


def to_log_scales(gaussians: Gaussians, where: Path | str) -> None:
    """Replace the linear scales of a file's Gaussians by their logs, in place (see `all_to_log_scales`)."""
    all_to_log_scales([(where, gaussians)])


def all_to_log_scales(parts: Sequence[tuple[Path | str, Gaussians]], writer: str = "") -> None:
    """Replace the linear scales (standard deviations) of all parts of a file by their logs, in place.

    All scales are taken for logs and kept, with a warning, if `writer` is given, or if at least
    LOG_SCALES_MIN_NEGATIVE_SHARE of all Gaussians have a negative scale. splat-transform wrote logs before 22 June
    2026, and the review draft of KHR_gaussian_splatting asked for them.

    parts: for each part of the file, a prefix for messages and the Gaussians.
    writer: name of the program that wrote the file, if it is known to write logs; otherwise "".
    Raises InputError if some Gaussians have a negative scale, but fewer than that fraction.
    """
    with np.errstate(invalid="ignore"):
        negative = [np.asarray((gaussians.log_scales < 0).any(axis=1)) for _, gaussians in parts]
    count, total = sum(int(rows.sum()) for rows in negative), sum(len(gaussians) for _, gaussians in parts)
    logs = "read as logs of scales, although this format stores scales"
    if writer:
        warn(f"{parts[0][0]}: its scales are {logs}, as {writer} wrote them")
        return
    if count:
        (where, gaussians), rows = next(each for each in zip(parts, negative, strict=True) if each[1].any())
        at = int(rows.argmax())
        found = f"Gaussian {at} has the scales {' '.join(f'{value:g}' for value in gaussians.log_scales[at])}"
        many = f"{count:,} of {total:,} {have(count)} a negative scale"
        if count < LOG_SCALES_MIN_NEGATIVE_SHARE * total:
            raise InputError(f"{where}: {found}, expected numbers of at least 0; {many}")
        warn(f"{where}: {found}, and {many}: all are {logs}")
        return
    for _, gaussians in parts:
        scales = gaussians.log_scales
        for block in row_blocks(len(scales)):
            scales[block] = np.log(np.maximum(scales[block], MIN_SCALE, dtype=np.float64))


def have(count: int) -> str:
    """The verb that agrees with a count: "has" or "have"."""
    return "has" if count == 1 else "have"


def logits_of(opacity: NDArray[Any], where: Path | str, numbers: int | NDArray[np.intp] = 0) -> Float32:
    """Logits from a file's opacities. NaN stays NaN.

    numbers: index in the file of each Gaussian, or of the first one if all are consecutive; for messages.
    Raises InputError for opacities outside [0, 1] by more than UNIT_RANGE_TOLERANCE.
    """
    with np.errstate(invalid="ignore"):
        bad = (opacity < -UNIT_RANGE_TOLERANCE) | (opacity > 1 + UNIT_RANGE_TOLERANCE)
    if bad.any():
        at = int(bad.argmax())
        number = numbers + at if isinstance(numbers, int) else numbers[at]
        raise InputError(
            f"{where}: Gaussian {number} has an opacity of {float(opacity[at]):g}, expected 0 to 1; if these are "
            "logits, replace them by 1 / (1 + exp(-logit))"
        )
    return logits(opacity)


def colours(dc: Float32) -> Float64:
    """Convert SH coefficients of degree 0, an array of any shape, to colours."""
    return 0.5 + SH_C0 * dc.astype(np.float64)


def coefficients(rgb: NDArray[Any]) -> Float64:
    """Convert colours, an array of any shape, to SH coefficients of degree 0."""
    return (np.asarray(rgb, np.float64) - 0.5) / SH_C0


def full_scale(levels: NDArray[Any]) -> float:
    """Value that stands for white in stored colours of any shape and numeric dtype, guessed from the values.

    - 8-bit integers: 255.
    - Wider integers: the first of 255, 65535, 2^31-1 and 2^32-1 that no value exceeds. 255 is among them because some
      programs store bytes in wider types.
    - Floats: 1 if no value exceeds 1. Also 1 if some are fractions, and either none exceeds MAX_FLOAT_HIGHLIGHT or
      UNIT_COLOUR_SHARE of them are at most 1. Otherwise 255 if no value exceeds it, else 65535.

    Non-finite values are ignored. Without values the result is 255 for integers, 1 for floats.
    """
    values = np.asarray(levels)
    integer = values.dtype.kind in "iub"
    if integer and values.dtype.itemsize == 1:
        return 255.0
    values = values[np.isfinite(values)]
    largest = float(values.max(initial=0))
    if integer:
        return next((white for white in (255.0, 65535.0, 2.0**31 - 1) if largest <= white), 2.0**32 - 1)
    slack = 1 + UNIT_RANGE_TOLERANCE
    if largest > MAX_FLOAT_HIGHLIGHT and bool((values != np.rint(values)).any()):
        usual = float(np.quantile(values, UNIT_COLOUR_SHARE))  # highlights may be far brighter than white
        largest = usual if usual <= slack else largest
    if largest <= slack or (largest <= MAX_FLOAT_HIGHLIGHT and bool((values != np.rint(values)).any())):
        return 1.0
    return 255.0 if largest <= 255 * slack else 65535.0


def unit_quaternions(quaternions: NDArray[Any]) -> Float64:
    """Normalise quaternions (n, 4), w x y z. A quaternion of length 0 becomes the identity rotation."""
    q = quaternions.astype(np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(length > 0, q / np.where(length > 0, length, 1), (1.0, 0.0, 0.0, 0.0))


def restore_largest(which: NDArray[Any], three: Float32) -> Float32:
    """Unit quaternions (n, 4), of which a file stores all components but the largest.

    which (n,): index of the missing component, the largest.
    three (n, 3): the other components in their order.
    """
    result = np.empty((len(three), 4), np.float32)
    largest = np.sqrt(np.maximum(1 - np.square(three).sum(axis=1), 0))
    np.put_along_axis(result, OTHER_QUATERNION_COMPONENTS[which], three, axis=1)
    np.put_along_axis(result, which.astype(np.intp)[:, None], largest[:, None], axis=1)
    return result


def leave_out_largest(unit: Float64) -> tuple[NDArray[np.intp], Float64]:
    """Index of the largest component of each unit quaternion (n, 4), and its three other components.

    The inverse of `restore_largest`. A quaternion changes sign if its largest component is negative.
    """
    which = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, which[:, None], axis=1) < 0, -1, 1)
    return which, np.take_along_axis(unit, OTHER_QUATERNION_COMPONENTS[which], axis=1) * sign


def at_ends(between: NDArray[Any], low: NDArray[Any], high: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
    """Replace the NaNs of an interpolation that come from infinite bounds.

    between: the interpolated values, low + part * (high - low), with `part` from 0 to 1.
    Where `low` or `high` is infinite, the result is `low` if `part` is 0, `high` if it is 1, and otherwise low + high.
    """
    finite = np.isfinite(low) & np.isfinite(high)
    if finite.all():
        return between
    with np.errstate(invalid="ignore"):  # -inf + inf gives NaN
        ends = np.where(part == 0, low, np.where(part == 1, high, low + high))
    return np.where(finite, between, ends)


def read_rows(file: BinaryIO, kind: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    """Read the next `count` records of dtype `kind` from a file. Raises InputError if the file has fewer."""
    data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise InputError(f"{path}: truncated while it was read")
    return np.frombuffer(data, kind)


def all_finite(array: NDArray[Any]) -> bool:
    """True if all values of a float32 array are finite. This is so if, and only if, their float64 sum is finite."""
    with np.errstate(invalid="ignore"):  # -inf + inf gives NaN
        return bool(np.isfinite(array.sum(dtype=np.float64)))


def check_writable(path: Path, gaussians: Gaussians, *, least: int = 0, first: int = 0) -> None:
    """Check Gaussians before they are written to `path`.

    first: the index in the file of the first of these Gaussians, for messages.

    Raises ValueError for invalid arrays (`Gaussians.check`), InputError for non-finite values and for fewer than
    `least` Gaussians.
    """
    gaussians.check()
    for name, array in zip(GAUSSIAN_ARRAY_NOUNS, gaussians.arrays().values(), strict=True):
        if not all_finite(array):
            row = int((~np.isfinite(array.reshape(len(array), -1)).all(axis=1)).argmax())
            raise InputError(f"{path}: cannot be written: Gaussian {first + row} has {name} that is not finite")
    if len(gaussians) < least:
        raise InputError(f"{path}: cannot be written: the model has no Gaussians")


def require_count(path: Path, count: int, size: int) -> None:
    """Raise InputError if a compressed file of `size` bytes cannot hold `count` Gaussians."""
    if count < 1:
        raise InputError(f"{path}: has {count} Gaussians, expected at least one")
    if count > max(MAX_UNCHECKED_GAUSSIANS, size):
        raise InputError(f"{path}: says that it has {count} Gaussians in {size} bytes; is it damaged?")


def morton_order(means: Float32) -> NDArray[np.int64]:
    """Indices (n,) that sort means (n, 3) along a Z-order curve through their bounding box (Morton 1966).

    Neighbours in space get close indices. Ties keep their order.
    """
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    cells = (1 << MORTON_BITS_PER_AXIS) - 1
    scale = cells / np.where(high > low, high - low, 1)
    codes = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code = ((means[:, axis] - low[axis]) * scale[axis]).astype(np.uint64)
        codes |= every_third_bit(code) << np.uint64(axis)
    return np.argsort(codes, kind="stable")
