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
from clsplat.cli.training_run import TrainingMachine


@dataclass(frozen=True)
class BlocksTrainVerb(Verb):
    """Train one block of a plan, as a run in CITY/blocks. The same command goes on after an interruption.

    The coarse model around the block is drawn, but does not change. Appearance and refined cameras are those of the
    coarse model.
    """

    city: CityFolder
    """Folder with the plan (clsplat blocks plan)."""
    block: Annotated[str, arg(metavar="I,J")]
    """Name of the block, as in the plan."""
    device: Annotated[TrainingMachine, arg(name="")] = field(default_factory=TrainingMachine)


def run(verb: BlocksTrainVerb, services: Services) -> int:
    """Train the block, unless it has finished."""
    from clsplat.blocks.block_training import train_block

    verb.device.check()
    train = trainer(services, verb.device)
    if not train_block(verb.city, verb.block, loader(services), train, verb.device.count):
        print(f"{verb.city}: block {verb.block} has finished before", file=sys.stderr)
    return 0
