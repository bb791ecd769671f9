# SPDX-License-Identifier: Apache-2.0
"""Values of a model's file that no Gaussian can have, mended or left out, and doubts about how others are meant.

- Infinite values that stand for a number: a log scale of -inf is a scale of 0, logits of -inf and inf are opacities of
  0 and 1 (flat and opaque Gaussians, as splat-transform writes them).
- Quaternions of length 0 are no rotation: w = 1, as writers of formats with unit quaternions have it. The kernels would
  not draw them. Others whose length leaves float32 when it is squared are made unit ones.
- Other values that are not finite: these Gaussians are left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.errors import InputError, warn
from clsplat.gaussians import Gaussians
from clsplat.models.codec import values

Activated = Literal["opacities", "scales", "both"]
"""Values that a file has as they are used, and not as their logits or logs."""

LENGTHS = (1e-29, 1e29)
"""Squares of the lengths of quaternions that are drawn as they are; project.cl takes 1e-30 to 1e30."""
FEWEST = 100
"""Gaussians whose values say how they are meant."""
BYTE_STEP = 0.02
"""The most that a logit between 0 and 1 is off after a format of bytes."""
OPAQUE = 20.0
"""Logits beyond this are of no use in float32: levels of bytes reach further."""
FEW = 10
"""Different whole numbers that the logits of a model made by hand may be."""
NO_LOG = float(np.log(values.LEAST_SCALE)) + 1
"""Log scales under this are those of scales of 0, which say nothing of how the others are meant."""
SKEWED = 3.0
"""How many times as far lengths reach above their median as below. They spread in proportion, by a factor of e or more
(then this is 10); their logs spread alike to both sides."""


def mend(gaussians: Gaussians) -> None:
    """Make infinite values that stand for a number that number, in place."""
    logits, scales = gaussians.opacity_logits, gaussians.log_scales
    if not values.all_finite(logits):
        ends = values.logits(np.array([0.0, 1.0]))
        logits[logits == -np.inf], logits[logits == np.inf] = ends
    if not values.all_finite(scales):
        scales[scales == -np.inf] = np.log(values.LEAST_SCALE)


def finite_rows(gaussians: Gaussians) -> NDArray[np.bool_]:
    """(n,): the Gaussians all of whose values are finite."""
    rows = np.ones(len(gaussians), bool)
    for array in gaussians.arrays().values():
        if not values.all_finite(array):
            rows &= np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    return rows


def sound(gaussians: Gaussians, where: Path | str) -> Gaussians:
    """The model with what this module says done to it, in place where no Gaussian is left out. Warns, once of each
    kind, beginning with `where`; raises InputError where no Gaussian is left."""
    mend(gaussians)
    good = finite_rows(gaussians)
    if not good.all():
        first, bad = int((~good).argmax()), int((~good).sum())
        name = next(
            name
            for name, array in zip(values.NAMES, gaussians.arrays().values(), strict=True)
            if not np.isfinite(array[first]).all()
        )
        found = (
            f"{where}: {bad:,} of {len(good):,} Gaussians have a value that is not finite, the first is Gaussian "
            f"{first} with {name}"
        )
        if bad == len(good):
            raise InputError(f"{found}; expected some that are finite; is it damaged?")
        warn(f"{found}; they are left out")
        gaussians = replace(gaussians, **{name: array[good] for name, array in gaussians.arrays().items()})
    _turn(gaussians, where)
    return gaussians


def _turn(gaussians: Gaussians, where: Path | str) -> None:
    quaternions = gaussians.quaternions
    with np.errstate(over="ignore", under="ignore"):
        squares = np.einsum("ij,ij->i", quaternions, quaternions)
    odd = np.flatnonzero(~((squares > LENGTHS[0]) & (squares < LENGTHS[1])))
    if not len(odd):
        return
    none = odd[~quaternions[odd].any(axis=1)]
    quaternions[odd] = values.unit_quaternions(quaternions[odd])
    if len(none):
        warn(
            f"{where}: {len(none):,} of {len(quaternions):,} Gaussians have a quaternion of 0, the first is Gaussian "
            f"{none[0]}; they are drawn unrotated, other programs may not draw them"
        )


def doubts(logits: Float32, log_scales: Float32) -> list[str]:
    """Warnings about values, all of them finite, that seem to be opacities and scales themselves in place of their
    logits and logs: lines for warnings, without the file's name. Models of few Gaussians give no doubts."""
    if len(logits) < FEWEST:
        return []
    seen = {"opacities": _seen_opacities(logits), "scales": _seen_scales(log_scales)}
    which = "both" if all(seen.values()) else "".join(name for name, found in seen.items() if found)
    return [
        f"{found} and are taken for {kind}; if they are {name} themselves, `clsplat convert --activated {which}` "
        "writes a right model"
        for (name, found), kind in zip(seen.items(), ("logits", "logs"), strict=True)
        if found
    ]


def _seen_opacities(logits: Float32) -> str:
    low, high = float(logits.min()), float(logits.max())
    if low < -BYTE_STEP or low == high or high > (1 + BYTE_STEP) * (white := _white(logits)):
        return ""
    return f"all opacities lie in {low:.3g} to {high:.3g}, as {'opacities from 0 to 1' if white == 1 else 'levels'} do,"


def _white(logits: Float32) -> float:
    """The largest that the opacities are levels of, if they are: 1 or, of whole numbers, 255 or more."""
    whole = logits.max() > OPAQUE and bool((logits == np.rint(logits)).all()) and len(np.unique(logits)) > FEW
    return values.full_scale(logits) if whole else 1.0


def _seen_scales(log_scales: Float32) -> str:
    if ((log_scales < 0) & (log_scales > NO_LOG)).any():
        return ""
    lengths = log_scales[log_scales > NO_LOG]
    p0, p1, p50, p99, p100 = (
        (float(value) for value in np.percentile(lengths, (0, 1, 50, 99, 100))) if len(lengths) else [0.0] * 5
    )
    if p0 == p100 or (p50 >= 1 and p99 - p50 <= SKEWED * (p50 - p1)):
        return ""
    return f"all scales lie in {p0:.3g} to {p100:.3g}, half of them under {p50:.3g}, as lengths do,"


def deactivated(gaussians: Gaussians, which: Activated, where: Path | str) -> Gaussians:
    """The model whose opacities, 0 to 1 or 0 to 255, or scales were taken for logits and logs, with logits and logs of
    them. Raises InputError, which begins with `where`, for values that cannot be opacities or scales."""
    changed: dict[str, Any] = {}
    if which in ("opacities", "both"):
        opacity = gaussians.opacity_logits / np.float32(_white(gaussians.opacity_logits))
        near = (opacity >= -BYTE_STEP) & (opacity <= 1 + BYTE_STEP)
        changed["opacity_logits"] = values.logits_of(np.where(near, np.clip(opacity, 0, 1), opacity), where)
    if which in ("scales", "both"):
        scales = gaussians.log_scales.copy()
        scales[scales < NO_LOG] = 0
        if (bad := (scales < 0).any(axis=1)).any():
            at = int(bad.argmax())
            raise InputError(
                f"{where}: Gaussian {at} has a scale of {scales[at].min():g}, expected lengths; are these logs?"
            )
        log = np.log(np.maximum(scales, values.LEAST_SCALE, dtype=np.float64))
        changed["log_scales"] = log.astype(np.float32)
    return replace(gaussians, **changed)
