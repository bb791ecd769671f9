# SPDX-License-Identifier: Apache-2.0
"""`clsplat.render` called from Python: arrays and cameras that are none are refused by name, before they are read."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from calls import refuses

from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.rendering.renderer import Renderer


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("log_scales", np.zeros((10, 3), np.float32), r"log_scales is float32 \(10, 3\), expected float32 \(100, 3\)"),
        ("quaternions", np.ones((100, 3), np.float32), r"quaternions is float32 \(100, 3\), expected .* \(100, 4\)"),
        ("opacity_logits", np.zeros((100, 1), np.float32), r"opacity_logits .* \(100, 1\), expected .* \(100,\)"),
        ("sh", np.zeros((99, 1, 3), np.float32), r"sh is float32 \(99, 1, 3\), expected float32 \(100, 1, 3\)"),
        ("sh", np.zeros((100, 5, 3), np.float32), r"sh has shape \(100, 5, 3\), expected \(N, 1, 4, 9 or 16, 3\)"),
        ("means", np.zeros((100, 3)), r"means is float64 \(100, 3\), expected float32"),
        ("means", [[0.0, 0, 3]] * 100, "means is a list, expected a NumPy array"),
    ],
)
def test_arrays(default_device: Device, name: str, value: Any, message: str) -> None:
    gaussians, camera = scenes.random_cloud(100, 1, 20, 16, degree=0)
    setattr(gaussians, name, value)
    refuses(message, Renderer(default_device).render, gaussians, camera, error=ValueError)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "width is 0, expected a whole number of pixels"),
        ({"height": 1.5}, r"height is 1\.5, expected a whole number"),
        ({"fx": -50.0}, r"fx is -50\.0, expected a finite number over 0"),
        ({"cy": np.nan}, "cx, cy are .*nan, expected finite"),
        ({"rotation": np.full((3, 3), np.nan)}, "rotation has numbers that are not finite"),
        ({"rotation": np.eye(4)}, r"rotation is float64 \(4, 4\), expected numbers of shape \(3, 3\)"),
        ({"rotation": 2 * np.eye(3)}, "rotation is not a rotation matrix, its axes are 3 off"),
        ({"translation": np.array([0, np.inf, 0])}, "translation has numbers that are not finite"),
        ({"near": 5.0, "far": 1.0}, r"near is 5\.0 and far is 1\.0, expected 0 < near < far"),
        ({"projection": "wide"}, "projection is 'wide', expected one of perspective"),
    ],
)
def test_cameras(default_device: Device, changes: dict[str, Any], message: str) -> None:
    gaussians, camera = scenes.random_cloud(10, 1, 20, 16, degree=0)
    refuses(f"camera: {message}", Renderer(default_device).render, gaussians, replace(camera, **changes))
    with pytest.raises(InputError, match=f"camera: {message}"):
        Renderer(default_device).render_channels(gaussians, camera, after=replace(camera, **changes))
