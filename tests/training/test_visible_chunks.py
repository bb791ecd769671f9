# SPDX-License-Identifier: Apache-2.0
"""Steps over the chunks in view: the bytes of steps over the whole model, whatever is repeated or looked at."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import noted
from compare import assert_same_bits
from pipeline import shaped
from quick import quick
from same_bytes import State, make_too_small, outcome, state, stopped
from tiny import cameras, run_steps, short
from wide import ROWS, let_small_models_have_chunks, start_wide, wide_model

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.chunks.bounds import ChunkBounds
from clsplat.chunks.culling import PictureBorders
from clsplat.chunks.order import beside_parents, space_order
from clsplat.chunks.residency import Residency
from clsplat.chunks.store import ChunkStore
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import DriverError
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.scenes.scene import Scene
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.stages.device_gaussians import HostGaussians
from clsplat.training import moved_rows, trained_model
from clsplat.training.density import ModelState, RowPlan
from clsplat.training.density.adaptive import Adaptive
from clsplat.training.memory import UNLIMITED, HostMemory
from clsplat.training.step import gradient_step, visible_chunks
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE
from clsplat.training.step.visible_chunks import Missed, VisibleChunks
from clsplat.training.telemetry import largest_contributions
from clsplat.training.trainer import Trainer

CONFIG = short(iterations=40, report=False, warmup=(), density={"max_gaussians": 16_000})
SPARSE = replace(CONFIG, optimiser=OptimiserConfig(sparse=True))

UNCHANGED_ROWS = short(iterations=40, report=False, warmup=(), density={"every": 0})
COOLED = replace(UNCHANGED_ROWS, optimiser=OptimiserConfig(cooldown=36, cooldown_to=1e-6))


@pytest.fixture(autouse=True)
def _small_models_have_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    let_small_models_have_chunks(monkeypatch)


@pytest.fixture
def shares(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The share of the chunks that may be in view, of each step that looks at its chunks."""
    found: list[float] = []
    real = VisibleChunks.join

    def join(component: VisibleChunks, *arguments: Any) -> Any:
        inputs = real(component, *arguments)
        if (chunks := inputs[0].chunks) is not None:
            found.append(len(chunks.numbers) / len(component._last))
        return inputs

    monkeypatch.setattr(VisibleChunks, "join", join)
    return found


def trained(
    scene: Scene,
    config: TrainConfig,
    device: Device,
    steps: int,
    *,
    whole: bool = False,
    around: bool = True,
    change: Callable[[Trainer], None] = lambda _: None,
    memory: HostMemory = UNLIMITED,
) -> tuple[State, Trainer]:
    """A training's state after some steps. whole: every step runs over the whole model. change: called before them."""
    with pytest.MonkeyPatch.context() as patch:
        if whole:
            patch.setattr(visible_chunks, "ORDERED_ROWS", 1 << 30)
        trainer = Trainer(scene, config, device, wide_model(around=around), memory=memory)
        change(trainer)
        run_steps(steps, trainer)
        return state(trainer), trainer


def assert_same(got: State, wanted: State) -> None:
    assert got.keys() == wanted.keys()
    for name, array in wanted.items():
        assert got[name].shape == array.shape, name
        assert got[name].tobytes() == array.tobytes(), name


SETTINGS = {
    "dense": CONFIG,
    "sparse": SPARSE,
    "thinning and penalties": replace(CONFIG, thinning=0.3, penalty=0.02, background="random"),
    "higher bands wait": replace(CONFIG, optimiser=OptimiserConfig(sh_rest_every=3), sh_degree_every=7),
    "absolute gradients": short(iterations=40, report=False, warmup=(), density={"absolute_gradients": True}),
    "contributions": short(iterations=40, report=False, warmup=(), density={"min_contribution": 1e-6}),
    "exposure": replace(CONFIG, appearance="exposure"),
    "by rays": replace(CONFIG, perspective="rays"),
}


@pytest.fixture(scope="module")
def of_whole() -> dict[tuple[str, Device], State]:
    """States of trainings over the whole model, by settings and device: one for all tests that compare with it."""
    return {}


