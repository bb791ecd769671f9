# SPDX-License-Identifier: Apache-2.0
"""Launches harmonics.cl and harmonics_grad.cl: colours from spherical harmonics, and the gradient.

The directions are given, or are computed from a camera's centre to the means.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.device.buffers import DeviceArray, Workspace, from_host
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.errors import InputError
from clsplat.stages.sums import padded, row_sums

MAX_SH_BASIS_DEGREE = 4
"""The highest degree of spherical harmonics that the kernels support."""


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Input of harmonics.cl and harmonics_grad.cl for n colours.

    directions: (n, 3), of any length.
    sh: (n, K, 3), K at least (degree + 1)^2; further coefficients are ignored.
    mask: (n,) or (n, 2), int32; rows whose first entry is not positive are skipped.
    centre: (6,), a camera's `centre_array`. With it, `directions` holds the means, and colours are increased by 0.5
    and clamped at 0.
    """

    directions: DeviceArray
    sh: DeviceArray
    degree: int
    mask: DeviceArray | None = None
    centre: DeviceArray | None = None

    @property
    def count(self) -> int:
        """Number of colours."""
        return self.directions.shape[0]

    @property
    def used(self) -> int:
        """Number of coefficients per channel that the degree uses. Raises InputError for an unsupported degree."""
        used = (self.degree + 1) ** 2
        if not 0 <= self.degree <= MAX_SH_BASIS_DEGREE:
            raise InputError(f"sh_degree is {self.degree}: expected 0 to {MAX_SH_BASIS_DEGREE}")
        if used > self.sh.shape[1]:
            raise InputError(f"sh_degree is {self.degree}: expected {used} coefficients, got {self.sh.shape[1]}")
        return used

    @property
    def defines(self) -> dict[str, object]:
        """Macros that harmonics.cl and harmonics_grad.cl are both compiled with."""
        wanted = {
            "CAMERA": self.centre is not None,
            "MASKED": self.mask is not None,
            "DEGREE_4": self.degree == MAX_SH_BASIS_DEGREE,
        }
        return {name: True for name, on in wanted.items() if on}

    @property
    def arguments(self) -> tuple[object, ...]:
        """Arguments that both kernels share, after the number of colours."""
        centre = () if self.centre is None else (self.centre,)
        mask = () if self.mask is None else (self.mask.size // max(self.count, 1), self.mask)
        return (self.sh.shape[1], self.used, *centre, self.directions, self.sh, *mask)


@dataclass(frozen=True, eq=False)
class HarmonicsGradients:
    """Gradients with respect to the arrays of `Harmonics`: sh (n, K, 3) and, if requested, directions (n, 3)."""

    sh: DeviceArray
    directions: DeviceArray | None = None


def centre_array(device: Device, position: Float64) -> DeviceArray:
    """A camera's centre in the world on the device, (6,): two floats for each coordinate."""
    high = np.asarray(position, np.float32)
    return from_host(device, np.concatenate([high, (np.asarray(position, np.float64) - high).astype(np.float32)]))


@stage("harmonics")
def harmonics(device: Device, given: Harmonics, colours: DeviceArray) -> None:
    """Compute colours (n, 3); masked rows become 0. Equation (167) of docs/gradients.md."""
    n = given.count
    kernel = device.kernels("harmonics", given.defines).harmonics
    launch_items(device, kernel, -(-n // device.shape.lanes), n, *given.arguments, colours)


@stage("harmonics_grad")
def harmonics_grad(
    device: Device,
    work: Workspace,
    given: Harmonics,
    colours: DeviceArray,
    d_colours: DeviceArray,
    gradients: HarmonicsGradients,
    *,
    add: bool = False,
    add_directions: bool = False,
    by_centre: bool = False,
) -> DeviceArray | None:
    """Compute the gradients with respect to coefficients and directions.

    given, colours: the inputs and the result of `harmonics`.
    d_colours: (n, 3), the gradient with respect to `colours`.
    gradients: filled with the results.
    add: True adds the gradients with respect to coefficients to the values that `gradients` has from earlier cameras.
    add_directions: True does so for the gradients with respect to directions or means.
    by_centre: True returns the gradient (3,) with respect to the camera's centre.

    Equations (38) to (40) and (168).
    """
    n = given.count
    parts = work.array("harmonics_by_centre", (3, padded(n))) if by_centre else None
    d_directions = gradients.directions
    wanted = {
        "ADDED": add,
        "BY_DIRECTION": d_directions is not None or by_centre,
        "ADDED_DIRECTIONS": add_directions,
        "BY_CENTRE": by_centre,
    }
    if by_centre and d_directions is None:
        d_directions = work.array("harmonics_by_direction", (n, 3))
    defines = {**given.defines, **{name: True for name, on in wanted.items() if on}}
    launch_items(
        device,
        device.kernels("harmonics_grad", defines).harmonics_grad,
        -(-padded(n) // device.shape.lanes),
        n,
        padded(n),
        *given.arguments,
        d_colours,
        *([] if given.centre is None else [colours]),
        gradients.sh,
        *([] if d_directions is None else [d_directions]),
        *([] if parts is None else [parts]),
    )
    return None if parts is None else row_sums(device, work, "harmonics", parts)
