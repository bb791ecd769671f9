# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: a live bar on a terminal, else a plain line every ten seconds; and tables of text."""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal, Protocol, TextIO

from typing_extensions import Self

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

Progress = Callable[[str, float | None], None]
"""A listener: the text of a stage, and the part of it that is done, None where that is not known."""
PLAIN_INTERVAL = 10.0
"""Seconds between plain lines."""
SMOOTHING = 0.1
"""Weight of the newest report in the shown PSNR and loss, which jump from view to view."""
RECENT = 20.0
"""Seconds of training that the shown rate is of."""


class Forecast(Protocol):
    """A teller of the time that is left, for `TrainProgress` (`training.forecast.Forecast`)."""

    def see(self, report: Any) -> None:
        """Take a report."""

    def left(self) -> float | None:
        """Seconds from the last report to the end, or None."""


class Counted(float):
    """A fraction that is told as a count: 12 of 25 stand. total: at least 1."""

    def __new__(cls, done: int, total: int, verb: str) -> Self:
        """The fraction done / total, at most 1."""
        value = super().__new__(cls, min(done / total, 1.0))
        value.text = f"{min(done, total):,} of {total:,} {verb}"
        return value

    text: str


def no_progress(text: str, fraction: float | None = None) -> None:
    """A listener that passes over everything."""


class _Bar:
    """A context manager with a live bar where standard error is a terminal; `live` is None elsewhere."""

    live: RichProgress | None = None

    def __init__(self, description: str, total: int, *, counted: bool = False) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        if sys.stderr.isatty():
            # frames are counted, and alike; what is left of steps is in their description
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


class TrainProgress(_Bar):
    """Progress of a training of `total` steps; call it with each `training.loop.StepReport`, every step or now and
    then. forecast: tells what is left; without one each step is taken to be like the last ones."""

    def __init__(self, total: int, forecast: Forecast | None = None) -> None:
        super().__init__(f"step 0/{total}", total)
        self.total, self.forecast = total, forecast
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
        elif report.step <= self.last.step:  # a training that has returned to a checkpoint
            self.recent.clear()
        self.last = report
        self.recent.append(report)
        while len(self.recent) > 2 and report.seconds - self.recent[1].seconds >= RECENT:
            self.recent.popleft()
        if self.forecast is not None:
            self.forecast.see(report)
        self.loss += SMOOTHING * (report.loss - self.loss)
        self.psnr += SMOOTHING * (report.psnr - self.psnr)
        if self.live is not None:
            self.live.update(self.task, completed=report.step, description=f"{self._numbers()}{self._left()}")
        elif time.monotonic() - self.printed_at >= PLAIN_INTERVAL and self.rate() > 0:
            self._print_line()

    def rate(self) -> float:
        """Steps a second of the last RECENT seconds; 0 before there are two reports."""
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
        with suppress(OSError):  # its reader has gone: a training goes on, or comes to its checkpoint
            print(f"{self._numbers()}{self._left()}", file=sys.stderr, flush=True)
        self.printed_at, self.printed_step = time.monotonic(), self.last.step


class StageProgress:
    """Progress of work in named stages: call it with the stage and the fraction done, or None where that is unknown.

    A fraction that is `Counted` is told as a count, and the last of a stage always. after: seconds in which nothing is
    said, for work that is mostly quick.
    """

    def __init__(self, after: float = 0.0) -> None:
        self.stage, self.printed_at = "", time.monotonic()
        self.silent_until = self.printed_at + after
        self.untold = ""

    def __call__(self, stage: str, fraction: float | None = None) -> None:
        now = time.monotonic()
        if now < self.silent_until:
            return
        if isinstance(fraction, Counted):
            text = f"{stage}: {fraction.text}"
        else:
            text = stage if fraction is None else f"{stage} {100 * fraction:.0f} %"
        if stage != self.stage and self.untold:
            self._tell(self.untold)
        if stage != self.stage or now - self.printed_at >= PLAIN_INTERVAL or fraction == 1.0:
            self._tell(text)
            self.stage, self.printed_at, self.untold = stage, now, ""
        else:
            self.untold = text if isinstance(fraction, Counted) else ""

    def _tell(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)


class FrameProgress(_Bar):
    """Progress of frames; call it with each `sequence.task.Record` when its file is complete.

    total: frames, skipped ones too; style: auto, a bar on standard error where that is a terminal, and a line for each
    frame written, with the time left, on `lines` unless that is None or both are one terminal; json, an object a line
    there; openjd, what Open Job Description takes for progress; none.
    """

    def __init__(
        self, total: int, style: Literal["auto", "json", "openjd", "none"] = "auto", *, lines: TextIO | None = None
    ) -> None:
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
            names = ("frame", "name", "path", "seconds", "skipped")
            values: dict[str, Any] = {name: getattr(record, name) for name in names}
            text = json.dumps({**values, "done": self.done, "total": self.total})
        elif self.style == "openjd":
            did = "is there" if record.skipped else f"took {record.seconds:.2f} s"
            text = f"openjd_progress: {100 * self.done / self.total:.1f}\nopenjd_status: frame {record.frame} {did}"
        elif record.skipped:
            return
        else:
            text = f"{record.path}  {record.width}x{record.height}  {record.seconds:.2f} s{self._left()}"
        print(text, file=self.lines, flush=True)

    def _left(self) -> str:
        """The time that is left, if frames go on as they did. The first one counts only until there is another: kernels
        may be built in its time. Empty where there is less than half a second."""
        now = time.monotonic()
        if self.written == 1:
            self.first_at = now
        each = (now - self.first_at) / (self.written - 1) if self.written > 1 else now - self.began
        seconds = (self.total - self.done) * each
        return f"  {duration(seconds)} left" if seconds >= 0.5 else ""


def duration(seconds: float) -> str:
    """h:mm:ss or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """A line for each row. The columns `left` are aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = ["<" if index in left else ">" for index in range(len(widths))]
    line = "  ".join(f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True))
    return [line.format(*row).rstrip() for row in rows]
