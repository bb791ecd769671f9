# SPDX-License-Identifier: Apache-2.0
"""Frames chosen from a camera walk with stops, a fast turn and motion blur, as videos of several codings.

    tools/stress/run videos [--width 960] [--height 540] [--frames 120] [--choose 40] [--keep FOLDER]

The walk is of the demo's still life (`tests/support/walk_videos.py`), 10 frames a second. Codings are H.264 of 8 bits,
the same with frames stored turned by 90 degrees, and HEVC of 10 bits in HLG. Columns: frames chosen; chosen frames in
the turn; chosen frames that are not sharper than the median of their stretch; by how much chosen frames are sharper
than that median, minimum and mean; mean error of the written frames against the rendered ones in levels of 255; wall
seconds and processor seconds of `take_frames`. The exit status is 1 if a chosen frame is in the turn or not sharper, or
if the same frames taken again have other bytes.
"""

from __future__ import annotations

import filecmp
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import number, plain_parser
from walk_videos import Walk, walk, write_walk

from clsplat.images.reading import read_image
from clsplat.progress import aligned
from clsplat.scenes.video.choice import choose
from clsplat.scenes.video.frames import TakenFrames, measure_video, take_frames
from clsplat.scenes.video.reading import open_video

HEAD = ("coding", "chosen", "of the turn", "not sharper", "least", "mean", "error", "wall s", "CPU s")
VARIANTS: dict[str, dict[str, Any]] = {"H.264": {}, "H.264, turned": {"turns": 1}, "HEVC, HLG": {"hlg": True}}


def row(name: str, made: Walk, video: Path, folder: Path, count: int) -> tuple[list[str], bool]:
    """Return a row of the table, and False if the frames fail a condition on which the exit status depends.

    made: the rendered walk. video: its file. folder: folder for frames. count: number of frames to choose.
    """
    wall, processor = time.perf_counter(), time.process_time()
    taken = take_frames([video], folder / "a", count=count)
    spent = time.perf_counter() - wall, time.process_time() - processor
    again = take_frames([video], folder / "b", count=count)
    files = [*taken.names, "frames.json"]
    same = taken.names == again.names and not any(
        filecmp.cmpfiles(folder / "a", folder / "b", files, shallow=False)[1:]
    )
    chosen = [int(Path(each).stem) for each in taken.names]
    turned = sum(made.parts[index] == "turn" for index in chosen)
    gains = sharper(video, count)
    worse = int((gains <= 0).sum())
    values = [name, str(len(chosen)), str(turned), str(worse), f"{gains.min():.4f}", f"{gains.mean():.4f}"]
    values += [f"{error(made, taken):.2f}", f"{spent[0]:.1f}", f"{spent[1]:.1f}"]
    if not same:
        print(f"{name}: the same frames taken again have other names or bytes", file=sys.stderr)
    return values, same and not turned and not worse


def sharper(video: Path, count: int) -> Any:
    """Sharpness of each chosen frame minus the median of its stretch, for stretches of several frames."""
    with open_video(video) as reader:
        measured, _, _ = measure_video(reader, lambda _: None)
    choice = choose(measured, count)
    gains = []
    for index in choice.frames:
        inside = measured.sharpness[choice.stretches == choice.stretches[index]]
        if len(inside) > 1:
            gains.append(measured.sharpness[index] - np.median(inside))
    return np.array(gains)


def error(made: Walk, taken: TakenFrames) -> float:
    """Mean absolute difference between written and rendered frames, in levels of 255."""
    differences = []
    for name in taken.names:
        written = read_image(taken.folder / name)
        differences.append(255 * np.abs(written - made.frames[int(Path(name).stem)]).mean())
    return float(np.mean(differences))


def main(arguments: Sequence[str]) -> int:
    """Render the walk, encode it in each coding, and print the table. Returns the exit status."""
    parser = plain_parser(__doc__)
    for flag, default in (("--width", 960), ("--height", 540), ("--frames", 120), ("--choose", 40)):
        parser.add_argument(flag, type=number, default=default)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        made = walk(options.width, options.height, options.frames)
        rows, good = [list(HEAD)], True
        for name, how in VARIANTS.items():
            stem = name.replace(", ", "-").replace(".", "").lower()
            video = write_walk(folder / f"{stem}.mp4", made.frames, **how)
            values, fine = row(name, made, video, folder / stem, options.choose)
            rows.append(values)
            good &= fine
    print("\n".join(aligned(rows)))
    return 0 if good else 1
