# SPDX-License-Identifier: Apache-2.0
"""Dense points and known depths against sparse points: in how many steps they reach what sparse ones do in many.

    .venv/bin/python tools/quality_points.py FOLDER [--rgbd SCENE] [--width 120] [--photos 40] [--iterations 7000]
        [--least 2500] [--sparse 1000] [--dense 40000] [--seed 0]

The scene is the demo's, whose ray caster knows every depth; with --rgbd it is a folder of frame-N.color.jpg, .depth.png
(16 bit, mm) and .pose.txt, with camera-intrinsics.txt beside. It is written as nerfstudio's transforms.json. Sparse
points are drawn at random from the dense ones, as many as structure from motion finds in pictures so small. Trained are
FOLDER/sparse with --iterations steps, FOLDER/dense with --least, FOLDER/depth with as many from the sparse points with
depth maps, and FOLDER/both. Runs that are there are not made again. The table is of PSNR on the held-out pictures by
step.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.cli.main import main as clsplat
from clsplat.demo.ray_caster import Surface, bake, cameras, render, still_life
from clsplat.images.reading import downscale, open_image, read_image
from clsplat.images.writing import write_image
from clsplat.scenes.transforms import COLMAP_FROM_OPENGL

STEPS = (250, 500, 1000, 1500, 2000, 2500, 5000)
FARTHEST = 6.0
"""Metres up to which an RGB-D camera's depths are taken."""


