# SPDX-License-Identifier: Apache-2.0
"""A scene in blocks that trains in seconds: the tiny scene, its coarse model, and a plan of two blocks."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tiny import CONFIG

from clsplat.api import train
from clsplat.blocks.block_training import LoadScene, TrainRun
from clsplat.blocks.plan import COARSE_FOLDER, Block, BlockPlan, Partition, Rectangle, write_plan
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.files.documents import digest
from clsplat.gaussians import Gaussians
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.scene import Scene
from clsplat.training.start import Start

WHOLE = replace(CONFIG, iterations=60, checkpoint_every=5, report=False)
"""Settings of the whole. The coarse model has a sixth of its steps, at half the size."""
COARSE_STEPS, BLOCK_STEPS, FINISH_STEPS = 10, 16, 6
WIDENING = 0.2


def write_city(city: Path, scene: Path, device: Device, config: TrainConfig = WHOLE) -> BlockPlan:
    """Train the coarse model of the scene in a folder into `city`, and write a plan of two blocks, west and east."""
    half = replace(config, iterations=COARSE_STEPS, resolution=24, warmup=(), eval_at=())
    run = Run.create(city / COARSE_FOLDER, half, scene=scene)
    train(load_scene_of(half, scene), half, run=run, device=device)
    whole, coarse = load_scene_of(config, scene), Gaussians.load(run.model_path)
    plan = BlockPlan(
        scene=scene.absolute(),
        settings=config,
        division=Partition("2"),
        up=(0.0, -1.0, 0.0),
        axes=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        margin=0.2,
        share=0.02,
        coarse=digest(run.model_path),
        extent=whole.extent,
        finish_steps=FINISH_STEPS,
        blocks=blocks_of(whole, coarse),
        photographs=len(whole.train_views),
        gaussians=len(coarse),
    )
    write_plan(city, plan)
    return plan


def blocks_of(scene: Scene, coarse: Gaussians) -> tuple[Block, ...]:
    """Two blocks west and east of 0. All but the last photograph show the first, all but the first the second."""
    names, x = tuple(view.name for view in scene.train_views), coarse.means[:, 0]
    west, east = Rectangle((-inf, -inf), (0.0, inf)), Rectangle((0.0, -inf), (inf, inf))
    wide = Rectangle((-inf, -inf), (WIDENING, inf)), Rectangle((-WIDENING, -inf), (inf, inf))
    inside = int((x < WIDENING).sum()), int((x >= -WIDENING).sum())
    return (
        Block("0_0", west, wide[0], names[:-1], BLOCK_STEPS, inside[0]),
        Block("1_0", east, wide[1], names[1:], BLOCK_STEPS, inside[1]),
    )


def load() -> LoadScene:
    return lambda config, source, frame: load_scene_of(config, source, frame=frame)


def trains_on(device: Device, stops_at: int | None = None) -> TrainRun:
    """Function that trains a run. stops_at: step after which Ctrl-C comes."""

    def run_it(scene: Scene, run: Run, start: Start) -> Gaussians:
        def between(trainer: object, _interrupted: object) -> None:
            if stops_at is not None and trainer.step >= stops_at:  # type: ignore[attr-defined]
                raise KeyboardInterrupt

        return train(scene, run.config, device=device, run=run, resume=run.resuming, start=start, between=between)

    return run_it


def in_cell(model: Gaussians, rectangle: Rectangle) -> NDArray[np.bool_]:
    """Mask of the means in a rectangle on x and z."""
    flat, low, high = model.means[:, [0, 2]], np.array(rectangle.low, np.float32), np.array(rectangle.high, np.float32)
    return np.asarray(((flat >= low) & (flat < high)).all(axis=1))
