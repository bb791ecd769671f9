# SPDX-License-Identifier: Apache-2.0
"""Frames shared by jobs that run at a time: each is looked at again before it is begun, and claimed by a file beside
it."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Literal

from clsplat.errors import warn
from clsplat.files import claim, give_back
from clsplat.sequence.existing import is_complete
from clsplat.sequence.task import RenderOptions, Task

HEARTBEAT = 60.0
"""Seconds after which a claim is touched again."""
LOOK_AGAIN = 0.25
"""Seconds after which frames of another job are looked at again."""
PATIENCE = 10.0
"""Seconds of waiting for them without a word."""
State = Literal["ours", "done", "theirs"]


class Sharing:
    """Claims of this job's frames. Its methods may be called by several threads."""

    def __init__(self, options: RenderOptions) -> None:
        self.options = options
        self._claims: dict[str, Path] = {}
        self._changing, self._closed = threading.Lock(), threading.Event()
        threading.Thread(target=self._hold, name="clsplat-claims", daemon=True).start()

    def begin(self, task: Task) -> State:
        """ours: the frame is to be rendered here; done: its file is complete by now; theirs: another process is at
        it."""
        if is_complete(task, self.options):
            return "done"
        if (claimed := claim(task.path)) is None:
            return "theirs"
        if is_complete(task, self.options):  # while it was being claimed
            give_back(claimed)
            return "done"
        with self._changing:
            self._claims[task.key] = claimed
        return "ours"

    def _hold(self) -> None:
        """Touch the claims as long as the job runs: a frame may take hours."""
        while not self._closed.wait(HEARTBEAT):
            with self._changing:
                for claimed in self._claims.values():
                    with suppress(OSError):
                        os.utime(claimed)  # and no touch, which would make a file that is gone

    def end(self, task: Task) -> None:
        """The frame's file is there, or will not be."""
        with self._changing:
            claimed = self._claims.pop(task.key, None)
        if claimed is not None:
            give_back(claimed)

    def close(self) -> None:
        """Give back what is not done."""
        self._closed.set()
        with self._changing:
            claims, self._claims = list(self._claims.values()), {}
        for claimed in claims:
            with suppress(OSError):
                give_back(claimed)


class FrameQueue:
    """The frames of a job, which its threads take one by one: first those that no other job is at, then the others',
    when they are done or given up. stop: set when no more are wanted."""

    def __init__(self, tasks: Iterable[Task], sharing: Sharing | None = None) -> None:
        self.stop = threading.Event()
        self._left, self._sharing, self._turn = iter(tasks), sharing, threading.Lock()
        self._theirs: deque[Task] = deque()
        self._told = False

    def take(self, skip: Callable[[Task], None]) -> Task | None:
        """The next frame to render, None if there is none; `skip` is called with each that is done already. Waits for
        those of other jobs."""
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
                self.stop.wait(LOOK_AGAIN)
        return None

    def _next(self) -> tuple[Task | None, bool]:
        """A frame, and whether another job was at it before."""
        with self._turn:
            if (task := next(self._left, None)) is not None:
                return task, False
            return (self._theirs.popleft() if self._theirs else None), True

    def _tell(self, task: Task, seconds: float) -> None:
        if seconds > PATIENCE and not self._told:
            self._told = True
            warn(f"--skip-existing: another process renders {task.path}, which is missing yet; waiting for it")

    def end(self, task: Task) -> None:
        """The frame's file is there, or will not be."""
        if self._sharing is not None:
            self._sharing.end(task)

    def close(self) -> None:
        """Leave to other jobs what is not done."""
        if self._sharing is not None:
            self._sharing.close()
