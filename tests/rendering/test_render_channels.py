# SPDX-License-Identifier: Apache-2.0
"""Renderer.render_channels: the same bits whatever the memory, and the picture that render gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_same_bits

from clsplat.device.context import open_device
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
    with pytest.raises(ValueError, match="3 Gaussians to move to, expected 20000"):
        renderer.render_channels(*SCENE, ("motion",), moved=take(SCENE[0], slice(3)))
    still = renderer.render_channels(*SCENE, ("motion",))[1]
    assert not still["motion"].any()
    assert np.abs(found["motion"]).max() > 0.1
