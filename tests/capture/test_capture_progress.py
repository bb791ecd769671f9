# SPDX-License-Identifier: Apache-2.0
"""Remaining time of a capture, and its stages in messages of errors."""

from __future__ import annotations

import errno
import io
from collections.abc import Iterator
from contextlib import redirect_stderr

import pytest
from calls import Capture

from clsplat.capture import progress as module
from clsplat.capture.progress import PACE_PRIOR_SECONDS, CaptureProgress
from clsplat.errors import CapacityError, ClsplatError, DeviceError, InputError, KernelBuildError, WriteError

EXPECTED = {"frames": 10.0, "cameras": 40.0, "training": 100.0, "report": 5.0}


class Clock:
    """A clock that tests advance."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def test_before_the_first_stage_everything_is_left(clock: Clock) -> None:
    assert CaptureProgress(EXPECTED, "again").left() == sum(EXPECTED.values())


def test_half_of_a_stage(clock: Clock) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    with progress.stage("training"):
        clock.now += 80.0
        progress("step", 0.5)
        # half by the measured 80 s, and half by the 100 s that were expected; then the report
        assert progress.left() == pytest.approx(0.5 * (80 + 0.5 * 100) + 5)
        progress("step", 1.0)
        assert progress.left() == pytest.approx(5)


def test_a_slow_machine_is_slow_later_too(clock: Clock) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    with progress.stage("frames"):
        clock.now += 30.0
    pace = (PACE_PRIOR_SECONDS + 30) / (PACE_PRIOR_SECONDS + 10)
    with progress.stage("cameras"):
        assert progress.left() == pytest.approx(pace * (40 + 100 + 5))


def test_results_that_were_there_say_nothing_about_the_pace(clock: Clock) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    with progress.stage("cameras"):
        clock.now += 0.1
    assert progress.pace() == 1.0


def test_a_forecast_replaces_the_expectation(clock: Clock) -> None:
    class Forecast:
        def see(self, report: object) -> None: ...

        def left(self) -> float | None:
            return 33.0

    progress = CaptureProgress(EXPECTED, "again")
    with progress.stage("training"):
        progress.forecast = Forecast()
        assert progress.left() == 33.0 + 5.0


def test_parts_of_the_cameras_add_up(clock: Clock) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    progress.expect("cameras", 200.0)
    with progress.stage("cameras"):
        lefts = []
        for text, fraction in (
            ("reading photos", 1.0),
            ("finding features", 0.5),
            ("matching photos", None),
            ("matching photos", 1.0),
            ("a part that nobody knows", 0.1),
            ("placing cameras, second try", 0.5),
            ("undistorting photos", 1.0),
        ):
            progress(text, fraction)
            lefts.append(progress.left())
        assert lefts == sorted(lefts, reverse=True)
        assert lefts[-1] == pytest.approx(100 + 5)


def test_lines_say_stage_part_and_time(clock: Clock, capsys: Capture) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    with progress.stage("report"):
        progress("writing", None)
        progress("writing", 0.5)  # within ten seconds of the line before
        clock.now += 11
        progress("writing", 1.0)
        progress("counted", 0.25, " 1 of 4")
    lines = ["4/4 report: writing  about 0:05 left", "4/4 report: writing 100 %  about 0:00 left"]
    assert capsys.readouterr().err.splitlines()[:2] == lines


def test_a_bar_on_a_terminal_and_findings_above_it() -> None:
    class TerminalText(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = TerminalText()
    with redirect_stderr(stream), CaptureProgress(EXPECTED, "again") as progress, progress.stage("frames"):
        progress("walk.mp4: 31 of 160 frames chosen")
        progress("writing the frames", 0.5)
        assert progress.live is not None
        (task,) = progress.live.tasks
        assert task.description.startswith("1/4 frames: writing the frames 50 %  about ")
        assert 0 <= task.completed <= task.total
    assert "frames: walk.mp4: 31 of 160 frames chosen" in stream.getvalue()


@pytest.mark.parametrize(
    ("error", "kind", "text", "status"),
    [
        (InputError("a.jpg: is damaged"), InputError, "stage cameras: a.jpg: is damaged", 2),
        (DeviceError("--device x: no such"), DeviceError, "stage cameras: --device x: no such", 2),
        (CapacityError("too large"), CapacityError, "stage cameras: too large", 1),
        (KernelBuildError("not built", "log", "source"), KernelBuildError, "stage cameras: not built", 1),
        (OSError(errno.ENOSPC, "No space", "a"), ClsplatError, "stage cameras: a: the disk is full", 1),
        (
            WriteError(errno.ENOENT, "there is no folder", "b"),
            InputError,
            "stage cameras: b: cannot be written: there is no folder",
            2,
        ),
        (MemoryError(), ClsplatError, "stage cameras: there is not enough main memory: the system has no more", 1),
    ],
)
def test_an_error_says_its_stage(error: Exception, kind: type[ClsplatError], text: str, status: int) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    with pytest.raises(kind) as caught, progress.stage("cameras"):
        raise error
    assert (str(caught.value), caught.value.exit_status) == (text, status)


@pytest.mark.parametrize("error", [BrokenPipeError(), ValueError("a fault of clsplat")])
def test_other_errors_stay_as_they_are(error: Exception) -> None:
    progress = CaptureProgress(EXPECTED, "again")
    with pytest.raises(type(error)) as caught, progress.stage("cameras"):
        raise error
    assert caught.value is error


def test_an_interruption_says_how_to_go_on() -> None:
    progress = CaptureProgress(EXPECTED, "clsplat capture walk.mp4 -o shot")
    with pytest.raises(KeyboardInterrupt) as caught, progress.stage("training"):
        raise KeyboardInterrupt("at step 7")
    assert caught.value.args == ("in the stage training at step 7; go on with: clsplat capture walk.mp4 -o shot",)
