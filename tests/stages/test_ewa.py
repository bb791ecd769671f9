# SPDX-License-Identifier: Apache-2.0
"""ewa.cl and ewa_grad.cl against the float64 twin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from compare import assert_close_gradient, relative_error
from ewa_cases import MODELS, OUTPUTS, Case, case, gradients
from numpy.typing import NDArray
from quick import quick

from clsplat.arrays import Float64
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.layouts.columns import EWA_GRADIENT, SUM_ROWS
from clsplat.reference import ewa as twin
from clsplat.stages.ewa import (
    Ewa,
    EwaCamera,
    EwaGradients,
    EwaImageGradients,
    EwaInputs,
    PlacedEwaCamera,
    camera_gradients,
    ewa,
    ewa_grad,
)
from clsplat.stages.sums import padded, row_sums

WAYS = [(model, covariances, full) for model in MODELS for covariances in (False, True) for full in (False, True)]
"""Camera model, covariances in place of quaternions and scales, opacities and compensations."""
FIRST, OTHERS = ("pinhole", False, True), [("fisheye", True, True), ("ortho", False, False)]
"""Of the quick run: in every shape, and in a device's own."""


def camera_of(view: twin.EwaViewTwin) -> EwaCamera:
    planes = (view.near, view.far, view.eps2d, view.radius_clip)
    return EwaCamera(view.viewmat, view.intrinsics, view.width, view.height, *planes, view.model)


def filled(device: Device, *shape: int, kind: type[np.generic] = np.float32) -> DeviceArray:
    array = allocate(device, shape, kind)
    array.fill(-7)
    return array


@dataclass
class Run:
    """A case on a device: what it was given, and what came of it."""

    device: Device
    inputs: EwaInputs
    camera: PlacedEwaCamera
    arrays: Ewa

    @classmethod
    def of(cls, device: Device, subject: Case, *, covariances: bool = False, full: bool = False) -> Run:
        camera, n = camera_of(subject.view), subject.count
        shapes = ["covariances"] if covariances else ["quaternions", "scales"]
        names = ["means", *shapes, *(["opacities"] if full else [])]
        inputs = EwaInputs(**{name: upload(device, getattr(subject, name)) for name in names})
        arrays = Ewa(
            filled(device, n, 2, kind=np.int32),
            filled(device, n, 2),
            filled(device, n),
            filled(device, n, 3),
            filled(device, n) if full else None,
        )
        run = cls(device, inputs, PlacedEwaCamera.on(device, camera), arrays)
        ewa(device, inputs, run.camera, arrays)
        return run

    def get(self, name: str) -> NDArray[Any]:
        return np.asarray(getattr(self.arrays, name).get())

    def gradient(
        self, by: dict[str, NDArray[np.float32]], into: EwaGradients | None = None, *, add: bool = False
    ) -> tuple[dict[str, NDArray[Any]], Float64, Float64]:
        """Gradients by Gaussians, by the view matrix and by the intrinsics."""
        n, device = self.inputs.count, self.device
        if into is None:
            shapes = {"covariances": 6} if self.inputs.covariances is not None else {"quaternions": 4, "scales": 3}
            into = EwaGradients(**{name: filled(device, n, width) for name, width in {"means": 3, **shapes}.items()})
        given = EwaImageGradients(**{name: upload(device, values) for name, values in by.items()})
        where = (self.camera, self.arrays, given, into)
        sums = ewa_grad(device, Workspace(device), self.inputs, *where, add=add, by_camera=True)
        assert sums is not None
        arrays = {name: array.get() for name, array in vars(into).items() if array is not None}
        return arrays, *camera_gradients(sums.get())


