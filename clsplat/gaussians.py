# SPDX-License-Identifier: Apache-2.0
"""`Gaussians`: a model in host memory, as arrays of raw quaternions, log scales, opacity logits and SH coefficients."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import DEFAULT_NEAR_PLANE, Camera

MAX_SH_DEGREE = 3


@dataclass(eq=False)
class Gaussians:
    """A model: N Gaussians. All parameters are C-contiguous float32.

    Attributes
    ----------
    means : (N, 3) float32
        World units, relative to `origin`.
    quaternions : (N, 4) float32
        w, x, y, z, not normalised.
    log_scales : (N, 3) float32
        Natural logarithms of the standard deviations in world units.
    opacity_logits : (N,) float32
        Logits of the opacities.
    sh : (N, K, 3) float32
        K = (degree + 1)^2 real SH coefficients per channel. Colour = 0.5 + sum of basis times coefficient.
    origin : (3,) float64
        World coordinates of the means' origin. It is 0 except for scenes far from the world's origin, where float32
        would be too coarse (docs/decisions/0017).
    near : float
        Near plane in world units, for cameras that do not set one (docs/decisions/0019).
    antialiased : bool
        True for a model that was trained, and is drawn, with Mip-Splatting's low-pass filter (docs/gradients.md,
        section 13).
    by_rays : bool
        True for a model that was trained along the rays of pixels, and that perspective cameras draw along them
        (`Camera.by_rays`).

    Notes
    -----
    Kerbl et al. 2023. The parameters are stored as in 3DGS files (docs/conventions.md).
    """

    means: Float32
    quaternions: Float32
    log_scales: Float32
    opacity_logits: Float32
    sh: Float32
    origin: Float64 = field(default_factory=lambda: np.zeros(3))
    near: float = DEFAULT_NEAR_PLANE
    antialiased: bool = False
    by_rays: bool = False

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the SH coefficients, 0 to 3."""
        return round(float(np.sqrt(self.sh.shape[1]))) - 1

    def arrays(self) -> dict[str, Any]:
        """The float32 arrays of the parameters by name, in the order of the class's fields."""
        return {group.field: getattr(self, group.field) for group in PARAMETER_GROUPS.values()}

    def local(self, camera: Camera) -> Camera:
        """Adapt a camera in world coordinates to the model: relative to the model's origin, with the model's near plane
        and `by_rays`."""
        return camera.from_origin(self.origin).before(self.near).along_rays(self.by_rays)

    def check(self) -> None:
        """Check dtypes and shapes.

        Raises
        ------
        ValueError
            If an array is not as the class describes. The message names the array.
        """
        for name, array in {**self.arrays(), "origin": self.origin}.items():
            if not isinstance(array, np.ndarray):
                raise ValueError(f"{name} is a {type(array).__name__}, expected a NumPy array")
        count = len(self.means) if self.means.ndim else 0
        coefficients = self.sh.shape[1] if self.sh.ndim == 3 else 0
        if coefficients not in [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)]:
            raise ValueError(f"sh has shape {self.sh.shape}, expected (N, 1, 4, 9 or 16, 3)")
        shapes = {group.field: (count, *group.shape) for group in PARAMETER_GROUPS.values()} | {
            "sh": (count, coefficients, 3)
        }
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
        """Read a model file of any format of `clsplat.models.formats`.

        Parameters
        ----------
        path : str or path
            The file.

        Returns
        -------
        Gaussians
            The model.

        Raises
        ------
        InputError
            If the file is missing or wrong. The message has the file and the reason.
        """
        from clsplat.models.formats import load

        return load(path)

    def save(self, path: str | os.PathLike[str], *, sh_degree: int | None = None, comments: Sequence[str] = ()) -> None:
        """Write a model file in the format of its extension, atomically (see `clsplat.models.formats`).

        Parameters
        ----------
        path : str or path
            The file.
        sh_degree : int, optional
            Pad SH with zeros up to this degree, in formats that store several degrees. None means the model's degree.
        comments : sequence of str
            Lines for the header, such as the colour space (`colour.comment`), in formats that have a header.

        Raises
        ------
        InputError
            If no format with this extension can be written.
        WriteError
            If the file cannot be written.
        """
        from clsplat.models.formats import save

        save(path, self, sh_degree=sh_degree, comments=comments)


MAX_SH_COEFFICIENT = 1e7
"""Largest magnitude of an SH coefficient. Up to it, colours stay small enough for project.cl to draw the Gaussian."""
MAX_PARAMETER = 1e19
"""Largest magnitude of parameters other than SH coefficients, so that their squares fit in float32."""


class GaussiansOfFile(Gaussians):
    """A model in a file. Its arrays are read on first use, since main memory may have no room for them.

    like: Gaussians that have the same origin, near plane and other properties as the model.
    """

    def __init__(self, path: Path, like: Gaussians) -> None:
        self.path, self.origin, self.near = path.absolute(), like.origin, like.near
        self.antialiased, self.by_rays = like.antialiased, like.by_rays

    def __getstate__(self) -> dict[str, Any]:
        """Include the arrays in copies and pickles, because the file may be gone when they are used."""
        return {"means": self.means, **vars(self)}

    def __getattr__(self, name: str) -> Any:
        if name not in {group.field for group in PARAMETER_GROUPS.values()}:
            raise AttributeError(name)
        vars(self).update(Gaussians.load(self.path).arrays())
        return vars(self)[name]


@dataclass(frozen=True)
class Group:
    """A parameter array that Adam updates.

    field: the array of `Gaussians` that holds it.
    shape: shape of one Gaussian's row; -1 stands for the SH coefficients after the constant one.
    rate: name of its learning rate in `OptimiserConfig`.
    limit: upper bound of the parameters' magnitudes.
    """

    field: str
    shape: tuple[int, ...]
    rate: str
    limit: float = MAX_PARAMETER


PARAMETER_GROUPS: dict[str, Group] = {
    "means": Group("means", (3,), "means_rate"),
    "quaternions": Group("quaternions", (4,), "quaternions_rate"),
    "log_scales": Group("log_scales", (3,), "scales_rate"),
    "opacity_logits": Group("opacity_logits", (), "opacities_rate"),
    "sh_dc": Group("sh", (3,), "sh_dc_rate", MAX_SH_COEFFICIENT),
    "sh_rest": Group("sh", (-1, 3), "sh_rest_rate", MAX_SH_COEFFICIENT),
}
"""The parameter groups on the device, in the order of the kernels' arguments. SH coefficients are in two groups: the
constant one, and the rest.
"""


def group_shapes(count: int, coefficients: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of `count` Gaussians with `coefficients` SH coefficients per channel."""
    return {
        name: (count, *(coefficients - 1 if axis < 0 else axis for axis in group.shape))
        for name, group in PARAMETER_GROUPS.items()
    }


def floats_of(coefficients: int) -> int:
    """Number of float32 parameters of one Gaussian with `coefficients` SH coefficients per channel."""
    return sum(prod(shape) for shape in group_shapes(1, coefficients).values())
