# SPDX-License-Identifier: Apache-2.0
"""The float64 gradients against central differences, and the formulas the kernels use against the float64 gradients.

Every difference quotient also asserts that no pixel changed its set of Gaussians, so that no discontinuity is inside
the step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_gradient
from numpy.typing import NDArray
from quick import quick

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference.adam import adam
from clsplat.reference.blend import BLEND_ALPHA_MAX, blend, blend_grad
from clsplat.reference.loss import l1_dssim
from clsplat.reference.project import ALPHA_MIN, covariance_grad, project, project_grad
from clsplat.reference.render import forward, parameters, projected_gradients, render_grad
from clsplat.reference.sh import sh_basis_grad
from clsplat.spherical_harmonics import sh_basis

Arrays = dict[str, Float64]

BACKGROUND = (0.2, 0.6, 0.4)
STEP = 1e-6


class Objective:
    """L1 + D-SSIM of a render against a fixed random image, as a function of the parameter arrays."""

    def __init__(self, gaussians: Gaussians, camera: Camera) -> None:
        self.arrays = parameters(gaussians)
        self.camera, self.antialiased = camera, gaussians.antialiased
        self.target = np.random.default_rng(0).uniform(0, 1, (camera.height, camera.width, 3))
        self.count, self.last = self._evaluate(self.arrays)[1:]

    def _evaluate(self, arrays: Arrays) -> tuple[float, NDArray[np.int64], NDArray[np.int64]]:
        projected = project(**arrays, camera=self.camera, sh_degree=3, antialiased=self.antialiased)
        blended = blend(projected, self.camera.width, self.camera.height, BACKGROUND)
        return l1_dssim(blended.image, self.target)[0], blended.count, blended.last

    def __call__(self, arrays: Arrays) -> float:
        loss, count, last = self._evaluate(arrays)
        assert (count == self.count).all() and (last == self.last).all(), "a discontinuity within the step"
        return loss

    def slope(self, name: str, direction: Float64) -> float:
        """Central difference of the loss along `direction`."""
        shifted = [dict(self.arrays, **{name: self.arrays[name] + s * STEP * direction}) for s in (1, -1)]
        return (self(shifted[0]) - self(shifted[1])) / (2 * STEP)

    def gradient(self) -> Arrays:
        projected = project(**self.arrays, camera=self.camera, sh_degree=3, antialiased=self.antialiased)
        width, height = self.camera.width, self.camera.height
        image = blend(projected, width, height, BACKGROUND).image
        screen = blend_grad(projected, width, height, BACKGROUND, l1_dssim(image, self.target)[1])
        by = projected_gradients(projected, screen)
        return project_grad(self.arrays, self.camera, 3, projected, by, antialiased=self.antialiased)


@pytest.fixture(scope="module", params=[False, True], ids=["", "antialiased"])
def overlap(request: pytest.FixtureRequest) -> tuple[Objective, Arrays]:
    gaussians, camera = scenes.overlap()
    objective = Objective(replace(gaussians, antialiased=request.param), camera)
    return objective, objective.gradient()


def test_overlap_exercises_the_clamps(overlap: tuple[Objective, Arrays]) -> None:
    """Frustum clamp, colour clamp, raw quaternion length: all happen in what the differences below run on."""
    objective, gradients = overlap
    arrays, camera = objective.arrays, objective.camera
    p = arrays["means"] @ camera.rotation.T + camera.translation
    ratios = p[:, :2] / p[:, 2:]
    low, high = camera.frustum_limits
    clamped = ((ratios < low) | (ratios > high)).any(axis=1)
    moved = np.abs(gradients["means"]).max(axis=1) > 1e-6
    assert np.count_nonzero(clamped & moved) >= 3
    projected = project(**arrays, camera=camera, sh_degree=3)
    assert (projected.colors[moved] == 0).any()
    assert np.ptp(np.linalg.norm(arrays["quaternions"], axis=1)) > 1


@pytest.mark.parametrize("name", quick(["means", "quaternions", "log_scales", "opacity_logits"], "opacity_logits"))
def test_every_parameter_by_central_differences(overlap: tuple[Objective, Arrays], name: str) -> None:
    objective, gradients = overlap
    slopes = np.zeros_like(gradients[name])
    for index in np.ndindex(slopes.shape):
        direction = np.zeros_like(slopes)
        direction[index] = 1.0
        slopes[index] = objective.slope(name, direction)
    # rounding of the loss, 1e-16 / step, against gradients of 1e-3 to 1e-2 in norm
    assert_close_gradient(gradients[name], slopes, 2e-7, name=name)
    assert_close(gradients[name], slopes, absolute=1e-9, name=name)


@pytest.mark.slow
def test_sh_of_degree_3_by_central_differences(overlap: tuple[Objective, Arrays]) -> None:
    """Every coefficient of two Gaussians, then random directions through all of them."""
    objective, gradients = overlap
    gradient = gradients["sh"]
    strongest = np.argsort(np.abs(gradient).sum(axis=(1, 2)))[-2:]
    for gaussian in strongest:
        slopes = np.zeros(gradient.shape[1:])
        for index in np.ndindex(slopes.shape):
            direction = np.zeros_like(gradient)
            direction[(gaussian, *index)] = 1.0
            slopes[index] = objective.slope("sh", direction)
        assert_close_gradient(gradient[gaussian], slopes, 2e-7, name=f"sh of {gaussian}")
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(20, *gradient.shape))
    assert_close_gradient(
        [(gradient * d).sum() for d in directions], [objective.slope("sh", d) for d in directions], 2e-7, name="sh"
    )


@pytest.mark.slow
@pytest.mark.parametrize("scene", quick(["one", "needles", "saturating", "equal_depth"], "one", "saturating"))
def test_random_directions_on_other_scenes(scene: str) -> None:
    """Along random directions through all parameters of a class at once; those that would cross a discontinuity are
    skipped, but most must remain. Depth ties must not be broken, so the means stay where depth is tied."""
    objective = Objective(*scenes.NAMED[scene]())
    gradients = objective.gradient()
    rng = np.random.default_rng(2)
    for name in ("means", "quaternions", "log_scales", "opacity_logits"):
        expected, slopes = [], []
        for _ in range(12):
            direction = rng.normal(size=gradients[name].shape)
            if name == "means" and scene == "equal_depth":
                direction[:, 2] = 0
            direction /= np.linalg.norm(direction)
            try:
                slopes.append(objective.slope(name, direction))
            except AssertionError:
                continue
            expected.append((gradients[name] * direction).sum())
        assert len(slopes) >= 6, f"{scene}: {name} sits on a discontinuity"
        assert_close(expected, slopes, relative=1e-6, absolute=2e-9, name=f"{scene}: {name}")


def test_quaternion_gradient_is_tangential(overlap: tuple[Objective, Arrays]) -> None:
    objective, gradients = overlap
    radial = (objective.arrays["quaternions"] * gradients["quaternions"]).sum(axis=1)
    assert_close(radial, np.zeros_like(radial), absolute=1e-15)


def test_inactive_bands_and_culled_rows_have_no_gradient() -> None:
    gaussians, camera = scenes.off_frustum()
    gradients = render_grad(gaussians, camera, np.ones((camera.height, camera.width, 3)), BACKGROUND, sh_degree=1)
    assert not gradients.parameters["sh"][:, 4:].any() and gradients.parameters["sh"][:, :4].any()
    assert not gradients.visible.all()
    for name, values in gradients.parameters.items():
        assert np.isfinite(values).all(), name
        assert not values[~gradients.visible].any(), name
        assert values.shape == getattr(gaussians, name).shape


@pytest.mark.parametrize("degree", range(5))
def test_sh_basis_is_orthonormal_and_its_derivative_right(degree: int) -> None:
    cosines, weights = np.polynomial.legendre.leggauss(8)
    angles = np.arange(16) * 2 * np.pi / 16
    z, phi = (a.ravel() for a in np.meshgrid(cosines, angles, indexing="ij"))
    sines = np.sqrt(1 - z * z)
    directions = np.stack([sines * np.cos(phi), sines * np.sin(phi), z], axis=1)
    basis = sh_basis(directions, degree)
    area = np.repeat(weights, 16) * 2 * np.pi / 16
    # the quadrature is exact to degree 15; the constants have 16 digits
    assert_close((basis * area[:, None]).T @ basis, np.eye((degree + 1) ** 2), absolute=1e-14)
    derivative = sh_basis_grad(directions, degree)
    for axis in range(3):
        shift = np.eye(3)[axis] * 1e-5
        slopes = (sh_basis(directions + shift, degree) - sh_basis(directions - shift, degree)) / 2e-5
        assert_close(derivative[:, :, axis], slopes, absolute=1e-9)


def test_conic_and_covariance_gradients_are_inverse() -> None:
    gaussians, camera = scenes.overlap()
    projected = project(**parameters(gaussians), camera=camera, sh_degree=3)
    d_conics = np.random.default_rng(3).normal(size=projected.conics.shape)
    twice = np.array([1.0, 2.0, 1.0])  # the off-diagonal entry of a symmetric matrix
    back = covariance_grad(projected.covariances, covariance_grad(projected.conics, d_conics) * twice) * twice
    assert_close(back, d_conics, relative=1e-9, absolute=1e-9)


@pytest.mark.parametrize("scene", ["overlap", "saturating", "needles"])
def test_whitened_moments_give_the_same_gradients(scene: str) -> None:
    """Eqs. (24), (25), (28), (29): five sums of g over the whitened offsets, per tile and then added, replace the
    sums over dx, dy. g comes here from its definition, dL/dalpha alpha, by a route of its own."""
    gaussians, camera = scenes.NAMED[scene]()
    width, height = camera.width, camera.height
    d_image = np.random.default_rng(4).normal(size=(height, width, 3))
    result = forward(gaussians, camera, BACKGROUND)
    projected, order = result.projected, result.projected.order
    wanted = blend_grad(projected, width, height, BACKGROUND, d_image)
    wanted_covariances = covariance_grad(projected.conics, wanted.conics)

    # every alpha of every pixel at once, and the colour behind each Gaussian by the sums that eq. (22) recurses
    alphas = np.zeros((len(order), height, width))
    free = np.zeros(alphas.shape, np.bool_)
    for position, gaussian in enumerate(order):
        splat = projected.footprint(int(gaussian), width, height)
        if splat is None:
            continue
        raw = splat.raw
        alphas[position][splat.box] = np.where(raw >= ALPHA_MIN, np.minimum(raw, BLEND_ALPHA_MAX), 0)
        free[position][splat.box] = (raw >= ALPHA_MIN) & (raw <= BLEND_ALPHA_MAX)
    added = np.arange(len(order))[:, None, None] <= result.blended.last
    alphas *= added
    before = np.cumprod(np.concatenate([np.ones((1, height, width)), 1 - alphas]), axis=0)
    weights = before[:-1] * alphas
    assert_close(before[-1], result.blended.transmittance, absolute=1e-14)
    parts = weights[..., None] * projected.colors[order][:, None, None, :]
    tail = np.cumsum(parts[::-1], axis=0)[::-1] - parts + before[-1][..., None] * np.array(BACKGROUND)
    d_alpha = before[:-1] * (d_image * projected.colors[order][:, None, None, :]).sum(-1)
    d_alpha -= (d_image * tail).sum(-1) / (1 - alphas)
    g = np.where(free & added, d_alpha * alphas, 0.0)

    columns, rows = np.arange(width) + 0.5, np.arange(height) + 0.5
    tile_of = (np.arange(height)[:, None] // 16 * -(-width // 16) + np.arange(width)[None, :] // 16).ravel()
    for position, gaussian in enumerate(order):
        dx = columns[None, :] - projected.means2d[gaussian, 0]
        dy = rows[:, None] - projected.means2d[gaussian, 1]
        l11, l12, l22 = projected.whitening[gaussian]
        u, v = l11 * dx + l12 * dy, l22 * dy + 0 * dx
        sums = [g[position] * m for m in (np.ones_like(u), u, v, u * u, u * v, v * v)]
        s0, su, sv, suu, suv, svv = (np.bincount(tile_of, m.ravel()).sum() for m in sums)
        w = np.array([[l11, l12], [0, l22]])
        half = 0.5 * w.T @ np.array([[suu, suv], [suv, svv]]) @ w
        scale = np.abs(g[position]).sum() + 1e-12
        assert_close(w.T @ [su, sv], wanted.means2d[gaussian], absolute=1e-9 * scale)
        assert_close([half[0, 0], half[0, 1], half[1, 1]], wanted_covariances[gaussian], absolute=1e-9 * scale)
        assert_close(s0 / projected.opacities[gaussian], wanted.opacities[gaussian], absolute=1e-9 * scale / ALPHA_MIN)


def test_absolute_screen_gradient_adds_pixel_by_pixel() -> None:
    """The sum over pixels of |dL/dmean| when each pixel alone carries the loss."""
    gaussians, camera = scenes.overlap(count=12, width=12, height=9)
    width, height = camera.width, camera.height
    result = forward(gaussians, camera, BACKGROUND)
    d_image = np.random.default_rng(5).normal(size=(height, width, 3))
    whole = blend_grad(result.projected, width, height, BACKGROUND, d_image)
    absolute = np.zeros_like(whole.means2d)
    for row in range(height):
        for column in range(width):
            single = np.zeros_like(d_image)
            single[row, column] = d_image[row, column]
            alone = blend_grad(result.projected, width, height, BACKGROUND, single)
            absolute += np.abs(alone.means2d)
    assert_close(whole.abs_means2d, absolute, relative=1e-12)
    assert (whole.abs_means2d >= np.abs(whole.means2d) - 1e-12).all()


def test_adam_first_steps() -> None:
    """The first step is the rate in the gradient's sign whatever its size; a constant gradient goes on so."""
    gradient = np.array([1e-3, -50.0, 0.0])
    value, first, second = np.zeros(3), np.zeros(3), np.zeros(3)
    for step in (1, 2, 3):
        value, first, second = adam(value, gradient, first, second, step, 0.01)
        assert_close(value, -0.01 * step * np.sign(gradient), absolute=1e-12)
