# SPDX-License-Identifier: Apache-2.0
"""The merge of the blocks' models: of each block, the Gaussians whose means lie in its own cell.

Cells are half-open and cover the plane, so each place on the ground belongs to one block. Gaussians outside the cell of
their block are left out, because another block has Gaussians of its own there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from clsplat.blocks.plan import BLOCKS_FOLDER, Block, BlockPlan, read_plan
from clsplat.blocks.progress_records import MERGED_FILE, done_record
from clsplat.errors import ClsplatError, InputError, examples
from clsplat.files.documents import digest, open_input
from clsplat.gaussians import Gaussians
from clsplat.images.colour import comment, recorded_space
from clsplat.models.edit import take
from clsplat.models.formats import ply
from clsplat.optimisation.trained_region import TrainedRegion

MERGED_COMMENT = "clsplat merged"
"""Beginning of the comment in merged.ply that is followed by the digest of the plan and of the blocks' models."""


@dataclass(frozen=True)
class CellModel:
    """Model file of a block. The merge takes its Gaussians in one cell."""

    path: Path
    cell: TrainedRegion

    def blocks(self) -> Iterator[Gaussians]:
        """Yield the Gaussians of the cell, in the file's order, in blocks of rows. Raises InputError."""
        for some in ply.local_blocks(self.path):
            yield take(some, self.cell.contains(some.means, some.origin))


def region_of_block(plan: BlockPlan, block: Block, *, widened: bool = False) -> TrainedRegion:
    """Return the cell of a block, or its widened cell, as a region of the world. Cells end at the sphere of the sky;
    the block of the sky has all outside it."""
    rectangle = block.widened if widened else block.cell
    region = TrainedRegion(np.array(plan.axes), np.array(rectangle.low), np.array(rectangle.high))
    if plan.sky is None:
        return region
    sphere = replace(region, centre=np.array(plan.sky.centre))
    return replace(sphere, nearest=plan.sky.radius) if block.is_sky else replace(sphere, farthest=plan.sky.radius)


def write_merged(target: Path, models: Sequence[CellModel], comments: Sequence[str] = ()) -> int:
    """Write the Gaussians of all cells, in the order of `models`, to a PLY. Returns their number.

    At most one block of rows is in memory at a time. comments: lines for the header.
    Raises InputError if the models do not fit together, or have no Gaussians in their cells.
    """
    count, like = 0, None
    for model in models:
        for some in model.blocks():
            count += len(some)
            like = some if like is None else like
            if _kind(some) != _kind(like):
                raise InputError(
                    f"{model.path}: SH degree, origin, near plane, antialiased, rays are {_kind(some)}, but those of "
                    f"{models[0].path} are {_kind(like)}; expected models of one plan"
                )
    if like is None or count == 0:
        raise InputError(f"{target}: the blocks have no Gaussians in their cells, expected at least one")
    ply.write_blocks(target, like, count, partial(_all_of, models), comments=comments)
    return count


def _all_of(models: Sequence[CellModel]) -> Iterator[Gaussians]:
    return (some for model in models for some in model.blocks())


def _kind(model: Gaussians) -> tuple[object, ...]:
    """Properties that all blocks of a model share: SH degree, origin, near plane, antialiased, by_rays."""
    return model.sh_degree, tuple(model.origin.tolist()), model.near, model.antialiased, model.by_rays


def merge_digest(plan: BlockPlan, models: Sequence[str]) -> str:
    """Return the digest of a merge, in hexadecimal. models: SHA-256 of each block's model file, in the plan's order."""
    return hashlib.sha256("\n".join([plan.digest, *models]).encode()).hexdigest()


def merge(city: Path) -> bool:
    """Write merged.ply from the blocks' finished models. Returns False if it is there already.

    Raises InputError if a block is not finished, or its model has changed since.
    """
    plan = read_plan(city)
    found = digests_of_blocks(city, plan)
    wanted, target = merge_digest(plan, found), city / MERGED_FILE
    if _has_merge(target, wanted):
        return False
    models = []
    for block, known in zip(plan.blocks, found, strict=True):
        path = city / BLOCKS_FOLDER / block.name / "model.ply"
        if digest(path) != known:
            raise InputError(
                f"{path}: is not the model that the block's training wrote; put it back, or remove "
                f"{path.with_name('done.json')} and train the block again"
            )
        models.append(CellModel(path, region_of_block(plan, block)))
    write_merged(target, models, [comment(recorded_space(models[0].path)), f"{MERGED_COMMENT} {wanted}"])
    return True


def is_merged(city: Path, plan: BlockPlan) -> bool:
    """True if merged.ply has the finished models of all blocks."""
    with suppress(ClsplatError):
        return _has_merge(city / MERGED_FILE, merge_digest(plan, digests_of_blocks(city, plan)))
    return False


def _has_merge(path: Path, wanted: str) -> bool:
    """True if the merge with the digest `wanted` wrote a file; False also for a file with a damaged header."""
    with suppress(InputError):
        return merged_of(path) == wanted
    return False


def digests_of_blocks(city: Path, plan: BlockPlan) -> list[str]:
    """Return the SHA-256 of each finished block's model file, in the plan's order.

    Raises InputError if blocks are not finished, or were trained by another plan.
    """
    found, missing = [], []
    for block in plan.blocks:
        record = done_record(city / BLOCKS_FOLDER / block.name)
        if record is None or record.plan != plan.digest:
            missing.append(block.shown)
        else:
            found.append(record.model)
    if missing:
        raise InputError(
            f"{city}: {len(missing)} of {len(plan.blocks)} blocks are not finished ({examples(missing)}); run "
            f"clsplat blocks train {city} --block {missing[0]}"
        )
    return found


def merged_of(path: Path) -> str | None:
    """Return the digest of the merge that wrote a file; None if the file is missing or not from a merge."""
    return next((line[len(MERGED_COMMENT) + 1 :] for line in _comments(path) if line.startswith(MERGED_COMMENT)), None)


def _comments(path: Path) -> list[str]:
    if not path.exists():
        return []
    with open_input(path, "a 3DGS PLY") as file:
        return ply.read_header(file, path).comments
