# SPDX-License-Identifier: Apache-2.0
"""`clsplat render`: from the command line to a job. What is wrong with the call is found before a frame is rendered.

The job's loop is in `clsplat.render_job`, one frame in `clsplat.shading`, clusters in `clsplat.farm`.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import clsplat
from clsplat import render_job
from clsplat.camera import Camera
from clsplat.cli import Render
from clsplat.config import RasterizerConfig
from clsplat.errors import InputError
from clsplat.files import digest
from clsplat.frames import ranges
from clsplat.gaussians import Gaussians
from clsplat.layers import Encoding, check_format, parse_channels
from clsplat.memory import parse_bytes
from clsplat.paths import choose_shot
from clsplat.progress import FrameProgress
from clsplat.render_job import Record
from clsplat.runs import model_file
from clsplat.shading import RenderOptions, Task, beside_colour, open_shader, renderer_channels

if TYPE_CHECKING:
    from clsplat.memory import Plan

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Job:
    """What a call means. devices: selectors, None for the usual one."""

    verb: Render
    options: RenderOptions
    rasterizer: RasterizerConfig
    model: Path
    gaussians: Gaussians
    tasks: list[Task]
    devices: tuple[str | None, ...]
    memory_limit: int | None

    @property
    def on_farm(self) -> bool:
        """Whether others render."""
        return self.verb.workers is not None or self.verb.scheduler is not None


def render(verb: Render) -> int:
    """Model and cameras to images. SIGTERM is taken as Ctrl-C is."""
    with _terminable():
        job = read_job(verb)
        if verb.dry_run:
            return _dry_run(job)
        return _run(job)


def read_job(verb: Render) -> Job:
    """All that can be checked without rendering. Raises InputError and DeviceError; writes nothing."""
    options = _options(verb)
    verb.rasterizer.check()
    limit = parse_bytes(verb.max_device_mem)
    resize = resizer(verb.width, verb.height, verb.scale)
    devices = _devices(verb)
    whole = choose_shot(
        verb.cameras,
        path=verb.path,
        count=verb.count,
        size=(verb.width, verb.height),
        usd_camera=verb.usd_camera,
    )
    chosen = whole if verb.frames is None else whole.only(verb.frames)
    tasks = render_job.make_tasks(chosen, whole, verb.output, resize, options.channels)
    render_job.check_folders(tasks)
    for warning in chosen.warnings:
        _warn(warning)
    rasterizer = verb.rasterizer
    if rasterizer.sh_angle:
        _warn(f"--rasterizer.sh-angle {rasterizer.sh_angle:g} is not used: a frame would depend on those before it")
        rasterizer = replace(rasterizer, sh_angle=0.0)
    model = model_file(verb.model)
    gaussians = Gaussians.load(model)
    attributes = {"Software": f"clsplat {clsplat.__version__}", "clsplat:model": digest(model)}
    options = replace(options, attributes=attributes)
    return Job(verb, options, rasterizer, model, gaussians, tasks, devices, limit)


def _options(verb: Render) -> RenderOptions:
    channels = parse_channels(f"{verb.channels},alpha" if verb.alpha else verb.channels)
    check_format(verb.output, channels)
    if not 1 <= verb.quality <= 100:
        raise InputError(f"--quality {verb.quality}: expected 1 to 100")
    if "alpha" in channels and verb.background is not None:
        flag = "--alpha" if verb.alpha else "--channels alpha"
        raise InputError(f"{flag} and --background exclude each other: with alpha there is no background")
    encoding = Encoding(verb.exr, verb.parts, verb.compression, verb.bits, verb.quality)
    return RenderOptions(channels, parse_colour(verb.background or "black"), encoding)


def _devices(verb: Render) -> tuple[str | None, ...]:
    """The selectors in --device."""
    if verb.workers is not None and verb.workers < 1:
        raise InputError(f"--workers {verb.workers}: expected at least 1")
    if verb.workers is not None and verb.scheduler is not None:
        raise InputError("--workers and --scheduler exclude each other: a new cluster here, or one that is there")
    words = [word.strip() for word in verb.device.split(",")] if verb.device else []
    if not words:
        return (None,)
    farm = "--workers" if verb.workers is not None else "--scheduler" if verb.scheduler is not None else None
    if farm and (len(words) > 1 or words == ["all"]):
        raise InputError(f"--device {verb.device} and {farm} exclude each other: a worker has one device")
    if farm:
        return (words[0],)
    if words == ["all"]:
        from clsplat.device.context import list_devices

        words = [str(info.index) for info in list_devices()]
    elif len(words) > 1:
        from clsplat.device.context import find_device

        found = [find_device(word).index for word in words]
        if len(set(found)) < len(found):
            raise InputError(f"--device {verb.device}: names a device twice, expected each once")
    return tuple(words)


def _run(job: Job) -> int:
    verb, tasks, options = job.verb, job.tasks, job.options
    shaders = []
    if not job.on_farm:
        how: dict[str, Any] = {"memory_limit": job.memory_limit, "profile": verb.profile}
        shaders = [open_shader(job.gaussians, options, job.rasterizer, device=each, **how) for each in job.devices]
    if _is_main_thread():  # again, as pycolmap and compilers of kernels install handlers of their own
        signal.signal(signal.SIGTERM, _interrupt)
    render_job.make_folders(tasks)
    render_job.remove_temporaries(tasks)
    there = render_job.complete(tasks, options) if verb.skip_existing else set()
    records: dict[int, Record] = {}
    lines = sys.stdout if not verb.json else sys.stderr if verb.progress in ("json", "openjd") else None
    start = time.monotonic()
    try:
        with FrameProgress(len(tasks), verb.progress, lines=lines) as progress:

            def done(record: Record) -> None:
                records[record.frame] = record
                progress(record)

            for task in tasks:
                if task.number in there:
                    done(render_job.record_of(task, skipped=True))
            left = [task for task in tasks if task.number not in there]
            if job.on_farm:
                _on_farm(job, left, done)
            else:
                render_job.run_tasks(left, shaders, options, done)
    except KeyboardInterrupt:
        count = f"{len(records)} of {len(tasks)} frames"
        print(f"clsplat: interrupted after {count}; go on with --skip-existing", file=sys.stderr)
        return 130
    if verb.profile:
        _print_profile(records.values(), time.monotonic() - start, len(shaders))
    if verb.json:
        print(json.dumps([records[task.number].document() for task in tasks], indent=2))
    return 0


def _on_farm(job: Job, tasks: Sequence[Task], done: Callable[[Record], None]) -> None:
    from clsplat.farm import Scene, render_on_farm

    if job.verb.profile:
        _warn("--profile is not used: it is for devices of this process")
    scene = Scene(
        str(job.model.absolute()),
        str(job.options.attributes["clsplat:model"]),
        job.options,
        job.rasterizer,
        job.devices[0],
        job.memory_limit,
    )
    render_on_farm(tasks, scene, done, scheduler=job.verb.scheduler, workers=job.verb.workers)


def _print_profile(records: Any, wall: float, devices: int) -> None:
    """What part of the wall time the devices were at work."""
    kernels, transfers = (
        sum(getattr(record, name) or 0.0 for record in records) / (10 * max(wall, 1e-9) * max(devices, 1))
        for name in ("kernel_ms", "transfer_ms")
    )
    print(f"in {wall:.2f} s the device ran kernels {kernels:.1f} % and transfers {transfers:.1f} %", file=sys.stderr)


def _dry_run(job: Job) -> int:
    verb, tasks, options = job.verb, job.tasks, job.options
    there = render_job.complete(tasks, options) if verb.skip_existing else set()
    writers, held = render_job.frames_ahead(tasks, options, len(job.devices))
    host = held * max(render_job.frame_bytes(task, options) for task in tasks)
    plans = [] if job.on_farm else [_plan(job, device) for device in job.devices]
    model_digest = str(options.attributes["clsplat:model"])
    sizes = sorted({(task.camera.width, task.camera.height) for task in tasks})
    if verb.json:
        document = {
            "model": str(job.model),
            "digest": model_digest,
            "gaussians": len(job.gaussians),
            "channels": list(options.channels),
            "frames": [
                {
                    "name": task.name,
                    "frame": task.number,
                    "path": str(task.path),
                    "width": task.camera.width,
                    "height": task.camera.height,
                    "skipped": task.number in there,
                }
                for task in tasks
            ],
            "devices": [
                {"device": name, "needed": plan.needed, "allowed": plan.allowed, "pieces": any(plan.pieces)}
                for name, plan in plans
            ],
            "host_bytes": host,
            "writers": writers,
        }
        print(json.dumps(document, indent=2))
        return 0
    print(f"model     {job.model}: {len(job.gaussians):,} Gaussians, SHA-256 {model_digest[:12]}")
    numbers = ranges([task.number for task in tasks])
    print(f"frames    {len(tasks)}: {numbers}; {', '.join(f'{width}x{height}' for width, height in sizes)}")
    print(f"files     {tasks[0].path}" + (f" to {tasks[-1].path}" if len(tasks) > 1 else ""))
    print(f"channels  {', '.join(options.channels)}")
    for name, plan in plans:
        print(f"device    {name}: {plan}")
    print(f"host      about {host / 2**20:,.0f} MiB for frames that wait to be written")
    if verb.skip_existing:
        listed = f": {ranges(sorted(there))}" if there else ""
        print(f"skipped   {len(there)}{listed}")
    return 0


def _plan(job: Job, selector: str | None) -> tuple[str, Plan]:
    """The device's name, and how its memory will do for the largest frame. Raises CapacityError."""
    from clsplat.device.context import open_device
    from clsplat.needs import plan_frame
    from clsplat.rendering import held_sh
    from clsplat.stages.channels import Features

    device = open_device(selector, job.memory_limit)
    channels = job.options.channels
    features = Features.of(renderer_channels(channels)).floats if beside_colour(channels) else 0
    floats = held_sh(job.gaussians, job.rasterizer).floats
    cameras = {(task.camera.width, task.camera.height): task.camera for task in job.tasks}
    plans = [
        plan_frame(device, len(job.gaussians), floats, camera, job.rasterizer, features) for camera in cameras.values()
    ]
    return device.name, max(plans, key=lambda plan: plan.needed)


