# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from calls import python
from systems import posix

from clsplat.camera import Camera
from clsplat.scenes.dataset import Lens, colmap_camera_models, undistort

ZERO, EYE = np.zeros(3), np.eye(3)
WIDTH, HEIGHT = 96, 64
CORE = (80.0, 82.0, 47.0, 33.0)
LENSES = [
    Lens("SIMPLE_RADIAL", WIDTH, HEIGHT, (80.0, 47.0, 33.0, -0.1)),
    Lens("RADIAL", WIDTH, HEIGHT, (80.0, 47.0, 33.0, -0.1, 0.05)),
    Lens("OPENCV", WIDTH, HEIGHT, (*CORE, -0.1, 0.03, 0.004, -0.003)),
    Lens("FULL_OPENCV", WIDTH, HEIGHT, (*CORE, 0.1, -0.03, 0.002, 0.001, 0.02, 0.01, 0.0, 0.0)),
    Lens("OPENCV_FISHEYE", WIDTH, HEIGHT, (*CORE, 0.02, -0.01, 0.003, 0.0)),
    Lens("SIMPLE_RADIAL_FISHEYE", WIDTH, HEIGHT, (80.0, 47.0, 33.0, 0.02)),
    Lens("RADIAL_FISHEYE", WIDTH, HEIGHT, (80.0, 47.0, 33.0, 0.02, -0.01)),
    Lens("FOV", WIDTH, HEIGHT, (*CORE, 0.4)),
    Lens("THIN_PRISM_FISHEYE", WIDTH, HEIGHT, (*CORE, 0.02, -0.01, 0.001, 0.001, 0.0, 0.0, 0.001, -0.001)),
]


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    return np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture of the direction of view."""
    return np.stack([0.5 + 0.4 * np.sin(7 * x), 0.5 + 0.4 * np.cos(6 * y), 0.5 + 0.3 * np.sin(5 * x + 4 * y)], axis=-1)


def photograph(lens: Lens) -> np.ndarray:
    """What the lens sees of the pattern: its exact colour in the middle of each pixel."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    found = lens._camera().cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    return pattern(*found.T).reshape(lens.height, lens.width, 3).astype(np.float32)


def test_every_model_of_pycolmap_is_known() -> None:
    assert {"PINHOLE", "OPENCV", "FOV", "SIMPLE_DIVISION", "EUCM"} <= dict(colmap_camera_models().values()).keys()
    assert colmap_camera_models()[4] == ("OPENCV", 8)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_an_undistorted_picture_is_the_pinhole_view(lens: Lens) -> None:
    assert not lens.is_pinhole
    camera = lens.pinhole(EYE, ZERO)
    image = undistort(photograph(lens), lens, camera)
    assert image.shape == (camera.height, camera.width, 3)
    error = np.abs(image - pattern(*rays(camera)))
    # cubic interpolation of a pattern whose waves are 70 pixels long; half a pixel of shift would be 0.02
    assert error.max() < 4e-3
    assert error.mean() < 2e-4


@pytest.mark.parametrize("lens", LENSES[:4], ids=lambda lens: lens.model)
def test_no_pixel_is_blank(lens: Lens) -> None:
    camera = lens.pinhole(EYE, ZERO)
    x, y = rays(camera)
    pixels = lens.img_from_cam(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1))
    assert (pixels > -0.5).all()
    assert (pixels < [lens.width + 0.5, lens.height + 0.5]).all()


@pytest.mark.parametrize("scale", [0.3, 0.5, 0.9, 2])
def test_another_size_shows_the_same(scale: float) -> None:
    lens = LENSES[2]
    full = lens.pinhole(EYE, ZERO)
    camera = full.resized(round(full.width * scale), round(full.height * scale))
    error = np.abs(undistort(photograph(lens), lens, camera) - pattern(*rays(camera)))
    assert error.max() < 0.04  # a pixel's mean is not the colour of its middle
    assert error.mean() < 5e-3


def test_a_lens_of_the_picture_at_another_size() -> None:
    lens = LENSES[2]
    double = lens.resized(2 * WIDTH, 2 * HEIGHT)
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0]])
    np.testing.assert_allclose(double.img_from_cam(points), 2 * lens.img_from_cam(points), rtol=1e-12)
    one = LENSES[0].resized(2 * WIDTH, 2 * HEIGHT)
    np.testing.assert_allclose(one.img_from_cam(points), 2 * LENSES[0].img_from_cam(points), rtol=1e-12)


def test_without_distortion_nothing_changes() -> None:
    assert Lens("OPENCV", 9, 7, (8.0, 8.0, 4.0, 3.0, 0, 0, 0, 0)).is_pinhole
    assert not Lens("OPENCV_FISHEYE", 9, 7, (8.0, 8.0, 4.0, 3.0, 0, 0, 0, 0)).is_pinhole
    lens = Lens("PINHOLE", WIDTH, HEIGHT, CORE)
    image = np.random.default_rng(0).random((HEIGHT, WIDTH, 3), np.float32)
    np.testing.assert_allclose(undistort(image, lens, lens.pinhole(EYE, ZERO)), image, atol=1e-5)


def test_alpha_is_resampled_premultiplied() -> None:
    lens = LENSES[2]
    image = np.zeros((HEIGHT, WIDTH, 4), np.float32)
    image[:, : WIDTH // 2] = [0.8, 0.4, 0.2, 1]
    image[:, WIDTH // 2 :] = [0, 1, 1, 0]  # transparent cyan must not bleed in
    result = undistort(image, lens, lens.pinhole(EYE, ZERO))
    seen = result[:, :, 3] > 0.01
    np.testing.assert_allclose(result[seen][:, :3], np.broadcast_to([0.8, 0.4, 0.2], (seen.sum(), 3)), atol=1e-3)


def test_colours_stay_within_those_of_the_picture() -> None:
    lens = LENSES[2]
    image = (np.indices((HEIGHT, WIDTH)).sum(axis=0) % 7 < 3)[:, :, None].repeat(3, axis=2).astype(np.float32)
    result = undistort(image, lens, lens.pinhole(EYE, ZERO))
    assert result.min() >= 0
    assert result.max() <= 1


def test_a_fisheye_beyond_180_degrees_is_cut_to_a_pinhole() -> None:
    lens = Lens("OPENCV_FISHEYE", WIDTH, HEIGHT, (25.0, 25.0, 48.0, 32.0, 0, 0, 0, 0))
    camera = lens.pinhole(EYE, ZERO)
    image = undistort(photograph(lens), lens, camera)
    assert np.isfinite(image).all()
    middle = np.s_[camera.height // 4 : -camera.height // 4, camera.width // 4 : -camera.width // 4]
    assert np.abs(image - pattern(*rays(camera)))[middle].mean() < 0.02


@posix
def test_reading_cameras_leaves_the_handler_of_sigterm() -> None:
    """pycolmap puts one there that prints its stack, which a job that is stopped while it begins would show."""
    code = """
import os, signal
signal.signal(signal.SIGTERM, lambda *_: print("taken"))
import clsplat.scenes.dataset
os.kill(os.getpid(), signal.SIGTERM)
"""
    done = python("-c", code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "taken\n", "")
