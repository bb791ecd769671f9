# SPDX-License-Identifier: Apache-2.0
"""Helpers of several formats: values and their bytes, reading rows, an order in space, checks of what was read.

Colours in formats of bytes are 0.5 + C0 times SH coefficient 0, opacities lie in 0 to 1 (Kerbl et al. 2023).
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
from clsplat.spherical_harmonics import C0

BLOCK_ROWS = 1 << 15
"""Rows that are read or written at once: whole chunks of the compressed PLY."""
LEAST_SCALE = 2.0**-149
"""Value for a scale of 0, whose log has to be finite: float32's least."""
LOGS = 0.01
"""The part of linear scales that has to be negative for all of them to be logs. Of a model in metres nearly all are; a
file of scales with a damaged one is none of logs."""
FREE_COUNT = 1 << 20
"""Gaussians that a compressed file may have whatever its length is; beyond them it may have one for each byte of it.
That is more than any model of a scene, whose positions alone take several bytes each, and less than what a bomb would
ask for."""
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Row i: the components of a quaternion but for number i."""
MORTON_BITS = 21
BEYOND_WHITE = 2.0
"""Colours of floats that are up to here, and no whole numbers, are parts of 1, some of them brighter than white."""
USUAL = 0.95
"""Share of the colours that lie in 0 to 1 where those of floats are parts of 1 with highlights among them."""
ROUNDING = 1e-3
"""By how much, in parts of it, a colour of floats may pass white, or an opacity 1: that of half floats and averages."""
NAMES = ("a position", "a rotation", "a scale", "an opacity", "a colour")
"""The arrays of `Gaussians`, for messages."""
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def empty(count: int, degree: int) -> Gaussians:
    """Room for `count` Gaussians, to be filled."""
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3))
    arrays: list[Any] = [np.empty(shape, np.float32) for shape in shapes]
    return Gaussians(*arrays)


def row_blocks(count: int, most: int = BLOCK_ROWS) -> Iterator[slice]:
    """The rows 0 to `count`, at most so many at a time."""
    return (slice(start, min(start + most, count)) for start in range(0, count, most))


def world_means(gaussians: Gaussians, rows: slice | NDArray[Any] = slice(None)) -> Float64:
    """(n, 3) where they are in the world."""
    return gaussians.means[rows] + gaussians.origin


def to_bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """0 to 1 as 0 to 255, to the nearest; what lies outside is cut."""
    return np.asarray(np.clip(np.rint(values * 255), 0, 255).astype(np.uint8))


def opacities(logits: Float32) -> Float64:
    """0 to 1 of logits."""
    with np.errstate(over="ignore"):  # exp of a large number: the opacity is 0 then, as it should be
        values: Float64 = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return values


def logits(opacity: NDArray[Any]) -> Float32:
    """Logits of opacities from 0 to 1. Those of 0 and 1 are infinite: they count as float32's nearest others,
    halved."""
    p = np.clip(opacity.astype(np.float64), 2.0**-150, 1 - 2.0**-25)
    return (np.log(p) - np.log1p(-p)).astype(np.float32)


def byte_logits() -> Float32:
    """(256,): of opacities in steps of 1/255. The first and the last step are half as wide as others, and count as
    their middle, where the logit is finite and rounds to the same byte."""
    steps = np.arange(256, dtype=np.float64)
    steps[0], steps[-1] = 0.25, 254.75
    return logits(steps / 255)


def to_log_scales(gaussians: Gaussians, where: Path | str) -> None:
    """`all_to_log_scales` of a model of one part."""
    all_to_log_scales([(where, gaussians)])


def all_to_log_scales(parts: Sequence[tuple[Path | str, Gaussians]], writer: str = "") -> None:
    """Take logs of linear scales, standard deviations that a file has in place of logs, in place, in all its parts.

    Those of which `LOGS` or more are negative are logs, and stay, with a warning: splat-transform's .glb of before 22
    June 2026, and the review draft of KHR_gaussian_splatting, had such. All parts decide together; `where` of the part
    begins messages. writer: a program that is known to write logs, negative or not. Raises InputError for fewer
    negative ones.
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
        if count < LOGS * total:
            raise InputError(f"{where}: {found}, expected numbers of at least 0; {many}")
        warn(f"{where}: {found}, and {many}: all are {logs}")
        return
    for _, gaussians in parts:
        scales = gaussians.log_scales
        for block in row_blocks(len(scales)):
            scales[block] = np.log(np.maximum(scales[block], LEAST_SCALE, dtype=np.float64))


def have(count: int) -> str:
    """The verb of so many Gaussians."""
    return "has" if count == 1 else "have"


def logits_of(opacity: NDArray[Any], where: Path | str, numbers: int | NDArray[np.intp] = 0) -> Float32:
    """Logits of a file's opacities; NaN is passed on. `numbers`: of each, or of the first of them. Raises InputError
    for what is outside [0, 1] by more than rounding."""
    with np.errstate(invalid="ignore"):
        bad = (opacity < -ROUNDING) | (opacity > 1 + ROUNDING)
    if bad.any():
        at = int(bad.argmax())
        number = numbers + at if isinstance(numbers, int) else numbers[at]
        raise InputError(
            f"{where}: Gaussian {number} has an opacity outside [0, 1], {float(opacity[at]):g}; if these are "
            "logits, expected 1 / (1 + exp(-logit))"
        )
    return logits(opacity)


def colours(dc: Float32) -> Float64:
    """Colours of SH coefficients 0."""
    return 0.5 + C0 * dc.astype(np.float64)


