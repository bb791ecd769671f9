# SPDX-License-Identifier: Apache-2.0
"""The dispatcher: starts attempts at tasks in their order, repeats failed ones, and reports progress.

All state is in files, so that a dispatcher can be killed at any time, and several can work on the same tasks at once.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from clsplat.errors import ClsplatError, examples, warn
from clsplat.files.atomic import ABANDONED_FILE_SECONDS
from clsplat.files.locks import WRITTEN_BY, is_claimed
from clsplat.jobs.task import (
    ATTEMPT_PREFIX,
    Attempt,
    Engine,
    JobTask,
    Outcome,
    check_tasks,
    followers_of,
    last_line,
    log_path,
    mark_of,
)

MAX_TRIES = 3
"""Number of attempts without progress, one after another, after which a task has failed."""
RETRY_SECONDS = 2.0
"""Seconds before another attempt at a task whose attempt has failed."""
CLAIM_CHECK_SECONDS = 2.0
"""Seconds between checks of tasks that other processes have claimed."""
CLAIMED_WARNING_SECONDS = 10.0
"""Seconds that a task is claimed by another process before a warning says so."""
PROGRESS_SECONDS = 1.0
"""Seconds between reports of progress."""


@dataclass(frozen=True)
class JobProgress:
    """Progress of all tasks.

    done, total: number of tasks that are done, and number of all tasks.
    steps, total_steps: number of steps that are done, and number of all steps, summed over all tasks.
    running: names of the tasks that run now, started by this dispatcher or by others.
    failed: number of tasks that have failed.
    """

    done: int
    total: int
    steps: int
    total_steps: int
    running: tuple[str, ...] = ()
    failed: int = 0


def run_tasks(
    tasks: Sequence[JobTask],
    engine: Engine,
    folder: Path,
    on_progress: Callable[[JobProgress], None] = lambda _: None,
    *,
    needs: Sequence[Path] = (),
) -> None:
    """Run the tasks that are not done.

    folder: folder for claims and logs. All workers must see it. It is created if it is missing.
    needs: files and folders that every worker must see, such as the scene.

    A task fails after MAX_TRIES attempts without progress. Tasks that do not depend on it go on.
    Raises ClsplatError at the end if tasks have failed, and at once if no worker is left. After Ctrl-C, all commands
    are ended first, and the message of the KeyboardInterrupt says how to go on.
    """
    check_tasks(tasks)
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    dispatcher = _Dispatcher(tasks, engine, folder, tuple(str(path.absolute()) for path in needs))
    try:
        dispatcher.run(on_progress)
    except KeyboardInterrupt as error:
        error.args = (f"after {dispatcher.done} of {len(tasks)} tasks; the same command goes on",)
        raise
    finally:
        engine.stop()
    dispatcher.check()


class _Dispatcher:
    """Tasks by state, and their progress as far as it is known.

    done: number of tasks that are done. failed: names of the failed tasks.
    """

    def __init__(self, tasks: Sequence[JobTask], engine: Engine, folder: Path, needs: tuple[str, ...]) -> None:
        self.tasks = {task.name: task for task in tasks}
        self.engine, self.folder, self.needs, self.mark = engine, folder, needs, mark_of(folder)
        self.done = 0
        self.failed: list[str] = []
        self._followers = followers_of(tasks)
        self._missing = {task.name: len(set(task.after)) for task in tasks}
        self._ready = deque(task.name for task in tasks if not task.after)
        self._later: list[tuple[float, str]] = []
        self._running: set[str] = set()
        self._claimed: dict[str, float] = {}
        self._tries: dict[str, int] = {}
        self._before: dict[str, int] = {}  # steps when the running attempt began
        self._steps = {task.name: task.progress() for task in tasks}
        self._all_steps, self._total_steps = sum(self._steps.values()), sum(task.total for task in tasks)
        self._told_of_claim = False

    def run(self, on_progress: Callable[[JobProgress], None]) -> None:
        """Run tasks until all are done, have failed, or wait for failed ones."""
        report_at = 0.0
        while True:
            now = time.monotonic()
            while self._later and self._later[0][0] <= now:
                self._ready.append(heapq.heappop(self._later)[1])
            while self._ready and self.engine.free() > 0:
                self._begin(self._ready.popleft())
            if not self._running:  # no worker is left, but other processes may have done or claimed the tasks
                self._sort_out()
            if not (self._running or self._ready or self._later):
                on_progress(self._progress())
                return
            if now >= report_at:
                self._look()
                on_progress(self._progress())
                report_at = now + PROGRESS_SECONDS
            for outcome in self.engine.wait(self._patience(report_at)):
                self._end(outcome)

    def check(self) -> None:
        """Raise ClsplatError if tasks have failed."""
        if not self.failed:
            return
        waiting = len(self.tasks) - self.done - len(self.failed)
        more = f", and {waiting} that depend on them were not begun" if waiting else ""
        logs = examples(log_path(self.folder, name) for name in self.failed)
        raise ClsplatError(
            f"{len(self.failed)} of {len(self.tasks)} tasks failed: {examples(self.failed)}{more}; see {logs}; the "
            "same command tries again"
        )

    def _patience(self, report_at: float) -> float:
        """Seconds until the next report, or the next task whose turn comes by time."""
        until = min([report_at, *(at for at, _ in self._later[:1])])
        return max(until - time.monotonic(), 0.0)

    def _begin(self, name: str) -> None:
        """Start an attempt at a task, unless it is done, or another process has claimed it."""
        if self._is_left(name):
            self._running.add(name)
            self._before[name] = self._steps[name]
            command = self.tasks[name].command
            self.engine.start(Attempt(name, command, str(self.folder), self.needs, self.mark))

    def _sort_out(self) -> None:
        """Take the tasks that are done, or that other processes have claimed, out of the ready ones."""
        left: deque[str] = deque()
        while self._ready:
            if self._is_left(name := self._ready.popleft()):
                self._claimed.pop(name, None)
                left.append(name)
        self._ready = left

    def _is_left(self, name: str) -> bool:
        """True if an attempt at a task has to be started. A task that is done is counted, a claimed one waited for."""
        if self.tasks[name].is_done():
            self._finish(name)
            return False
        if is_claimed(self.folder / name):
            self._wait_for_claim(name)
            return False
        return True

    def _finish(self, name: str) -> None:
        """Count a task as done. Tasks that waited for this task alone become ready."""
        self.done += 1
        self._claimed.pop(name, None)
        self._see(name, self.tasks[name].total)
        for follower in self._followers[name]:
            self._missing[follower] -= 1
            if self._missing[follower] == 0:
                self._ready.append(follower)

    def _end(self, outcome: Outcome) -> None:
        """React to the end of an attempt."""
        name = outcome.name
        self._running.discard(name)
        task = self.tasks[name]
        claimed = outcome.kind == "claimed" or self._is_written(outcome)
        if not claimed:
            self._claimed.pop(name, None)
        if task.is_done():
            self._finish(name)
        elif claimed:
            self._wait_for_claim(name)
        elif outcome.kind == "unfit":
            self._leave_out(outcome)
        else:
            self._see(name, task.progress())
            self._tries[name] = 0 if self._steps[name] > self._before[name] else self._tries.get(name, 0) + 1
            if self._tries[name] >= MAX_TRIES:
                self._fail(outcome)
            else:
                heapq.heappush(self._later, (time.monotonic() + RETRY_SECONDS, name))

    def _is_written(self, outcome: Outcome) -> bool:
        """True if a command has ended because another process, without a claim, writes the task's result."""
        refused = outcome.kind == "ended" and outcome.status == 2
        return refused and WRITTEN_BY in last_line(log_path(self.folder, outcome.name))

    def _leave_out(self, outcome: Outcome) -> None:
        """Use an unfit worker no more, and begin its task next. Raises ClsplatError if no worker is left."""
        self._ready.appendleft(outcome.name)
        if not self.engine.leave_out(outcome.worker):
            raise ClsplatError(
                f"worker {outcome.worker} {outcome.reason}; no worker is left for {outcome.name}; the same command "
                "goes on when that is mended"
            )
        warn(f"worker {outcome.worker} {outcome.reason}; it is left out, and {outcome.name} goes to another worker")

    def _fail(self, outcome: Outcome) -> None:
        """Count a task as failed, and say why in one line."""
        log = log_path(self.folder, outcome.name)
        if outcome.kind == "lost":
            why = f"the last worker, {outcome.worker}, was lost: {outcome.reason}"
        else:
            why = f"the command ended with status {outcome.status}"
        line = last_line(log)
        end = f"; {log} ends with: {line}" if line and not line.startswith(ATTEMPT_PREFIX) else f"; see {log}"
        self.failed.append(outcome.name)
        warn(f"task {outcome.name} failed {MAX_TRIES} times without progress; {why}{end}")

    def _wait_for_claim(self, name: str) -> None:
        """Look again in CLAIM_CHECK_SECONDS at a task that another process has claimed."""
        now = time.monotonic()
        since = self._claimed.setdefault(name, now)
        if now - since > CLAIMED_WARNING_SECONDS and not self._told_of_claim:
            self._told_of_claim = True
            minutes = ABANDONED_FILE_SECONDS / 60
            warn(
                f"task {name} is claimed by another process; waiting until that process has done it or has ended (on "
                f"another machine or in another container, until its claim is {minutes:.0f} minutes old)"
            )
        heapq.heappush(self._later, (now + CLAIM_CHECK_SECONDS, name))

    def _look(self) -> None:
        """Read the progress of the running tasks, also if other dispatchers have started them."""
        for name in (*self._running, *self._claimed):
            self._see(name, self.tasks[name].progress())

    def _see(self, name: str, steps: int) -> None:
        """Note the number of steps of a task."""
        steps = min(max(steps, self._steps[name]), self.tasks[name].total)
        self._all_steps += steps - self._steps[name]
        self._steps[name] = steps

    def _progress(self) -> JobProgress:
        names = tuple(sorted({*self._running, *self._claimed}))
        total, steps = len(self.tasks), (self._all_steps, self._total_steps)
        return JobProgress(self.done, total, *steps, names, len(self.failed))
