# SPDX-License-Identifier: Apache-2.0
"""A fisheye capture of 190 degrees against pinhole photographs of the same scene, each trained as it is.

    .venv/bin/python tools/quality_fisheye.py FOLDER [--iterations 2000] [--photos 40] [--width 120] [--seed 0]
        [--threshold 1] [--finer 1] [--antialiased]

Both captures are made by the demo's ray caster from the same places: one through Kannala and Brandt's lens, one through
a pinhole with as many pixels a radian on the axis, or --finer times fewer. What lies around the fisheye's circle is
masked, as it has to be in any capture: other photographs show what is there. Both models are measured on the same
held-out pinhole pictures, each drawn as its file says, that of fisheyes along rays, and on those pixels alone that a
fisheye has too, which is all; then on the inner and the outer half of them, where a pinhole has up to 1 / cos^3 of the
angle as many pixels for the same part of the scene.
Writes FOLDER/fisheye and FOLDER/pinhole, each with model.ply, which is taken again where it is there, and
FOLDER/views.png: truth, fisheye's model, pinhole's, and the fisheye's own held-out picture. The loss is a mean over
pixels, and density control counts in half images: in a fisheye's larger picture the same blur has a smaller gradient,
and fewer Gaussians grow; --threshold makes up for it.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsplat.api import train
from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.demo.ray_caster import Surface, bake, cameras, still_life
from clsplat.device.context import Device, open_device
from clsplat.evaluation.metrics import psnr
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.reference.cameras import cam_from_pixel, pixel_grid
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene

RADIAL = (0.03, -0.012, 0.003, -0.0004)
"""Of the fisheye: a lens that is bent by a few pixels."""
ANGLE = np.deg2rad(190)
POINTS = 4000
HELD_OUT = 8


def fisheye_of(pinhole: Camera, side: int) -> Camera:
    """The fisheye in the place of a pinhole, with a circle of 190 degrees as wide as its square picture."""
    theta = ANGLE / 2
    reach = theta * (1 + sum(k * theta ** (2 * power) for power, k in enumerate(RADIAL, 1)))
    focal, middle = side / 2 / reach, side / 2
    lens = {"fx": focal, "fy": focal, "cx": middle, "cy": middle, "projection": "fisheye", "radial": RADIAL}
    return replace(pinhole, width=side, height=side, **lens)  # type: ignore[arg-type]


def circle(camera: Camera) -> NDArray[np.bool_]:
    """Pixels (H, W) that a fisheye of 190 degrees shows."""
    rays = np.nan_to_num(cam_from_pixel(camera, pixel_grid(camera))[1])
    inside: NDArray[np.bool_] = np.any(rays != 0, axis=1) & (rays[:, 2] > np.cos(ANGLE / 2))
    return inside.reshape(camera.height, camera.width)


def photograph(surfaces: list[Surface], camera: Camera, samples: int = 2) -> Float32:
    """The ray caster's picture of a camera of any projection: samples^2 rays a pixel; black beyond 190 degrees."""
    fine = camera.resized(camera.width * samples, camera.height * samples)
    rays = np.nan_to_num(cam_from_pixel(fine, pixel_grid(fine))[1])
    shown = circle(fine).ravel() if camera.projection == "fisheye" else np.any(rays != 0, axis=1)
    colours = np.zeros((len(rays), 3), np.float32)
    colours[shown] = cast(surfaces, camera, rays[shown])
    linear = colours.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(linear, 0, 1) ** np.float32(1 / 1.6), np.float32)


def cast(surfaces: list[Surface], camera: Camera, rays: np.ndarray) -> Float32:
    """Linear colours (N, 3) of rays (N, 3) of the camera, without gloss."""
    direction = (rays @ camera.rotation).astype(np.float32)
    origin = camera.position.astype(np.float32)
    distances = np.stack([surface.distance(origin, direction) for surface in surfaces])
    nearest, hit = distances.min(axis=0), distances.argmin(axis=0)
    colours = np.zeros_like(direction)
    for index, surface in enumerate(surfaces):
        chosen = np.flatnonzero((hit == index) & np.isfinite(nearest))
        colours[chosen] = surface.colour(origin + nearest[chosen, None] * direction[chosen])
    return colours


