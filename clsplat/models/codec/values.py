# SPDX-License-Identifier: Apache-2.0
"""Helpers of several formats: encoding in bytes, reading rows, spatial order, checks of file contents.

Formats of bytes store colours as 0.5 + C0 times SH coefficient 0, and opacities from 0 to 1 (Kerbl et al. 2023).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.gaussians import Gaussians
from clsplat.spherical_harmonics import SH_C0

IO_BLOCK_ROWS = 1 << 15
"""Number of rows that are read or written at once: whole chunks of the compressed PLY."""
MIN_SCALE = 2.0**-149
"""Replacement for a scale of 0, whose log has to be finite: the smallest float32."""
LOG_SCALES_MIN_NEGATIVE_SHARE = 0.01
"""Fraction of Gaussians with a negative scale, at or above which all scales are taken for logs.

In a model in metres nearly all logs are negative. A file of linear scales with a few damaged ones stays below it.
"""
MAX_UNCHECKED_GAUSSIANS = 1 << 20
"""Number of Gaussians that a compressed file of any length may have. A file may have more only if it has a byte for
each.

Real files meet this limit, since positions alone take several bytes each. A decompression bomb claims more.
"""
OTHER_QUATERNION_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Row i: the components of a quaternion other than component i."""
MORTON_BITS_PER_AXIS = 21
MAX_FLOAT_HIGHLIGHT = 2.0
"""Float colours up to this value have white at 1, unless all are whole numbers. Some may then be brighter than white.
"""
UNIT_COLOUR_SHARE = 0.95
"""Least fraction of float colours that are at most 1, if white is 1 and there are highlights."""
UNIT_RANGE_TOLERANCE = 1e-3
"""Relative tolerance of float colours above white and of opacities outside 0 to 1, for half floats and averages."""
GAUSSIAN_ARRAY_NOUNS = ("a position", "a rotation", "a scale", "an opacity", "a colour")
"""Nouns for the arrays of `Gaussians`, for messages."""
_MORTON_SPREAD_STEPS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def empty(count: int, degree: int) -> Gaussians:
    """Uninitialised model of `count` Gaussians."""
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3))
    arrays: list[Any] = [np.empty(shape, np.float32) for shape in shapes]
    return Gaussians(*arrays)


def row_blocks(count: int, most: int = IO_BLOCK_ROWS) -> Iterator[slice]:
    """Slices of the rows 0 to `count`, each of at most `most` rows."""
    return (slice(start, min(start + most, count)) for start in range(0, count, most))


def world_means(gaussians: Gaussians, rows: slice | NDArray[Any] = slice(None)) -> Float64:
    """Means (n, 3) in world coordinates."""
    return gaussians.means[rows] + gaussians.origin


def to_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert values from 0 to 1 to bytes from 0 to 255; values outside are clamped."""
    return np.asarray(np.clip(np.rint(values * 255), 0, 255).astype(np.uint8))


def opacities(logits: Float32) -> Float64:
    """Opacities from 0 to 1 of logits."""
    with np.errstate(over="ignore"):  # exp of a large number: the opacity correctly becomes 0
        values: Float64 = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return values


def logits(opacity: NDArray[Any]) -> Float32:
    """Logits of opacities from 0 to 1. To stay finite, 0 and 1 move halfway to the nearest other float32."""
    p = np.clip(opacity.astype(np.float64), 2.0**-150, 1 - 2.0**-25)
    return (np.log(p) - np.log1p(-p)).astype(np.float32)


def byte_logits() -> Float32:
    """Logits (256,) of opacities in steps of 1/255.

    The first and the last step are half as wide as the others. Their middles stand for them: the logits are finite and
    round to the same byte.
    """
    steps = np.arange(256, dtype=np.float64)
    steps[0], steps[-1] = 0.25, 254.75
    return logits(steps / 255)


def to_log_scales(gaussians: Gaussians, where: Path | str) -> None:
    """`all_to_log_scales` for a model of one part."""
    all_to_log_scales([(where, gaussians)])


def all_to_log_scales(parts: Sequence[tuple[Path | str, Gaussians]], writer: str = "") -> None:
    """Replace the linear scales (standard deviations) of all parts by their logs, in place.

    If the fraction LOG_SCALES_MIN_NEGATIVE_SHARE or more of all Gaussians has a negative scale, the scales of all parts
    are logs already: they stay, and a warning says so. Files by splat-transform before 22 June 2026, and files after
    the review draft of KHR_gaussian_splatting, have logs.

    parts: prefix of messages and Gaussians of each part.
    writer: a program that is known to write logs, negative or not.
    Raises InputError for negative scales below that fraction.
    """
    with np.errstate(invalid="ignore"):
        negative = [np.asarray((gaussians.log_scales < 0).any(axis=1)) for _, gaussians in parts]
    count, total = sum(int(rows.sum()) for rows in negative), sum(len(gaussians) for _, gaussians in parts)
    logs = "read as logs of scales, though this format holds scales themselves"
    if writer:
        warn(f"{parts[0][0]}: its scales are {logs}, as {writer} wrote them")
        return
    if count:
        (where, gaussians), rows = next(each for each in zip(parts, negative, strict=True) if each[1].any())
        at = int(rows.argmax())
        found = f"Gaussian {at} has the scales {' '.join(f'{value:g}' for value in gaussians.log_scales[at])}"
        many = f"{count:,} of {total:,} {have(count)} a negative one"
        if count < LOG_SCALES_MIN_NEGATIVE_SHARE * total:
            raise InputError(f"{where}: {found}, expected numbers of at least 0; {many}")
        warn(f"{where}: {found}, and {many}: all are {logs}")
        return
    for _, gaussians in parts:
        scales = gaussians.log_scales
        for block in row_blocks(len(scales)):
            scales[block] = np.log(np.maximum(scales[block], MIN_SCALE, dtype=np.float64))


def have(count: int) -> str:
    """The verb "has" or "have" for a count."""
    return "has" if count == 1 else "have"


def logits_of(opacity: NDArray[Any], where: Path | str, numbers: int | NDArray[np.intp] = 0) -> Float32:
    """Logits of a file's opacities; NaN passes through.

    numbers: the Gaussians' numbers in the file, or the number of the first.
    Raises InputError for opacities outside [0, 1] by more than rounding.
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
    """Colours from SH coefficients 0, which are the constant terms."""
    return 0.5 + SH_C0 * dc.astype(np.float64)


