# SPDX-License-Identifier: Apache-2.0
"""Photographs whose exposure changes against the same photographs as they were, with and without --appearance.

    .venv/bin/python tools/quality_exposure.py SCENE FOLDER [--resolution 200] [--iterations 2000] [--seed 0]
        [--appearance exposure] [--rate 2e-3] [--mixes 0] [--corners 0]
        [--with setting=value,density.setting=value] [--only NAME ...]

Writes the scene's photographs at that resolution as float EXR into FOLDER, once as they are and once times 2^U(-1, 1),
so that nothing clips, and trains on each of them with and without. --mixes has their channels mixed too, each by up to
so much of each other, and --corners a lens that leaves 2^-CORNERS of the light there. All models are measured against
the held-out photographs as they are, after the affine map of colours that fits them best. Gains that were learnt are
compared with those put on, but for a common factor: largest and mean error; then but for those learnt of the
photographs as they are too, whose exposure may change as well. A second line has the errors of mixes (rms, but for
their mean and for those learnt of the photographs as they are) and of the light at the corners, for --appearance ppisp.
--with has settings as quality_views.py takes them. A row that FOLDER has already, of the same settings, is printed
again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from quality_views import with_settings

from clsplat.api import train
from clsplat.arrays import Float64
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device, open_device
from clsplat.errors import InputError
from clsplat.evaluation import metrics
from clsplat.files import atomic_write
from clsplat.images.alpha import Image, composite
from clsplat.images.writing import write_image
from clsplat.reference.ppisp import light, spread
from clsplat.rendering.renderer import Renderer
from clsplat.runs.appearance import unmixing
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View

ROWS = {"clean": (False, False), "gains": (True, False), "clean, learnt": (False, True), "gains, learnt": (True, True)}
"""Rows of the table: whether gains are on the photographs, and whether appearance is learnt."""


@dataclass(frozen=True)
class Changes:
    """Changes of photographs: a gain each, mixes (6,) each, and octaves of light that their lens takes from corners."""

    gains: Float64
    mixes: Float64
    corners: float

    def on(self, place: int, view: View, pixels: Image) -> Image:
        """The photograph number `place`, whose pixels are those of `view`."""
        changed = pixels * np.float32(self.gains[place])
        if self.mixes.any():
            changed = changed @ np.linalg.inv(unmixing(self.mixes[place])).T
        if self.corners:
            camera = view.camera
            s = spread(camera.width, camera.height, (camera.cx, camera.cy))[:, :, None]
            changed = changed * light(np.array([-self.corners / 2, -self.corners / 2, 0]), s)
        return np.ascontiguousarray(changed, np.float32)

    @property
    def label(self) -> str:
        """Part of a folder's name for what is changed beside gains."""
        most = f"-mixes-{np.abs(self.mixes).max():.4f}" if self.mixes.any() else ""
        return most + (f"-corners-{self.corners:g}" if self.corners else "")

    @property
    def none(self) -> Changes:
        """No changes."""
        return Changes(np.ones_like(self.gains), np.zeros_like(self.mixes), 0.0)


def changed(scene: Scene, folder: Path, changes: Changes) -> Scene:
    """The scene with changed photographs, which are EXR files of their working size."""
    folder.mkdir(parents=True, exist_ok=True)
    views: list[View] = []
    for view in scene.views:
        if not view.lens.is_pinhole:
            raise InputError(f"{view.name}: taken through a lens that distorts, expected a scene of pinhole cameras")
        path = folder / f"{len(views):04d}.exr"
        if not path.exists():
            write_image(path, changes.on(len(views), view, composite(view.load(), (0, 0, 0))))
        lens = replace(
            view.lens, width=view.camera.width, height=view.camera.height
        )  # of the file, which is read as it is
        views.append(replace(view, path=path, lens=lens))
    return replace(scene, views=views)


def errors(learnt: dict[str, list[float]], wanted: dict[str, list[float]]) -> str:
    """Largest and mean relative error of the gains that were learnt, both as logs, but for a common factor."""
    apart = np.array([np.subtract(learnt[name], wanted[name]) for name in learnt])
    wrong = np.abs(2.0 ** (apart - apart.mean(axis=0)) - 1)
    return f"{wrong.max():.1%} / {wrong.mean():.1%}"


def further(found: Any, own: Any, mixes: dict[str, Float64], corners: float, put: bool) -> str:
    """A row of the errors of mixes and of the light at the corners."""
    apart = np.array([np.subtract(value, mixes[name] * put) for name, value in found["mixes"].items()])
    if own is not None:
        apart -= np.array([own["mixes"][name] for name in found["mixes"]])
    off = np.sqrt(np.square(apart - apart.mean(axis=0)).mean())
    size = np.sqrt(np.mean([np.square(value * put) for value in mixes.values()]))
    octaves = sum(found["vignette"]) - (sum(own["vignette"]) if own is not None else 0.0)
    told = f"corners {octaves:+.3f} octaves, put on {-corners * put:+.3f}"
    return f"| | mixes off by {off:.4f} of {size:.4f} | {told} | | | | |"