def coefficients(rgb: NDArray[Any]) -> Float64:
    """SH coefficients 0 of colours."""
    return (np.asarray(rgb, np.float64) - 0.5) / C0


def full_scale(levels: NDArray[Any]) -> float:
    """White of stored colours of any shape and numeric dtype, by their values: 1, 255 or 65535.

    8-bit integers have 255. Wider ones have 255 if the largest is at most that, as programs store bytes in them, and
    else 65535. Floats have 1 if the largest is at most 1, or at most `BEYOND_WHITE` with fractions among them; else as
    wider integers. Values that are not finite do not count; no values at all have 255 as integers, 1 as floats.
    """
    values = np.asarray(levels)
    integer = values.dtype.kind in "iub"
    if integer and values.dtype.itemsize == 1:
        return 255.0
    values = values[np.isfinite(values)]
    largest = float(values.max(initial=0))
    if integer:
        return next((white for white in (255.0, 65535.0, 2.0**31 - 1) if largest <= white), 2.0**32 - 1)
    slack = 1 + ROUNDING
    if largest > BEYOND_WHITE and bool((values != np.rint(values)).any()):
        usual = float(np.quantile(values, USUAL))  # some parts of 1 may be far brighter than white
        largest = usual if usual <= slack else largest
    if largest <= slack or (largest <= BEYOND_WHITE and bool((values != np.rint(values)).any())):
        return 1.0
    return 255.0 if largest <= 255 * slack else 65535.0


def unit_quaternions(quaternions: NDArray[Any]) -> Float64:
    """(n, 4), w x y z, of length 1; of length 0 no rotation."""
    q = quaternions.astype(np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(length > 0, q / np.where(length > 0, length, 1), (1.0, 0.0, 0.0, 0.0))


def restore_largest(which: NDArray[Any], three: Float32) -> Float32:
    """(n, 4) unit quaternions, from the index (n,) of the component that was left out, the largest, and the others
    (n, 3) in their order."""
    result = np.empty((len(three), 4), np.float32)
    largest = np.sqrt(np.maximum(1 - np.square(three).sum(axis=1), 0))
    np.put_along_axis(result, OTHERS[which], three, axis=1)
    np.put_along_axis(result, which.astype(np.intp)[:, None], largest[:, None], axis=1)
    return result


def leave_out_largest(unit: Float64) -> tuple[NDArray[np.intp], Float64]:
    """The inverse of `restore_largest`, with the signs of (n, 4) such that the component left out is positive."""
    which = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, which[:, None], axis=1) < 0, -1, 1)
    return which, np.take_along_axis(unit, OTHERS[which], axis=1) * sign


def at_ends(between: NDArray[Any], low: NDArray[Any], high: NDArray[Any], part: NDArray[Any]) -> NDArray[Any]:
    """`between`, the values at a part, 0 to 1, of the way between two bounds; but where a bound is infinite those at
    the ends are the bounds themselves and the others the infinite one, which arithmetic would make NaN."""
    finite = np.isfinite(low) & np.isfinite(high)
    if finite.all():
        return between
    with np.errstate(invalid="ignore"):  # of infinities of both signs, which say nothing
        ends = np.where(part == 0, low, np.where(part == 1, high, low + high))
    return np.where(finite, between, ends)


def read_rows(file: BinaryIO, kind: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    """The next `count` records of the file, whose size has been checked. Raises InputError where it shrank since."""
    data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise InputError(f"{path}: truncated while it was read")
    return np.frombuffer(data, kind)


def all_finite(array: NDArray[Any]) -> bool:
    """True if every value is, by a single pass: the sum of float32 in float64 is finite if they are."""
    with np.errstate(invalid="ignore"):  # of infinities of both signs
        return bool(np.isfinite(array.sum(dtype=np.float64)))


def check_writable(path: Path, gaussians: Gaussians, *, least: int = 0) -> None:
    """Raise ValueError for arrays that are not as `Gaussians` says; InputError for values that are not finite, and for
    fewer than `least` Gaussians."""
    gaussians.check()
    for name, array in zip(NAMES, gaussians.arrays().values(), strict=True):
        if not all_finite(array):
            row = int((~np.isfinite(array.reshape(len(array), -1)).all(axis=1)).argmax())
            raise InputError(f"{path}: cannot be written: Gaussian {row} has {name} that is not finite")
    if len(gaussians) < least:
        raise InputError(f"{path}: cannot be written: the model has no Gaussians")


def require_count(path: Path, count: int, size: int) -> None:
    """Raise InputError for a count that a compressed file of `size` bytes does not have."""
    if count < 1:
        raise InputError(f"{path}: has {count} Gaussians, expected at least one")
    if count > max(FREE_COUNT, size):
        raise InputError(f"{path}: says that it has {count} Gaussians in {size} bytes; is it damaged?")


def morton_order(means: Float32) -> NDArray[np.int64]:
    """(n,) rows along a Z-order curve through the box around the means (n, 3) (Morton 1966): near ones near each
    other, ties by index."""
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    cells = (1 << MORTON_BITS) - 1
    scale = cells / np.where(high > low, high - low, 1)
    codes = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code = ((means[:, axis] - low[axis]) * scale[axis]).astype(np.uint64)
        for shift, mask in _SPREAD:
            code = (code | code << np.uint64(shift)) & np.uint64(mask)
        codes |= code << np.uint64(axis)
    return np.argsort(codes, kind="stable")
