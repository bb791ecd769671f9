# SPDX-License-Identifier: Apache-2.0
"""Checks and refusals of arguments (InputError), and conversions between tensors and arrays.

`torch/rendering.py` checks the settings of `rasterization`, such as tile_size and camera_model. Its calls of
`_refuse_missing` and `_refuse_settings` name the arguments of gsplat that clsplat refuses.
"""

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

_CONVERSIONS_REPORTED: set[str] = set()
"""Kinds of tensors (dtype and device) for which `as_array` has already warned."""


def refuse(name: str, found: object, expected: str) -> InputError:
    """Create the error that names an argument, the value found and the value expected."""
    return InputError(f"{name} is {found}, expected {expected}")


@contextmanager
def renamed(**names: str) -> Iterator[None]:
    """Context manager: put gsplat's argument names into error messages. names: gsplat's names, by clsplat's names."""
    try:
        yield
    except InputError as error:
        text = str(error)
        for ours, theirs in names.items():
            if re.match(rf"{ours}\b", text):
                raise InputError(text.replace(ours, theirs, 1)) from None
        raise


def shape_or_type(value: object) -> str:
    """Describe an argument for `refuse`: the shape of a tensor, or the type of another value."""
    return f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def check_shape(name: str, value: Any, *shapes: Sequence[int | str]) -> None:
    """Raise InputError unless the argument is a dense tensor of real numbers with one of `shapes`.

    A string in a shape stands for any size. Tensors of torch.func are refused too, since kernels cannot read them.
    """
    if isinstance(value, Tensor) and (is_gradtrackingtensor(value) or is_batchedtensor(value)):
        raise refuse(name, "a tensor of torch.func", "a plain tensor: clsplat.torch supports torch.autograd only")
    _check_shape(name, value, *shapes)


def _check_shape(name: str, value: Any, *shapes: Sequence[int | str]) -> None:
    """Raise InputError like `check_shape`, but accept tensors of torch.func, which pure PyTorch can read."""
    expected = f"a tensor {' or '.join(_named(shape) for shape in shapes)}"
    if not isinstance(value, Tensor):
        raise refuse(name, f"a {type(value).__name__}", expected)
    found = f"{str(value.dtype).removeprefix('torch.')} {_named(value.shape)}"
    if not any(_fits(value.shape, shape) for shape in shapes):
        raise refuse(name, found, expected)
    if not value.dtype.is_floating_point or value.is_sparse:
        raise refuse(name, "a sparse tensor" if value.is_sparse else found, "a dense tensor of float32")


def check(name: str, value: Any, *shapes: Sequence[int | str]) -> None:
    """Raise InputError unless the argument is a dense tensor of real numbers with one of `shapes` and without NaN.

    A string in a shape stands for any size. Tensors of torch.func are accepted.
    """
    _check_shape(name, value, *shapes)
    # the sum is NaN if a value is, and needs no additional array
    if torch.isnan(value.detach().sum()) and bool((broken := torch.isnan(value.detach())).any()):
        first = tuple(broken.nonzero()[0].tolist())
        raise InputError(f"{name} has {int(broken.sum())} NaN values, the first at {first}; expected numbers")


def _fits(found: Sequence[int], shape: Sequence[int | str]) -> bool:
    return len(found) == len(shape) and all(isinstance(b, str) or a == b for a, b in zip(found, shape, strict=True))


def _named(shape: Sequence[int | str]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise InputError unless the argument is one of `choices`."""
    if value not in choices:
        raise refuse(name, repr(value), f"one of {', '.join(choices)}")


def check_size(name: str, value: object) -> int:
    """Convert an argument, a number or a tensor of one element, to a whole number of pixels. Raises InputError."""
    size = whole(value)
    if size is None or size < 1:
        raise refuse(name, repr(value), "a whole number of pixels, 1 or more")
    return size


def check_number(name: str, value: object, least: float = -math.inf, most: float = math.inf) -> float:
    """The argument as a float, from a number or a tensor of one element. Raises InputError if it is out of range."""
    number = plain(value)
    if isinstance(number, bool) or not isinstance(number, int | float) or not least <= number <= most:
        limits = [f"at least {least}"] * (least > -math.inf) + [f"at most {most}"] * (most < math.inf)
        raise refuse(name, repr(value), f"a number of {' and '.join(limits)}" if limits else "a number")
    return float(number)


def as_array(value: Tensor) -> Float32:
    """The values of a tensor as a C-contiguous float32 array.

    The array shares memory with a dense float32 tensor on the CPU. Other tensors are copied, with one warning for each
    dtype and device.
    """
    if value.dtype != torch.float32 or value.device.type != "cpu":
        kind = f"{str(value.dtype).removeprefix('torch.')} on {value.device.type}"
        if kind not in _CONVERSIONS_REPORTED:
            _CONVERSIONS_REPORTED.add(kind)
            warn(f"tensors of {kind} are copied to float32 on the CPU for clsplat, and results are copied back")
        value = value.detach().to("cpu", torch.float32)
    array: Float32 = value.detach().contiguous().numpy()
    return array


def as_tensor(array: NDArray[Any], like: Tensor) -> Tensor:
    """The array as a tensor on the device of `like`, copied only if necessary. Real numbers get the dtype of `like`."""
    if not array.flags.writeable or not array.flags.c_contiguous:
        array = array.copy()
    tensor = torch.from_numpy(array)
    return tensor.to(like.device, like.dtype if tensor.dtype.is_floating_point else tensor.dtype)
