#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""`clsplat capture` of a video of a camera walk, against still photographs from the same places.

    python tools/quality/capture_videos.py FOLDER [--kinds plain,hlg,turned] [--size 480x270] [--fps 30]

The ray caster renders a walk with stops, a fast turn and motion blur (tests/support/walk_videos.py). The video is
captured; then a sharp still photograph is rendered for each frame that was taken, and the stills are captured. Prints
held-out PSNR of both, their difference, and the seconds of the video's capture. The exit status is 1 if a video is more
than MAX_LOSS_DB worse than its stills. A repeated call uses what an interrupted one has completed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from walk_videos import Walk, walk, write_walk

from clsplat.cli.main import main as clsplat
from clsplat.demo import ray_caster
from clsplat.progress import aligned
from clsplat.scenes.video.frames import FRAME_TABLE_FILE

MAX_LOSS_DB = 1.0
"""Largest loss of held-out PSNR in dB of a video against still photographs from the same places."""
SUB_FRAMES_PER_EXPOSURE_SECOND = 140
"""Pictures that are averaged for a frame of a moving camera, for each second that the shutter is open: 7 at 10 frames a
second, 3 at 30. The largest shake then moves the picture by about a pixel from one to the next at the default size."""
PHONE_BITS_PER_PIXEL = 0.27
"""Bits for a pixel of H.264 as phones record it: 17 Mbit/s for 1920x1080 at 30 frames a second."""
KINDS: dict[str, dict[str, Any]] = {
    "plain": {"bits_per_pixel": PHONE_BITS_PER_PIXEL},
    "hlg": {"hlg": True},
    "turned": {"turns": 1, "bits_per_pixel": PHONE_BITS_PER_PIXEL},
}
"""Arguments of `write_walk` by the kind of video."""


def captured(source: Path, output: Path, *more: str) -> dict[str, Any]:
    """Capture a video or a folder. Returns the contents of eval.json. Raises SystemExit if the capture fails.

    more: further arguments of `clsplat capture`.
    """
    if status := clsplat(["capture", str(source), "-o", str(output), *more]):
        raise SystemExit(status)
    result: dict[str, Any] = json.loads((output / "run" / "eval.json").read_text("utf-8"))
    return result


def sub_frames_of(fps: int) -> int:
    """Number of pictures that are averaged for a frame, an odd one."""
    return int(SUB_FRAMES_PER_EXPOSURE_SECOND * 0.5 / fps) // 2 * 2 + 1


def processor_seconds() -> float:
    """Seconds of processor time of this process and, except on Windows, of its children that have ended."""
    return sum(os.times()[:4])


def write_stills(capture: Path, made: Walk, folder: Path) -> int:
    """Render a sharp photograph for each frame that a capture has taken from its video. Returns their number.

    capture: folder of the capture. made: the walk that the video shows. folder: folder for the photographs.
    """
    folder.mkdir(exist_ok=True)
    (video,) = json.loads((capture / "frames" / FRAME_TABLE_FILE).read_text("utf-8"))["videos"]
    surfaces = ray_caster.still_life()
    ray_caster.bake(surfaces, 0)
    for frame in video["frames"]:
        camera = made.cameras[frame["frame"]]
        ray_caster.write_jpeg(folder / f"{frame['frame']:06d}.jpg", ray_caster.render(surfaces, camera))
    return len(video["frames"])


def main() -> int:
    """Capture the videos and their stills, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kinds", default="plain", help="kinds of videos: plain, hlg, turned; several with commas")
    parser.add_argument("--size", default="480x270", help="size of the video in pixels")
    parser.add_argument("--length", type=int, default=20, help="length of the video in seconds")
    parser.add_argument("--fps", type=int, default=30, help="frames a second of the video")
    parser.add_argument("--frames", default="48", help="number of frames to take from each video")
    parser.add_argument("--iterations", default="2000")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    width, height = map(int, given.size.split("x"))
    kinds = given.kinds.split(",")
    written = all((given.folder / f"{kind}.mp4").exists() for kind in kinds)  # then only the cameras are needed
    sub_frames, samples = (1, 1) if written else (sub_frames_of(given.fps), 2)
    count = given.fps * given.length
    made = walk(width, height, count, fps=given.fps, sub_frames=sub_frames, samples=samples)
    head = ("video", "photographs", "video, dB", "stills, dB", "difference", "seconds", "of processors")
    rows, worst = [head], 0.0
    for kind in kinds:
        video, shot, stills = (given.folder / name for name in (f"{kind}.mp4", f"{kind}_shot", f"{kind}_stills"))
        if not video.exists():
            write_walk(video, made.frames, made.fps, **KINDS[kind])
        start, used = time.monotonic(), processor_seconds()
        of_video = captured(video, shot, "--frames", given.frames, "--iterations", given.iterations)
        seconds, used = time.monotonic() - start, processor_seconds() - used
        count = write_stills(shot, made, stills)
        of_stills = captured(stills, given.folder / f"{kind}_stills_shot", "--iterations", given.iterations)
        psnr, other = of_video["mean"]["psnr"], of_stills["mean"]["psnr"]
        worst = max(worst, other - psnr)
        rows.append(
            (kind, str(count), f"{psnr:.2f}", f"{other:.2f}", f"{psnr - other:+.2f}", f"{seconds:.0f}", f"{used:.0f}")
        )
    print("\n".join(aligned(rows)))
    return int(worst > MAX_LOSS_DB)


if __name__ == "__main__":
    sys.exit(main())