def row(name: str, clean: Scene, folder: Path, changes: Changes, config: TrainConfig, device: Device) -> dict[str, Any]:
    """Train and measure one row."""
    changes, learns = changes if ROWS[name][0] else changes.none, ROWS[name][1]
    kind = f"gains{changes.label}" if ROWS[name][0] else "clean"
    scene = changed(clean, folder / f"{kind}-{config.resolution}-{config.seed}", changes)
    config = config if learns else replace(config, appearance="none")
    run, start = Run.create(folder / "runs" / name.replace(", ", "-"), config, overwrite=True), time.process_time()
    model = train(scene, config, device=device, run=run)
    seconds, renderer = time.process_time() - start, Renderer(device)
    scores = []
    for view in clean.test_views:
        truth, image = composite(view.load(), (0, 0, 0)), renderer.render(model, view.camera).image[:, :, :3]
        scores.append((metrics.psnr(image, truth), metrics.psnr_corrected(image, truth)))
    psnr, corrected = np.mean(scores, axis=0)
    result = {"psnr": psnr, "corrected": corrected, "gaussians": len(model), "seconds": seconds}
    if learns:
        photographs = json.loads(run.appearance_path.read_text("utf-8"))["photographs"]
        result["logs"] = {name: logs.get("log2_gains", logs.get("log2_exposure")) for name, logs in photographs.items()}
        result["mixes"] = {name: logs["mixes"] for name, logs in photographs.items() if "mixes" in logs}
        result["vignette"] = next((logs["vignette"] for logs in photographs.values() if "vignette" in logs), [])
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--resolution", type=int, default=200, help="pixels of the longest side; 0: up to 1600")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--appearance", default="exposure")
    parser.add_argument("--rate", type=float, default=TrainConfig.appearance_rate)
    parser.add_argument("--mixes", type=float, default=0.0)
    parser.add_argument("--corners", type=float, default=0.0)
    parser.add_argument("--with", dest="settings", default="", help="setting=value,...")
    parser.add_argument("--only", nargs="*", choices=ROWS, default=list(ROWS))
    options = parser.parse_args()
    device, clean = open_device(), load_scene(options.scene, resolution=options.resolution)
    rng = np.random.default_rng(options.seed)
    gains = 2.0 ** rng.uniform(-1, 1, len(clean.views))
    mixes = options.mixes * rng.uniform(-1, 1, (len(clean.views), 6))
    changes = Changes(gains, mixes, options.corners)
    settings = f"appearance={options.appearance},appearance_rate={options.rate},{options.settings}"
    config = with_settings(options.iterations, settings)
    config = replace(config, seed=options.seed, resolution=options.resolution, report=False)
    known = options.folder / "rows.json"
    rows = json.loads(known.read_text("utf-8")) if known.exists() else {}
    put_on = {view.name: [np.log2(gain)] for view, gain in zip(clean.views, gains, strict=True)}
    print("| photographs | PSNR | corrected | Gaussians | CPU s | gains wrong by | and but for those of clean |")
    print("|---|---|---|---|---|---|---|")
    keys: dict[str, str] = {}
    for name in options.only:
        learns = (options.appearance, options.rate) if ROWS[name][1] else ()
        more = filter(None, [options.settings])
        put = (options.mixes, options.corners) if ROWS[name][0] and changes.label else ()
        named = (name, options.resolution, options.iterations, options.seed, *learns, *more, *put)
        key = keys[name] = " ".join(map(str, named))
        if key not in rows:
            rows[key] = row(name, clean, options.folder, changes, config, device)
            atomic_write(known, json.dumps(rows).encode())
        found, cells = rows[key], ["", ""]
        if name == "gains, learnt":
            cells[0] = errors(found["logs"], put_on)
            if "clean, learnt" in keys:
                own = rows[keys["clean, learnt"]]["logs"]
                cells[1] = errors(found["logs"], {name: np.add(own[name], put_on[name]).tolist() for name in own})
        scores = f"{found['psnr']:.2f} | {found['corrected']:.2f} | {found['gaussians']:,} | {found['seconds']:.0f}"
        print(f"| {name} | {scores} | {' | '.join(cells)} |", flush=True)
        if found.get("mixes"):
            own = rows[keys["clean, learnt"]] if "clean, learnt" in keys and name == "gains, learnt" else None
            print(
                further(found, own, dict(zip(put_on, mixes, strict=True)), options.corners, ROWS[name][0]), flush=True
            )


if __name__ == "__main__":
    main()
