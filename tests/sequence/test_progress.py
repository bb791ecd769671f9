# SPDX-License-Identifier: Apache-2.0
"""Progress as plain lines and as a bar."""

import io
import json
from contextlib import redirect_stderr
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from clsplat.progress import CountedFraction, FrameProgress, StageProgress, TrainProgress, duration
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
        "openjd_status: frame 8 exists",
    ]
    assert plain.getvalue() == ""


def test_lines_of_frames_have_the_time_left(now: list[float]) -> None:
    """By the frames after the first, which may have built kernels; those that were there do not count."""
    lines = io.StringIO()
    took = [0.0, 0.0, 30.0, 2.0, 4.0, 600.0, 0.2]
    with redirect_stderr(io.StringIO()), FrameProgress(9, lines=lines) as progress:
        for number, seconds in enumerate(took):
            now[0] += seconds
            progress(Record(f"{number}", number, "a.exr", 8, 6, seconds, skipped=seconds == 0))
    left = [line.partition(" s")[2].strip() for line in lines.getvalue().splitlines()]
    # 6 of 30; 5 of 2; 4 of 3; 3 of 202; 2 of 151.55
    assert left == ["3:00 left", "0:10 left", "0:12 left", "10:06 left", "5:03 left"]


def test_the_last_frame_has_no_time_left(now: list[float]) -> None:
    lines = io.StringIO()
    with redirect_stderr(io.StringIO()), FrameProgress(2, lines=lines) as progress:
        for number in (1, 2):
            now[0] += 5
            progress(Record(f"{number}", number, "a.exr", 8, 6, 5.0))
    assert lines.getvalue() == "a.exr  8x6  5.00 s  0:05 left\na.exr  8x6  5.00 s\n"


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


class Fixed:
    """A forecast that knows."""

    def __init__(self, left: float | None) -> None:
        self.seen: list[int] = []
        self._left = left

    def see(self, report: Report) -> None:
        self.seen.append(report.step)

    def left(self) -> float | None:
        return self._left


@pytest.mark.parametrize(("left", "words"), [(754.0, "12:34 left"), (None, "0:40 left"), (0.0, "0:00 left")])
def test_the_time_left_is_the_forecasts(now: list[float], left: float | None, words: str) -> None:
    stream, forecast = io.StringIO(), Fixed(left)
    with redirect_stderr(stream), TrainProgress(100, forecast) as progress:
        for step in range(1, 21):
            now[0] += 0.5
            progress(Report(step, seconds=now[0]))
    assert stream.getvalue().splitlines()[0].endswith(f"2.0 steps/s  {words}")
    assert forecast.seen == list(range(1, 21))


def test_a_live_bar_asks_for_the_time_left_once_a_second(now: list[float]) -> None:
    """A GPU reports a hundred times a second, and a forecast takes as long as some of its steps."""
    progress, forecast, shown = TrainProgress(1000), Fixed(754.0), []
    progress.forecast = forecast
    progress.live = SimpleNamespace(update=lambda _, **changes: shown.append(changes))  # type: ignore[assignment]
    progress.task = 0  # type: ignore[assignment]
    for step in range(10, 1001, 10):
        now[0] += 0.05
        progress(Report(step, seconds=now[0]))
    texts = [each["description"] for each in shown if "description" in each]
    assert len(texts) == 5, "one a second; the fifth is the end's"
    assert texts[-1].startswith("step 1000/1000")
    assert texts[-1].endswith("12:34 left")
    assert [each["completed"] for each in shown if "completed" in each] == list(range(10, 1001, 10))


def test_the_first_line_has_a_rate(now: list[float]) -> None:
    """Kernels are built for 30 s before the first report; a line comes with the second, which tells a rate."""
    stream = io.StringIO()
    with redirect_stderr(stream), TrainProgress(100) as progress:
        for step, seconds in ((10, 30.0), (20, 31.0)):
            now[0] = seconds
            progress(Report(step, seconds=seconds))
            assert len(stream.getvalue().splitlines()) == (step == 20)
    assert "step 20/100" in stream.getvalue()
    assert "10.0 steps/s  0:08 left" in stream.getvalue()


def test_the_rate_is_that_of_the_last_seconds() -> None:
    progress = TrainProgress(10_000)
    with redirect_stderr(io.StringIO()):
        for second in range(100):  # ten steps a second, then one
            progress(Report(10 * second, seconds=second))
        for second in range(1, 41):
            progress(Report(990 + second, seconds=99.0 + second))
    assert progress.rate() == 1


def test_counts_are_told_as_such_and_the_last_always(now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    progress = StageProgress()
    for second, done in ((0.0, 0), (3.0, 7), (10.5, 12), (12.0, 23)):
        now[0] = second
        progress("placing cameras", CountedFraction(done, 25, "cameras placed"))
    progress("undistorting photos", None)
    progress("placing cameras", CountedFraction(2, 2, "cameras placed"))
    progress("done", None)
    assert capsys.readouterr().err.splitlines() == [
        "placing cameras: 0 of 25 cameras placed",
        "placing cameras: 12 of 25 cameras placed",
        "placing cameras: 23 of 25 cameras placed",
        "undistorting photos",
        "placing cameras: 2 of 2 cameras placed",
        "done",
    ]


@pytest.mark.parametrize(("done", "part", "text"), [(0, 0.0, "0 of 8 x"), (2, 0.25, "2 of 8 x"), (9, 1.0, "8 of 8 x")])
def test_a_count_is_a_fraction(done: int, part: float, text: str) -> None:
    assert CountedFraction(done, 8, "x") == part
    assert CountedFraction(done, 8, "x").text == text