def assert_projected(run: Run, wanted: twin.EwaProjectedTwin, *, compensated: bool) -> None:
    """Radii are those of the twin but where a side is within rounding of a whole pixel; what only one of them culls is
    one of those."""
    radii = run.get("radii")
    assert (np.abs(radii - wanted.radii) > 1).sum() <= 2
    assert (radii != wanted.radii).sum() <= 2 + len(radii) // 500
    seen = wanted.visible & (radii[:, 0] > 0)
    assert seen.sum() >= 0.2 * len(radii)
    # of places up to 2000 pixels away a float's last digit is 1.2e-4, of the fisheye's angle two of those
    far = np.maximum(np.abs(wanted.means2d[seen]), 100)
    assert (np.abs(run.get("means2d")[seen] - wanted.means2d[seen]) <= 1.8e-7 * far).all()
    np.testing.assert_allclose(run.get("depths")[seen], wanted.depths[seen], rtol=2e-7)
    size = np.linalg.norm(wanted.conics[seen], axis=1)
    off = np.linalg.norm(run.get("conics")[seen] - wanted.conics[seen], axis=1) / size
    # rounding, times the ellipse's length over its width: up to 64, from where on it is made good in two floats
    assert off.max(initial=0) <= 3e-5 and (off.size == 0 or np.quantile(off, 0.98) <= 3e-6)
    if compensated:
        np.testing.assert_allclose(run.get("compensations")[seen], wanted.compensations[seen], rtol=3e-5, atol=1e-7)
    for name in ("means2d", "depths", "conics", *(["compensations"] if compensated else [])):
        assert not run.get(name)[radii[:, 0] == 0].any()


@pytest.mark.parametrize("way", quick(WAYS, FIRST))
def test_the_kernels_against_the_twin(shaped_device: Device, way: tuple[str, bool, bool]) -> None:
    check_kernels(shaped_device, *way)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 513])
def test_sizes_at_the_seams(shaped_device: Device, count: int) -> None:
    check_kernels(shaped_device, "pinhole", False, True, count=count)


@pytest.mark.parametrize("way", OTHERS)
def test_other_models_against_the_twin(device: Device, way: tuple[str, bool, bool]) -> None:
    check_kernels(device, *way)


def check_kernels(device: Device, model: str, covariances: bool, full: bool, *, count: int = 700) -> None:
    subject = case(count, model)
    run = Run.of(device, subject, covariances=covariances, full=full)
    wanted = subject.projected(rounded=covariances, opacities=full, compensated=full)
    assert_projected(run, wanted, compensated=full)

    seen = run.get("radii")
    wanted = replace(wanted, radii=seen)  # with that of the gradient too
    names = OUTPUTS if full else OUTPUTS[:3]
    by = gradients(wanted, *names)
    arrays, by_viewmat, by_intrinsics = run.gradient(by)
    means, full_covariances = subject.means.astype(np.float64), subject.full(rounded=covariances)
    shown = {name: np.nan_to_num(values.astype(np.float64)) for name, values in by.items()}
    result = twin.project_grad(means, full_covariances, subject.view, wanted, shown)
    expected = {"means": result["means"]}
    if covariances:
        expected["covariances"] = twin.upper_gradients(result["covariances"])
    else:
        shapes = (subject.quaternions.astype(np.float64), subject.scales.astype(np.float64), result["covariances"])
        expected["quaternions"], expected["scales"] = twin.covariances_grad(*shapes)
    if not seen.any():
        assert not any(values.any() for values in (*arrays.values(), by_viewmat, by_intrinsics))
        return
    for name, values in expected.items():
        # means and sums are of many terms, of rounding each; shapes as the conics, by the Gaussians that weigh most
        assert_close_gradient(arrays[name], values, 1e-6 if name == "means" else 2e-5, name=name)
        assert not arrays[name][seen[:, 0] == 0].any()
    assert_close_gradient(by_viewmat, result["viewmat"], 2e-6, name="viewmat")
    assert_close_gradient(by_intrinsics, result["intrinsics"], 2e-6, name="intrinsics")


def test_gradients_of_cameras_add_up(device: Device) -> None:
    """Culled rows stay as they were."""
    subject = case(200)
    run = Run.of(device, subject, full=True)
    by = gradients(replace(subject.projected(), radii=run.get("radii")), *OUTPUTS)
    once, by_viewmat, _ = run.gradient(by)
    start = {name: np.full_like(values, 2.0) for name, values in once.items()}
    into = EwaGradients(**{name: upload(device, values) for name, values in start.items()})
    twice, again, _ = run.gradient(by, into, add=True)
    for name, values in once.items():
        np.testing.assert_array_equal(twice[name], start[name] + values)
    np.testing.assert_array_equal(again, by_viewmat)


