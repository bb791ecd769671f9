# SPDX-License-Identifier: Apache-2.0
"""Names of gsplat 1.5.3 and 1.6 that clsplat lacks, and their replacements, which raise an error when called."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NoReturn

from clsplat.errors import InputError

CUDA_ONLY_NAMES = (
    "FusedGaussianLosses",
    "adam",
    "build_sparse_tile_layout",
    "create_camera_model",
    "fully_fused_projection_2dgs",
    "fully_fused_projection_with_ut",
    "isect_tiles_lidar",
    "isect_tiles_sparse",
    "persp_proj",
    "proj",
    "rasterization_2dgs",
    "rasterize_contributing_gaussian_ids",
    "rasterize_contributing_gaussian_ids_sparse",
    "rasterize_num_contributing_gaussians",
    "rasterize_num_contributing_gaussians_sparse",
    "rasterize_to_indices_in_range",
    "rasterize_to_indices_in_range_2dgs",
    "rasterize_to_pixels_2dgs",
    "rasterize_to_pixels_eval3d",
    "rasterize_to_pixels_eval3d_extra",
    "rasterize_to_pixels_sparse",
    "rasterize_top_contributing_gaussian_ids",
    "rasterize_top_contributing_gaussian_ids_sparse",
    "spherical_harmonics_l0",
    "spherical_harmonics_l1_plus",
    "world_to_cam",
)
"""Functions that gsplat implements only in CUDA and that clsplat does not have."""
CUDA_ONLY_MODULES = ("gsplat.cuda._wrapper", "gsplat.rendering", "gsplat.losses_fused")
"""Modules of gsplat that define the functions of CUDA_ONLY_NAMES."""
PURE_PYTHON_NAMES = (
    "PngCompression",
    "Strategy",
    "accumulate",
    "accumulate_2dgs",
    "color_correct_affine",
    "color_correct_quadratic",
    "export_splats",
    "rasterization_2dgs_inria_wrapper",
    "rasterization_inria_wrapper",
)
"""Functions and classes in gsplat's Python code that need no CUDA. They are not replaced if gsplat is installed."""


def what_is_absent(name: str) -> str:
    """Error message for a call of gsplat's function `name`, which clsplat lacks."""
    return f"{name} is a CUDA function of gsplat that clsplat lacks: docs/library.md lists the functions of clsplat"


def refuses(name: str, theirs: Callable[..., Any] | None = None) -> Callable[..., NoReturn]:
    """Create a replacement for gsplat's function `name` that raises InputError when it is called.

    theirs: gsplat's function, whose docstring the replacement gets; None if gsplat is not installed.
    """

    def call(*_: Any, **__: Any) -> NoReturn:
        raise InputError(what_is_absent(name))

    if theirs is not None:
        functools.update_wrapper(call, theirs, updated=())
    call.__name__ = name
    call.clsplat_refuses = True  # type: ignore[attr-defined]
    return call


def is_refused(value: Any) -> bool:
    """True if the value is a function that `refuses` created."""
    return "clsplat_refuses" in getattr(value, "__dict__", {})
