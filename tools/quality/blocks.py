# SPDX-License-Identifier: Apache-2.0
"""The experiment of blocks: a scene whole and in blocks, its borders, and floaters."""

from __future__ import annotations

import shutil
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from quality.trainings import Rows, call, trained, words_of

from clsplat.arrays import Float32, Float64
from clsplat.blocks import block_training
from clsplat.blocks.block_settings import block_settings
from clsplat.blocks.merging import region_of_block
from clsplat.blocks.plan import Block, BlockPlan, read_plan
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.models.edit import take
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View
from clsplat.training.start import Start

BAND_METRES = 3.0
"""Width, on each side of a border, of the band in which PSNR and colour are measured, in world units of the town."""
EXTRA_STEPS = 1.05
"""Steps of the whole's training, as a multiple of --iterations, because the finish adds about as many to the blocks."""
LEAST_PIXELS = 200
"""Least number of pixels of a view in the band, or elsewhere, that count."""
OUTSIDE_CAMERAS = 8
"""Number of cameras around a block that look at it from outside."""
TALLEST = 80.0
"""Height above the median point up to which Gaussians of a block are drawn from outside, in world units: no sky."""


@dataclass(frozen=True)
class Border:
    """A line on the ground between blocks: coordinate `at` on the axis `axis`, from `begin` to `end` on the other."""

    axis: int
    at: float
    begin: float
    end: float

    def distances(self, places: Float64) -> Float64:
        """Signed distances (..., ) of points on the ground (..., 2) from the line; infinite beside its ends."""
        other = places[..., 1 - self.axis]
        beside = (other >= self.begin) & (other < self.end)
        return np.where(beside, places[..., self.axis] - self.at, np.inf)


def borders_of(plan: BlockPlan) -> list[Border]:
    """Find the lines between the blocks of a plan."""
    found = []
    for block in plan.cells:
        for axis, other in ((0, 1), (1, 0)):
            if np.isfinite(at := block.cell.high[axis]):
                found.append(Border(axis, at, block.cell.low[other], block.cell.high[other]))
    return found


