# SPDX-License-Identifier: Apache-2.0
"""Calls from JAX's programs to NumPy functions."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

SCHEDULABLE = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
if SCHEDULABLE == 1:
    # XLA on one core has one thread, which a callback would block that waits for that thread to copy its arguments.
    # XLA reads this when JAX makes its first array.
    os.environ.setdefault("NPROC", "2")


def shape_like(array: Any) -> jax.ShapeDtypeStruct:
    """Shape and dtype of an array that may be traced."""
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


def on_host(function: Callable[..., Any], shapes: Any, *arguments: Any) -> Any:
    """Call a function of NumPy arrays in a program of JAX; `vmap` calls it once for each element.

    shapes: a tree of jax.ShapeDtypeStruct like the function's result.
    """

    def called(*given: Any) -> Any:
        return function(*jax.tree_util.tree_map(np.asarray, given))

    return jax.pure_callback(called, shapes, *arguments, vmap_method="sequential")
