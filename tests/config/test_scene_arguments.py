# SPDX-License-Identifier: Apache-2.0
"""The arguments of `load_scene` that follow from the settings of a training."""

from __future__ import annotations

import inspect
from pathlib import Path

from clsplat.config.masks import MaskUse
from clsplat.config.training import TrainConfig
from clsplat.scenes.loading import load_scene


def test_they_have_the_names_and_defaults_of_load_scene() -> None:
    parameters = inspect.signature(load_scene).parameters
    assert TrainConfig().scene_arguments() == {
        name: parameters[name].default for name in TrainConfig().scene_arguments()
    }
    settings = TrainConfig(
        resolution=3, test_every=4, test_most=5, masks="ignore", invert_masks=True, lenses="native", missing="skip"
    )
    assert settings.scene_arguments() == {
        "resolution": 3,
        "test_every": 4,
        "test_most": 5,
        "masks": MaskUse("ignore", invert=True),
        "lenses": "native",
        "missing": "skip",
    }


def test_no_other_module_spells_them_out() -> None:
    package = Path(inspect.getfile(load_scene)).parents[1]
    spelt = [path.name for path in package.rglob("*.py") if "masks=config.mask_use" in path.read_text("utf-8")]
    assert spelt == []
