# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: a live bar on a terminal, else a plain line every ten seconds. Also text tables."""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal, Protocol, TextIO

from typing_extensions import Self

from clsplat.errors import examples

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

Progress = Callable[[str, float | None], None]
"""A progress callback. It takes the text of a stage and the fraction that is done, or None if that is unknown."""
PLAIN_LINE_SECONDS = 10.0
"""Seconds between lines of progress if standard error is not a terminal."""
LIVE_TEXT_SECONDS = 1.0
"""Seconds between updates of a live bar's text. Its forecast takes several milliseconds, like a training step on a GPU.
"""
METRIC_SMOOTHING_WEIGHT = 0.1
"""Weight of the newest report in the displayed PSNR and loss, which are smoothed because views differ."""
RATE_WINDOW_SECONDS = 20.0
"""Seconds of training over which the displayed rate is averaged."""
TASK_RATE_WINDOW_SECONDS = 600.0
"""Seconds over which the steps of all tasks are averaged, to estimate the remaining time."""
ProgressStyle = Literal["auto", "json", "openjd", "none"]
"""How progress is written. "auto": a bar on standard error if that is a terminal, else lines of text. "json": one
object per line. "openjd": progress lines of Open Job Description. "none": nothing."""


class RemainingTime(Protocol):
    """An estimator of the remaining time, for `TrainProgress` (`training.forecast.Forecast`)."""

    def see(self, report: Any) -> None:
        """Update the estimate of the remaining time with a `training.loop.StepReport`."""

    def left(self) -> float | None:
        """Seconds from the last report to the end, or None if they cannot be estimated yet."""


class CountedFraction(float):
    """A fraction that is reported as a count, such as "12 of 25 registered". total: at least 1."""

    def __new__(cls, done: int, total: int, verb: str) -> Self:
        """The fraction done / total, at most 1. verb: what was done, such as "registered"."""
        value = super().__new__(cls, min(done / total, 1.0))
        value.text = f"{min(done, total):,} of {total:,} {verb}"
        return value

    text: str


def no_progress(text: str, fraction: float | None = None) -> None:
    """A progress callback that does nothing."""


class LiveBar:
    """A live progress bar, as a context manager. `live` is None if standard error is not a terminal."""

    live: RichProgress | None = None

    def __init__(self, description: str, total: int, *, counted: bool = False) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        if sys.stderr.isatty():
            # `rich` estimates the remaining time of frames, which take similar times. Training adds its own estimate.
            more = [MofNCompleteColumn(), TimeRemainingColumn()] if counted else []
            columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), *more)
            self.live = Progress(
                *columns, console=Console(file=sys.stderr), refresh_per_second=4, speed_estimate_period=60
            )
            self.task = self.live.add_task(description, total=total)

    def __enter__(self) -> Self:
        if self.live is not None:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live is not None:
            with suppress(OSError):
                self.live.stop()


