# SPDX-License-Identifier: Apache-2.0
"""Trainings with masks and without: a block that moves over a scene's photographs, and a thing on a turntable.

    .venv/bin/python tools/quality_masks.py SCENE FOLDER [--resolution 200] [--iterations 7000] [--seed 0]

SCENE is a COLMAP scene, sparse/0 beside images/. A block of patterned pixels covers a twelfth of each photograph to
train on, elsewhere in each, and masks cover the block. There are four trainings: on the photographs as they were, with
the block, with the block masked, and with a block of other pixels masked. The last two models have the same bytes, or
the call ends with status 1. All are measured on the held-out photographs, which have no block.

The turntable is the demo's still life without its floor and wall: photographs with alpha, by the ray caster. There are
two trainings over black, with `--alpha blend` and `--alpha transparent`. Measured are the mean alpha of the renders
where the held-out photographs are transparent, and PSNR over white.

FOLDER/SCENE-ITERATIONS-RESOLUTION-SEED has the runs, which are not made again, and block.png and turntable.png:
photographs and renders side by side.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from quality_points import depth_of, trained, write_scene

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.verbs import TEST_EVERY
from clsplat.demo.ray_caster import Floor, Surface, Wall, bake, cameras, render, still_life
from clsplat.device.context import open_device
from clsplat.errors import ClsplatError, InputError
from clsplat.evaluation.metrics import psnr
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import composite
from clsplat.images.reading import downscale, read_image
from clsplat.images.writing import write_image
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene

POINTS = (1000, 20_000)
"""Sparse and dense points of the turntable; training starts from the sparse ones."""
ROUNDS = 3
"""How many times the block crosses the picture in the course of the photographs."""


def with_block(scene: Path, folder: Path, seed: int) -> Path:
    """The scene with a block on each photograph to train on, of pixels by the seed, and masks of it."""
    if not (scene / "sparse" / "0").is_dir():
        raise InputError(f"{scene / 'sparse' / '0'}: no such folder, expected a COLMAP scene")
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    try:
        model = pycolmap.Reconstruction(scene / "sparse" / "0")
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{scene / 'sparse' / '0'}: {error}, expected a COLMAP model") from None
    images = sorted(model.images.values(), key=lambda image: image.name)
    for index, image in enumerate(images):
        photograph = composite(read_image(scene / "images" / image.name, orient=False), (0, 0, 0))
        image.name = f"{index:06d}.png"
        if index % TEST_EVERY:
            height, width = photograph.shape[:2]
            across, down = width // 3, height // 4
            turn = ROUNDS * index / len(images) % 1
            left, top = round(turn * (width - across)), round((0.5 + 0.4 * np.sin(7 * turn)) * (height - down))
            mask = np.ones((height, width, 3), np.float32)
            mask[top : top + down, left : left + across] = 0
            photograph = np.where(mask > 0, photograph, pattern(width, height, seed))
            write_image(folder / "masks" / image.name, mask)
        write_image(folder / "images" / image.name, photograph)
    model.write(folder / "sparse" / "0")
    return folder


def pattern(width: int, height: int, seed: int) -> Float32:
    """A picture (H, W, 3) of squares in random colours."""
    side = max(width // 24, 1)
    colours = np.random.default_rng(seed).random((height // side + 1, width // side + 1, 3)).astype(np.float32)
    return np.asarray(colours.repeat(side, axis=0).repeat(side, axis=1)[:height, :width])


def cut_out(surfaces: list[Surface], camera: Camera) -> Float32:
    """The ray caster's picture (H, W, 4) of the surfaces alone, with straight alpha, four rays a pixel."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    hit = (depth_of(surfaces, fine) > 0).astype(np.float32)[:, :, None]
    both = np.concatenate([render(surfaces, fine, samples=1) * hit, hit], axis=2)
    return downscale(both, camera.width, camera.height)


def turntable(folder: Path, seed: int) -> Path:
    """A scene of the still life's things, cut out of their surroundings."""
    surfaces = still_life()
    bake(surfaces, seed)
    things = [surface for surface in surfaces if not isinstance(surface, Floor | Wall)]
    views = cameras(40, 160, 120, seed)
    with ThreadPoolExecutor(2) as pool:
        pictures = list(pool.map(partial(cut_out, things), views))
        depths = list(pool.map(partial(depth_of, things), views))
    return write_scene(folder, views, pictures, depths, POINTS, seed)


