# SPDX-License-Identifier: Apache-2.0
"""`clsplat blocks train`, `merge` and `finish`: the work after the plan, each command for itself."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from clsplat.cli.eval import print_summary
from clsplat.cli.options import Flag, OptionalInt
from clsplat.cli.session import Services, load_scene
from clsplat.cli.training_run import TrainingMachine, tell_of_training, train_run

if TYPE_CHECKING:
    from clsplat.blocks.block_training import LoadScene, TrainRun
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene
    from clsplat.training.start import Start

CityFolder = Annotated[Positional[Path], arg(metavar="CITY")]


@dataclass(frozen=True)
class TrainBlock:
    """Train one block of a plan, as a run in CITY/blocks. The same command goes on after an interruption.

    The coarse model around the block is drawn, but does not change. Appearance and refined cameras are those of the
    coarse model.
    """

    city: CityFolder
    """Folder with the plan (clsplat blocks plan)."""
    block: Annotated[str, arg(metavar="I,J")]
    """Name of the block, as in the plan."""
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)

    def run(self, services: Services) -> int:
        """Train the block, unless it has finished."""
        from clsplat.blocks.block_training import train_block

        self.device.check()
        if not train_block(self.city, self.block, loader(services), trainer(services, self.device), self.device.count):
            print(f"{self.city}: block {self.block} has finished before", file=sys.stderr)
        return 0


@dataclass(frozen=True)
class MergeBlocks:
    """Merge the models of all blocks into CITY/merged.ply.

    Each block gives the Gaussians whose means lie in its own cell.
    """

    city: CityFolder
    """Folder with the trained blocks."""

    def run(self, services: Services) -> int:
        """Merge the blocks, unless that has been done."""
        del services
        from clsplat.blocks.merging import merge
        from clsplat.blocks.progress_records import MERGED_FILE

        done = merge(self.city)
        print(f"{'merged model' if done else 'has been merged before:'} in {self.city / MERGED_FILE}", file=sys.stderr)
        return 0


@dataclass(frozen=True)
class FinishBlocks:
    """Train the merged model on all photographs, evaluate it, and write the report. CITY is then a run.

    The same command goes on after an interruption.
    """

    city: CityFolder
    """Folder with the merged model (clsplat blocks merge)."""
    finish: OptionalInt = None
    """Number of steps. If not given: those of the run that goes on, else those of the plan."""
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)
    json: Flag = False
    """Print the evaluation as JSON on standard output."""

    def run(self, services: Services) -> int:
        """Train the merged model, unless that has been done."""
        from clsplat.blocks.block_training import finish

        self.device.check()
        if not finish(self.city, self.finish, loader(services), trainer(services, self.device), self.device.count):
            print(f"{self.city}: has been finished before", file=sys.stderr)
        tell_of_city(self.city, as_json=self.json)
        return 0


def loader(services: Services) -> LoadScene:
    """Return a function that loads a scene, and prints its warnings."""
    return lambda config, source, frame: load_scene(services, source, config, frame=frame)


def trainer(services: Services, machine: TrainingMachine) -> TrainRun:
    """Return a function that trains a run on this machine, with a progress bar. Raises DeviceError."""
    from clsplat.selftest.result import stages_of_training

    opened = machine.open_all(services)

    def train(scene: Scene, run: Run, start: Start) -> None:
        devices = [services.require(device, stages_of_training(run.config)) for device in opened]
        run.resume_command = shlex.join([*shlex.split(run.resume_command), *machine.flags])
        tell_of_training(scene, run.config, devices)
        train_run(services, scene, run, devices, machine, start=start)
        print(f"model in {run.model_path}", file=sys.stderr)

    return train


def tell_of_city(city: Path, *, as_json: bool) -> None:
    """Print the evaluation of a finished city, if views are held out."""
    from clsplat.runs.run import Run

    path = Run.open(city).eval_path
    result = json.loads(path.read_text("utf-8")) if path.exists() else None
    if as_json:
        print(json.dumps(result, indent=2))
    elif result is not None:
        print_summary(result)
