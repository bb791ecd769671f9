# SPDX-License-Identifier: Apache-2.0
"""`clsplat view`, and the page of `clsplat train --view`: start of the viewer (`clsplat.viewer`)."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from clsplat.cli.options import DeviceOptions, PageOptions, RunOrModel, ScenePath, Verb
from clsplat.cli.session import Services
from clsplat.config.orientation import AS_IN_FILES
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, warn
from clsplat.process import MAX_SIGNAL_WAIT_SECONDS, endings, handled

if TYPE_CHECKING:
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene
    from clsplat.viewer.server import Server
    from clsplat.viewer.training_view import TrainingView

WARM_UP_PICTURE_SIZE_PX = (640, 360)
"""Width and height in pixels of the pictures that are rendered before the page opens, to build kernels and load the
model."""


@dataclass(frozen=True)
class ViewVerb(Verb):
    """Look at a model in the browser: the device renders, the page shows it. Ctrl-C ends the viewer.

    docs/viewer.md describes the page.
    """

    model: RunOrModel
    """A run's folder or a model file. For a file in a run's folder, that run's settings apply."""
    scene: ScenePath = None
    """Folder with the scene, for its cameras and photos. If not given: the scene on which the run was trained."""
    background: Annotated[Literal["black", "white"] | None, arg(metavar="black|white")] = None
    """Background behind the Gaussians. If not given: the run's setting, else black."""
    appearance: Annotated[str | None, arg(metavar="PHOTO")] = None
    """Give the model the exposure and colours of this photograph of its scene, from the run's appearance.json, but not
    the vignette of its lens. If not given: the photographs' average."""
    page: Annotated[PageOptions, arg(name="")] = field(default_factory=PageOptions)
    device: Annotated[DeviceOptions, arg(name="")] = field(default_factory=DeviceOptions)


def run(verb: ViewVerb, services: Services) -> int:
    """Show a model in the browser until Ctrl-C."""
    from clsplat.device.drivers.worker_process import TrialInterrupted
    from clsplat.gaussians import Gaussians
    from clsplat.images.alpha import background_colour
    from clsplat.models.edit import exposed
    from clsplat.models.formats import colour_space
    from clsplat.runs.appearance import gains_of
    from clsplat.runs.run import model_file, run_of
    from clsplat.selftest.result import FORWARD_STAGES
    from clsplat.shots.viewpoints import extent_of
    from clsplat.viewer.appearance import Look
    from clsplat.viewer.models import HeldModel
    from clsplat.viewer.page import World
    from clsplat.viewer.pose import looking, start_of
    from clsplat.viewer.scheduler import Viewing
    from clsplat.viewer.server import Address, Server

    address = Address(verb.page.host, verb.page.port, verb.page.paths)
    verb.device.check()
    file = model_file(verb.model)
    run = run_of(verb.model)
    address.check()
    gains = gains_of(verb.model, verb.appearance) if verb.appearance is not None else None
    gaussians = Gaussians.load(file) if gains is None else exposed(Gaussians.load(file), gains)
    if not len(gaussians):
        raise InputError(f"{file}: has no Gaussians, expected at least one")
    config = run.config if run else TrainConfig()
    scene = _scene(services, verb.scene or (run.scene if run else None), run, given=verb.scene is not None)
    device = verb.device.trusted(services, FORWARD_STAGES)
    background = background_colour(verb.background or config.background)
    model = HeldModel(gaussians, device, config.rasterizer, background, colour_space(file))
    views = scene.views if scene else []
    low, high = extent_of(gaussians.means)
    box = (low + gaussians.origin, high + gaussians.origin)
    level = scene is not None and scene.frame.upright
    start = start_of([view.camera for view in views], gaussians.means + gaussians.origin, level=level)
    world = World(file.name, start, gaussians.origin, box, gaussians.sh_degree, views)
    for exact in (False, True):  # render two pictures now, to build the kernels
        model.picture(looking(start, WARM_UP_PICTURE_SIZE_PX).camera(), Look(), exact=exact)
    viewing = Viewing(model)
    stopped = threading.Event()
    signals = handled((signal.SIGINT, *endings()), lambda *_: stopped.set())
    with signals, closing(Server(viewing, world, address)) as server:
        _print_address(server)
        with suppress(TrialInterrupted):  # Ctrl-C raises this error while a driver builds or tries a kernel
            while not stopped.is_set():
                if not viewing.work():
                    viewing.wait(MAX_SIGNAL_WAIT_SECONDS)
    return 0


def training_view(options: PageOptions) -> Callable[[Scene, TrainConfig], AbstractContextManager[TrainingView]]:
    """Return a function that opens a context, in which the viewer's page is served while a scene is trained.

    Raises InputError at once if the page cannot be served, before anything is trained or written.
    """
    from clsplat.images.alpha import background_colour
    from clsplat.shots.viewpoints import extent_of
    from clsplat.viewer.page import World
    from clsplat.viewer.pose import start_of
    from clsplat.viewer.scheduler import Viewing
    from clsplat.viewer.server import Address, Server
    from clsplat.viewer.training_view import TrainingView

    address = Address(options.host, options.port, options.paths)
    address.check()

    @contextmanager
    def page(scene: Scene, config: TrainConfig) -> Iterator[TrainingView]:
        box = extent_of(scene.points) if len(scene.points) else scene.bounds
        start = start_of([view.camera for view in scene.views], scene.points, level=scene.frame.upright)
        world = World(scene.name, start, scene.origin, box, config.sh_degree, scene.views)
        viewing = Viewing()
        with closing(Server(viewing, world, address, training=True)) as server:
            _print_address(server)
            yield TrainingView(viewing, server, background_colour(config.background), config.iterations)

    return page


def _scene(services: Services, path: Path | None, run: Run | None, *, given: bool) -> Scene | None:
    """Load the scene for its cameras and photos, or return None if there is no scene to show.

    run: the model's run, whose settings and frame the scene gets.
    given: True if --scene names the scene. Then an unreadable scene is an error; otherwise it causes a warning.
    """
    if path is None:
        return None
    config = run.config if run else TrainConfig()
    frame = AS_IN_FILES if run is None else run.frame_for(path)
    try:
        return services.load_scene(config, path, frame=frame)
    except (InputError, OSError) as error:
        if given:
            raise
        warn(f"cameras and photos are not shown: {error}")
        return None


def _print_address(server: Server) -> None:
    more = "" if server.address.local else " (visible to anybody who can reach this machine)"
    print(f"viewer at {server.url}{more}; Ctrl-C ends it", file=sys.stderr, flush=True)
