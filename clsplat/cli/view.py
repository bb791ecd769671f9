# SPDX-License-Identifier: Apache-2.0
"""`clsplat view`, and the page of `clsplat train --view`: from the command line to a viewer (`clsplat.viewer`)."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from clsplat.cli.main import Train
from clsplat.cli.options import View
from clsplat.config.memory import parse_bytes
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.process import endings
from clsplat.runs.run import Run, is_run, model_file
from clsplat.viewer.appearance import Look
from clsplat.viewer.models import HeldModel
from clsplat.viewer.pose import extent_of, looking, start_of
from clsplat.viewer.scheduler import Viewing
from clsplat.viewer.server import Address, Server, World
from clsplat.viewer.training_view import LONGEST_WAIT, TrainingView

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

FIRST = (640, 360)
"""Pixels of the pictures that are made before there is a page, so that kernels are built and the model is in place."""


def view(verb: View) -> int:
    """A model in the browser, until Ctrl-C, which is the way to end it."""
    from clsplat.device.child import TrialInterrupted
    from clsplat.device.context import open_device
    from clsplat.selftest.result import FORWARD
    from clsplat.selftest.trust import require

    address = Address(verb.host, verb.port, verb.paths)
    limit = parse_bytes(verb.max_device_mem)
    file = model_file(verb.model)
    folder = verb.model if verb.model.is_dir() else file.parent
    run = Run.open(folder) if is_run(folder) else None
    address.check()
    gaussians = Gaussians.load(file)
    if not len(gaussians):
        raise InputError(f"{file}: has no Gaussians, expected some to look at")
    config = run.config if run else TrainConfig()
    scene = _scene(verb.scene or (run.scene if run else None), config, given=verb.scene is not None)
    device = require(open_device(verb.device, limit), FORWARD)
    background = background_colour(verb.background or config.background)
    model = HeldModel(gaussians, device, config.rasterizer, background)
    world = _world(gaussians, scene, file.name)
    _warm(model, world)
    viewing = Viewing(model)
    with _until_stopped() as stopped, _serving(Server(viewing, world, address)) as server:
        _print_address(server)
        with suppress(TrialInterrupted):  # asked to end while a driver hung
            while not stopped():
                if not viewing.work():
                    viewing.wait(LONGEST_WAIT)
    return 0


def training_view(verb: Train) -> Callable[[Scene], AbstractContextManager[TrainingView]]:
    """The page of a training, which is open as long as the context is. Raises InputError where it cannot be served, at
    once, before anything is trained or written."""
    address, config = Address(verb.host, verb.port, verb.paths), verb.config
    address.check()

    @contextmanager
    def page(scene: Scene) -> Iterator[TrainingView]:
        box = extent_of(scene.points) if len(scene.points) else scene.bounds
        start = start_of([each.camera for each in scene.views], scene.points)
        world = World(scene.name, start, scene.origin, box, config.sh_degree, scene.views)
        viewing = Viewing()
        with _serving(Server(viewing, world, address, training=True)) as server:
            _print_address(server)
            yield TrainingView(viewing, server, background_colour(config.background), config.iterations)

    return page


def _scene(path: Path | None, config: TrainConfig, *, given: bool) -> Scene | None:
    """The scene, for its cameras and photos. One that only the run names may be gone by now: then a warning, and
    None."""
    from clsplat.scenes.scene import load_scene

    if path is None:
        return None
    try:
        return load_scene(path, resolution=config.resolution, test_every=config.test_every)
    except (InputError, OSError) as error:
        if given:
            raise
        print(f"clsplat: warning: no cameras and photos: {error}", file=sys.stderr)
        return None


def _world(gaussians: Gaussians, scene: Scene | None, title: str) -> World:
    views = scene.views if scene else []
    low, high = extent_of(gaussians.means)
    box = (low + gaussians.origin, high + gaussians.origin)
    start = start_of([each.camera for each in views], gaussians.means + gaussians.origin)
    return World(title, start, gaussians.origin, box, gaussians.sh_degree, views)


def _warm(model: HeldModel, world: World) -> None:
    """Make a picture in motion and one at rest, as the first of all wait for kernels to be built."""
    camera = looking(world.start, FIRST).camera()
    for exact in (False, True):
        model.picture(camera, Look(), exact=exact)


@contextmanager
def _serving(server: Server) -> Iterator[Server]:
    try:
        yield server
    finally:
        server.close()


def _print_address(server: Server) -> None:
    more = "" if server.address.local else " (anybody who reaches this machine can look)"
    print(f"viewer at {server.url}{more}; Ctrl-C ends it", file=sys.stderr, flush=True)


@contextmanager
def _until_stopped() -> Iterator[Callable[[], bool]]:
    """Inside, Ctrl-C and what else asks the process to end is heard."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return
    before = {each: signal.signal(each, lambda *_: asked.set()) for each in (signal.SIGINT, *endings())}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