def unprojected(camera: Camera, depth: Float32) -> Float64:
    """World positions (H, W, 3) of a pinhole camera's pixels with depths (H, W)."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=2)
    local = rays * depth[:, :, None] - camera.translation
    return np.asarray(local @ camera.rotation)


def ground_of(renderer: Renderer, model: Gaussians, views: Sequence[View], plan: BlockPlan) -> list[Float64]:
    """Return, for each view, where its pixels lie on the ground (H, W, 2), by the median depth of a model along the
    rays; NaN where the model is transparent."""
    places, axes = [], np.array(plan.axes)
    for view in views:
        result, channels = renderer.render_channels(model, view.camera)
        there = (result.alpha > 0.5) & np.isfinite(channels["median"])
        found = unprojected(view.camera, np.where(there, channels["median"], 1.0)) @ axes.T
        places.append(np.where(there[:, :, None], found, np.nan))
    return places


def from_borders(places: Float64, borders: Sequence[Border]) -> Float64:
    """Distance (H, W) of pixels at `places` (H, W, 2) from the nearest border; NaN where there is no place."""
    nearest = np.min([np.abs(border.distances(places)) for border in borders], axis=0)
    return np.where(np.isnan(places[..., 0]), np.nan, nearest)


def psnrs(
    renders: Sequence[Float32], photographs: Sequence[Float32], ground: Sequence[Float64], borders: Sequence[Border]
) -> list[float]:
    """PSNR in dB of all pixels, of those in the band, and of those elsewhere: means over the views that have some."""
    found: list[list[float]] = [[], [], []]
    for image, photograph, places in zip(renders, photographs, ground, strict=True):
        errors = np.square(np.clip(image, 0, 1).astype(np.float64) - photograph).mean(axis=2)
        distance = from_borders(places, borders)
        everywhere = np.ones(distance.shape, np.bool_)
        for index, mask in enumerate((everywhere, distance <= BAND_METRES, distance > BAND_METRES)):
            if mask.sum() >= LEAST_PIXELS:
                found[index].append(float(-10 * np.log10(errors[mask].mean())))
    return [float(np.mean(values)) for values in found]


@contextmanager
def no_surroundings() -> Iterator[None]:
    """Context in which blocks begin with the Gaussians of their widened cell alone, and train them everywhere."""

    def start(model: Gaussians, region: TrainedRegion | None, *rest: object, **named: object) -> Start:
        if region is None:
            return Start(model, region, *rest, **named)  # type: ignore[arg-type]
        inside = take(model, region.contains(model.means, model.origin))
        return Start(inside, None, *rest, **named)  # type: ignore[arg-type]

    def without_frozen(plan: BlockPlan, block: Block, coarse: TrainConfig, _surroundings: int) -> TrainConfig:
        return block_settings(plan, block, coarse, 0)

    with (
        patch.object(block_training, "Start", start),
        patch.object(block_training, "block_settings", without_frozen),
    ):
        yield


def town_of(given: Namespace, exposure: float = 0.0) -> Path:
    """Write the town, or take the one that is there. exposure: stops by which exposures drift (`--town-exposure`)."""
    folder: Path = given.folder / f"town-{exposure:g}"
    if not folder.exists():
        words = ["--town", given.town, "--town-photos", str(given.town_photos), "--town-size", given.town_size]
        call(["demo", *words, "--town-exposure", str(exposure), "-o", str(folder)])
    return folder


def city_of(given: Namespace, town: Path, name: str, settings: str, planned: Path | None = None) -> Path:
    """Train a town in blocks, or go on with it. planned: another city, whose coarse model and plan are taken."""
    city: Path = given.folder / "cities" / name
    if planned is not None and not city.exists():
        shutil.copytree(planned / "coarse", city / "coarse")
        shutil.copy(planned / "plan.json", city / "plan.json")
    if planned is None:
        usual = {"iterations": given.iterations, "seed": given.seed, "resolution": given.resolution}
        call(
            ["train", str(town), "-o", str(city), "--no-report", "--blocks", given.blocks, *words_of(settings, **usual)]
        )
        return city
    for block in read_plan(city).blocks:
        call(["blocks", "train", str(city), "--block", block.shown])
    call(["blocks", "merge", str(city)])
    call(["blocks", "finish", str(city)])
    return city


def models_of(city: Path) -> dict[str, Gaussians]:
    """Models of a city by what they are called in the table."""
    return {
        "merged": Gaussians.load(city / "merged.ply"),
        "finished": Gaussians.load(city / "model.ply"),
    }


def blocks(given: Namespace) -> Rows:
    """A town whole and in blocks: held-out PSNR, in a band along the borders and elsewhere, with and without frozen
    surroundings.

    The whole has as many steps as the blocks with their finish, and at most as many Gaussians.
    """
    renderer = Renderer(open_device())
    town = town_of(given)
    settings = f"schedule=short,sky={given.sky},{given.settings}".rstrip(",")
    growth = f"density.growth=budget,density.max-gaussians={given.gaussians}"
    city = city_of(given, town, "frozen", f"{settings},{growth}")
    plan = read_plan(city)
    borders, scene = borders_of(plan), load_scene(town, resolution=given.resolution)
    models = models_of(city)
    count = f"density.growth=budget,density.max-gaussians={len(models['finished'])}"
    done = trained(
        given, "whole", town, settings=f"{settings},{count}", iterations=round(EXTRA_STEPS * given.iterations)
    )
    cells, sky = sum(len(block.photographs) for block in plan.cells), sum(b.iterations for b in plan.blocks if b.is_sky)
    passes = sum(block.iterations for block in plan.cells) / cells
    yield f"photographs of the blocks without the sky / of the scene: {cells / len(scene.train_views):.2f}"
    yield f"steps of the sky / of as many passes through the scene: {sky / passes / len(scene.train_views):.2f}"
    yield "model", "Gaussians", "PSNR, dB", "band", "elsewhere", "band less elsewhere"
    everything = {"whole": done.model, **models}
    ground = ground_of(renderer, done.model, scene.test_views, plan)
    with no_surroundings():
        alone = city_of(given, town, "alone", settings, planned=city)
    everything |= {f"{name}, without surroundings": model for name, model in models_of(alone).items()}
    photographs = [view.load()[:, :, :3] for view in scene.test_views]
    pictures: dict[str, list[Float32]] = {}
    for name, model in everything.items():
        pictures[name] = [renderer.render(model, view.camera).image for view in scene.test_views]
        values = psnrs(pictures[name], photographs, ground, borders)
        yield name, f"{len(model):,}", *(f"{value:.2f}" for value in values), f"{values[1] - values[2]:.2f}"
    shares = [float((from_borders(places, borders) <= BAND_METRES).mean()) for places in ground]
    save_pictures(given.folder / "pictures", scene, shares, photographs, pictures)
    yield from floaters(given, renderer, scene, {"frozen": city, "without": alone}, done.model)
    return 0


def save_pictures(
    folder: Path, scene: Scene, shares: list[float], photographs: list[Float32], pictures: dict[str, list[Float32]]
) -> None:
    """Write strips of the held-out views with the most pixels in the band: photograph, then each model's render.

    shares: fraction of each view's pixels in the band.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for place in np.argsort(shares)[::-1][:3]:
        rows = [photographs[place], *(images[place] for images in pictures.values())]
        name = scene.test_views[place].name.replace("/", "-").rpartition(".")[0]
        write_image(folder / f"{name}.png", np.clip(np.concatenate(rows, axis=1), 0, 1).astype(np.float32))


