# SPDX-License-Identifier: Apache-2.0
"""Making of a plan: the ground is divided into cells, whose loads are measured with the coarse model."""

from __future__ import annotations

from math import ceil, inf
from pathlib import Path

import numpy as np

from clsplat.blocks.plan import COARSE_FOLDER, MARGIN, SHARE, SKY_BLOCK, Block, BlockPlan, Partition, shown_name
from clsplat.blocks.planning.coarse import block_steps, finish_steps, sky_steps
from clsplat.blocks.planning.measurement import CellLoads, LoadMeasurement
from clsplat.blocks.planning.split import (
    MAX_BLOCKS,
    PLANE,
    Leaf,
    Tree,
    balanced,
    cells,
    cut_again,
    gridded,
    parse_blocks,
    without,
)
from clsplat.camera import Camera
from clsplat.errors import InputError, amount, examples, warn
from clsplat.files.documents import known_digest
from clsplat.runs import scene_record
from clsplat.runs.run import Run, is_run
from clsplat.scenes.scene import Scene

ONE_CAMERA = "one camera"
"""Reason why a cell cannot be trained if all its photographs were taken at one place."""
MIN_LOAD_DROP = 0.95
"""Cutting goes on while each round lowers the largest load to at most this fraction of its value."""
SLOW = "training will run in pieces, and be slower"
"""Effect of too little device memory, for warnings."""


def made_plan(measurement: LoadMeasurement, coarse: Run, source: Path, division: Partition) -> BlockPlan:
    """Divide a scene into blocks, and measure their loads.

    coarse: run of the coarse model.
    source: path of the scene.
    Raises InputError for limits that no division meets.
    """
    config, photographs = measurement.config, [view.name for view in measurement.scene.train_views]
    loads, joined = divided(measurement, division)
    blocks = []
    for index, name in enumerate(loads.names):
        own = tuple(photographs[photograph] for photograph in np.flatnonzero(loads.belongs[:, index]))
        steps, gaussians = block_steps(config, len(own), len(photographs)), round(float(loads.around[index]))
        blocks.append(Block(name, loads.cells[index], loads.widened[index], own, steps, gaussians))
    if loads.sky is not None:
        own = tuple(photographs[photograph] for photograph in np.flatnonzero(loads.sky.shown))
        steps = sky_steps(config, len(own), len(photographs), max(block.iterations for block in blocks))
        blocks.append(Block(SKY_BLOCK, PLANE, PLANE, own, steps, int(loads.sky.rows.sum())))
    return BlockPlan(
        scene=source.absolute(),
        settings=config,
        division=division,
        up=measurement.ground.up,
        axes=measurement.ground.axes,
        margin=MARGIN,
        share=SHARE,
        coarse=known_digest(coarse.model_path),
        extent=measurement.scene.extent,
        finish_steps=finish_steps(config),
        blocks=tuple(blocks),
        sky=None if loads.sky is None else loads.sky.sphere,
        joined=tuple(joined),
        photographs=len(photographs),
        gaussians=len(measurement.model),
    )


def coarse_run(city: Path) -> Run | None:
    """Return the run of the coarse model in a city's folder; None if it has not begun."""
    folder = city / COARSE_FOLDER
    return Run.open(folder) if is_run(folder) else None


def coarse_cameras(coarse: Run, scene: Scene) -> list[Camera]:
    """Return the cameras of a scene's training views at the size of the coarse model's photographs."""
    record = scene_record.read(coarse)
    sizes = {} if record is None else {name: view["size"] for name, view in record["views"].items()}
    return [view.camera.resized(*sizes[view.name]) if view.name in sizes else view.camera for view in scene.train_views]


def divided(measurement: LoadMeasurement, division: Partition) -> tuple[CellLoads, list[str]]:
    """Divide the ground into the cells that `division` asks for, and measure their loads.

    For "auto", cells are halved until each is within the limits. Cells that cannot be trained are joined to their
    neighbours.
    Returns the loads, and a line for each cell that was joined. Raises InputError for limits that no division meets.
    """
    asked = parse_blocks(division.blocks)
    if isinstance(asked, tuple):
        tree = gridded(measurement.places, *asked)
    elif asked is not None:
        tree = balanced(measurement.places, asked)
    else:
        tree = _within(measurement, division)
    return _joined(measurement, tree)


