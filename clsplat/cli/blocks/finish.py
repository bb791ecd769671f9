# SPDX-License-Identifier: Apache-2.0
"""`clsplat blocks finish`: the training of the merged model on all photographs."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.blocks.city_runs import CityFolder, loader, tell_of_city, trainer
from clsplat.cli.options import Flag, OptionalInt, Verb
from clsplat.cli.session import Services
from clsplat.cli.training_run import TrainingMachine, TrainingProgress


@dataclass(frozen=True)
class BlocksFinishVerb(Verb):
    """Train the merged model on all photographs, evaluate it, and write the report. CITY is a run then.

    The same command goes on after an interruption.
    """

    city: CityFolder
    """Folder with the merged model (clsplat blocks merge)."""
    finish: OptionalInt = None
    """Number of steps. If not given: those of the existing run, or of the plan if there is no run."""
    progress: TrainingProgress = "auto"
    """How progress is written, as for clsplat blocks train."""
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)
    json: Flag = False
    """Print the evaluation as JSON on standard output."""


def run(verb: BlocksFinishVerb, services: Services) -> int:
    """Train the merged model, unless that has been done."""
    from clsplat.blocks.block_training import finish, is_finished
    from clsplat.blocks.plan import read_plan

    verb.device.check()
    done = is_finished(verb.city, read_plan(verb.city), verb.finish)  # before the device is opened
    if done or not finish(
        verb.city, verb.finish, loader(services), trainer(services, verb.device, verb.progress), verb.device.count
    ):
        print(f"{verb.city}: has been finished before", file=sys.stderr)
    tell_of_city(verb.city, as_json=verb.json)
    return 0
