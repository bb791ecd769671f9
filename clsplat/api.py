# SPDX-License-Identifier: Apache-2.0
"""The public functions `clsplat.train`, which trains a model, and `clsplat.devices`, which lists OpenCL devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from pathlib import Path

from clsplat.config.checks import parse_bytes
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.device.selection import DeviceInfo, list_devices, open_devices
from clsplat.errors import InputError, of_argument
from clsplat.gaussians import Gaussians
from clsplat.rendering.memory_plan import Plan
from clsplat.report.page import write_last
from clsplat.runs.locks import locked
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.loop import Between, StepReport, TrainingSession
from clsplat.training.memory import HostMemory
from clsplat.training.preparation import begin, check_scene, settings_of
from clsplat.training.region_masks import with_region_masks
from clsplat.training.start import NO_START, Start, check_start
from clsplat.training.trainer import Trainer


def devices() -> list[DeviceInfo]:
    """List the OpenCL devices of this machine, like `clsplat devices`.

    Returns
    -------
    list of DeviceInfo
        Index, name, platform, version, kind, compute_units, memory_bytes, and kernel shape. The argument `device` of
        other calls is an index as text, "cpu", "gpu", or a part of a name, platform or version.
    """
    return list_devices()


def train(
    scene: Scene,
    config: TrainConfig | None = None,
    *,
    device: Device | str | Sequence[Device] | None = None,
    max_device_mem: str | int | None = None,
    max_host_mem: str | int | None = None,
    cache: str | Path | None = None,
    scratch: str | Path | None = None,
    run: Run | None = None,
    resume: bool = False,
    start: Start = NO_START,
    on_step: Callable[[StepReport], None] | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    between: Between | None = None,
) -> Gaussians:
    """Train a model of a scene.

    Parameters
    ----------
    scene : Scene
        Photographs with cameras, see `load_scene`.
    config : TrainConfig, optional
        Settings, which are written to the run. None means the run's settings, or the defaults without a run.
    device : Device, str or sequence of Device, optional
        An open device, or text that selects a device (see `devices`). Several devices, or such texts separated by
        commas, share the views of a step (`TrainConfig.batch`).
    max_device_mem : str or int, optional
        Largest amount of memory to use on each device: a number of bytes, or text such as "256MiB".
    max_host_mem : str or int, optional
        Largest amount of main memory to use for photographs and Gaussians together, in the form of `max_device_mem`.
        Photographs beyond it are read from `cache`, or decoded again. None means no limit.
    cache : str or Path, optional
        Folder for decoded photographs, which is kept and may be shared by trainings; "none" for no cache. None means
        a folder in the run that is removed after training if `max_host_mem` is given, else no cache.
    scratch : str or Path, optional
        Folder of the file with Gaussians that do not fit in `max_host_mem`. If the run's checkpoints refer to the file,
        it is kept after training. None means the run's folder.
    run : Run, optional
        A folder for metrics, checkpoints, held-out renders and the model. With None nothing is written.
    resume : bool
        Continue from the run's latest checkpoint. If False, a run that has checkpoints or metrics is refused.
    start : Start
        What to begin with in place of Gaussians from the scene's points: a model, the region in which it is trained,
        and another run's appearance. With a region, the loss leaves out pixels in which the model shows Gaussians from
        outside. To resume, give the same start again.
    on_step : callable, optional
        Called with a report every 10 steps (`REPORT_EVERY` in `clsplat/training/loop.py`).
    on_plan : callable, optional
        Called with the memory plan before the first step and after each change.
    between : callable, optional
        Called before each step with the trainer and a function that returns True after Ctrl-C. It may render the
        trainer's model. Its time does not count as training time.

    Returns
    -------
    Gaussians
        The trained model.

    Raises
    ------
    InputError
        If the scene has no training views, if it is not the resumed run's scene, or if another process writes the run.
    ClsplatError
        If values are repeatedly not finite (docs/decisions/0016-never-a-nan.md). Values that could be repaired cause
        only a warning.
    Interrupted
        A KeyboardInterrupt, on Ctrl-C, SIGTERM or SIGHUP, after a checkpoint has been written.

    Notes
    -----
    Kerbl et al. 2023; docs/gradients.md has the equations, docs/decisions/ the changes to the method.
    """
    check_scene(scene)
    config = settings_of(config, run, resume=resume)
    check_start(start, config)
    with nullcontext() if run is None else locked(run.path, "train"):
        first, *further = _opened(device, parse_bytes(max_device_mem))
        config = config.on_devices(1 + len(further), explicit=resume)
        memory = HostMemory.chosen(max_host_mem, cache, run, scratch)
        memory.remove_scratch()
        scene = begin(scene, config, run, resume=resume, start=start)
        shown = with_region_masks(scene, start, first, config.rasterizer)
        trainer = Trainer(shown, config, first, start, further=further, memory=memory)
        with closing(trainer):
            session = TrainingSession(trainer, run, on_step, on_plan)
            if resume:
                session.resume()
            model = session.train(between)
        memory.end(run)
        if run is not None and config.report:
            write_last(run, scene, model)
    return model


def _opened(device: Device | str | Sequence[Device] | None, limit: int | None) -> list[Device]:
    """Open the devices, with at most `limit` bytes of memory each, if set. Raises InputError if no device matches."""
    if device is None or isinstance(device, str):
        with of_argument():
            return open_devices(device, limit)
    given = [device] if isinstance(device, Device) else device if isinstance(device, Sequence) else ()
    devices = [one for one in given if isinstance(one, Device)]
    if not devices or len(devices) < len(given):
        raise InputError(f"device is {device!r:.100}, expected open devices, or device names separated by commas")
    return devices if limit is None else [one.with_memory_limit(limit) for one in devices]
