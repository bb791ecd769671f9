# SPDX-License-Identifier: Apache-2.0
"""The far plane: Gaussians whose depth is beyond it are not drawn, by the kernels and by their float64 twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_same_bits

from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.models.edit import take
from clsplat.reference import every_pixel
from clsplat.rendering.renderer import Renderer

CLOUD, STRAIGHT = scenes.random_cloud(60, 8, 48, 32)
KINDS = {
    "perspective": {},
    "perspective along rays": {"by_rays": True},
    "orthographic": {"projection": "orthographic", "fx": 8.0, "fy": 8.0},
    "equirectangular": {"projection": "equirectangular", "fx": 48 / (2 * np.pi), "fy": 32 / np.pi},
    "fisheye": {"projection": "fisheye"},
}


def camera_of(kind: str) -> Camera:
    return replace(STRAIGHT, **KINDS[kind])


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if " " in kind or "equi" in kind else ()) for kind in KINDS]
)
def test_what_is_beyond_it_is_left_out(default_device: Device, kind: str) -> None:
    camera, renderer = camera_of(kind), Renderer(default_device)
    gaussians = replace(CLOUD, by_rays=camera.by_rays)
    local = gaussians.means.astype(np.float64) @ camera.rotation.T + camera.translation
    depths = local[:, 2] if camera.model.flat else np.linalg.norm(local, axis=1)
    seen = np.sort(depths[depths > camera.near])
    far = float(seen[len(seen) // 2 - 1 : len(seen) // 2 + 1].mean())  # between two of them
    cut = replace(camera, far=far)
    kept = take(gaussians, depths < far)
    assert 0 < len(kept) < len(gaussians)
    got, wanted, whole = (
        renderer.render(model, one) for model, one in ((gaussians, cut), (kept, camera), (gaussians, camera))
    )
    assert_same_bits(got.image, wanted.image)
    assert_same_bits(got.alpha, wanted.alpha)
    assert np.abs(whole.alpha - got.alpha).max() > 0.1
    twin, of_kept = every_pixel.render(gaussians, cut), every_pixel.render(kept, camera)
    np.testing.assert_array_equal(twin.image, of_kept.image)


@pytest.mark.parametrize("kind", ["perspective", pytest.param("fisheye", marks=pytest.mark.slow)])
def test_without_one_no_bit_is_another(default_device: Device, kind: str) -> None:
    """Of a plane beyond what float32 has, too."""
    camera, renderer = camera_of(kind), Renderer(default_device)
    plain = renderer.render(CLOUD, camera)
    for far in (1e6, 1e39):
        assert_same_bits(renderer.render(CLOUD, replace(camera, far=far)).image, plain.image)
