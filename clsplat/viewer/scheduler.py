# SPDX-License-Identifier: Apache-2.0
"""Scheduler that renders the pictures of all viewers, one after the other, on a single thread. Uses neither OpenCL nor
viser.

Any thread may report a viewer's changes. Only `work` renders, on the thread that owns the device.
`viewer/refinement.py` decides when, at which resolution, and for which part of a training's time.
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
    """A display of pictures, remarks and messages, such as `page.ViserPage`."""

    def show(self, image: Image, level: Level, text: str) -> None: ...
    def tell(self, message: str) -> None: ...


@dataclass(eq=False)
class Viewer:
    """A viewer: an open page, with its refinement, appearance settings and camera pose.

    trouble: the error message that the page shows; "" once a picture was shown.
    """

    page: Page
    refinement: Refinement
    look: Look = field(default_factory=Look)
    pose: Pose | None = None
    trouble: str = ""


class Viewing:
    """All viewers of a model, and the jobs for the thread that owns the device.

    model: the model that is shown; None until training has created it.
    clock: function that returns the time in seconds.
    """

    def __init__(self, model: Model | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self.model, self.clock = model, clock
        self._viewers: list[Viewer] = []
        self._jobs: deque[tuple[Viewer, Callable[[Model], None]]] = deque()
        self._news = threading.Condition()
        self._is_news = False

    def __len__(self) -> int:
        return len(self._viewers)

    def join(self, page: Page) -> Viewer:
        """Add a viewer that has opened a page."""
        viewer = Viewer(page, Refinement(self.clock()))
        with self._news:
            self._viewers.append(viewer)
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Remove a viewer whose page is closed."""
        with self._news:
            self._viewers.remove(viewer)

    def moved(self, viewer: Viewer, pose: Pose) -> None:
        """Set a viewer's pose. An equal pose does not count as a change."""
        with self._news:
            if not pose.same(viewer.pose):
                if viewer.pose is not None:
                    viewer.refinement.changed(self.clock())
                viewer.pose = pose
                self.wake()

    def looks(self, viewer: Viewer, look: Look) -> None:
        """Set a viewer's appearance settings. Equal settings do not count as a change."""
        with self._news:
            if look != viewer.look:
                viewer.look = look
                viewer.refinement.changed(self.clock())
                self.wake()

    def ask(self, viewer: Viewer, job: Callable[[Model], None]) -> None:
        """Schedule a job for the thread that owns the device. The page shows a ClsplatError or OSError of the job."""
        with self._news:
            self._jobs.append((viewer, job))
            self.wake()

    def wake(self) -> None:
        """Make a thread that is in `wait` return."""
        with self._news:
            self._is_news = True
            self._news.notify_all()

    def wait(self, most: float) -> None:
        """Wait until there may be work, for at most `most` seconds."""
        with self._news:
            if self._is_news:
                self._is_news = False
                return
            now = self.clock()
            version = self.model.version if self.model else 0
            waits = [viewer.refinement.wait(now, version) for viewer in self._viewers if viewer.pose is not None]
            self._news.wait(min([most, *(seconds for seconds in waits if seconds is not None)]))
            self._is_news = False

    def work(self, share: Share | None = None) -> bool:
        """Do one job, or render one picture for the viewer that has waited longest. Returns True if there was work.

        share: limit on the fraction of a training's time that pictures take.
        """
        if (model := self.model) is None or not (self._viewers or self._jobs):
            return False
        with self._news:
            self._is_news = False
            job = self._jobs.popleft() if self._jobs else None
            turn = None if job else self._turn(model.version, share)
            begun = turn[0].refinement.changes if turn else 0
        if job:
            self._do(*job, model)
        elif turn:
            self._show(*turn, begun, model, share)
        return bool(job or turn)

    def _turn(self, version: int, share: Share | None) -> tuple[Viewer, Level] | None:
        """Choose the viewer whose picture is due and who has waited longest. Returns None if no picture is due.

        The result also has the picture's size and exactness. version: the model's version number.
        """
        now = self.clock()
        if share is not None and not (share.ready(now, moving=True) or share.ready(now, moving=False)):
            return None
        for viewer in sorted(self._viewers, key=lambda viewer: viewer.refinement.served):
            level = viewer.refinement.due(now, version) if viewer.pose is not None else None
            if level is not None and (share is None or share.ready(now, moving=viewer.refinement.moving)):
                return viewer, level
        return None

    def _show(self, viewer: Viewer, level: Level, begun: int, model: Model, share: Share | None) -> None:
        start, version, pose, look = self.clock(), model.version, viewer.pose, viewer.look
        assert pose is not None, "pictures are only due for viewers with a pose"
        camera = pose.camera().resized(*fitted(pose.width, pose.height, level.scale, model.pixels))
        try:
            image, text = model.picture(camera, look, exact=level.exact)
            if viewer in self._viewers:
                # if the camera has moved during rendering, the picture is outdated and not marked as exact
                moved_on = level.exact and viewer.refinement.changes != begun
                viewer.page.show(image, Level(level.scale, exact=False) if moved_on else level, text)
            viewer.trouble = ""
        except ClsplatError as error:
            if viewer.trouble != str(error):  # report an error only once
                viewer.page.tell(str(error))
            viewer.trouble = str(error)
        now = self.clock()
        viewer.refinement.shown(begun, level, now - start, now, version)
        if share is not None:
            share.spent(now, now - start)

    def _do(self, viewer: Viewer, job: Callable[[Model], None], model: Model) -> None:
        try:
            job(model)
        except (ClsplatError, OSError) as error:
            if viewer in self._viewers:
                viewer.page.tell(str(error))
