# SPDX-License-Identifier: Apache-2.0
"""harmonics.cl and harmonics_grad.cl against float64 sums of the basis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from compare import assert_close_gradient, assert_same_bits
from numpy.typing import NDArray
from quick import quick

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.reference.sh import sh_basis_grad
from clsplat.spherical_harmonics import sh_basis
from clsplat.stages.harmonics import (
    MAX_SH_BASIS_DEGREE,
    Harmonics,
    HarmonicsGradients,
    centre_array,
    harmonics,
    harmonics_grad,
)

CENTRE = np.array([0.1, 0.2, 3.3])
"""Of a camera; not one of float32's numbers."""


@dataclass(frozen=True, eq=False)
class Subject:
    """directions (n, 3), sh (n, K, 3), mask (n, 2), d_colours (n, 3), and whether a camera looks."""

    directions: Float32
    sh: Float32
    mask: NDArray[np.int32]
    d_colours: Float32
    degree: int
    camera: bool

    def on(self, device: Device) -> Harmonics:
        mask, centre = (upload(device, self.mask), centre_array(device, CENTRE)) if self.camera else (None, None)
        return Harmonics(upload(device, self.directions), upload(device, self.sh), self.degree, mask, centre)

    def wanted(self) -> dict[str, Float64]:
        """Colours and gradients in float64."""
        away = self.directions.astype(np.float64) - (CENTRE if self.camera else 0.0)
        length = np.linalg.norm(away, axis=1, keepdims=True)
        unit, used = away / length, (self.degree + 1) ** 2
        basis, slopes, sh = sh_basis(unit, self.degree), sh_basis_grad(unit, self.degree), self.sh[:, :used]
        colours, d_colours = np.einsum("nk,nkc->nc", basis, sh.astype(np.float64)), self.d_colours.astype(np.float64)
        if self.camera:
            shown = self.mask[:, :1] > 0
            colours = np.where(shown, np.maximum(colours + 0.5, 0.0), 0.0)
            d_colours = np.where(colours > 0, d_colours, 0.0)
        d_sh = np.zeros(self.sh.shape)
        d_sh[:, :used] = basis[:, :, None] * d_colours[:, None]
        by_unit = np.einsum("nkd,nkc,nc->nd", slopes, sh.astype(np.float64), d_colours)
        d_directions = (by_unit - unit * (unit * by_unit).sum(axis=1, keepdims=True)) / length
        return {"colours": colours, "sh": d_sh, "directions": d_directions, "centre": -d_directions.sum(axis=0)}


def subject(count: int, degree: int = 3, *, camera: bool = True) -> Subject:
    rng = np.random.default_rng(count + degree)
    mask = np.repeat((rng.random((count, 1)) < 0.8).astype(np.int32), 2, axis=1)
    shapes = ((count, 3), (count, 25 if degree == MAX_SH_BASIS_DEGREE else 16, 3), (count, 3))
    directions, sh, by = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    return Subject(directions, sh, mask, by, degree, camera)


def run(device: Device, given: Subject, *, add: bool = False, start: float = -7.0) -> dict[str, NDArray[Any]]:
    """Results of the kernels, the gradients in arrays that are full of `start`."""
    inputs, work = given.on(device), Workspace(device)
    colours, d_sh, d_directions = (
        allocate(device, shape, np.float32) for shape in ((inputs.count, 3), given.sh.shape, (inputs.count, 3))
    )
    for array in (colours, d_sh, d_directions):
        array.fill(start)
    harmonics(device, inputs, colours)
    by = (colours, upload(device, given.d_colours), HarmonicsGradients(d_sh, d_directions))
    by_centre = harmonics_grad(device, work, inputs, *by, add=add, add_directions=add, by_centre=given.camera)
    found = {"colours": colours.get(), "sh": d_sh.get(), "directions": d_directions.get()}
    return found if by_centre is None else {**found, "centre": by_centre.get()}


@pytest.mark.parametrize("camera", quick([False, True], True))
@pytest.mark.parametrize("degree", range(MAX_SH_BASIS_DEGREE + 1))
def test_the_kernels_against_float64(shaped_device: Device, degree: int, camera: bool) -> None:
    given = subject(300, degree, camera=camera)
    found, wanted = run(shaped_device, given), given.wanted()
    # sums of up to 25 products of size 1, each off by 1e-7
    np.testing.assert_allclose(found["colours"], wanted["colours"], atol=4e-6)
    for name in ("sh", *(["directions", *(["centre"] if camera else [])] if degree else [])):
        assert_close_gradient(found[name], wanted[name], 2e-6, name=name)
    assert not found["sh"][:, (degree + 1) ** 2 :].any()
    if camera:
        hidden = given.mask[:, 0] == 0
        assert not (found["colours"][hidden].any() or found["sh"][hidden].any() or found["directions"][hidden].any())
        assert (found["colours"] == 0).sum() > 3 * hidden.sum()


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 513])
def test_sizes_at_the_seams(shaped_device: Device, count: int) -> None:
    given = subject(count)
    found, wanted = run(shaped_device, given), given.wanted()
    np.testing.assert_allclose(found["colours"], wanted["colours"], atol=4e-6)
    np.testing.assert_allclose(found["sh"], wanted["sh"], atol=2e-6)
    np.testing.assert_allclose(found["directions"], wanted["directions"], atol=1e-5)
    np.testing.assert_allclose(found["centre"], wanted["centre"], atol=1e-4)


def test_every_shape_has_the_same_bits(device: Device) -> None:
    given = subject(300)
    first, second = (run(other, given) for other in (device, device.with_shape("1x64")))
    for name, values in first.items():
        assert_same_bits(second[name], values, name)


def test_gradients_of_cameras_add_up(device: Device) -> None:
    given = subject(200)
    once, twice = run(device, given), run(device, given, add=True, start=2.0)
    for name in ("sh", "directions"):
        np.testing.assert_array_equal(twice[name], np.float32(2.0) + once[name])
    np.testing.assert_array_equal(twice["centre"], once["centre"])


def test_what_is_hidden_may_be_no_number(shaped_device: Device) -> None:
    given = subject(65)
    hidden = given.mask[:, 0] == 0
    for array in (given.directions, given.sh, given.d_colours):
        array[hidden] = np.nan
    found = run(shaped_device, given)
    assert all(np.isfinite(values).all() for values in found.values())
    assert found["centre"].any()


@pytest.mark.parametrize("degree", quick(range(MAX_SH_BASIS_DEGREE + 1), 3))
def test_no_direction_has_the_first_coefficient_alone(device: Device, degree: int) -> None:
    given = replace(subject(64, degree, camera=False), directions=np.zeros((64, 3), np.float32))
    found = run(device, given)
    basis = sh_basis(np.zeros((1, 3)), degree)
    np.testing.assert_allclose(found["colours"], basis[0, 0] * given.sh[:, 0], rtol=1e-6, atol=1e-7)
    assert not found["directions"].any()


def test_degrees_that_there_are_not(default_device: Device) -> None:
    given = subject(1)
    with pytest.raises(InputError, match="sh_degree is 5: expected 0 to 4"):
        _ = replace(given, degree=5).on(default_device).used
    with pytest.raises(InputError, match="sh_degree is 2: expected 9 coefficients, got 4"):
        _ = replace(given, degree=2, sh=np.ascontiguousarray(given.sh[:, :4])).on(default_device).used
