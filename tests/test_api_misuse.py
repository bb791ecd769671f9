# SPDX-License-Identifier: Apache-2.0
"""Calls of Python and settings that the command line would not let through: one InputError, nothing that passes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses
from tiny import hidden_model, short

import clsplat
from clsplat.api import train
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.rendering.renderer import Renderer
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene

FEW = short(iterations=2, report=False, density={"every": 0})


@pytest.fixture(scope="module")
def loaded(scene: Path) -> Scene:
    return load_scene(scene)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (TrainConfig(iterations=4.5), "--iterations 4.5: expected a whole number"),
        (TrainConfig(iterations="4"), "--iterations 4: expected a whole number"),
        (TrainConfig(iterations=None), "--iterations None: expected a whole number"),
        (TrainConfig(seed=1 << 62), "--seed 4611686018427387904: expected a whole number below 4611686018427387904"),
        (TrainConfig(sh_degree=True), "--sh-degree True: expected a whole number"),
        (TrainConfig(dssim_weight="0.2"), "--dssim-weight 0.2: expected a number"),
        (TrainConfig(background="grey"), "--background grey: expected one of black, white, random"),
        (TrainConfig(background=(1, 1, 1)), "--background 1,1,1: expected one of black, white, random"),
        (TrainConfig(warmup=250), "--warmup 250: expected whole numbers"),
        (TrainConfig(eval_at=(1.5,)), "--eval-at 1.5: expected whole numbers"),
        (TrainConfig(report="no"), "--report no: expected True or False"),
        (TrainConfig(optimiser=None), "--optimiser None: expected OptimiserConfig(...)"),
        (TrainConfig(optimiser=OptimiserConfig(means_rate=1e301)), "means-rate 1e+301: expected a number below 1e300"),
        (TrainConfig(density={"every": 3}), "--density {'every': 3}: expected DensityConfig(...)"),
        (
            TrainConfig(density=DensityConfig(growth="budgets")),
            "--density.growth budgets: expected one of paper, budget, mcmc",
        ),
        (TrainConfig(rasterizer=RasterizerConfig(extent="opacit")), "--rasterizer.extent opacit: expected one of"),
        (TrainConfig(rasterizer=BenchSwitches(row_skip="no")), "--rasterizer.row-skip no: expected True or False"),
    ],
    ids=str,
)
def test_settings_of_another_kind_are_named(config: Any, message: str) -> None:
    assert message in refuses(".", config.check)


def test_numbers_of_numpy_serve_and_come_back(tmp_path: Path) -> None:
    config = replace(FEW, iterations=np.int64(2), dssim_weight=np.float32(0.25), report=np.bool_(False))  # type: ignore[arg-type]
    config.check()
    assert Run.open(Run.create(tmp_path / "run", config).path).config == replace(FEW, dssim_weight=0.25)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "scene"}, "scene is 'scene', expected clsplat.load_scene(...)"),
        ({"config": {"iterations": 3}}, "config is {'iterations': 3}, expected TrainConfig(...)"),
        ({"run": "run"}, "run is 'run', expected Run.create(...)"),
        ({"resume": True}, "resume=True: expected run=..."),
    ],
    ids=str,
)
def test_arguments_of_another_kind_are_named(arguments: dict[str, Any], message: str, loaded: Scene) -> None:
    assert message in refuses(".", train, **{"scene": loaded, "config": FEW, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"test_every": 2.5}, "test_every 2.5: expected a whole number below"),
        ({"test_every": "8"}, "test_every 8: expected a whole number below"),
        ({"test_every": None}, "test_every None: expected a whole number below"),
        ({"test_every": True}, "test_every True: expected a whole number below"),
        ({"resolution": 40.5}, "resolution 40.5: expected a whole number below"),
        ({"resolution": -1}, "resolution -1: expected 0 or more"),
        ({"test_every": -1}, "test_every -1: expected 0 or more"),
        ({"test_most": -1}, "test_most -1: expected 0 or more"),
    ],
    ids=str,
)
def test_numbers_of_a_scene_that_are_not_whole_are_named(arguments: dict[str, Any], message: str, scene: Path) -> None:
    assert refuses(".", load_scene, scene, **arguments).startswith(message)


@pytest.mark.parametrize("degree", [3.0, "3", True, 4, -1], ids=repr)
def test_a_degree_that_is_none_is_not_written(degree: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"^sh_degree is {degree}, expected 0 \(the model's\) to 3$"):
        hidden_model().save(tmp_path / "a.ply", sh_degree=degree)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("device", [0, True, 1.5], ids=repr)
def test_a_device_that_is_no_name_is_named(device: Any, loaded: Scene) -> None:
    for call in (
        lambda: clsplat.render(hidden_model(), loaded.views[0].camera, device=device),
        lambda: train(loaded, FEW, device=device),
    ):
        refuses(rf"device is {device}, expected", call)


def test_a_limit_holds_for_a_device_that_is_open(loaded: Scene, default_device: Device) -> None:
    with pytest.raises(CapacityError):
        train(loaded, FEW, device=default_device, max_device_mem="1KiB")


def test_a_run_that_is_there_is_not_trained_into_and_knows_its_settings(
    loaded: Scene, default_device: Device, tmp_path: Path
) -> None:
    run = Run.create(tmp_path / "run", FEW)
    train(loaded, replace(FEW, iterations=3), device=default_device, run=run)
    assert Run.open(run.path).config.iterations == 3  # and not what the run was made with
    metrics = run.metrics_path.read_bytes()
    for call, message in (
        ({}, "has been trained already; resume=True continues it"),
        ({"config": replace(FEW, iterations=1), "resume": True}, "is already at step 3; expected more"),
        ({"config": replace(FEW, seed=9), "resume": True}, "seed is 0, a resumed run cannot change it to 9"),
    ):
        given = {"scene": loaded, "device": default_device, "run": Run.open(run.path), **call}
        assert message in refuses(".", train, **given)
    assert run.metrics_path.read_bytes() == metrics
    again = train(loaded, device=default_device, run=Run.open(run.path), resume=True)  # to the run's 3 steps
    assert len(again) == len(clsplat.Gaussians.load(run.model_path))


def test_a_background_that_is_changed_in_place_counts(loaded: Scene, default_device: Device) -> None:
    gaussians, camera = hidden_model(), loaded.views[0].camera
    renderer, background = Renderer(default_device), np.zeros(3, np.float32)
    dark = renderer.render(gaussians, camera, background).image
    background[:] = 1
    assert renderer.render(gaussians, camera, background).image.sum() > dark.sum()


def test_arrays_of_different_lengths_are_not_rendered(loaded: Scene, default_device: Device) -> None:
    model = hidden_model()
    model.quaternions = model.quaternions[:5]
    with pytest.raises(ValueError, match=r"quaternions is float32 \(5, 4\), expected float32 \(40, 4\)"):
        Renderer(default_device).render(model, loaded.views[0].camera)
