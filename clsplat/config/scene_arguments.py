# SPDX-License-Identifier: Apache-2.0
"""Settings of a training that are also arguments of `clsplat.load_scene`."""

from __future__ import annotations

from typing import TypedDict

from clsplat.config.masks import MaskUse
from clsplat.config.training import Lenses, Missing, TrainConfig


class SceneArguments(TypedDict):
    """Arguments of `clsplat.load_scene`, which are documented there."""

    resolution: int
    test_every: int
    test_most: int
    masks: MaskUse
    lenses: Lenses
    missing: Missing


def scene_arguments(config: TrainConfig) -> SceneArguments:
    """Return the arguments of `clsplat.load_scene` for a training: all that depend on its settings but the frame.

    The frame is not among them, because a run that exists keeps the frame that it has.
    """
    return {
        "resolution": config.resolution,
        "test_every": config.test_every,
        "test_most": config.test_most,
        "masks": config.mask_use,
        "lenses": config.lenses,
        "missing": config.missing,
    }
