# SPDX-License-Identifier: Apache-2.0
"""The arguments of `load_scene` that follow from the settings of a training."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest

from clsplat.config.masks import MaskUse
from clsplat.config.training import TrainConfig
from clsplat.scenes import loading


def arguments_of(config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the keyword arguments with which `load_scene_of` calls `load_scene`."""
    given: dict[str, Any] = {}
    monkeypatch.setattr(loading, "load_scene", lambda path, **arguments: given.update(arguments, path=path))
    loading.load_scene_of(config, "scene")
    return given


def test_they_have_the_names_and_defaults_of_load_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    parameters = inspect.signature(loading.load_scene).parameters
    given = arguments_of(TrainConfig(), monkeypatch)
    assert given.pop("path") == "scene"
    assert given == {name: parameters[name].default for name in given}


def test_they_are_those_of_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    given = arguments_of(
        TrainConfig(
            resolution=3, test_every=4, test_most=5, masks="ignore", invert_masks=True, lenses="native", missing="skip"
        ),
        monkeypatch,
    )
    expected = {
        "resolution": 3,
        "test_every": 4,
        "test_most": 5,
        "masks": MaskUse("ignore", invert=True),
        "lenses": "native",
        "missing": "skip",
    }
    assert {name: given[name] for name in expected} == expected


def test_no_other_module_spells_them_out() -> None:
    package = Path(inspect.getfile(loading)).parents[1]
    spelt = [path.name for path in package.rglob("*.py") if "masks=config.mask_use" in path.read_text("utf-8")]
    assert spelt == ["loading.py"]