class TrainProgress(LiveBar):
    """Progress of a training of `total` steps. Call it with a `training.loop.StepReport` after some or all steps.

    forecast: estimates the remaining time. Without it the remaining steps are assumed to take as long as the last ones.
    style: "auto": a bar, or lines on standard error. "openjd": lines on standard output.
    """

    def __init__(
        self, total: int, forecast: RemainingTime | None = None, style: Literal["auto", "openjd"] = "auto"
    ) -> None:
        if style == "auto":
            super().__init__(f"step 0/{total}", total)
        self.total, self.forecast, self.style = total, forecast, style
        self.last: Any = None
        self.recent: deque[Any] = deque()
        self.loss, self.psnr = 0.0, 0.0
        self.printed_at, self.printed_step = time.monotonic(), -1

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.live is None and self.last is not None and self.last.step != self.printed_step:
            self._print_line()

    def __call__(self, report: Any) -> None:
        if self.last is None:
            self.loss, self.psnr = report.loss, report.psnr
        elif report.step <= self.last.step:  # training went back to a checkpoint
            self.recent.clear()
        self.last = report
        self.recent.append(report)
        while len(self.recent) > 2 and report.seconds - self.recent[1].seconds >= RATE_WINDOW_SECONDS:
            self.recent.popleft()
        if self.forecast is not None:
            self.forecast.see(report)
        self.loss += METRIC_SMOOTHING_WEIGHT * (report.loss - self.loss)
        self.psnr += METRIC_SMOOTHING_WEIGHT * (report.psnr - self.psnr)
        if self.live is not None:
            self.live.update(self.task, completed=report.step)
            if time.monotonic() - self.printed_at >= LIVE_TEXT_SECONDS or report.step == self.total:
                self.live.update(self.task, description=f"{self._numbers()}{self._left()}")
                self.printed_at = time.monotonic()
        elif time.monotonic() - self.printed_at >= PLAIN_LINE_SECONDS and self.rate() > 0:
            self._print_line()

    def rate(self) -> float:
        """Steps per second over the last RATE_WINDOW_SECONDS seconds; 0 before there are two reports."""
        if len(self.recent) < 2 or self.recent[-1].seconds <= self.recent[0].seconds:
            return 0.0
        first, last = self.recent[0], self.recent[-1]
        return float((last.step - first.step) / (last.seconds - first.seconds))

    def _numbers(self) -> str:
        numbers = (
            f"step {self.last.step}/{self.total}  loss {self.loss:.4f}  PSNR {self.psnr:.2f}  "
            f"{self.last.gaussians:,} Gaussians"
        )
        rate = self.rate()
        return f"{numbers}  {rate:.{1 if rate >= 1 else 3}f} steps/s" if rate > 0 else numbers

    def _left(self) -> str:
        seconds = self.forecast.left() if self.forecast is not None else None
        if seconds is None:
            rate = self.rate()
            seconds = (self.total - self.last.step) / rate if rate > 0 else None
        return "" if seconds is None else f"  {duration(seconds)} left"

    def _print_line(self) -> None:
        with suppress(OSError):  # the program that reads the output has ended: training goes on
            if self.style == "openjd":
                print(openjd_lines(self.last.step / self.total, f"{self._numbers()}{self._left()}"), flush=True)
            else:
                print(f"{self._numbers()}{self._left()}", file=sys.stderr, flush=True)
        self.printed_at, self.printed_step = time.monotonic(), self.last.step


class StageProgress:
    """Progress of work in named stages. Call it with the stage's name and the fraction done, or None if unknown.

    A `CountedFraction` is reported as a count. The last report of a stage is always shown.
    after: seconds at the start during which nothing is printed, for work that is usually quick.
    """

    def __init__(self, after: float = 0.0) -> None:
        self.stage, self.printed_at = "", time.monotonic()
        self.silent_until = self.printed_at + after
        self.untold = ""

    def __call__(self, stage: str, fraction: float | None = None) -> None:
        now = time.monotonic()
        if now < self.silent_until:
            return
        if isinstance(fraction, CountedFraction):
            text = f"{stage}: {fraction.text}"
        else:
            text = stage if fraction is None else f"{stage} {100 * fraction:.0f} %"
        if stage != self.stage and self.untold:
            self._tell(self.untold)
        if stage != self.stage or now - self.printed_at >= PLAIN_LINE_SECONDS or fraction == 1.0:
            self._tell(text)
            self.stage, self.printed_at, self.untold = stage, now, ""
        else:
            self.untold = text if isinstance(fraction, CountedFraction) else ""

    def _tell(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)


