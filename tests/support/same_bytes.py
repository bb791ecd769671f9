# SPDX-License-Identifier: Apache-2.0
"""Bytes of trained models, for tests of resumed trainings and of trainings with less memory, with every setting."""

from __future__ import annotations

import signal
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare import assert_same_arrays
from depths import add_maps, add_tracks
from numpy.typing import NDArray
from tiny import short, write_scene

from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.runs.run import Run
from clsplat.scenes.depth_sources import with_depths
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE
from clsplat.training.trainer import Trainer

PLAIN = short(iterations=48, report=False, density={"min_contribution": 0.01})
MCMC = {"growth": "mcmc", "max_gaussians": 150, "min_opacity": 0.03, "max_screen_radius": 30.0}
BUDGET = {"growth": "budget", "max_gaussians": 120}
SETTINGS: dict[str, TrainConfig] = {
    "plain": PLAIN,
    "background": replace(PLAIN, background="random"),
    "thinning": replace(PLAIN, thinning=0.5),
    "penalty": replace(PLAIN, penalty=0.5),
    "exposure": replace(PLAIN, appearance="exposure"),
    "ppisp": replace(PLAIN, appearance="ppisp"),
    "grid": replace(PLAIN, appearance="grid"),
    "MCMC": short(iterations=48, report=False, density=MCMC),
    "long axis": short(iterations=48, report=False, density={**BUDGET, "long_axis": True}),
    "contributions": short(
        iterations=48, report=False, density={**BUDGET, "min_contribution": 2.0, "prune_every": 6}
    ),
    "absolute": short(iterations=48, report=False, density={"min_contribution": 0.05, "absolute_gradients": True}),
    "antialiased": replace(PLAIN, antialiased=True),
    "ignored": replace(PLAIN, masks="ignore", alpha="transparent"),
    "transparent": replace(PLAIN, masks="transparent"),
    "shortcuts": replace(PLAIN, optimiser=replace(PLAIN.optimiser, sparse=True, sh_rest_every=3)),
    "late": replace(PLAIN, thinning=0.5, optimiser=replace(PLAIN.optimiser, late=True, sh_rest_every=2)),
    "points": replace(PLAIN, depth="points", depth_weight=0.05),
    "maps": replace(PLAIN, depth="maps", thinning=0.2, penalty=0.01),
    "poses": replace(PLAIN, refine_poses=True, refine_gate=0.0),
    "lenses": replace(PLAIN, refine_lenses=True, refine_gate=0.0),
    "cameras": replace(PLAIN, refine_poses=True, refine_lenses=True),
    "rays": replace(PLAIN, perspective="rays"),
    "rays, refined": replace(PLAIN, perspective="rays", antialiased=True, refine_poses=True),
    "rays in batches": replace(PLAIN, perspective="rays", batch=2),
    "batch": replace(PLAIN, batch=2, thinning=0.3),
    "all": replace(
        short(iterations=48, report=False, density=MCMC),
        thinning=0.3, appearance="exposure", antialiased=True, masks="ignore",
    ),
}  # fmt: skip
"""Trainings by name. Each has density control, a rising SH degree and a rising resolution."""

State = Mapping[str, NDArray[Any]]


def write_known_scene(folder: Path) -> Path:
    """Write the tiny scene with alpha, masks and known depths. Each mask has another number of pixels."""
    scene = write_scene(folder, alpha=True)
    (scene / "masks").mkdir()
    for index, path in enumerate(sorted((scene / "images").iterdir())):
        mask = np.ones_like(read_image(path)[:, :, :3])
        mask[5:23, 2 * index : 3 * index + 9] = 0
        write_image(scene / "masks" / f"{path.name}.png", mask)
    add_maps(scene)
    add_tracks(scene)
    return scene


def scene_for(folder: Path, config: TrainConfig) -> Scene:
    """Load the scene of `write_known_scene` with the masks and depths that these settings use."""
    return with_depths(load_scene(folder, masks=config.mask_use), config.depth_use)


def trained_run(scene: Scene, config: TrainConfig, device: Device, folder: Path, **options: Any) -> Run:
    """Train in this folder, and return the run. options: arguments of `train`."""
    run = Run.create(folder, config, resume=options.get("resume", False))
    train(scene, config, device=device, run=run, **options)
    return run


