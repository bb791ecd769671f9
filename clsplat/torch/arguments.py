# SPDX-License-Identifier: Apache-2.0
"""Tensors that are given, checked by name; and the way from a tensor to an array and back."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch._C._functorch import is_batchedtensor, is_gradtrackingtensor

from clsplat.arrays import Float32
from clsplat.errors import InputError, warn
from clsplat.library.checks import plain, whole

_SAID: set[str] = set()
"""Kinds of tensors that have been warned of."""


def refuse(name: str, found: object, expected: str) -> InputError:
    """The error of an argument: its name, its value, and a value that would do."""
    return InputError(f"{name} is {found}, expected {expected}")


@contextmanager
def renamed(**names: str) -> Iterator[None]:
    """Errors of the library within, with the names that arguments have here: `theirs="ours"`."""
    try:
        yield
    except InputError as error:
        text = str(error)
        for theirs, ours in names.items():
            if re.match(rf"{theirs}\b", text):
                raise InputError(text.replace(theirs, ours, 1)) from None
        raise


def check_shape(name: str, value: Any, *shapes: Sequence[int | str]) -> None:
    """Raise InputError, which names the argument, unless it is a dense tensor of real numbers of one of `shapes`, in
    which a word stands for any size; and for a tensor of torch.func, whose numbers kernels cannot read."""
    if isinstance(value, Tensor) and (is_gradtrackingtensor(value) or is_batchedtensor(value)):
        raise refuse(name, "a tensor of torch.func", "a plain one: clsplat.torch has the gradients of torch.autograd")
    _check_shape(name, value, *shapes)


def _check_shape(name: str, value: Any, *shapes: Sequence[int | str]) -> None:
    """Check as `check_shape` does, for functions in PyTorch alone, which torch.func may call."""
    expected = f"a tensor {' or '.join(_named(shape) for shape in shapes)}"
    if not isinstance(value, Tensor):
        raise refuse(name, f"a {type(value).__name__}", expected)
    found = f"{str(value.dtype).removeprefix('torch.')} {_named(value.shape)}"
    if not any(_fits(value.shape, shape) for shape in shapes):
        raise refuse(name, found, expected)
    if not value.dtype.is_floating_point or value.is_sparse:
        raise refuse(name, "a sparse tensor" if value.is_sparse else found, "a dense tensor of float32")


def check(name: str, value: Any, *shapes: Sequence[int | str]) -> None:
    """Raise InputError, which names the argument, where `check_shape` does, and for NaN."""
    _check_shape(name, value, *shapes)
    # a sum is NaN where a number is, and is made in one pass without another array
    if torch.isnan(value.detach().sum()) and bool((broken := torch.isnan(value.detach())).any()):
        first = tuple(broken.nonzero()[0].tolist())
        raise InputError(f"{name} has {int(broken.sum())} NaN, the first at {first}; expected numbers")


def _fits(found: Sequence[int], shape: Sequence[int | str]) -> bool:
    return len(found) == len(shape) and all(isinstance(b, str) or a == b for a, b in zip(found, shape, strict=True))


def _named(shape: Sequence[int | str]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise InputError unless an argument is one of `choices`."""
    if value not in choices:
        raise refuse(name, repr(value), f"one of {', '.join(choices)}")


def check_size(name: str, value: object) -> int:
    """A number of pixels, which may be a real number or a tensor of one. Raises InputError where it is none."""
    size = whole(value)
    if size is None or size < 1:
        raise refuse(name, repr(value), "a whole number of pixels, 1 or more")
    return size


def check_number(name: str, value: object, least: float = -math.inf, most: float = math.inf) -> float:
    """A number in a range, which may be a tensor of one. Raises InputError where it is none."""
    number = plain(value)
    if isinstance(number, bool) or not isinstance(number, int | float) or not least <= number <= most:
        limits = [f"{least} or more"] * (least > -math.inf) + [f"{most} or less"] * (most < math.inf)
        raise refuse(name, repr(value), " and ".join(["a number", *limits]))
    return float(number)


def as_array(value: Tensor) -> Float32:
    """The numbers of a tensor: float32, C order. Over the same memory where the tensor is float32 on the CPU and dense.

    Others are copied, and a warning says so once for each kind.
    """
    if value.dtype != torch.float32 or value.device.type != "cpu":
        kind = f"{str(value.dtype).removeprefix('torch.')} on {value.device.type}"
        if kind not in _SAID:
            _SAID.add(kind)
            warn(f"tensors of {kind} are copied to float32 on the CPU, in which clsplat takes them, and results back")
        value = value.detach().to("cpu", torch.float32)
    array: Float32 = value.detach().contiguous().numpy()
    return array


def as_tensor(array: NDArray[Any], like: Tensor) -> Tensor:
    """A tensor over an array's memory; on the device of another tensor, and of its kind where the numbers are real."""
    if not array.flags.writeable or not array.flags.c_contiguous:
        array = array.copy()
    tensor = torch.from_numpy(array)
    return tensor.to(like.device, like.dtype if tensor.dtype.is_floating_point else tensor.dtype)