def write_scene(folder: Path, surfaces: list[Surface], views: list[Camera]) -> Path:
    """A COLMAP scene of the cameras' photographs, with points on the surfaces and their colours."""
    sparse, images = folder / "sparse" / "0", folder / "images"
    sparse.mkdir(parents=True, exist_ok=True)
    images.mkdir(exist_ok=True)
    one, masks = views[0], folder / "masks"
    shown = None
    if one.projection == "fisheye":
        masks.mkdir(exist_ok=True)
        shown = np.repeat(circle(one)[:, :, None], 3, axis=2).astype(np.float32)
    model = "OPENCV_FISHEYE" if one.projection == "fisheye" else "PINHOLE"
    radial = one.radial if one.projection == "fisheye" else ()
    numbers = " ".join(map(str, (one.width, one.height, one.fx, one.fy, one.cx, one.cy, *radial)))
    (sparse / "cameras.txt").write_text(f"1 {model} {numbers}\n")
    lines = []
    with ThreadPoolExecutor(2) as pool:
        for index, picture in enumerate(pool.map(partial(photograph, surfaces), views)):
            x, y, z, w = Rotation.from_matrix(views[index].rotation).as_quat()
            pose = " ".join(map(repr, map(float, (w, x, y, z, *views[index].translation))))
            lines.append(f"{index + 1} {pose} 1 {index:03d}.png\n\n")
            write_image(images / f"{index:03d}.png", picture)
            if shown is not None:
                write_image(masks / f"{index:03d}.png", shown)
    (sparse / "images.txt").write_text("".join(lines))
    rng, rows = np.random.default_rng(1), []
    for surface in surfaces:
        places = rng.random((2, POINTS // len(surfaces))).astype(np.float32)
        points, _ = surface.point(places[0], places[1])
        colours = np.clip(surface.colour(points), 0, 1) ** (1 / 1.6)
        for point, colour in zip(points.tolist(), (255 * colours).astype(int).tolist(), strict=True):
            rows.append(f"{len(rows) + 1} {' '.join(map(repr, point))} {' '.join(map(str, colour))} 0\n")
    (sparse / "points3D.txt").write_text("".join(rows))
    return folder


def trained(folder: Path, config: TrainConfig, device: Device) -> Gaussians:
    """The model of a scene, trained through its own lens, or the one that is there."""
    scene = load_scene(folder, lenses="native", test_every=HELD_OUT, masks=config.mask_use)
    path = folder / "model.ply"
    if path.exists():
        return Gaussians.load(path)
    model = train(scene, config, device=device)
    model.save(path)
    print(f"{folder.name}: {len(scene.train_views)} photographs, {len(model):,} Gaussians", flush=True)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--width", type=int, default=120, help="of the pinhole's pictures, in pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--threshold", type=float, default=1.0, help="factor of the fisheye's threshold of density control"
    )
    parser.add_argument("--finer", type=float, default=1.0, help="factor of the fisheye's pixels a radian")
    parser.add_argument("--antialiased", action="store_true", help="train both so")
    options = parser.parse_args()
    surfaces = still_life()
    bake(surfaces, options.seed)
    pinholes = cameras(options.photos, options.width, options.width * 3 // 4, options.seed)
    side = round(options.finer * pinholes[0].fx * 1000 / fisheye_of(pinholes[0], 1000).fx)
    fisheyes = [fisheye_of(camera, side) for camera in pinholes]
    device, config = open_device(), TrainConfig(iterations=options.iterations, seed=options.seed, report=False)
    config = replace(config, antialiased=options.antialiased)
    renderer, models = Renderer(device), {}
    for name, views in (("fisheye", fisheyes), ("pinhole", pinholes)):
        factor = options.threshold if name == "fisheye" else 1.0
        density = replace(config.density, gradient_threshold=factor * config.density.gradient_threshold)
        own_config = replace(config, density=density, masks="ignore" if name == "fisheye" else "none")
        models[name] = trained(write_scene(options.folder / name, surfaces, views), own_config, device)
    one = pinholes[0]
    across, down = (np.abs(np.arange(size) + 0.5 - size / 2) for size in (one.width, one.height))
    away = np.hypot(*np.meshgrid(across, down))
    parts = {"whole": away >= 0, "inner half": away <= np.median(away), "outer half": away > np.median(away)}
    scores: dict[tuple[str, str], list[float]] = {(name, part): [] for name in models for part in parts}
    rows = []
    for index in range(0, options.photos, HELD_OUT):
        truth = photograph(surfaces, pinholes[index])
        found = {name: renderer.render(model, pinholes[index]).image for name, model in models.items()}
        for name, image in found.items():
            for part, where in parts.items():
                scores[name, part].append(psnr(image[:, :, :3], truth, where))
        own = renderer.render(models["fisheye"], fisheyes[index]).image[:, :, :3]
        crop = own[(side - truth.shape[0]) // 2 :, (side - truth.shape[1]) // 2 :][: truth.shape[0], : truth.shape[1]]
        whole = own[:: -(-side // truth.shape[0]), :: -(-side // truth.shape[0])]
        shown = np.zeros((truth.shape[0], whole.shape[1], 3), np.float32)
        shown[: whole.shape[0]] = whole
        rows.append(np.concatenate([truth, *found.values(), crop, shown], axis=1))
    write_image(options.folder / "views.png", np.clip(np.concatenate(rows), 0, 1).astype(np.float32))
    means = {key: float(np.mean(values)) for key, values in scores.items()}
    for part in reversed(parts):
        pair = means["fisheye", part], means["pinhole", part]
        print(
            f"{part}: fisheye {pair[0]:.2f}, pinhole {pair[1]:.2f} dB, {pair[1] - pair[0]:+.2f} dB lost by the fisheye"
        )


if __name__ == "__main__":
    main()
