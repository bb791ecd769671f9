# SPDX-License-Identifier: Apache-2.0
"""The learning rate of gains and grids of photographs, and their arrays in a checkpoint."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device

WARM_UP, LEAST = 500, 0.01
"""Steps over which the rate rises, or a tenth of all; the part of itself that it begins with."""
FULL = 10_000
"""Steps under which a training is short: in so many a gain comes about 2 octaves far, at the rate of the settings."""


def rate_at(config: TrainConfig, step: int, views: int, *, ends: float, hastens: bool = True) -> float:
    """The learning rate of step number `step`, of which the last has the part `ends`. A photograph has a gradient in
    one of `views` steps, by the root of which Adam makes its steps smaller. In a short training gains have to come as
    far, where it hastens."""
    rise: float = LEAST ** (1 - min(step / min(WARM_UP, config.iterations / 10), 1.0))
    fall: float = ends ** (step / config.iterations)
    short = max(FULL / config.iterations, 1.0) if hastens else 1.0
    return float(config.appearance_rate * short * views**0.5 * rise * fall)


def saved(held: Mapping[str, DeviceArray]) -> dict[str, NDArray[Any]]:
    """Arrays of a checkpoint, by name."""
    return {f"appearance/{name}": array.get() for name, array in held.items()}


def loaded(
    device: Device, arrays: Mapping[str, NDArray[Any]], names: Iterable[str], shape: tuple[int, ...]
) -> dict[str, DeviceArray]:
    """Arrays of a checkpoint on the device. Raises ValueError where one is missing, or of other photographs."""
    values = {}
    for name in names:
        value = arrays.get(name)
        if value is None or value.shape != shape or value.dtype != np.float32 or not np.isfinite(value).all():
            raise ValueError(f"has no appearance/{name} of shape {shape}")
        values[name] = upload(device, value)
    return values
