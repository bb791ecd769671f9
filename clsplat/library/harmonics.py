# SPDX-License-Identifier: Apache-2.0
"""Colours from spherical harmonics, and their vector-Jacobian product."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32
from clsplat.device.buffers import from_host, hosted
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library import checks
from clsplat.library.checks import floats, gradient
from clsplat.library.session import LibrarySession, session_of
from clsplat.stages.harmonics import MAX_SH_BASIS_DEGREE, Harmonics, HarmonicsGradients, harmonics, harmonics_grad


@dataclass(frozen=True, eq=False)
class HarmonicColors:
    """Colours from spherical harmonics.

    Attributes
    ----------
    colors : (..., 3) float32
        The colours; 0 where the mask is False.
    """

    colors: Float32
    _given: Harmonics
    _session: LibrarySession

    def vjp(self, colors: ArrayLike) -> dict[str, Float32]:
        """Compute the vector-Jacobian product.

        Parameters
        ----------
        colors : (..., 3) array_like
            Gradient of the loss with respect to `colors`.

        Returns
        -------
        dict
            float32 gradients "directions" (..., 3) and "coefficients" (..., K, 3). They are zero where the mask is
            False, and for coefficients above the degree.

        Raises
        ------
        InputError
            If the gradient has another shape.
        """
        values = gradient("colors", colors, self.colors.shape)
        if values is None:
            raise InputError("colors is None, expected the gradient with respect to the colours")
        session, given = self._session, self._given
        with session.lock:
            device = session.device
            by_directions, by_sh = hosted(device, given.directions.shape), hosted(device, given.sh.shape)
            d_colours = from_host(device, values.reshape(-1, 3))
            colours = given.directions  # a placeholder: without a camera the kernel reads no colours
            gradients = HarmonicsGradients(by_sh.array, by_directions.array)
            harmonics_grad(device, session.scratch, given, colours, d_colours, gradients)
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
    """Evaluate real spherical harmonics in given directions, with the conventions of gsplat's `spherical_harmonics`.

    Parameters
    ----------
    degree : int
        Highest degree used, 0 to 4.
    directions : (..., 3) array_like
        Directions of any length. At length 0 only degree 0 is used.
    coefficients : (..., K, 3) array_like
        K is at least (degree + 1)^2.
    masks : (...) array_like of bool, optional
        Where it is False the colour is 0 and there is no gradient.
    device : Device or str, optional
        An open device, or a name as `clsplat devices` lists them.

    Returns
    -------
    HarmonicColors
        The colours, which are the bare sums. A model's colours have 0.5 added.

    Raises
    ------
    InputError
        If a shape or degree is wrong, or numbers are not finite. The message names the argument.
    DeviceError
        If there is no such device.

    Notes
    -----
    Signs and order of the basis are in docs/conventions.md. float32 arrays may be read in place, and must not change
    before the last `vjp`.
    """
    batch = np.shape(directions)[:-1]
    given = floats("directions", directions, (*batch, 3))
    degree = checks.degree("degree", degree, MAX_SH_BASIS_DEGREE)
    sh = floats("coefficients", coefficients, (*batch, "K", 3))
    used = (degree + 1) ** 2
    if sh.shape[-2] < used:
        raise InputError(f"coefficients: got K = {sh.shape[-2]}, expected {used} or more for degree {degree}")
    mask = None if masks is None else _mask(masks, batch)
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


def _mask(masks: ArrayLike, batch: tuple[int, ...]) -> NDArray[np.int32]:
    """Return the masks as integers on one axis: 1 where a colour is evaluated, otherwise 0.

    batch: the shape that the masks must have. Raises InputError for another shape.
    """
    shown = np.asarray(masks)
    if shown.shape != batch:
        raise InputError(f"masks: got shape {shown.shape}, expected {batch}")
    return np.ascontiguousarray(shown.reshape(-1) != 0, np.int32)