def test_what_is_no_number_is_culled_alone(shaped_device: Device) -> None:
    subject = case(65)
    subject.means[3], subject.scales[5], subject.opacities[7] = np.nan, np.inf, np.nan
    subject.quaternions[11], subject.means[13, 0], subject.quaternions[17] = 0.0, np.inf, np.nan
    run = Run.of(shaped_device, subject, full=True)
    bad = [3, 5, 7, 11, 13, 17]
    assert not run.get("radii")[bad].any()
    wanted = replace(case(65).projected(), radii=run.get("radii"))
    arrays, by_viewmat, by_intrinsics = run.gradient(gradients(wanted, *OUTPUTS))
    assert all(np.isfinite(run.get(name)).all() for name in OUTPUTS)
    assert all(np.isfinite(values).all() and not values[bad].any() for values in arrays.values())
    assert np.isfinite(by_viewmat).all() and np.isfinite(by_intrinsics).all() and by_viewmat.any()


def test_needles_and_discs(shaped_device: Device) -> None:
    """Standard deviations that differ by up to 1e4, up to 1,000 pixels long."""
    subject = case(600, thin=2.5, size=(640, 480))
    subject.opacities[:] = 1.0
    run, wanted = Run.of(shaped_device, subject, full=True), subject.projected()
    both = wanted.visible & (run.get("radii")[:, 0] > 0)
    size = np.linalg.norm(wanted.conics[both], axis=1)
    off = np.linalg.norm(run.get("conics")[both] - wanted.conics[both], axis=1) / size
    assert off.max() <= 3e-5 and np.median(off) <= 1e-6  # rounding times 64, as above


def test_flat_gaussians_and_points_have_gradients(device: Device) -> None:
    """Scales of 0: what is seen is the low-pass's, and compensations end at 0, where they have no slope."""
    subject = case(64)
    subject.scales[::2, 0] = subject.scales[1::2] = 0.0
    subject.opacities[:] = 1.0
    run = Run.of(device, subject)
    by = gradients(replace(subject.projected(), radii=run.get("radii")), *OUTPUTS)
    arrays, by_viewmat, _ = run.gradient(by)
    assert all(np.isfinite(values).all() for values in arrays.values()) and np.isfinite(by_viewmat).all()
    assert arrays["scales"].any() and not arrays["scales"][1::2].any()


def test_a_tiny_quaternion_turns_as_its_direction(shaped_device: Device) -> None:
    subject = case(64)
    small = replace(subject, quaternions=subject.quaternions * np.float32(2.0**-20))
    plain, other = (Run.of(shaped_device, each, full=True) for each in (subject, small))
    np.testing.assert_array_equal(plain.get("conics"), other.get("conics"))
    by = gradients(replace(subject.projected(), radii=plain.get("radii")), *OUTPUTS)
    found = [run.gradient(by)[0]["quaternions"] for run in (plain, other)]
    assert relative_error(found[1] * np.float32(2.0**-20), found[0]) <= 1e-6


@pytest.mark.parametrize("count", [0, 1, SUM_ROWS, SUM_ROWS + 1, SUM_ROWS**2 + 1])
def test_sums_of_rows(shaped_device: Device, count: int) -> None:
    rows = len(EWA_GRADIENT)
    parts = np.zeros((rows, padded(count)), np.float32)
    parts[:, :count] = np.random.default_rng(count).normal(size=(rows, count))
    work = Workspace(shaped_device)
    result = row_sums(shaped_device, work, "test", upload(shaped_device, parts)).get()
    assert result.shape == (rows,)
    # partial sums of 64 neighbours at a time are off by a few last digits of the terms' size
    np.testing.assert_allclose(result, parts.sum(axis=1, dtype=np.float64), atol=1e-6 * max(count, 1) ** 0.5 * 4)


def test_a_model_that_is_none(default_device: Device) -> None:
    view = case(1).view
    camera = replace(camera_of(view), model="panorama")
    inputs = EwaInputs(allocate(default_device, (1, 3), np.float32))
    with pytest.raises(InputError, match="panorama': expected one of pinhole"):
        _ = camera.defines
    with pytest.raises(InputError, match="either quaternions and scales, or covariances"):
        _ = inputs.shapes


def test_the_centre_s_gradient_is_that_of_the_inverse() -> None:
    camera, by = camera_of(case(1).view), np.array([0.3, -0.2, 0.5])
    gradient = camera.position_gradient(by)
    for place in np.ndindex(4, 4):
        step = np.zeros((4, 4))
        step[place] = 1e-6
        ends = [replace(camera, viewmat=camera.viewmat + s * step).position @ by for s in (1, -1)]
        assert abs((ends[0] - ends[1]) / 2e-6 - gradient[place]) < 1e-8
