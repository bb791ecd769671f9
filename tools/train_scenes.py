#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Held-out PSNR of scenes that are trained from several seeds, beside what an earlier version reached.

python tools/train_scenes.py SCENES/fox SCENES/bonsai --iterations 2000 --seeds 3 --json before.json
python tools/train_scenes.py SCENES/fox SCENES/bonsai --iterations 2000 --seeds 3 --against before.json

Prints a row for each scene: the mean of the seeds and their range, how many Gaussians ended black, how many with a
channel at its floor of 0, and the difference. Status 1 where a scene is lower by more than --bound, or by --few-bound
if it holds out fewer than four views.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from clsplat import load_scene
from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device, open_device
from clsplat.evaluation.held_out import evaluate
from clsplat.images.alpha import background_colour
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.spherical_harmonics import C0

BOUND, FEW_BOUND, FEW = 0.1, 0.3, 4


def main(arguments: list[str]) -> int:
    """Print the table; 1 where a scene has lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--resolution", type=int, default=0)
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--background", choices=("black", "white", "random"), default="black")
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path, help="write what was found, to be compared with")
    parser.add_argument("--against", type=Path, help="what an earlier version wrote")
    parser.add_argument("--bound", type=float, default=BOUND, help="dB")
    parser.add_argument("--few-bound", type=float, default=FEW_BOUND, help="dB, of scenes with few held-out views")
    given = parser.parse_args(arguments)
    earlier = json.loads(given.against.read_text("utf-8")) if given.against else {}
    device = open_device(given.device)
    found: dict[str, Any] = {}
    print("| scene | held out | PSNR, dB | of the seeds | Gaussians | black | a channel at 0 | change |")
    print("|---|---|---|---|---|---|---|---|")
    lost = 0
    for path in given.scenes:
        scene = load_scene(path, resolution=given.resolution)
        settings = {"iterations": given.iterations, "resolution": given.resolution, "background": given.background}
        results = [measured(scene, TrainConfig(seed=seed, **settings), device) for seed in range(given.seeds)]
        row = {name: float(np.mean([result[name] for result in results])) for name in results[0]}
        scores = [result["psnr"] for result in results]
        views = len(scene.test_views)
        found[scene.name] = {**row, "seeds": scores, "views": views}
        change = row["psnr"] - earlier[scene.name]["psnr"] if scene.name in earlier else None
        lost += change is not None and not change >= -(given.few_bound if views < FEW else given.bound)
        print(
            f"| {scene.name} | {views} | {row['psnr']:.3f} | {min(scores):.3f} to {max(scores):.3f} | "
            f"{row['gaussians']:,.0f} | {row['black']:.0f} | {row['clamped']:.0f} | "
            f"{'' if change is None else f'{change:+.3f}'} |",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")
    return 1 if lost else 0


def measured(scene: Scene, config: TrainConfig, device: Device) -> dict[str, float]:
    """Figures of one training: PSNR of the held-out views, number of Gaussians, and of those that are black or have a
    channel at 0, by the constant coefficient."""
    model = train(scene, config, device=device)
    background, renderer = background_colour(config.background), Renderer(device)
    result = evaluate(
        lambda view: renderer.render(model, view.camera, background).image,
        scene.test_views,
        background,
        step=config.iterations,
        gaussians=len(model),
        seconds=None,
    )
    floor = 0.5 + C0 * model.sh[:, 0].astype(np.float64) <= 1e-6
    return {
        "psnr": result["mean"]["psnr"],
        "gaussians": float(len(model)),
        "black": float(floor.all(axis=1).sum()),
        "clamped": float(floor.any(axis=1).sum()),
    }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
