# SPDX-License-Identifier: Apache-2.0
"""Frames shared by jobs that run at the same time. Before a job renders a frame, it checks the frame's file again, and
claims the frame by a claim file next to it (`clsplat.jobs.claims`).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Literal

from clsplat.errors import warn
from clsplat.jobs.claims import HeldClaims
from clsplat.sequence.finished_frames import is_complete
from clsplat.sequence.task import RenderOptions, Task

CLAIM_POLL_SECONDS = 0.25
"""Seconds between checks of frames that other jobs have claimed."""
CLAIM_WARNING_SECONDS = 10.0
"""Seconds that a thread waits for other jobs before it warns."""
State = Literal["ours", "done", "theirs"]


class Sharing:
    """The frames that this job has claimed, so that no other job renders them. All methods are thread-safe."""

    def __init__(self, options: RenderOptions) -> None:
        self.options, self._claims = options, HeldClaims()

    def begin(self, task: Task) -> State:
        """Claim a frame if possible. Returns one of three words:

        ours: this job has the claim now, and must render the frame.
        done: the frame's file is complete already.
        theirs: another process has the claim, and is rendering the frame.
        """
        if is_complete(task, self.options):
            return "done"
        if not self._claims.take(task.path):
            return "theirs"
        if is_complete(task, self.options):  # completed by another job just before the claim
            self._claims.release(task.path)
            return "done"
        return "ours"

    def end(self, task: Task) -> None:
        """Give up the claim of a frame, whether the frame's file has been completed or not."""
        self._claims.release(task.path)

    def close(self) -> None:
        """Give up the claims of all unfinished frames."""
        self._claims.close()


class FrameQueue:
    """The frames of a job, which the job's threads take one by one.

    Frames that no other job has claimed come first. Claimed frames follow when the other jobs have completed or
    released them.

    stop: event that ends the queue when it is set.
    """

    def __init__(self, tasks: Iterable[Task], sharing: Sharing | None = None) -> None:
        self.stop = threading.Event()
        self._left, self._sharing, self._turn = iter(tasks), sharing, threading.Lock()
        self._theirs: deque[Task] = deque()
        self._told = False

    def take(self, skip: Callable[[Task], None]) -> Task | None:
        """Return the next frame to render, or None if none is left. Waits for frames that other jobs have claimed.

        skip: function that is called for each frame whose file is complete already.
        """
        began = time.monotonic()
        while not self.stop.is_set():
            task, waits = self._next()
            if task is None or self._sharing is None or (state := self._sharing.begin(task)) == "ours":
                return task
            if state == "done":
                skip(task)
                continue
            with self._turn:
                self._theirs.append(task)
            if waits:
                self._tell(task, time.monotonic() - began)
                self.stop.wait(CLAIM_POLL_SECONDS)
        return None

    def _next(self) -> tuple[Task | None, bool]:
        """Return the next frame or None, and True if only frames that other jobs had claimed are left."""
        with self._turn:
            if (task := next(self._left, None)) is not None:
                return task, False
            return (self._theirs.popleft() if self._theirs else None), True

    def _tell(self, task: Task, seconds: float) -> None:
        if seconds > CLAIM_WARNING_SECONDS and not self._told:
            self._told = True
            warn(f"--skip-existing: {task.path} is missing; waiting for another process, which has begun to render it")

    def end(self, task: Task) -> None:
        """Give up the claim of a frame, whether the frame's file has been completed or not."""
        if self._sharing is not None:
            self._sharing.end(task)

    def close(self) -> None:
        """Give up the claims of unfinished frames, so that other jobs can render them."""
        if self._sharing is not None:
            self._sharing.close()
