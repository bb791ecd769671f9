# SPDX-License-Identifier: Apache-2.0
"""Colours of spherical harmonics, and their vector-Jacobian product."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clsplat.arrays import Float32
from clsplat.device.buffers import from_host, hosted
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library import checks
from clsplat.library.checks import floats, gradient
from clsplat.library.session import Session, session_of
from clsplat.stages.harmonics import HIGHEST, Harmonics, harmonics, harmonics_grad


@dataclass(frozen=True, eq=False)
class HarmonicColors:
    """colors (..., 3), 0 where the mask is."""

    colors: Float32
    _given: Harmonics
    _session: Session

    def vjp(self, colors: ArrayLike) -> dict[str, Float32]:
        """The vector-Jacobian product: gradients by `directions` (..., 3) and `coefficients` (..., K, 3), zero where
        the mask is and for degrees that are not looked at; colors (..., 3): the gradient by the colours. Raises
        InputError for another shape."""
        values = gradient("colors", colors, self.colors.shape)
        if values is None:
            raise InputError("colors: expected the gradient by them")
        session, given = self._session, self._given
        with session.lock:
            device = session.device
            by_directions, by_sh = hosted(device, given.directions.shape), hosted(device, given.sh.shape)
            d_colours = from_host(device, values.reshape(-1, 3))
            unused = given.directions  # of a camera alone
            harmonics_grad(device, session.scratch, given, unused, d_colours, by_sh.array, by_directions.array)
            batch = self.colors.shape[:-1]
            return {
                "directions": np.asarray(by_directions.get(), np.float32).reshape(*batch, 3),
                "coefficients": np.asarray(by_sh.get(), np.float32).reshape(*batch, *given.sh.shape[1:]),
            }


def spherical_harmonics(
    degree: int,
    directions: ArrayLike,
    coefficients: ArrayLike,
    masks: ArrayLike | None = None,
    *,
    device: Device | str | None = None,
) -> HarmonicColors:
    """Sum up real spherical harmonics in directions, by the conventions of gsplat's function of that name.

    degree: the highest that is looked at, 0 to 4; directions (..., 3), of any length; in the direction of length 0
    degree 0 counts alone. coefficients (..., K, 3), K at least (degree + 1)^2; masks (...): what is false has the
    colour 0 and no gradient. The signs and the order of the basis are in docs/conventions.md; there is no 0.5 more.
    Float32 arrays are read in place, and must not change before the last `vjp`.

    Raises InputError, which names the argument, for wrong shapes, degrees and numbers that are not finite, DeviceError
    for a device that is not there.
    """
    batch = np.shape(directions)[:-1]
    given = floats("directions", directions, (*batch, 3))
    degree = checks.degree("degree", degree, HIGHEST)
    sh = floats("coefficients", coefficients, (*batch, "K", 3))
    used = (degree + 1) ** 2
    if sh.shape[-2] < used:
        raise InputError(f"coefficients: got {sh.shape[-2]} of them, expected {used} or more for degree {degree}")
    mask = None
    if masks is not None:
        shown = np.asarray(masks)
        if shown.shape != batch:
            raise InputError(f"masks: got shape {shown.shape}, expected {batch}")
        mask = np.ascontiguousarray(shown.reshape(-1) != 0, np.int32)
    session = session_of(device)
    with session.lock:
        inputs = Harmonics(
            from_host(session.device, given.reshape(-1, 3)),
            from_host(session.device, sh.reshape(-1, *sh.shape[-2:])),
            degree,
            None if mask is None else from_host(session.device, mask),
        )
        colours = hosted(session.device, inputs.directions.shape)
        harmonics(session.device, inputs, colours.array)
        return HarmonicColors(np.asarray(colours.get(), np.float32).reshape(*batch, 3), inputs, session)
