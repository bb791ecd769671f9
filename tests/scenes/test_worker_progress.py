# SPDX-License-Identifier: Apache-2.0
"""Progress of the worker of structure from motion, counted by the files that it writes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pictures import write_pixels

from clsplat.scenes.sfm import worker_progress
from clsplat.scenes.sfm.worker_progress import UNDISTORTED_IMAGES


def test_photos_are_counted_while_the_worker_moves_them_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        write_pixels(tmp_path / UNDISTORTED_IMAGES / name / "1.png", np.zeros((2, 2, 3), np.uint8))
    listed = os.scandir

    def moved_before(path: Any) -> Any:
        if Path(path).name == "b":
            Path(path).rename(tmp_path / "moved")
        return listed(path)

    monkeypatch.setattr(os, "scandir", moved_before)
    assert worker_progress._count(tmp_path, UNDISTORTED_IMAGES) == 1
