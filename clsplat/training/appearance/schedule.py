# SPDX-License-Identifier: Apache-2.0
"""Learning rate of appearance (gains, grids) by step, and the appearance arrays of a checkpoint.

Adam's betas and epsilon for appearance: `stages/appearance.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.colour_models import rise_in_short_training
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device

APPEARANCE_WARM_UP_STEPS, WARM_UP_START_FRACTION = 500, 0.01
"""Number of steps in which the learning rate rises at first (at most a tenth of all steps), and the fraction of the
full rate with which it begins."""


def rate_at(config: TrainConfig, step: int, views: int, *, ends: float, hastens: bool = True) -> float:
    """Learning rate of appearance in step number `step`.

    views: number of photographs, or of lenses. Each has a gradient in only one of this many steps, so Adam's steps for
        it are smaller by the root of this number. The rate is multiplied by the root to make up for it.
    ends: fraction of the rate that is left at the last step.
    hastens: True to raise the rate in a short training, so that gains can change by as much as in a long one.
    """
    rise: float = WARM_UP_START_FRACTION ** (1 - min(step / min(APPEARANCE_WARM_UP_STEPS, config.iterations / 10), 1.0))
    fall: float = ends ** (step / config.iterations)
    short = rise_in_short_training(config.iterations) if hastens else 1.0
    return float(config.appearance_rate * short * views**0.5 * rise * fall)


def saved(held: Mapping[str, DeviceArray]) -> dict[str, NDArray[Any]]:
    """Download the arrays `held` for a checkpoint, with "appearance/" before their names."""
    return {f"appearance/{name}": array.get() for name, array in held.items()}


def loaded(
    device: Device, arrays: Mapping[str, NDArray[Any]], names: Iterable[str], shape: tuple[int, ...]
) -> dict[str, DeviceArray]:
    """Upload the arrays `names` (float32, of this shape) of a checkpoint. Raises ValueError for arrays of other
    photographs.

    arrays: the checkpoint's arrays, by name without "appearance/".
    """
    values = {}
    for name in names:
        value = arrays.get(name)
        if value is None or value.shape != shape or value.dtype != np.float32 or not np.isfinite(value).all():
            raise ValueError(f"has no appearance/{name} of shape {shape}")
        values[name] = upload(device, value)
    return values
