#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Count Gaussians, visible Gaussians, pairs and pixels of real frames, for the predictions of `gpu_static.py`.

    python tools/gpu/gpu_frames.py "made up, 1 M=synthetic:1000000:1600x1060" "fox, step 7000=PATH"...

PATH is a run, a model or a scene, as for `clsplat bench`; its first view is rendered. Or it is a scene of
`gpu_scenes.py`. `listed` counts the (tile, Gaussian) pairs in the tiles' lists, `walked` those up to the last pair that
a pixel of the tile needs; `walk_of`, `visits_of`, `summary` and `gpu_waves.py` explain the rest. The rows of these
names in gpu_frames.json are replaced. A row with `picture` is only rendered, not trained; one with `held_out` is only
compared with measurements. A frame that was measured elsewhere gets the numbers that it had there (`as_measured`).
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from gpu_measured import CALIBRATION
from gpu_run import BATCH_BACK, BLOCKS, VISITS, WARPS, together
from gpu_scenes import subject_of
from gpu_waves import refined, waves_in
from measuring import plain_parser, require, tool

from clsplat.bench.workload import Subject
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.selection import open_device
from clsplat.files.atomic import atomic_write
from clsplat.layouts.columns import SPLAT, TILE
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.duplicate import Counted

FRAMES = Path(__file__).with_name("gpu_frames.json")


def count(name: str, subject: Subject) -> dict[str, Any]:
    """Count the frame of a subject, and return its row."""
    device, camera = open_device(), subject.camera
    rasterizer = Rasterizer(device)
    gaussians = upload_gaussians(device, subject.gaussians)
    frame = rasterizer.forward(gaussians, camera, upload(device, np.zeros(3, np.float32)), backward=False)
    require(len(frame.bands) == 1, f"{name}: the frame needs more memory than there is, expected one band")
    lists, counted = frame.listed.lists, frame.listed.counted
    assert isinstance(counted, Counted), "the frame has exact counts"
    stops = frame.blended.stops.get()
    tiles = stops.reshape(stops.shape[0] // TILE, TILE, stops.shape[1] // TILE, TILE).swapaxes(1, 2)
    splats, order = frame.projected.splats.get(), lists.gaussian_from_sorted.get()
    walks = [
        walk_of(splats[order[begin:end]], tile - begin, np.array(place[::-1]) * TILE)
        for (begin, end), tile, place in zip(
            lists.ranges.get().astype(np.int64),
            tiles.reshape(-1, TILE, TILE),
            np.ndindex(tiles.shape[:2]),
            strict=True,
        )
    ]
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "gaussians": len(subject.gaussians),
        "sh_degree": subject.gaussians.sh_degree,
        "visible": counted.visible,
        "listed": counted.pairs,
        "key_bits": counted.key_bits,
        **summary(np.array(walks)),
        **lists_in(np.diff(lists.ranges.get().astype(np.int64)).ravel()),
        **waves_in(refined(subject), splats, frame.projected.tile_counts.get(), (tiles.shape[1], tiles.shape[0])),
    }


def lists_in(lengths: np.ndarray) -> dict[str, Any]:
    """Keys of a frame's row, from the lengths of its tiles' lists.

    The keys are the longest list, and, for each length 1, 2, 4, ..., the number of lists of at most this length and
    over half of it, and their pairs.
    """
    doublings = np.ceil(np.log2(np.maximum(lengths, 1))).astype(np.int64)
    return {
        "longest_listed": int(lengths.max()),
        "list_tiles": np.bincount(doublings).tolist(),
        "list_pairs": np.bincount(doublings, lengths).astype(np.int64).tolist(),
    }


WALK = ("walked", "reached", "taken", "halves", "longer_reached", "longer_taken")
"""Counts of a tile.

- walked: walked pairs. The other counts are sums over these.
- reached: blocks of 4x8 pixels that the ellipse reaches and that have an unfinished pixel.
- taken: blocks with a pixel that takes the pair.
- halves: halves of the tile that the ellipse reaches. In 1x64, a warp owns a half, a row of blocks.
- longer_reached, longer_taken: such blocks in the half that has more of them.
"""


