# SPDX-License-Identifier: Apache-2.0
"""Stress test: compare projection, blending and their gradients with the float64 twins on extreme inputs.

    tools/stress/run kernels [--cases 1e6] [--seed 0] [--only NAME,NAME] [--device DEVICE] [--json] [--plot FILE]

A case is one Gaussian for one camera and one stressor, with forward pass and gradient. Nearly all cases are of
projection alone: thousands in a launch, each compared with the twin in 80-bit floats (stress_projection.py). The others
are in small frames, whose pixels and gradients are compared (stress_frames.py). stress_cases.py has the bounds and
their reasons. The exit status is 1 if an error exceeds its bound.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from measuring import Result, heading, machine, number, options_parser, parsed, require, show, tool
from numpy.typing import NDArray
from plotting import Panel, plot_grid
from stress_cases import BAND_SHARE, FRAME, FRAME_TAIL, GRADIENT_NORM, GRADIENT_TAIL, PROJECTION, STRESSORS
from stress_frames import SCENES, FrameOutcome, compare_8k
from stress_frames import compare as compare_frame
from stress_projection import ERRORS, compare
from stress_stages import stages

from clsplat.device.context import Device
from clsplat.device.selection import open_device

Array = NDArray[Any]
BATCH = 5000
"""Number of Gaussians for one camera."""
CASES_A_FRAME = 20_000
"""Number of cases of a run for each frame of a kind."""
CASES_A_LARGE_FRAME = 500_000
"""Number of cases of a run for each frame that takes seconds: 10,000 Gaussians on a pixel, or 7680 x 4320 pixels."""
CASES_A_STAGE = 10_000
"""Number of cases of a run for each random input of a stage by itself. These inputs do not count as cases."""
SLOW = ("one_pixel",)
PLOTTED = {"shape": "whitening, largest", "position": "position (px), largest", "d log_scales": "d scales, 99.9 %"}
STAGES = "stages"
FLOOR = 1e-9
"""Smallest error in a plot; smaller errors are drawn there."""


@dataclass
class Tally:
    """Counts and errors of one stressor.

    shown: number of cases that are visible.
    broken: number of faults by kind.
    errors: errors of all cases, by name.
    norms: sums of squares of the gradients' differences and wanted values, by name.
    hurt: how extreme each case is (`Cases.hurt`).
    """

    cases: int = 0
    shown: int = 0
    broken: dict[str, int] = field(default_factory=dict)
    errors: dict[str, list[Array]] = field(default_factory=dict)
    norms: dict[str, tuple[float, float]] = field(default_factory=dict)
    hurt: list[Array] = field(default_factory=list)

    def add_norms(self, norms: Mapping[str, tuple[float, float]]) -> None:
        """Add to the sums of squares in `norms`."""
        for name, (off, size) in norms.items():
            before = self.norms.get(name, (0.0, 0.0))
            self.norms[name] = (before[0] + off, before[1] + size)

    def add_errors(self, errors: Mapping[str, Array]) -> None:
        """Add to `errors`, in float32, which is precise enough."""
        for name, values in errors.items():
            self.errors.setdefault(name, []).append(np.asarray(values, np.float32))

    def joined(self, name: str) -> Array:
        """All errors of a name; NaN where there was nothing to compare."""
        return np.concatenate(self.errors[name])

    def relative_norm(self, name: str) -> float:
        """|difference| / |wanted| over all cases."""
        off, size = self.norms[name]
        return float(np.sqrt(off / size)) if size > 0 else 0.0


def projections(device: Device, name: str, cases: int, seed: int) -> Tally:
    """Run the cases of one stressor, in batches."""
    stressor, tally = STRESSORS[name], Tally()
    for batch in range(-(-cases // BATCH)):
        rng = np.random.default_rng([seed, batch, *name.encode()])
        made = stressor.make(rng, min(BATCH, cases - batch * BATCH))
        found = compare(device, made, rng, finite_only=stressor.finite)
        tally.cases += len(made.hurt)
        tally.shown += int(found.shown.sum())
        for kind, times in found.broken.items():
            tally.broken[kind] = tally.broken.get(kind, 0) + times
        tally.hurt.append(np.asarray(made.hurt, np.float32))
        tally.add_errors(found.errors)
        tally.add_norms(found.norms)
    return tally


def _summary(values: Array) -> Result:
    values = values[~np.isnan(values)]
    if not len(values):
        return {"median": 0.0, "p999": 0.0, "max": 0.0}
    return {
        "median": float(np.median(values)),
        "p999": float(np.quantile(values, 0.999, method="lower")),
        "max": float(values.max()),
    }


def gradient_faults(name: str, row: Result, tail: float) -> list[str]:
    """Descriptions of a gradient's errors that exceed their bounds.

    The bound of the error in norm over all cases is GRADIENT_NORM, that of the 99.9th percentile of Gaussians `tail`.
    """
    faults = [] if row["norm"] <= GRADIENT_NORM else [f"{name} in norm {row['norm']:.2g} over {GRADIENT_NORM:g}"]
    return faults + ([f"{name} of 99.9 % {row['p999']:.2g} over {tail:g}"] if row["p999"] > tail else [])


def judged(name: str, tally: Tally) -> Result:
    """A stressor's row: errors with their bounds, and descriptions of faults."""
    bounds = {**PROJECTION, **STRESSORS[name].bounds}
    rows, faults = {}, [f"{times} {kind}" for kind, times in tally.broken.items() if times]
    for error in tally.errors:
        row = _summary(tally.joined(error))
        if error in bounds:
            row["bound"] = bounds[error]
            if row["max"] > bounds[error]:
                faults.append(f"{error} {row['max']:.2g} over {bounds[error]:g}")
        else:
            row["norm"] = tally.relative_norm(error.removeprefix("d "))
            faults += gradient_faults(error, row, GRADIENT_TAIL)
        rows[error] = row
    return {"cases": tally.cases, "shown": tally.shown, "errors": rows, "faults": faults}


