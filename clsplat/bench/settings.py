# SPDX-License-Identifier: Apache-2.0
"""Run time against error, for every switch of the rasterizer: what `clsplat bench --plot` measures and draws."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.bench.stages import held_kind, picture_of, trainer_of
from clsplat.bench.subject import Subject
from clsplat.camera import Camera
from clsplat.config.presets import PRESETS
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.device.layout import PLAIN_SLOTS
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.progress import Progress, aligned, no_progress
from clsplat.reference.blend import blend
from clsplat.reference.project import project
from clsplat.reference.render import parameters
from clsplat.rendering.memory_needs import plan_step
from clsplat.rendering.rasterizer import Frame, Rasterizer
from clsplat.rendering.renderer import held_sh
from clsplat.stages.device_gaussians import AnyGaussians, upload_gaussians

CROP = 192
"""Side in pixels of what is compared with the float64 reference, in the middle of the image; smaller ones are whole."""
ALL_OFF = "all exact switches off"
"""Of several values that a switch can have, the one that does most."""
PSNR_MAX = 160.0
"""PSNR of equal images, which would be infinite."""
MAY_CHANGE_BITS = ("sh_degree_limit", "sh_tolerance", "sh_storage", "alpha_min", "transmittance_min")
"""Settings whose values approximate, all but that of `exact`. Of `extent` one value does: 3sigma."""


def error_of(picture: NDArray[Any], wanted: NDArray[Any]) -> dict[str, float]:
    """PSNR over all pixels and channels in dB, at most PSNR_MAX, and the largest absolute difference. Compared in
    float64, not clamped."""
    difference = np.asarray(picture, np.float64) - np.asarray(wanted, np.float64)
    mse = float(np.mean(np.square(difference)))
    psnr = min(-10 * float(np.log10(mse)), PSNR_MAX) if mse > 0 else PSNR_MAX
    return {"psnr": psnr, "max_abs": float(np.abs(difference).max())}


def settings() -> dict[str, BenchSwitches]:
    """The points of the plot: presets, and each switch away from its default alone, and the exact ones together."""
    named = {f"preset {name}": config.switches() for name, config in PRESETS.items()}
    flags = [switch.name for switch in fields(BenchSwitches) if switch.default is True]
    changes: dict[str, dict[str, Any]] = {
        "extent constant": {"extent": "constant"},
        "tile-test box": {"tile_test": "box"},
        "tile-test square": {"tile_test": "square"},
        "depth-sort pairs": {"depth_sort": "pairs"},
        "key-bits all": {"key_bits": "all"},
        **{f"no {flag.replace('_', '-')}": {flag: False} for flag in flags},
    }
    changes[ALL_OFF] = {key: value for change in changes.values() for key, value in change.items()}
    changes["extent 3sigma"] = {"extent": "3sigma"}
    changes.update({f"sh-degree-limit {degree}": {"sh_degree_limit": degree} for degree in (0, 1, 2)})
    changes.update({f"sh-tolerance {steps}/255": {"sh_tolerance": steps / 255} for steps in (4, 16, 64)})
    changes["sh-storage half"] = {"sh_storage": "half"}
    changes.update({f"alpha-min {steps}/255": {"alpha_min": steps / 255} for steps in (2, 4)})
    changes.update({f"transmittance-min {value:g}": {"transmittance_min": value} for value in (1e-3, 1e-2)})
    named.update({name: BenchSwitches(**change) for name, change in changes.items()})
    merged: dict[BenchSwitches, str] = {}
    for name, config in named.items():
        merged[config] = f"{merged[config]} = {name.removeprefix('preset ')}" if config in merged else name
    return {name: config for config, name in merged.items()}


def approximate(config: RasterizerConfig) -> bool:
    """True if a setting that may change bits differs from that of the `exact` preset."""
    exact = PRESETS["exact"]
    return config.extent == "3sigma" or any(getattr(config, key) != getattr(exact, key) for key in MAY_CHANGE_BITS)


def compare(
    subject: Subject,
    device: Device,
    candidates: Mapping[str, RasterizerConfig] | None = None,
    *,
    repeat: int = 5,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run time against error of each setting: median times of a frame and of a training step, the settings taken in
    turn; the frame's difference from the float64 reference on a crop, and from the exact preset's frame on the whole
    image. Where both are among the settings, also how many times faster all exact switches together make them.
    """
    say = progress or no_progress
    if subject.camera.kind.rays:
        raise InputError(
            f"{subject.name}: its pictures are drawn along rays, expected a model and a camera of the image's plane"
        )
    tried = {name: config.switches() for name, config in (candidates or settings()).items()}
    trainer, camera = trainer_of(subject, device, PRESETS["exact"]), subject.camera
    model, work = trainer.parameters, trainer.rasterizer.work
    background = upload(device, np.zeros(3, np.float32))
    width, height = min(CROP, camera.width), min(CROP, camera.height)
    x0, y0 = (camera.width - width) // 2, (camera.height - height) // 2
    crop = (x0, y0, width, height)
    say("float64 reference", None)
    reference = reference_crop(subject.gaussians, camera, crop)

    def errors(picture: Float32) -> dict[str, dict[str, float]]:
        part = picture[y0 : y0 + height, x0 : x0 + width]
        return {"against_float64": error_of(part, reference), "against_exact": error_of(picture, exact)}

    def draw(rasterizer: Rasterizer) -> Frame:
        held = models[held_kind(rasterizer.config)]
        return rasterizer.forward(held, camera, background, backward=False)

    def step(rasterizer: Rasterizer) -> None:
        trainer.settle()
        trainer.rasterizer = rasterizer
        trainer.train_step()

    models: dict[tuple[object, ...], AnyGaussians] = {held_kind(PRESETS["exact"]): model}
    for config in tried.values():
        if (kind := held_kind(config)) not in models:
            models[kind] = upload_gaussians(device, subject.gaussians, held_sh(subject.gaussians, config))
    exact = picture_of(draw(trainer.rasterizer))
    rasterizers = {name: Rasterizer(device, config, work) for name, config in tried.items()}
    size = (model.count, model.coefficients, [camera])
    for rasterizer in rasterizers.values():
        rasterizer.follow(plan_step(device, *size, rasterizer.config, fields=PLAIN_SLOTS, agreement=False))
    differences = {}
    for done, (name, rasterizer) in enumerate(rasterizers.items()):
        say("settings", done / len(rasterizers))
        differences[name] = errors(picture_of(draw(rasterizer)))
        step(rasterizer)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in rasterizers}
    for done in range(repeat):
        say("times", done / repeat)
        for name, rasterizer in rasterizers.items():
            _, frame_ms = device.timed(partial(draw, rasterizer))
            _, step_ms = device.timed(partial(step, rasterizer))
            times[name].append((frame_ms, step_ms))
    whole = (width, height) == (camera.width, camera.height)
    points: dict[str, dict[str, Any]] = {}
    for name, config in tried.items():
        frame_ms, iteration_ms = map(statistics.median, zip(*times[name], strict=True))
        points[name] = {
            "name": name,
            "approximate": approximate(config),
            "frame_ms": frame_ms,
            "iteration_ms": iteration_ms,
            **differences[name],
            **differences[name]["against_float64" if whole else "against_exact"],
        }
    on_front = front([(point["frame_ms"], point["psnr"]) for point in points.values()])
    for point, best in zip(points.values(), on_front, strict=True):
        point["on_front"] = best
    exact_name = next((name for name, config in tried.items() if config == PRESETS["exact"].switches()), None)
    faster = None
    if exact_name is not None and ALL_OFF in points:
        on, off = points[exact_name], points[ALL_OFF]
        faster = {key: off[f"{key}_ms"] / on[f"{key}_ms"] for key in ("frame", "iteration")}
    return {
        "exact": exact_name,
        "exact_switches_faster": faster,
        "error_is_against": "the float64 reference" if whole else "the exact preset's frame",
        "crop": list(crop),
        "exact_against_float64": errors(exact)["against_float64"],
        "points": list(points.values()),
    }


