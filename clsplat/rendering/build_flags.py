# SPDX-License-Identifier: Apache-2.0
"""Kernel build defines for the settings of the rasterizer (`RasterizerConfig`). The defaults need no defines."""

from __future__ import annotations

import math

import numpy as np

from clsplat.config.rasterizer import RasterizerConfig

_HALF_LOG2E = 0.5 * math.log2(math.e)


DEFAULT_ALPHA_MAX = 0.99
"""Default maximum of a Gaussian's alpha at a pixel."""


def kernel_defines(
    config: RasterizerConfig, *, antialiased: bool = False, alpha_max: float = DEFAULT_ALPHA_MAX
) -> dict[str, object]:
    """The kernels' defines for `config`, only for settings that differ from the default.

    antialiased: True for an antialiased model.
    alpha_max: maximum of a Gaussian's alpha at a pixel; library calls choose their own.
    """
    config, default = config.switches(), RasterizerConfig()
    defines: dict[str, object] = {}
    if config.extent == "3sigma":
        # No skips: a Gaussian may be visible beyond 3 sigma. Skips of whole rows and columns of cells would cut it off
        # at a place that depends on the kernel shape.
        defines.update(EXTENT_BUDGET=_literal(9 * _HALF_LOG2E), NO_ROW_SKIP=True, NO_COLUMN_SKIP=True)
    elif config.extent == "constant":
        defines["EXTENT_BUDGET"] = _literal(-math.log2(config.alpha_min))
    flags = {
        "BOX_TILE_TEST": config.tile_test != "ellipse",
        "SQUARE_TILE_TEST": config.tile_test == "square",
        "NO_ROW_SKIP": not config.row_skip,
        "NO_COLUMN_SKIP": not config.column_skip,
        "NO_EARLY_STOP": not config.early_stop,
        "NO_FRUSTUM_CULL": not config.frustum_cull,
        "ANTIALIASED": antialiased,
    }
    defines.update({name: True for name, wanted in flags.items() if wanted})
    if config.sh_degree_limit != default.sh_degree_limit:
        defines["SH_LIMIT"] = (config.sh_degree_limit + 1) ** 2
    if config.alpha_min != default.alpha_min:
        defines.update(ALPHA_MIN=_literal(config.alpha_min), LOG2_ALPHA_MIN=_literal(math.log2(config.alpha_min)))
    if config.transmittance_min != default.transmittance_min:
        defines["TRANSMITTANCE_MIN"] = _literal(config.transmittance_min)
    if alpha_max != DEFAULT_ALPHA_MAX:
        defines["ALPHA_MAX"] = _literal(alpha_max)
    return defines


def _literal(value: float) -> str:
    """The OpenCL C literal of a value, with all digits of its float32."""
    return f"{float(np.float32(value)):.9e}f"
