# SPDX-License-Identifier: Apache-2.0
"""Projected Gaussians as arrays, with which the library's pixels are tried."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.library.pixels import PixelPass, screen_gaussians
from clsplat.library.session import session_of
from clsplat.reference import values as twin


@dataclass(frozen=True, eq=False)
class Flat:
    """Arrays in the order of `screen_gaussians`, float32 as kernels have them, but for the radii."""

    means2d: Float32
    conics: Float32
    opacities: Float32
    colours: Float32
    depths: Float32
    radii: NDArray[np.int32]

    @property
    def arrays(self) -> tuple[Float32, Float32, Float32, Float32, Float32, NDArray[np.int32]]:
        """The arguments of `screen_gaussians`, after the device."""
        return (self.means2d, self.conics, self.opacities, self.colours, self.depths, self.radii)

    @property
    def twin(self) -> twin.FlatGaussians:
        """The same in float64."""
        means2d, conics, opacities, colours, depths = (np.asarray(array, np.float64) for array in self.arrays[:5])
        drawn = np.asarray((self.radii > 0).all(axis=1))
        return twin.FlatGaussians(means2d, conics, opacities, colours, depths, drawn)

    def pixels(self, device: Any, width: int, height: int, **how: Any) -> PixelPass:
        """Their picture."""
        session = session_of(device)
        with session.lock:
            return PixelPass(session, screen_gaussians(session.device, *self.arrays), (width, height), **how)


def conics_of(sides: Float64, angles: Float64) -> Float32:
    """(n, 3) of ellipses with these standard deviations (n, 2) in pixels, turned by the angles (n,)."""
    axes = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=1).reshape(-1, 2, 2)
    inverse = (axes / sides[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    return np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1).astype(np.float32)


def cloud(count: int, width: int, height: int, depth: int = 3, *, seed: int = 0, opaque: float = 0.1) -> Flat:
    """Gaussians of a few pixels all over an image and a little beyond, a tenth culled by a radius, and a part as opaque
    as the cap; two of the same depth."""
    rng = np.random.default_rng(seed)
    sides = np.exp(rng.normal(0.9, 0.5, (count, 2)))
    opacities = np.where(rng.random(count) < opaque, 1.0, rng.uniform(0.02, 0.95, count))
    depths = rng.uniform(1, 9, count)
    depths[: count // 2 * 2 : 2] = depths[1 : count // 2 * 2 : 2]
    radii = np.where(rng.random((count, 2)) < 0.05, 0, 9)
    return Flat(
        (rng.uniform(-0.1, 1.1, (count, 2)) * [width, height]).astype(np.float32),
        conics_of(sides, rng.uniform(0, np.pi, count)),
        opacities.astype(np.float32),
        rng.uniform(0, 1, (count, depth)).astype(np.float32),
        depths.astype(np.float32),
        radii.astype(np.int32),
    )
