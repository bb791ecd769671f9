# SPDX-License-Identifier: Apache-2.0
"""Videos and tables of their frames, for the stress test of damaged files; see `hostile.py`."""

from __future__ import annotations

import json
from pathlib import Path

from walk_videos import sliding, write_walk

from clsplat.scenes.video.frames import FRAME_TABLE_FILE, frame_sequences, take_frames


def make_video(folder: Path) -> None:
    """Write a video whose textured picture moves."""
    write_walk(folder / "walk.mp4", sliding(12))


def read_video(folder: Path) -> None:
    """Take frames of the video."""
    take_frames([folder / "walk.mp4"], folder / "taken", count=4, overwrite=True)


def make_frames(folder: Path) -> None:
    """Write a table of frames, with an empty file for each frame."""
    frames = [{"name": f"walk.mp4/{index:06d}.jpg", "frame": index, "seconds": 0.1 * index} for index in range(3)]
    for frame in frames:
        path = folder / "frames" / str(frame["name"])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    row = {"video": "walk.mp4", "sha256": "0", "asked": None, "frames": frames, "preview": "", "advice": []}
    (folder / "frames" / FRAME_TABLE_FILE).write_text(json.dumps({"version": 1, "videos": [row]}))


def read_frames(folder: Path) -> None:
    """Read the order of the frames."""
    frame_sequences(folder / "frames")
