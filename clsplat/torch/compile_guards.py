# SPDX-License-Identifier: Apache-2.0
"""Decorators: one keeps a function out of the graphs of `torch.compile`, the other forbids second derivatives."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch.autograd.function import once_differentiable

_P = ParamSpec("_P")
_R = TypeVar("_R")


def differentiable_once(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Mark the `backward` of an autograd function as not differentiable: a second derivative raises an error."""
    return once_differentiable(function)  # type: ignore[no-any-return]


def outside_graphs(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Exclude a function from tracing by `torch.compile`.

    `torch.compiler.disable` imports the compiler, which takes seconds. So it is called only if other code has already
    imported the compiler.
    """
    disabled: list[Callable[_P, _R]] = []

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if "torch._dynamo" not in sys.modules:
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(torch.compiler.disable(function))
        return disabled[0](*args, **kwargs)

    # the compiler checks this mark when a compiled function calls `call`
    call._torchdynamo_disable = True  # type: ignore[attr-defined]  # noqa: SLF001
    return call
