#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Render one large frame of a made-up scene in little device memory, and say what it took.

    python tools/big_frame.py OUTPUT.exr [WIDTHxHEIGHT] [MEMORY] [GAUSSIANS]

By default 16384x8192 within 512MiB. Prints the strips, the most device memory that was in use, the host's peak and the
time; exit status 1 where more device memory was used than allowed.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path

from clsplat.bench.subject import synthetic
from clsplat.config.checks import parse_bytes
from clsplat.device.context import open_device
from clsplat.frame.draw import drawn_by
from clsplat.frame.strips import strip_rows, write_in_strips
from clsplat.rendering.renderer import Renderer


def main(arguments: list[str]) -> int:
    """Render, and print a line."""
    if not arguments:
        print(__doc__, file=sys.stderr)
        return 2
    path, size, memory, count = (*arguments, *("", "16384x8192", "512MiB", "200000")[len(arguments) :])
    width, height = (int(word) for word in size.split("x"))
    limit = parse_bytes(memory)
    assert limit is not None
    subject = synthetic(int(count), 1024, 512)
    camera = subject.camera.resized(width, height)
    renderer = Renderer(open_device(None, limit))
    rows = strip_rows(renderer.device, camera, ("rgb", "alpha"))
    start = time.monotonic()
    write_in_strips(Path(path), drawn_by(renderer, subject.gaussians), camera, ("rgb", "alpha"), rows)
    seconds = time.monotonic() - start
    peak, host = renderer.device.memory.peak, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(
        f"{path}: {width}x{height}, {-(-height // rows)} strips of {rows} rows, {seconds:.0f} s; "
        f"device {peak / 2**20:.0f} of {limit / 2**20:.0f} MiB, host {host / 2**20:.0f} MiB, "
        f"file {Path(path).stat().st_size / 2**20:.0f} MiB"
    )
    return int(peak > limit)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
