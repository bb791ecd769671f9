# SPDX-License-Identifier: Apache-2.0
"""`clsplat.train`: the training, and the report of its run; and `clsplat.devices`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext

from clsplat.config.checks import parse_bytes
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device, DeviceInfo, list_devices, open_devices
from clsplat.errors import InputError, of_argument
from clsplat.gaussians import Gaussians
from clsplat.rendering.memory_plan import Plan
from clsplat.report.page import write_last
from clsplat.runs.locks import locked
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.loop import Between, Session, StepReport, begin, checked
from clsplat.training.trainer import Trainer


def devices() -> list[DeviceInfo]:
    """The OpenCL devices of this machine, as `clsplat devices` lists them: index, name, platform, version, kind,
    compute_units, memory_bytes, and the shape of kernels. What other calls take as `device` is an index as text, "cpu",
    "gpu", or a part of a name, platform or version."""
    return list_devices()


def train(
    scene: Scene,
    config: TrainConfig | None = None,
    *,
    device: Device | str | Sequence[Device] | None = None,
    max_device_mem: str | int | None = None,
    run: Run | None = None,
    resume: bool = False,
    on_step: Callable[[StepReport], None] | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    between: Between | None = None,
) -> Gaussians:
    """Train on a scene; returns the model.

    config: the run's, or else the defaults, unless given; a given one is written to the run. device: an open one, or a
    name as `clsplat devices` lists them; several, or names with commas between, share the views of a step
    (`TrainConfig.batch`). max_device_mem: the most of each one's memory to use, such as "256MiB". run: a folder for
    metrics, checkpoints, held-out renders and the model; None writes nothing. resume: go on from the run's latest
    checkpoint; without it a run that has been trained is refused. on_step: called every REPORT_EVERY steps. on_plan:
    called with the use of device memory, before the first step and when it changes. between: called before each step;
    it may render the trainer's model, and its time is not counted.

    Raises InputError for a scene without views, a scene that is not the resumed run's, and a run that another process
    writes. Raises ClsplatError where numbers are not finite again and again (docs/decisions/0016-never-a-nan.md);
    values that could be repaired give a warning. Raises Interrupted, a KeyboardInterrupt, on Ctrl-C, SIGTERM or SIGHUP,
    after a checkpoint has been written.
    """
    config = checked(scene, config, run, resume=resume)
    with nullcontext() if run is None else locked(run.path, "train"):
        first, *further = _opened(device, parse_bytes(max_device_mem))
        config = config.on_devices(1 + len(further), explicit=resume)
        trainer = Trainer(begin(scene, config, run, resume=resume), config, first, further=further)
        with closing(trainer):
            session = Session(trainer, run, on_step, on_plan)
            if resume:
                session.resume()
            model = session.train(between)
        if run is not None and config.report:
            write_last(run, scene, model)
    return model


def _opened(device: Device | str | Sequence[Device] | None, limit: int | None) -> list[Device]:
    """The devices, with `limit` bytes of memory each. Raises InputError for what is none."""
    if device is None or isinstance(device, str):
        with of_argument():
            return open_devices(device, limit)
    given = [device] if isinstance(device, Device) else device if isinstance(device, Sequence) else ()
    devices = [one for one in given if isinstance(one, Device)]
    if not devices or len(devices) < len(given):
        raise InputError(f"device is {device!r:.100}, expected open devices, or names with commas between")
    return devices if limit is None else [one.with_memory_limit(limit) for one in devices]
