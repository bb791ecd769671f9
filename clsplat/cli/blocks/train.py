# SPDX-License-Identifier: Apache-2.0
"""`clsplat blocks train`: the training of one block."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.blocks.city_runs import CityFolder, loader, trainer
from clsplat.cli.options import Verb
from clsplat.cli.session import Services
from clsplat.cli.training_run import TrainingMachine, TrainingProgress


@dataclass(frozen=True)
class BlocksTrainVerb(Verb):
    """Train one block of a plan, as a run in CITY/blocks. The same command goes on after an interruption.

    The training draws the coarse model around the block and does not change it. It uses the cameras that the coarse
    model has refined. Appearances begin with the coarse model's.
    """

    city: CityFolder
    """Folder with the plan (clsplat blocks plan)."""
    block: Annotated[str, arg(metavar="I,J|sky|K")]
    """Name of the block, as in the plan, or its number in the order of the plan, from 0 on. A number for which there is
    no block is no error, so that an array of jobs may have more jobs than there are blocks."""
    progress: TrainingProgress = "auto"
    """How progress is written. auto: a bar on standard error if that is a terminal, else lines of text. openjd: lines
    of Open Job Description on standard output."""
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)


def run(verb: BlocksTrainVerb, services: Services) -> int:
    """Train the block, unless it has finished."""
    from clsplat.blocks.block_training import is_trained, train_block
    from clsplat.blocks.plan import read_plan

    verb.device.check()
    plan, name = read_plan(verb.city), verb.block
    if name.isascii() and name.isdigit():
        digits, count = name.lstrip("0") or "0", len(plan.blocks)
        if len(digits) > len(str(count)) or int(digits) >= count:  # int() refuses thousands of digits
            print(f"{verb.city}: the plan has {count} blocks, so there is nothing to do", file=sys.stderr)
            return 0
        name = plan.blocks[int(digits)].shown
    done = is_trained(verb.city, plan, plan.block(name))  # before the device is opened, as a queue may repeat a task
    if done or not train_block(
        verb.city, name, loader(services), trainer(services, verb.device, verb.progress), verb.device.count
    ):
        print(f"{verb.city}: block {name} has finished before", file=sys.stderr)
    return 0
