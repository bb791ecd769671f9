# SPDX-License-Identifier: Apache-2.0
"""The plan of a scene that is trained in blocks, and its file plan.json: cells, photographs, steps and digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any

from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, examples
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import load_document
from clsplat.runs.settings import config_of, table_of
from clsplat.version import package_version

PLAN_FILE = "plan.json"
"""Name of the plan's file in a city's folder. Its picture is PLAN_PICTURE_FILE (`clsplat.report`)."""
COARSE_FOLDER, BLOCKS_FOLDER = "coarse", "blocks"
"""Names of the folders, in a city's folder, of the coarse model's run and of the blocks' runs."""
MAX_PLAN_BYTES = 256 << 20
"""Size limit of plan.json in bytes, enough for some million names of photographs."""
PLAN_FORM = 2
"""Form of plan.json that this version writes, and the only one that it reads."""
MARGIN = 0.2
"""Width that widens a cell on each side, as a fraction of the cell's size along the same axis."""
SHARE = 0.3
"""A photograph belongs to a cell's block if the cell fills at least this fraction of the pixels that the photograph's
fullest cell fills (docs/scale.md)."""
SKY_BLOCK = "sky"
"""Name of the block of the sky."""
_EXPECTED_PLAN = "a plan that clsplat blocks plan wrote"
Pair = tuple[float, float]
Point = tuple[float, float, float]
Axes = tuple[Point, Point]


@dataclass(frozen=True)
class Rectangle:
    """A rectangle on the ground, half-open: a point is inside if low <= coordinate < high on both axes.

    low, high: corners in the coordinates of `BlockPlan.axes`; infinite where the rectangle has no edge.
    """

    low: Pair
    high: Pair


@dataclass(frozen=True)
class Block:
    """A part of the scene that is trained on its own.

    name: two numbers, such as "0_1", or "sky". It is also the name of the block's folder.
    cell: the block's part of the ground. The cells of the ground's blocks cover the plane without overlap. The cell of
        the sky is the whole plane.
    widened: the cell and its margin, within which the block's Gaussians are trained.
    photographs: names of the training views that belong to the block, sorted.
    iterations: number of training steps.
    gaussians: number of the coarse model's Gaussians in the widened cell, without the sky; or in the sky.
    """

    name: str
    cell: Rectangle
    widened: Rectangle
    photographs: tuple[str, ...]
    iterations: int
    gaussians: int

    @property
    def shown(self) -> str:
        """The name as commands and messages write it, such as "0,1"."""
        return shown_name(self.name)

    @property
    def is_sky(self) -> bool:
        """True for the block of the sky."""
        return self.name == SKY_BLOCK


@dataclass(frozen=True)
class Sky:
    """A sphere around the scene. The Gaussians outside it are the sky, a block of its own.

    centre: in world coordinates.
    radius: in world units.
    """

    centre: Point
    radius: float


@dataclass(frozen=True)
class Partition:
    """The options by which a scene is divided into blocks.

    blocks: "auto", a number of blocks such as "4", or numbers of blocks along both axes such as "2x3".
    memory: bytes that a block's training may take on its device; None for no limit.
    photographs: largest number of photographs of a block; None for no limit.
    """

    blocks: str = "auto"
    memory: int | None = None
    photographs: int | None = None


@dataclass(frozen=True)
class BlockPlan:
    """A scene's division into blocks.

    scene: path of the scene.
    settings: settings of the training of the whole scene.
    division: options by which the scene was divided.
    up: unit vector in the world.
    axes: two unit vectors in the world, at right angles to `up` and each other. A mean's coordinates on the ground are
        its dot products with them.
    margin, share: as MARGIN and SHARE.
    coarse: SHA-256 of the coarse model's file.
    extent: the whole scene's extent in world units (`Scene.extent`).
    finish_steps: number of steps over all photographs after the merge.
    blocks: in the order in which the merge joins them.
    sky: where the sky begins, if it is a block of its own; None if it is divided into the cells like the ground.
    joined: in words, for each cell that was joined to its neighbours, the reason, and what a single block lacks.
    photographs: number of the scene's training views.
    gaussians: number of the coarse model's Gaussians.
    """

    scene: Path
    settings: TrainConfig
    division: Partition
    up: Point
    axes: Axes
    margin: float
    share: float
    coarse: str
    extent: float
    finish_steps: int
    blocks: tuple[Block, ...]
    sky: Sky | None = None
    joined: tuple[str, ...] = ()
    photographs: int = 0
    gaussians: int = 0

    @property
    def digest(self) -> str:
        """SHA-256 of the plan without the scene's path, in hexadecimal. It does not depend on clsplat's version."""
        document = {key: value for key, value in self.document().items() if key not in ("clsplat", "scene")}
        return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()

    @property
    def cells(self) -> list[Block]:
        """The blocks of the ground, without the sky."""
        return [block for block in self.blocks if not block.is_sky]

    def block(self, name: str) -> Block:
        """Return the block with a name such as "0_1" or "0,1". Raises InputError if the plan has no such block."""
        for block in self.blocks:
            if block.name == name.replace(",", "_").replace(" ", ""):
                return block
        names = examples([block.shown for block in self.blocks], 8)
        raise InputError(f"--block {name}: the plan has no such block, expected one of {names}")

    def document(self) -> dict[str, Any]:
        """Return the content of plan.json."""
        division = self.division
        return {
            "clsplat_blocks": PLAN_FORM,
            "clsplat": package_version(),
            "scene": str(self.scene),
            "coarse": self.coarse,
            "extent": self.extent,
            "division": {
                "blocks": division.blocks,
                "memory": division.memory,
                "photographs": division.photographs,
            },
            "up": list(self.up),
            "axes": [list(axis) for axis in self.axes],
            "margin": self.margin,
            "share": self.share,
            "finish_steps": self.finish_steps,
            "sky": None if self.sky is None else {"centre": list(self.sky.centre), "radius": self.sky.radius},
            "joined": list(self.joined),
            "photographs": self.photographs,
            "gaussians": self.gaussians,
            "train": table_of(self.settings),
            "blocks": [
                {
                    "name": block.name,
                    "cell": _edges(block.cell),
                    "widened": _edges(block.widened),
                    "iterations": block.iterations,
                    "gaussians": block.gaussians,
                    "photographs": list(block.photographs),
                }
                for block in self.blocks
            ],
        }


