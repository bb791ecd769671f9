# SPDX-License-Identifier: Apache-2.0
"""Progress as plain lines and as a bar."""

import io
import json
from contextlib import redirect_stderr
from dataclasses import dataclass
from typing import Any

import pytest

from clsplat.progress import FrameProgress, StageProgress, TrainProgress, duration
from clsplat.sequence.task import Record


@dataclass
class Report:
    step: int
    loss: float = 0.5
    psnr: float = 20.0
    gaussians: int = 12345
    seconds: float = 0.0


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that the clock shows."""
    now = [0.0]
    monkeypatch.setattr("clsplat.progress.time.monotonic", lambda: now[0])
    return now


def test_plain_lines_now_and_then(now: list[float]) -> None:
    stream = io.StringIO()
    with redirect_stderr(stream), TrainProgress(100) as progress:
        for step in range(1, 51):
            now[0] += 0.5
            progress(Report(step, seconds=now[0]))
    lines = stream.getvalue().splitlines()
    assert lines[0] == "step 20/100  loss 0.5000  PSNR 20.00  12,345 Gaussians  2.0 steps/s  0:40 left"
    assert [line.split()[1] for line in lines] == ["20/100", "40/100", "50/100"]


def test_rate_counts_from_where_a_resumed_run_began() -> None:
    progress = TrainProgress(2000)
    assert progress.rate() == 0
    progress(Report(1001, seconds=500))
    progress(Report(1011, seconds=505))
    assert progress.rate() == 2


def test_a_bar_on_a_terminal() -> None:
    stream = Terminal()
    with redirect_stderr(stream), TrainProgress(10) as progress:
        progress(Report(10))
    assert "step 10/10" in stream.getvalue()
    assert "PSNR 20.00" in stream.getvalue()


def frames() -> list[Record]:
    return [Record("a", 7, "a.0007.exr", 8, 6, 0.25), Record("b", 8, "a.0008.exr", 8, 6, 0.0, skipped=True)]


def shown(style: Any, *, stream: io.StringIO, lines: io.StringIO | None) -> str:
    with redirect_stderr(stream), FrameProgress(2, style, lines=lines) as progress:
        for record in frames():
            progress(record)
    return "" if lines is None else lines.getvalue()


def test_frames_on_a_terminal_are_a_bar() -> None:
    bar = Terminal()
    assert shown("auto", stream=bar, lines=Terminal()) == ""  # lines would go through the bar
    assert "frame 8" in bar.getvalue()
    assert "2/2" in bar.getvalue()
    assert shown("auto", stream=Terminal(), lines=io.StringIO()) == "a.0007.exr  8x6  0.25 s\n"


def test_frames_elsewhere_are_lines() -> None:
    plain = io.StringIO()
    assert shown("auto", stream=plain, lines=io.StringIO()) == "a.0007.exr  8x6  0.25 s\n"
    assert shown("auto", stream=plain, lines=None) == ""
    assert shown("none", stream=plain, lines=io.StringIO()) == ""
    first, second = shown("json", stream=Terminal(), lines=io.StringIO()).splitlines()
    assert json.loads(first) == {
        "frame": 7,
        "name": "a",
        "path": "a.0007.exr",
        "seconds": 0.25,
        "skipped": False,
        "done": 1,
        "total": 2,
    }
    assert json.loads(second)["skipped"] is True
    assert shown("openjd", stream=plain, lines=io.StringIO()).splitlines() == [
        "openjd_progress: 50.0",
        "openjd_status: frame 7 took 0.25 s",
        "openjd_progress: 100.0",
        "openjd_status: frame 8 is there",
    ]
    assert plain.getvalue() == ""


def test_stages_are_told_apart(now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    progress = StageProgress()
    for stage, fraction in [("features", None), ("features", 0.5), ("matching", 0.0), ("matching", 1.0)]:
        progress(stage, fraction)
    now[0] = 11
    progress("matching", 0.25)
    assert capsys.readouterr().err.splitlines() == ["features", "matching 0 %", "matching 100 %", "matching 25 %"]


def test_durations() -> None:
    assert [duration(s) for s in (0, 59.6, 61, 3600, 36061)] == ["0:00", "1:00", "1:01", "1:00:00", "10:01:01"]


def test_what_is_quick_is_not_told(now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    progress = StageProgress(after=2.0)
    for time, part in ((0.0, 0.0), (1.9, 0.4), (2.1, 0.5), (3.0, 0.6), (12.5, 0.9)):
        now[0] = time
        progress("palette", part)
    assert capsys.readouterr().err.splitlines() == ["palette 50 %", "palette 90 %"]
