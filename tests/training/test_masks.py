# SPDX-License-Identifier: Apache-2.0
"""Masks in training: both meanings held against the float64 twins, and pixels that must not matter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradients, assert_slopes
from pipeline import BACKGROUND, Pipeline
from quick import quick
from same_bytes import model_bytes
from tiny import CONFIG, write_scene

from clsplat.config.masks import MaskUse
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.layouts.columns import SlotFields
from clsplat.reference.blend import blend
from clsplat.reference.loss import alpha_loss, masked_l1_dssim
from clsplat.reference.project import project
from clsplat.reference.render import forward, parameters, render_grad
from clsplat.scenes.loading import load_scene
from clsplat.stages.device_gaussians import allocate_gaussians, download_gaussians
from clsplat.stages.loss import loss
from clsplat.stages.loss_terms import AlphaTerm, RenderTerms
from clsplat.stages.target import target
from clsplat.training.supervision.image_cache import kept_pixels


def photograph(width: int, height: int) -> np.ndarray:
    """(H, W, 5) with alpha and a mask that leaves out whole tiles, and parts of others."""
    rng = np.random.default_rng(3)
    image = rng.random((height, width, 5)).astype(np.float32)
    image[:, :, 4] = 1
    image[: height // 2 + 3, : width // 2 + 5, 4] = 0
    return image


def masked_step(device: Device, subject: tuple[Any, Any], image: np.ndarray, weight: float) -> tuple[Any, Any, float]:
    """Gradients by parameters and on the screen, and the loss, of a photograph."""
    made, fields = Pipeline.run(device, subject), SlotFields(contributions=True)
    frame, rasterizer = made.frame, made.rasterizer
    planes = target(device, rasterizer.work, image, frame.background, frame.blended, alpha=weight > 0)
    size, kept = (made.camera.width, made.camera.height), kept_pixels(image)
    further = RenderTerms(frame.blended, (AlphaTerm(weight),) if weight else ())
    result = loss(device, rasterizer.work, frame.blended.image, planes, size, 0.2, kept=kept, further=further)
    gradients = allocate_gaussians(device, made.gaussians.count, made.gaussians.coefficients, zero=True)
    screen = rasterizer.backward(made.gaussians, frame, result.gradient, gradients, fields=fields)
    assert screen.contributions is not None
    return download_gaussians(gradients), screen.contributions.get(), result.read()[0]


@pytest.mark.parametrize("weight", [0.0, 0.4])
def test_gradients_are_the_twins(shaped_device: Device, weight: float) -> None:
    gaussians, camera = subject = scenes.NAMED["overlap"]()
    image = photograph(camera.width, camera.height)
    seen = forward(gaussians, camera, BACKGROUND).blended
    image[seen.margin < 1e-4, 4] = 0  # where float32 may decide otherwise
    got, contributions, value = masked_step(shaped_device, subject, image, weight)
    counts, alpha = image[:, :, 4].astype(float), image[:, :, 3].astype(float)
    truth = alpha[:, :, None] * image[:, :, :3] + (1 - alpha[:, :, None]) * np.array(BACKGROUND)
    own, d_image = masked_l1_dssim(seen.image, truth, counts)
    of_alpha, d_t = alpha_loss(seen.transmittance, alpha, counts, weight)
    wanted = render_grad(gaussians, camera, d_image, BACKGROUND, d_transmittance=d_t)
    assert_close(value, own + of_alpha, relative=1e-5)
    assert_close_gradients(got.arrays(), wanted.parameters, 1e-4)
    inside = render_grad(gaussians, camera, counts[:, :, None] + np.zeros(3), BACKGROUND)
    assert np.isfinite(contributions).all()
    assert (contributions <= inside.contributions + 1e-3).all()


def test_the_twins_slopes() -> None:
    """The twin's gradient of both losses against central differences."""
    gaussians, camera = scenes.NAMED["overlap"]()
    image = photograph(camera.width, camera.height).astype(float)
    seen = forward(gaussians, camera, BACKGROUND).blended
    counts = np.where(seen.margin < 1e-3, 0.0, image[:, :, 4])
    arrays = parameters(gaussians)

    def value(arrays: dict[str, np.ndarray]) -> float:
        made = blend(project(**arrays, camera=camera, sh_degree=3), camera.width, camera.height, BACKGROUND)
        of_alpha = alpha_loss(made.transmittance, image[:, :, 3], counts, 0.4)[0]
        return masked_l1_dssim(made.image, image[:, :, :3], counts)[0] + of_alpha

    d_image = masked_l1_dssim(seen.image, image[:, :, :3], counts)[1]
    d_t = alpha_loss(seen.transmittance, image[:, :, 3], counts, 0.4)[1]
    gradients = render_grad(gaussians, camera, d_image, BACKGROUND, d_transmittance=d_t).parameters
    assert_slopes(value, arrays, gradients, step=1e-7, tolerance=1e-4)


def with_masks(folder: Path, seed: int) -> Path:
    """The tiny scene with a block in every picture, of pixels by the seed, and masks of the blocks."""
    scene = write_scene(folder)
    rng = np.random.default_rng(seed)
    (scene / "masks").mkdir()
    for index, path in enumerate(sorted((scene / "images").iterdir())):
        image, mask = read_image(path), np.ones((40, 48, 3), np.float32)
        mask[5:23, 2 * index : 2 * index + 19] = 0
        write_image(path, np.where(mask > 0, image, rng.random(image.shape)).astype(np.float32))
        write_image(scene / "masks" / f"{path.name}.png", mask)
    return scene


def model(folder: Path, scene: Path, config: TrainConfig, device: Device) -> bytes:
    return model_bytes(load_scene(scene, masks=config.mask_use), config, device, folder)


@pytest.mark.parametrize("batch", quick([1, 2], 1))
def test_ignored_pixels_change_no_bit(default_device: Device, tmp_path: Path, batch: int) -> None:
    """At every resolution of the warm-up."""
    config = replace(CONFIG, masks="ignore", report=False, batch=batch)
    models = [model(tmp_path / f"run{n}", with_masks(tmp_path / f"{n}", n), config, default_device) for n in (1, 2)]
    assert models[0] == models[1]
    plain = model(tmp_path / "plain", tmp_path / "1", replace(CONFIG, report=False, batch=batch), default_device)
    assert plain != models[0]


def test_the_mean_is_of_the_part_that_counts(tmp_path: Path) -> None:
    """A picture of two colours, one of which is masked, has no trace of it at any size."""
    scene = write_scene(tmp_path / "scene")
    image, mask = np.full((40, 48, 3), 0.2, np.float32), np.ones((40, 48, 3), np.float32)
    image[:, 21:], mask[:, 21:] = 0.9, 0
    (scene / "masks").mkdir()
    for path in sorted((scene / "images").iterdir()):
        write_image(path, image)
        write_image(scene / "masks" / f"{path.stem}.png", mask)
    view = load_scene(scene, masks=MaskUse("ignore")).views[0]
    for width, height in ((48, 40), (24, 20), (12, 10), (13, 7)):
        pixels = view.load_masked(width, height)
        counts = pixels[:, :, 4] > 0
        assert np.abs(pixels[counts][:, :3] - 0.2).max() < 1e-6
        assert not pixels[~counts].any()
        share = [min(max(21 - 48 / width * x, 0) * width / 48, 1) for x in range(width)]
        assert counts[0].tolist() == [part >= 0.5 for part in share]
