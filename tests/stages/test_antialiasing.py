# SPDX-License-Identifier: Apache-2.0
"""The low-pass with compensated opacity: a closed form, and models with and without it by turns.

`scenes.ANTIALIASED` and cameras in test_project_rays.py and test_gradients_of_projections.py have it beside the twins.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scenes
from compare import assert_close

from clsplat.device.context import Device
from clsplat.rendering.renderer import Renderer


def test_a_small_ball_keeps_its_area(default_device: Device) -> None:
    """Closed form: the picture has 2 pi sigma^2 of a ball, times its opacity; without the filter it has the low-pass's
    too."""
    gaussians, camera = scenes.one()
    sigma, opacity = 0.5, 1 / (1 + np.exp(-4.0))  # pixels
    depth = float((gaussians.means @ camera.rotation.T + camera.translation)[0, 2])
    ball = replace(
        gaussians,
        log_scales=np.full((1, 3), np.log(sigma * depth / camera.fx), np.float32),
        opacity_logits=np.full(1, 4.0, np.float32),
    )
    square, renderer = replace(camera, fy=camera.fx), Renderer(default_device)
    areas = [renderer.render(replace(ball, antialiased=on), square).alpha.sum() for on in (True, False)]
    # 0.6 % is under 1/255 and not drawn; the grid of pixels makes 0.4 %; the ball is off the axis, and so no circle
    assert_close(areas[0], 2 * np.pi * sigma**2 * opacity, relative=0.05)
    assert_close(areas[1], 2 * np.pi * (sigma**2 + 0.3) * opacity, relative=0.05)


def test_a_renderer_takes_turns(default_device: Device) -> None:
    """Models with and without the filter, one after the other, in one renderer."""
    gaussians, camera = scenes.overlap()
    smooth, renderer = replace(gaussians, antialiased=True), Renderer(default_device)
    first, second, third = (renderer.render(model, camera).image for model in (gaussians, smooth, gaussians))
    assert np.array_equal(first, third)
    assert not np.array_equal(first, second)
    assert np.array_equal(second, Renderer(default_device).render(smooth, camera).image)
