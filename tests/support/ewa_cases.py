# SPDX-License-Identifier: Apache-2.0
"""Gaussians and cameras for tests of the EWA projection: of its twin, its kernels and the library's calls."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float32, Float64
from clsplat.reference import ewa as twin

MODELS = ("pinhole", "ortho", "fisheye")
OUTPUTS = ("means2d", "depths", "conics", "compensations")


@dataclass(frozen=True, eq=False)
class Case:
    """Gaussians in float32, as kernels read them, and a camera whose matrix is not exactly a rotation."""

    means: Float32
    quaternions: Float32
    scales: Float32
    opacities: Float32
    view: twin.EwaViewTwin

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.means)

    @property
    def covariances(self) -> Float32:
        """Upper triangles (N, 6) of the covariances, rounded to float32."""
        full = twin.covariances_of(self.quaternions.astype(np.float64), self.scales.astype(np.float64))
        return full.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].astype(np.float32)

    def full(self, *, rounded: bool) -> Float64:
        """Covariances (N, 3, 3) from quaternions and scales. rounded: from the rounded `covariances` instead."""
        if rounded:
            return twin.full_covariances(self.covariances.astype(np.float64))
        return twin.covariances_of(self.quaternions.astype(np.float64), self.scales.astype(np.float64))

    def projected(
        self, *, rounded: bool = False, opacities: bool = False, compensated: bool = False
    ) -> twin.EwaProjectedTwin:
        """Results of the twin.

        rounded: use the rounded `covariances`.
        opacities: let the radii depend on the opacities. compensated: multiply these by the compensations first.
        """
        means, full = self.means.astype(np.float64), self.full(rounded=rounded)
        plain = twin.project(means, full, self.view)
        if not opacities:
            return plain
        seen = self.opacities.astype(np.float64) * (plain.compensations if compensated else 1.0)
        return twin.project(means, full, self.view, seen)

    def at(self, **changes: object) -> Case:
        """The case with these changes of its view."""
        return replace(self, view=replace(self.view, **changes))  # type: ignore[arg-type]


def case(
    count: int, model: str = "pinhole", *, seed: int = 1, thin: float = 1.0, size: tuple[int, int] = (100, 70)
) -> Case:
    """Gaussians around the point that a camera looks at. Some are outside its picture, and some behind it.

    thin: standard deviation of the logarithms of their scales.
    """
    rng = np.random.default_rng(seed)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec([0.2, 0.3, -0.1]).as_matrix() + 0.02 * rng.normal(size=(3, 3))
    viewmat[:3, 3] = [0.1, -0.2, 3.5]
    width, height = size
    focal = width * (0.3 if model == "ortho" else 0.9)
    intrinsics = np.array([[focal, 0, 0.45 * width], [0, 0.95 * focal, 0.4 * width], [0, 0, 1]])
    return Case(
        rng.normal(0, 2.0, (count, 3)).astype(np.float32),
        rng.normal(0, 1, (count, 4)).astype(np.float32),
        np.exp(rng.normal(-2.5, thin, (count, 3))).astype(np.float32),
        rng.uniform(0, 1, count).astype(np.float32),
        twin.EwaViewTwin(viewmat, intrinsics, width, height, model),
    )


def gradients(projected: twin.EwaProjectedTwin, *names: str, seed: int = 2) -> dict[str, Float32]:
    """Random gradients with respect to these outputs; NaN for culled Gaussians.

    Gradients of conics are divided by the conic's norm, so that all have similar effects.
    """
    rng = np.random.default_rng(seed)
    sizes = {"means2d": projected.means2d.shape, "conics": projected.conics.shape}
    result = {}
    for name in names:
        values = rng.normal(size=sizes.get(name, projected.depths.shape))
        if name == "conics":
            with np.errstate(all="ignore"):
                values /= np.linalg.norm(projected.conics, axis=1, keepdims=True)
        seen = projected.visible.reshape(-1, *[1] * (values.ndim - 1))
        result[name] = np.where(seen, values, np.nan).astype(np.float32)
    return result
