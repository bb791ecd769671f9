# SPDX-License-Identifier: Apache-2.0
"""Picture of a plan as SVG, and its table as text: cells, cameras and loads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from math import isfinite

import numpy as np

from clsplat.arrays import Float64
from clsplat.blocks.plan import Block, BlockPlan, Pair, Rectangle
from clsplat.blocks.planning.ground import on_ground

PICTURE_SIDE_PX = 640
"""Longer side of the map in a plan's picture, in pixels."""
PICTURE_EDGE_PX = 24
"""Width of the picture's margin around the map, in pixels."""
CAPTION_LINE_PX = 20
"""Height of a line of text below the map, in pixels."""
BORDER_PART = 0.06
"""Width of the border around all cameras and cuts on the map, as a fraction of their longer side."""
CELL_COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#76b7b2", "#edc948", "#b07aa1", "#9c755f")
"""Colours of cells, which repeat after the eighth."""
PLAN_CAMERA_COLOURS = ("#8a8a8a", "#1b1b1b", "#b23a00", "#d40078")
"""Colours of cameras whose photographs belong to no block, one, two, and three or more."""
DETAILS_SIDE_PX = 110
"""Least width and height in pixels of a cell on the map that has room for its loads."""


def plan_table(plan: BlockPlan) -> list[tuple[str, ...]]:
    """Return the rows of a table with the loads of all blocks; the first row has the titles."""
    rows: list[tuple[str, ...]] = [("block", "photographs", "Gaussians", "steps")]
    for block in plan.blocks:
        loads = (len(block.photographs), block.gaussians, block.iterations)
        rows.append((block.shown, *(f"{load:,}" for load in loads)))
    return rows


def plan_total(plan: BlockPlan) -> str:
    """Return a line: how many photographs the ground's blocks have together, their ratio to the scene's photographs,
    and how many the sky has."""
    total = sum(len(block.photographs) for block in plan.cells)
    blocks = "1 block" if len(plan.cells) == 1 else f"{len(plan.cells):,} blocks"
    times = f"{total / max(plan.photographs, 1):.2f} times"
    shown = next((len(block.photographs) for block in plan.blocks if block.is_sky), 0)
    sky = f"; the sky is one more, with {shown:,}" if shown else ""
    return f"{blocks} with {total:,} photographs in all, {times} the scene's {plan.photographs:,}{sky}"


def plan_svg(plan: BlockPlan, cameras: Mapping[str, Float64]) -> str:
    """Return the text of an SVG picture of a plan, seen from above, with the first axis to the right.

    cameras: positions (3,) in the world of the cameras, by the names of their photographs.
    Cells are coloured, and their widened cells have dashed edges. A camera's colour says how many blocks have its
    photograph.
    """
    places = on_ground(np.array([cameras[name] for name in sorted(cameras)], np.float64).reshape(-1, 3), plan.axes)
    view = _view(plan, places)
    sides = [high - low for low, high in zip(view.low, view.high, strict=True)]
    scale = PICTURE_SIDE_PX / max(sides)
    width, height = scale * sides[0], scale * sides[1]

    def pixel(place: Pair) -> Pair:
        """Position on the picture of a place, moved to the map's edge if it is outside."""
        x, y = (min(max(value, low), high) - low for value, low, high in zip(place, view.low, view.high, strict=True))
        return PICTURE_EDGE_PX + scale * x, PICTURE_EDGE_PX + height - scale * y

    times = Counter(name for block in plan.cells for name in block.photographs)
    body = [
        *(_cell(block, index, pixel) for index, block in enumerate(plan.cells)),
        *(_outline(block.widened, CELL_COLOURS[index % 8], pixel) for index, block in enumerate(plan.cells)),
        *(_dot(pixel((place[0], place[1])), times[name]) for name, place in zip(sorted(cameras), places, strict=True)),
        *(_label(block, pixel) for block in plan.cells),
    ]
    bottom = height + 2 * PICTURE_EDGE_PX
    counts = Counter(min(times[name], 3) for name in cameras)
    known = ("in no block of the ground", "in 1 block", "in 2 blocks", "in 3 or more blocks")
    legend = [(PLAN_CAMERA_COLOURS[key], f"{counts[key]:,} cameras {known[key]}") for key in range(4) if counts[key]]
    lines = [_text(plan_total(plan), PICTURE_EDGE_PX, bottom)]
    for number, (colour, text) in enumerate(legend, 1):
        y = bottom + CAPTION_LINE_PX * number
        lines += [_dot((PICTURE_EDGE_PX + 4, y - 4), color=colour), _text(text, PICTURE_EDGE_PX + 16, y)]
    whole = width + 2 * PICTURE_EDGE_PX, bottom + CAPTION_LINE_PX * len(legend) + PICTURE_EDGE_PX / 2
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {whole[0]:.1f} {whole[1]:.1f}" width="{whole[0]:.0f}" '
        f'height="{whole[1]:.0f}" font-family="sans-serif" font-size="13" role="img">'
    )
    ground = '<rect width="100%" height="100%" fill="#ffffff"/>'
    return "\n".join([head, f"<title>{plan_total(plan)}</title>", ground, *body, *lines, "</svg>", ""])