def frames(device: Device, name: str, many: int, seed: int, every: Tally | None = None) -> Result:
    """The row of `many` frames of one kind. every: tally to which the errors of their gradients are added."""
    image = flips = 0.0
    pixels = band = cases = broken = 0
    tally = Tally()
    for index in range(many):
        rng = np.random.default_rng([seed, index, *name.encode()])
        found: FrameOutcome
        if name == "8k":
            found, count = compare_8k(device, rng), 2000
        else:
            scene = SCENES[name](rng)
            found, count = compare_frame(device, scene, rng), len(scene[0])
        cases += count
        image, flips = float(np.maximum(image, found.image)), max(flips, found.flips)  # np.maximum keeps a NaN
        pixels, band, broken = pixels + found.pixels, band + found.band, broken + (not found.finite)
        for gathered in (tally, every):
            if gathered is not None:
                gathered.add_norms(found.norms)
                gathered.add_errors(found.each)
    faults = [f"{broken} frames not finite"] if broken else []
    if not image <= FRAME:
        faults.append(f"image {image:.2g} over {FRAME:g}")
    if band > BAND_SHARE * pixels + 1:
        faults.append(f"band {band / pixels:.2g} of the pixels, over {BAND_SHARE:g}")
    gradients = {}
    for group in tally.errors:
        gradients[group] = {**_summary(tally.joined(group)), "norm": tally.relative_norm(group)}
        faults += gradient_faults(f"d {group}", gradients[group], FRAME_TAIL)
    return {
        "cases": cases,
        "frames": many,
        "pixels": pixels,
        "band": band,
        "image": image,
        "flips": flips,
        "gradients": gradients,
        "faults": faults,
    }


def panel(name: str, tally: Tally) -> Panel:
    """Plot of errors over how extreme the cases are (`Cases.hurt`), in bins."""
    hurt = np.concatenate(tally.hurt)
    low, high = hurt[hurt > 0].min(), hurt.max()
    edges = np.geomspace(low, max(high, low * 1.01), 25)
    at = np.clip(np.digitize(hurt, edges) - 1, 0, len(edges) - 2)
    lines = {}
    for error, label in PLOTTED.items():
        values, points = tally.joined(error), []
        for index in range(len(edges) - 1):
            own = values[(at == index) & ~np.isnan(values)]
            if len(own) >= 10:
                middle = float(np.sqrt(edges[index] * edges[index + 1]))
                worst = np.quantile(own, 0.999, method="higher") if error.startswith("d ") else own.max()
                points.append((middle, max(float(worst), FLOOR)))
        lines[label] = points
    return Panel(f"{name}: {STRESSORS[name].unit}", "error", lines)


