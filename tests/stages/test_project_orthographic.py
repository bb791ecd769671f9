# SPDX-License-Identifier: Apache-2.0
"""Orthographic pictures against a float64 twin that has every Gaussian at every pixel, and against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_same_arrays, assert_same_bits
from pipeline import BACKGROUND
from test_project_rays import FEATURES, assert_as_the_twin

from clsplat.camera import Camera
from clsplat.config.rasterizer import BenchSwitches
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import InputError
from clsplat.frame.draw import on_tiles
from clsplat.reference import every_pixel
from clsplat.reference import render as reference
from clsplat.reference.cameras import pixel_from_world
from clsplat.reference.project import rotation_matrices
from clsplat.rendering.renderer import Renderer


def moved(camera: Camera) -> Camera:
    """A step, a turn of a degree and more pixels a unit."""
    turn = np.array([[np.cos(0.02), 0.0, np.sin(0.02)], [0.0, 1.0, 0.0], [-np.sin(0.02), 0.0, np.cos(0.02)]])
    step = np.array([-0.07, 0.03, -0.05])
    return replace(
        camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation + step, fx=1.02 * camera.fx
    )


SCENES = {
    "one": scenes.one,
    "overlap": scenes.overlap,
    "saturating": scenes.saturating,
    "off_frustum": scenes.off_frustum,
    "needles": scenes.needles,
    "equal_depth": scenes.equal_depth,
    "cloud": lambda: scenes.random_cloud(600, 8, 70, 50),
}


@pytest.mark.parametrize("name", SCENES)
def test_against_the_twin(device: Device, name: str) -> None:
    gaussians, camera = scene = scenes.orthographic(SCENES[name]())
    wanted = every_pixel.render(gaussians, camera, BACKGROUND, moved(camera))
    assert (wanted.margin < 3e-4).mean() < 0.1
    assert_as_the_twin(device, scene, moved(camera), wanted)


def test_the_twin_is_the_definition_of_the_projection() -> None:
    # The mean goes where pixel_from_world has it, and the covariance there is the world's through its derivative, of
    # which central differences are exact, as it is linear.
    gaussians, camera = scenes.orthographic(scenes.overlap())
    arrays = reference.parameters(gaussians)
    means = arrays["means"]
    projected = reference.forward(gaussians, camera).projected
    pixels, depths = pixel_from_world(camera, means)
    np.testing.assert_allclose(projected.means2d, pixels, atol=1e-12)
    np.testing.assert_allclose(projected.depths, depths, atol=1e-12)
    steps = [pixel_from_world(camera, means + d)[0] - pixel_from_world(camera, means - d)[0] for d in 0.5 * np.eye(3)]
    jacobian = np.stack(steps, axis=2)
    axes = rotation_matrices(arrays["quaternions"]) * np.exp(arrays["log_scales"])[:, None, :]
    covariance = jacobian @ axes @ axes.transpose(0, 2, 1) @ jacobian.transpose(0, 2, 1) + 0.3 * np.eye(2)
    wanted = np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], axis=1)
    np.testing.assert_allclose(projected.covariances, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"frustum_cull": False}, {"tile_test": "square"}])
def test_exact_switches_change_no_bit(default_device: Device, change: dict[str, bool]) -> None:
    gaussians, camera = scenes.orthographic(scenes.off_frustum())
    plain = Renderer(default_device).render(gaussians, camera, BACKGROUND)
    other = Renderer(default_device, config=BenchSwitches(**change)).render(gaussians, camera, BACKGROUND)  # type: ignore[arg-type]
    assert_same_bits(other.image, plain.image)
    assert_same_bits(other.alpha, plain.alpha)


def test_what_is_deeper_is_as_large_and_has_the_same_colour(device: Device) -> None:
    # A disc at 2 and at 200 units, of SH that depends on the direction: the same picture.
    rng = np.random.default_rng(3)
    sh = scenes.random_sh(rng, 1)
    camera = replace(scenes.straight_camera(48, 32, 10.0), projection="orthographic")
    pictures = []
    for depth in (2.0, 200.0):
        gaussians = scenes.make_gaussians(
            np.array([[0.75, -0.5, depth]]), np.array([[1.0, 0, 0, 0]]), np.log([[0.5, 0.25, 0.5]]), np.array([0.8]), sh
        )
        pictures.append(Renderer(device).render(gaussians, camera))
    assert_same_bits(pictures[1].image, pictures[0].image)
    assert_same_bits(pictures[1].alpha, pictures[0].alpha)
    # By hand: ten pixels a unit, variances 5^2 + 0.3 and 2.5^2 + 0.3. Rounded a few times: 1e-6.
    x, y = np.meshgrid(np.arange(48) + 0.5 - (24 + 7.5), np.arange(32) + 0.5 - (16 - 5.0))
    alpha = 0.8 * np.exp(-0.5 * (x * x / 25.3 + y * y / 6.55))
    assert_close(pictures[0].alpha, np.where(alpha >= 1 / 255, alpha, 0), absolute=1e-6)


def test_the_near_plane(device: Device) -> None:
    gaussians, camera = scenes.orthographic(scenes.one())
    renderer = Renderer(device)
    assert renderer.render(gaussians, replace(camera, near=3.99)).alpha.any()
    assert not renderer.render(gaussians, replace(camera, near=4.0)).alpha.any()
    behind = replace(camera, translation=np.array([0.0, 0.0, -5.0]))
    assert not renderer.render(gaussians, replace(behind, near=0.01)).alpha.any()
    with pytest.raises(InputError, match="near is -10"):  # nothing is behind a camera: depths are sorted as they are
        renderer.render(gaussians, replace(behind, near=-10.0))


def test_a_wall(device: Device) -> None:
    # One flat Gaussian, tilted 45 degrees about x: its normal looks back along the view, also far off the axis, where
    # a pinhole would see the other side; and what it moves by is the step in pixels, whatever its depth.
    half = np.sqrt(0.5)
    gaussians = scenes.make_gaussians(
        np.array([[0.0, 30.0, 2.0]]),
        np.array([[np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0]]),
        np.log([[3.0, 3.0, 1e-3]]),
        np.array([0.9]),
        np.zeros((1, 1, 3)),
    )
    camera = replace(scenes.straight_camera(20, 12, 2.0), cy=6 - 60.0, projection="orthographic")
    after = replace(camera, translation=np.array([0.25, 0.5, 1.0]))
    for view, sign in ((camera, 1.0), (replace(camera, cy=6 - 30.0, projection="perspective"), -1.0)):
        found = Renderer(device).render_channels(gaussians, view, ("normal",))[1]
        assert_close(found["normal"][6, 10], [0.0, sign * half, -sign * half], absolute=1e-6)
    found = Renderer(device).render_channels(gaussians, camera, FEATURES, after=after)[1]
    assert_close(found["depth"][6, 10], 2.0, relative=1e-6)
    assert_close(found["position"][6, 10], [0.0, 30.0, 2.0], relative=1e-6)
    assert_close(found["motion"][6, 10], [0.5, 1.0], absolute=1e-5)


def test_windows_and_little_memory_change_no_bit() -> None:
    gaussians, camera = scenes.orthographic(scenes.random_cloud(20_000, 4, 300, 200, degree=1))

    def drawn(device: Device, view: Camera, after: Camera) -> dict[str, np.ndarray]:
        image, found = Renderer(device).render_channels(gaussians, view, FEATURES, after=after, background=BACKGROUND)
        return {"image": image.image, "alpha": image.alpha, **found}

    whole = drawn(open_device(), camera, moved(camera))
    part, rows, columns = on_tiles(camera.cropped(37, 21, 100, 60))
    after = replace(moved(camera), width=part.width, height=part.height, window=part.window)
    got = {
        name: np.ascontiguousarray(plane[rows, columns]) for name, plane in drawn(open_device(), part, after).items()
    }
    assert_same_arrays(got, {name: np.ascontiguousarray(plane[21:81, 37:137]) for name, plane in whole.items()})
    limit = 8 << 20
    device = open_device(None, limit)
    assert_same_arrays(drawn(device, camera, moved(camera)), whole)
    assert device.memory.peak <= limit
