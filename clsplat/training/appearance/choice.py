# SPDX-License-Identifier: Apache-2.0
"""Choice of the appearance model by the setting `appearance`: none, a colour model, or bilateral grids."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from clsplat.config.colour_models import COLOUR_MODELS
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.training.appearance.base import Appearance
from clsplat.training.appearance.bilateral_grid import GridsOfAll
from clsplat.training.appearance.colours import ColoursOfAll

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


APPEARANCE_MODELS: dict[str, Callable[[TrainConfig, Device, Scene], Appearance]] = {
    **dict.fromkeys(COLOUR_MODELS, ColoursOfAll),
    "grid": GridsOfAll,
}
"""Class of the appearance model for each value of the setting `appearance`, except "none"."""


def appearance_of(config: TrainConfig, device: Device, scene: Scene) -> Appearance:
    """Make the appearance model that the setting `appearance` names."""
    if config.appearance == "none":
        return Appearance()
    return APPEARANCE_MODELS[config.appearance](config, device, scene)
