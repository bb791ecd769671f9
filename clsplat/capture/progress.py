# SPDX-License-Identifier: Apache-2.0
"""Progress of a capture over all its stages, with the remaining time. Adds the stage's name to messages of errors."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress

from clsplat.errors import ClsplatError, InputError, system_trouble
from clsplat.process import reader_has_gone
from clsplat.progress import LIVE_TEXT_SECONDS, PLAIN_LINE_SECONDS, LiveBar, RemainingTime, duration

WORK_SHARES = {
    "frames": {"reading ": 0.6, "writing the frames": 0.4},
    "cameras": {
        "reading": 0.02,
        "finding features": 0.45,
        "matching photos": 0.35,
        "placing cameras": 0.15,
        "undistorting photos": 0.03,
    },
}
"""Fractions of a stage's time that its parts take, by stage and by how the parts' progress texts begin."""
BAR_STEPS = 1000
"""Length of the live bar in steps."""
PACE_PRIOR_SECONDS = 20.0
"""Weight of the prior in `CaptureProgress.pace`: it counts as this many seconds of work done at the expected speed."""
REUSED_FRACTION = 0.02
"""A stage that ends within this fraction of its expected duration has reused an earlier result, so its duration is left
out of the pace."""


class CaptureProgress(LiveBar):
    """Progress of a capture on standard error: a live bar on a terminal, else a line for each part and every 10 s.

    expected: expected duration in seconds of each stage, in the stages' order. `expect` changes one.
    again: the command that goes on after an interruption.
    forecast: estimator of the current stage's remaining time; None to estimate it from the expected duration.
    """

    def __init__(self, expected: Mapping[str, float], again: str) -> None:
        super().__init__("", BAR_STEPS)
        self.expected, self.again = dict(expected), again
        self.names = list(expected)
        self.stage_name = ""
        self.forecast: RemainingTime | None = None
        self._spent: dict[str, float] = {}
        self._began = self._stage_began = time.monotonic()
        self._fraction: float | None = None
        self._told, self._told_at = "", 0.0

    def expect(self, stage: str, seconds: float) -> None:
        """Replace the expected duration of a stage."""
        self.expected[stage] = seconds

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Context of a stage. Messages of errors in it begin with its name, and KeyboardInterrupt says how to go on."""
        self.stage_name, self.forecast, self._fraction = name, None, None
        self._stage_began = time.monotonic()
        try:
            yield
        except KeyboardInterrupt as error:
            error.args = (f"in the stage {name}{self._at(error)}; go on with: {self.again}",)
            raise
        except Exception as error:
            if isinstance(error, OSError) and reader_has_gone(error):
                raise
            told = of_stage(error, name)
            if told is None or told is error:
                raise
            raise told from error
        self._spent[name] = time.monotonic() - self._stage_began

    @staticmethod
    def _at(error: KeyboardInterrupt) -> str:
        return f" {error.args[0]}" if error.args else ""

    def __call__(self, text: str, fraction: float | None = None, detail: str = "") -> None:
        """Report progress in the current stage.

        text: the part of the stage, as in WORK_SHARES.
        fraction: fraction of this part that is done; None if unknown.
        detail: text that replaces the percentage.
        """
        self._fraction = self._of_stage(text, fraction)
        now = time.monotonic()
        key = f"{self.stage_name} {text}"
        if self.live is None:
            if key != self._told or now - self._told_at >= PLAIN_LINE_SECONDS:
                with suppress(OSError):  # if the program that reads the output has ended, the work goes on
                    print(self._line(text, fraction, detail), file=sys.stderr, flush=True)
                self._told, self._told_at = key, now
        elif key != self._told or now - self._told_at >= LIVE_TEXT_SECONDS:
            if fraction is None:  # a finding, such as the number of a video's frames, stays readable above the bar
                self.live.console.print(f"{self.stage_name}: {text}", markup=False, highlight=False, soft_wrap=True)
            share = (now - self._began) / max(now - self._began + self.left(), 1e-9)
            line = self._line(text, fraction, detail)
            self.live.update(self.task, completed=BAR_STEPS * share, description=line)
            self._told, self._told_at = key, now

    def _line(self, text: str, fraction: float | None, detail: str) -> str:
        number = self.names.index(self.stage_name) + 1
        percent = "" if fraction is None or detail else f" {100 * fraction:.0f} %"
        return (
            f"{number}/{len(self.names)} {self.stage_name}: {text}{percent}{detail}  about {duration(self.left())} left"
        )

    def left(self) -> float:
        """Seconds that the rest of the current stage and the later stages are estimated to take."""
        later = self.names[self.names.index(self.stage_name) + 1 :] if self.stage_name else self.names
        return self._left_of_stage() + self.pace() * sum(self.expected[name] for name in later)

    def pace(self) -> float:
        """Ratio of the finished stages' duration to the expected one, with a prior of 1 (PACE_PRIOR_SECONDS)."""
        worked = {name: spent for name, spent in self._spent.items() if spent > REUSED_FRACTION * self.expected[name]}
        expected = sum(self.expected[name] for name in worked)
        return (PACE_PRIOR_SECONDS + sum(worked.values())) / (PACE_PRIOR_SECONDS + expected)

    def _left_of_stage(self) -> float:
        if not self.stage_name:
            return 0.0
        if self.forecast is not None and (seconds := self.forecast.left()) is not None:
            return seconds
        spent = time.monotonic() - self._stage_began
        usual = self.pace() * self.expected[self.stage_name]
        if self._fraction is None:
            return max(usual - spent, 0.0)
        # the more is done, the more the estimate follows the measured time instead of the usual time
        return (1 - self._fraction) * (spent + (1 - self._fraction) * usual)

    def _of_stage(self, text: str, fraction: float | None) -> float | None:
        """Return the fraction of the current stage that is done, from the fraction of the part `text`.

        It never falls in a stage of WORK_SHARES. Without a new fraction, the result is the one before.
        """
        shares = WORK_SHARES.get(self.stage_name)
        before = self._fraction
        if shares is None:
            return before if fraction is None else min(max(fraction, 0.0), 1.0)
        done = 0.0
        for start, share in shares.items():
            if text.startswith(start):
                return max(done + share * min(max(fraction or 0.0, 0.0), 1.0), before or 0.0)
            done += share
        return before


def of_stage(error: Exception, stage: str) -> ClsplatError | None:
    """Return an error whose message begins with the stage's name; None for an internal error, such as a bug.

    An OSError, a MemoryError or an error of pyopencl becomes a ClsplatError (InputError if it has its exit status).
    Other errors of clsplat keep their class.
    """
    start = f"stage {stage}: "
    if isinstance(error, OSError):
        text = str(error) if isinstance(error, ClsplatError) else system_trouble(error)
        kind = InputError if getattr(error, "exit_status", 1) == InputError.exit_status else ClsplatError
        return kind(f"{start}{text}")
    if isinstance(error, ClsplatError):
        error.args = (f"{start}{error.args[0] if error.args else ''}", *error.args[1:])
        return error
    if isinstance(error, MemoryError):
        return ClsplatError(f"{start}there is not enough main memory: {str(error) or 'the system has no more'}")
    if type(error).__module__.startswith("pyopencl"):
        return ClsplatError(f"{start}the OpenCL driver failed: {' '.join(str(error).split())}")
    return None