def model_bytes(scene: Scene, config: TrainConfig, device: Device, folder: Path, **options: Any) -> bytes:
    """Bytes of model.ply after a training."""
    return trained_run(scene, config, device, folder, **options).model_path.read_bytes()


@pytest.fixture(scope="module")
def undisturbed(request: pytest.FixtureRequest, default_device: Device, tmp_path_factory: Any) -> bytes:
    """Bytes of model.ply after an uninterrupted training with the module's CONFIG and fixture `scene`."""
    scene = request.getfixturevalue("scene")
    return model_bytes(scene, request.module.CONFIG, default_device, tmp_path_factory.mktemp("undisturbed"))


def outcome(scene: Scene, config: TrainConfig, device: Device, folder: Path, **options: Any) -> State:
    """Train, and return the arrays of the last checkpoint, and model.ply."""
    model_bytes(scene, config, device, folder, **options)
    return state_of(Run.open(folder))


def state_of(run: Run) -> State:
    """Arrays of a run's last checkpoint, and its model.ply."""
    checkpoint = run.load_latest_checkpoint()
    assert checkpoint is not None
    return {"model.ply": np.frombuffer(run.model_path.read_bytes(), np.uint8), **checkpoint.arrays}


def stopped(step: int, scene: Scene, config: TrainConfig, device: Device, folder: Path) -> State:
    """The outcome of a training that was interrupted by Ctrl-C at a step, and resumed."""

    def press(trainer: Trainer, _: object) -> None:
        if trainer.step < step <= trainer.step + config.batch:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(scene, config, device=device, run=Run.create(folder, config), between=press)
    run = Run.create(folder, config, resume=True)
    assert max(number for number, _ in run.checkpoints()) in range(step, step + config.batch)
    return gone_on(scene, config, device, run)


def gone_on(scene: Scene, config: TrainConfig, device: Device, run: Run) -> State:
    """Resume the training of a run, and return its outcome."""
    train(scene, config, device=device, run=run, resume=True)
    return state_of(run)


def make_too_small(monkeypatch: pytest.MonkeyPatch, trainer: Trainer, steps: Collection[int]) -> None:
    """Let passes by capacity of these steps have a capacity of only 8 pairs, so that the steps are repeated."""
    real = trainer.pending.room
    monkeypatch.setattr(
        trainer.pending, "room", lambda *size: (room := real(*size)) and (8 if trainer.step in steps else room)
    )


Stepped = tuple[State, list[tuple[float, float]], Trainer]


def stepped(
    scene: Scene,
    config: TrainConfig,
    device: Device,
    monkeypatch: pytest.MonkeyPatch,
    *,
    capacity: bool,
    too_small: Collection[int] = (),
    before: Callable[[Trainer], object] = lambda _: None,
) -> Stepped:
    """Train, and return the arrays of a checkpoint, the losses that were read, and the trainer.

    capacity: True for passes by capacity, False for exact counts.
    too_small: steps for `make_too_small`.
    before: called with the trainer before each step.
    """
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "01"[capacity])
    trainer, losses = Trainer(scene, config, device), []
    make_too_small(monkeypatch, trainer, too_small)
    while trainer.step < config.iterations:
        before(trainer)
        result = trainer.train_step(reads_loss=trainer.step % 10 == 9)
        if trainer.step % 10 == 0 or trainer.step == 17:
            losses.append(result.read())
    return trainer.checkpoint()[0], losses, trainer


def assert_alike(one: Stepped, other: Stepped) -> None:
    """Fail unless arrays, losses and incidents of two trainings are equal."""
    assert_same_arrays(one[0], other[0])
    assert one[1] == other[1]
    assert list(map(str, one[2].monitor.incidents)) == list(map(str, other[2].monitor.incidents))


def opened_again(device: Device) -> Device:
    """The device with another context, queue and kernels, as another thread needs them."""
    return Device(device.cl_device, device.shape)


def state(trainer: Trainer) -> State:
    """All arrays of a checkpoint, with those of Gaussians that are in a scratch file."""
    saved = {name: array.copy() for name, array in trainer.checkpoint()[0].items() if not name.startswith("chunks/")}
    return saved | trainer.model.arrays()