def coefficients(rgb: NDArray[Any]) -> Float64:
    """SH coefficients 0 from colours."""
    return (np.asarray(rgb, np.float64) - 0.5) / SH_C0


def full_scale(levels: NDArray[Any]) -> float:
    """Value of white in stored colours of any shape and numeric dtype, judged by the values.

    - 8-bit integers: 255.
    - Wider integers: 255 if the largest is at most that, as programs store bytes in them. Otherwise 65535, 2^31-1 or
      2^32-1.
    - Floats: 1 if the largest is at most 1, or at most MAX_FLOAT_HIGHLIGHT with fractions among them, or if nearly all
      are at most 1. Otherwise 255 or 65535.

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
    """Quaternions (n, 4), w x y z, normalised; length 0 becomes no rotation."""
    q = quaternions.astype(np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(length > 0, q / np.where(length > 0, length, 1), (1.0, 0.0, 0.0, 0.0))


def restore_largest(which: NDArray[Any], three: Float32) -> Float32:
    """Unit quaternions (n, 4) from their three smaller components.

    which (n,): index of the largest component, which was left out.
    three (n, 3): the others in their order.
    """
    result = np.empty((len(three), 4), np.float32)
    largest = np.sqrt(np.maximum(1 - np.square(three).sum(axis=1), 0))
    np.put_along_axis(result, OTHER_QUATERNION_COMPONENTS[which], three, axis=1)
    np.put_along_axis(result, which.astype(np.intp)[:, None], largest[:, None], axis=1)
    return result


def leave_out_largest(unit: Float64) -> tuple[NDArray[np.intp], Float64]:
    """Inverse of `restore_largest`. A quaternion changes sign if its largest component is negative."""
    which = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, which[:, None], axis=1) < 0, -1, 1)
    return which, np.take_along_axis(unit, OTHER_QUATERNION_COMPONENTS[which], axis=1) * sign


def at_ends(between: NDArray[Any], low: NDArray[Any], high: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
    """Interpolate between bounds that may be infinite, for which plain arithmetic gives NaN.

    between: plain interpolation at the fraction `part`, 0 to 1, of the way from `low` to `high`.
    If a bound is infinite, the ends are the bounds themselves, and all values between them are infinite.
    """
    finite = np.isfinite(low) & np.isfinite(high)
    if finite.all():
        return between
    with np.errstate(invalid="ignore"):  # -inf + inf, which has no meaning
        ends = np.where(part == 0, low, np.where(part == 1, high, low + high))
    return np.where(finite, between, ends)


def read_rows(file: BinaryIO, kind: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    """Read the next `count` records of a file whose size was checked. Raises InputError if it has shrunk since."""
    data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise InputError(f"{path}: truncated while it was read")
    return np.frombuffer(data, kind)


def all_finite(array: NDArray[Any]) -> bool:
    """True if all values are finite, in a single pass: the float64 sum of finite float32 values is finite."""
    with np.errstate(invalid="ignore"):  # -inf + inf
        return bool(np.isfinite(array.sum(dtype=np.float64)))


def check_writable(path: Path, gaussians: Gaussians, *, least: int = 0) -> None:
    """Raise ValueError for arrays that are not as `Gaussians` requires.

    Raises InputError for non-finite values, and for fewer than `least` Gaussians.
    """
    gaussians.check()
    for name, array in zip(GAUSSIAN_ARRAY_NOUNS, gaussians.arrays().values(), strict=True):
        if not all_finite(array):
            row = int((~np.isfinite(array.reshape(len(array), -1)).all(axis=1)).argmax())
            raise InputError(f"{path}: cannot be written: Gaussian {row} has {name} that is not finite")
    if len(gaussians) < least:
        raise InputError(f"{path}: cannot be written: the model has no Gaussians")


def require_count(path: Path, count: int, size: int) -> None:
    """Raise InputError for a count that a compressed file of `size` bytes cannot have."""
    if count < 1:
        raise InputError(f"{path}: has {count} Gaussians, expected at least one")
    if count > max(MAX_UNCHECKED_GAUSSIANS, size):
        raise InputError(f"{path}: says that it has {count} Gaussians in {size} bytes; is it damaged?")


def morton_order(means: Float32) -> NDArray[np.int64]:
    """Row order (n,) along a Z-order curve through the bounding box of the means (n, 3) (Morton 1966).

    Neighbours in space stay close. Ties keep their order.
    """
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    cells = (1 << MORTON_BITS_PER_AXIS) - 1
    scale = cells / np.where(high > low, high - low, 1)
    codes = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code = ((means[:, axis] - low[axis]) * scale[axis]).astype(np.uint64)
        for shift, mask in _MORTON_SPREAD_STEPS:
            code = (code | code << np.uint64(shift)) & np.uint64(mask)
        codes |= code << np.uint64(axis)
    return np.argsort(codes, kind="stable")
