# SPDX-License-Identifier: Apache-2.0
"""The merge of the blocks: of each model, the Gaussians whose means lie in its own cell, and the mean appearance.

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

from clsplat.blocks.merged_appearance import mean_appearance
from clsplat.blocks.plan import BLOCKS_FOLDER, COARSE_FOLDER, Block, BlockPlan, read_plan
from clsplat.blocks.progress_records import (
    DONE_FILE,
    MERGED_APPEARANCE_FOLDER,
    MERGED_FILE,
    DoneRecord,
    done_record,
)
from clsplat.errors import ClsplatError, InputError, examples
from clsplat.files.documents import digest, open_input
from clsplat.gaussians import Gaussians
from clsplat.images.colour import comment, recorded_space
from clsplat.models.edit import take
from clsplat.models.formats import ply
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.runs.run import Run

MERGED_COMMENT = "clsplat merged"
"""Beginning of the comment in merged.ply that is followed by the digest of the plan and of the blocks' results."""


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


def merge_digest(plan: BlockPlan, records: Sequence[DoneRecord]) -> str:
    """Return the digest of a merge, in hexadecimal. records: the blocks' records, in the plan's order."""
    return hashlib.sha256("\n".join([plan.digest, *(record.result for record in records)]).encode()).hexdigest()


def merge(city: Path) -> bool:
    """Write merged.ply from the blocks' finished models, and the merged appearance, if there is one. Returns False if
    both are there already.

    Raises InputError if a block is not finished, or a file of its result has changed since.
    """
    plan = read_plan(city)
    if is_merged(city, plan):
        return False
    records = records_of_blocks(city, plan)
    folders = {block.name: city / BLOCKS_FOLDER / block.name for block in plan.blocks}
    for folder, record in zip(folders.values(), records, strict=True):
        _check_result(folder, record)
    if plan.settings.appearance != "none":
        # not of the sky's block, as the sky alone tells little about the exposure of a photograph
        parts = [folders[block.name] for block in plan.cells]
        found = mean_appearance(city / COARSE_FOLDER, parts, plan.settings.appearance)
        (city / MERGED_APPEARANCE_FOLDER).mkdir(exist_ok=True)
        Run(city / MERGED_APPEARANCE_FOLDER, plan.settings, plan.scene).write_appearance(*found)
    models = [CellModel(folders[block.name] / "model.ply", region_of_block(plan, block)) for block in plan.blocks]
    comments = [comment(recorded_space(models[0].path)), f"{MERGED_COMMENT} {merge_digest(plan, records)}"]
    write_merged(city / MERGED_FILE, models, comments)
    return True


def _check_result(folder: Path, record: DoneRecord) -> None:
    """Raise InputError if a file of a block's result has changed since the block's training wrote it."""
    for name, known in record.files.items():
        if digest(folder / name) != known:
            raise InputError(
                f"{folder / name}: is not the file that the block's training wrote; put it back, or remove "
                f"{folder / DONE_FILE} and train the block again"
            )


def is_merged(city: Path, plan: BlockPlan) -> bool:
    """True if merged.ply has the finished models of all blocks, and their merged appearance is there."""
    learnt = Run(city / MERGED_APPEARANCE_FOLDER, plan.settings, plan.scene).appearance_files
    with suppress(ClsplatError):
        wanted = merge_digest(plan, records_of_blocks(city, plan))
        return merged_of(city / MERGED_FILE) == wanted and all(file.exists() for file in learnt)
    return False


def records_of_blocks(city: Path, plan: BlockPlan) -> list[DoneRecord]:
    """Return the records of the finished blocks, in the plan's order.

    Raises InputError if blocks are not finished, or were trained by another plan.
    """
    found, missing = [], []
    for block in plan.blocks:
        record = done_record(city / BLOCKS_FOLDER / block.name)
        if record is None or record.plan != plan.digest:
            missing.append(block.shown)
        else:
            found.append(record)
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
