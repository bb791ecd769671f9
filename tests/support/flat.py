# SPDX-License-Identifier: Apache-2.0
"""Projected Gaussians as arrays, for tests of the library's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.library.pixels import PixelPass, screen_gaussians
from clsplat.library.session import session_of
from clsplat.reference import values as twin
from clsplat.selftest.cases.library import random_splats


@dataclass(frozen=True, eq=False)
class Flat:
    """Projected Gaussians: arrays in the order of the arguments of `screen_gaussians`."""

    means2d: Float32
    conics: Float32
    opacities: Float32
    colours: Float32
    depths: Float32
    radii: NDArray[np.int32]

    @property
    def arrays(self) -> tuple[Float32, Float32, Float32, Float32, Float32, NDArray[np.int32]]:
        """The arguments of `screen_gaussians` that follow the device."""
        return (self.means2d, self.conics, self.opacities, self.colours, self.depths, self.radii)

    @property
    def twin(self) -> twin.FlatGaussians:
        """The Gaussians in float64, for the twin."""
        means2d, conics, opacities, colours, depths = (np.asarray(array, np.float64) for array in self.arrays[:5])
        drawn = np.asarray((self.radii > 0).all(axis=1))
        return twin.FlatGaussians(means2d, conics, opacities, colours, depths, drawn)

    def pixels(self, device: Any, width: int, height: int, **how: Any) -> PixelPass:
        """The picture of the Gaussians. how: further arguments of `PixelPass`."""
        session = session_of(device)
        with session.lock:
            return PixelPass(session, screen_gaussians(session.device, *self.arrays), (width, height), **how)


def cloud(count: int, width: int, height: int, depth: int = 3, *, seed: int = 0, opaque: float = 0.1) -> Flat:
    """Random Gaussians all over an image, by `random_splats` of the self-test."""
    rng = np.random.default_rng(seed)
    given = random_splats(rng, count, width=width, height=height, depth=depth, opaque=opaque)
    return Flat(given.means2d, given.conics, given.opacities, given.values, given.depths, given.radii)
