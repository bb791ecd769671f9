#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Rendered EXR frames against the float64 twin: how far off each is, and how many pixels are over 2e-5.

    clsplat render MODEL.ply --cameras SPARSE_DIR -o 'out/{name}.exr'
    python tools/check_frames.py MODEL.ply SPARSE_DIR out [NAME ...]

Exit status 1 where a frame has more than 1 pixel in 10,000 over the tolerance. The twin takes about ten seconds a
frame for 50,000 Gaussians at 800x450; without names the first, middle and last frame are taken.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.images.reading import read_image
from clsplat.reference.render import render
from clsplat.scenes.colmap import read_cameras

TOLERANCE, FLIPS = 2e-5, 1e-4


def main(arguments: list[str]) -> int:
    """Print a line for each frame."""
    if len(arguments) < 3:
        print(__doc__, file=sys.stderr)
        return 2
    model, sparse, folder = (Path(word) for word in arguments[:3])
    gaussians, cameras = Gaussians.load(model), read_cameras(sparse)
    frames = {Path(name).with_suffix("").as_posix(): camera for name, camera in sorted(cameras.items())}
    names = arguments[3:] or [list(frames)[i] for i in (0, len(frames) // 2, -1)]
    worst = 0.0
    for name in names:
        wanted, _ = render(gaussians, frames[name])
        difference = np.abs(read_image(folder / f"{name}.exr") - wanted).max(axis=2)
        over = float((difference > TOLERANCE).mean())
        within = difference[difference <= TOLERANCE]
        worst = max(worst, over)
        mse = float(np.mean(difference**2))
        print(
            f"{name}: {over * 1e4:.2f} pixels in 10,000 over {TOLERANCE:g}; largest of the rest {within.max():.2g}, "
            f"of all {difference.max():.2g}; PSNR {-10 * np.log10(max(mse, 1e-30)):.1f} dB"
        )
    return int(worst > FLIPS)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
