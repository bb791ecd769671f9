# SPDX-License-Identifier: Apache-2.0
"""Scenes of measurements on GPUs that need no file: the bench's synthetic one, and one like a trained model of fox."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from measuring import require

from clsplat.bench.workload import Subject, load_subject, synthetic
from clsplat.gaussians import Gaussians

FOX_LIKE = (233_481, 449, 800)
"""Gaussians, width and height of the trained model of fox that was measured."""
CELL = 32
"""Side in pixels of the cells in which `fox_like` has one density."""
UNEVEN = 1.1
"""Standard deviation of the density's logarithm: a hundredth of the tiles then have lists of four times the mean."""
LARGER = 1.36
"""Sizes of `fox_like`'s Gaussians relative to the synthetic scene's of as many: 3.1 tiles for each visible one."""
SEEN = 0.8
"""Fraction of `fox_like`'s Gaussians in front of the camera."""


def fox_like(count: int, width: int, height: int) -> Subject:
    """A scene whose lists are like those of a small trained model. Every call returns the same scene.

    It has few tiles, some with many more pairs than others. Its Gaussians are so faint that nearly all pairs are
    walked.
    """
    made = synthetic(count, width, height)
    rng = np.random.default_rng(1)
    camera, model = made.camera, made.gaussians
    across, down = -(-width // CELL), -(-height // CELL)
    density = np.exp(UNEVEN * rng.normal(size=across * down))
    cell = rng.choice(across * down, count, p=density / density.sum())
    pixels = CELL * (np.stack([cell % across, cell // across], axis=1) + rng.random((count, 2)))
    depths = np.where(rng.random((count, 1)) < SEEN, model.means[:, 2:], -model.means[:, 2:])
    means = np.concatenate([(pixels - (camera.cx, camera.cy)) / camera.fx * depths, depths], axis=1)
    opacities = 0.005 + 0.3 * rng.beta(0.5, 6.0, count)
    logits = np.log(opacities) - np.log1p(-opacities)
    gaussians = Gaussians(
        np.ascontiguousarray(means, np.float32),
        model.quaternions,
        model.log_scales + np.float32(np.log(LARGER)),
        np.ascontiguousarray(logits, np.float32),
        model.sh,
    )
    return replace(made, name="fox-like", gaussians=gaussians)


def subject_of(path: str) -> Subject:
    """The subject at a path, or a scene made here: `synthetic:COUNT:WIDTHxHEIGHT` or `fox-like:COUNT:WIDTHxHEIGHT`."""
    made = re.fullmatch(r"(synthetic|fox-like):(\d+):(\d+)x(\d+)", path)
    if made is None:
        made_here = "synthetic:COUNT:WIDTHxHEIGHT or fox-like:COUNT:WIDTHxHEIGHT"
        require(":" not in path, f"{path}: expected a path, {made_here}")
        return load_subject(Path(path))
    scene = synthetic if made[1] == "synthetic" else fox_like
    return scene(*map(int, made.groups()[1:]))
