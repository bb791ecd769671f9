# SPDX-License-Identifier: Apache-2.0
"""Calls of NumPy functions from JAX programs, by jax.pure_callback."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

SCHEDULABLE_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
if SCHEDULABLE_CORES == 1:
    # On one core XLA has a single thread. A callback would run in this thread and wait for the same thread to copy its
    # arguments: a deadlock. XLA reads its number of threads from NPROC when JAX makes its first array.
    os.environ.setdefault("NPROC", "2")


def shape_like(array: Any) -> jax.ShapeDtypeStruct:
    """Shape and dtype of an array, which may be a tracer."""
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


def on_host(function: Callable[..., Any], shapes: Any, *arguments: Any) -> Any:
    """Call `function` of NumPy arrays from a JAX program, and return its result as JAX arrays.

    shapes: shapes and dtypes of the result, a tree of jax.ShapeDtypeStruct.
    arguments: JAX arrays. Under `vmap` the function is called once for each element of the mapped axis.
    """

    def called(*given: Any) -> Any:
        return function(*jax.tree_util.tree_map(np.asarray, given))

    return jax.pure_callback(called, shapes, *arguments, vmap_method="sequential")
