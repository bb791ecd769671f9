# SPDX-License-Identifier: Apache-2.0
"""Scheduler of one thread's work for all viewers: whose picture is next, and their other requests. No OpenCL, no viser.

Any thread may say what a viewer wants; `work` alone renders, in the thread that owns the device.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from clsplat.errors import ClsplatError
from clsplat.viewer.appearance import Image, Look
from clsplat.viewer.pose import Pose, fitted
from clsplat.viewer.refinement import Level, Refinement, Share

if TYPE_CHECKING:
    from clsplat.viewer.models import Model


class Page(Protocol):
    """The page of a viewer."""

    def show(self, image: Image, level: Level, text: str) -> None:
        """Show a picture (H, W, 3), with a remark on it."""
        ...

    def tell(self, message: str) -> None:
        """Show the reason that there is no picture."""
        ...


@dataclass(eq=False)
class Watcher:
    """One viewer: page, refinement, look and pose."""

    page: Page
    refinement: Refinement
    look: Look = field(default_factory=Look)
    pose: Pose | None = None
    told: str = ""


class Viewing:
    """All viewers of a model. model: None until there is one."""

    def __init__(self, model: Model | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self.model, self.clock = model, clock
        self._watchers: dict[int, Watcher] = {}
        self._jobs: deque[tuple[int, Callable[[Model], None]]] = deque()
        self._news = threading.Condition()
        self._told = False

    def __len__(self) -> int:
        return len(self._watchers)

    def join(self, key: int, page: Page) -> None:
        """Take in a viewer that has opened a page."""
        with self._news:
            self._watchers[key] = Watcher(page, Refinement(self.clock()))

    def leave(self, key: int) -> None:
        """Drop a viewer whose page is closed."""
        with self._news:
            self._watchers.pop(key, None)

    def pose(self, key: int) -> Pose | None:
        """The viewer's pose, None if there is none."""
        watcher = self._watchers.get(key)
        return watcher.pose if watcher else None

    def look(self, key: int) -> Look:
        """The viewer's look at the model."""
        watcher = self._watchers.get(key)
        return watcher.look if watcher else Look()

    def moved(self, key: int, pose: Pose) -> None:
        """Take the viewer's pose, a new one or once more the same."""
        with self._news:
            watcher = self._watchers.get(key)
            if watcher is not None and not pose.same(watcher.pose):
                first, watcher.pose = watcher.pose is None, pose
                if first:
                    self._wake()
                else:
                    self._changed(watcher)

    def looks(self, key: int, look: Look) -> None:
        """Take the viewer's look at the model."""
        with self._news:
            watcher = self._watchers.get(key)
            if watcher is not None and look != watcher.look:
                watcher.look = look
                self._changed(watcher)

    def ask(self, key: int, job: Callable[[Model], None]) -> None:
        """Have something done in the device's thread. ClsplatError and OSError are told to them."""
        with self._news:
            self._jobs.append((key, job))
            self._wake()

    def wake(self) -> None:
        """End a `wait`."""
        with self._news:
            self._wake()

    def wait(self, most: float) -> None:
        """Wait until there may be something to do, for at most `most` seconds."""
        with self._news:
            if self._told:
                self._told = False
                return
            now = self.clock()
            version = self.model.version if self.model else 0
            waits = [each.refinement.wait(now, version) for each in self._watchers.values() if each.pose is not None]
            self._news.wait(min([most, *(seconds for seconds in waits if seconds is not None)]))
            self._told = False

    def work(self, share: Share | None = None) -> bool:
        """Do one thing, if there is one: a job, or the picture of the one whose turn it is. share: of a training, which
        must not be exceeded. Whether something was done."""
        if not self._watchers and not self._jobs:
            return False
        model = self.model
        if model is None:
            return False
        with self._news:
            self._told = False
            job = self._jobs.popleft() if self._jobs else None
            turn = None if job else self._turn(model.version, share)
            begun = turn[1].refinement.begun() if turn else 0
        if job:
            self._do(*job, model)
        elif turn:
            self._show(*turn, begun, model, share)
        return bool(job or turn)

    def _turn(self, version: int, share: Share | None) -> tuple[int, Watcher, Level] | None:
        """The viewer that has waited longest of those for which a picture is due, with its key and the picture's
        level."""
        now = self.clock()
        if share is not None and not (share.ready(now, moving=True) or share.ready(now, moving=False)):
            return None
        for key, each in sorted(self._watchers.items(), key=lambda item: item[1].refinement.served):
            level = each.refinement.due(now, version) if each.pose is not None else None
            if level is not None and (share is None or share.ready(now, moving=each.refinement.moving)):
                return key, each, level
        return None

    def _show(self, key: int, watcher: Watcher, level: Level, begun: int, model: Model, share: Share | None) -> None:
        start, version, pose, look = self.clock(), model.version, watcher.pose, watcher.look
        assert pose is not None, "only a viewer with a pose has a turn"
        camera = pose.camera().resized(*fitted(pose.width, pose.height, level.scale, model.pixels))
        try:
            image, text = model.picture(camera, look, exact=level.exact)
            if key in self._watchers:
                watcher.page.show(image, level, text)
            watcher.told = ""
        except ClsplatError as error:
            if watcher.told != str(error):  # once is enough
                watcher.page.tell(str(error))
            watcher.told = str(error)
        now = self.clock()
        watcher.refinement.shown(begun, level, now - start, now, version)
        if share is not None:
            share.spent(now, now - start)

    def _do(self, key: int, job: Callable[[Model], None], model: Model) -> None:
        watcher = self._watchers.get(key)
        try:
            job(model)
        except (ClsplatError, OSError) as error:
            if watcher is not None:
                watcher.page.tell(str(error))

    def _changed(self, watcher: Watcher) -> None:
        watcher.refinement.changed(self.clock())
        self._wake()

    def _wake(self) -> None:
        self._told = True
        self._news.notify_all()
