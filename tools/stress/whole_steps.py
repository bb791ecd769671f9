# SPDX-License-Identifier: Apache-2.0
"""Time steps of a training that gets all its Gaussians in memory, with any version of clsplat on PYTHONPATH.

    whole_steps.py FOLDER GAUSSIANS DEGREE STEPS DENSE [DEVICE]

`tools/stress/run sizes --before` starts it. Prints the times as JSON.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from plain import CELL, SeededArray, settings, timed_steps

from clsplat.cli.session import Services
from clsplat.gaussians import Gaussians, group_shapes
from clsplat.scenes.loading import load_scene
from clsplat.training.trainer import Trainer


def plain(count: int, coefficients: int) -> Gaussians:
    """All Gaussians of the plain."""
    arrays = {name: SeededArray(name, shape).get() for name, shape in group_shapes(count, coefficients).items()}
    sh = np.empty((count, coefficients, 3), np.float32)
    sh[:, :1], sh[:, 1:] = arrays["sh_dc"].reshape(count, 1, 3), arrays["sh_rest"].reshape(count, -1, 3)
    return Gaussians(arrays["means"], arrays["quaternions"], arrays["log_scales"], arrays["opacity_logits"], sh)


def main(arguments: Sequence[str]) -> int:
    """Train, and print the times."""
    count, degree, steps, dense = map(int, arguments[1:5])
    scene = replace(load_scene(Path(arguments[0]), test_every=0), unit=CELL)
    config = settings(steps, degree, dense=bool(dense))
    trainer = Trainer(scene, config, Services().open_device(*arguments[5:]), plain(count, (degree + 1) ** 2))
    print(json.dumps(timed_steps(trainer, steps)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