def floaters(given: Namespace, renderer: Renderer, scene: Scene, cities: dict[str, Path], whole: Gaussians) -> Rows:
    """Blocks seen from outside, against the same part of the whole's model: what a block adds where the whole has
    nothing, and PSNR. Writes a picture of each."""
    yield "block seen from outside", "surroundings", "coverage where the whole has none", "PSNR to the whole, dB"
    plan = read_plan(cities["frozen"])
    cameras = from_outside(scene, plan)
    wanted = [renderer.render(standing(whole, scene, plan), camera) for camera in cameras]
    pictures = [wanted[0].image]
    for name, city in cities.items():
        model = Gaussians.load(city / "blocks" / plan.blocks[0].name / "model.ply")
        found = [renderer.render(standing(model, scene, plan), camera) for camera in cameras]
        pairs = list(zip(found, wanted, strict=True))
        more = np.mean([np.maximum(one.alpha - other.alpha, 0)[other.alpha < 0.1].mean() for one, other in pairs])
        psnr = np.mean([-10 * np.log10(np.square(one.image - other.image).mean()) for one, other in pairs])
        yield plan.blocks[0].shown, name, f"{100 * more:.2f} %", f"{psnr:.2f}"
        pictures.append(found[0].image)
    strip = np.clip(np.concatenate(pictures, axis=1), 0, 1).astype(np.float32)
    write_image(given.folder / "pictures" / "outside-whole-frozen-without.png", strip)
    return 0


def standing(model: Gaussians, scene: Scene, plan: BlockPlan) -> Gaussians:
    """Gaussians over the first block's cell, up to TALLEST above the median point."""
    up = np.array(plan.up)
    heights = (model.means + model.origin) @ up - np.median(scene.points @ up)
    inside = region_of_block(plan, plan.blocks[0]).contains(model.means, model.origin)
    return take(model, inside & (heights < TALLEST))


def from_outside(scene: Scene, plan: BlockPlan) -> list[Camera]:
    """Cameras in a circle around the first block, which look at its middle from above."""
    axes, up = np.array(plan.axes), np.array(plan.up)
    points = scene.points @ axes.T
    cell = plan.blocks[0].cell
    low, high = np.maximum(cell.low, points.min(axis=0)), np.minimum(cell.high, points.max(axis=0))
    middle = (low + high) / 2 @ axes + up * np.median(scene.points @ up)
    size, cameras = float(np.linalg.norm(high - low)), []
    for angle in np.arange(OUTSIDE_CAMERAS) * 2 * np.pi / OUTSIDE_CAMERAS + np.pi / 4:
        forward = -(np.cos(angle) * axes[0] + np.sin(angle) * axes[1]) * 0.85 - up * 0.53
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        position = middle - forward * 1.3 * size
        cameras.append(Camera(320, 200, 260.0, 260.0, 160.0, 100.0, rotation, -rotation @ position))
    return cameras
