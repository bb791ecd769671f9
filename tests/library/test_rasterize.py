# SPDX-License-Identifier: Apache-2.0
"""`clsplat.rasterize`: what it takes, gives and refuses. tests/as_gsplat holds its numbers against float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calls import refuses

import clsplat
from clsplat.device.context import Device
from clsplat.library.rasterize import RASTERIZE_RENDER_MODES, Rasterization

WIDTH, HEIGHT = 40, 24


def scene(n: int = 12, seed: int = 3) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.6, 0.6, (n, 3)).astype(np.float32),
        "quaternions": rng.normal(size=(n, 4)).astype(np.float32),
        "scales": rng.uniform(0.1, 0.3, (n, 3)).astype(np.float32),
        "opacities": rng.uniform(0.2, 0.8, n).astype(np.float32),
        "colors": rng.random((n, 3)).astype(np.float32),
        "viewmats": np.stack([pose(0.0), pose(0.4)]),
        "intrinsics": np.array([[30.0, 0, 20], [0, 32, 12], [0, 0, 1]]),
    }


def pose(turn: float) -> np.ndarray:
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[2, 3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]], 3.0
    return matrix


def call(arguments: dict[str, Any], device: Device, **settings: Any) -> Rasterization:
    given = {"width": WIDTH, "height": HEIGHT, **arguments, **settings}
    positional = [given.pop(name) for name in POSITIONAL]
    if given.get("intrinsics") is None:
        given.pop("intrinsics", None)
    return clsplat.rasterize(*positional, device=device, **given)


POSITIONAL = ("means", "quaternions", "scales", "opacities", "colors", "viewmats", "intrinsics", "width", "height")


def with_lenses(arguments: dict[str, Any]) -> dict[str, Any]:
    """One matrix for each camera."""
    return {**arguments, "intrinsics": np.stack([arguments["intrinsics"]] * len(arguments["viewmats"]))}


@pytest.mark.smoke
def test_shapes_and_that_the_colours_are_of_the_gaussians(default_device: Device) -> None:
    result = call(with_lenses(scene()), default_device)
    shapes = {
        "images": (2, HEIGHT, WIDTH, 3),
        "alphas": (2, HEIGHT, WIDTH, 1),
        "radii": (2, 12, 2),
        "means2d": (2, 12, 2),
        "depths": (2, 12),
        "conics": (2, 12, 3),
        "opacities": (2, 12),
        "colors2d": (2, 12, 3),
        "tile_counts": (2, 12),
    }
    assert {name: getattr(result, name).shape for name in shapes} == shapes
    assert result.images.max() > 0.3 and ((result.radii > 0).all(-1) == (result.tile_counts > 0)).all()


def test_cameras_are_the_same_alone_and_together(default_device: Device) -> None:
    arguments = with_lenses(scene())
    together = call(arguments, default_device)
    d_images = np.random.default_rng(1).normal(size=together.images.shape).astype(np.float32)
    summed = together.vjp(d_images)
    alone = []
    for index in range(2):
        one = {**arguments, "viewmats": arguments["viewmats"][index], "intrinsics": arguments["intrinsics"][index]}
        result = call(one, default_device)
        assert (result.images[0] == together.images[index]).all()
        alone.append(result.vjp(d_images[index : index + 1]))
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        # two roundings of a sum of two
        np.testing.assert_allclose(summed[name], alone[0][name] + alone[1][name], rtol=1e-5, atol=1e-5)
    for name in ("viewmats", "intrinsics"):
        assert (summed[name] == np.concatenate([alone[0][name], alone[1][name]])).all()


def test_cameras_of_several_sizes(default_device: Device) -> None:
    arguments = with_lenses(scene())
    result = call(arguments, default_device, width=[WIDTH, 17], height=[HEIGHT, 33])
    assert [image.shape for image in result.images] == [(HEIGHT, WIDTH, 3), (33, 17, 3)]
    assert [alpha.shape for alpha in result.alphas] == [(HEIGHT, WIDTH, 1), (33, 17, 1)]
    same = call(arguments, default_device).images
    assert (result.images[0] == same[0]).all()
    gradients = result.vjp([np.ones_like(image) for image in result.images])
    assert all(np.isfinite(array).all() for array in gradients.values())


def test_depths_are_channels_of_their_own(default_device: Device) -> None:
    arguments = with_lenses(scene())
    by_mode = {mode: call(arguments, default_device, render_mode=mode) for mode in RASTERIZE_RENDER_MODES}
    rgb, depth = by_mode["RGB"].images, by_mode["D"].images
    alpha = by_mode["RGB"].alphas
    # blend.cl and values.cl add the same products in the same order, and fuse them alike
    np.testing.assert_allclose(by_mode["RGB+D"].images[..., :3], rgb, atol=1e-6)
    np.testing.assert_allclose(by_mode["RGB+D"].images[..., 3:], depth, atol=1e-5)
    shown = alpha > 0
    np.testing.assert_allclose(by_mode["ED"].images[shown], (depth[shown] / alpha[shown]), rtol=1e-6)
    assert (by_mode["RGB+ED"].images[..., 3:][shown] > 2).all() and (by_mode["ED"].images[~shown] == 0).all()


def test_covariances_in_place_of_quaternions_and_scales(default_device: Device) -> None:
    arguments = with_lenses(scene())
    q = arguments["quaternions"].astype(np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    turned = (
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        * arguments["scales"][:, None, :]
    )
    covars = turned @ turned.transpose(0, 2, 1)
    wanted = call(arguments, default_device)
    result = call({**arguments, "quaternions": None, "scales": None, "covars": covars}, default_device)
    # float32 has 6e-8 of a covariance, and its inverse's condition is a few hundred at most here
    np.testing.assert_allclose(result.images, wanted.images, atol=2e-5)
    d_images = np.random.default_rng(2).normal(size=wanted.images.shape)
    by_covars, by_scales = result.vjp(d_images)["covars"], wanted.vjp(d_images)["scales"]
    # the chain rule: dL/ds = 2 diag(R^T G R) s, of a symmetric G
    units = turned / arguments["scales"][:, None, :]
    chained = 2 * np.einsum("nji,njk,nki->ni", units, by_covars.astype(np.float64), units) * arguments["scales"]
    assert np.linalg.norm(chained - by_scales) <= 1e-4 * np.linalg.norm(by_scales)
    upper = covars[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    same = call({**arguments, "quaternions": None, "scales": None, "covars": upper}, default_device)
    np.testing.assert_array_equal(same.images, result.images)
    both = by_covars[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] * np.float32([1, 2, 2, 1, 2, 1])
    np.testing.assert_array_equal(same.vjp(d_images)["covars"], both)


@pytest.mark.parametrize("channels", [3, 5])
def test_images_alone_have_the_same_bits_and_so_have_gradients_after_all(channels: int, device: Device) -> None:
    arguments = {**with_lenses(scene()), "colors": np.random.default_rng(1).random((12, channels), np.float32)}
    wanted, alone = call(arguments, device), call(arguments, device, differentiable=False)
    np.testing.assert_array_equal(alone.images, wanted.images)
    by = np.random.default_rng(2).normal(size=wanted.images.shape)
    expected = wanted.vjp(by)
    for name, array in alone.vjp(by).items():
        np.testing.assert_array_equal(array, expected[name])


def test_a_degree_may_be_numpys_and_the_first_of_its_kind(default_device: Device) -> None:
    colors = np.random.default_rng(1).normal(size=(12, 16, 3))
    images = [
        call({**with_lenses(scene()), "colors": colors}, default_device, sh_degree=degree).images
        for degree in (np.int64(2), 2)
    ]
    np.testing.assert_array_equal(*images)


def test_matrices_may_change_after_the_call(default_device: Device) -> None:
    arguments = {**with_lenses(scene()), "colors": np.random.default_rng(1).normal(size=(12, 4, 3))}
    arguments |= {name: np.array(arguments[name], np.float64) for name in ("viewmats", "intrinsics")}
    result = call(arguments, default_device, sh_degree=1)
    by = np.random.default_rng(2).normal(size=result.images.shape)
    before = result.vjp(by)
    for name in ("viewmats", "intrinsics"):
        arguments[name] *= 1.5
    for name, array in result.vjp(by).items():
        np.testing.assert_array_equal(array, before[name])


def test_results_are_not_the_arguments(default_device: Device) -> None:
    arguments = {name: np.float32(value) for name, value in with_lenses(scene()).items()}
    arguments |= {name: arguments[name][:1] for name in ("viewmats", "intrinsics")}
    result = call(arguments, default_device)
    assert not np.may_share_memory(result.opacities, arguments["opacities"])
    assert not np.may_share_memory(result.colors2d, arguments["colors"])


def test_gradients_that_are_not_finite_pass_to_what_they_have_a_part_in(default_device: Device) -> None:
    result = call(with_lenses(scene()), default_device)
    d_images = np.random.default_rng(3).normal(size=result.images.shape).astype(np.float32)
    d_images[0, 12, 20] = 0
    wanted = result.vjp(d_images)
    d_images[0, 12, 20] = np.inf
    found = result.vjp(d_images)
    reached = ~np.isfinite(found["opacities"])
    assert 0 < reached.sum() < len(reached)
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        np.testing.assert_array_equal(found[name][~reached], wanted[name][~reached])


def test_a_background_shows_through(default_device: Device) -> None:
    arguments = with_lenses(scene())
    black = call(arguments, default_device)
    over = np.array([[0.25, 0.5, 0.75], [1, 0, 0]], np.float32)
    result = call(arguments, default_device, backgrounds=over)
    through = (1 - black.alphas) * over[:, None, None]
    np.testing.assert_allclose(result.images, black.images + through, atol=1e-6)  # some ulp of 1
    d_images = np.random.default_rng(5).normal(size=result.images.shape)
    wanted = ((1 - black.alphas) * d_images).sum((1, 2))
    np.testing.assert_allclose(result.vjp(d_images)["backgrounds"], wanted, rtol=1e-4, atol=1e-4)  # sums of 960
    depth = call(arguments, default_device, backgrounds=over, render_mode="RGB+D")
    assert (depth.images[..., 3] == call(arguments, default_device, render_mode="RGB+D").images[..., 3]).all()


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize(
    "settings", [{}, {"rasterize_mode": "antialiased", "sh_degree": 2}], ids=["plain", "harmonics"]
)
def test_gradients_by_differences(mode: str, settings: dict[str, Any], default_device: Device) -> None:
    """The loss' change along a random direction of every argument, by central differences."""
    arguments = with_lenses(scene(6))
    rng = np.random.default_rng(4)
    if "sh_degree" in settings:
        arguments["colors"] = rng.normal(0, 0.3, (6, 9, 3)).astype(np.float32)
    base = call(arguments, default_device, render_mode=mode, **settings)
    waves = [np.cos(np.add.outer(0.1 * np.arange(HEIGHT) + phase, 0.07 * np.arange(WIDTH))) for phase in range(4)]
    # an expected depth jumps where next to nothing comes in
    weights = np.stack(waves[: base.images.shape[-1]], axis=-1) * (base.alphas > 0.05)
    weights[..., 3:] *= 0.1
    weights_alpha = np.stack([waves[2], waves[3]])[:, :, :, None]

    def loss(changed: dict[str, Any]) -> float:
        result = call({**arguments, **changed}, default_device, render_mode=mode, **settings)
        return float((result.images * weights).sum(dtype=np.float64) + (result.alphas * weights_alpha).sum())

    gradients = base.vjp(weights, weights_alpha)
    for name in ("means", "quaternions", "scales", "opacities", "colors", "viewmats", "intrinsics"):
        value = np.asarray(arguments[name], np.float64)
        direction = gradients[name] / np.linalg.norm(gradients[name])
        step = 2e-3 * max(float(np.abs(value).max()), 1.0)
        ends = [loss({name: value + sign * step * direction}) for sign in (1, -1)]
        wanted = np.linalg.norm(gradients[name])
        # at an ellipse's edge, where alpha is cut at 1/255, the loss jumps and its gradient does not know: up to 6 %
        assert abs((ends[0] - ends[1]) / (2 * step) - wanted) <= 0.08 * wanted, name


