# SPDX-License-Identifier: Apache-2.0
"""Functions that the verbs about blocks share: how a scene is loaded, a run trained, and the result printed."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from clsplat.cli.eval import print_summary
from clsplat.cli.session import Services, load_scene
from clsplat.cli.training_run import TrainingMachine, TrainingProgress, tell_of_training, train_run

if TYPE_CHECKING:
    from clsplat.blocks.block_training import LoadScene, TrainRun
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene
    from clsplat.training.start import Start

CityFolder = Annotated[Positional[Path], arg(metavar="CITY")]


def loader(services: Services) -> LoadScene:
    """Return a function that loads a scene, and prints its warnings."""
    return lambda config, source, frame: load_scene(services, source, config, frame=frame)


def trainer(services: Services, machine: TrainingMachine, progress: TrainingProgress = "auto") -> TrainRun:
    """Return a function that trains a run on this machine. Raises DeviceError.

    progress: how progress is written (`TrainProgress`).
    """
    from clsplat.selftest.result import stages_of_training

    opened = machine.open_all(services)

    def train(scene: Scene, run: Run, start: Start) -> None:
        stages = stages_of_training(run.config, region=start.region is not None)
        devices = [services.require(device, stages) for device in opened]
        run.resume_command = shlex.join([*shlex.split(run.resume_command), *machine.flags])
        tell_of_training(scene, run.config, devices)
        train_run(services, scene, run, devices, machine, start=start, progress=progress)
        print(f"model in {run.model_path}", file=sys.stderr)

    return train


def tell_of_city(city: Path, *, as_json: bool) -> None:
    """Print the evaluation of a finished city, if views are held out. as_json: True to print it as JSON."""
    from clsplat.runs.run import Run

    path = Run.open(city).eval_path
    result = json.loads(path.read_text("utf-8")) if path.exists() else None
    if as_json:
        print(json.dumps(result, indent=2))
    elif result is not None:
        print_summary(result)
