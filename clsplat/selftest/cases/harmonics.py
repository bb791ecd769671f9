# SPDX-License-Identifier: Apache-2.0
"""Colours from spherical harmonics, in directions or from a camera, and the gradient back."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.reference.sh import sh_basis_grad
from clsplat.selftest.case import Arrays, Case, Given, Read, Wanted, exactly
from clsplat.selftest.harness import CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.spherical_harmonics import sh_basis
from clsplat.stages.harmonics import (
    MAX_SH_BASIS_DEGREE,
    Harmonics,
    HarmonicsGradients,
    centre_array,
    harmonics,
    harmonics_grad,
)

SH_CENTRE = np.array([0.1, 0.2, 3.3])
"""Of a camera; not one of float32's numbers."""


def random_harmonics(rng: Generator, count: int, degree: int | None = None, *, camera: bool | None = None) -> Given:
    """Colours of a degree, seen from a camera or not, each random unless it is given."""
    degree = int(rng.integers(MAX_SH_BASIS_DEGREE + 1)) if degree is None else degree
    shapes = ((count, 3), (count, 25 if degree == MAX_SH_BASIS_DEGREE else 16, 3), (count, 3))
    directions, sh, by = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    mask = np.repeat((rng.random((count, 1)) < 0.8).astype(np.int32), 2, axis=1)
    centre = SH_CENTRE if (rng.random() < 0.5 if camera is None else camera) else None
    return Given(directions=directions, sh=sh, by=by, mask=mask, degree=degree, centre=centre)


def _frozen(bench: CaseBench) -> list[Given]:
    """Colours of the highest degree in synthetic directions."""
    n = bench.model.count
    shapes = ((n, 3), (n, (MAX_SH_BASIS_DEGREE + 1) ** 2, 3), (n, 3))
    away, sh, by = (evenly(71 + index, shape, -1.0, 1.0).astype(np.float32) for index, shape in enumerate(shapes))
    away[:, 2] += 1.5
    return [Given(directions=away, sh=sh, by=by, mask=None, degree=MAX_SH_BASIS_DEGREE, centre=None)]


def harmonics_inputs(device: Device, given: Given) -> Harmonics:
    """The inputs on the device."""
    mask, centre = None, None
    if given.centre is not None:
        mask, centre = upload(device, given.mask), centre_array(device, given.centre)
    return Harmonics(upload(device, given.directions), upload(device, given.sh), given.degree, mask, centre)


def launch_harmonics(device: Device, work: Workspace, given: Given, *, add: bool = False, start: float = -7.0) -> Read:
    """Launch both kernels, with gradients in arrays that are full of `start`."""
    inputs = harmonics_inputs(device, given)
    shapes = ((inputs.count, 3), given.sh.shape, (inputs.count, 3))
    colours, d_sh, d_directions = (allocate(device, shape, np.float32) for shape in shapes)
    for array in (colours, d_sh, d_directions):
        array.fill(start)
    harmonics(device, inputs, colours)
    by = (colours, upload(device, given.by), HarmonicsGradients(d_sh, d_directions))
    from_centre = given.centre is not None
    by_centre = harmonics_grad(device, work, inputs, *by, add=add, add_directions=add, by_centre=from_centre)
    made = {"colours": colours, "sh": d_sh, "directions": d_directions}
    made |= {} if by_centre is None else {"centre": by_centre}
    return lambda: {name: array.get() for name, array in made.items()}


def _twin(given: Given, _: Arrays) -> dict[str, Wanted]:
    directions, sh, d_colours = given.wide("directions", "sh", "by")
    away, used = directions - (0.0 if given.centre is None else given.centre), (given.degree + 1) ** 2
    length = np.linalg.norm(away, axis=1, keepdims=True)
    unit, sh = away / length, sh[:, :used]
    basis, slopes = sh_basis(unit, given.degree), sh_basis_grad(unit, given.degree)
    colours = np.einsum("nk,nkc->nc", basis, sh)
    if given.centre is not None:
        shown = given.mask[:, :1] > 0
        colours = np.where(shown, np.maximum(colours + 0.5, 0.0), 0.0)
        d_colours = np.where(colours > 0, d_colours, 0.0)
    d_sh = np.zeros(given.sh.shape)
    d_sh[:, :used] = basis[:, :, None] * d_colours[:, None]
    by_unit = np.einsum("nkd,nkc,nc->nd", slopes, sh, d_colours)
    d_directions = (by_unit - unit * (unit * by_unit).sum(axis=1, keepdims=True)) / length
    # sums of up to 25 products of size 1, each off by 1e-7
    wanted = {"colours": Wanted(colours, 4e-6, 1.0), "sh": Wanted(d_sh, 2e-6)}
    wanted["directions"] = Wanted(d_directions, 2e-6) if given.degree else exactly(np.zeros_like(d_directions))
    if given.centre is not None:
        wanted["centre"] = Wanted(-d_directions.sum(axis=0), 2e-6, (np.abs(by_unit) / length).sum(axis=0))
    return wanted


HARMONICS_CASE = Case(
    sizes=(1, 64, 65, 300, 63, 0, 513),
    random=random_harmonics,
    launch=launch_harmonics,
    twin=_twin,
    frozen=_frozen,
    digested=("colours", "sh", "directions"),
)
