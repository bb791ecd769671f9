# SPDX-License-Identifier: Apache-2.0
"""`fully_fused_projection` against gsplat's PyTorch reference and against the float64 twin, and its errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calls import refuses
from compare import assert_close_gradient, relative_error
from ewa_cases import MODELS, OUTPUTS, case

from clsplat.device.context import Device
from clsplat.library.projection import Projection, fully_fused_projection
from clsplat.reference import ewa as twin

SUBJECT = case(400)
SHAPES = ["quaternions and scales", "covars"]


def three_views() -> tuple[np.ndarray, np.ndarray]:
    """View matrices (3, 4, 4) and intrinsics (3, 3, 3)."""
    viewmats = np.tile(SUBJECT.view.viewmat, (3, 1, 1))
    viewmats[1, :3, 3] += [0.5, 0.1, 1.0]
    viewmats[2, :3, :3] = viewmats[2, :3, :3] @ np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    intrinsics = SUBJECT.view.intrinsics * np.array([1.0, 1.2, 0.8])[:, None, None]
    intrinsics[:, 2, 2] = 1
    return viewmats, intrinsics


def projection(device: Device | None = None, shape: str = SHAPES[0], **settings: Any) -> Projection:
    """SUBJECT before the three cameras."""
    shapes: tuple[Any, ...] = (None, SUBJECT.quaternions, SUBJECT.scales)
    if shape != SHAPES[0]:
        shapes = (SUBJECT.full(rounded=True), None, None)
    given = (SUBJECT.means, *shapes, *three_views(), 100, 70)
    return fully_fused_projection(*given, calc_compensations=True, device=device, **settings)


def random_gradients(projected: Projection) -> dict[str, np.ndarray]:
    """By all outputs of three cameras, 0 for what is culled."""
    rng = np.random.default_rng(7)
    result = {}
    for name in OUTPUTS:
        values = rng.normal(size=getattr(projected, name).shape)
        if name == "conics":
            values /= np.maximum(np.linalg.norm(projected.conics, axis=2, keepdims=True), 1e-9)
        seen = projected.radii[..., 0] > 0
        result[name] = np.where(seen.reshape(*seen.shape, *[1] * (values.ndim - 2)), values, 0.0)
    return result


@pytest.mark.needs("gsplat")
@pytest.mark.needs("torch")
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", MODELS)
def test_gsplat_s_reference_has_the_same(model: str, shape: str) -> None:
    """In float64 there. It counts a skew, which here is not looked at, and leaves what is culled as it is."""
    torch = pytest.importorskip("torch")
    reference = pytest.importorskip("gsplat.cuda._torch_impl")
    projected = projection(shape=shape, camera_model=model)
    names = ("means", "quaternions", "scales", "viewmats", "intrinsics")
    values = (SUBJECT.means, SUBJECT.quaternions, SUBJECT.scales, *three_views())
    tensors = {
        name: torch.tensor(np.asarray(array, np.float64), requires_grad=True)
        for name, array in zip(names, values, strict=True)
    }
    if shape == "covars":
        tensors["covars"] = torch.tensor(SUBJECT.full(rounded=True), requires_grad=True)
        covars = tensors["covars"]
    else:
        covars, _ = reference._quat_scale_to_covar_preci(tensors["quaternions"], tensors["scales"], True, False)
    radii, *outputs = reference._fully_fused_projection(
        tensors["means"], covars, tensors["viewmats"], tensors["intrinsics"], 100, 70,
        calc_compensations=True, camera_model=model,
    )  # fmt: skip
    # a side within rounding of a whole pixel has the next one
    assert (np.abs(radii.numpy() - projected.radii)).max() <= 1
    assert (radii.numpy() != projected.radii).sum() <= 2
    seen = projected.radii[..., 0] > 0
    for name, output in zip(OUTPUTS, outputs, strict=True):
        wanted = output.detach().numpy()[seen]
        assert relative_error(getattr(projected, name)[seen], wanted) <= 1e-5, name
    by = random_gradients(projected)
    sum((output * torch.tensor(by[name])).sum() for name, output in zip(OUTPUTS, outputs, strict=True)).backward()
    found = projected.vjp(**by)
    for name, values_ in found.items():
        wanted = tensors[name].grad.numpy()
        if name == "intrinsics":
            wanted[:, [0, 1], [1, 0]] = 0  # a skew
        if name == "covars":
            wanted = 0.5 * (wanted + wanted.transpose(0, 2, 1))
        assert_close_gradient(values_, wanted, 1e-4, name=name)


def test_three_cameras_have_the_sum_of_their_gradients(device: Device) -> None:
    projected = projection(device)
    by = random_gradients(projected)
    found = projected.vjp(**by)
    means, full = SUBJECT.means.astype(np.float64), SUBJECT.full(rounded=False)
    sums: dict[str, Any] = {"means": 0.0, "covariances": 0.0}
    for index, (viewmat, intrinsics) in enumerate(zip(*three_views(), strict=True)):
        view = twin.EwaViewTwin(viewmat, intrinsics, 100, 70)
        wanted = twin.project(means, full, view)
        assert (np.abs(wanted.radii - projected.radii[index]) > 1).sum() == 0
        result = twin.project_grad(means, full, view, wanted, {name: values[index] for name, values in by.items()})
        assert_close_gradient(found["viewmats"][index], result["viewmat"], 1e-5)
        assert_close_gradient(found["intrinsics"][index], result["intrinsics"], 1e-5)
        sums = {name: sums[name] + result[name] for name in sums}
    assert_close_gradient(found["means"], sums["means"], 1e-5)
    shapes = (SUBJECT.quaternions.astype(np.float64), SUBJECT.scales.astype(np.float64), sums["covariances"])
    for name, values in zip(("quaternions", "scales"), twin.covariances_grad(*shapes), strict=True):
        assert_close_gradient(found[name], values, 2e-5)


def test_one_gradient_alone_is_a_part_of_the_sum(default_device: Device) -> None:
    projected = projection(default_device)
    by = random_gradients(projected)
    parts = [projected.vjp(**{name: values}) for name, values in by.items()]
    for name, values in projected.vjp(**by).items():
        assert relative_error(sum(part[name] for part in parts), values) <= 1e-5
    assert not any(values.any() for values in projected.vjp().values())


def test_covars_by_six_numbers_or_nine(default_device: Device) -> None:
    nine, views = projection(default_device, "covars"), three_views()
    six = fully_fused_projection(
        SUBJECT.means, SUBJECT.covariances, None, None, *views, 100, 70, calc_compensations=True, device=default_device
    )
    np.testing.assert_array_equal(six.conics, nine.conics)
    by = random_gradients(nine)
    of_six, of_nine = six.vjp(**by)["covars"], nine.vjp(**by)["covars"]
    assert (of_six.shape, of_nine.shape) == ((400, 6), (400, 3, 3))
    np.testing.assert_array_equal(of_nine, of_nine.transpose(0, 2, 1))
    np.testing.assert_array_equal(of_six[:, 1], 2 * of_nine[:, 0, 1])
    np.testing.assert_array_equal(of_six[:, 3], of_nine[:, 1, 1])


def test_opacities_make_radii_smaller(default_device: Device) -> None:
    wide, narrow = (projection(default_device, opacities=o).radii for o in (None, SUBJECT.opacities))
    assert (narrow <= wide).all() and (narrow < wide).any()


def test_no_gaussians_and_no_cameras(default_device: Device) -> None:
    none = np.zeros((0, 3), np.float32)
    views = three_views()
    empty = fully_fused_projection(none, None, np.zeros((0, 4)), none, *views, 100, 70, device=default_device)
    assert (empty.radii.shape, empty.conics.shape) == ((3, 0, 2), (3, 0, 3))
    assert not empty.vjp(means2d=np.zeros((3, 0, 2)))["viewmats"].any()
    shapes = (SUBJECT.means, None, SUBJECT.quaternions, SUBJECT.scales)
    unseen = fully_fused_projection(*shapes, np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 100, 70, device=default_device)
    assert unseen.means2d.shape == (0, 400, 2)
    by = unseen.vjp()
    assert not by["means"].any() and by["viewmats"].shape == (0, 4, 4)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"means": np.zeros((3, 4))}, r"means: got shape \(3, 4\), expected \(N, 3\)"),
        ({"means": np.full((400, 3), np.nan)}, r"means: \[0, 0\] is nan, expected finite numbers"),
        ({"means": np.full((400, 3), 1e300)}, r"means: \[0, 0\] is 1e\+300, expected finite numbers"),
        ({"means": [["a"] * 3] * 400}, "means: got <U1, expected an array of real numbers"),
        ({"quaternions": None}, "quaternions is None, expected an array unless covars is given"),
        ({"scales": np.zeros((7, 3))}, r"scales: got shape \(7, 3\), expected \(400, 3\)"),
        ({"covars": np.zeros((400, 6))}, "covars: expected either covars, or quaternions and scales"),
        ({"viewmats": np.eye(4)}, r"intrinsics: got shape \(3, 3, 3\), expected \(1, 3, 3\) or \(3, 3\)"),
        ({"intrinsics": np.zeros((2, 3, 3))}, r"intrinsics: got shape \(2, 3, 3\), expected \(3, 3, 3\) or \(3, 3\)"),
        ({"intrinsics": np.eye(3)}, "intrinsics has 1 matrices, expected 3, one for each matrix of viewmats"),
        ({"intrinsics": np.zeros((3, 3, 3))}, "intrinsics: a focal length is 0"),
        ({"width": 0}, "width is 0, expected a positive whole number"),
        ({"eps2d": -1.0}, r"eps2d is -1.0, expected a number from 0 to 3.4\d*e\+38"),
        ({"radius_clip": float("nan")}, "radius_clip is nan, expected a number from 0 to 3.4"),
        ({"near_plane": 5.0, "far_plane": 2.0}, "near_plane is 5.0 and far_plane is 2.0"),
        ({"camera_model": "ftheta"}, "camera_model is 'ftheta', expected one of pinhole, ortho, fisheye"),
        ({"opacities": np.zeros(3)}, r"opacities: got shape \(3,\), expected \(400,\)"),
    ],
)
def test_errors_name_the_argument(changes: dict[str, Any], told: str) -> None:
    viewmats, intrinsics = three_views()
    arrays = {"means": SUBJECT.means, "covars": None, "quaternions": SUBJECT.quaternions, "scales": SUBJECT.scales}
    given = {**arrays, "viewmats": viewmats, "intrinsics": intrinsics, "width": 100, "height": 70, **changes}
    refuses(told, fully_fused_projection, **given)


def test_errors_of_gradients(default_device: Device) -> None:
    projected = projection(default_device)
    refuses(r"means2d: got shape \(400, 2\), expected \(3, 400, 2\)", projected.vjp, means2d=np.zeros((400, 2)))
    shapes = (SUBJECT.means, None, SUBJECT.quaternions, SUBJECT.scales)
    plain = fully_fused_projection(*shapes, *three_views(), 100, 70, device=default_device)
    refuses("compensations: got a gradient, expected None", plain.vjp, compensations=np.zeros((3, 400)))