def walk_of(splats: np.ndarray, stops: np.ndarray, corner: np.ndarray) -> list[int]:
    """The counts WALK of a tile, then for each number of warps in WARPS those of `visits_of`.

    splats: splats of the tile's pairs, front to back.
    stops: (16, 16), the first pair that each pixel does not take.
    corner: x and y of the tile's first pixel.
    """
    walked = max(int(stops.max()), 0)
    splats = splats[: -(-walked // LARGEST_BATCH) * LARGEST_BATCH]
    field = dict(zip(SPLAT, splats.T[:, :, None, None], strict=False))
    at = np.arange(TILE, dtype=np.float32) + np.float32(0.5)
    dx = field["PIXEL_X"] - corner[0] + field["SUB_X"] - at
    dy = field["PIXEL_Y"] - corner[1] + field["SUB_Y"] - at[:, None]
    power = field["LOG2O"] - (field["L11"] * dx + field["L12"] * dy) ** 2 - (field["L22"] * dy) ** 2
    reaches = power >= np.log2(RasterizerConfig().alpha_min)
    pair = np.arange(len(splats))[:, None, None]
    ellipse, takes, ends = (_blocks(each) for each in (reaches, reaches & (pair < stops), reaches & (pair <= stops)))
    last = _blocks(stops[None], np.max)
    back = ellipse & (pair[:, 0] < last)
    found = (each[:walked].reshape(-1, 2, BLOCKS // 2).sum(2) for each in (ellipse, back, takes))
    halves, reached, taken = found
    more = reached.argmax(1)[:, None]
    longer = (int(np.take_along_axis(each, more, 1).sum()) for each in (reached, taken))
    walk = [walked, int(reached.sum()), int(taken.sum()), int((halves > 0).sum()), *longer]
    return walk + [count for warps in WARPS for count in visits_of(warps, ellipse, ends, (back, takes), last)]


LARGEST_BATCH = 256
"""Number of pairs in a batch with the most warps of WARPS: BATCH in blocks.h."""


def _blocks(pixels: np.ndarray, over: Callable[..., np.ndarray] = np.any) -> np.ndarray:
    """Reduce pixels (n, 16, 16) to blocks (n, BLOCKS)."""
    return over(pixels.reshape(-1, TILE // 8, 8, TILE // 4, 4), axis=(2, 4)).reshape(-1, BLOCKS)


def visits_of(
    warps: int, ellipse: np.ndarray, ends: np.ndarray, gradient: tuple[np.ndarray, np.ndarray], last: np.ndarray
) -> list[int]:
    """The counts VISITS of a tile that `warps` warps share: of all warps, then of the warp that visits most blocks.

    ellipse: (n, BLOCKS), blocks that the ellipse of a pair reaches.
    ends: (n, BLOCKS), blocks with a pixel that takes the pair or is finished by it.
    gradient: two arrays (n, BLOCKS): blocks that the gradient visits, and blocks with a pixel that takes the pair.
    last: (1, BLOCKS), the largest stop of a block's pixels.
    """
    batch, owned = max(64, 32 * warps), BLOCKS // warps
    live = last >= np.arange(len(ellipse))[:, None] // batch * batch
    shape = (-1, warps, owned)
    reached, taken = (each.reshape(shape).sum(2) for each in (ellipse & live, ends & live))
    dense = reached > (owned // 2)
    *of_strip, rounds = back_of(*gradient, max(int(last.max()), 0), together(warps))
    of_warp = np.stack(
        [
            (reached > 0).sum(0),
            dense.sum(0),
            (reached * ~dense).sum(0),
            (taken * ~dense).sum(0),
            *(each.sum(keepdims=True) if warps == 1 else np.repeat(each, warps // 2) for each in of_strip),
            np.full(warps, rounds.sum() if warps == 1 else rounds.max(0).sum()),
        ]
    )
    return [*map(int, of_warp.sum(1)), *map(int, of_warp[:, reached.sum(0).argmax()])]


def back_of(back: np.ndarray, takes: np.ndarray, walked: int, of_round: int) -> list[np.ndarray]:
    """Counts of the gradient's walk for each of a tile's two strips (strips.h).

    They are: pairs that the walk visits; those that reach all blocks of the strip; for the other pairs, blocks that it
    visits, and blocks with a pixel that takes the pair; and rounds (2, batches).

    back, takes: the arrays of `gradient` in `visits_of`.
    walked: number of the tile's walked pairs.
    of_round: number of pairs in a round.
    """
    visited, taken = (each[:walked].reshape(-1, 2, BLOCKS // 2).sum(2)[::-1] for each in (back, takes))
    whole = visited == BLOCKS // 2
    padded = np.pad(visited > 0, ((0, -walked % BATCH_BACK), (0, 0)))
    counts = padded.reshape(-1, BATCH_BACK, 2).sum(1).T
    others = ((each * ~whole).sum(0) for each in (visited, taken))
    return [counts.sum(1), whole.sum(0), *others, -(-counts // of_round)]


def summary(walks: np.ndarray) -> dict[str, Any]:
    """Keys of a frame's row, from WALK and VISITS of its tiles (tiles, counts).

    The slowest tile is the one with the most pairs and blocks in one half. Its keys are its number of pairs, and the
    counts of its longer half and its longest warp. Counts of WALK and VISITS are per walked pair; those of VISITS are
    lists over WARPS.
    """
    walked = walks[:, 0]
    slowest = walks[walks[:, (0, 4, 5)].sum(1).argmax()]
    mean, longest = (each / max(each[0], 1) for each in (walks.sum(0), slowest))
    visits = len(WALK) + np.arange(2 * len(WARPS) * len(VISITS)).reshape(len(WARPS), 2, len(VISITS))
    return {
        "walked": int(walked.sum()),
        **{name: round(float(value), 3) for name, value in zip(WALK[1:4], mean[1:4], strict=True)},
        "list_99": int(np.percentile(walked, 99)),
        "longest": int(walked.max()),
        "slowest": int(slowest[0]),
        **{name: round(float(value), 3) for name, value in zip(WALK[4:], longest[4 : len(WALK)], strict=True)},
        **{name: mean[visits[:, 0, k]].round(3).tolist() for k, name in enumerate(VISITS)},
        **{f"longest_{name}": longest[visits[:, 1, k]].round(3).tolist() for k, name in enumerate(VISITS)},
    }


def as_measured(row: Mapping[str, Any], calibration: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The row of a frame with the numbers of the measured frame of this name, if there is one.

    These numbers are Gaussians, visible Gaussians and listed pairs. The lengths of lists are scaled by the ratio of
    listed pairs. The key `counted` then has the number of Gaussians of the model that was counted.
    """
    scenes = (scene for measured in calibration for scene in measured["scenes"])
    scene = next((each for each in scenes if each.get("frame") == row["name"] and "pairs" in each), None)
    if scene is None:
        return dict(row)
    longer = scene["pairs"]["listed"] / row["listed"]
    lengths = ("walked", "list_99", "longest", "slowest", "longest_listed")
    lists: dict[str, Any] = {name: round(row[name] * longer) for name in lengths}
    lists["list_pairs"] = [round(pairs * longer) for pairs in row["list_pairs"]]
    numbers = {"gaussians": scene["gaussians"], "visible": scene["visible"], "listed": scene["pairs"]["listed"]}
    return {**row, **numbers, **lists, "counted": row["gaussians"]}


@tool("gpu_frames")
def main(arguments: Sequence[str]) -> int:
    """Count the frames and write their rows."""
    parser = plain_parser(__doc__, prog="gpu_frames")
    parser.add_argument("subjects", metavar="NAME=PATH", nargs="+")
    frames = {row["name"]: row for row in json.loads(FRAMES.read_text())["frames"]}
    for text in parser.parse_args(arguments).subjects:
        name, equals, path = text.partition("=")
        require(bool(name and equals and path), f"{text}: expected NAME=PATH")
        row = as_measured(count(name, subject_of(path)), json.loads(CALIBRATION.read_text()))
        frames[name] = {**frames.get(name, {}), **row}
        print(json.dumps(frames[name]))
    rows = sorted(frames.values(), key=lambda row: (row.get("picture", False), row["gaussians"]))
    text = json.dumps({"frames": rows}, indent=2)
    text = re.sub(r"\[\s+([\d.,\s]+?)\s+\]", lambda match: f"[{' '.join(match[1].split())}]", text)  # one line per list
    atomic_write(FRAMES, (text + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
