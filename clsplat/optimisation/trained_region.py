# SPDX-License-Identifier: Apache-2.0
"""The region of a scene in which a training changes Gaussians. Gaussians outside it are drawn but stay as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from clsplat.arrays import Bool, Float32, Float64, numbers
from clsplat.errors import InputError


@dataclass(frozen=True, eq=False)
class TrainedRegion:
    """A rectangle on the ground, open above and below, in which a training changes Gaussians. It may be limited to
    Gaussians near a centre, or far from it.

    A Gaussian is inside if low <= dot(axis, mean) < high holds for both axes, and nearest <= |mean - centre| <
    farthest. Gaussians outside are frozen: they are drawn, but get no gradients, are neither cloned, split, pruned nor
    reset, and are dropped at the end of training.

    axes: (2, 3), two horizontal directions in world coordinates. The dot products have the unit of low and high.
    low, high: (2,), edges along the axes; -inf and inf for no edge.
    centre: (3,), in world coordinates.
    nearest, farthest: least and largest distance from the centre, in world units; 0 and inf for no limit.
    Kernels and `numbers` expect a region in the coordinates of the model's means (`relative_to`).
    """

    axes: Float64
    low: Float64
    high: Float64
    centre: Float64 = field(default_factory=lambda: np.zeros(3))
    nearest: float = 0.0
    farthest: float = inf

    def __post_init__(self) -> None:
        for name, shape in (("axes", (2, 3)), ("low", (2,)), ("high", (2,)), ("centre", (3,))):
            given = getattr(self, name)
            array = numbers(np.asarray(given).tolist())
            bounds = name in ("low", "high")
            if array.shape != shape or not (np.isfinite(array) | (bounds & np.isinf(array))).all():
                raise InputError(f"region: {name} is {given!r:.100}, expected {shape} numbers")
            object.__setattr__(self, name, array)
        if not (self.low < self.high).all():
            raise InputError(f"region: low is {self.low.tolist()} and high {self.high.tolist()}, expected low < high")
        if not 0 <= self.nearest < self.farthest:
            raise InputError(
                f"region: nearest is {self.nearest!r} and farthest {self.farthest!r}, expected 0 <= nearest < farthest"
            )

    def coordinates(self, means: Float32) -> Float32:
        """Coordinates (n, 2) of means (n, 3) along the axes, with the bits of `region_coordinate` in
        kernels/shared/region.h. Means relative to an origin give coordinates relative to the same origin."""
        axes, x = self.axes.astype(np.float32), np.asarray(means, np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            found = [(x[:, 0] * a[0] + x[:, 1] * a[1]) + x[:, 2] * a[2] for a in axes]
        return np.stack(found, axis=1)

    def squares(self, means: Float32) -> Float32:
        """Squares (n,) of the distances of means (n, 3) from the centre, with the bits of `region_square` in
        kernels/shared/region.h. A square that is no finite number is the largest float32."""
        with np.errstate(over="ignore", invalid="ignore"):
            x = np.asarray(means, np.float32) - self.centre.astype(np.float32)
            found = (x[:, 0] * x[:, 0] + x[:, 1] * x[:, 1]) + x[:, 2] * x[:, 2]
        return np.asarray(np.fmin(found, np.finfo(np.float32).max), np.float32)

    @property
    def _limits(self) -> Float32:
        """Squares (2,) of the least and the largest distance from the centre; infinite beyond float32."""
        with np.errstate(over="ignore"):
            return np.square([self.nearest, self.farthest]).astype(np.float32)

    def contains(self, means: Float32, origin: Sequence[float] | Float64 = (0.0, 0.0, 0.0)) -> Bool:
        """Mask (n,), True for means (n, 3) inside, as the kernels decide it; False for means that are not finite.

        origin: world coordinates of the means' origin (`Gaussians.origin`).
        """
        local, found = self.relative_to(origin), self.coordinates(means)
        low, high = local.low.astype(np.float32), local.high.astype(np.float32)
        squares, (nearest, farthest) = local.squares(means), self._limits
        return np.asarray(((low <= found) & (found < high)).all(axis=1) & (nearest <= squares) & (squares < farthest))

    def relative_to(self, origin: Sequence[float] | Float64) -> TrainedRegion:
        """The same region for means that are relative to `origin`, in world coordinates."""
        place = np.asarray(origin, np.float64)
        shift = self.axes @ place
        return replace(self, low=self.low - shift, high=self.high - shift, centre=self.centre - place)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Arguments of the kernels (REGION_PARAMETERS in kernels/shared/region.h): axis, low and high of each axis,
        then the centre and the squares of nearest and farthest."""
        rows = np.concatenate([self.axes, self.low[:, None], self.high[:, None]], axis=1)
        sphere = [*self.centre, *self._limits]
        return tuple(float(number) for number in np.append(rows, sphere).astype(np.float32))
