# SPDX-License-Identifier: Apache-2.0
"""Thinning of a step's model: which Gaussians are left out, the gradient of the rest, and the same bytes again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calls import refuses
from compare import assert_close_gradients
from numpy.typing import NDArray
from pipeline import Pipeline
from quick import quick
from scenes import random_cloud
from tiny import short

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.optimisation.dropout import Thinning, thinning_of
from clsplat.reference.dropout import factors, logit_grad, thinned_logits
from clsplat.reference.render import forward, render_grad
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import upload_gaussians

CONFIG = replace(short(iterations=40), thinning=0.5)
THINNING = Thinning(0.3, (0x12345678, 0x9ABCDEF0))


def cloud() -> tuple[Gaussians, Camera]:
    """Gaussians that stay under 1 when the rest are left out, for which the twin has a logit."""
    model, camera = random_cloud(300, 3, 64, 48)
    return replace(model, opacity_logits=np.minimum(model.opacity_logits, np.float32(0.5))), camera


def thinned(model: Gaussians, thinning: Thinning) -> Gaussians:
    logits = thinned_logits(model.opacity_logits.astype(np.float64), factors(thinning, len(model)))
    return replace(model, opacity_logits=logits.astype(np.float32))


def test_the_share_rises_and_the_steps_differ() -> None:
    rates = [thinning_of(CONFIG, step) for step in (1, 20, 40)]
    assert [one and one.rate for one in rates] == [0.5 / 40, 0.25, 0.5]
    assert thinning_of(replace(CONFIG, thinning=0.0), 20) is None
    assert thinning_of(replace(CONFIG, batch=2), 20) == Thinning(0.5, rates[1].key if rates[1] else (0, 0))
    kept = [factors(one, 100_000) > 0 for one in rates if one]
    assert kept[1].mean() == pytest.approx(0.75, abs=0.006)
    both = kept[1] & kept[2]
    assert both.mean() == pytest.approx(0.375, abs=0.007), "drawn apart"


@pytest.mark.parametrize("first_row", [0, 77])
def test_twin_words_go_by_the_row_of_the_model(first_row: int) -> None:
    np.testing.assert_array_equal(
        factors(THINNING, 200, first_row), factors(THINNING, 300)[first_row : first_row + 200]
    )


def test_the_twin_s_slopes() -> None:
    logits, step = np.linspace(-5, 0.5, 9), 1e-6
    by = factors(THINNING, 9)
    up, down = thinned_logits(logits + step, by), thinned_logits(logits - step, by)
    np.testing.assert_allclose(logit_grad(logits, by, np.ones(9)), (up - down) / (2 * step), rtol=1e-6, atol=1e-12)


def gradients_of(
    device: Device, model: Gaussians, camera: Camera, d_image: Float64, thinning: Thinning | None
) -> tuple[Float32, NDArray[np.uint32], Gaussians]:
    """The kernels' image (H, W, 3), counts of tiles and gradients."""
    rasterizer, held = Rasterizer(device), upload_gaussians(device, model)
    frame = rasterizer.forward(held, camera, np.zeros(3, np.float32), thinning=thinning)
    run = Pipeline(rasterizer, held, camera, frame)
    return run.image, frame.projected.tile_counts.get(), run.backward(d_image)[0]


@pytest.mark.parametrize("projection", quick(["perspective", "orthographic", "fisheye"], "perspective"))
def test_frame_and_gradient_are_those_of_thinned_opacities(shaped_device: Device, projection: str) -> None:
    """The twin's in perspective; where it draws nothing else, those of the kernels without thinning."""
    model, camera = cloud()
    if projection != "perspective":
        camera = replace(camera, projection=projection)
    by, wanted = factors(THINNING, len(model)), thinned(model, THINNING)
    d_image, steady = np.random.default_rng(5).standard_normal((camera.height, camera.width, 3)), np.array(True)
    if projection == "perspective":
        blended = forward(wanted, camera).blended
        steady, picture = blended.margin > 1e-4, blended.image
        d_image[~steady] = 0
        gradients = render_grad(wanted, camera, d_image).parameters
    else:
        picture, _, found = gradients_of(shaped_device, wanted, camera, d_image, None)
        gradients = {name: values.astype(np.float64) for name, values in found.arrays().items()}
    image, tiles, got = gradients_of(shaped_device, model, camera, d_image, THINNING)
    assert not tiles[by == 0].any() and tiles.any()
    assert np.abs(image - picture)[np.broadcast_to(steady, image.shape[:2])].max() < 1e-4
    gradients["opacity_logits"] = logit_grad(model.opacity_logits.astype(np.float64), by, gradients["opacity_logits"])
    assert_close_gradients(got.arrays(), gradients, 1e-4)


@pytest.mark.parametrize("rate", [-0.1, 0.95])
def test_a_share_that_makes_no_sense(rate: float) -> None:
    refuses(f"--thinning {rate}: expected 0 to 0.9", TrainConfig(thinning=rate).check)
