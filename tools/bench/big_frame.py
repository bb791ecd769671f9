#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Render one large frame of a synthetic scene in little device memory, and print time and memory.

    python tools/bench/big_frame.py OUTPUT.exr [WIDTHxHEIGHT] [MEMORY] [GAUSSIANS]

The default is 16384x8192 within 512MiB. Prints the number of strips, the peaks of device and host memory, and the time.
The exit status is 1 if more device memory was used than allowed.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

from clsplat.bench.workload import synthetic
from clsplat.cli.bench import parse_size
from clsplat.config.checks import parse_bytes
from clsplat.device.selection import open_device
from clsplat.frame.draw import drawn_by
from clsplat.frame.strips import strip_rows, write_in_strips
from clsplat.rendering.renderer import Renderer


def main(arguments: list[str]) -> int:
    """Render, and print a line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, metavar="OUTPUT.exr")
    parser.add_argument("size", nargs="?", default="16384x8192", metavar="WIDTHxHEIGHT")
    parser.add_argument("memory", nargs="?", default="512MiB", metavar="MEMORY")
    parser.add_argument("gaussians", nargs="?", type=int, default=200_000, metavar="GAUSSIANS")
    options = parser.parse_args(arguments)
    path, size, limit = options.output, parse_size(options.size), parse_bytes(options.memory)
    assert size is not None
    assert limit is not None
    width, height = size
    subject = synthetic(options.gaussians, 1024, 512)
    camera = subject.camera.resized(width, height)
    renderer = Renderer(open_device(None, limit))
    rows = strip_rows(renderer.device, camera, ("rgb", "alpha"))
    start = time.monotonic()
    write_in_strips(path, drawn_by(renderer, subject.gaussians), camera, ("rgb", "alpha"), rows)
    seconds = time.monotonic() - start
    peak, host = renderer.device.memory.peak, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(
        f"{path}: {width}x{height}, {-(-height // rows)} strips of {rows} rows, {seconds:.0f} s; "
        f"device {peak / 2**20:.0f} of {limit / 2**20:.0f} MiB, host {host / 2**20:.0f} MiB, "
        f"file {path.stat().st_size / 2**20:.0f} MiB"
    )
    return int(peak > limit)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
