#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""One scene in many units, and moved: each is trained alike, written, read back and rendered, and has to look the same.

python tools/check_scales.py shared/scenes/fox --resolution 160 --iterations 300

Prints a row for each: the extent, the near plane, held-out PSNR against the photographs, and how far that is from the
scene's at its own scale. Status 1 where a row is off by more than --bound.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat import load_scene
from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device, open_device
from clsplat.evaluation.held_out import evaluate
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene

FACTORS = (1.0, 1e-7, 1e-4, 1e4, 1e7)
OFFSET = 1e6
BOUND = 0.3


@dataclass(frozen=True)
class Row:
    """Result for the scene times `factor`, moved by `offset` along each axis."""

    factor: float
    offset: float
    extent: float
    near: float
    psnr: float
    gaussians: int


def main(arguments: list[str]) -> int:
    """Print the table; 1 where a row is off."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--resolution", type=int, default=160)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device")
    parser.add_argument("--bound", type=float, default=BOUND, help="dB")
    given = parser.parse_args(arguments)
    scene = load_scene(given.scene, resolution=given.resolution)
    config = TrainConfig(iterations=given.iterations, seed=given.seed, resolution=given.resolution)
    device = open_device(given.device)
    cases = [*((factor, 0.0) for factor in FACTORS), (1.0, OFFSET)]
    print("| times | moved by | extent | near plane | Gaussians | held-out PSNR, dB | beside its own scale |")
    print("|---|---|---|---|---|---|---|")
    first: Row | None = None
    off = 0
    for factor, offset in cases:
        row = measured(scene, config, device, factor, offset)
        first = first or row
        apart = row.psnr - first.psnr
        off += not abs(apart) <= given.bound
        print(
            f"| {factor:g} | {offset:g} | {row.extent:.3g} | {row.near:.2g} | {row.gaussians:,} | {row.psnr:.2f} | "
            f"{apart:+.3f} |",
            flush=True,
        )
    return 1 if off else 0


def measured(scene: Scene, config: TrainConfig, device: Device, factor: float, offset: float) -> Row:
    """Trained, written, read and rendered."""
    moved = in_units(scene, factor, np.full(3, offset))
    model = train(moved, config, device=device)
    with tempfile.TemporaryDirectory(prefix="clsplat-scales-") as folder:
        path = Path(folder) / "model.ply"
        model.save(path)
        model = Gaussians.load(path)
    background = background_colour(config.background)
    renderer = Renderer(device)
    found = evaluate(
        lambda view: renderer.render(model, view.camera, background).image,
        moved.test_views,
        background,
        step=config.iterations,
        gaussians=len(model),
        seconds=None,
    )
    near = getattr(model, "near", 0.01)
    return Row(factor, offset, moved.extent, near, found["mean"]["psnr"], len(model))


def in_units(scene: Scene, factor: float, offset: NDArray[np.float64]) -> Scene:
    """The scene with its world times factor, and then moved by offset (3,)."""
    views = [
        replace(
            view,
            camera=replace(view.camera, translation=factor * view.camera.translation - view.camera.rotation @ offset),
        )
        for view in scene.views
    ]
    low, high = (factor * corner + offset for corner in scene.bounds)
    return Scene(scene.name, views, factor * scene.points + offset, scene.point_colors, (low, high))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