def whole_state(of_whole: dict[tuple[str, Device], State], scene: Scene, name: str, device: Device) -> State:
    """The state after 32 steps over the whole model. It is trained at the first call."""
    key = (name, device)
    if key not in of_whole:
        of_whole[key], _ = trained(scene, SETTINGS[name], device, 32, whole=True)
    return of_whole[key]


@pytest.mark.parametrize("lanes", quick([8, 1], 8))
@pytest.mark.parametrize("capacity", quick("01", "0"))
@pytest.mark.parametrize("name", quick(SETTINGS, "dense", "sparse"))
def test_the_bytes_of_the_whole_model(
    scene: Scene,
    device: Device,
    shares: list[float],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    capacity: str,
    lanes: int,
    of_whole: dict[tuple[str, Device], State],
) -> None:
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, capacity)
    config, device = SETTINGS[name], device if lanes > 1 else shaped(device, 1, 64)
    wanted = whole_state(of_whole, scene, name, device)
    assert not shares
    got, trainer = trained(scene, config, device, 32)
    assert_same(got, wanted)
    assert trainer.parameters.count > 2 * CHUNK_ROWS
    assert len(shares) == 32
    assert min(shares) < visible_chunks.MAX_SHARE_IN_VIEW, "some steps leave chunks out"


LIMITS = {
    "device 4 MiB": (4 << 20, None),
    "device 7 MiB": (7 << 20, None),
    "device 6.5 MiB, memory of its own": (13 << 19, None),
    "host 1 MiB": (None, 1 << 20),
    "host 5 MiB": (None, 5 << 20),
}
"""Limits of memory, of the device and of the host, at which the pool has room for 3, 6, 5, 1 and 7 of the 12 chunks;
6 are in view. A host limit puts the chunks into a file. A device with memory of its own fetches chunks ahead."""


@pytest.mark.parametrize("optimiser", quick(["dense", "sparse"], "dense"))
@pytest.mark.parametrize("name", LIMITS)
def test_a_streamed_model(
    scene: Scene, default_device: Device, shares: list[float], tmp_path: Path, optimiser: str, name: str,
    of_whole: dict[tuple[str, Device], State],
) -> None:  # fmt: skip
    """At every limit the model has the bytes of one that is on the device."""
    wanted = whole_state(of_whole, scene, optimiser, default_device)
    of_device, of_host = LIMITS[name]
    device = default_device if of_device is None else open_device(memory_limit=of_device)
    if name == "device 6.5 MiB, memory of its own":
        device.shares_memory = False
    memory = HostMemory(limit=of_host, scratch=tmp_path, owner="test")
    placed: list[int] = []
    ahead: list[bool] = []
    with pytest.MonkeyPatch.context() as patch:
        noted(patch, ChunkPool, "place", lambda _, numbers, **__: placed.append(len(numbers)))
        noted(patch, Residency, "plan_ahead", lambda *_: ahead.append(True))
        got, trainer = trained(scene, SETTINGS[optimiser], device, 32, memory=memory)
    assert bool(ahead) != device.shares_memory
    assert trainer.plan.streamed
    assert min(shares) < 1, "some steps leave chunks out"
    assert 0 < max(placed) <= trainer.plan.rows // CHUNK_ROWS < trainer.parameters.count / CHUNK_ROWS
    assert len(list(tmp_path.iterdir())) == (of_host is not None)
    assert_same(got, wanted)
    trainer.close()
    assert not list(tmp_path.iterdir()), "the file of chunks is gone"


