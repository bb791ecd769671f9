#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Count Gaussians, visible Gaussians, pairs and pixels of real frames, for the predictions of `gpu_static.py`.

    python tools/gpu/gpu_frames.py NAME=PATH...

PATH is a run, a model or a scene, as for `clsplat bench`; its first view is rendered. `listed` counts the (tile,
Gaussian) pairs in the tiles' lists, `walked` those up to the last pair that a pixel of the tile needs. The rows of
these names in gpu_frames.json are replaced. Rows that were not counted are hypothetical frames with assumed counts. A
row with `picture` is only rendered, not trained.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from measuring import plain_parser, require, tool

from clsplat.bench.workload import Subject, load_subject
from clsplat.device.buffers import upload
from clsplat.device.context import open_device
from clsplat.files.atomic import atomic_write
from clsplat.layouts.columns import TILE
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import upload_gaussians

FRAMES = Path(__file__).with_name("gpu_frames.json")


def count(name: str, subject: Subject) -> dict[str, Any]:
    """Count the frame of a subject, and return its row."""
    device, camera = open_device(), subject.camera
    rasterizer = Rasterizer(device)
    gaussians = upload_gaussians(device, subject.gaussians)
    frame = rasterizer.forward(gaussians, camera, upload(device, np.zeros(3, np.float32)), backward=False)
    require(len(frame.bands) == 1, f"{name}: the frame needs more memory than there is, expected one band")
    lists, counted = frame.listed.lists, frame.listed.counted
    ranges = lists.ranges.get().astype(np.int64)
    stops = frame.blended.stops.get()
    tiles = stops.reshape(stops.shape[0] // TILE, TILE, stops.shape[1] // TILE, TILE)
    last = np.maximum(tiles.max(axis=(1, 3)).ravel(), ranges[:, 0])
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "gaussians": len(subject.gaussians),
        "sh_degree": subject.gaussians.sh_degree,
        "visible": counted.visible,
        "listed": counted.pairs,
        "walked": int((last - ranges[:, 0]).sum()),
        "key_bits": counted.key_bits,
    }


@tool("gpu_frames")
def main(arguments: Sequence[str]) -> int:
    """Count the frames and write their rows."""
    parser = plain_parser(__doc__, prog="gpu_frames")
    parser.add_argument("subjects", metavar="NAME=PATH", nargs="+")
    frames = {row["name"]: row for row in json.loads(FRAMES.read_text())["frames"]}
    for text in parser.parse_args(arguments).subjects:
        name, equals, path = text.partition("=")
        require(bool(name and equals and path), f"{text}: expected NAME=PATH")
        frames[name] = count(name, load_subject(Path(path)))
        print(json.dumps(frames[name]))
    rows = sorted(frames.values(), key=lambda row: (row.get("picture", False), row["gaussians"]))
    atomic_write(FRAMES, (json.dumps({"frames": rows}, indent=2) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
