#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Compare the times of the library's calls with those of the renderer and the trainer.

    python tools/bench/bench_library.py [--gaussians 1e5] [--size 640x480] [--repeat 25] [--device DEVICE] [--json]

The scene is the synthetic one of `clsplat bench`, with SH of degree 3. Each turn runs every call once. The table has
median times in ms, and medians of the ratios within a turn. Images are compared with `Renderer.render`, images that
prepare a gradient with a trainer's `Rasterizer.forward`, whose image stays on the device, and gradients with
`Rasterizer.backward`. No gradient of the view matrix is computed, as the trainer has none. Without PyTorch, its rows
are absent.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from measuring import Result, machine, number, options_parser, parsed, require, show, tool

from clsplat.bench.workload import Subject, synthetic
from clsplat.camera import Camera
from clsplat.cli.bench import parse_size
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.library.rasterize import rasterize
from clsplat.progress import aligned
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.rendering.renderer import Renderer
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians

DEGREE = 3
Call = tuple[str, Callable[[], Callable[[], object]]]
"""A name, and a function that prepares the call, untimed, and returns the function to time."""


def arrays_of(subject: Subject) -> dict[str, Any]:
    """The arguments of `rasterize`."""
    gaussians, camera = subject.gaussians, subject.camera
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    return {
        "means": gaussians.means,
        "quaternions": gaussians.quaternions,
        "scales": np.exp(gaussians.log_scales),
        "opacities": 1 / (1 + np.exp(-gaussians.opacity_logits)),
        "colors": gaussians.sh,
        "viewmats": pose[None],
        "intrinsics": np.array([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]], np.float32),
    }


def of_the_renderer(device: Device, subject: Subject) -> tuple[Call, Call, Call]:
    """`Renderer.render`, and `Rasterizer.forward` and `Rasterizer.backward`, whose arrays stay on the device."""
    renderer, rasterizer, camera = Renderer(device), Rasterizer(device), subject.camera
    gaussians = upload_gaussians(device, subject.gaussians)
    gradients = allocate_gaussians(device, gaussians.count, gaussians.coefficients, zero=True)
    black = upload(device, np.zeros(3, np.float32))
    planes = upload(device, gradient_of(camera).transpose(2, 0, 1))

    def finished(work: Callable[[], Any]) -> Any:
        found = work()
        device.finish()
        return found

    draw = partial(rasterizer.forward, gaussians, camera, black, backward=True)

    def backward() -> Callable[[], object]:
        frame = finished(draw)
        return lambda: finished(lambda: rasterizer.backward(gaussians, frame, planes, gradients))

    render = partial(renderer.render, subject.gaussians, camera)
    whole, frame = ("Renderer.render", lambda: render), ("Rasterizer.forward", lambda: partial(finished, draw))
    return whole, frame, ("Rasterizer.backward", backward)


def of_numpy(device: Device, subject: Subject) -> tuple[Call, Call, Call]:
    """`clsplat.rasterize` without and with preparation for a gradient, and its vector-Jacobian product."""
    arrays, gradient = arrays_of(subject), gradient_of(subject.camera)[None]

    def call(*, differentiable: bool = True) -> Any:
        width, height = subject.camera.width, subject.camera.height
        how: dict[str, Any] = {"sh_degree": DEGREE, "differentiable": differentiable, "device": device}
        found = rasterize(**arrays, width=width, height=height, **how)
        return found, found.images, found.alphas

    def backward() -> Callable[[], object]:
        found = call()[0]
        return lambda: found.vjp(gradient, cameras=False)

    alone = partial(call, differentiable=False)
    return ("rasterize, differentiable=False", lambda: alone), ("rasterize", lambda: call), ("rasterize, vjp", backward)


def of_torch(device: Device, subject: Subject, *, packed: bool) -> tuple[Call, Call, Call]:
    """`clsplat.torch.rasterization` without and with preparation for a gradient, and its backward pass.

    packed: its argument of this name.
    """
    import torch

    from clsplat.torch import rasterization

    tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays_of(subject).items()}
    poses, lenses = tensors.pop("viewmats"), tensors.pop("intrinsics")
    leaves = [tensor.requires_grad_() for tensor in tensors.values()]
    gradient = torch.from_numpy(gradient_of(subject.camera)[None])

    def call() -> Any:
        means, quats, scales, opacities, sh = leaves
        views = (poses, lenses, subject.camera.width, subject.camera.height)
        how: dict[str, Any] = {"sh_degree": DEGREE, "packed": packed, "device": device}
        return rasterization(means, quats, scales, opacities, sh, *views, **how)

    def backward() -> Callable[[], object]:
        for leaf in leaves:
            leaf.grad = None
        images = call()[0]
        return lambda: images.backward(gradient)

    without = torch.no_grad()(call)
    title = f"torch.rasterization, packed={packed}"
    return (f"{title}, no_grad", lambda: without), (title, lambda: call), (f"{title}, backward", backward)


def gradient_of(camera: Camera) -> Any:
    """A gradient of the loss with respect to the image, (H, W, 3) float32."""
    return np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)


def measure(groups: list[tuple[Call, Call, Call]], repeat: int) -> list[Result]:
    """Time all calls, and return the rows of the table. The ratios are to the times of the first group."""
    times: dict[str, list[float]] = {name: [] for group in groups for name, _ in group}
    for turn in range(repeat + 2):  # the first two are a warm-up, which builds kernels and allocates memory
        for group in groups:
            for name, prepare in group:
                work = prepare()
                began = time.perf_counter()
                kept = work()
                if turn > 1:
                    times[name].append(1e3 * (time.perf_counter() - began))
                del kept, work
    rows = []
    for place in range(3):
        base = times[groups[0][place][0]]
        for group in groups:
            name = group[place][0]
            ratios = [ms / other for ms, other in zip(times[name], base, strict=True)]
            rows.append({"call": name, "ms": statistics.median(times[name]), "ratio": statistics.median(ratios)})
    return rows


@tool("bench_library")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = options_parser(__doc__, 25, plot=False)
    parser.add_argument("--gaussians", metavar="N", type=number, default=100_000)
    parser.add_argument("--size", metavar="WxH", default="640x480")
    options = parsed(parser, arguments)
    require(options.gaussians >= 1, f"--gaussians {options.gaussians}: expected at least 1")
    size = parse_size(options.size)
    assert size is not None
    device, subject = open_device(options.device), synthetic(options.gaussians, *size)
    groups = [of_the_renderer(device, subject), of_numpy(device, subject)]
    try:
        groups += [of_torch(device, subject, packed=packed) for packed in (False, True)]
    except ModuleNotFoundError as error:
        print(f"bench_library: {error}: the table has no rows for PyTorch", file=sys.stderr)
    rows = measure(groups, options.repeat)
    result = {
        **machine(device, options.repeat),
        "gaussians": options.gaussians,
        "width": size[0],
        "height": size[1],
        "rows": rows,
    }
    lines = [("call", "ms", "ratio"), *((row["call"], f"{row['ms']:.1f}", f"{row['ratio']:.2f}") for row in rows)]
    show(result, aligned(lines), as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
