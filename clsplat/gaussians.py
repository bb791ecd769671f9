# SPDX-License-Identifier: Apache-2.0
"""The model on the host: a structure of arrays, as stored (raw quaternions, log scales, opacity logits)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import NEAR, Camera

MAX_SH_DEGREE = 3


@dataclass(eq=False)
class Gaussians:
    """N Gaussians.

    means (N, 3); quaternions (N, 4), w x y z, not normalised; log_scales (N, 3), natural logs of the standard
    deviations; opacity_logits (N,); sh (N, K, 3), K = (degree + 1)^2 real SH coefficients per channel,
    colour = 0.5 + sum of basis times coefficient. All float32, C-contiguous. origin (3,) float64: the place in the
    world that the means count from; 0 but for scenes far from it, which float32 would blur (docs/decisions/0017). near:
    where cameras without a near plane of their own begin to see, world units (docs/decisions/0019). antialiased: True
    for a model that is drawn with the filter of docs/gradients.md, section 13, as it was trained; by_rays: True for one
    that perspective cameras draw along the rays of their pixels (`Camera.by_rays`), as it was trained.
    """

    means: Float32
    quaternions: Float32
    log_scales: Float32
    opacity_logits: Float32
    sh: Float32
    origin: Float64 = field(default_factory=lambda: np.zeros(3))
    near: float = NEAR
    antialiased: bool = False
    by_rays: bool = False

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        return round(float(np.sqrt(self.sh.shape[1]))) - 1

    def arrays(self) -> dict[str, Any]:
        """The parameters, float32, by their names, in the order of the class."""
        return {group.field: getattr(self, group.field) for group in GROUPS.values()}

    def local(self, camera: Camera) -> Camera:
        """A camera in the world as one that counts from where the means do, with the model's near plane, which draws as
        the model wants it."""
        return camera.from_origin(self.origin).before(self.near).along_rays(self.by_rays)

    def check(self) -> None:
        """Raise ValueError naming the array whose dtype or shape is not as the class says."""
        for name, array in {**self.arrays(), "origin": self.origin}.items():
            if not isinstance(array, np.ndarray):
                raise ValueError(f"{name} is a {type(array).__name__}, expected a NumPy array")
        count = len(self.means) if self.means.ndim else 0
        coefficients = self.sh.shape[1] if self.sh.ndim == 3 else 0
        if coefficients not in [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)]:
            raise ValueError(f"sh has shape {self.sh.shape}, expected (N, 1, 4, 9 or 16, 3)")
        shapes = {group.field: (count, *group.shape) for group in GROUPS.values()} | {"sh": (count, coefficients, 3)}
        for name, array in self.arrays().items():
            shape = shapes[name]
            if array.dtype != np.float32 or array.shape != shape:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, expected float32 {shape}")
        if self.origin.dtype != np.float64 or self.origin.shape != (3,):
            raise ValueError(f"origin is {self.origin.dtype} {self.origin.shape}, expected float64 (3,)")
        if not 0 < self.near < np.inf:
            raise ValueError(f"near is {self.near}, expected a distance of more than 0")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Gaussians:
        """Read a model file of any format, see `clsplat.models.formats`. Raises InputError naming the file and the
        trouble."""
        from clsplat.models.formats import load

        return load(path)

    def save(self, path: str | os.PathLike[str], *, sh_degree: int | None = None, comments: Sequence[str] = ()) -> None:
        """Write a model file in the format of its ending, atomically, see `clsplat.models.formats`.

        Of formats that have room for it: sh_degree, pad with zero coefficients up to this degree; the model's own where
        it is not given. comments: lines of the header, such as `colour.comment`.
        """
        from clsplat.models.formats import save

        save(path, self, sh_degree=sh_degree, comments=comments)


SH_LIMIT = 1e7
"""No SH coefficient may be larger: a colour that project.cl does not draw for its size has one that is."""
LIMIT = 1e19
"""No parameter may be larger: its square is to be a float32."""


@dataclass(frozen=True)
class Group:
    """A parameter array that Adam steps.

    field: the array of `Gaussians` that holds it; shape: the floats of one Gaussian, -1 for the SH coefficients after
    the constant one; rate: its learning rate in `OptimiserConfig`; limit: the bound that magnitudes stay under.
    """

    field: str
    shape: tuple[int, ...]
    rate: str
    limit: float = LIMIT


GROUPS: dict[str, Group] = {
    "means": Group("means", (3,), "means_rate"),
    "quaternions": Group("quaternions", (4,), "quaternions_rate"),
    "log_scales": Group("log_scales", (3,), "scales_rate"),
    "opacity_logits": Group("opacity_logits", (), "opacities_rate"),
    "sh_dc": Group("sh", (3,), "sh_dc_rate", SH_LIMIT),
    "sh_rest": Group("sh", (-1, 3), "sh_rest_rate", SH_LIMIT),
}
"""The parameter groups on the device, in the order of the kernels' arguments. SH is split into its constant and the
rest."""


def group_shapes(count: int, coefficients: int) -> dict[str, tuple[int, ...]]:
    """The arrays of `count` Gaussians with `coefficients` SH coefficients a channel."""
    return {
        name: (count, *(coefficients - 1 if axis < 0 else axis for axis in group.shape))
        for name, group in GROUPS.items()
    }


def floats_of(coefficients: int) -> int:
    """The floats of one Gaussian's parameters."""
    return sum(prod(shape) for shape in group_shapes(1, coefficients).values())
