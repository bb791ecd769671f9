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
from same_bytes import State, opened_again, outcome, state, stopped
from test_visible_chunks import assert_same
from tiny import cameras, run_steps, short
from wide import ROWS, let_small_models_have_chunks, start_wide, wide_model

from clsplat.chunks.division import chunks_of
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import DriverError
from clsplat.gaussians import floats_of
from clsplat.layouts.columns import CHUNK_ROWS, SPLAT
from clsplat.scenes.scene import Scene
from clsplat.stages.device_gaussians import HostGaussians
from clsplat.training.batches.batch_chunks import BatchChunks
from clsplat.training.memory import UNLIMITED, HostMemory
from clsplat.training.step import gradient_step, visible_chunks
from clsplat.training.step.inputs import ViewInputs
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
    assert len(shares) == STEPS or (name in ("contributions", "by rays") and len(shares) >= 4), "some show too much"
    assert 0.2 < min(shares) < 0.9, "steps leave chunks out, and views differ"
    assert trainer.parameters.count > 2 * CHUNK_ROWS


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 4])
def test_other_kernel_shapes(scene: Scene, default_device: Device, lanes: int) -> None:
    """Against the same shape's steps over the whole model."""
    device = shaped(default_device, lanes, 64 if lanes == 1 else 1)
    wanted, _, _ = trained(scene, CONFIG, [device], whole=True)
    got, shares, _ = trained(scene, CONFIG, [device])
    assert_same(got, wanted)
    assert len(shares) == STEPS


@pytest.mark.parametrize("optimiser", quick(["dense", "sparse"], "dense"))
@pytest.mark.parametrize("name", quick(LIMITS, "device 5 MiB"))
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
    assert len(shares) == STEPS
    assert_same(got, wanted)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("limit", quick(["", "3 MiB"], "3 MiB"))
def test_a_further_device_with_little_memory(
    scene: Scene, default_device: Device, of_whole: Callable[..., State], limit: str
) -> None:
    """It gets the chunks of its views a few rows at a time."""
    further = opened_again(default_device)
    if limit:
        further = further.with_memory_limit(3 << 20)
    got, shares, trainer = trained(scene, CONFIG, [default_device, further])
    assert trainer.batch is not None
    (replica,) = trainer.batch.replicas
    assert replica.plan is not None
    assert replica.plan.streamed == bool(limit)
    assert isinstance(replica.parameters, HostGaussians) == bool(limit)
    assert len(shares) == STEPS
    assert_same(got, of_whole(scene, "dense", default_device))


def test_a_step_moves_what_its_views_show(scene: Scene, default_device: Device) -> None:
    """Parameters of the chunks of the other device's view there, and its gradients and statistics back."""
    config = replace(CONFIG, batch=2, density=replace(CONFIG.density, every=0), sh_degree_every=0, sh_degree=1)
    sent: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        real = BatchChunks.parameters

        def parameters(chunks: BatchChunks, inputs: ViewInputs, *arguments: Any) -> Any:
            assert inputs.chunks is not None
            sent.append(len(inputs.chunks.in_view))
            return real(chunks, inputs, *arguments)

        patch.setattr(BatchChunks, "parameters", parameters)
        trainer = Trainer(scene, config, default_device, wide_model(), further=[opened_again(default_device)])
        run_steps(3, trainer)
        trainer.close()
    assert trainer.batch is not None
    assert trainer.parameters.count == ROWS
    short_chunk = CHUNK_ROWS - ROWS % CHUNK_ROWS  # rows that the last chunk lacks
    floats = floats_of(4)
    of_view = 2 * floats + 1 + len(SPLAT) + 2  # parameters, gradients, tile counts, splats, gradients on the screen
    most, least = 4 * of_view * CHUNK_ROWS * sum(sent), 4 * of_view * (CHUNK_ROWS * sum(sent) - 3 * short_chunk)
    assert len(sent) == 3
    assert max(sent) < chunks_of(ROWS)
    assert least <= trainer.batch.moved_bytes <= most


def test_a_look_changes_no_byte(scene: Scene, default_device: Device, of_whole: Callable[..., State]) -> None:
    trainer = Trainer(scene, CONFIG, default_device, wide_model())
    for step in range(STEPS):
        trainer.train_step()
        if step % 3 == 0:
            trainer.draw(cameras()[step % 5])
        if step % 4 == 0:
            trainer.checkpoint()
    assert_same(state(trainer), of_whole(scene, "dense", default_device))


@pytest.mark.parametrize("batch", quick([2, 4], 4))
@pytest.mark.parametrize("step", quick([13, 20], 20))
def test_interrupted_and_resumed(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, batch: int
) -> None:
    start_wide(monkeypatch)
    config = replace(CONFIG, batch=batch, checkpoint_every=0)
    wanted = outcome(scene, config, default_device, tmp_path / "undisturbed")
    assert_same(stopped(step, scene, config, default_device, tmp_path / "stopped"), wanted)


def test_a_step_that_fails_leaves_the_state_before_it(
    scene: Scene, default_device: Device, of_whole: Callable[..., State]
) -> None:
    trainer = Trainer(scene, CONFIG, default_device, wide_model())
    run_steps(7, trainer)  # no epoch begins with the next view
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gradient_step, "loss", fail)
        with pytest.raises(DriverError):
            trainer.train_step()
    assert trainer.step_back()
    trainer.checkpoint()
    run_steps(3, trainer)
    assert_same(state(trainer), of_whole(scene, "dense", default_device))


def fail(*_: object, **__: object) -> None:
    raise DriverError("the loss failed")


def test_chunks_are_caught_up_in_time(scene: Scene, default_device: Device, of_whole: Callable[..., State]) -> None:
    """With missed steps counted in Adam's steps, not in views, and bounds that are measured seldom or always."""
    for most, measured in ((2, 1), (1, 3)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(visible_chunks, "MOST_MISSED_STEPS", most)
            patch.setattr(visible_chunks, "STEPS_PER_MEASUREMENT", measured)
            got, _, _ = trained(scene, CONFIG, [default_device])
        assert_same(got, of_whole(scene, "dense", default_device))


def test_views_that_show_nothing(scene: Scene, default_device: Device) -> None:
    """Also on a further device."""
    model = wide_model()
    model.means += 1e4
    found = []
    for most in (1 << 30, 2 * CHUNK_ROWS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(visible_chunks, "ORDERED_ROWS", most)
            trainer = Trainer(scene, CONFIG, default_device, model, further=[opened_again(default_device)])
            run_steps(3, trainer)
            found.append(state(trainer))
            trainer.close()
    assert_same(*found)
