# SPDX-License-Identifier: Apache-2.0
"""Trainings whose Gaussians are in a scratch file, stopped and resumed: settings, fixtures, and what a run has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tiny import short
from wide import let_small_models_have_chunks, start_wide

from clsplat.api import train
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer

LIMIT = 4 << 20
"""Bytes of main memory with which `wide_model` is in a scratch file."""
DENSE = short(
    iterations=26, report=False, warmup=(), sh_degree_every=1, checkpoint_every=4, density={"max_gaussians": 16_000}
)
SPARSE = replace(DENSE, optimiser=OptimiserConfig(sparse=True))
STEADY = replace(DENSE, density=replace(DENSE.density, every=0))
"""A training whose rows do not move, so that all checkpoints are in one file."""
SPARE = replace(SPARSE, density=STEADY.density)
SETTINGS = {"dense": DENSE, "sparse": SPARSE, "rows that stay": STEADY, "chunks that stay": SPARE}


@pytest.fixture
def starts_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every training starts from a model with chunks, most of which no view shows."""
    let_small_models_have_chunks(monkeypatch)
    start_wide(monkeypatch, around=False)


Train = Callable[..., Run]


@pytest.fixture
def go(scene: Scene, default_device: Device, tmp_path: Path) -> Train:
    """Function that trains in tmp_path/run, or another folder there, and returns the run.

    until: step before which the training is stopped without a word, as by a kill; None for its end.
    each: called before each step with the trainer.
    """

    def train_run(
        config: TrainConfig = STEADY,
        *,
        until: int | None = None,
        name: str = "run",
        limit: int | None = LIMIT,
        each: Callable[[Trainer], object] = lambda _: None,
        **options: Any,
    ) -> Run:
        folder = tmp_path / name
        run = Run.create(folder, config, resume=folder.exists())

        def between(trainer: Trainer, _: object) -> None:
            each(trainer)
            if trainer.step == until:
                trainer.model.close = lambda: None  # type: ignore[method-assign]  # a killed process removes nothing
                raise KilledError

        options = {"max_host_mem": limit, "between": between, **options}
        try:
            train(scene, config, device=default_device, run=run, resume=run.resuming, **options)
        except KilledError:
            assert until is not None
        return run

    return train_run


class KilledError(Exception):
    """The end of a process."""


@pytest.fixture
def whole(go: Train) -> Callable[[TrainConfig], bytes]:
    """Bytes of model.ply of a training without a limit."""

    def model(config: TrainConfig) -> bytes:
        if repr(config) not in _MODELS:
            _MODELS[repr(config)] = go(config, name="whole", limit=None).model_path.read_bytes()
        return _MODELS[repr(config)]

    return model


_MODELS: dict[str, bytes] = {}
"""Models of trainings that others are compared with, by their settings."""


def files_of(run: Run) -> list[Path]:
    return sorted(run.scratch_path.glob("*"))


def steps_of(run: Run) -> list[int]:
    return [step for step, _ in run.checkpoints()]
