# SPDX-License-Identifier: Apache-2.0
"""pose.cl against the float64 twin, and the twin against central differences of whole pictures."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from pipeline import BACKGROUND, Pipeline
from quick import quick
from scipy.spatial.transform import Rotation
from test_gradients_of_projections import CAMERAS, direction_of_loss, subject

from clsplat.camera import Camera
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.reference import every_pixel
from clsplat.reference.pose import pose_gradient as reference
from clsplat.selftest.harness import planes_of
from clsplat.stages.device_gaussians import allocate_gaussians
from clsplat.stages.pose import pose_rows, sum_of, sums_of

STEP = 1e-6
BAND = 3e-4


def posed(name: str, count: int) -> tuple[Gaussians, Camera]:
    """A scene with SH of degree 3 and a camera that is not at the origin."""
    gaussians, camera = scenes.overlap(count=count) if name == "perspective" else subject(name, count)
    rng = np.random.default_rng(8)
    gaussians.sh = rng.normal(0, 0.3, (len(gaussians), 16, 3)).astype(np.float32)
    return gaussians, camera.moved(np.array([0.02, -0.03, 0.01, 0.1, 0.05, -0.1]))


def of_model(gaussians: Gaussians, camera: Camera, d_image: np.ndarray) -> np.ndarray:
    """The twin's gradient by the pose."""
    by = every_pixel.render_grad(gaussians, camera, d_image, BACKGROUND).parameters
    model = scenes.in_float64(gaussians)
    return reference(model.means, model.quaternions, model.sh, camera, gaussians.sh_degree, by)


def on_device(pipeline: Pipeline, d_image: np.ndarray) -> np.ndarray:
    rasterizer, model, frame = pipeline.rasterizer, pipeline.gaussians, pipeline.frame
    gradients = allocate_gaussians(rasterizer.device, model.count, model.coefficients)
    for array in gradients.arrays.values():
        array.fill(np.nan)  # rows that are not seen are not read
    rasterizer.backward(model, frame, upload(rasterizer.device, planes_of(d_image)), gradients)
    sums, device = sums_of(rasterizer.work, model.count), rasterizer.device_of(pipeline.camera)
    sums.fill(np.nan)
    pose_rows(device, model, frame.camera_array, frame.projected.tile_counts, gradients, sums)
    return sum_of(device, rasterizer.work, sums).get()[0]


@pytest.mark.parametrize("name", quick(["perspective", *CAMERAS], "perspective", "bent fisheye"))
def test_the_twin_by_central_differences(name: str) -> None:
    gaussians, camera = posed(name, 40)
    model = scenes.in_float64(gaussians)
    d_image = direction_of_loss(model, camera, 2e-4)
    found = of_model(model, camera, d_image)

    def loss(motion: np.ndarray) -> float:
        return float((every_pixel.render(model, camera.moved(motion), BACKGROUND).image * d_image).sum())

    slopes = [(loss(axis) - loss(-axis)) / (2 * STEP) for axis in STEP * np.eye(6)]
    # of 12 digits that a loss of about 100 has, a step of 1e-6 leaves 6
    assert np.linalg.norm(found - slopes) <= 1e-5 * np.linalg.norm(found)


@pytest.mark.parametrize(
    "name", quick(["perspective", *CAMERAS], "perspective", "orthographic", "panorama", "bent fisheye")
)
def test_the_kernels_against_the_twin(shaped_device: Device, name: str) -> None:
    gaussians, camera = posed(name, 200)
    d_image = direction_of_loss(gaussians, camera, BAND)
    wanted = of_model(gaussians, camera, d_image)
    got = on_device(Pipeline.run(shaped_device, (gaussians, camera)), d_image)
    for part in (slice(3), slice(3, 6)):
        assert np.linalg.norm(got[part] - wanted[part]) <= 1e-4 * np.linalg.norm(wanted[part])


def test_a_motion_is_a_rotation_and_undoes_itself() -> None:
    camera = scenes.tilted_camera(40, 30)
    motion = np.array([0.3, -0.2, 0.5, 1.0, 2.0, -3.0])
    moved = camera.moved(motion)
    turned = Rotation.from_rotvec(motion[:3]).as_matrix()
    np.testing.assert_allclose(moved.rotation, camera.rotation @ turned, atol=1e-15)
    np.testing.assert_allclose(moved.position, camera.position - turned.T @ motion[3:], atol=1e-14)
    back = moved.moved(np.array([-0.3, 0.2, -0.5, 0, 0, 0])).moved(np.array([0, 0, 0, *-turned.T @ motion[3:]]))
    np.testing.assert_allclose(back.rotation, camera.rotation, atol=1e-15)
    np.testing.assert_allclose(back.position, camera.position, atol=1e-14)
    still = camera.moved(np.zeros(6))
    np.testing.assert_allclose(still.rotation, camera.rotation, atol=0)
