# SPDX-License-Identifier: Apache-2.0
"""Videos and tables of their frames, for the stress test of damaged files; see `hostile.py`."""

from __future__ import annotations

from pathlib import Path

from walk_videos import sliding, write_walk

from clsplat.scenes.video.frames import frame_sequences, take_frames


def make_video(folder: Path) -> None:
    """Write a video whose textured picture moves."""
    write_walk(folder / "walk.mp4", sliding(12))


def read_video(folder: Path) -> None:
    """Take frames of the video."""
    take_frames([folder / "walk.mp4"], folder / "taken", count=4, overwrite=True)


def make_frames(folder: Path) -> None:
    """Write a video, and take its frames."""
    make_video(folder)
    read_frames(folder)


def read_frames(folder: Path) -> None:
    """Use the frames that were taken before, and read their order."""
    frame_sequences(folder / "frames")
    take_frames([folder / "walk.mp4"], folder / "frames", count=4)