def test_the_chunks_of_the_next_view_are_read_ahead(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step uses none that was neither on the device nor asked for, unless it begins a pass, whose first view was not
    known before."""
    asked: list[int] = []
    placed: list[int] = []
    noted(monkeypatch, ChunkStore, "read_ahead", lambda _, numbers: asked.extend(numbers))
    noted(monkeypatch, ChunkPool, "place", lambda _, numbers, **__: placed.extend(numbers))
    memory = HostMemory(limit=LIMITS["host 1 MiB"][1], scratch=tmp_path, owner="test")
    trainer = Trainer(scene, SPARSE, default_device, wide_model(), memory=memory)
    used: set[int] = set()
    for _ in range(11):  # until the SH degree rises
        asked.clear()
        placed.clear()
        begins, there = not trainer.position.queue, used
        trainer.train_step()
        assert begins or set(placed) <= there
        assert bool(asked) == bool(trainer.position.queue)
        assert isinstance(trainer.parameters, HostGaussians)
        pool = trainer.parameters.pool
        assert pool is not None
        used = {*asked, *(number for number in range(pool.store.chunks) if pool.slots_of(np.array([number]))[0] >= 0)}
    trainer.close()


def depth_of(trainer: Trainer, camera: Camera) -> Float32:
    model, camera = trainer.complete_parameters, trainer.local(camera)
    return trainer.renderer.render_channels(model, camera, ["depth"])[1]["depth"]


@pytest.mark.parametrize("optimiser", ["dense", "sparse"])
def test_a_look_at_a_streamed_model(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, optimiser: str
) -> None:
    """Pictures of a model in training show the same at every limit, and change no byte of it."""
    config, memory = SETTINGS[optimiser], HostMemory(limit=1 << 20, scratch=tmp_path, owner="test")
    free, limited = Trainer(scene, config, default_device, wide_model()), None
    limited = Trainer(scene, config, default_device, wide_model(), memory=memory)
    for step in range(24):
        free.train_step()
        limited.train_step()
        if step % 4 == 0:
            camera = cameras()[step % 5]
            assert_same_bits(limited.draw(camera).image, free.draw(camera).image)
            assert_same_bits(depth_of(limited, camera), depth_of(free, camera))
        if step % 7 == 0:
            some = limited.rows()(100, 3000)
            assert_same_bits(some.sh, free.gaussians().sh[100:3000])
    assert_same(state(limited), state(free))


@pytest.mark.parametrize("optimiser", ["dense", "sparse"])
@pytest.mark.parametrize("steps", [(7,), (12, 13), (15, 25), (32,)])
def test_steps_that_are_repeated(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch, optimiser: str, steps: Collection[int],
    of_whole: dict[tuple[str, Device], State],
) -> None:  # fmt: skip
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    config = SETTINGS[optimiser]
    wanted = whole_state(of_whole, scene, optimiser, default_device)
    got, trainer = trained(scene, config, default_device, 32, change=lambda t: make_too_small(monkeypatch, t, steps))
    assert trainer.pending.redone > 0
    assert_same(got, wanted)


@pytest.mark.parametrize("capacity", quick(["0", "1"], "1"))
def test_a_model_that_grows_into_chunks(
    scene: Scene, default_device: Device, shares: list[float], monkeypatch: pytest.MonkeyPatch, capacity: str
) -> None:
    """The first chunks come in the middle of a training, and are caught up from there."""
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, capacity)
    for module in (visible_chunks, trained_model, moved_rows):
        monkeypatch.setattr(module, "ORDERED_ROWS", ROWS + 20)
    wanted, _ = trained(scene, CONFIG, default_device, 32, whole=True)
    sorted_means: list[np.ndarray[Any, Any]] = []
    noted(monkeypatch, moved_rows, "space_order", sorted_means.append)
    got, trainer = trained(scene, CONFIG, default_device, 32)
    assert_same(got, wanted)
    assert [len(means) > ROWS + 20 for means in sorted_means] == [True], "its rows are put in order once"
    assert trainer.parameters.count > ROWS + 20
    assert 0 < len(shares) <= 17, "from density control after step 15 on"


def test_chunks_are_caught_up_in_time(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch, of_whole: dict[tuple[str, Device], State]
) -> None:
    wanted = whole_state(of_whole, scene, "dense", default_device)
    for most, measured in ((5, 1), (3, 7), (1, 16)):
        monkeypatch.setattr(visible_chunks, "MOST_MISSED_STEPS", most)
        monkeypatch.setattr(visible_chunks, "STEPS_PER_MEASUREMENT", measured)
        calls: list[tuple[Any, ...]] = []
        with monkeypatch.context() as patch:
            noted(patch, VisibleChunks, "_catch_up", partial(note, calls))
            got, _ = trained(scene, CONFIG, default_device, 32)
        assert_same(got, wanted)
        missed: list[Missed] = [call[-1] for call in calls]
        assert 0 < max(each.step - int(each.last.min()) for each in missed) <= most + measured


def note(calls: list[tuple[Any, ...]], *arguments: Any) -> None:
    calls.append(arguments)


def test_a_look_changes_no_byte(
    scene: Scene, default_device: Device, of_whole: dict[tuple[str, Device], State]
) -> None:
    wanted = whole_state(of_whole, scene, "dense", default_device)
    trainer = Trainer(scene, CONFIG, default_device, wide_model())
    for step in range(32):
        trainer.train_step()
        if step % 3 == 0:
            trainer.draw(cameras()[step % 5])
        if step % 5 == 0:
            trainer.gaussians()
        if step % 7 == 0:
            trainer.checkpoint()
    assert_same(state(trainer), wanted)


@pytest.fixture
def _starts_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    start_wide(monkeypatch)


@pytest.mark.usefixtures("_starts_wide")
@pytest.mark.parametrize("step", [13, 20])
def test_interrupted_and_resumed(scene: Scene, default_device: Device, tmp_path: Path, step: int) -> None:
    config = replace(CONFIG, checkpoint_every=0)
    wanted = outcome(scene, config, default_device, tmp_path / "undisturbed")
    assert_same(stopped(step, scene, config, default_device, tmp_path / "stopped"), wanted)


def test_a_step_that_fails_leaves_the_state_before_it(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch, of_whole: dict[tuple[str, Device], State]
) -> None:
    wanted = whole_state(of_whole, scene, "dense", default_device)
    trainer = Trainer(scene, CONFIG, default_device, wide_model())
    run_steps(22, trainer)
    with monkeypatch.context() as patch:
        patch.setattr(gradient_step, "loss", fail)
        with pytest.raises(DriverError):
            trainer.train_step()
    assert trainer.step_back()
    saved, _ = trainer.checkpoint()
    run_steps(10, trainer)
    assert_same(state(trainer), wanted)
    before, _ = trained(scene, CONFIG, default_device, 22, whole=True)
    assert_same(saved, before)


def fail(*_: object, **__: object) -> None:
    raise DriverError("the loss failed")


def test_a_model_that_becomes_large(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch, shares: list[float]
) -> None:
    """The steps before ran over all rows. They are more than the table of missed steps holds."""
    monkeypatch.setattr(visible_chunks, "MOST_MISSED_STEPS", 1)
    monkeypatch.setattr(visible_chunks, "STEPS_PER_MEASUREMENT", 1)
    for module in (trained_model, moved_rows):
        monkeypatch.setattr(module, "ORDERED_ROWS", ROWS)
    wanted, _ = trained(scene, CONFIG, default_device, 32, whole=True)
    monkeypatch.setattr(visible_chunks, "ORDERED_ROWS", ROWS)
    got, trainer = trained(scene, CONFIG, default_device, 32)
    assert trainer.parameters.count > ROWS
    assert 0 < len(shares) < 32
    assert_same(got, wanted)


def bounds_of(trainer: Trainer) -> ChunkBounds:
    return ChunkBounds.measured(*(trainer.parameters[group].get() for group in ("means", "log_scales")))


def moving(scene: Scene, config: TrainConfig, device: Device) -> Trainer:
    """A trainer of a model that moves by its first moments, as much as these could be after many steps."""
    trainer = Trainer(scene, config, device, wide_model())
    for group in ("means", "log_scales"):
        trainer.model.first[group].fill(-7e-3)
        trainer.model.second[group].fill(1e-6)
    return trainer


@pytest.mark.parametrize("share", [0.1, 0.6])
@pytest.mark.parametrize("measured", [1, 8])
@pytest.mark.parametrize("config", [UNCHANGED_ROWS, COOLED], ids=["constant rates", "cooldown"])
def test_bounds_hold(
    scene: Scene,
    default_device: Device,
    monkeypatch: pytest.MonkeyPatch,
    config: TrainConfig,
    measured: int,
    share: float,
) -> None:
    """Gaussians of a training over the whole model are in the bounds that a step over chunks reckons with, after steps
    over all chunks, looks at the model, and steps with larger rates."""
    monkeypatch.setattr(visible_chunks, "MAX_SHARE_IN_VIEW", share)
    monkeypatch.setattr(visible_chunks, "STEPS_PER_MEASUREMENT", measured)
    wanted: list[ChunkBounds] = []
    with monkeypatch.context() as patch:
        patch.setattr(visible_chunks, "ORDERED_ROWS", 1 << 30)
        trainer = moving(scene, config, default_device)
        for _ in range(40):
            wanted.append(bounds_of(trainer))
            trainer.train_step()
    given: list[ChunkBounds] = []
    real = visible_chunks.visible

    def visible(picture: PictureBorders, bounds: ChunkBounds) -> Any:
        given.append(bounds)
        return real(picture, bounds)

    monkeypatch.setattr(visible_chunks, "visible", visible)
    trainer = moving(scene, config, default_device)
    for step in range(40):
        if step % 9 == 4:
            trainer.draw(cameras()[0])
        trainer.train_step()
    assert len(given) == len(wanted)
    for inside, outside in zip(wanted, given, strict=True):
        assert (outside.lowest <= inside.lowest).all()
        assert (inside.highest <= outside.highest).all()
        assert (inside.terms[6] <= outside.terms[6]).all()


def test_largest_contributions_are_of_the_whole_model(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for most in (1 << 30, 2 * CHUNK_ROWS):
        monkeypatch.setattr(visible_chunks, "ORDERED_ROWS", most)
        trainer = moving(scene, CONFIG, default_device)
        run_steps(8, trainer)
        found.append(largest_contributions(trainer, seconds=100)[0])
    np.testing.assert_array_equal(*found)


class Dims(Adaptive):
    """A strategy that looks at the model after each step, and changes Gaussians by what it sees."""

    def after_gradient(self, model: ModelState) -> RowPlan:
        """Move a Gaussian of each chunk."""
        rows = np.arange(0, model.count, CHUNK_ROWS)
        return RowPlan(values={"sh_dc": (rows, 0.9 * model.parameters["sh_dc"].get()[rows])})


def test_a_strategy_that_looks_at_each_step(scene: Scene, default_device: Device) -> None:
    found = []
    for most in (1 << 30, 2 * CHUNK_ROWS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(visible_chunks, "ORDERED_ROWS", most)
            trainer = Trainer(scene, CONFIG, default_device, wide_model(), strategy=Dims)
            run_steps(20, trainer)
            found.append(state(trainer))
    assert_same(*found)


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        replace(CONFIG, batch=2, thinning=0.3),
        replace(CONFIG, antialiased=True),
        replace(CONFIG, refine_poses=True),
        replace(CONFIG, optimiser=OptimiserConfig(late=True)),
        short(iterations=40, report=False, density={"growth": "mcmc", "max_gaussians": 9000}),
    ],
    ids=["batch with thinning", "antialiased", "poses", "late", "mcmc"],
)
def test_other_steps_take_the_whole_model(
    scene: Scene, default_device: Device, shares: list[float], config: TrainConfig
) -> None:
    trainer = Trainer(scene, config, default_device, wide_model())
    run_steps(2, trainer)
    assert not shares


def test_a_small_model_keeps_its_order(scene: Scene, default_device: Device, shares: list[float]) -> None:
    model = wide_model(2 * CHUNK_ROWS)
    trainer = Trainer(scene, CONFIG, default_device, model)
    np.testing.assert_array_equal(trainer.parameters["means"].get(), model.means)
    run_steps(2, trainer)
    assert not shares


def test_new_rows_follow_their_parents(scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    model = wide_model()
    trainer = Trainer(scene, CONFIG, default_device, model)
    np.testing.assert_array_equal(trainer.parameters["means"].get(), model.means[space_order(model.means)])
    moved: list[np.ndarray[Any, Any]] = []
    monkeypatch.setattr(VisibleChunks, "rows_moved", lambda _, listed: moved.append(listed.get()))
    plans: list[np.ndarray[Any, Any]] = []
    noted(monkeypatch, moved_rows, "beside_parents", plans.append)
    run_steps(16, trainer)
    (entries,), (sources,) = moved, plans
    assert (np.diff(sources.astype(np.int64)) < 0).any(), "density control adds new rows at the end"
    old = entries & ~moved_rows.FRESH
    assert (np.diff(old.astype(np.int64)) >= 0).all()
    np.testing.assert_array_equal(old, sources[beside_parents(sources)])
