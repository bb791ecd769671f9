# SPDX-License-Identifier: Apache-2.0
"""Renderer.render_channels: the same bits whatever the memory, and the picture that render gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from quick import quick

from clsplat.camera import PROJECTIONS, Projection
from clsplat.device.selection import open_device
from clsplat.errors import InputError
from clsplat.models.edit import take
from clsplat.rendering.renderer import ChannelResult, Renderer, RenderResult

SCENE = scenes.random_cloud(20_000, 4, 300, 200, degree=1)
EVERYTHING = ("normal", "position", "motion")


def drawn(limit: int | None) -> tuple[RenderResult, ChannelResult, Renderer]:
    renderer = Renderer(open_device(None, limit))
    gaussians, camera = SCENE
    after = replace(camera, translation=camera.translation + np.array([0.02, 0.0, 0.0]))
    moved = replace(gaussians, means=gaussians.means[:, [1, 0, 2]])
    image, found = renderer.render_channels(gaussians, camera, EVERYTHING, after=after, moved=moved)
    return image, found, renderer


def arrays(image: RenderResult, found: ChannelResult) -> dict[str, np.ndarray]:
    return {"image": image.image, "alpha": image.alpha, **found}


def test_in_little_memory() -> None:
    image, found, _ = drawn(None)
    whole = arrays(image, found)
    assert set(found) == {"depth", "median", "first", "count", "index", *EVERYTHING}
    assert (whole["count"] > 1).mean() > 0.5
    limit = (8 << 20) + (1 << 18)  # with the means that motion goes to
    image, found, renderer = drawn(limit)
    assert renderer.device.memory.peak <= limit
    for name, values in arrays(image, found).items():
        assert_same_bits(values, whole[name])


def test_the_picture_is_that_of_render() -> None:
    image, found, renderer = drawn(None)
    plain = renderer.render(*SCENE)
    assert_same_bits(image.image, plain.image)
    assert_same_bits(image.alpha, plain.alpha)
    with pytest.raises(ValueError, match="3 moved Gaussians, expected 20000"):
        renderer.render_channels(*SCENE, ("motion",), moved=take(SCENE[0], slice(3)))
    still = renderer.render_channels(*SCENE, ("motion",))[1]
    assert not still["motion"].any()
    assert np.abs(found["motion"]).max() > 0.1


@pytest.mark.parametrize("projection", quick(PROJECTIONS, "perspective", "fisheye"))
def test_backward_motion_is_forward_motion_of_the_frame_before(projection: Projection) -> None:
    """Of one Gaussian all pixels have the same motion, so that it does not matter which of them a frame shows."""
    gaussians, camera = scenes.one()
    focals = {"equirectangular": camera.width / (2 * np.pi), "orthographic": 0.3 * camera.width}
    focal = focals.get(projection, camera.fx)
    first = replace(camera, fx=focal, fy=focal, projection=projection)
    second = first.moved(np.array([0.01, -0.02, 0.015, 0.05, -0.03, 0.1]))
    renderer = Renderer(open_device())
    there, back = (
        renderer.render_channels(gaussians, view, (name,), **{way: other})[1]
        for view, name, way, other in ((first, "motion", "after", second), (second, "backward", "before", first))
    )
    forward = there["motion"][there["count"] > 0][0]
    backward = back["backward"][back["count"] > 0][0]
    assert np.abs(forward).max() > 0.1  # a panorama has few pixels a radian
    # a pixel's place has about 1e-5 of rounding, of each of the two
    np.testing.assert_allclose(backward, -forward, atol=1e-4)


def test_backward_motion_of_another_projection_is_refused() -> None:
    gaussians, camera = scenes.one()
    other = replace(camera, projection="orthographic")
    with pytest.raises(InputError, match="backward: the other frame's camera is orthographic, expected perspective"):
        Renderer(open_device()).render_channels(gaussians, camera, ("backward",), before=other)
