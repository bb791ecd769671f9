# SPDX-License-Identifier: Apache-2.0
"""Ways that another device gets, forced by CLSPLAT_PRETEND: they are taken, and give the bits of the usual way."""

from __future__ import annotations

import pytest
from compare import assert_same_arrays
from tiny import CONFIG, write_scene

from clsplat.api import train
from clsplat.device.context import Device
from clsplat.device.drivers import driver_records
from clsplat.device.drivers.capabilities import PRETEND_VARIABLE, capabilities_of
from clsplat.device.selection import open_device
from clsplat.errors import DeviceError
from clsplat.gaussians import Gaussians
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE
from clsplat.training.trainer import Trainer


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("capabilities") / "scene"))


@pytest.fixture(scope="module")
def usual_models() -> dict[int, Gaussians]:
    """By the index of a device the model that it trains as it is."""
    return {}


def opened(monkeypatch: pytest.MonkeyPatch, device: Device, pretended: str, shape: str = "") -> Device:
    """The device, opened anew in a shape while this is pretended."""
    monkeypatch.setenv(PRETEND_VARIABLE, pretended)
    monkeypatch.setenv("CLSPLAT_SHAPE", shape)
    return Device(device.cl_device)


@pytest.mark.slow
def test_a_gpu(scene: Scene, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels in groups, photographs that are copied, and a driver that chooses the groups of an image's kernels."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")  # so that both send each camera once
    usual = opened(monkeypatch, device, "", "1x64")
    gpu = opened(monkeypatch, device, "gpu")
    assert (gpu.kind, gpu.shares_memory, gpu.shape.label) == ("gpu", False, "1x64")
    assert (usual.kind, usual.shares_memory) == ("cpu", True)
    assert open_device().kind == "gpu", "a device that was open before is not given again"
    of_gpu, wanted = (train(scene, CONFIG, device=one).arrays() for one in (gpu, usual))
    assert_same_arrays(of_gpu, wanted)
    assert gpu.calls.writes > usual.calls.writes


@pytest.mark.slow
@pytest.mark.parametrize("pretended", ["no-contraction", "no-exact-division", "allocation=184320", "group=32"])
def test_the_same_model(
    scene: Scene,
    device: Device,
    pretended: str,
    monkeypatch: pytest.MonkeyPatch,
    usual_models: dict[int, Gaussians],
) -> None:
    """A multiply-add by the built-in function, division as the driver likes it, where these drivers divide exactly
    anyway; buffers that do not hold a frame's pairs; launches in groups that the driver chooses."""
    usual, capabilities = opened(monkeypatch, device, ""), capabilities_of(device.cl_device)
    other = opened(monkeypatch, device, pretended)
    assert capabilities_of(device.cl_device) != capabilities or (
        pretended == "no-exact-division" and not capabilities.exact_division
    )
    if "division" in pretended:
        assert "correctly-rounded" not in other._options
    if device.index not in usual_models:
        usual_models[device.index] = train(scene, CONFIG, device=usual)
    assert_same_arrays(train(scene, CONFIG, device=other).arrays(), usual_models[device.index].arrays())


def test_shapes_of_small_devices(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    assert opened(monkeypatch, default_device, "gpu,group=16").shape.label == "1x16"
    assert opened(monkeypatch, default_device, "gpu,local-memory=4096").shape.items < 64
    with pytest.raises(DeviceError, match=r"CLSPLAT_SHAPE=1x64: .* has at most 32 items in a work-group"):
        opened(monkeypatch, default_device, "group=32", "1x64")
    with pytest.raises(DeviceError, match=r"CLSPLAT_SHAPE=1x64: .* has 4 KiB of local memory"):
        opened(monkeypatch, default_device, "local-memory=4096", "1x64")


def test_what_is_learnt_of_a_pretended_device_is_kept_apart(
    default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = driver_records.device_key(default_device.cl_device)
    monkeypatch.setenv(PRETEND_VARIABLE, "gpu")
    assert driver_records.device_key(default_device.cl_device) != usual


@pytest.mark.parametrize("text", ["cpu", "gpu=1", "group", "group=0", "group=-3", "allocation=1MiB", "gpu;group=3"])
def test_a_variable_that_makes_no_sense(default_device: Device, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PRETEND_VARIABLE, text)
    with pytest.raises(DeviceError, match=rf"{PRETEND_VARIABLE}=.* is not known, expected .* group=NUMBER, "):
        capabilities_of(default_device.cl_device)


def test_trainers_take_it(scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Buffers of so few bytes cut a frame's pairs into bands."""
    small = opened(monkeypatch, default_device, "allocation=184320")
    assert Trainer(scene, CONFIG, small).plan.pairs < Trainer(scene, CONFIG, default_device).plan.pairs
