# SPDX-License-Identifier: Apache-2.0
"""gsplat's functions for PyTorch on any OpenCL device: import them from `clsplat.torch` instead of `gsplat`."""

from __future__ import annotations

from typing import Any

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("clsplat.torch needs PyTorch: pip install 'clsplat[torch]'", name="torch") from error

from clsplat.torch.covariances import quat_scale_to_covar_preci
from clsplat.torch.gsplat.absent_names import CUDA_ONLY_NAMES, what_is_absent
from clsplat.torch.gsplat.shim import install_as_gsplat, strategy
from clsplat.torch.harmonics import spherical_harmonics
from clsplat.torch.pixels import rasterize_to_pixels
from clsplat.torch.projection import fully_fused_projection
from clsplat.torch.relocation import compute_relocation
from clsplat.torch.rendering import RollingShutterType, rasterization
from clsplat.torch.selective_adam import SelectiveAdam
from clsplat.torch.tiles import isect_offset_encode, isect_tiles

__all__ = [
    "DefaultStrategy",
    "MCMCStrategy",
    "RollingShutterType",
    "SelectiveAdam",
    "compute_relocation",
    "fully_fused_projection",
    "install_as_gsplat",
    "isect_offset_encode",
    "isect_tiles",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterize_to_pixels",
    "spherical_harmonics",
]
GSPLAT_STRATEGIES = ("DefaultStrategy", "MCMCStrategy")
"""Classes that are imported from gsplat on first use."""


def __getattr__(name: str) -> Any:
    if name in CUDA_ONLY_NAMES:
        raise AttributeError(what_is_absent(name))
    if name not in GSPLAT_STRATEGIES:
        raise AttributeError(f"module 'clsplat.torch' has no attribute {name!r}")
    globals()[name] = value = strategy(name)
    return value
