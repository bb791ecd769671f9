# SPDX-License-Identifier: Apache-2.0
"""The region of a scene in which a training changes Gaussians. Gaussians outside it are drawn but stay as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Bool, Float32, Float64, numbers
from clsplat.errors import InputError


@dataclass(frozen=True, eq=False)
class TrainedRegion:
    """A rectangle on the ground, open above and below, in which a training changes Gaussians.

    A Gaussian is inside if low <= dot(axis, mean) < high holds for both axes. Gaussians outside are frozen: they are
    drawn, but get no gradients, are neither cloned, split, pruned nor reset, and are dropped at the end of training.

    axes: (2, 3), two horizontal directions in world coordinates. The dot products have the unit of low and high.
    low, high: (2,), edges along the axes; -inf and inf for no edge.
    Kernels and `numbers` expect a region in the coordinates of the model's means (`relative_to`).
    """

    axes: Float64
    low: Float64
    high: Float64

    def __post_init__(self) -> None:
        for name, shape in (("axes", (2, 3)), ("low", (2,)), ("high", (2,))):
            given = getattr(self, name)
            array = numbers(np.asarray(given).tolist())
            if array.shape != shape or np.isnan(array).any() or (name == "axes" and not np.isfinite(array).all()):
                raise InputError(f"region: {name} is {given!r:.100}, expected {shape} numbers")
            object.__setattr__(self, name, array)
        if not (self.low < self.high).all():
            raise InputError(f"region: low is {self.low.tolist()} and high {self.high.tolist()}, expected low < high")

    def coordinates(self, means: Float32) -> Float32:
        """Coordinates (n, 2) of means (n, 3) along the axes, with the bits of `region_coordinate` in
        kernels/shared/region.h. Means relative to an origin give coordinates relative to the same origin."""
        axes, x = self.axes.astype(np.float32), np.asarray(means, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            found = [(x[:, 0] * a[0] + x[:, 1] * a[1]) + x[:, 2] * a[2] for a in axes]
        return np.stack(found, axis=1)

    def contains(self, means: Float32, origin: Sequence[float] | Float64 = (0.0, 0.0, 0.0)) -> Bool:
        """Mask (n,), True for means (n, 3) inside, as the kernels decide it; False for means that are not finite.

        origin: world coordinates of the means' origin (`Gaussians.origin`).
        """
        local, found = self.relative_to(origin), self.coordinates(means)
        low, high = local.low.astype(np.float32), local.high.astype(np.float32)
        return np.asarray(((low <= found) & (found < high)).all(axis=1))

    def relative_to(self, origin: Sequence[float] | Float64) -> TrainedRegion:
        """The same region for means that are relative to `origin`, in world coordinates."""
        shift = self.axes @ np.asarray(origin, np.float64)
        return replace(self, low=self.low - shift, high=self.high - shift)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Arguments of the kernels (REGION_PARAMETERS in kernels/shared/region.h): axis, low and high of each axis."""
        rows = np.concatenate([self.axes, self.low[:, None], self.high[:, None]], axis=1).astype(np.float32)
        return tuple(float(number) for number in rows.ravel())