def _view(plan: BlockPlan, places: Float64) -> Rectangle:
    """Return the part of the ground on the map: all cameras, and all finite edges of cells, with a border."""
    corners = [corner for block in plan.cells for corner in (block.widened.low, block.widened.high)]
    along = [
        [value for value in [*places[:, axis].tolist(), *(corner[axis] for corner in corners)] if isfinite(value)]
        for axis in (0, 1)
    ]
    (left, right), (bottom, top) = ((min(values, default=0.0), max(values, default=0.0)) for values in along)
    border = BORDER_PART * max(right - left, top - bottom) or 1.0
    return Rectangle((left - border, bottom - border), (right + border, top + border))


def _cell(block: Block, index: int, pixel: Callable[[Pair], Pair]) -> str:
    (left, bottom), (right, top) = pixel(block.cell.low), pixel(block.cell.high)
    return (
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" '
        f'fill="{CELL_COLOURS[index % len(CELL_COLOURS)]}" fill-opacity="0.3" stroke="#ffffff" stroke-width="2"/>'
    )


def _outline(widened: Rectangle, color: str, pixel: Callable[[Pair], Pair]) -> str:
    (left, bottom), (right, top) = pixel(widened.low), pixel(widened.high)
    return (
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" fill="none" '
        f'stroke="{color}" stroke-dasharray="6 4" stroke-width="1.5"/>'
    )


def _dot(at: Pair, blocks: int = 0, *, color: str | None = None) -> str:
    color = color or PLAN_CAMERA_COLOURS[min(blocks, 3)]
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="3" fill="{color}" fill-opacity="0.8"/>'


def _label(block: Block, pixel: Callable[[Pair], Pair]) -> str:
    """Name of a block in the middle of its cell, and its loads if they fit."""
    (left, bottom), (right, top) = pixel(block.cell.low), pixel(block.cell.high)
    middle, y = 0.5 * (left + right), 0.5 * (top + bottom)
    lines = [f"block {block.shown}"]
    if min(right - left, bottom - top) >= DETAILS_SIDE_PX:
        lines += [
            f"{len(block.photographs):,} photographs",
            f"{block.gaussians:,} Gaussians",
            f"{block.iterations:,} steps",
        ]
    start = y - 8 * (len(lines) - 1) + 4
    style = 'text-anchor="middle" stroke="#ffffff" stroke-width="3" paint-order="stroke" fill="#000000"'
    return "\n".join(
        f'<text x="{middle:.1f}" y="{start + 16 * number:.1f}" {style}>{line}</text>'
        for number, line in enumerate(lines)
    )


def _text(text: str, x: float, y: float) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="#000000">{text}</text>'