@contextmanager
def _terminable() -> Iterator[None]:
    """Inside, SIGTERM raises KeyboardInterrupt in the main thread."""
    if not _is_main_thread():
        yield
        return

    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _warn(text: str) -> None:
    print(f"clsplat: warning: {text}", file=sys.stderr)


def parse_colour(text: str) -> Colour:
    """black, white or three numbers from 0 to 1. Raises InputError."""
    named: dict[str, Colour] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    if text in named:
        return named[text]
    try:
        red, green, blue = (float(word) for word in text.split(","))
    except ValueError:
        red = green = blue = -1.0
    if not (0 <= red <= 1 and 0 <= green <= 1 and 0 <= blue <= 1):
        raise InputError(f"--background {text}: expected black, white or three numbers from 0 to 1 such as 0.2,0.2,0.3")
    return red, green, blue


def resizer(width: int | None, height: int | None, scale: float) -> Callable[[Camera], Camera]:
    """A camera's size after --width, --height and --scale. Raises InputError for sizes that make no sense."""
    for flag, value in (("--width", width), ("--height", height), ("--scale", scale)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"{flag} {value}: expected a number above 0")
    if scale != 1 and (width or height):
        raise InputError("--scale and --width or --height exclude each other")

    def resize(camera: Camera) -> Camera:
        across, down = width, height
        if across is None:
            across = round(camera.width * (down / camera.height if down else scale))
        if down is None:
            down = round(camera.height * (across / camera.width if width else scale))
        if (across, down) == (camera.width, camera.height):
            return camera
        return camera.resized(max(1, across), max(1, down))

    return resize
