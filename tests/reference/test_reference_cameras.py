# SPDX-License-Identifier: Apache-2.0
"""Every projection: there and back, closed forms, seams and edges."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera, Projection, focal_length
from clsplat.reference.cameras import cam_from_pixel, pixel_from_cam, pixel_from_world, pixel_grid

ROTATION = Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix()
TRANSLATION = np.array([0.4, -2.0, 1.5])


def camera(projection: Projection, width: int = 36, height: int = 18) -> Camera:
    """Off-centre, with pixels that are not square, but for a panorama, which is whole."""
    fx, fy, cx, cy = {
        "perspective": (30.0, 27.0, 15.0, 11.0),
        "orthographic": (8.0, 9.0, 15.0, 11.0),
        "fisheye": (7.0, 6.0, 17.0, 8.5),
        "equirectangular": (width / (2 * np.pi), height / np.pi, width / 2, height / 2),
    }[projection]
    return Camera(width, height, fx, fy, cx, cy, ROTATION, TRANSLATION, projection=projection)


@pytest.mark.parametrize("projection", get_args(Projection))
def test_pixel_to_ray_to_pixel(projection: Projection) -> None:
    view = camera(projection)
    pixels = np.concatenate([pixel_grid(view), np.random.default_rng(0).uniform(0, 1, (200, 2)) * [36, 18]])
    origins, directions = cam_from_pixel(view, pixels)
    origins, directions = (origins - view.translation) @ view.rotation, directions @ view.rotation
    assert np.isfinite(directions).all()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-14)
    for distance in (0.02, 3.0, 1000.0):
        back, depths = pixel_from_world(view, origins + distance * directions)
        # 1e-9 px: coordinates of some 1000 units, times some 30 px a unit, in float64 (2e-16)
        np.testing.assert_allclose(back, pixels, atol=1e-9)
        if projection in {"fisheye", "equirectangular"}:
            np.testing.assert_allclose(depths, distance, rtol=1e-9)
        else:
            along = directions @ ROTATION[2]
            np.testing.assert_allclose(depths, distance * along, rtol=1e-9)


@pytest.mark.parametrize("projection", get_args(Projection))
def test_the_same_view_at_another_size(projection: Projection) -> None:
    view = camera(projection)
    larger = view.resized(108, 36)
    points = np.random.default_rng(1).normal(size=(50, 3)) * 2 + view.position + 3 * ROTATION[2]
    small, _ = pixel_from_world(view, points)
    large, _ = pixel_from_world(larger, points)
    np.testing.assert_allclose(large, small * [3, 2], atol=1e-9)


def straight(projection: Projection, **values: float) -> Camera:
    plain = Camera(200, 100, 50.0, 50.0, 100.0, 50.0, np.eye(3), np.zeros(3), projection=projection)
    return replace(plain, **values)


def test_perspective_closed_forms() -> None:
    view = straight("perspective", fx=focal_length(math.pi / 2, 200))
    pixels, depths = pixel_from_cam(view, np.array([[1.0, 0, 1], [-2, 0, 2], [0, 3, 3], [0, 0, 0], [1, 1, -1]]))
    np.testing.assert_allclose(pixels[:3], [[200, 50], [0, 50], [100, 100]], atol=1e-12)
    assert np.isnan(pixels[3:]).all()
    np.testing.assert_array_equal(depths, [1, 2, 3, 0, -1])


def test_orthographic_scale_is_world_units_a_pixel() -> None:
    view = straight("orthographic", fx=4.0, fy=4.0)  # a quarter of a unit a pixel
    near, _ = pixel_from_cam(view, np.array([[1.0, -2.0, 0.5], [1.0, -2.0, 500.0], [1.0, -2.0, -1.0]]))
    np.testing.assert_allclose(near[:2], [[104, 42], [104, 42]])
    assert np.isnan(near[2]).all()
    origins, directions = cam_from_pixel(view, np.array([[100.5, 50.5], [101.5, 50.5]]))
    np.testing.assert_allclose(origins[1] - origins[0], [0.25, 0, 0])
    np.testing.assert_array_equal(directions, [[0, 0, 1], [0, 0, 1]])


def test_fisheye_is_equidistant_to_straight_behind() -> None:
    view = straight("fisheye", fx=30.0, fy=30.0)
    for degrees in (0.0, 1e-7, 30.0, 90.0, 120.0, 179.0):
        angle = math.radians(degrees)
        point = 5 * np.array([[math.sin(angle), 0, math.cos(angle)], [0, -math.sin(angle), math.cos(angle)]])
        pixels, depths = pixel_from_cam(view, point)
        np.testing.assert_allclose(pixels, [[100 + 30 * angle, 50], [100, 50 - 30 * angle]], atol=1e-9)
        np.testing.assert_allclose(depths, 5, rtol=1e-14)
    behind, _ = pixel_from_cam(view, np.array([[0.0, 0, -1]]))
    assert np.isnan(behind).all()


def test_beyond_the_circle_of_half_a_turn_there_is_no_ray() -> None:
    view = straight("fisheye", fx=20.0, fy=20.0)
    _, directions = cam_from_pixel(view, np.array([[100 + 20 * 3.14, 50], [100 + 20 * 3.15, 50], [0.5, 0.5]]))
    assert np.isfinite(directions[0]).all()
    assert directions[0] @ [0, 0, -1] > 0.999
    assert np.isnan(directions[1:]).all()


def test_a_fisheye_of_220_degrees_fills_its_width() -> None:
    view = straight("fisheye", fx=focal_length(math.radians(220), 200, "fisheye"))
    _, edge = cam_from_pixel(view, np.array([[0.0, 50.0], [200.0, 50.0]]))
    np.testing.assert_allclose(np.degrees(np.arccos(edge[:, 2])), 110, rtol=1e-12)


def test_equirectangular_closed_forms() -> None:
    view = straight("equirectangular", fx=200 / (2 * np.pi), fy=100 / np.pi)
    up, down, ahead, right, left = [0, -1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0], [-1, 0, 0]
    pixels, depths = pixel_from_cam(view, 7.0 * np.array([ahead, right, left, up, down]))
    np.testing.assert_allclose(pixels[:3], [[100, 50], [150, 50], [50, 50]], atol=1e-12)
    np.testing.assert_allclose(pixels[3:, 1], [0, 100], atol=1e-12)
    np.testing.assert_allclose(depths, 7)
    assert np.isnan(pixel_from_cam(view, np.zeros((1, 3)))[0][0, 0])
    _, beyond = cam_from_pixel(view, np.array([[100.0, -0.5], [100.0, 100.5]]))
    assert np.isnan(beyond).all()


@pytest.mark.parametrize("cx", [100.0, 0.0, 130.0, -400.0])
def test_equirectangular_wraps_at_the_seam(cx: float) -> None:
    view = straight("equirectangular", fx=200 / (2 * np.pi), fy=100 / np.pi, cx=cx)
    assert view.model.turn(view) == pytest.approx(200)
    pixels = pixel_grid(view)
    back, _ = pixel_from_cam(view, cam_from_pixel(view, pixels)[1])
    np.testing.assert_allclose(back, pixels, atol=1e-9)
    longitudes = np.linspace(-np.pi, np.pi, 1001)
    u = pixel_from_cam(view, np.stack([np.sin(longitudes), 0 * longitudes, np.cos(longitudes)], axis=1))[0][:, 0]
    assert (u >= 0).all()
    assert (u < 200).all()
    # one whole turn to the right is the same direction
    _, once = cam_from_pixel(view, np.array([[30.0, 40.0]]))
    _, again = cam_from_pixel(view, np.array([[230.0, 40.0]]))
    np.testing.assert_allclose(once, again, atol=1e-14)


def test_a_cut_of_a_panorama_keeps_what_is_just_beyond_its_edges() -> None:
    view = straight("equirectangular", width=20, fx=200 / (2 * np.pi), fy=100 / np.pi, cx=10.0)
    angle = 2 * np.pi * 12 / 200
    u = pixel_from_cam(view, np.array([[math.sin(angle), 0, math.cos(angle)], [-math.sin(angle), 0, math.cos(angle)]]))
    np.testing.assert_allclose(u[0][:, 0], [22, -2], atol=1e-12)


def test_focal_lengths_of_angles_of_view() -> None:
    assert focal_length(math.pi / 2, 100) == pytest.approx(50)
    assert focal_length(math.radians(60), 100) == pytest.approx(50 * math.sqrt(3))
    assert focal_length(math.pi, 100, "fisheye") == pytest.approx(100 / math.pi)
    assert focal_length(2 * math.pi, 100, "equirectangular") == pytest.approx(100 / (2 * math.pi))
    for fov, projection in ((0, "perspective"), (math.pi, "perspective"), (7, "fisheye"), (1, "orthographic")):
        with pytest.raises(ValueError, match="angle of view"):
            focal_length(fov, 100, projection)  # type: ignore[arg-type]