def test_the_cap_of_alpha_is_an_argument(default_device: Device) -> None:
    arguments = with_lenses(scene(1))
    # its middle is the middle of a pixel
    arguments["opacities"], arguments["means"] = np.ones(1), np.array([[0.05, 0.5 * 3 / 32, 0]])
    arguments["viewmats"] = np.stack([pose(0.0)] * 2)
    for cap in (0.99, 0.999, 0.5):
        assert call(arguments, default_device, alpha_max=cap).alphas.max() == pytest.approx(cap, abs=1e-6)


def test_no_gaussians(default_device: Device) -> None:
    arguments = with_lenses(scene(0))
    result = call(arguments, default_device, backgrounds=[0.5, 0.25, 1.0])
    assert (result.images == np.float32([0.5, 0.25, 1.0])).all() and (result.alphas == 0).all()
    gradients = result.vjp(np.ones_like(result.images))
    assert gradients["means"].shape == (0, 3) and (gradients["viewmats"] == 0).all()


def test_radii_that_are_clipped_are_not_seen(default_device: Device) -> None:
    arguments = with_lenses(scene())
    result = call(arguments, default_device, radius_clip=1e4)
    assert (result.radii == 0).all() and (result.images == 0).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 40.0, "height": np.float32(24)},
        {"width": np.array(40), "height": np.array(24.0), "sh_degree": np.array(0.0)},
        {"width": [40.0, np.array(40)], "height": np.array([24, 24]), "eps2d": np.array(0.3), "sh_degree": 0.0},
    ],
    ids=["real numbers", "arrays of one", "one for each camera"],
)
def test_numbers_may_be_real_numbers_or_arrays_of_one(changes: dict[str, Any], default_device: Device) -> None:
    arguments = {**with_lenses(scene()), "colors": np.full((12, 1, 3), 0.5), "sh_degree": 0}
    expected, found = call(arguments, default_device), call({**arguments, **changes}, default_device)
    assert found.images.shape == (2, 24, 40, 3)
    assert np.array_equal(found.images, expected.images)


