# SPDX-License-Identifier: Apache-2.0
"""Progress on standard error: a live bar on a terminal, else a plain line every ten seconds; and tables of text."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal, TextIO

from typing_extensions import Self

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

Progress = Callable[[str, float | None], None]
"""A listener: the text of a stage, and the part of it that is done, None where that is not known."""
PLAIN_INTERVAL = 10.0
"""Seconds between plain lines."""
SMOOTHING = 0.1
"""Weight of the newest report in the shown PSNR and loss, which jump from view to view."""


def no_progress(text: str, fraction: float | None = None) -> None:
    """A listener that passes over everything."""


class _Bar:
    """A context manager with a live bar where standard error is a terminal; `live` is None elsewhere."""

    live: RichProgress | None = None

    def __init__(self, description: str, total: int, *, counted: bool = False) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        if sys.stderr.isatty():
            count = [MofNCompleteColumn()] if counted else []
            columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), *count, TimeRemainingColumn())
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
    then."""

    def __init__(self, total: int) -> None:
        super().__init__(f"step 0/{total}", total)
        self.total = total
        self.first: Any = None
        self.last: Any = None
        self.loss, self.psnr = 0.0, 0.0
        self.printed_at, self.printed_step = time.monotonic(), -1

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.live is None and self.last is not None and self.last.step != self.printed_step:
            self._print_line()

    def __call__(self, report: Any) -> None:
        if self.first is None:
            self.first = report
            self.loss, self.psnr = report.loss, report.psnr
        self.last = report
        self.loss += SMOOTHING * (report.loss - self.loss)
        self.psnr += SMOOTHING * (report.psnr - self.psnr)
        if self.live is not None:
            self.live.update(self.task, completed=report.step, description=self._numbers())
        elif time.monotonic() - self.printed_at >= PLAIN_INTERVAL:
            self._print_line()

    def rate(self) -> float:
        """Steps a second since the first report; 0 before there are two."""
        if self.first is None or self.last is None or self.last.seconds <= self.first.seconds:
            return 0.0
        return float((self.last.step - self.first.step) / (self.last.seconds - self.first.seconds))

    def _numbers(self) -> str:
        numbers = (
            f"step {self.last.step}/{self.total}  loss {self.loss:.4f}  PSNR {self.psnr:.2f}  "
            f"{self.last.gaussians:,} Gaussians"
        )
        rate = self.rate()
        return f"{numbers}  {rate:.{1 if rate >= 1 else 3}f} steps/s" if rate > 0 else numbers

    def _print_line(self) -> None:
        rate = self.rate()
        left = f"  {duration((self.total - self.last.step) / rate)} left" if rate > 0 else ""
        with suppress(OSError):  # its reader has gone: a training goes on, or comes to its checkpoint
            print(f"{self._numbers()}{left}", file=sys.stderr, flush=True)
        self.printed_at, self.printed_step = time.monotonic(), self.last.step


class StageProgress:
    """Progress of work in named stages: call it with the stage and the fraction done, or None where that is unknown.

    after: seconds in which nothing is said, for work that is mostly quick.
    """

    def __init__(self, after: float = 0.0) -> None:
        self.stage, self.printed_at = "", time.monotonic()
        self.silent_until = self.printed_at + after

    def __call__(self, stage: str, fraction: float | None = None) -> None:
        now = time.monotonic()
        if now < self.silent_until:
            return
        if stage != self.stage or now - self.printed_at >= PLAIN_INTERVAL or fraction == 1.0:
            text = stage if fraction is None else f"{stage} {100 * fraction:.0f} %"
            print(text, file=sys.stderr, flush=True)
            self.stage, self.printed_at = stage, now


class FrameProgress(_Bar):
    """Progress of frames; call it with each `sequence.task.Record` when its file is complete.

    total: frames, skipped ones too; style: auto, a bar on standard error where that is a terminal, and a line for each
    frame written on `lines` unless that is None or both are one terminal; json, an object a line there; openjd, what
    Open Job Description takes for progress; none.
    """

    def __init__(
        self, total: int, style: Literal["auto", "json", "openjd", "none"] = "auto", *, lines: TextIO | None = None
    ) -> None:
        self.total, self.style, self.lines, self.done = total, style, lines, 0
        if style == "auto":
            super().__init__("frames", total, counted=True)
        if self.live is not None and lines is not None and lines.isatty():
            self.lines = None

    def __call__(self, record: Any) -> None:
        self.done += 1
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
            text = f"{record.path}  {record.width}x{record.height}  {record.seconds:.2f} s"
        print(text, file=self.lines, flush=True)


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
