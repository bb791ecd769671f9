# SPDX-License-Identifier: Apache-2.0
"""Steps of several views over the chunks in view: the bytes of steps over the whole model, on any number of devices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pipeline import shaped
from quick import quick
from same_bytes import State, opened_again, state
from test_visible_chunks import assert_same
from tiny import run_steps, short
from wide import let_small_models_have_chunks, wide_model

from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import HostGaussians
from clsplat.training.batch_chunks import BatchChunks
from clsplat.training.memory import UNLIMITED, HostMemory
from clsplat.training.step import visible_chunks
from clsplat.training.trainer import Trainer

CONFIG = short(iterations=38, report=False, warmup=(), batch=4, density={"max_gaussians": 16_000})
STEPS = 10
"""Steps of four views, the last one of two. Density control comes four times."""
SETTINGS = {
    "dense": CONFIG,
    "sparse": replace(CONFIG, optimiser=OptimiserConfig(sparse=True)),
    "higher bands wait": replace(CONFIG, optimiser=OptimiserConfig(sh_rest_every=8), sh_degree_every=8),
    "penalties": replace(CONFIG, penalty=0.02, background="random"),
    "contributions": replace(CONFIG, density=replace(CONFIG.density, min_contribution=1e-6, absolute_gradients=True)),
    "exposure": replace(CONFIG, appearance="exposure"),
    "by rays": replace(CONFIG, perspective="rays"),
}

LIMITS = {
    "device 5 MiB": (5 << 20, None),
    "device 10 MiB": (10 << 20, None),
    "host 1 MiB": (None, 1 << 20),
    "host 5 MiB": (None, 5 << 20),
}
"""Limits of memory, of the device and of the host. See test_a_streamed_model."""


@pytest.fixture(autouse=True)
def _small_models_have_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    let_small_models_have_chunks(monkeypatch)


Found = tuple[State, list[float], Trainer]


def trained(
    scene: Scene, config: TrainConfig, devices: list[Device], *, whole: bool = False, memory: HostMemory = UNLIMITED
) -> Found:
    """Train STEPS steps. Returns the state, the share of the chunks in each step over chunks, and the trainer.

    whole: every step runs over the whole model.
    """
    shares: list[float] = []
    real = BatchChunks.begin

    def begin(*arguments: Any) -> BatchChunks | None:
        chunks = real(*arguments)
        if chunks is not None:
            shares.append(CHUNK_ROWS * len(chunks.numbers) / chunks.model[0].count)
        return chunks

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BatchChunks, "begin", begin)
        if whole:
            patch.setattr(visible_chunks, "ORDERED_ROWS", 1 << 30)
        trainer = Trainer(scene, config, devices[0], wide_model(), further=devices[1:], memory=memory)
        run_steps(STEPS, trainer)
        assert trainer.step == config.iterations
        found = state(trainer)
        trainer.close()
    return found, shares, trainer


@pytest.fixture(scope="module")
def of_whole() -> Callable[[Scene, str, Device], State]:
    """States of trainings over the whole model, by settings: one for all tests that compare with it."""
    known: dict[str, State] = {}

    def wanted(scene: Scene, name: str, device: Device) -> State:
        if name not in known:
            known[name], shares, trainer = trained(scene, SETTINGS[name], [device], whole=True)
            assert not shares
            assert trainer.batch is not None
            assert trainer.batch.moved_bytes == 0
        return known[name]

    return wanted


@pytest.mark.parametrize("name", quick(SETTINGS, "dense", "sparse"))
@pytest.mark.parametrize("parts", quick([1, 2, 4], 1, 2))
def test_the_bytes_of_the_whole_model(
    scene: Scene, default_device: Device, of_whole: Callable[..., State], name: str, parts: int
) -> None:
    wanted = of_whole(scene, name, default_device)
    devices = [default_device, *(opened_again(default_device) for _ in range(parts - 1))]
    got, shares, trainer = trained(scene, SETTINGS[name], devices)
    assert_same(got, wanted)
    assert len(shares) == STEPS
    assert 0.2 < min(shares) < 0.9, "steps leave chunks out, and views differ"
    assert trainer.parameters.count > 2 * CHUNK_ROWS


@pytest.mark.parametrize("lanes", quick([1, 4], 1))
def test_other_kernel_shapes(scene: Scene, default_device: Device, lanes: int) -> None:
    """Against the same shape's steps over the whole model."""
    device = shaped(default_device, lanes, 64 if lanes == 1 else 1)
    wanted, _, _ = trained(scene, CONFIG, [device], whole=True)
    got, shares, _ = trained(scene, CONFIG, [device])
    assert_same(got, wanted)
    assert len(shares) == STEPS


@pytest.mark.parametrize("optimiser", quick(["dense", "sparse"], "dense"))
@pytest.mark.parametrize("name", quick(LIMITS, "device 5 MiB", "host 1 MiB"))
@pytest.mark.parametrize("parts", quick([1, 2], 2))
def test_a_streamed_model(
    scene: Scene, default_device: Device, tmp_path: Path, of_whole: Callable[..., State], optimiser: str, name: str,
    parts: int,
) -> None:  # fmt: skip
    """With pools that have slots for all chunks of a step, for those of a view, or for fewer."""
    wanted = of_whole(scene, optimiser, default_device)
    of_device, of_host = LIMITS[name]
    device = default_device if of_device is None else open_device(memory_limit=of_device)
    devices = [device, *(opened_again(default_device) for _ in range(parts - 1))]
    memory = HostMemory(limit=of_host, scratch=tmp_path, owner="test")
    got, shares, trainer = trained(scene, SETTINGS[optimiser], devices, memory=memory)
    assert trainer.plan.streamed
    assert isinstance(trainer.parameters, HostGaussians)
    print(trainer.plan.rows / CHUNK_ROWS, shares, trainer.planner.rows_in_view)
    assert len(shares) == STEPS
    assert_same(got, wanted)
    assert not list(tmp_path.iterdir())
