# SPDX-License-Identifier: Apache-2.0
"""Row-by-row errors of a model that was written to a format and read back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.gaussians import Gaussians
from clsplat.models.codec import values as packing

ERROR_UNITS = {
    "position": "world units",
    "position_relative": "of the extent",
    "scale": "of the Gaussian's largest",
    "rotation": "degrees",
    "opacity": "of 1",
    "colour": "of 1",
    "sh": "in a coefficient beyond degree 0",
}


def errors(original: Gaussians, read: Gaussians) -> dict[str, dict[str, float]]:
    """Return the "largest" and the "mean" error over all Gaussians of each attribute in ERROR_UNITS.

    Position errors are distances, and rotation errors angles. The error of any other attribute is that of its worst
    component. A scale error is a fraction of the Gaussian's largest scale, because formats clamp the thickness of very
    thin discs. SH coefficients that one model lacks are taken as 0.

    Raises ValueError for models of different sizes.
    """
    if len(original) != len(read):
        raise ValueError(f"the models have {len(original)} and {len(read)} Gaussians, expected equal numbers")
    low, high = original.means.min(axis=0).astype(np.float64), original.means.max(axis=0).astype(np.float64)
    extent = float(np.linalg.norm(high - low))
    shift = read.origin - original.origin
    blocks = []
    for rows in packing.row_blocks(len(original)):
        distance = np.linalg.norm(read.means[rows].astype(np.float64) - original.means[rows] + shift, axis=1)
        opacities = [packing.opacities(model.opacity_logits[rows]) for model in (original, read)]
        colours = [packing.colours(model.sh[rows, 0]) for model in (original, read)]
        blocks.append(
            {
                "position": distance,
                "position_relative": distance / extent if extent else distance * 0,
                "scale": _scale_errors(original.log_scales[rows], read.log_scales[rows]),
                "rotation": _angles(original.quaternions[rows], read.quaternions[rows]),
                "opacity": np.abs(opacities[1] - opacities[0]),
                "colour": np.abs(colours[1] - colours[0]).max(axis=1),
                "sh": _sh_errors(original.sh[rows, 1:], read.sh[rows, 1:]),
            }
        )
    whole = {name: np.concatenate([block[name] for block in blocks]) for name in ERROR_UNITS}
    return {name: {"largest": float(column.max()), "mean": float(column.mean())} for name, column in whole.items()}


def _scale_errors(a: NDArray[Any], b: NDArray[Any]) -> Float64:
    """Return for each Gaussian (n,) the largest error of its three scales, divided by its largest scale.

    a, b: log scales (n, 3) of the two models. The largest scale is that of `a`.
    """
    largest = a.max(axis=1, keepdims=True).astype(np.float64)
    with np.errstate(over="ignore"):
        p, q = np.exp(a - largest), np.exp(b - largest)
    return np.asarray(np.abs(q - p).max(axis=1))


def _angles(a: NDArray[Any], b: NDArray[Any]) -> Float64:
    """Angles (n,) in degrees between the rotations of quaternions `a` and `b` (n, 4), accurate for small angles."""
    p, q = packing.unit_quaternions(a), packing.unit_quaternions(b)
    q *= np.where((p * q).sum(axis=1) < 0, -1, 1)[:, None]
    chord = np.linalg.norm(p - q, axis=1)
    return np.asarray(np.degrees(4 * np.arcsin(np.minimum(chord / 2, 1))))


def _sh_errors(a: NDArray[Any], b: NDArray[Any]) -> Float64:
    width = max(a.shape[1], b.shape[1])
    p, q = (np.pad(sh.astype(np.float64), ((0, 0), (0, width - sh.shape[1]), (0, 0))) for sh in (a, b))
    return np.asarray(np.abs(p - q).max(axis=(1, 2), initial=0))


def table(losses: dict[str, dict[str, float]]) -> str:
    """The result of `errors` as text, with a line for each attribute."""
    names = {"position_relative": "", "sh": "SH"}
    lines = ["error      largest      mean"]
    for name, unit in ERROR_UNITS.items():
        label = names.get(name, name)
        lines.append(f"{label:9}  {losses[name]['largest']:<11.3g}  {losses[name]['mean']:<11.3g}  {unit}")
    return "\n".join(lines)