def write_scene(
    folder: Path,
    views: list[Camera],
    pictures: list[Float32],
    depths: list[Float32],
    counts: tuple[int, int],
    seed: int,
) -> Path:
    """The scene with sparse.ply in transforms.json, and dense.ply, of depths that are 0 where they are not known."""
    for name in ("images", "depths"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames: list[dict[str, Any]] = []
    points, colors = [], []
    for index, (view, picture, depth) in enumerate(zip(views, pictures, depths, strict=True)):
        write_image(folder / "images" / f"{index:03d}.png", picture)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = view.rotation.T @ COLMAP_FROM_OPENGL, view.position
        lens = {"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy, "w": view.width, "h": view.height}
        np.save(folder / "depths" / f"{index:03d}.npy", depth)
        files = {"file_path": f"images/{index:03d}.png", "depth_file_path": f"depths/{index:03d}.npy"}
        frames.append({**files, **lens, "transform_matrix": matrix.tolist()})
        if index % 8:  # none of the points are of held-out pictures
            rows, columns = np.nonzero(depth)
            z = depth[rows, columns].astype(float)
            x, y = (columns + 0.5 - view.cx) / view.fx * z, (rows + 0.5 - view.cy) / view.fy * z
            points.append((np.stack([x, y, z], axis=1) - view.translation) @ view.rotation)
            colors.append(picture[rows, columns])
    every, shades = np.concatenate(points), np.concatenate(colors)
    for name, count in zip(("sparse", "dense"), counts, strict=True):
        chosen = np.sort(np.random.default_rng(seed).permutation(len(every))[:count])
        write_ply(folder / f"{name}.ply", every[chosen], shades[chosen])
    document = {"ply_file_path": "sparse.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document), "utf-8")
    return folder


def write_ply(path: Path, points: Float64, colors: Float32) -> None:
    rows = np.zeros(len(points), [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in "rgb"])
    for axis in range(3):
        rows["xyz"[axis]], rows["rgb"[axis]] = points[:, axis], np.rint(255 * colors[:, axis])
    properties = [f"property float {name}" for name in "xyz"]
    properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    path.write_bytes(("\n".join(header) + "\n").encode() + rows.tobytes())


def depth_of(surfaces: list[Surface], camera: Camera) -> Float32:
    """The depth (H, W) along the axis that each pixel's middle shows."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2).reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    directions = (rays / lengths @ camera.rotation).astype(np.float32)
    distances = np.stack([surface.distance(camera.position.astype(np.float32), directions) for surface in surfaces])
    nearest = distances.min(axis=0)
    depth = np.where(np.isfinite(nearest), nearest / lengths[:, 0], 0)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def demo(width: int, photos: int, seed: int) -> tuple[list[Camera], list[Float32], list[Float32]]:
    """Cameras, photographs and depths of the demo's scene."""
    surfaces = still_life()
    bake(surfaces, seed)
    views = cameras(photos, width, width * 3 // 4, seed)
    with ThreadPoolExecutor(2) as pool:
        pictures = list(pool.map(partial(render, surfaces), views))
        depths = list(pool.map(partial(depth_of, surfaces), views))
    return views, [np.asarray(picture, np.float32) for picture in pictures], depths


def rgbd(folder: Path, width: int, photos: int) -> tuple[list[Camera], list[Float32], list[Float32]]:
    """The same of an RGB-D sequence: depths of the nearest pixel of the map."""
    matrix = np.loadtxt(folder / "camera-intrinsics.txt")
    files = sorted(folder.glob("frame-*.color.jpg"))
    views, pictures, depths = [], [], []
    for file in files[:: max(len(files) // photos, 1)][:photos]:
        stem = file.name.removesuffix(".color.jpg")
        pose = np.linalg.inv(np.loadtxt(folder / f"{stem}.pose.txt"))
        picture = read_image(file)
        full = (picture.shape[1], picture.shape[0])
        lens = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        view = Camera(*full, *lens, pose[:3, :3], pose[:3, 3]).resized(width, width * full[1] // full[0])
        source = open_image(folder / f"{stem}.depth.png")
        levels = np.asarray(source.read_image("uint16")).reshape(full[1], full[0])
        source.close()
        rows = ((np.arange(view.height) + 0.5) * full[1] / view.height).astype(int)
        columns = ((np.arange(view.width) + 0.5) * full[0] / view.width).astype(int)
        depth = levels[rows][:, columns] / np.float32(1000)
        views.append(view)
        pictures.append(downscale(picture, view.width, view.height))
        depths.append(np.where(depth < FARTHEST, depth, 0).astype(np.float32))
    return views, pictures, depths


def trained(scene: Path, run: Path, words: Sequence[str]) -> None:
    """Train with these words of the command line, or go on where that was interrupted; nothing if it is done."""
    if (run / "eval.json").is_file():
        return
    more = ["--resume"] if (run / "config.toml").is_file() else words
    with redirect_stdout(sys.stderr):  # where the table is not
        status = clsplat(["train", str(scene), "-o", str(run), "--no-report", *more])
    if status:
        raise SystemExit(status)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rgbd", type=Path, help="folder of an RGB-D sequence, in place of the demo's scene")
    parser.add_argument("--width", type=int, default=120, help="of the pictures, in pixels")
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--iterations", type=int, default=7000, help="steps of the training from sparse points")
    parser.add_argument("--least", type=int, default=2500, help="steps of the others")
    parser.add_argument("--sparse", type=int, default=1000, help="sparse points")
    parser.add_argument("--dense", type=int, default=40_000, help="dense points")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.rgbd:
        made = rgbd(options.rgbd, options.width, options.photos)
    else:
        made = demo(options.width, options.photos, options.seed)
    scene = write_scene(options.folder / "scene", *made, (options.sparse, options.dense), options.seed)
    dense = ("--points", str(scene / "dense.ply"))
    trainings: dict[str, tuple[int, tuple[str, ...]]] = {
        "sparse": (options.iterations, ()),
        "dense": (options.least, dense),
        "depth": (options.least, ("--depth", "maps")),
        "both": (options.least, (*dense, "--depth", "maps")),
    }
    scores: dict[str, dict[int, float]] = {}
    for name, (iterations, more) in trainings.items():
        run = options.folder / name
        steps = ",".join(str(step) for step in STEPS if step < iterations)
        words = ["--iterations", str(iterations), "--eval-at", steps, "--seed", str(options.seed)]
        trained(scene, run, [*words, *more])
        records = [json.loads(line) for line in (run / "metrics.jsonl").read_text("utf-8").splitlines()]
        scores[name] = {r["step"]: r["eval"]["mean"]["psnr"] for r in records if "eval" in r}
        scores[name][iterations] = json.loads((run / "eval.json").read_text("utf-8"))["mean"]["psnr"]
        print(f"{name}: {records[-1]['gaussians']:,} Gaussians, {records[-1]['seconds']:.0f} s", flush=True)
    steps = sorted({step for values in scores.values() for step in values})
    print(f"| PSNR, dB | {' | '.join(map(str, steps))} |\n|---{'|---' * len(steps)}|")
    for name, values in scores.items():
        row = " | ".join(f"{values[step]:.2f}" if step in values else "" for step in steps)
        print(f"| {name} | {row} |")
    wanted = scores["sparse"][options.iterations]
    for name in list(scores)[1:]:
        first = next((step for step, value in sorted(scores[name].items()) if value >= wanted), None)
        print(f"{name}: {wanted:.2f} dB {f'reached by step {first}' if first else 'not reached'}")


if __name__ == "__main__":
    main()
