# SPDX-License-Identifier: Apache-2.0
"""Points that are clicked in the viewer, and the flags that their distance gives."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from calls import refuses
from scenes import make_gaussians
from tiny import cameras

from clsplat.config.orientation import parse_scale
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.scenes.orientation.known_length import metres_per_unit
from clsplat.viewer.appearance import Look
from clsplat.viewer.measure import Measurement, point_at
from clsplat.viewer.models import HeldModel

CAMERA = cameras()[3]


def test_a_click_hits_the_model(default_device: Device) -> None:
    """Two small opaque Gaussians: their distance, from clicks on their pixels, to a pixel's width at their depth."""
    means = np.array([(0.5, 0.2, 0.3), (-0.6, -0.3, 0.1)])
    gaussians = make_gaussians(
        means, np.tile((1.0, 0, 0, 0), (2, 1)), np.full((2, 3), math.log(0.1)), np.full(2, 0.98), np.zeros((2, 1, 3))
    )
    model = HeldModel(gaussians, default_device, RasterizerConfig(), (0, 0, 0))
    depth, alpha = model.depths(CAMERA, Look())
    found = []
    for mean in means:
        x, y, z = CAMERA.rotation @ mean + CAMERA.translation
        place = (CAMERA.fx * x / z + CAMERA.cx) / CAMERA.width, (CAMERA.fy * y / z + CAMERA.cy) / CAMERA.height
        found.append(point_at(CAMERA, depth, alpha, place))
        np.testing.assert_allclose(found[-1], mean, atol=1e-5)
    measurement = Measurement()
    assert measurement.text(0) == "Click on a point."
    measurement.add(found[0])
    assert measurement.text(0) == "Click on a second point."
    measurement.add(found[1])
    apart = float(np.linalg.norm(means[0] - means[1]))
    assert measurement.distance == pytest.approx(apart, rel=1e-4)
    assert "Enter its length" in measurement.text(0)
    text = measurement.text(1.25)
    match = re.search(r"--scale=(\S+)", text)
    assert match is not None
    rule = parse_scale(match.group(1))
    assert rule is not None
    assert metres_per_unit(rule, {}) == pytest.approx(1.25 / apart, rel=1e-4)
    assert f"--scale {1.25 / apart:.4f}"[:-2] in text  # for clsplat convert
    measurement.add(found[0])  # a third click begins anew
    assert measurement.distance is None


@pytest.mark.parametrize("place", [(0.0, 0.0), (1.0, 1.0), (-0.1, 0.5), (0.5, 1.1), (math.nan, 0.5)])
def test_a_click_beside_the_model_is_told(place: tuple[float, float]) -> None:
    shape = (CAMERA.height, CAMERA.width)
    depth, alpha = np.full(shape, 3.0, np.float32), np.zeros(shape, np.float32)
    refuses("nothing is there|outside the picture", point_at, CAMERA, depth, alpha, place)
    refuses("nothing is there|outside", point_at, CAMERA, 0 * depth, alpha + 1, place)


def test_a_flag_far_from_the_origin_keeps_the_distance() -> None:
    measurement = Measurement()
    for point in ((4_500_000.25, -3.0, 700_000.5), (4_500_000.75, -3.0, 700_000.5)):
        measurement.add(np.array(point))
    match = re.search(r"--scale=(\S+)", measurement.text(2.0))
    assert match is not None
    rule = parse_scale(match.group(1))
    assert rule is not None
    assert np.linalg.norm(np.subtract(rule.ends[:3], rule.ends[3:])) == pytest.approx(0.5, rel=1e-4)


def test_two_clicks_on_one_point_give_no_flag() -> None:
    measurement = Measurement()
    for _ in range(2):
        measurement.add(np.ones(3))
    assert "--scale" not in measurement.text(2.0)
    for metres in (-1.0, math.nan, math.inf, 1e9):
        assert "--scale" not in measurement.text(metres)