def table(result: Result) -> list[str]:
    """Text table of the result."""
    short = {"d means": "d mean", "d quaternions": "d quat", "d log_scales": "d scale", "d opacity_logits": "d opac"}
    forward = [name for name in ERRORS if not name.startswith("d ")]
    backward = [*short, "d sh"]
    header = [f"{'largest error of':15}", f"{'cases':>8}", f"{'shown':>8}", *(f"{name[:8]:>8}" for name in forward)]
    lines = ["  ".join([*header, *(f"{short.get(name, name):>15}" for name in backward)])]
    for name, row in result["projection"].items():
        cells = [f"{row['errors'][e]['max']:8.1e}" for e in forward if row["errors"]]
        cells += [f"{row['errors'][e]['norm']:7.0e}/{row['errors'][e]['p999']:7.0e}" for e in backward if row["errors"]]
        lines.append("  ".join([f"{name:15}", f"{row['cases']:8,}", f"{row['shown']:8,}", *cells]))
    lines += ["", f"{'frames of':15}     cases    frames   image     band      gradients, in norm / 99.9 %"]
    for name, row in result["frames"].items():
        share = row["band"] / max(row["pixels"], 1)
        worst = [max((g[key] for g in row["gradients"].values()), default=0.0) for key in ("norm", "p999")]
        numbers = f"{row['cases']:9,}  {row['frames']:8}  {row['image']:8.1e}  {share:8.1e}"
        lines.append(f"{name:15} {numbers}  {worst[0]:8.1e} / {worst[1]:8.1e}")
    tail = max((row["p999"] for row in result["frame_gradients"].values()), default=0.0)
    lines.append(f"{'all':15} {'':55}{tail:8.1e}")
    if "stages" in result:
        lines += ["", f"{'by themselves':32}     error     bound"]
        for name, row in result["stages"]["errors"].items():
            lines += [f"{name:32}  {row['error']:8.1e}  {row['bound']:8.1e}"] if row["bound"] else []
    rows = {**result["projection"], **result["frames"], "frames": {"faults": result["frame_faults"]}}
    rows["stages"] = result.get("stages", {"faults": []})
    faults = [f"{name}: {fault}" for name, row in rows.items() for fault in row["faults"]]
    cases = f"{result['cases']:,} cases in {result['seconds']:.0f} s"
    return [*lines, "", cases + (": all within their bounds" if not faults else ", FAULTS:"), *faults]


def stress(device: Device, cases: int, seed: int, names: Sequence[str]) -> tuple[Result, list[Panel]]:
    """Run all chosen parts. Returns the result and the plots."""
    start = time.perf_counter()
    result: Result = {**machine(device, 1), "seed": seed, "projection": {}, "frames": {}}
    panels = []
    every = Tally()
    of_frames = [name for name in (*SCENES, "8k") if name in names]
    for name in of_frames:
        many = 1 + cases // (CASES_A_LARGE_FRAME if name in (*SLOW, "8k") else CASES_A_FRAME)
        result["frames"][name] = frames(device, name, many, seed, every)
    result["frame_gradients"] = {group: _summary(every.joined(group)) for group in every.errors}
    left = cases - sum(row["cases"] for row in result["frames"].values())
    chosen = [name for name in STRESSORS if name in names]
    for index, name in enumerate(chosen):
        share = max(left, 0) // (len(chosen) - index)
        left -= share
        tally = projections(device, name, share, seed)
        result["projection"][name] = judged(name, tally)
        if tally.hurt and not STRESSORS[name].finite:  # with few cases, some stressors have none
            panels.append(panel(name, tally))
    rows = [*result["projection"].values(), *result["frames"].values()]
    far = {group: row["p999"] for group, row in result["frame_gradients"].items() if row["p999"] > GRADIENT_TAIL}
    result["frame_faults"] = [f"d {group} of 99.9 % {tail:.2g} over {GRADIENT_TAIL:g}" for group, tail in far.items()]
    result["cases"] = sum(row["cases"] for row in rows)
    if STAGES in names:
        result["stages"] = stages(device, seed, 4 + cases // CASES_A_STAGE)
        rows.append(result["stages"])
    result["faults"] = len(result["frame_faults"]) + sum(len(row["faults"]) for row in rows)
    result["seconds"] = time.perf_counter() - start
    return result, panels


@tool("stress")
def main(arguments: Sequence[str]) -> int:
    """Run the stress test, and print and plot its result. Returns the exit status."""
    parser = options_parser(__doc__)
    parser.add_argument("--cases", metavar="N", type=number, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="NAMES", default="")
    options = parsed(parser, arguments)
    everything = (*STRESSORS, *SCENES, "8k", STAGES)
    names = options.only.split(",") if options.only else everything
    for name in names:
        require(name in everything, f"--only {name}: expected some of {', '.join(everything)}")
    require(options.cases > 0, f"--cases {options.cases}: expected more than 0")
    result, panels = stress(open_device(options.device), options.cases, options.seed, names)
    show(result, table(result), as_json=options.json)
    if options.plot is not None and panels:
        plot_grid(options.plot, panels, f"Error against what hurts\n{heading(result)}")
    return 1 if result["faults"] else 0
