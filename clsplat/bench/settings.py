# SPDX-License-Identifier: Apache-2.0
"""Run time and error of every switch of the rasterizer: measurements and table for `clsplat bench --plot`."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.bench.stages import held_kind, picture_of, trainer_of
from clsplat.bench.workload import Subject
from clsplat.camera import Camera
from clsplat.config.presets import RASTERIZER_PRESETS
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import PLAIN_SLOTS
from clsplat.progress import Progress, aligned, no_progress
from clsplat.reference.blend import blend
from clsplat.reference.render import project_model
from clsplat.rendering.memory_needs import StepMemory, plan_step
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.rendering.renderer import held_sh
from clsplat.stages.device_gaussians import AnyGaussians, upload_gaussians

REFERENCE_CROP_SIDE_PX = 192
"""Side in pixels of the central crop that is compared with the float64 reference. Smaller images are compared whole."""
ALL_EXACT_SWITCHES_OFF = "all exact switches off"
"""Name of the setting with all exact switches off. Switches with several values take the one that skips least work."""
MAX_PSNR_DB = 160.0
"""PSNR in dB that is reported for equal images instead of infinity."""
APPROXIMATING_SETTINGS = ("sh_degree_limit", "sh_tolerance", "sh_storage", "alpha_min", "transmittance_min")
"""Fields of `RasterizerConfig` in which all values but the preset `exact`'s are approximate. The field `extent`,
which is not listed, is approximate only if it is "3sigma"."""


def error_of(picture: NDArray[Any], wanted: NDArray[Any]) -> dict[str, float]:
    """Compare two images. Returns their "psnr" in dB, at most MAX_PSNR_DB, and "max_abs", their largest difference.

    Both are over all pixels and channels, in float64, without clamping.
    """
    difference = np.asarray(picture, np.float64) - np.asarray(wanted, np.float64)
    mse = float(np.mean(np.square(difference)))
    psnr = min(-10 * float(np.log10(mse)), MAX_PSNR_DB) if mse > 0 else MAX_PSNR_DB
    return {"psnr": psnr, "max_abs": float(np.abs(difference).max())}


def settings() -> dict[str, BenchSwitches]:
    """Return the settings to measure, by name.

    These are the presets, the defaults with one switch changed, and the defaults with all exact switches off.
    Equal settings are listed once, with their names joined.
    """
    named = {f"preset {name}": config.switches() for name, config in RASTERIZER_PRESETS.items()}
    flags = [switch.name for switch in fields(BenchSwitches) if switch.default is True]
    changes: dict[str, dict[str, Any]] = {
        "extent constant": {"extent": "constant"},
        "tile-test box": {"tile_test": "box"},
        "tile-test square": {"tile_test": "square"},
        "depth-sort pairs": {"depth_sort": "pairs"},
        "key-bits all": {"key_bits": "all"},
        **{f"no {flag.replace('_', '-')}": {flag: False} for flag in flags},
    }
    changes[ALL_EXACT_SWITCHES_OFF] = {key: value for change in changes.values() for key, value in change.items()}
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
    """True if a setting that may change bits of a frame differs from the `exact` preset."""
    exact = RASTERIZER_PRESETS["exact"]
    return config.extent == "3sigma" or any(
        getattr(config, key) != getattr(exact, key) for key in APPROXIMATING_SETTINGS
    )


def compare(
    subject: Subject,
    device: Device,
    candidates: Mapping[str, RasterizerConfig] | None = None,
    *,
    repeat: int = 5,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure run time and error of each setting.

    candidates: the settings by name; None measures `settings()`. repeat: number of rounds.
    progress: function that is called with a text and the completed fraction; None for no calls.
    Times are medians for a frame and for a training step. Each round measures all settings in turn.
    Errors are relative to the float64 reference in a crop, and to the frame of the exact preset in the full image.
    If the settings include exact and ALL_EXACT_SWITCHES_OFF, the result also has the ratio of their times.
    """
    say = progress or no_progress
    if subject.camera.model.along_rays:
        raise InputError(
            f"{subject.name}: is drawn along rays, which --plot does not support; expected a model that is drawn by "
            "projection, and a pinhole camera"
        )
    tried = {name: config.switches() for name, config in (candidates or settings()).items()}
    camera = subject.camera
    comparison = _Comparison(subject, device, tried)
    width, height = min(REFERENCE_CROP_SIDE_PX, camera.width), min(REFERENCE_CROP_SIDE_PX, camera.height)
    x0, y0 = (camera.width - width) // 2, (camera.height - height) // 2
    crop = (x0, y0, width, height)
    say("float64 reference", None)
    reference = reference_crop(subject.gaussians, camera, crop)
    exact = comparison.exact

    def errors(picture: Float32) -> dict[str, dict[str, float]]:
        part = picture[y0 : y0 + height, x0 : x0 + width]
        return {"against_float64": error_of(part, reference), "against_exact": error_of(picture, exact)}

    differences = {}
    for done, (name, rasterizer) in enumerate(comparison.rasterizers.items()):
        say("settings", done / len(tried))
        differences[name] = errors(picture_of(comparison.draw(rasterizer)))
        comparison.step(rasterizer)
    times = comparison.times(repeat, say)
    whole = (width, height) == (camera.width, camera.height)
    points = _points(tried, times, differences, "against_float64" if whole else "against_exact")
    exact_name = next(
        (name for name, config in tried.items() if config == RASTERIZER_PRESETS["exact"].switches()), None
    )
    return {
        "exact": exact_name,
        "exact_switches_faster": _exact_switches_faster(points, exact_name),
        "error_is_against": "the float64 reference" if whole else "the exact preset's frame",
        "crop": list(crop),
        "exact_against_float64": errors(exact)["against_float64"],
        "points": list(points.values()),
    }


