# SPDX-License-Identifier: Apache-2.0
"""Camera input: camera files and generated camera paths become a `Shot`. The world is never reoriented."""

from clsplat.shots.read import check_around, choose_shot, read_shot, shot_around
from clsplat.shots.shot import Frame, Shot

__all__ = ["Frame", "Shot", "check_around", "choose_shot", "read_shot", "shot_around"]
