# SPDX-License-Identifier: Apache-2.0
"""Loss terms in addition to L1 and D-SSIM. Launches alpha_loss.cl and depth_loss.cl; a new term is a class here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.layouts.columns import TILE
from clsplat.stages.blend import Blended

ALPHA_PIXEL_BYTES = 9
"""Bytes of the alpha loss per pixel, padding included: alpha, its gradient and, rounded up, the partial sums."""
DEPTH_PIXEL_BYTES = 17
"""Bytes of the depth loss per pixel, padding included: nearness, its gradient, target and weight, and the partial
sums, rounded up."""


@dataclass(frozen=True, eq=False)
class Compared:
    """A render and its photograph, the inputs and outputs of a loss term.

    target: planes (3 or 4, rows, stride) of the photograph; the fourth is its alpha. If no term reads alpha, `target`
    may be the photograph itself, (height, width, 3).
    gradient: planes (3 + terms, rows, stride); each term writes its own plane.
    sums: all partial sums of the loss; each term writes `rows / TILE * stride` of them.
    pixels: number of pixels that no mask excludes.
    """

    device: Device
    work: Workspace
    blended: Blended
    target: DeviceArray
    gradient: DeviceArray
    sums: DeviceArray
    pixels: float


class LossTerm:
    """A loss term. Its value is weight * (sum of its partial sums) / divisor; `scale` returns weight and divisor."""

    wants_alpha = False
    """True if the term reads the photograph's alpha, the fourth plane of the target."""

    @property
    def key(self) -> object:
        """Settings that the launch depends on. A command buffer replays the launch only if they have not changed. None
        prevents replays."""
        return None

    def scale(self, pixels: float) -> tuple[float, float]:
        """Return (weight, divisor): the sum of the partial sums is multiplied by the weight and divided by the divisor.

        pixels: number of pixels that no mask excludes.
        """
        raise NotImplementedError

    def launch(self, compared: Compared, plane: int, first: int) -> None:
        """Launch the term's kernel, which writes the plane with index `plane` of `compared.gradient`, and the term's
        partial sums to `compared.sums` from index `first` on."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class RenderTerms:
    """Loss terms to add to L1 and D-SSIM, and the render that they read."""

    blended: Blended
    terms: Sequence[LossTerm]


@dataclass(frozen=True)
class AlphaTerm(LossTerm):
    """Weighted mean absolute difference between the alpha of the render and of the photograph."""

    weight: float
    wants_alpha = True

    @property
    def key(self) -> object:
        """The weight, the only setting that the launch depends on."""
        return self.weight

    def scale(self, pixels: float) -> tuple[float, float]:
        """Return (weight, pixels): the sum of the partial sums is multiplied by the weight and divided by the number of
        pixels."""
        return self.weight, pixels

    def launch(self, compared: Compared, plane: int, first: int) -> None:
        """Launch alpha_loss.cl, which writes the fourth plane of the gradient."""
        assert plane == compared.target.shape[0] - 1 == 3, "alpha is the plane after the colours"
        _, rows, stride = compared.target.shape
        blended, kernel = compared.blended, compared.device.kernels("alpha_loss").alpha_loss
        planes = (blended.stops, blended.transmittance, compared.target, compared.gradient, compared.sums)
        scale = self.weight / compared.pixels
        launch_grid(compared.device, kernel, (stride, rows // TILE), stride, rows, first, scale, *planes)


@dataclass(frozen=True, eq=False)
class DepthTerm(LossTerm):
    """Weighted sum of absolute differences between the render's nearness, 1 / depth, and known values.

    planes: (2, rows, stride) float32, nearness and weight; the weight is 0 where nearness is unknown.
    factor: weight of the sum in the loss.
    """

    planes: NDArray[np.float32]
    factor: float

    def scale(self, pixels: float) -> tuple[float, float]:  # noqa: ARG002
        """Return (factor, 1): the factor already contains the division by the number of pixels."""
        return self.factor, 1.0

    def launch(self, compared: Compared, plane: int, first: int) -> None:
        """Upload the known nearness and its weights, and launch depth_loss.cl."""
        blended, (_, rows, stride) = compared.blended, compared.gradient.shape
        assert blended.nearness is not None, "the depth loss needs an image blended with nearness"
        aims = compared.work.array("depth_aims", (2, rows, stride))
        aims.send(self.planes)
        kernel = compared.device.kernels("depth_loss").depth_loss
        planes = (blended.stops, blended.nearness, aims, compared.gradient, compared.sums)
        launch_grid(compared.device, kernel, (stride, rows // TILE), stride, rows, plane, first, self.factor, *planes)