@pytest.mark.slow
@pytest.mark.parametrize("channels", [513, *(pytest.param(count, marks=pytest.mark.slow) for count in (768, 1030))])
def test_any_number_of_channels(channels: int, default_device: Device) -> None:
    """Bit for bit what calls with a part of them give, the gradient by colours too; that by means is their sum, to the
    rounding of sums of a thousand float32."""
    arguments, rng = with_lenses(scene()), np.random.default_rng(channels)
    colors = rng.uniform(size=(12, channels)).astype(np.float32)
    weights = rng.normal(size=(2, HEIGHT, WIDTH, channels)).astype(np.float32)
    whole = call({**arguments, "colors": colors}, default_device)
    gradients = whole.vjp(weights)
    cut = [slice(begin, begin + 300) for begin in range(0, channels, 300)]
    parts = [call({**arguments, "colors": colors[:, part]}, default_device) for part in cut]
    by_part = [result.vjp(weights[..., part]) for result, part in zip(parts, cut, strict=True)]
    assert np.array_equal(whole.images, np.concatenate([result.images for result in parts], axis=-1))
    assert np.array_equal(gradients["colors"], np.concatenate([found["colors"] for found in by_part], axis=-1))
    summed = sum(found["means"].astype(np.float64) for found in by_part)
    np.testing.assert_allclose(gradients["means"], summed, rtol=1e-4, atol=1e-4 * np.abs(summed).max())


