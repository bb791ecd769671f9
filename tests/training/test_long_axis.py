# SPDX-License-Identifier: Apache-2.0
"""Splits along the longest axis: the formulas, and that they repeat to the last byte."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import run_steps, short, trained_to

from clsplat.device.context import Device
from clsplat.scenes.scene import Scene
from clsplat.training.density.adaptive import long_halves

CONFIG = short(iterations=48, density={"growth": "budget", "max_gaussians": 120, "long_axis": True})


def test_halves_lie_on_the_longest_axis() -> None:
    quaternion, scales = np.array([2.0, 0.6, -0.9, 1.4]), np.array([0.1, 0.5, 0.02])
    split = {
        "means": np.array([[3.0, -2.0, 1.0]], np.float32),
        "quaternions": quaternion[None].astype(np.float32),
        "log_scales": np.log(scales)[None].astype(np.float32),
        "opacity_logits": np.log(np.array([0.8 / 0.2], np.float32)),
    }
    first, second = (long_halves(split, later) for later in (False, True))
    halves = {name: np.concatenate([values, second[name]]) for name, values in first.items()}
    axis = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()[:, 1]
    offsets = halves["means"] - split["means"]
    np.testing.assert_allclose(offsets, 1.35 * 0.5 * np.stack([axis, -axis]), atol=1e-6)
    np.testing.assert_allclose(np.exp(halves["log_scales"]), np.tile(scales * [0.893, 0.55, 0.893], (2, 1)), rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-halves["opacity_logits"])), 0.48, rtol=1e-6)
    assert all(array.dtype == np.float32 for array in halves.values())


@pytest.mark.parametrize("logit", [-100.0, 100.0])
def test_extreme_opacities_stay_finite(logit: float) -> None:
    split = {
        name: np.zeros((1, size), np.float32) for name, size in (("means", 3), ("quaternions", 4), ("log_scales", 3))
    }
    halves = long_halves(split | {"opacity_logits": np.array([logit], np.float32)}, second=False)
    assert all(np.isfinite(array).all() for array in halves.values())
    assert halves["opacity_logits"][0] == pytest.approx(np.log(0.6) + logit if logit < 0 else np.log(1.5), rel=1e-6)


def test_it_grows_by_splits_alone(scene: Scene, default_device: Device) -> None:
    trainer = trained_to(16, scene, CONFIG, default_device)
    before = trainer.parameters.count
    run_steps(20, trainer)
    assert trainer.parameters.count > before
