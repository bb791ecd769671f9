#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Training on few photographs: PSNR of the held-out views against their number, for several settings.

    python tools/quality_views.py SCENE FOLDER [--views 3,6,9,12] [--iterations 2000] [--resolution 200] [--seeds 0]
        [--try NAME:setting=value,density.setting=value]...

The photographs are picked evenly from the training views by name, so that they are the same each time; the points are
those of the whole scene. Each --try is a row of the table beside that of the defaults, in the settings' names of
config.toml; its schedule and iterations, if there are any, are taken first. FOLDER/views.json keeps what is measured,
and a call goes on from there.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from clsplat.api import train
from clsplat.config.presets import Schedule, scheduled
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device, open_device
from clsplat.errors import InputError
from clsplat.evaluation.held_out import evaluate
from clsplat.images.writing import write_image
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.answers import changed
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene


def picked(scene: Scene, count: int) -> Scene:
    """The scene with `count` of its training views, evenly by name, the first and the last among them."""
    names = [view.name for view in scene.train_views]
    places = np.rint(np.linspace(0, len(names) - 1, min(count, len(names)))).astype(int)
    kept = {names[place] for place in places}
    return replace(scene, views=[view for view in scene.views if view.split == "test" or view.name in kept])


def with_settings(iterations: int, settings: str) -> TrainConfig:
    """The schedule `schedule=NAME`, else the paper's, of so many steps with these settings, `name=value` with commas
    between; values as in JSON, other words as they are. Raises InputError."""
    values: dict[str, Any] = {}
    for setting in filter(None, settings.split(",")):
        name, _, text = setting.partition("=")
        try:
            values[name] = json.loads(text)
        except json.JSONDecodeError:
            values[name] = text
    if (schedule := values.pop("schedule", "paper")) not in get_args(Schedule):
        raise InputError(f"schedule={schedule}: expected one of {', '.join(get_args(Schedule))}")
    config = scheduled(schedule, values.pop("iterations", iterations))
    for name, value in values.items():
        config = changed(config, name.replace("-", "_"), value)
    config.check()
    return config


def measured(scene: Scene, config: TrainConfig, device: Device, pictures: Path) -> dict[str, float]:
    """Mean PSNR and number of Gaussians; the first held-out view, render over photograph, goes to `pictures`."""
    model = train(scene, config, device=device)
    renderer = Renderer(device)
    result = evaluate(
        lambda view: renderer.render(model, view.camera).image,
        scene.test_views,
        (1, 1, 1) if config.background == "white" else (0, 0, 0),
        step=config.iterations,
        gaussians=len(model),
        seconds=None,
    )
    view = scene.test_views[0]
    both = np.concatenate([renderer.render(model, view.camera).image[:, :, :3], view.load()[:, :, :3]])
    write_image(pictures, np.clip(both, 0, 1).astype(np.float32))
    return {"psnr": result["mean"]["psnr"], "gaussians": len(model)}


def table(psnrs: dict[tuple[str, int, int], float], methods: list[str], counts: list[int], seeds: list[int]) -> str:
    """Markdown: means over the seeds."""
    lines = [
        "| settings | " + " | ".join(f"{count} views" for count in counts) + " |",
        "|---" * (len(counts) + 1) + "|",
    ]
    for method in methods:
        cells = [f"{np.mean([psnrs[method, count, seed] for seed in seeds]):.2f}" for count in counts]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def numbers(text: str) -> list[int]:
    """Whole numbers with commas between."""
    return [int(number) for number in text.split(",")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=numbers, default=[3, 6, 9, 12])
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--resolution", type=int, default=200)
    parser.add_argument("--seeds", type=numbers, default=[0])
    parser.add_argument("--try", dest="tried", action="append", default=[], help="NAME:setting=value,...")
    options = parser.parse_args()
    methods = {"as ever": "", **dict(one.split(":", 1) for one in options.tried)}
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "views.json"
    rows = json.loads(file.read_text("utf-8")) if file.exists() else {}
    psnrs: dict[tuple[str, int, int], float] = {}
    scene = load_scene(options.scene, resolution=options.resolution)
    device = open_device()
    for count in options.views:
        few = picked(scene, count)
        for seed in options.seeds:
            for method, settings in methods.items():
                key = f"{method} {count} {seed} {options.iterations} {options.resolution} {settings}"
                config = with_settings(options.iterations, settings)
                config = replace(config, seed=seed, resolution=options.resolution, report=False)
                if key not in rows:
                    picture = options.folder / f"{method.replace(' ', '_')}_{count}_{seed}.png"
                    rows[key] = measured(few, config, device, picture)
                    file.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
                psnrs[method, count, seed] = rows[key]["psnr"]
                words = f"{psnrs[method, count, seed]:.2f} dB, {rows[key]['gaussians']:,} Gaussians"
                print(f"{method}, {count} views, seed {seed}: {words}", flush=True)
    print(table(psnrs, list(methods), options.views, options.seeds))


if __name__ == "__main__":
    main()