def test_absolute_gradients(default_device: Device) -> None:
    result = call(with_lenses(scene()), default_device, absolute_gradients=True)
    found = result.vjp_pixels(np.random.default_rng(0).normal(size=result.images.shape))
    # a sum of absolute values is no less than the absolute sum, but for rounding
    assert (found["absolute"] >= np.abs(found["means2d"]) * (1 - 1e-5) - 1e-6).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"means": np.zeros((12, 2))}, "means: got shape (12, 2), expected (N, 3)"),
        ({"means": np.full((12, 3), np.nan)}, "means: [0, 0] is nan, expected finite numbers within float32"),
        ({"quaternions": np.zeros((11, 4))}, "quaternions: got shape (11, 4), expected (12, 4)"),
        ({"quaternions": None}, "quaternions is None, expected an array unless covars is given"),
        ({"covars": np.zeros((12, 6))}, "covars: expected either covars, or quaternions and scales"),
        ({"scales": "wide"}, "scales: got <U4, expected an array of real numbers"),
        ({"opacities": np.full(12, np.inf)}, "opacities: [0] is inf, expected finite numbers within float32"),
        ({"colors": np.zeros((3, 12, 3))}, "colors: got shape (3, 12, 3), expected (12, D) or (2, 12, D)"),
        ({"colors": np.zeros((12, 0))}, "colors has 0 channels, expected 1 or more"),
        (
            {"colors": np.zeros((12, 4, 3)), "sh_degree": 2},
            "colors has 4 SH coefficients, expected 9 or more for sh_degree 2",
        ),
        ({"sh_degree": 2.5}, "sh_degree is 2.5, expected a whole number from 0 to 4, or None"),
        ({"sh_degree": True}, "sh_degree is True, expected a whole number from 0 to 4, or None"),
        (
            {"viewmats": np.zeros((0, 4, 4)), "intrinsics": np.zeros((0, 3, 3))},
            "viewmats has no matrix, expected 1 or more",
        ),
        ({"sh_degree": 5}, "sh_degree is 5, expected a whole number from 0 to 4, or None"),
        ({"viewmats": np.zeros((2, 3, 4))}, "viewmats: got shape (2, 3, 4), expected (C, 4, 4) or (4, 4)"),
        ({"intrinsics": np.zeros((2, 3, 3))}, "intrinsics: a focal length is 0, expected numbers other than 0"),
        ({"near_plane": 2, "far_plane": 1}, "near_plane is 2 and far_plane is 1, expected near_plane < far_plane"),
        ({"intrinsics": np.eye(3)}, "intrinsics has 1 matrices, expected 2, one for each matrix of viewmats"),
        ({"width": 0}, "width is 0, expected a positive whole number, or one for each of 2 cameras"),
        ({"width": 40.5}, "width is 40.5, expected a positive whole number, or one for each of 2 cameras"),
        ({"width": np.inf}, "width is inf, expected a positive whole number, or one for each of 2 cameras"),
        ({"width": True}, "width is True, expected a positive whole number, or one for each of 2 cameras"),
        ({"width": np.array("40")}, "width is array('40', dtype='<U2'), expected a positive whole number"),
        ({"height": [24]}, "height is [24], expected a positive whole number, or one for each of 2 cameras"),
        ({"backgrounds": np.zeros((2, 4))}, "backgrounds: got shape (2, 4), expected (2, 3) or (3,)"),
        ({"render_mode": "RGBD"}, "render_mode is 'RGBD', expected one of RGB, D, ED, RGB+D, RGB+ED"),
        ({"rasterize_mode": "smooth"}, "rasterize_mode is 'smooth', expected one of classic, antialiased"),
        ({"camera_model": "ftheta"}, "camera_model is 'ftheta', expected one of pinhole, ortho, fisheye"),
        ({"alpha_max": 1.0}, "alpha_max is 1.0, expected a number from 0.00392157 to 0.999999"),
        ({"eps2d": -1}, "eps2d is -1, expected a number from 0 to 3.40282e+38"),
        (
            {"viewmats": np.zeros((2, 4, 4)), "sh_degree": 0, "colors": np.zeros((12, 1, 3))},
            "viewmats: a matrix is singular",
        ),
    ],
    ids=str,
)
def test_what_makes_no_sense_names_its_argument(change: dict[str, Any], words: str, default_device: Device) -> None:
    assert refuses(".", call, {**with_lenses(scene()), **change}, default_device).startswith(words)


def test_gradients_that_make_no_sense_name_their_argument(default_device: Device) -> None:
    result = call(with_lenses(scene()), default_device)
    for none in (None, 1.0, np.float32(1)):
        refuses(r"d_images is .*, expected 2 images, one for each camera", result.vjp, none)
    refuses("d_images has 1 images, expected 2", result.vjp, np.zeros((1, HEIGHT, WIDTH, 3)))
    refuses(r"d_images: got shape \(24, 40, 4\), expected \(24, 40, 3\)", result.vjp, np.zeros((2, HEIGHT, WIDTH, 4)))
    refuses(r"means2d: got shape \(2, 12\), expected \(2, 12, 2\)", result.vjp_projection, means2d=np.zeros((2, 12)))
