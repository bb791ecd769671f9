# SPDX-License-Identifier: Apache-2.0
"""Shapes of kernels whose instructions `gpu_static.py` counts, and the choice of a shape for each frame's launches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gpu_devices import GPUS
from gpu_measured import DRAWN, Works
from gpu_model import tiles_of
from gpu_page import SHAPE, trained_and_picture

from clsplat.layouts.columns import TILE
from clsplat.stages.blend import items_for

SHAPES = ("1x32", "1x64", "1x128", "1x256")
FORMS = ("1x32g", "1x64g", "1x32s", "1x64s")
"""Shapes that differ only in the form of blending's gradient."""
BY_FRAME = {"blend": items_for, "sort_lists": items_for}
"""Kernels whose groups follow the frame, and how (`clsplat.stages.blend.frame_items`)."""


def on_each_gpu(works: Mapping[str, Works], frames: Sequence[Mapping[str, Any]]) -> Works:
    """The work of each frame's launches in SHAPE, by GPU and frame, with larger groups where a frame has few tiles.

    works: of each shape, by target and frame.
    """
    sizes = {frame["name"]: tiles_of(frame) for frame in frames}
    found = {}
    for gpu in GPUS:
        for (target, name), launches in works[SHAPE].items():
            if target == gpu.target:
                frame = name.removesuffix(DRAWN)
                of_tiles = (sizes[frame], gpu.units, int(SHAPE[2:]), TILE * TILE)
                shapes = {kernel: f"1x{items(*of_tiles)}" for kernel, items in BY_FRAME.items()}
                wide = {
                    work.kernel: work
                    for shape in set(shapes.values())
                    for work in works[shape][target, frame]
                    if work and shapes.get(work.kernel) == shape
                }
                found[gpu.name, name] = [work and wide.get(work.kernel, work) for work in launches]
    return found


def frames_in(shape: str, frames: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """The frames whose launches are counted in a shape. In SHAPE, trained frames are also counted as pictures."""
    if shape in FORMS:
        return trained_and_picture(frames)[0][-1:]
    if shape != SHAPE:
        return frames
    trained = (frame for frame in frames if not frame.get("picture"))
    return [*frames, *({**frame, "name": frame["name"] + DRAWN, "picture": True} for frame in trained)]
