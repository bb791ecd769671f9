# SPDX-License-Identifier: Apache-2.0
"""Views that show more chunks than the device has slots: memory for their rows, and the bytes of an unlimited model."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calls import noted
from compare import assert_same_bits
from same_bytes import State
from test_visible_chunks import assert_same, state
from tiny import cameras, run_steps, short
from wide import let_small_models_have_chunks, wide_model

from clsplat.chunks.division import listed_chunks
from clsplat.config.checks import parse_bytes
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import CapacityError
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.scenes.scene import Scene
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.training.memory import MemoryPlanner
from clsplat.training.trainer import Trainer

ROWS = 60 * CHUNK_ROWS + 100
IN_VIEW = 19
"""Most chunks of `wide_model(ROWS)` that a view of the tiny scene shows."""
CONFIG = short(iterations=40, report=False, warmup=(), sh_degree=1, sh_degree_every=5, density={"every": 0})
STEPS = 12
LITTLE = 6 << 20
"""Bytes with which there are 2 slots, if memory is set aside for the rows of 19 chunks; by itself the pool would have
6. A plan for the rows of 6 chunks ends at 5 MiB, in the first step."""


@pytest.fixture(autouse=True)
def _small_models_have_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    let_small_models_have_chunks(monkeypatch)


@pytest.fixture
def _nothing_is_known_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MemoryPlanner, "look", lambda *_: None)


def limited(scene: Scene, limit: int) -> Trainer:
    return Trainer(scene, CONFIG, open_device(memory_limit=limit), wide_model(ROWS))


def slots_of(trainer: Trainer) -> int:
    pool = trainer.model._pool
    assert pool is not None
    assert trainer.plan.rows == pool.rows == trainer.parameters.rows
    return pool.slots


@pytest.fixture(scope="module")
def wanted(scene: Scene, default_device: Device) -> State:
    """A training's state without a limit."""
    with pytest.MonkeyPatch.context() as patch:
        let_small_models_have_chunks(patch)
        trainer = Trainer(scene, CONFIG, default_device, wide_model(ROWS))
        run_steps(STEPS, trainer)
        return state(trainer)


@pytest.mark.slow
def test_more_chunks_in_view_than_slots(scene: Scene, wanted: State) -> None:
    """The cameras tell at the start how many rows a view shows, and the pool keeps its size."""
    trainer = limited(scene, LITTLE)
    assert trainer.planner.rows_in_view == CHUNK_ROWS * IN_VIEW
    slots = slots_of(trainer)
    assert slots < IN_VIEW / 4
    run_steps(STEPS, trainer)
    assert slots_of(trainer) == slots
    assert trainer.device.memory.peak <= LITTLE
    assert_same(state(trainer), wanted)
    trainer.close()


@pytest.mark.usefixtures("_nothing_is_known_at_the_start")
def test_the_pool_shrinks_before_a_view_of_more_chunks(
    scene: Scene, wanted: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    noted(monkeypatch, ChunkPool, "resize", lambda _, rows: sizes.append(rows // CHUNK_ROWS))
    limit = 7 << 20
    trainer = limited(scene, limit)
    before = slots_of(trainer)
    run_steps(7, trainer)
    assert trainer.planner.rows_in_view == CHUNK_ROWS * listed_chunks(IN_VIEW)
    trainer.model._before_view(IN_VIEW + 4, IN_VIEW + 4)  # as if a later view showed more
    run_steps(STEPS - 7, trainer)
    assert len(sizes) > 1
    assert [before, *sizes] == sorted({before, *sizes}, reverse=True), "each time it is smaller"
    assert slots_of(trainer) == sizes[-1]
    assert trainer.device.memory.peak <= limit
    assert_same(state(trainer), wanted)
    trainer.close()


def least_of(error: CapacityError) -> int:
    """The least memory that a refusal names."""
    named = re.search(r"(\d+) of them in chunks that a step shows, need at least about ([\d.,]+ \w+)", str(error))
    assert named is not None, error
    least = parse_bytes(re.sub("[ ,]", "", named[2]))
    assert least is not None
    return least


def test_the_least_that_is_named_is_enough(scene: Scene, wanted: State) -> None:
    with pytest.raises(CapacityError) as refused:
        limited(scene, 4 << 20)
    least = least_of(refused.value)
    assert 4 << 20 < least < LITTLE
    trainer = limited(scene, least)
    run_steps(STEPS, trainer)
    assert slots_of(trainer) == 1
    assert trainer.device.memory.peak <= least
    assert_same(state(trainer), wanted)
    trainer.close()


@pytest.mark.usefixtures("_nothing_is_known_at_the_start")
def test_too_little_in_a_step(scene: Scene, default_device: Device, wanted: State) -> None:
    """If a view shows so many chunks that not even one slot is left, the state before the step can be saved."""
    trainer, done = limited(scene, 4 << 20), 0
    slots = slots_of(trainer)
    free = Trainer(scene, CONFIG, default_device, wide_model(ROWS))
    with pytest.raises(CapacityError) as refused:
        for done in range(STEPS):  # noqa: B007
            trainer.train_step()
    assert trainer.step_back()
    assert (trainer.step, slots_of(trainer)) == (done, slots)
    run_steps(done, free)
    assert_same(state(trainer), state(free))
    trainer.close()
    again = limited(scene, max(least_of(refused.value), 5500 << 10))  # later views show more than the one that failed
    run_steps(STEPS, again)
    assert_same(state(again), wanted)
    again.close()


def test_pictures_of_more_chunks_than_slots(scene: Scene, default_device: Device, wanted: State) -> None:
    """They leave the plan as it is, and find the chunks in view also after the step in which SH bands are added."""
    trainer, free = limited(scene, LITTLE), Trainer(scene, CONFIG, default_device, wide_model(ROWS))
    slots, camera = slots_of(trainer), cameras()[0]
    back = replace(camera, translation=camera.translation + np.array([0.0, 0.0, 3.0]))
    for step in range(STEPS):
        trainer.train_step()
        free.train_step()
        pool = trainer.model._pool
        assert pool is not None
        assert pool.cull is not None
        assert slots < len(pool.cull(trainer.local(back)))
        if step in (4, 7):  # bands come in step 5
            assert_same_bits(trainer.draw(back).image, free.draw(back).image)
    assert slots_of(trainer) == slots
    assert trainer.device.memory.peak <= LITTLE
    assert_same(state(trainer), wanted)
    trainer.close()
