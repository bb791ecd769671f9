# SPDX-License-Identifier: Apache-2.0
"""Arguments of the library's calls as arrays for the kernels: errors name the argument."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.errors import InputError

Shape = tuple[int | str, ...]


def floats(name: str, values: Any, *shapes: Shape) -> Float32:
    """The argument `name` as a C-contiguous float32 array of one of these shapes, in which a text stands for any size.

    Raises InputError, which names the argument, for another shape, for what is no array of real numbers, and for
    numbers that are not finite.
    """
    array = _numbers(name, values)
    _check_shape(name, array, shapes)
    with np.errstate(over="ignore", invalid="ignore"):
        result = np.ascontiguousarray(array, np.float32)
        finite = np.isfinite(result.sum()) or bool(np.isfinite(result).all())  # a sum is quicker, and may overflow
    if not finite:
        at = np.unravel_index(int(np.argmin(np.isfinite(result))), result.shape)
        place = ", ".join(str(int(index)) for index in at)
        raise InputError(f"{name}: [{place}] is {array[at]}, expected finite numbers within float32")
    return result


def gradient(name: str, values: Any, shape: tuple[int, ...]) -> Float32 | None:
    """The gradient by an output as a C-contiguous float32 array of that output's shape; None where there is none.
    Raises InputError, as `floats` does, but lets numbers pass that are not finite."""
    if values is None:
        return None
    array = _numbers(name, values)
    _check_shape(name, array, (shape,))
    return np.ascontiguousarray(array, np.float32)


def _numbers(name: str, values: Any) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name}: got {array.dtype}, expected an array of real numbers")
    return array


def _check_shape(name: str, array: NDArray[Any], shapes: tuple[Shape, ...]) -> None:
    def fits(shape: Shape) -> bool:
        pairs = zip(array.shape, shape, strict=True)
        return len(shape) == array.ndim and all(isinstance(size, str) or size == had for had, size in pairs)

    if not any(fits(shape) for shape in shapes):
        wanted = " or ".join(f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})" for shape in shapes)
        raise InputError(f"{name}: got shape {array.shape}, expected {wanted}")
