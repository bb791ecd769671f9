# SPDX-License-Identifier: Apache-2.0
"""harmonics.cl and harmonics_grad.cl: every degree, and what colours and gradients do not depend on."""

from __future__ import annotations

import numpy as np
import pytest
from quick import quick

from clsplat.device.buffers import Workspace
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.selftest.case import Arrays, Inputs, faults
from clsplat.selftest.cases.library import HARMONICS_CASE, harmonics_inputs, launch_harmonics, random_harmonics
from clsplat.spherical_harmonics import sh_basis
from clsplat.stages.harmonics import MAX_SH_BASIS_DEGREE


def subject(count: int, degree: int = 3, *, camera: bool = True) -> Inputs:
    return random_harmonics(np.random.default_rng(count + degree), count, degree, camera=camera)


def run(device: Device, given: Inputs, *, add: bool = False, start: float = -7.0) -> Arrays:
    return launch_harmonics(device, Workspace(device), given, add=add, start=start)()


@pytest.mark.parametrize("camera", quick([False, True], True))
@pytest.mark.parametrize("degree", range(MAX_SH_BASIS_DEGREE + 1))
def test_every_degree(shaped_device: Device, degree: int, camera: bool) -> None:
    given = subject(300, degree, camera=camera)
    assert faults(HARMONICS_CASE.errors(shaped_device, given)) == []


def test_gradients_of_cameras_add_up(device: Device) -> None:
    given = subject(200)
    once, twice = run(device, given), run(device, given, add=True, start=2.0)
    for name in ("sh", "directions"):
        np.testing.assert_array_equal(twice[name], np.float32(2.0) + once[name])
    np.testing.assert_array_equal(twice["centre"], once["centre"])


def test_what_is_hidden_may_be_no_number(shaped_device: Device) -> None:
    given = subject(65)
    hidden = given.mask[:, 0] == 0
    for array in (given.directions, given.sh, given.by):
        array[hidden] = np.nan
    found = run(shaped_device, given)
    assert all(np.isfinite(values).all() for values in found.values())
    assert found["centre"].any()


@pytest.mark.parametrize("degree", quick(range(MAX_SH_BASIS_DEGREE + 1), 3))
def test_no_direction_has_the_first_coefficient_alone(device: Device, degree: int) -> None:
    given = subject(64, degree, camera=False)
    given.directions[:] = 0
    found = run(device, given)
    basis = sh_basis(np.zeros((1, 3)), degree)
    np.testing.assert_allclose(found["colours"], basis[0, 0] * given.sh[:, 0], rtol=1e-6, atol=1e-7)
    assert not found["directions"].any()


def test_degrees_that_there_are_not(default_device: Device) -> None:
    given = subject(1)
    given.degree = 5
    with pytest.raises(InputError, match="sh_degree is 5: expected 0 to 4"):
        _ = harmonics_inputs(default_device, given).used
    given.degree, given.sh = 2, np.ascontiguousarray(given.sh[:, :4])
    with pytest.raises(InputError, match="sh_degree is 2: expected 9 coefficients, got 4"):
        _ = harmonics_inputs(default_device, given).used