def model_of(scene: Path, run: Path, options: argparse.Namespace, *more: str) -> Gaussians:
    """The model of a run, which is trained where it is not there."""
    trained(scene, run, ["--iterations", str(options.iterations), "--seed", str(options.seed), *more])
    return Gaussians.load(run / "model.ply")


def block(options: argparse.Namespace, renderer: Renderer) -> int:
    """The table of the block; 1 if masked pixels have changed a bit of the model."""
    size = ("--resolution", str(options.resolution))
    scenes = [with_block(options.scene, options.folder / f"block-{seed}", seed) for seed in (1, 2)]
    rows = {
        "photographs as they were": (options.scene, ()),
        "with the block": (scenes[0], ()),
        "with the block, `--masks ignore`": (scenes[0], ("--masks", "ignore")),
        "with other pixels, `--masks ignore`": (scenes[1], ("--masks", "ignore")),
    }
    print(f"| {options.scene.name} | PSNR, dB | SSIM | Gaussians | digest of the model |\n|---|---|---|---|---|")
    view = load_scene(scenes[0], resolution=options.resolution).train_views[0]
    pictures, digests = [view.load()[:, :, :3]], []
    for number, (name, (scene, more)) in enumerate(rows.items()):
        run = options.folder / f"block-run-{number}"
        model = model_of(scene, run, options, *size, *more)
        found = json.loads((run / "eval.json").read_text("utf-8"))["mean"]
        digests.append(hashlib.blake2b((run / "model.ply").read_bytes(), digest_size=8).hexdigest())
        print(f"| {name} | {found['psnr']:.2f} | {found['ssim']:.4f} | {len(model):,} | {digests[-1]} |", flush=True)
        pictures.append(renderer.render(model, view.camera).image[:, :, :3])
    write_image(options.folder / "block.png", np.clip(np.concatenate(pictures, axis=1), 0, 1).astype(np.float32))
    same = digests[2] == digests[3]
    print(f"\nPixels under the masks change {'no bit' if same else 'the bits'} of the model.")
    return 0 if same else 1


def table_of_turntable(options: argparse.Namespace, renderer: Renderer) -> None:
    """The table of the turntable."""
    scene = turntable(options.folder / "turntable", options.seed)
    rows = []
    print("| turntable | alpha outside | PSNR over white, dB | Gaussians |\n|---|---|---|---|")
    for meaning in ("blend", "transparent"):
        model = model_of(scene, options.folder / f"turntable-{meaning}", options, "--alpha", meaning)
        outside, scores, pictures = [], [], []
        for view in load_scene(scene).test_views:
            truth, seen = view.load(), renderer.render(model, view.camera, background=(1, 1, 1))
            outside.append(seen.alpha[truth[:, :, 3] == 0])
            white = composite(truth, (1, 1, 1))
            scores.append(psnr(seen.image[:, :, :3], white))
            pictures.append(np.concatenate([white, seen.image[:, :, :3]]))
        rows.append(pictures[0])
        alpha = np.concatenate(outside).mean()
        print(f"| `--alpha {meaning}` | {alpha:.4f} | {np.mean(scores):.2f} | {len(model):,} |", flush=True)
    write_image(options.folder / "turntable.png", np.clip(np.concatenate(rows, axis=1), 0, 1).astype(np.float32))


def main() -> int:
    """Make both tables; 1 if masked pixels have changed a bit of the model, or where the work fails, 2 for a scene that
    is none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--resolution", type=int, default=200, help="longest side of the photographs; 0: as they are, up to 1600"
    )
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.scene = options.scene.resolve()
    options.folder /= f"{options.scene.name}-{options.iterations}-{options.resolution}-{options.seed}"
    try:
        renderer = Renderer(open_device())
        status = block(options, renderer)
        print()
        table_of_turntable(options, renderer)
    except (ClsplatError, OSError) as error:
        print(f"quality_masks: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    return status


if __name__ == "__main__":
    raise SystemExit(main())