def _within(measurement: LoadMeasurement, division: Partition) -> Tree:
    """Cut each block that is over a limit of `division` in two, until none is.

    Raises InputError if smaller cells do not help. For the memory of this device, which is the limit if no other is
    given, there is only a warning, as a training of more runs in pieces.
    """
    memory, most = _memory_limit(measurement, division), division.photographs or inf
    places = measurement.places
    tree, before = balanced(places, min(ceil(len(places) / most), MAX_BLOCKS)), inf
    while True:
        loads = measurement.of(tree)
        taken = [measurement.bytes_needed(gaussians) for gaussians in loads.around]
        counts = [int(count) for count in loads.belongs.sum(axis=0)]
        parts = [max(size / memory, count / most) for size, count in zip(taken, counts, strict=True)]
        largest = max(parts)
        if largest <= 1:
            return tree
        over = [name for name, part in zip(loads.names, parts, strict=True) if part > 1]
        finer = cut_again(tree, over, places)
        if finer == tree or largest > MIN_LOAD_DROP * before or len(list(cells(finer))) > MAX_BLOCKS:
            if max(taken) / memory < largest:
                raise InputError(
                    f"--block-photographs {most}: the largest of {len(parts):,} blocks would still have "
                    f"{max(counts):,} photographs, and smaller blocks hardly fewer, as each photograph shows several; "
                    "expected at least that"
                )
            takes = f"the largest of {len(parts):,} blocks would still take {amount(max(taken))}"
            if division.memory is None:
                warn(f"{takes}, and smaller blocks hardly less, but this device has {amount(int(memory))}: {SLOW}")
                return tree
            raise InputError(
                f"--block-mem {amount(int(memory))}: {takes}, and smaller blocks hardly less; expected at least that, "
                "or a smaller --resolution"
            )
        tree, before = finer, largest


def _memory_limit(measurement: LoadMeasurement, division: Partition) -> float:
    """Return the largest number of bytes of device memory of a block; infinite, with a warning, if it cannot be met.

    Raises InputError if `division` asks for less memory than the smallest block takes.
    """
    memory, least = division.memory or measurement.device.budget, measurement.bytes_needed(0)
    if least <= memory:
        return memory
    takes = f"the coarse model, which is drawn around each block, takes {amount(least)}"
    if division.memory is None:
        warn(f"{takes}, but this device has {amount(memory)}: {SLOW}")
        return inf
    raise InputError(f"--block-mem {amount(memory)}: {takes}; expected more than that, or a smaller --resolution")


def _joined(measurement: LoadMeasurement, tree: Tree) -> tuple[CellLoads, list[str]]:
    """Measure the cells' loads, and join each cell that cannot be trained to its neighbours.

    Loads are measured again after each round. In a round, a cell that the round has changed is not joined again, since
    it may be fit now. All other cells stay unfit, since joined cells can only take photographs from them.
    Returns the loads of the remaining cells, and a line for each joined cell. Raises InputError if only one cell
    remains and has no points or no photographs.
    """
    notes: list[str] = []
    while True:
        loads = measurement.of(tree)
        unfit = {name: why for index, name in enumerate(loads.names) if (why := _unfit(measurement, loads, index))}
        if not unfit:
            return loads, notes
        if isinstance(tree, Leaf):
            return loads, [*notes, _note_of_single(measurement, unfit[tree.name])]
        changed: set[str] = set()
        for name, why in unfit.items():
            after, neighbours = without(tree, name)
            if changed.isdisjoint((name, *neighbours)):
                tree = after
                changed.update((name, *neighbours))
                joined = examples([shown_name(neighbour) for neighbour in neighbours])
                notes.append(f"block {shown_name(name)} has {why}: its cell is joined to block {joined}")


def _note_of_single(measurement: LoadMeasurement, why: str) -> str:
    """Return a note about the only cell, which has no neighbours. why: what the cell has, as from `_unfit`.

    Raises InputError if nothing can be trained.
    """
    if why == ONE_CAMERA:
        return (
            "block 0,0 has one camera, and there is no other block to join it to; expected photographs from two places"
        )
    scene = measurement.scene
    raise InputError(
        f"{scene.source or scene.name}: the only block has {why}, expected points of the coarse model, and photographs "
        "that show them; check the scene's cameras"
    )


def _unfit(measurement: LoadMeasurement, loads: CellLoads, index: int) -> str:
    """Return in words why a cell cannot be trained; empty if it can."""
    own = loads.belongs[:, index]
    if not loads.inside[index]:
        return "no points"
    if not own.any():
        return "no photographs"
    return "" if measurement.has_several_places(own) else ONE_CAMERA
