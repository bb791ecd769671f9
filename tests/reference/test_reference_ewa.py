# SPDX-License-Identifier: Apache-2.0
"""The float64 twin of EWA projection against closed forms, and its gradient against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ewa_cases import MODELS, OUTPUTS, Case, case, gradients

from clsplat.arrays import Float64
from clsplat.reference.ewa import (
    EwaViewTwin,
    covariances_grad,
    covariances_of,
    full_covariances,
    project,
    project_grad,
    upper_gradients,
)

STEP = 1e-6


def loss(case: Case, arrays: dict[str, Float64], by: dict[str, Float64]) -> float:
    """A sum of all outputs of what is seen at first; the set of what is clamped may not change."""
    covariances = (
        covariances_of(arrays["quaternions"], arrays["scales"])
        if "quaternions" in arrays
        else full_covariances(arrays["covars"])
    )
    view = replace(case.view, viewmat=arrays["viewmat"], intrinsics=arrays["intrinsics"])
    projected, plain = project(arrays["means"], covariances, view), case.projected()
    assert (projected.clamped == plain.clamped).all()
    seen = plain.visible
    return sum(float((getattr(projected, name)[seen] * by[name][seen]).sum()) for name in OUTPUTS)


@pytest.mark.parametrize("shape", ["quaternions and scales", "covariances"])
@pytest.mark.parametrize("model", MODELS)
def test_gradients_by_central_differences(model: str, shape: str) -> None:
    subject = case(60, model, thin=0.5)
    means, quaternions, scales = (
        np.asarray(a, np.float64) for a in (subject.means, subject.quaternions, subject.scales)
    )
    full = covariances_of(quaternions, scales)
    projected = project(means, full, subject.view)
    by = {name: values.astype(np.float64) for name, values in gradients(projected, *OUTPUTS).items()}
    assert projected.visible.sum() > 10
    if model == "pinhole":
        assert projected.clamped[projected.visible].any()
    result = project_grad(means, full, subject.view, projected, by)
    arrays = {"means": means, "viewmat": subject.view.viewmat, "intrinsics": subject.view.intrinsics}
    wanted = {"means": result["means"], "viewmat": result["viewmat"], "intrinsics": result["intrinsics"]}
    if shape == "covariances":
        arrays["covars"] = full.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        wanted["covars"] = upper_gradients(result["covariances"])
    else:
        arrays |= {"quaternions": quaternions, "scales": scales}
        wanted["quaternions"], wanted["scales"] = covariances_grad(quaternions, scales, result["covariances"])
    rng = np.random.default_rng(3)
    for name, slope in wanted.items():
        for _ in range(3):
            direction = rng.normal(size=slope.shape) * (np.abs(arrays[name]) if name == "covars" else 1.0)
            shifted = [dict(arrays, **{name: arrays[name] + s * STEP * direction}) for s in (1, -1)]
            difference = (loss(subject, shifted[0], by) - loss(subject, shifted[1], by)) / (2 * STEP)
            # a loss of about 100 with 15 digits leaves 1e-8 of a slope; the third derivative's part is of the same size
            assert abs(difference - (slope * direction).sum()) <= 2e-6 * np.linalg.norm(slope * direction), name


def test_a_ball_before_a_pinhole_camera() -> None:
    view = EwaViewTwin(np.eye(4), np.array([[50.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), 64, 48)
    projected = project(np.array([[0.0, 0, 2]]), 0.04 * np.eye(3)[None], view)
    variances = np.array([(50 * 0.2 / 2) ** 2 + 0.3, (60 * 0.2 / 2) ** 2 + 0.3])
    np.testing.assert_allclose(projected.means2d, [[32, 24]], atol=1e-12)
    np.testing.assert_allclose(projected.conics, [[1 / variances[0], 0, 1 / variances[1]]], rtol=1e-12)
    np.testing.assert_array_equal(projected.radii, [np.ceil(3.33 * np.sqrt(variances))])
    wanted = np.sqrt((variances - 0.3).prod() / variances.prod())
    np.testing.assert_allclose(projected.compensations, [wanted], rtol=1e-12)


def test_radii_end_where_alpha_is_a_255th() -> None:
    view = EwaViewTwin(np.eye(4), np.array([[50.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), 64, 48)
    means, covariances = np.tile([0.0, 0, 2], (4, 1)), np.tile(0.04 * np.eye(3), (4, 1, 1))
    projected = project(means, covariances, view, np.array([1.0, 0.1, 1.001 / 255, 0.999 / 255]))
    sigma = np.sqrt((50 * 0.1) ** 2 + 0.3)
    reach = np.minimum(np.sqrt(2 * np.log(255 * np.array([1.0, 0.1, 1.001 / 255]))), 3.33)
    np.testing.assert_array_equal(projected.radii[:3, 0], np.ceil(sigma * reach))
    assert projected.radii[3].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("mean", "changes"),
    [
        ([0, 0, 0.009], {}),
        ([0, 0, -2], {}),
        ([0, 0, 5], {"far": 4.0}),
        ([9, 0, 2], {}),
        ([0, 0, 2], {"radius_clip": 100.0}),
    ],
)
def test_what_is_culled(mean: list[float], changes: dict[str, float]) -> None:
    view = EwaViewTwin(np.eye(4), np.array([[50.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]), 64, 48, **changes)  # type: ignore[arg-type]
    projected = project(np.array([mean], float), 0.04 * np.eye(3)[None], view)
    assert projected.radii.tolist() == [[0, 0]]


def test_a_fisheye_near_its_axis_is_a_pinhole_camera() -> None:
    """Angle and tangent part by a third of the angle's square, 1e-6 here, and the Jacobian by its square."""
    subject = case(1)
    means, full = np.array([[1e-3, 2e-3, 2.0]]), subject.full(rounded=False)
    views = [EwaViewTwin(np.eye(4), subject.view.intrinsics, 100, 70, model) for model in ("pinhole", "fisheye")]
    plain, bent = (project(means, full, view) for view in views)
    np.testing.assert_allclose(bent.means2d, plain.means2d, atol=1e-6)
    np.testing.assert_allclose(bent.conics, plain.conics, rtol=2e-5)


def test_a_fisheye_s_series_and_its_closed_form_meet() -> None:
    """At the angle where one gives way to the other, both good to 1e-12."""
    view = EwaViewTwin(np.eye(4), case(1).view.intrinsics, 100, 70, "fisheye")
    places = np.array([[np.sqrt(1e-3) * (1 + s), 0, 1.0] for s in (-1e-9, 1e-9)])
    projected = project(places, np.tile(0.01 * np.eye(3), (2, 1, 1)), view)
    np.testing.assert_allclose(projected.jacobians[0], projected.jacobians[1], rtol=1e-7, atol=1e-7)
