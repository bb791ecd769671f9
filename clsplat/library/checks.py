# SPDX-License-Identifier: Apache-2.0
"""Argument checks of library calls, which convert the arguments for the kernels. Error messages name the argument."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError

Shape = tuple[int | str, ...]


def floats(name: str, values: Any, *shapes: Shape) -> Float32:
    """Convert the argument `name` to a C-contiguous float32 array of one of `shapes`. A string stands for any size.

    Raises InputError for another shape, for values that are not real numbers, and for NaN and infinite numbers.
    """
    array = _numbers(name, values)
    check_shape(name, array.shape, *shapes)
    with np.errstate(over="ignore", invalid="ignore"):
        result = np.ascontiguousarray(array, np.float32)
        flat = result.reshape(-1)
        # a dot product is faster than isfinite; if it overflows, isfinite decides
        finite = np.isfinite(flat @ flat) or bool(np.isfinite(flat).all())
    if not finite:
        at = np.unravel_index(int(np.argmin(np.isfinite(result))), result.shape)
        place = ", ".join(str(int(index)) for index in at)
        raise InputError(f"{name}: [{place}] is {array[at]}, expected finite numbers within float32")
    return result


def gradient(name: str, values: Any, shape: tuple[int, ...]) -> Float32 | None:
    """Convert the argument `name`, a gradient or None, to a C-contiguous float32 array of this shape, or None.

    Raises InputError like `floats`, except that NaN and infinite numbers are accepted.
    """
    if values is None:
        return None
    array = _numbers(name, values)
    check_shape(name, array.shape, shape)
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)


def matrices(name: str, given: Any, side: int, count: int | str) -> Float64:
    """Convert the argument `name`, (count, side, side) or a single matrix, to float64 (count, side, side).

    count: required number of matrices; a string stands for any number. A single matrix becomes (1, side, side).
    Raises InputError like `floats`.
    """
    floats(name, given, (count, side, side), (side, side))
    array: Float64 = np.array(given, np.float64)  # copied, because the caller may change the array later
    return array.reshape(-1, side, side)


def plain(given: Any) -> Any:
    """Return the Python number in an array or tensor with a single element. Other arguments are returned unchanged."""
    one = hasattr(given, "item") and prod(getattr(given, "shape", (0,))) == 1
    return given.item() if one else given


def whole(given: Any) -> int | None:
    """Return the value of an int, a float such as 40.0, or an array or tensor with one such number; otherwise None."""
    number = plain(given)
    if isinstance(number, bool) or not isinstance(number, (int, float)) or number != number // 1:
        return None
    return int(number)


def sizes(name: str, given: Any, count: int) -> list[int]:
    """Return the argument `name` as a list with a length in pixels for each of `count` cameras. Raises InputError.

    given: one length for all cameras, or a sequence with one for each.
    """
    each = [whole(size) for size in ([given] * count if np.ndim(given) == 0 else given)]
    lengths = [size for size in each if size is not None and 0 < size < 2**24]
    if not len(lengths) == len(each) == count:
        raise InputError(
            f"{name} is {given!r:.80}, expected a positive whole number, or one for each of {count} cameras"
        )
    return lengths


def number(name: str, given: Any, least: float, most: float = np.inf) -> float:
    """Return the argument `name` as a float. Raises InputError unless it is a number from `least` to `most`."""
    value = plain(given)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not least <= value <= most:
        bound = f"from {least:g} to {most:g}" if np.isfinite(most) else f"of at least {least:g}"
        raise InputError(f"{name} is {given!r:.80}, expected a number {bound}")
    return float(value)


def degree(name: str, given: Any, highest: int, otherwise: str = "") -> int:
    """Return the argument `name` as an int. Raises InputError unless it is an SH degree from 0 to `highest`.

    otherwise: text for the error message about other accepted values, such as ", or None".
    """
    found = whole(given)
    if found is None or not 0 <= found <= highest:
        raise InputError(f"{name} is {given!r:.80}, expected a whole number from 0 to {highest}{otherwise}")
    return found


def choice(name: str, given: Any, choices: Sequence[str]) -> None:
    """Raise InputError unless the argument `name`, whose value is `given`, is one of the choices."""
    if given not in choices:
        raise InputError(f"{name} is {given!r:.80}, expected one of {', '.join(choices)}")


def check_shape(name: str, found: Sequence[int], *shapes: Shape) -> None:
    """Raise InputError unless the argument's shape `found` is one of `shapes`. A string stands for any size."""

    def fits(shape: Shape) -> bool:
        pairs = zip(found, shape, strict=True)
        return len(shape) == len(found) and all(isinstance(size, str) or size == had for had, size in pairs)

    if not any(fits(shape) for shape in shapes):
        wanted = " or ".join(f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})" for shape in shapes)
        raise InputError(f"{name}: got shape {tuple(found)}, expected {wanted}")


def _numbers(name: str, values: Any) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name}: got {array.dtype}, expected an array of real numbers")
    return array
