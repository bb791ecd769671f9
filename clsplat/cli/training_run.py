# SPDX-License-Identifier: Apache-2.0
"""A training on the command line: its machine's flags, its first line, its progress, and advice after Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from clsplat.cli.eval import tell_of_lpips
from clsplat.cli.options import Memory, SeveralDevices
from clsplat.cli.session import Services
from clsplat.config.checks import parse_bytes
from clsplat.config.training import TrainConfig
from clsplat.progress import TrainProgress

if TYPE_CHECKING:
    from clsplat.device.context import Device
    from clsplat.rendering.memory_plan import Plan
    from clsplat.runs.run import Run
    from clsplat.scenes.scene import Scene
    from clsplat.training.start import Start
    from clsplat.viewer.training_view import TrainingView

TrainingProgress = Literal["auto", "openjd"]
"""How the progress of a training is written, as for `TrainProgress`."""


@dataclass(frozen=True)
class TrainingMachine(SeveralDevices):
    """The devices to train on, and limits and folders for data that does not fit in memory."""

    max_host_mem: Memory = None
    """Limit of main memory for photographs and Gaussians together, such as 4GiB. Photographs beyond it are read from
    the cache (--cache), or decoded again. The result is the same. If not given: all photographs stay in memory."""
    cache: Annotated[str | None, arg(metavar="DIR|none")] = None
    """Folder for decoded photographs. It stays after the training, and several trainings may share it. none: no cache.
    If not given: with --max-host-mem, cache/ in the run's folder until the training has finished; otherwise none."""
    scratch: Annotated[str | None, arg(metavar="DIR")] = None
    """Folder, on a local disk, for Gaussians that do not fit in --max-host-mem. A file in it, at most 2.2 times as
    large as the parameters and Adam's moments, stays after the training, as checkpoints need it. If not given:
    scratch/ in the run's folder."""

    def check(self) -> None:
        """Raise InputError for a malformed memory limit, before anything is read."""
        super().check()
        parse_bytes(self.max_host_mem, "--max-host-mem")

    def check_memory(self, scene: Scene, config: TrainConfig, device: Device) -> None:
        """Raise InputError if the limit of main memory is too small for the first step. device: the first device."""
        from clsplat.training.memory import HostMemory

        HostMemory.chosen(self.max_host_mem, self.cache, None, self.scratch).check(scene, config, device)

    def in_any_folder(self) -> TrainingMachine:
        """Return the same options with absolute paths, for commands that run in other folders."""

        def absolute(folder: str) -> str:
            return str(Path(folder).absolute())

        cache, scratch = self.cache, self.scratch
        return replace(
            self,
            cache=cache if cache in (None, "none") else absolute(cache),
            scratch=None if scratch is None else absolute(scratch),
        )

    @property
    def flags(self) -> list[str]:
        """The given flags as words, for the command that resumes a run. No file records them."""
        given = {
            "--device": self.selector,
            "--max-device-mem": self.max_device_mem,
            "--max-host-mem": self.max_host_mem,
            "--cache": self.cache,
            "--scratch": self.scratch,
        }
        return [word for flag, value in given.items() if value is not None for word in (flag, str(value))]


def tell_of_training(scene: Scene, config: TrainConfig, devices: Sequence[Device]) -> None:
    """Print the numbers of pictures and points, the devices, and the reason if LPIPS cannot be measured."""
    order = " in near order" if config.view_order == "near" else ""
    unit = f", length unit {scene.length_unit:.4g} (extent {scene.extent:.4g})" if scene.unit_differs else ""
    on = "; ".join(f"{device.name}, {device.driver.split('  ')[0].strip()}" for device in devices)
    print(
        f"{scene.name}: {len(scene.train_views)} training pictures{order}, {len(scene.test_views)} held out, "
        f"{len(scene.points):,} points{unit}; on {on} (the first steps may take longer, while kernels are built)",
        file=sys.stderr,
    )
    for note in scene.frame.notes:
        print(f"{scene.name}: {note}", file=sys.stderr)
    if scene.test_views:
        tell_of_lpips()


def train_run(
    services: Services,
    scene: Scene,
    run: Run,
    devices: Sequence[Device],
    machine: TrainingMachine,
    *,
    start: Start | None = None,
    progress: TrainingProgress = "auto",
    page: Callable[[Scene, TrainConfig], AbstractContextManager[TrainingView]] | None = None,
) -> None:
    """Train the run with a progress bar. If training is interrupted, the error's message says how to resume.

    start: initial model, region and appearance; None for Gaussians from the scene's points.
    progress: how progress is written.
    page: function that returns a context manager, which serves the viewer's page; None without --view.
    """
    from clsplat.training.forecast import Forecast
    from clsplat.training.start import NO_START

    views = scene.train_views
    pixels = sum(view.camera.width * view.camera.height for view in views) / len(views)

    def print_plan(plan: Plan) -> None:
        if devices[0].memory.limit is not None or any(plan.pieces):
            print(f"{plan.need.gaussians:,} Gaussians: {plan}", file=sys.stderr)

    try:
        with (
            page(scene, run.config) if page else nullcontext() as between,
            TrainProgress(run.config.iterations, Forecast(run.config, len(views), pixels), progress) as display,
        ):
            services.train(
                scene,
                run.config,
                device=devices,
                max_host_mem=machine.max_host_mem,
                cache=machine.cache,
                scratch=machine.scratch,
                run=run,
                resume=run.resuming,
                start=start or NO_START,
                on_plan=print_plan,
                on_step=display,
                between=between,
            )
    except KeyboardInterrupt as error:
        steps = run.checkpoints()
        at = f"at step {steps[-1][0]}" if steps else "before the first checkpoint"
        error.args = (f"{at}; go on with: {run.resume_command}",)
        raise