class FrameProgress(LiveBar):
    """Progress of frames. Call it with each `sequence.task.Record` when its file is complete.

    total: number of frames, skipped ones included.
    lines: stream for lines of progress, None for none.
    style: "auto": a bar on standard error if that is a terminal, and on `lines` a line for each written frame, with the
      remaining time. No lines are written if `lines` is None, or if both streams are terminals.
      "json": one object per line on `lines`. "openjd": progress lines of Open Job Description. "none": nothing.
    """

    def __init__(self, total: int, style: ProgressStyle = "auto", *, lines: TextIO | None = None) -> None:
        self.total, self.style, self.lines, self.done = total, style, lines, 0
        self.written, self.began = 0, time.monotonic()
        self.first_at = self.began
        if style == "auto":
            super().__init__("frames", total, counted=True)
        if self.live is not None and lines is not None and lines.isatty():
            self.lines = None

    def __call__(self, record: Any) -> None:
        self.done += 1
        self.written += not record.skipped
        if self.live is not None:
            self.live.update(self.task, completed=self.done, description=f"frame {record.frame}")
        if self.lines is None or self.style == "none":
            return
        if self.style == "json":
            line = {
                "frame": record.frame,
                "name": record.name,
                "path": record.path,
                "seconds": record.seconds,
                "skipped": record.skipped,
                "done": self.done,
                "total": self.total,
            }
            text = json.dumps(line)
        elif self.style == "openjd":
            did = "exists" if record.skipped else f"took {record.seconds:.2f} s"
            text = openjd_lines(self.done / self.total, f"frame {record.frame} {did}")
        elif record.skipped:
            return
        else:
            text = f"{record.path}  {record.width}x{record.height}  {record.seconds:.2f} s{self._left()}"
        print(text, file=self.lines, flush=True)

    def _left(self) -> str:
        """Return a text with the remaining time, or an empty text if that is less than half a second.

        The estimate is the mean time of a written frame times the number of frames left. As soon as two frames are
        written, the mean leaves out the first one, because kernels may have been built during it.
        """
        now = time.monotonic()
        if self.written == 1:
            self.first_at = now
        each = (now - self.first_at) / (self.written - 1) if self.written > 1 else now - self.began
        seconds = (self.total - self.done) * each
        return f"  {duration(seconds)} left" if seconds >= 0.5 else ""


class TaskProgress(LiveBar):
    """Progress of tasks. Call it with a `jobs.dispatcher.JobProgress` at intervals.

    what: word for the tasks in the plural, such as "tasks".
    style: "auto": a bar or lines on standard error. "openjd": lines on standard output.
    """

    def __init__(self, what: str = "tasks", style: Literal["auto", "openjd"] = "auto") -> None:
        if style == "auto":
            super().__init__(what, 1)
        self.what, self.style = what, style
        self.recent: deque[tuple[float, int]] = deque()
        self.last: Any = None
        self.printed_at, self.printed = float("-inf"), ""

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.live is None and self.last is not None:
            self._print_line()

    def __call__(self, progress: Any) -> None:
        now = time.monotonic()
        self.last = progress
        self.recent.append((now, progress.steps))
        while len(self.recent) > 2 and now - self.recent[1][0] >= TASK_RATE_WINDOW_SECONDS:
            self.recent.popleft()
        if self.live is not None:
            text = self._text(progress) + self._left(progress)
            self.live.update(self.task, completed=progress.steps, total=progress.total_steps, description=text)
        elif now - self.printed_at >= PLAIN_LINE_SECONDS:
            self._print_line()
            self.printed_at = now

    def _print_line(self) -> None:
        """Print a line, unless it says the same as the last one."""
        if (text := self._text(self.last)) == self.printed:
            return
        self.printed, line = text, text + self._left(self.last)
        with suppress(OSError):  # the program that reads the output has ended: the tasks go on
            if self.style == "openjd":
                print(openjd_lines(self.last.steps / max(self.last.total_steps, 1), line), flush=True)
            else:
                print(line, file=sys.stderr, flush=True)

    def _text(self, progress: Any) -> str:
        failed = f", {progress.failed:,} failed" if progress.failed else ""
        names = f"  now {examples(progress.running)}" if progress.running else ""
        return (
            f"{progress.done:,} of {progress.total:,} {self.what} done{failed}  "
            f"step {progress.steps:,}/{progress.total_steps:,}{names}"
        )

    def _left(self, progress: Any) -> str:
        """Return a text with the remaining time; empty without progress in the last TASK_RATE_WINDOW_SECONDS."""
        (begin, first), (end, last) = self.recent[0], self.recent[-1]
        if last <= first or not progress.running:
            return ""
        return f"  {duration((progress.total_steps - last) * (end - begin) / (last - first))} left"


def openjd_lines(fraction: float, status: str) -> str:
    """Lines by which a task of Open Job Description reports its progress. fraction: from 0 to 1."""
    return f"openjd_progress: {100 * fraction:.1f}\nopenjd_status: {status}"


def duration(seconds: float) -> str:
    """Format a number of seconds as h:mm:ss or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """Format a table, one line per row. left: indices of the left-aligned columns; the others are right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = ["<" if index in left else ">" for index in range(len(widths))]
    line = "  ".join(f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True))
    return [line.format(*row).rstrip() for row in rows]
