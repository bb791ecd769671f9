# SPDX-License-Identifier: Apache-2.0
"""Density control and repairs of a model in a store of chunks: the bytes of one on the device, with little memory."""

from __future__ import annotations

import errno
import os
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import noted
from quick import quick
from same_bytes import State, opened_again
from test_visible_chunks import CONFIG, assert_same, state, wide_model
from tiny import run_steps, short

from clsplat.chunks import gathering
from clsplat.chunks.order import beside_parents
from clsplat.chunks.slot_file import SlotFile
from clsplat.chunks.store import ChunkStore
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import WriteError
from clsplat.files.atomic import write_error
from clsplat.gaussians import floats_of
from clsplat.layouts.columns import CHUNK_ROWS, SPLAT
from clsplat.models.edit import take
from clsplat.scenes.scene import Scene
from clsplat.stages import density
from clsplat.training import moved_rows, trained_model
from clsplat.training.density import ModelState, RowPlan, adaptive
from clsplat.training.density.adaptive import Adaptive, weakest
from clsplat.training.memory import UNLIMITED, HostMemory
from clsplat.training.step import visible_chunks
from clsplat.training.trainer import Trainer

LITTLE = 7 << 20
"""Bytes of device memory, or of main memory, with which a part of `wide_model` is on the device."""
BUDGET = {"growth": "budget", "max_gaussians": 12_500, "opacity_reset_every": 10}
SETTINGS = {
    "growth": CONFIG,
    "budget": short(iterations=40, report=False, warmup=(), density=BUDGET),
    "long axis": short(iterations=40, report=False, warmup=(), density={**BUDGET, "long_axis": True}),
    "pruning": short(
        iterations=40,
        report=False,
        warmup=(),
        density={"min_opacity": 0.2, "prune_every": 7, "max_screen_radius": 9.0, "opacity_reset_every": 0},
    ),
    "thinning": short(
        iterations=40, report=False, warmup=(), thinning=0.4, density={"max_gaussians": 12_500, "stop": 22}
    ),
    "contributions": short(
        iterations=40, report=False, warmup=(), density={"min_contribution": 1e-3, "max_gaussians": 16_000, "stop": 22}
    ),
}


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small models have chunks, and a model of some thousand rows is many parts of each kind."""
    monkeypatch.setattr(visible_chunks, "ORDERED_ROWS", 2 * CHUNK_ROWS)
    for module in (trained_model, moved_rows):
        monkeypatch.setattr(module, "ORDERED_ROWS", 2 * CHUNK_ROWS)
    monkeypatch.setattr(trained_model, "HALVED_ROWS", 50)
    monkeypatch.setattr(density, "LISTED_ROWS", 640)
    monkeypatch.setattr(gathering, "BLOCK_CHUNKS", 1)


Limits = Callable[[], tuple[Device, HostMemory]]


@pytest.fixture(scope="module")
def whole() -> dict[str, State]:
    """States of trainings of SETTINGS on a device, by name: one for all limits."""
    return {}


@pytest.fixture(params=["device", "file"])
def limits(request: pytest.FixtureRequest, default_device: Device, tmp_path: Path) -> Limits:
    """Makes a device and a main memory: chunks in main memory, or in a file."""
    if request.param == "device":
        return lambda: (open_device(memory_limit=LITTLE), UNLIMITED)
    return lambda: (default_device, HostMemory(limit=2 << 20, scratch=tmp_path / "scratch", owner="x"))


def trainer_of(scene: Scene, config: TrainConfig, limits: Limits | Device, **options: Any) -> Trainer:
    """A trainer of `wide_model` under these limits, which has some chunks on the device, or with it all on a device."""
    if isinstance(limits, Device):
        return Trainer(scene, config, limits, wide_model(around=False), **options)
    device, memory = limits()
    trainer = Trainer(scene, config, device, wide_model(around=False), memory=memory, **options)
    pool = trainer.model._pool
    assert pool is not None
    assert pool.slots < pool.store.chunks
    return trainer


def after(steps: int, trainer: Trainer) -> State:
    run_steps(steps, trainer)
    found = state(trainer)
    trainer.close()
    return found


@pytest.mark.parametrize("name", quick(SETTINGS, "growth", "long axis", "pruning"))
def test_the_bytes_of_a_model_on_the_device(
    scene: Scene, default_device: Device, limits: Limits, whole: dict[str, State], monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:  # fmt: skip
    """With clones, halves in several parts, pruned rows, resets, and SH degrees from step 12 and 24 on."""
    if name not in whole:
        whole[name] = after(32, trainer_of(scene, SETTINGS[name], default_device))
    wanted = whole[name]
    moves: list[tuple[int, int]] = []
    noted(monkeypatch, ChunkStore, "move", lambda store, rows, *_: moves.append((store.count, rows is None)))
    trainer = trainer_of(scene, SETTINGS[name], limits)
    run_steps(32, trainer)
    left, path = trainer.model._pool is None, None if (store := trainer.model.store) is None else store.path
    assert_same(after(0, trainer), wanted)
    assert len({count for count, _ in moves}) > 1 or left, "rows move within a store, or leave it"
    assert any(widened for _, widened in moves)
    assert (path is not None) == (limits()[1] is not UNLIMITED) or left
    assert path is None or not path.exists()


@pytest.mark.parametrize("room", [1, 2, 5, 7, 8, 11])
def test_the_weakest_is_that_of_a_stable_sort(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptive, "SCORED_ROWS", 3)
    scores = np.array([4, -1, 2, 4, -2, 0.5, 2, 2, 9, 4, -1, 2, 2], np.float32)
    row = int(np.argsort(-scores, kind="stable")[room - 1])
    assert weakest(scores, room) == (scores[row], row)


def traced(trainer: Trainer) -> tuple[int, int]:
    """Run density control. Returns the peaks of what it allocates: in main memory, and on the device."""
    memory, before = trainer.device.memory, tracemalloc.get_traced_memory()[0]
    memory.peak = used = memory.used
    tracemalloc.reset_peak()
    trainer._control_density()
    return tracemalloc.get_traced_memory()[1] - before, memory.peak - used


def test_no_second_copy_of_the_model(scene: Scene, limits: Limits) -> None:
    """While rows move, main memory has the new rows, a few chunks, and lists. The device has scratch memory as of a
    frame of the rows that it has room for."""
    config = replace(CONFIG, sh_degree=3, sh_degree_every=0)
    tracemalloc.start()
    try:
        trainer = trainer_of(scene, config, limits)
        run_steps(15, trainer)
        count = trainer.parameters.count
        rows = trainer.plan.rows
        host, device = traced(trainer)
        grown = trainer.parameters.count - count
    finally:
        tracemalloc.stop()
    each = 3 * 4 * floats_of(16)
    assert grown > 0
    # 40 and 24 bytes a half are in one part here, 4 in a list; a chunk is read, one written, with their fields
    assert host < each * (grown + 6 * CHUNK_ROWS) + 100 * count
    assert rows < count / 2
    assert device < 4 * len(SPLAT) * rows


def test_what_is_hidden_takes_no_memory_of_the_device(scene: Scene) -> None:
    """Also with contributions: nothing there is as long as the model."""
    config = replace(SETTINGS["contributions"], optimiser=OptimiserConfig(sparse=True))
    model, used = wide_model(around=False), []
    hidden = np.flatnonzero(model.means[:, 1] > 20)
    for copies in (0, 3):
        larger = take(model, np.concatenate([np.arange(len(model)), np.tile(hidden, copies)]))
        larger.means[len(model) :, 1] += 50
        device = open_device(memory_limit=LITTLE)
        trainer = Trainer(scene, config, device, larger)
        run_steps(5, trainer)
        pool = trainer.model._pool
        assert pool is not None
        used.append((len(larger), device.memory.used, pool.slots))
        in_view = trainer.plan.need.row
        trainer.close()
    (few, of_few, slots), (many, of_many, slots_of_many) = used
    assert many > 3 * few
    assert slots == slots_of_many
    # chunks are other ones, of which a view may show one more
    assert of_many - of_few < CHUNK_ROWS * in_view < 8 * (many - few)


class Shuffles(Adaptive):
    """A strategy that lists rows on the host in an order of its own, some of them twice, and gives some a value."""

    def before_step(self, model: ModelState) -> RowPlan:
        rows = model.rng.permutation(model.count)[: model.count - 300].astype(np.uint32)
        rows = np.concatenate([rows, rows[:700]])
        fresh = np.arange(len(rows)) >= model.count - 300
        places = model.rng.permutation(len(rows))[:500]
        values = {"means": (places, model.rng.normal(size=(500, 3)).astype(np.float32))}
        return RowPlan(rows=rows, fresh=fresh, values=values, restarted=("quaternions",))


def test_a_strategy_with_a_list_of_its_own(scene: Scene, default_device: Device, limits: Limits) -> None:
    wanted = after(22, trainer_of(scene, CONFIG, default_device, strategy=Shuffles))
    assert_same(after(22, trainer_of(scene, CONFIG, limits, strategy=Shuffles)), wanted)


class Marked(Adaptive):
    """A strategy that lists rows on the device, and gives some of that list a value."""

    def before_step(self, model: ModelState) -> RowPlan:
        made = super().before_step(model)
        assert made.listed is not None
        places = model.rng.permutation(made.listed.count)[:500]
        return replace(made, values={"sh_dc": (places, model.rng.normal(size=(500, 3)).astype(np.float32))})


def test_values_of_rows_that_a_marker_has_listed(scene: Scene, default_device: Device, limits: Limits) -> None:
    wanted = after(17, trainer_of(scene, CONFIG, default_device, strategy=Marked))
    assert_same(after(17, trainer_of(scene, CONFIG, limits, strategy=Marked)), wanted)


@pytest.mark.parametrize("kept", [CHUNK_ROWS, 2 * CHUNK_ROWS + 5])
def test_a_model_that_becomes_small(scene: Scene, default_device: Device, limits: Limits, kept: int) -> None:
    """It leaves its store, and has its rows in the order of the list if it is no longer large."""

    class Drops(Adaptive):
        def before_step(self, model: ModelState) -> RowPlan:
            made = super().before_step(model)
            assert made.listed is not None
            rows = np.arange(min(kept, model.count), dtype=np.uint32)
            return made if model.step == 15 else RowPlan(rows=rows)

    wanted = after(22, trainer_of(scene, CONFIG, default_device, strategy=Drops))
    assert len(wanted["parameters/means"]) <= kept
    trainer = trainer_of(scene, CONFIG, limits, strategy=Drops)
    assert_same(after(22, trainer), wanted)
    assert trainer.model._pool is None


def test_pruned_by_a_marker_to_a_small_model(scene: Scene, default_device: Device, limits: Limits) -> None:
    density = {"min_opacity": 0.7, "prune_every": 12, "opacity_reset_every": 0}
    config = short(iterations=40, report=False, warmup=(), density=density)
    wanted = after(17, trainer_of(scene, config, default_device))
    assert 0 < len(wanted["parameters/means"]) <= 2 * CHUNK_ROWS
    assert_same(after(17, trainer_of(scene, config, limits)), wanted)


@pytest.mark.parametrize(("kind", "group"), [("parameters", "sh_dc"), ("first", "means"), ("second", "log_scales")])
def test_a_repair(scene: Scene, default_device: Device, limits: Limits, kind: str, group: str) -> None:
    """Of a Gaussian in each chunk, those that no view shows included."""

    def spoilt(limits: Limits | Device) -> tuple[State, Trainer]:
        trainer = trainer_of(scene, CONFIG, limits)
        run_steps(7, trainer)
        array = trainer.model.kinds()[kind][group]
        values = array.get()
        values[5::CHUNK_ROWS, 1] = np.inf
        array.set(values)
        return after(12, trainer), trainer

    wanted, whole = spoilt(default_device)
    got, trainer = spoilt(limits)
    assert_same(got, wanted)
    incidents, expected = trainer.monitor.incidents, whole.monitor.incidents
    assert [str(each) for each in incidents] == [str(each) for each in expected] != []
    for mine, theirs in zip(incidents, expected, strict=True):
        assert mine.gaussians.keys() == theirs.gaussians.keys()
        for name, values in theirs.gaussians.items():
            assert mine.gaussians[name].tobytes() == values.tobytes(), name


def test_a_full_disk_leaves_the_state_before_it(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = HostMemory(limit=2 << 20, scratch=tmp_path / "scratch", owner="x")
    trainer = trainer_of(scene, CONFIG, lambda: (default_device, memory))
    run_steps(15, trainer)

    def full(*_: object) -> None:
        raise write_error(str(tmp_path), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), needs=1)

    with monkeypatch.context() as patch:
        patch.setattr(SlotFile, "write", full)
        with pytest.raises(WriteError):
            trainer.train_step()
    assert trainer.step_back()
    assert len(list((tmp_path / "scratch").iterdir())) == 1
    wanted = after(15, trainer_of(scene, CONFIG, default_device))
    assert_same(state(trainer), wanted)
    trainer.close()


def test_rows_of_a_large_model_rise(scene: Scene, limits: Limits, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a new chunk needs only a run of old ones. A list is put in order piece by piece."""
    trainer = trainer_of(scene, CONFIG, limits)
    sizes: list[int] = []
    noted(monkeypatch, gathering, "beside_parents", lambda sources: sizes.append(len(sources)))
    moved: list[np.ndarray] = []
    noted(monkeypatch, type(trainer.components[-1]), "rows_moved", lambda _, listed: moved.append(listed.get()))
    run_steps(16, trainer)
    (entries,) = moved
    sources = entries & ~moved_rows.FRESH
    assert (np.diff(sources.astype(np.int64)) >= 0).all()
    np.testing.assert_array_equal(beside_parents(sources), np.arange(len(sources)))
    assert len(sizes) > 1
    assert sum(sizes) == len(entries)
    trainer.close()


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "devices"), [(5 << 20, 1), (LITTLE, 1), (LITTLE, 2)])
def test_batches_of_a_pooled_model(scene: Scene, default_device: Device, memory: int, devices: int) -> None:
    """Sums over the views are in main memory, beside the chunks of the pool. It has one slot even if the plan, which
    counts rows here, has room for fewer. Another device's views are added to the statistics part by part."""
    config = short(iterations=8, batch=2, report=False, warmup=(), sh_degree_every=2, density={"every": 3, "start": 2})
    wanted = after(4, trainer_of(scene, config, default_device))
    limited = open_device(memory_limit=memory)
    further = [opened_again(default_device) for _ in range(devices - 1)]
    assert_same(after(4, trainer_of(scene, config, lambda: (limited, UNLIMITED), further=further)), wanted)