class _Comparison:
    """Rasterizers with different settings, which draw the same frame and do the same training step.

    exact: the frame of the exact preset.
    """

    def __init__(self, subject: Subject, device: Device, tried: Mapping[str, BenchSwitches]) -> None:
        self._device, self._camera = device, subject.camera
        self._trainer = trainer_of(subject, device, RASTERIZER_PRESETS["exact"])
        self._background = upload(device, np.zeros(3, np.float32))
        model, work = self._trainer.parameters, self._trainer.rasterizer.work
        self._models: dict[tuple[object, ...], AnyGaussians] = {held_kind(RASTERIZER_PRESETS["exact"]): model}
        for config in tried.values():
            if (kind := held_kind(config)) not in self._models:
                held = held_sh(subject.gaussians, config)
                self._models[kind] = upload_gaussians(device, subject.gaussians, held)
        self.exact = picture_of(self.draw(self._trainer.rasterizer))
        self.rasterizers = {name: Rasterizer(device, config, work) for name, config in tried.items()}
        size = (model.count, model.coefficients, [self._camera])
        for rasterizer in self.rasterizers.values():
            rasterizer.follow(plan_step(device, *size, rasterizer.config, StepMemory(PLAIN_SLOTS)))

    def draw(self, rasterizer: Rasterizer) -> ForwardPass:
        held = self._models[held_kind(rasterizer.config)]
        return rasterizer.forward(held, self._camera, self._background, backward=False)

    def step(self, rasterizer: Rasterizer) -> None:
        self._trainer.settle()
        self._trainer.rasterizer = rasterizer
        self._trainer.train_step()

    def times(self, repeat: int, say: Progress) -> dict[str, list[tuple[float, float]]]:
        """Measure milliseconds of a frame and of a training step for each setting.

        Each of `repeat` rounds measures all settings in turn.
        """
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in self.rasterizers}
        for done in range(repeat):
            say("times", done / repeat)
            for name, rasterizer in self.rasterizers.items():
                _, frame_ms = self._device.timed(partial(self.draw, rasterizer))
                _, step_ms = self._device.timed(partial(self.step, rasterizer))
                times[name].append((frame_ms, step_ms))
        return times


