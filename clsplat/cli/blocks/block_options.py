# SPDX-License-Identifier: Apache-2.0
"""Options of a training in blocks: how the scene is divided, and who trains the blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from clsplat.cli.options import Memory, OptionalInt


@dataclass(frozen=True)
class DivisionOptions:
    """Limits of a block, and the up direction by which the ground is found."""

    block_mem: Memory = None
    """Most device memory that a block's training may take, such as 8GiB. Give that of the smallest device. If not
    given: this device's memory."""
    block_photographs: OptionalInt = None
    """Largest number of photographs of a block. If not given: any number."""
    up: Annotated[str | None, arg(metavar="X,Y,Z")] = None
    """Up direction in the scene's world, such as 0,0,1. If not given: -y of an upright scene (--orient up), else an
    estimate from the points and the cameras."""


@dataclass(frozen=True)
class WholeInBlocks(DivisionOptions):
    """Options of `clsplat train` for a large scene that is trained in blocks."""

    blocks: Annotated[str | None, arg(metavar="auto|N|NxM")] = None
    """Train a large scene in blocks, each on its own, and merge them: as clsplat blocks plan, train, merge and finish.
    The number of blocks, numbers along both axes of the ground, or auto: halved until each is within --block-mem and
    --block-photographs. The same command goes on after an interruption, and so does --resume once the plan is made."""
    workers: OptionalInt = None
    """With --blocks: number of processes on this machine, each of which trains a block at a time. If not given: this
    process trains one after another."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """With --blocks: address of the scheduler of a Dask cluster, whose workers train the blocks, one each at a time.
    They must see the scene and the output folder under the same paths."""
    finish: OptionalInt = None
    """With --blocks: number of steps on the merged model. If not given: those of a finish that has begun, else a
    twentieth of --iterations. The plan does not keep the number, so give it again to go on."""
