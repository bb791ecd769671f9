#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measure how the time of a frame grows with the number of Gaussians and with the image's size, and fit a line to each.

    python tools/bench/bench_growth.py [--max-gaussians 3e6] [--max-megapixels 8] [--repeat 5] [--device DEVICE]
                                       [--json] [--plot growth.svg]

The scene is the synthetic one of `clsplat bench`. First the number of Gaussians grows, in images of 1024x768. The
Gaussians shrink so that their total area stays the same. Then the image grows at 4:3, and 200,000 Gaussians grow with
it. Times are medians of the wall time of `Rasterizer.forward`, from an idle device to an idle device.

The line ms = a + b x is fitted by least squares of the relative residuals (each weighted by 1 / ms). So small sizes
count as much as large ones. The largest residual is printed as a fraction of the measured time.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from functools import partial

import numpy as np
from measuring import Result, machine, number, options_parser, parsed, require, show, sizes, tool
from plotting import Panel, plot_growth

from clsplat.bench.workload import synthetic
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.progress import aligned
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import upload_gaussians

GAUSSIANS, WIDTH, HEIGHT = 200_000, 1024, 768
"""Number of Gaussians and image size that are fixed while the other grows."""
FEWEST = 10_000
MEGAPIXELS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
POINTS = 3
"""Smallest number of sizes: a line through one or two points has no residuals."""


def size_of(megapixels: float) -> tuple[int, int]:
    """Width and height of an image of 4:3."""
    width = round((megapixels * 1e6 * 4 / 3) ** 0.5)
    return width, round(width * 3 / 4)


def measure(device: Device, count: int, width: int, height: int, repeat: int) -> Result:
    """Measure a frame and return a row of the table. `pairs` counts (tile, Gaussian) pairs."""
    print(f"{count:,} Gaussians, {width}x{height}", file=sys.stderr, flush=True)
    subject = synthetic(count, width, height)
    rasterizer = Rasterizer(device)
    gaussians = upload_gaussians(device, subject.gaussians)
    background = upload(device, np.zeros(3, np.float32))
    draw = partial(rasterizer.forward, gaussians, subject.camera, background, backward=False)
    frames = [draw() for _ in range(2)]  # the first builds kernels and allocates memory
    ms = statistics.median(device.timed(draw)[1] for _ in range(repeat))
    pairs = frames[-1].listed.counted.pairs
    return {"gaussians": count, "width": width, "height": height, "pairs": pairs, "ms": ms}


def fit(x: Sequence[float], ms: Sequence[float]) -> tuple[float, float, list[float]]:
    """a and b of ms = a + b x, and the relative residuals, (fitted - measured) / measured."""
    times = np.asarray(ms)
    rows = np.stack([np.ones(len(times)), np.asarray(x)], axis=1) / times[:, None]
    (a, b), *_ = np.linalg.lstsq(rows, np.ones(len(times)), rcond=None)
    residuals: list[float] = (rows @ (a, b) - 1).tolist()
    return float(a), float(b), residuals


def growth(rows: list[Result], unit: str, x: Sequence[float]) -> Result:
    """The rows with their residuals, and the fitted line. x: a number in `unit` for each row."""
    a, b, residuals = fit(x, [row["ms"] for row in rows])
    told = [{**row, "x": value, "residual": residual} for row, value, residual in zip(rows, x, residuals, strict=True)]
    largest = max(residuals, key=abs)
    return {"unit": unit, "rows": told, "ms_at_zero": a, "ms_per_unit": b, "largest_residual": largest}


def table(part: Result) -> list[str]:
    """Text table of a result of `growth`: times over Gaussians, or over pixels."""
    rows: list[tuple[str, ...]] = [("Gaussians", "image", "tile pairs", "ms", "off the line")]
    for row in part["rows"]:
        size, off = f"{row['width']}x{row['height']}", f"{row['residual']:+.1%}"
        rows.append((f"{row['gaussians']:,}", size, f"{row['pairs']:,}", f"{row['ms']:.2f}", off))
    line = f"ms = {part['ms_at_zero']:.2f} + {part['ms_per_unit']:.2f} x, x in {part['unit']}"
    return [*aligned(rows), "", f"{line}; largest residual {part['largest_residual']:+.1%}"]


def panel(part: Result) -> Panel:
    """Panel of the plot for a result of `growth`: times over Gaussians, or over pixels."""
    measured = [(row["x"], row["ms"]) for row in part["rows"]]
    ends = np.geomspace(measured[0][0], measured[-1][0], 50).tolist()  # the line is curved on logarithmic axes
    fitted = [(x, part["ms_at_zero"] + part["ms_per_unit"] * x) for x in ends]
    kept = [point for point in fitted if point[1] > 0]
    label = (
        f"{part['ms_at_zero']:.1f} + {part['ms_per_unit']:.1f} x, off by {abs(part['largest_residual']):.0%} at most"
    )
    return Panel(f"x: {part['unit']}", "ms a frame, median", {"measured": measured}, {label: kept})


@tool("bench_growth")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    parser = options_parser(__doc__)
    parser.add_argument("--max-gaussians", metavar="N", type=number, default=3_000_000)
    parser.add_argument("--max-megapixels", metavar="X", type=float, default=8.0)
    options = parsed(parser, arguments)
    counts = sizes(FEWEST, options.max_gaussians)
    images = [size_of(size) for size in MEGAPIXELS if size <= options.max_megapixels]
    least = sizes(FEWEST, 10 * FEWEST)[POINTS - 1]
    require(len(counts) >= POINTS, f"--max-gaussians {options.max_gaussians}: expected at least {least}")
    least_pixels = f"--max-megapixels {options.max_megapixels:g}: expected at least {MEGAPIXELS[POINTS - 1]:g}"
    require(len(images) >= POINTS, least_pixels)
    device = open_device(options.device)
    by_count = [measure(device, count, WIDTH, HEIGHT, options.repeat) for count in counts]
    by_size = [measure(device, GAUSSIANS, *image, options.repeat) for image in images]
    parts = {
        "gaussians": growth(by_count, "million Gaussians", [1e-6 * count for count in counts]),
        "pixels": growth(by_size, "megapixels", [1e-6 * width * height for width, height in images]),
    }
    result = {**machine(device, options.repeat), **parts}
    show(result, [*table(parts["gaussians"]), "", *table(parts["pixels"])], as_json=options.json)
    if options.plot is not None:
        title = f"A frame on {result['device']}, {result['driver'].split('  ')[0]}"
        plot_growth(options.plot, [panel(part) for part in parts.values()], title)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
