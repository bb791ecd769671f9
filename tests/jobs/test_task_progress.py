# SPDX-License-Identifier: Apache-2.0
"""The display of tasks: one line for all of them, at intervals and at the end."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from types import SimpleNamespace

import pytest

from clsplat import progress
from clsplat.jobs.dispatcher import JobProgress
from clsplat.progress import TaskProgress, TrainProgress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


STEPS = (
    JobProgress(0, 5, 0, 1000, ("0_0", "0_1")),
    JobProgress(1, 5, 250, 1000, ("0_1", "1_0", "1_1", "1_2"), 1),
    JobProgress(4, 5, 1000, 1000),
)


def shown(monkeypatch: pytest.MonkeyPatch, style: str = "auto") -> tuple[str, str]:
    """Standard output and error of a display that is called every 20 seconds."""
    out, err = io.StringIO(), io.StringIO()
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with redirect_stdout(out), redirect_stderr(err), TaskProgress("tasks", style) as display:  # type: ignore[arg-type]
        for one in STEPS:
            display(one)
            display(one)
            now[0] += 20.0
    return out.getvalue(), err.getvalue()


def test_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    out, err = shown(monkeypatch)
    assert out == ""
    assert err.splitlines() == [
        "0 of 5 tasks done  step 0/1,000  now 0_0, 0_1",
        "1 of 5 tasks done, 1 failed  step 250/1,000  now 0_1, 1_0, 1_1 and 1 more  1:00 left",
        "4 of 5 tasks done  step 1,000/1,000",
    ]


def test_open_job_description(monkeypatch: pytest.MonkeyPatch) -> None:
    out, err = shown(monkeypatch, "openjd")
    assert err == ""
    assert [line for line in out.splitlines() if "progress" in line] == [
        "openjd_progress: 0.0",
        "openjd_progress: 25.0",
        "openjd_progress: 100.0",
    ]
    assert out.splitlines()[1] == "openjd_status: 0 of 5 tasks done  step 0/1,000  now 0_0, 0_1"


def test_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    with redirect_stderr(stream), TaskProgress("tasks") as display:
        for one in STEPS:
            display(one)
        assert display.live is not None
        assert display.live.tasks[0].completed == 1000
        assert display.live.tasks[0].description == "4 of 5 tasks done  step 1,000/1,000"


def test_a_training_for_open_job_description(monkeypatch: pytest.MonkeyPatch) -> None:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), TrainProgress(50, style="openjd") as display:
        for step in (10, 20):
            display(SimpleNamespace(step=step, loss=0.1, psnr=20.0, gaussians=1200, seconds=float(step)))
    assert err.getvalue() == ""
    assert out.getvalue().splitlines() == [
        "openjd_progress: 40.0",
        "openjd_status: step 20/50  loss 0.1000  PSNR 20.00  1,200 Gaussians  1.0 steps/s  0:30 left",
    ]