def shown_name(name: str) -> str:
    """Return the name of a block, such as "0_1", as commands and messages write it: "0,1"."""
    return name.replace("_", ",")


def write_plan(city: Path, plan: BlockPlan) -> None:
    """Write plan.json in the city's folder."""
    text = json.dumps(plan.document(), indent=1, allow_nan=False) + "\n"
    atomic_write(city / PLAN_FILE, text.encode())


def read_plan(city: Path) -> BlockPlan:
    """Read plan.json in the city's folder. Raises InputError if it is missing or damaged."""
    path = city / PLAN_FILE
    if not path.exists():
        raise InputError(f"{path}: no such file, expected {_EXPECTED_PLAN}; run clsplat blocks plan SCENE -o {city}")
    document = load_document(path, _EXPECTED_PLAN, "clsplat_blocks", MAX_PLAN_BYTES)
    form = document.get("clsplat_blocks")
    if form != PLAN_FORM:
        raise InputError(f"{path}: clsplat_blocks is {form!r:.40}, expected {PLAN_FORM}; make the plan anew")
    try:
        return _plan_of(document, path)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error) or "its form is wrong"
        raise InputError(f"{path}: is damaged ({why}), expected {_EXPECTED_PLAN}; make the plan anew") from None


def _plan_of(document: Mapping[str, Any], path: Path) -> BlockPlan:
    division = document["division"]
    first, second = document["axes"]
    plan = BlockPlan(
        scene=Path(_text(document["scene"])),
        settings=config_of(document["train"], path),
        division=Partition(
            _text(division["blocks"]), _count_or_none(division["memory"]), _count_or_none(division["photographs"])
        ),
        up=_point(document["up"]),
        axes=(_point(first), _point(second)),
        margin=_number(document["margin"]),
        share=_number(document["share"]),
        coarse=_text(document["coarse"]),
        extent=_number(document["extent"]),
        finish_steps=_count(document["finish_steps"]),
        blocks=tuple(_block_of(block) for block in document["blocks"]),
        sky=_sky_of(document["sky"]),
        joined=tuple(_text(line) for line in document["joined"]),
        photographs=_count(document["photographs"]),
        gaussians=_count(document["gaussians"]),
    )
    names = [block.name for block in plan.blocks]
    if not names or len(set(names)) < len(names):
        raise ValueError("expected blocks, each with a name of its own")
    if (SKY_BLOCK in names) != (plan.sky is not None):
        found = f"sky is {document['sky']!r:.60}, and the blocks are {examples(names)}"
        raise ValueError(f"{found}; expected a block named {SKY_BLOCK} if it is said where the sky begins, else none")
    if not plan.cells:
        raise ValueError("expected blocks of the ground")
    return plan


def _sky_of(sky: Mapping[str, Any] | None) -> Sky | None:
    if sky is None:
        return None
    if (radius := _number(sky["radius"])) <= 0:
        raise ValueError(f"the sky begins at the distance {radius}, expected more than 0")
    return Sky(_point(sky["centre"]), radius)


def _block_of(block: Mapping[str, Any]) -> Block:
    name = _text(block["name"])
    digits = [part.isascii() and part.isdigit() for part in name.split("_")]
    if name != SKY_BLOCK and digits != [True, True]:  # it is the name of a folder
        raise ValueError(f"a block has the name {name!r:.40}, expected two numbers such as 0_1, or sky")
    return Block(
        name=name,
        cell=_rectangle(block["cell"]),
        widened=_rectangle(block["widened"]),
        photographs=tuple(_text(photograph) for photograph in block["photographs"]),
        iterations=_count(block["iterations"]),
        gaussians=_count(block["gaussians"]),
    )


def _edges(rectangle: Rectangle) -> dict[str, list[float | None]]:
    """Return a rectangle as JSON values, with null for an infinite coordinate."""
    return {
        "low": [value if isfinite(value) else None for value in rectangle.low],
        "high": [value if isfinite(value) else None for value in rectangle.high],
    }


def _rectangle(given: Mapping[str, Any]) -> Rectangle:
    (left, bottom), (right, top) = given["low"], given["high"]
    low = (_edge(left, -inf), _edge(bottom, -inf))
    high = (_edge(right, inf), _edge(top, inf))
    if not (low[0] < high[0] and low[1] < high[1]):
        raise ValueError(f"a cell reaches from {low} to {high}, expected a low corner below the high corner")
    return Rectangle(low, high)


def _edge(value: object, without: float) -> float:
    return without if value is None else _number(value)


def _point(values: Any) -> Point:
    x, y, z = values
    return _number(x), _number(y), _number(z)


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"{value!r:.40} stands where a finite number is expected")
    return float(value)


def _count(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r:.40} stands where a whole number, at least 0, is expected")
    return value


def _count_or_none(value: object) -> int | None:
    return None if value is None else _count(value)


def _text(value: object) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"{value!r:.40} stands where a text is expected")
    return value
