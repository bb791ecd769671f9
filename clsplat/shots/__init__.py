# SPDX-License-Identifier: Apache-2.0
"""Cameras in: files of cameras and generated paths, as one `Shot`. The world is never re-oriented."""

from clsplat.shots.read import check_around, choose_shot, read_shot, shot_around
from clsplat.shots.shot import Frame, Shot

__all__ = ["Frame", "Shot", "check_around", "choose_shot", "read_shot", "shot_around"]
