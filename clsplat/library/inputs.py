# SPDX-License-Identifier: Apache-2.0
"""Arguments of the library's calls as the kernels take them; each error names the argument."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError


def floats(name: str, given: Any, *shapes: Sequence[int | str]) -> Float32:
    """A C-contiguous float32 array of one of the shapes, in which a word stands for any size: `given` itself where it
    is one. Raises InputError for another shape, for what is no array of numbers, and for what is not finite."""
    try:
        with np.errstate(over="ignore"):
            array: Float32 = np.ascontiguousarray(given, np.float32)
    except (TypeError, ValueError):
        raise InputError(f"{name} is a {type(given).__name__}, expected an array {_named(*shapes)}") from None
    check_shape(name, array.shape, *shapes)
    # one pass without another array; a sum of finite numbers may overflow, so it only says where to look
    with np.errstate(over="ignore", invalid="ignore"):
        suspect = not np.isfinite(array.sum())
    if suspect and not (fine := np.isfinite(array)).all():
        first = tuple(int(index) for index in np.argwhere(~fine)[0])
        wrong = np.size(fine) - np.count_nonzero(fine)
        raise InputError(
            f"{name} has {wrong:,} values that are NaN or infinite, the first at {first}; expected numbers"
        )
    return array


def check_shape(name: str, found: Sequence[int], *shapes: Sequence[int | str]) -> None:
    """Raise InputError unless the shape of an argument is one of the shapes, in which a word stands for any size."""
    if not any(_fits(found, shape) for shape in shapes):
        raise InputError(f"{name} has shape {_text(found)}, expected {_named(*shapes)}")


def matrices(name: str, given: Any, side: int, count: int | str) -> Float64:
    """(count, side, side) float64, of one matrix or of many. Raises InputError as `floats`."""
    floats(name, given, (count, side, side), (side, side))
    array: Float64 = np.asarray(given, np.float64)
    return array.reshape(-1, side, side)


def sizes(name: str, given: Any, count: int) -> list[int]:
    """A length in pixels for each of `count` cameras, from one for all or one for each. Raises InputError."""
    each = [given] * count if np.ndim(given) == 0 else list(given)
    whole = all(
        isinstance(size, (int, np.integer)) and not isinstance(size, bool) and 0 < size < 2**24 for size in each
    )
    if len(each) != count or not whole:
        raise InputError(
            f"{name} is {given!r:.80}, expected a positive whole number, or one for each of {count} cameras"
        )
    return [int(size) for size in each]


def number(name: str, given: Any, least: float, most: float = np.inf) -> float:
    """A number from `least` to `most`. Raises InputError."""
    if not isinstance(given, (int, float, np.number)) or isinstance(given, bool) or not least <= given <= most:
        bound = f"from {least:g} to {most:g}" if np.isfinite(most) else f"of at least {least:g}"
        raise InputError(f"{name} is {given!r:.80}, expected a number {bound}")
    return float(given)


def choice(name: str, given: Any, choices: Sequence[str]) -> None:
    """Raise InputError unless an argument is one of the choices."""
    if given not in choices:
        raise InputError(f"{name} is {given!r:.80}, expected one of {', '.join(choices)}")


def _fits(found: Sequence[int], shape: Sequence[int | str]) -> bool:
    return len(found) == len(shape) and all(isinstance(b, str) or a == b for a, b in zip(found, shape, strict=True))


def _text(shape: Sequence[int | str]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def _named(*shapes: Sequence[int | str]) -> str:
    return " or ".join(map(_text, shapes))
