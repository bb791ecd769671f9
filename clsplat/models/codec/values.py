# SPDX-License-Identifier: Apache-2.0
"""Helpers of several formats: values and their bytes, reading rows, an order in space, checks of what was read.

Colours in formats of bytes are 0.5 + C0 times SH coefficient 0, opacities lie in 0 to 1 (Kerbl et al. 2023).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.spherical_harmonics import C0

BLOCK_ROWS = 1 << 15
"""Rows that are read or written at once: whole chunks of the compressed PLY."""
LEAST_SCALE = 2.0**-149
"""Value for a scale of 0, whose log has to be finite: float32's least."""
FREE_COUNT = 1 << 20
"""Gaussians that a compressed file may have whatever its length is; beyond them it may have one for each byte of it.
That is more than any model of a scene, whose positions alone take several bytes each, and less than what a bomb would
ask for."""
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Row i: the components of a quaternion but for number i."""
MORTON_BITS = 21
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


def log_scales(linear: NDArray[Any], path: Path | str, first: int) -> Float64:
    """(n, 3) of standard deviations, those of the Gaussians from `first` on. Raises InputError for negative ones."""
    with np.errstate(invalid="ignore"):
        bad = ~(linear >= 0).all(axis=1)
    if bad.any():
        at = int(bad.argmax())
        scales = " ".join(f"{value:g}" for value in linear[at])
        raise InputError(f"{path}: Gaussian {first + at} has the scales {scales}, expected numbers of at least 0")
    return np.asarray(np.log(np.maximum(linear, LEAST_SCALE, dtype=np.float64)))


def colours(dc: Float32) -> Float64:
    """Colours of SH coefficients 0."""
    return 0.5 + C0 * dc.astype(np.float64)


def coefficients(rgb: NDArray[Any]) -> Float64:
    """SH coefficients 0 of colours."""
    return (np.asarray(rgb, np.float64) - 0.5) / C0


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


def read_rows(file: BinaryIO, kind: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    """The next `count` records of the file, whose size has been checked. Raises InputError where it shrank since."""
    data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise InputError(f"{path}: truncated while it was read")
    return np.frombuffer(data, kind)


def require_finite(path: Path, gaussians: Gaussians, *, writing: bool = False) -> None:
    """Raise InputError naming the first value that is not finite."""
    for name, array in zip(NAMES, gaussians.arrays().values(), strict=True):
        with np.errstate(invalid="ignore"):  # of infinities of both signs
            total = array.sum(dtype=np.float64)  # a single pass; that of finite float32 is finite
        if not np.isfinite(total):
            row = int((~np.isfinite(array.reshape(len(array), -1)).all(axis=1)).argmax())
            verb = "cannot be written: " if writing else ""
            raise InputError(f"{path}: {verb}Gaussian {row} has {name} that is not finite")


def check_writable(path: Path, gaussians: Gaussians, *, least: int = 0) -> None:
    """Raise ValueError for arrays that are not as `Gaussians` says; InputError for values that are not finite, and for
    fewer than `least` Gaussians."""
    gaussians.check()
    require_finite(path, gaussians, writing=True)
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