def front(points: list[tuple[float, float]]) -> list[bool]:
    """Of (cost, quality) pairs those that none beats in one without losing in the other."""
    return [
        not any(c <= cost and q >= quality and (c < cost or q > quality) for c, q in points) for cost, quality in points
    ]


def reference_crop(gaussians: Gaussians, camera: Camera, crop: tuple[int, int, int, int]) -> Float64:
    """A part of the frame in float64, over black, (height, width, 3): the twin, but for Gaussians that cannot reach."""
    x, y, width, height = crop
    degree, antialiased = gaussians.sh_degree, gaussians.antialiased
    projected = project(**parameters(gaussians), camera=camera, sh_degree=degree, antialiased=antialiased)
    means = projected.means2d - (x, y)
    reach = 1.1 * projected.half_extents + 1.0
    near = (means > -reach).all(axis=1) & (means < np.array([width, height]) + reach).all(axis=1)
    image: Float64 = blend(replace(projected, means2d=means, visible=projected.visible & near), width, height).image
    return image


def settings_table(result: dict[str, Any]) -> str:
    """Table of what `compare` measured, for people."""
    rows: list[tuple[str, ...]] = [("setting", "ms", "step ms", "PSNR dB", "largest", "front")]
    for point in result["points"]:
        psnr = "same bits" if point["max_abs"] == 0 else f"{point['psnr']:.1f}"
        front_mark = "*" if point["on_front"] else ""
        times = (f"{point['frame_ms']:.2f}", f"{point['iteration_ms']:.2f}")
        rows.append((point["name"], *times, psnr, f"{point['max_abs']:.2g}", front_mark))
    known, (_, _, width, height) = result["exact_against_float64"], result["crop"]
    note = (
        f"error against {result['error_is_against']}; exact against float64 on {width}x{height} pixels: "
        f"{known['psnr']:.1f} dB, {known['max_abs']:.2g}"
    )
    lines = [*aligned(rows), "", note]
    if (faster := result["exact_switches_faster"]) is not None:
        gain = f"a frame {faster['frame']:.2f} times faster, a training step {faster['iteration']:.2f} times"
        lines.append(f"the exact switches together: {gain}")
    return "\n".join(lines)