def _points(
    tried: Mapping[str, BenchSwitches],
    times: Mapping[str, Sequence[tuple[float, float]]],
    differences: Mapping[str, Mapping[str, Mapping[str, float]]],
    against: str,
) -> dict[str, dict[str, Any]]:
    """Return a record for each setting: median times, errors, and `on_front`, True on the Pareto front.

    tried: the settings by name.
    times: milliseconds of a frame and of a step, in each round.
    differences: results of `error_of` for each setting and reference.
    against: reference whose difference is used as the setting's error, a key of the differences.
    """
    points: dict[str, dict[str, Any]] = {}
    for name, config in tried.items():
        frame_ms, iteration_ms = map(statistics.median, zip(*times[name], strict=True))
        points[name] = {
            "name": name,
            "approximate": approximate(config),
            "frame_ms": frame_ms,
            "iteration_ms": iteration_ms,
            **differences[name],
            **differences[name][against],
        }
    on_front = front([(point["frame_ms"], point["psnr"]) for point in points.values()])
    for point, best in zip(points.values(), on_front, strict=True):
        point["on_front"] = best
    return points


def _exact_switches_faster(points: Mapping[str, Mapping[str, Any]], exact: str | None) -> dict[str, float] | None:
    """Return how many times faster a frame and a step are with all exact switches on than with all off.

    The result is None if one of these two settings was not measured.
    exact: name of the exact preset among the points; None if it was not measured.
    """
    if exact is None or ALL_EXACT_SWITCHES_OFF not in points:
        return None
    on, off = points[exact], points[ALL_EXACT_SWITCHES_OFF]
    return {key: off[f"{key}_ms"] / on[f"{key}_ms"] for key in ("frame", "iteration")}


def front(points: list[tuple[float, float]]) -> list[bool]:
    """Find the Pareto front: True for each pair (cost, quality) that no other pair dominates."""
    return [
        not any(c <= cost and q >= quality and (c < cost or q > quality) for c, q in points) for cost, quality in points
    ]


def reference_crop(gaussians: Gaussians, camera: Camera, crop: tuple[int, int, int, int]) -> Float64:
    """Render a crop (height, width, 3) of the frame over black with the float64 reference.

    crop: x, y, width and height in pixels. Gaussians that do not reach the crop are skipped.
    """
    x, y, width, height = crop
    projected = project_model(gaussians, camera, gaussians.sh_degree)
    means = projected.means2d - (x, y)
    reach = 1.1 * projected.half_extents + 1.0
    near = (means > -reach).all(axis=1) & (means < np.array([width, height]) + reach).all(axis=1)
    image: Float64 = blend(replace(projected, means2d=means, visible=projected.visible & near), width, height).image
    return image


def settings_table(result: dict[str, Any]) -> str:
    """Format a result of `compare` as a text table."""
    rows: list[tuple[str, ...]] = [("setting", "ms", "step ms", "PSNR dB", "largest", "front")]
    for point in result["points"]:
        psnr = "same bits" if point["max_abs"] == 0 else f"{point['psnr']:.1f}"
        front_mark = "*" if point["on_front"] else ""
        times = (f"{point['frame_ms']:.2f}", f"{point['iteration_ms']:.2f}")
        rows.append((point["name"], *times, psnr, f"{point['max_abs']:.2g}", front_mark))
    known, (_, _, width, height) = result["exact_against_float64"], result["crop"]
    note = (
        f"errors are against {result['error_is_against']}; the exact preset against the float64 reference on "
        f"{width}x{height} pixels: PSNR {known['psnr']:.1f} dB, largest error {known['max_abs']:.2g}"
    )
    lines = [*aligned(rows), "", note]
    if (faster := result["exact_switches_faster"]) is not None:
        gain = f"a frame {faster['frame']:.2f} times faster, and a training step {faster['iteration']:.2f} times"
        lines.append(f"all exact switches together make {gain}")
    return "\n".join(lines)
