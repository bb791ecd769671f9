# SPDX-License-Identifier: Apache-2.0
"""The float64 forward pass against closed forms, invariances and independent implementations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_images
from skimage.metrics import structural_similarity

from clsplat.gaussians import Gaussians
from clsplat.reference.blend import blend
from clsplat.reference.loss import l1_dssim, ssim
from clsplat.reference.project import ALPHA_MIN, project, rotation_matrices
from clsplat.reference.render import forward, parameters, render
from clsplat.reference.sort import depth_order
from clsplat.reference.tiles import touched_tiles


def gray(gaussians: Gaussians, value: float) -> Gaussians:
    """The same Gaussians, all of one colour from everywhere."""
    sh = np.zeros_like(gaussians.sh, np.float64)
    sh[:, 0] = (value - 0.5) / 0.28209479177387814
    # float64 on purpose: the float32 of the contract would round the colour
    return Gaussians(gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.opacity_logits, sh)  # type: ignore[arg-type]


def test_one_round_gaussian_on_the_axis_is_its_formula() -> None:
    camera = scenes.straight_camera(21, 15, 20.0)
    gaussians = scenes.make_gaussians(
        np.array([[0.0, 0.0, 4.0]]),
        np.array([[2.0, 0, 0, 0]]),
        np.log([[0.5] * 3]),
        np.array([0.75]),
        np.zeros((1, 1, 3)),
    )
    image, alpha = render(gaussians, camera, (0.1, 0.2, 0.3))
    x, y = np.arange(21) + 0.5 - 10.5, np.arange(15)[:, None] + 0.5 - 7.5
    # standard deviation 0.5 world units at depth 4 with focal length 20: 2.5 px, squared, plus the low-pass
    wanted = 0.75 * np.exp(-0.5 * (x * x + y * y) / (2.5**2 + 0.3))
    wanted[wanted < 1 / 255] = 0.0
    # parameters are stored in float32
    assert_close(alpha, wanted, absolute=1e-7)
    assert_close(image, 0.5 * wanted[..., None] + (1 - wanted[..., None]) * [0.1, 0.2, 0.3], absolute=1e-7)
    assert 0 < np.count_nonzero(alpha == 0) < alpha.size


def test_covariance_is_the_square_root_squared() -> None:
    """Eqs. (6) to (8) against the plain matrix product, and rotations against the vector form of q v q*."""
    for scene in ("overlap", "off_frustum", "needles"):
        gaussians, camera = scenes.NAMED[scene]()
        arrays = parameters(gaussians)
        projected = project(**arrays, camera=camera, sh_degree=3)
        low, high = camera.frustum_limits
        for n in np.flatnonzero(projected.visible):
            q = arrays["quaternions"][n] / np.linalg.norm(arrays["quaternions"][n])
            axes = np.eye(3) + 2 * np.cross(q[1:], np.cross(q[1:], np.eye(3)) + q[0] * np.eye(3))
            assert_close(rotation_matrices(arrays["quaternions"][n : n + 1])[0], axes.T, absolute=1e-14)
            sigma = axes.T @ np.diag(np.exp(2 * arrays["log_scales"][n])) @ axes
            x, y, z = camera.rotation @ arrays["means"][n] + camera.translation
            xc, yc = z * np.clip(np.array([x / z, y / z]), low, high)
            j = np.array([[camera.fx / z, 0, -camera.fx * xc / z**2], [0, camera.fy / z, -camera.fy * yc / z**2]])
            wanted = j @ camera.rotation @ sigma @ camera.rotation.T @ j.T + 0.3 * np.eye(2)
            sxx, sxy, syy = projected.covariances[n]
            got = np.array([[sxx, sxy], [sxy, syy]])
            assert_close(got, wanted, relative=1e-10, absolute=1e-10 * wanted.max())
            l11, l12, l22 = projected.whitening[n]
            w = np.array([[l11, l12], [0, l22]])
            a, b, c = projected.conics[n]
            assert_close(w.T @ w, [[a, b], [b, c]], relative=1e-9)
            # a plain determinant of a needle would cancel; the inverse must still be one
            assert_close(w @ wanted @ w.T, np.eye(2), absolute=1e-6)


def test_frustum_limits_follow_the_principal_point() -> None:
    camera = scenes.tilted_camera(100, 50)
    low, high = camera.frustum_limits
    assert_close(low, [-0.42 - 0.15, -(0.57 * 50 + 7.5) / 110], absolute=1e-15)
    assert_close(high, [0.58 + 0.15, (0.43 * 50 + 7.5) / 110], absolute=1e-15)


@pytest.mark.parametrize("scene", sorted(scenes.NAMED))
def test_furnace(scene: str) -> None:
    """Everything of one colour, the background too: every pixel has it, whatever the geometry."""
    gaussians, camera = scenes.NAMED[scene]()
    image, alpha = render(gray(gaussians, 0.37), camera, (0.37, 0.37, 0.37))
    assert_close_images(image, np.full_like(image, 0.37), 1e-14)
    assert alpha.min() >= 0 and alpha.max() < 1


@pytest.mark.parametrize("scene", sorted(set(scenes.NAMED) - {"equal_depth"}))
def test_permuted_gaussians_give_the_same_image(scene: str) -> None:
    gaussians, camera = scenes.NAMED[scene]()
    shuffle = np.random.default_rng(1).permutation(len(gaussians))
    arrays = [getattr(gaussians, name)[shuffle] for name in parameters(gaussians)]
    for got, wanted in zip(render(Gaussians(*arrays), camera), render(gaussians, camera), strict=True):
        assert_close_images(got, wanted, 0.0)


def test_equal_depths_are_blended_by_index() -> None:
    gaussians, camera = scenes.equal_depth()
    result = forward(gaussians, camera)
    assert (result.projected.order == np.arange(len(gaussians))).all()
    depths = np.array([2.0, 1.0, 1.0 + 1e-9, 1.0, 3.0])
    assert depth_order(depths, np.array([True, True, True, True, False])).tolist() == [1, 2, 3, 0]


def test_stop_rule_excludes_the_gaussian_that_would_saturate() -> None:
    """Two clamped layers would take T a hair under 1e-4, in the float32 of 0.99: one is added, the rest left out."""
    camera = scenes.straight_camera(9, 9, 9.0)
    count = 4
    means = np.stack([np.zeros(count), np.zeros(count), np.array([4.0, 3.0, 2.0, 1.0])], axis=1)
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = np.array([2.0, 1.5, 1.0, 0.5])[:, None] / 0.28209479177387814
    gaussians = scenes.make_gaussians(
        means, np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 3.0), np.full(count, 0.9999), sh
    )
    blended = forward(gaussians, camera, (9.0, 9.0, 9.0)).blended
    cap = float(np.float32(0.99))
    assert (1 - cap) ** 2 < np.float32(1e-4)
    assert (blended.count == 1).all() and (blended.last == 0).all()
    assert_close(blended.transmittance, np.full((9, 9), 1 - cap), relative=1e-12)
    assert_close_images(blended.image, np.full((9, 9, 3), cap + 9 * (1 - cap)), 1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("means", np.nan), ("means", np.inf), ("quaternions", 0.0), ("quaternions", np.nan)),
        *(("log_scales", np.inf), ("log_scales", np.nan), ("log_scales", 400.0), ("opacity_logits", np.nan)),
        *(("opacity_logits", -np.inf), ("sh", np.nan)),
    ],
)
def test_poison_culls_its_own_gaussian_only(field: str, value: float) -> None:
    gaussians, camera = scenes.overlap()
    arrays = {name: np.array(getattr(gaussians, name)) for name in parameters(gaussians)}
    arrays[field][7] = value
    without = Gaussians(*(np.delete(getattr(gaussians, name), 7, axis=0) for name in arrays))
    result = forward(Gaussians(**arrays), camera)
    assert not result.projected.visible[7]
    assert_close_images(result.blended.image, render(without, camera)[0], 0.0)


def test_boxes_lose_nothing_and_margins_see_the_thresholds() -> None:
    """Against an evaluation of every pixel; and moving each threshold by less than the margin changes no pixel."""
    gaussians, camera = scenes.random_cloud(60, 3, 40, 30)
    result = forward(gaussians, camera)
    projected = result.projected
    image = np.zeros((30, 40, 3))
    transmittance, done = np.ones((30, 40)), np.zeros((30, 40), np.bool_)
    for n in projected.order:
        dx = np.arange(40) + 0.5 - projected.means2d[n, 0]
        dy = np.arange(30)[:, None] + 0.5 - projected.means2d[n, 1]
        a, b, c = projected.conics[n]
        alpha = np.minimum(0.99, projected.opacities[n] * np.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2)))
        seen = (alpha >= 1 / 255) & ~done
        done |= seen & (transmittance * (1 - alpha) <= 1e-4)
        alpha = np.where(seen & ~done, alpha, 0)
        image += (transmittance * alpha)[..., None] * projected.colors[n]
        transmittance *= 1 - alpha
    assert_close_images(result.blended.image, image, 1e-14)
    assert_close(result.blended.transmittance, transmittance, absolute=1e-14)

    margin = result.blended.margin
    assert margin is not None and 0 < margin.min() < 1e-3 and margin.max() <= 0.05
    fainter = replace(projected, opacities=projected.opacities * (1 - 2e-3))
    other = blend(fainter, 40, 30)
    # where little is left, T moves by many times the change of an alpha; elsewhere only alphas can have flipped
    changed = (other.count != result.blended.count) & (result.blended.transmittance > 1e-2)
    assert changed.any(), "the scene has no pixel near a threshold"
    assert margin[changed].max() <= 2.1e-3


def test_tiles_hold_what_the_image_shows() -> None:
    gaussians, camera = scenes.random_cloud(50, 4, 45, 35)
    projected = forward(gaussians, camera).projected
    tiles = touched_tiles(projected, 45, 35)
    for n in range(50):
        dx = np.arange(45) + 0.5 - projected.means2d[n, 0]
        dy = np.arange(35)[:, None] + 0.5 - projected.means2d[n, 1]
        a, b, c = projected.conics[n]
        alpha = projected.opacities[n] * np.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2))
        wanted = {y // 16 * 3 + x // 16 for y, x in zip(*np.nonzero(alpha >= ALPHA_MIN), strict=True)}
        assert set(tiles[n].tolist()) == (wanted if projected.visible[n] else set())


def test_ssim_is_that_of_scikit_image() -> None:
    rng = np.random.default_rng(6)
    y = rng.uniform(0, 1, (40, 33, 3))
    x = np.clip(y + rng.normal(0, 0.2, y.shape), 0, 1)
    _, wanted = structural_similarity(  # type: ignore[no-untyped-call]
        x, y, data_range=1.0, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )
    # inside, where scikit-image's reflected edge and our zeros are both out of reach
    inside = (slice(5, -5), slice(5, -5))
    assert_close(ssim(x, y)[0][inside], wanted[inside], absolute=1e-13)


def test_loss_of_equal_images_is_zero_and_gradient_by_differences() -> None:
    rng = np.random.default_rng(7)
    x, y = rng.uniform(0, 1, (2, 9, 13, 3))
    assert l1_dssim(x, x)[0] == pytest.approx(0, abs=1e-15)
    for weight in (0.0, 0.2, 1.0):
        _, gradient = l1_dssim(x, y, weight)
        slopes = np.zeros_like(x)
        for index in np.ndindex(9, 13, 1):
            shift = np.zeros_like(x)
            shift[index] = 1e-6
            slopes[index] = (l1_dssim(x + shift, y, weight)[0] - l1_dssim(x - shift, y, weight)[0]) / 2e-6
        assert_close(gradient[..., 0], slopes[..., 0], absolute=1e-9)
