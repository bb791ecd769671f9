# SPDX-License-Identifier: Apache-2.0
"""The stress test of videos, on a small walk."""

from __future__ import annotations

import pytest
from calls import Capture
from needs import require

require("av")
import stress_videos  # noqa: E402


@pytest.mark.slow
def test_a_small_walk_in_three_codings(capsys: Capture) -> None:
    assert stress_videos.main(["--width", "96", "--height", "72", "--frames", "60", "--choose", "12"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines[1:]] == ["H.264", "H.264, turned", "HEVC, HLG"]
