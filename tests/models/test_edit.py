# SPDX-License-Identifier: Apache-2.0
"""Edits of a model: what they keep, and that a model moved with its camera gives the same frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from calls import refuses
from models import assert_equal, random_gaussians
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.reference.render import render as reference
from clsplat.rendering.contributions import largest_contributions
from clsplat.rendering.renderer import Renderer
from clsplat.spherical_harmonics import sh_basis

TURN = Rotation.from_euler("xyz", (0.7, -1.9, 2.6)).as_matrix()
MIRROR = TURN @ np.diag([1.0, -1.0, 1.0])


def similarity(turn: np.ndarray, scale: float = 1.0, shift: tuple[float, ...] = (0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * turn, shift
    return matrix


MATRICES = {
    "turned": similarity(TURN),
    "scaled": edit.scaling(2.5),
    "moved": similarity(np.eye(3), 1.0, (3, -7, 1)),
    "all three": similarity(TURN, 0.3, (-2, 5, 11)),
    "mirrored": similarity(MIRROR, 1.7, (1, 2, 3)),
}


def asymmetric() -> tuple[Gaussians, Camera]:
    """No two axes alike, SH of degree 3: nothing that is turned or mirrored looks as before."""
    return scenes.overlap()


@pytest.mark.parametrize("name", MATRICES)
def test_a_model_moved_with_its_camera_gives_the_same_frame(name: str) -> None:
    matrix = MATRICES[name]
    gaussians, camera = asymmetric()
    wanted, _ = reference(gaussians, camera, (0.1, 0.2, 0.3))
    moved = edit.transform(gaussians, matrix)
    got, _ = reference(moved, edit.transform_camera(camera, matrix), (0.1, 0.2, 0.3))
    # Parameters are rounded to float32 once more: the oracle works in float64. Pixels where a Gaussian crosses 1/255
    # may jump by that.
    assert np.abs(got - wanted).mean() < 1e-6
    assert np.abs(got - wanted).max() < 1 / 255
    unmoved, _ = reference(moved, camera, (0.1, 0.2, 0.3))
    assert np.abs(unmoved - wanted).mean() > 0.01, "the move is seen"


def test_the_device_sees_it_too(default_device: Device) -> None:
    gaussians, camera = asymmetric()
    matrix = MATRICES["all three"]
    renderer = Renderer(default_device)
    wanted = renderer.render(gaussians, camera).image
    got = renderer.render(edit.transform(gaussians, matrix), edit.transform_camera(camera, matrix)).image
    assert np.abs(got - wanted).mean() < 1e-5  # float32's rounding, of means about 12 from the new origin


@pytest.mark.parametrize("turn", [TURN, MIRROR, -np.eye(3), np.eye(3)], ids=["turn", "mirror", "point", "none"])
@pytest.mark.parametrize("degree", range(4))
def test_sh_of_a_turned_model_is_the_function_turned(turn: np.ndarray, degree: int) -> None:
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sh = rng.standard_normal((5, (degree + 1) ** 2, 3)).astype(np.float32)
    turned = edit.rotate_sh(sh, turn)
    got = np.einsum("dk,nkc->dnc", sh_basis(directions @ turn.T, degree), turned)
    wanted = np.einsum("dk,nkc->dnc", sh_basis(directions, degree), sh)
    np.testing.assert_allclose(got, wanted, atol=2e-6)  # the coefficients, up to 4, are float32
    for matrix in edit.sh_rotations(turn, degree):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=1e-13)


def test_turning_twice_is_turning_by_the_product() -> None:
    other = Rotation.from_euler("zyx", (1.1, 0.2, -0.4)).as_matrix()
    for both, first, second in zip(
        edit.sh_rotations(other @ TURN, 3), edit.sh_rotations(TURN, 3), edit.sh_rotations(other, 3), strict=True
    ):
        np.testing.assert_allclose(both, second @ first, atol=1e-13)


def test_lengths_of_quaternions_stay() -> None:
    gaussians = random_gaussians(50)
    moved = edit.transform(gaussians, MATRICES["mirrored"])
    lengths = [np.linalg.norm(model.quaternions, axis=1) for model in (gaussians, moved)]
    np.testing.assert_allclose(*lengths, rtol=1e-6)


def test_a_model_that_is_moved_far_keeps_its_digits() -> None:
    gaussians, camera = asymmetric()
    matrix = similarity(TURN, 1.0, (5e5, -4.2e6, 333.0))
    far = edit.transform(gaussians, matrix)
    assert far.origin.any()
    assert np.abs(far.means).max() < 100
    again = edit.transform(far, np.linalg.inv(matrix))
    assert not again.origin.any(), "near the world's origin it counts from there"
    np.testing.assert_allclose(again.means, gaussians.means, atol=2e-5)  # float64's digits of 4.2e6, times a few
    wanted, _ = reference(gaussians, camera)
    moved = edit.transform_camera(camera, matrix).from_origin(far.origin)
    got, _ = reference(replace(far, origin=np.zeros(3)), moved)
    assert np.abs(got - wanted).mean() < 1e-6


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "4 x 4"),
        (np.full((4, 4), np.nan), "finite"),
        (np.diag([1.0, 1, 2, 1]), "not a similarity"),
        (np.diag([0.0, 0, 0, 1]), "is not invertible"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
    ],
)
def test_what_is_no_similarity_is_refused(matrix: np.ndarray, message: str) -> None:
    refuses(message, edit.transform, random_gaussians(3), matrix)


def test_crops_are_in_the_world() -> None:
    gaussians = random_gaussians(500)
    low, high = (-0.5, -1.0, 0.0), (1.0, 2.0, 0.7)
    kept = edit.in_box(gaussians, low, high)
    wanted = [all(lo <= x <= hi for lo, x, hi in zip(low, mean, high, strict=True)) for mean in gaussians.means]
    assert kept.tolist() == wanted
    assert 0 < kept.sum() < 500
    far = replace(gaussians, origin=np.array([1e6, -2e6, 3e6]))
    np.testing.assert_array_equal(edit.in_box(far, low + far.origin, high + far.origin), kept)
    near = edit.in_sphere(far, far.origin + np.array([0.1, 0.2, 0.3]), 1.2)
    distances = np.linalg.norm(gaussians.means - np.array([0.1, 0.2, 0.3]), axis=1)
    np.testing.assert_array_equal(near, distances <= 1.2)
    assert_equal(edit.take(gaussians, np.flatnonzero(kept)), edit.take(gaussians, kept))


def test_opacity_and_degree() -> None:
    gaussians = random_gaussians(300)
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    np.testing.assert_array_equal(edit.opaque(gaussians, 0.3), opacity >= 0.3)
    assert edit.opaque(gaussians, 0.0).all()
    assert not edit.opaque(gaussians, 1.0).any()
    for degree in range(4):
        dropped = edit.drop_sh(gaussians, degree)
        assert dropped.sh_degree == degree
        np.testing.assert_array_equal(dropped.sh, gaussians.sh[:, : (degree + 1) ** 2])
    assert edit.drop_sh(edit.drop_sh(gaussians, 1), 2).sh_degree == 1


def test_merged_models_are_where_they_were() -> None:
    a = replace(random_gaussians(5, 1), origin=np.array([1e6, 0, 0]))
    b = replace(random_gaussians(7, 3, seed=1), origin=np.array([1e6, 64.0, 0]))
    both = edit.merge([a, b])
    both.check()
    assert len(both) == 12
    assert both.sh_degree == 3
    np.testing.assert_array_equal(edit.take(both, np.arange(5)).means, a.means)
    np.testing.assert_allclose(both.means[5:] + both.origin, b.means + b.origin, atol=1e-5)
    assert not both.sh[:5, 4:].any()
    np.testing.assert_array_equal(both.sh[5:], b.sh)


def test_contributions_are_the_sums_of_blending_weights(device: Device) -> None:
    """One Gaussian alone: its sum of alpha is the picture's alpha. One behind a wall, one beside the picture: 0."""
    gaussians, camera = scenes.one()
    result = Renderer(device).render(gaussians, camera)
    alone = largest_contributions(gaussians, [camera], device)
    np.testing.assert_allclose(alone, result.alpha.sum(), rtol=1e-4)  # float32 sums of about 300 pixels
    turned = edit.transform_camera(camera, similarity(Rotation.from_euler("y", 180, degrees=True).as_matrix()))
    beside = edit.transform(gaussians, similarity(np.eye(3), 1.0, (50, 0, 0)))
    found = largest_contributions(edit.merge([gaussians, beside]), [turned, camera], device)
    np.testing.assert_array_equal(found, [alone[0], 0])
    limited = largest_contributions(replace(gaussians, origin=np.array([0, 0, 7.0])), [camera], device)
    assert 0 < limited[0] < alone[0], "it counts from the origin: farther away, and smaller"


def test_contributions_to_other_cameras(device: Device) -> None:
    """Those of all Gaussians add up to the picture's alpha."""
    gaussians, camera = scenes.one()
    gaussians = edit.merge([gaussians, edit.transform(gaussians, similarity(np.eye(3), 0.5, (0.3, 0.1, 0.2)))])
    flat = replace(camera, fx=0.2 * camera.fx, fy=0.2 * camera.fy, projection="orthographic")
    for other in (flat, replace(camera, projection="fisheye")):
        alpha = Renderer(device).render(gaussians, other).alpha
        found = largest_contributions(gaussians, [other], device)
        assert found.min() > 1
        np.testing.assert_allclose(found.sum(), alpha.sum(), rtol=1e-4)  # as above
