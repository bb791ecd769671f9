# SPDX-License-Identifier: Apache-2.0
"""Colours from spherical harmonics in JAX programs, with their gradient: `clsplat.jax.spherical_harmonics`."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from clsplat.jax.host import on_host, shape_like
from clsplat.library import harmonics
from clsplat.library.checks import check_shape


def spherical_harmonics(
    degree: int, directions: jax.Array, coefficients: jax.Array, masks: jax.Array | None = None
) -> jax.Array:
    """Evaluate real spherical harmonics in given directions, differentiable in directions and coefficients.

    Parameters
    ----------
    degree : int
        Highest degree used, 0 to 4.
    directions : (..., 3) jax.Array
        Directions of any length.
    coefficients : (..., K, 3) jax.Array
        K is at least (degree + 1)^2.
    masks : (...) jax.Array of bool, optional
        Where it is False, the result is 0.

    Returns
    -------
    (..., 3) jax.Array of float32
        The sums, without 0.5 added.

    Raises
    ------
    InputError
        If a shape is wrong. For other invalid arguments JAX raises its own error, when the program runs.

    Notes
    -----
    Calls `clsplat.library.harmonics.spherical_harmonics`. Signs and order of the basis are gsplat's
    (docs/conventions.md; Kerbl et al. 2023). Arrays of other dtypes are converted to float32.
    """
    directions, coefficients = jnp.asarray(directions, jnp.float32), jnp.asarray(coefficients, jnp.float32)
    batch = directions.shape[:-1]
    check_shape("directions", directions.shape, (*batch, 3))
    check_shape("coefficients", coefficients.shape, (*batch, "K", 3))
    if masks is not None:
        check_shape("masks", masks.shape, batch)
    result: jax.Array = _harmonics(degree, masks, directions, coefficients)
    return result


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _harmonics(degree: int, masks: Any, directions: Any, coefficients: Any) -> Any:
    def forward(masks: Any, directions: Any, coefficients: Any) -> Any:
        return harmonics.spherical_harmonics(degree, directions, coefficients, masks).colors

    return on_host(forward, shape_like(directions), masks, directions, coefficients)


def _forward(degree: int, *arrays: Any) -> Any:
    return _harmonics(degree, *arrays), arrays


def _backward(degree: int, arrays: Any, d_colors: Any) -> Any:
    def gradient(masks: Any, directions: Any, coefficients: Any, d_colors: Any) -> Any:
        found = harmonics.spherical_harmonics(degree, directions, coefficients, masks).vjp(d_colors)
        return found["directions"], found["coefficients"]

    shapes = tuple(map(shape_like, arrays[1:]))
    return None, *on_host(gradient, shapes, *arrays, d_colors)


_harmonics.defvjp(_forward, _backward)
