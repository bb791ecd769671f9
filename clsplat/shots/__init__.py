# SPDX-License-Identifier: Apache-2.0
"""Camera input: camera files and generated camera paths become a `Shot`. No world is reoriented here."""

from clsplat.shots.read import check_around, choose_shot, read_shot, shot_around
from clsplat.shots.shot import Frame, Shot

__all__ = ["Frame", "Shot", "check_around", "choose_shot", "read_shot", "shot_around"]
