# SPDX-License-Identifier: Apache-2.0
"""`clsplat.rasterize` for JAX programs, with `jit`, `grad` and `vmap`. Requires the extra `jax`."""

from __future__ import annotations

try:
    import jax as _jax  # noqa: F401  # a plain "No module named 'jax'" would not say how to install it
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("clsplat.jax needs JAX: pip install 'clsplat[jax]'", name="jax") from error

from clsplat.jax.harmonics import spherical_harmonics
from clsplat.jax.rasterize import Rasterized, rasterize

__all__ = ["Rasterized", "rasterize", "spherical_harmonics"]
