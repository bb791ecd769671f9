# SPDX-License-Identifier: Apache-2.0
"""`clsplat render --dry-run`: what would be done, for people and as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from clsplat.cli.render_request import Job, frames_there
from clsplat.config.channels import light_and_rest
from clsplat.config.pictures import FPS
from clsplat.errors import amount, examples
from clsplat.frame.draw import feature_floats, on_tiles
from clsplat.frame.samples import finer
from clsplat.frame.window import crop
from clsplat.sequence import workers
from clsplat.sequence.task import picture_camera
from clsplat.shots.frame_numbers import ranges

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.rendering.memory_plan import Plan


@dataclass(frozen=True)
class DevicePlan:
    """The memory plan of a device for the frame that needs most of it; strips: number of strips that a frame is
    rendered in."""

    device: str
    plan: Plan
    strips: int


def dry_run(job: Job) -> int:
    """Print the plan. Raises DeviceError, and CapacityError where a frame does not fit."""
    verb, tasks, options = job.verb, job.tasks, job.options
    there = frames_there(job)
    plans = [] if job.on_farm else [plan_of(job, device) for device in job.devices]
    if job.verb.json:
        print(json.dumps(document(job, there, plans), indent=2))
        return 0
    _, held = workers.frames_ahead(tasks, options, len(job.devices))
    host = held * max(workers.frame_bytes(task, options) for task in tasks)
    print(f"model     {job.model}: {len(job.gaussians):,} Gaussians, SHA-256 {job.digest[:12]}")
    cameras = [picture_camera(task, options) for task in tasks]
    print(f"frames    {len(tasks)}: {ranges([task.number for task in tasks])}; {examples(_sizes(cameras))}")
    print(f"files     {tasks[0].path}" + (f" to {tasks[-1].path}" if tasks[-1].path != tasks[0].path else ""))
    if job.is_video:
        from clsplat.images.video import rate_of

        print(f"video     {rate_of(job.video.fps or FPS)} frames a second")
    deep = f" in {options.deep.bins} slices by depth" if options.deep else ""
    print(f"channels  {', '.join(options.channels)}{deep}")
    model, output = job.spaces
    print(f"colour    {model}" + (f" to {output}" if output != model else ""))
    if samples := _samples(job):
        print(f"samples   {samples}")
    for each in plans:
        strips = f"; {each.strips} strips a frame" if each.strips > 1 else ""
        print(f"device    {each.device}: {each.plan}{strips}")
    print(f"host      about {amount(host)} for frames that wait to be written")
    if verb.skip_existing:
        listed = f": {ranges(sorted(there))}" if there else ""
        print(f"skipped   {len(there)}{listed}")
    return 0


def document(job: Job, there: set[int], plans: list[DevicePlan]) -> dict[str, Any]:
    """The plan for JSON. there: numbers of the frames that are left out."""
    tasks, options = job.tasks, job.options
    writers, held = workers.frames_ahead(tasks, options, len(job.devices))
    model, output = job.spaces
    frames = []
    for task in tasks:
        camera = picture_camera(task, options)
        frame = {"name": task.name, "frame": task.number, "path": str(task.path)}
        frame |= {"width": camera.width, "height": camera.height, "skipped": task.number in there}
        if window := camera.window:
            frame["window"] = [window.x, window.y, window.width, window.height]
        frames.append(frame)
    return {
        "model": str(job.model),
        "digest": job.digest,
        "gaussians": len(job.gaussians),
        "channels": list(options.channels),
        "deep_bins": options.deep.bins if options.deep else 0,
        "model_colorspace": model,
        "colorspace": output,
        "samples": options.pictures.sampling.samples if options.pictures.sampling.on else 1,
        "supersample": options.pictures.framing.supersample,
        **({"fps": job.video.fps or FPS} if job.is_video else {}),
        "frames": frames,
        "devices": [
            {
                "device": each.device,
                "needed": each.plan.needed,
                "allowed": each.plan.allowed,
                "pieces": any(each.plan.pieces),
                "strips": each.strips,
            }
            for each in plans
        ],
        "host_bytes": held * max(workers.frame_bytes(task, options) for task in tasks),
        "writers": writers,
    }


def plan_of(job: Job, selector: str | None) -> DevicePlan:
    """The plan for the device that `selector` names. Raises DeviceError and CapacityError."""
    from clsplat.device.context import open_device
    from clsplat.frame.deep_exr import deep_rows
    from clsplat.frame.strips import strip_rows
    from clsplat.rendering.memory_needs import plan_frame
    from clsplat.rendering.renderer import held_sh
    from clsplat.stages.deep import DEEP_FLOATS

    device, options = open_device(selector, job.memory_limit), job.options
    floats = held_sh(job.gaussians, job.rasterizer).floats
    framing, names = options.pictures.framing, set(options.channels)
    features = feature_floats(names)
    cameras = {(each.width, each.height): each for each in (picture_camera(task, options) for task in job.tasks)}
    found = []
    for camera in cameras.values():
        if options.deep:
            rows, planes = deep_rows(device, camera, options.deep.bins), 4 * DEEP_FLOATS * options.deep.bins
        else:
            rows, planes = strip_rows(device, camera, options.channels, framing), 0
        strip = crop(camera, 0, 0, camera.width, rows) if rows < camera.height else camera
        drawn = [(strip, features)]
        if framing.supersample > 1 and light_and_rest(names)[0]:
            drawn.append((finer(strip, framing), 0))
        for window, floats_beside in drawn:
            sizes = (on_tiles(window)[0], job.rasterizer, floats_beside, planes)
            plan = plan_frame(device, len(job.gaussians), floats, *sizes)
            found.append(DevicePlan(device.name, plan, -(-camera.height // rows)))
    return max(found, key=lambda each: each.plan.needed)


def _sizes(cameras: list[Camera]) -> list[str]:
    """Sizes of the pictures, and of the frames that they are a part of."""
    sizes = set()
    for camera in cameras:
        window = camera.window
        of = f" at {window.x},{window.y} of {window.width}x{window.height}" if window else ""
        sizes.add((camera.width, camera.height, of))
    return [f"{width}x{height}{of}" for width, height, of in sorted(sizes)]


def _samples(job: Job) -> str:
    sampling, framing = job.options.pictures.sampling, job.options.pictures.framing
    words = [f"{sampling.samples} frames for one" if sampling.on else ""]
    if sampling.moves:
        opens, closes = sampling.shutter
        words.append(f"shutter from {opens:g} to {closes:g} frames")
    words.append(f"lens in focus at {sampling.focus:g}" if sampling.has_lens else "")
    words.append(
        f"{framing.supersample}x{framing.supersample} a pixel, {framing.filter}" if framing.supersample > 1 else ""
    )
    return ", ".join(word for word in words if word)
