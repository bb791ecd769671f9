# SPDX-License-Identifier: Apache-2.0
"""Repair or removal of invalid values in model files, and warnings about valid values that look wrongly encoded.

- Infinite logs and logits are replaced: a log scale of -inf is a scale of 0; logits of -inf and inf are opacities of
  0 and 1. splat-transform writes flat and opaque Gaussians like this.
- Quaternions of length 0, which the kernels do not draw, become the identity rotation. Other quaternions are normalised
  if their squared length is outside the range of float32.
- Gaussians with other non-finite values are left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.errors import InputError, warn
from clsplat.gaussians import Gaussians
from clsplat.models.codec import values
from clsplat.models.edit import take

Activated = Literal["opacities", "scales", "both"]
"""Values that a file stores as opacities instead of logits, or as scales instead of logs."""

DRAWN_QUATERNION_SQUARES = (1e-29, 1e29)
"""Range of the squared lengths of quaternions that are left as they are; project.cl accepts 1e-30 to 1e30."""
MIN_GAUSSIANS_FOR_ENCODING_WARNINGS = 100
"""Least number of Gaussians from whose values the encoding can be guessed."""
BYTE_LOGIT_ERROR = 0.02
"""Largest error of a logit between 0 and 1 after conversion to an 8-bit format."""
LARGEST_USEFUL_LOGIT = 20.0
"""Largest logit that changes an opacity in float32. Opacities stored as levels from 0 to 255 exceed it."""
MAX_HANDMADE_LOGITS = 10
"""A model with at most this many distinct logits is taken to be made by hand and not trained."""
TRAINED_OPACITY_SPREAD = (0.35, 0.93)
"""Two bounds. In a trained model, 1 % of the opacities are below the first even after pruning, and the largest is above
the second.

If such values were logits, no opacity would be below about 0.5, and the largest would be 0.717 to 0.735. But the
largest opacity of a trained model is 0.8 or more, except after short trainings.
"""
CLIPPED_OPACITY_SHARE = (1e-3, 0.02)
"""A distance from 1, and a fraction. If at least this fraction of the values is within this distance of 1, the values
are opacities that a neural network has clipped at 1. Logits do not cluster at 1."""
PERCENTAGE_MAXIMA = (40.0, 100.0)
"""Whole numbers are percentages if the largest is in this range. If they were levels up to 255, no opacity would exceed
0.4."""
ZERO_SCALE_LOG_LIMIT = float(np.log(values.MIN_SCALE)) + 1
"""Log scales below this stand for scales of 0, and do not show how the other scales are encoded."""
LENGTH_SKEW_RATIO = 3.0
"""Ratio of (99th percentile - median) to (median - 1st percentile), above which values are lengths and not logs.

The logs of a model's lengths have a standard deviation of 1 or more. If they are normally distributed, the 99th
percentile is 2.33 standard deviations above the median. The ratio of the lengths is then e^2.33 = 10 or more, and the
ratio of the logs is about 1.
"""


def replace_infinities(gaussians: Gaussians) -> None:
    """Replace infinite logits (opacities 0 and 1) and log scales of -inf (scales of 0) by finite values, in place."""
    logits, scales = gaussians.opacity_logits, gaussians.log_scales
    if not values.all_finite(logits):
        ends = values.logits(np.array([0.0, 1.0]))
        logits[logits == -np.inf], logits[logits == np.inf] = ends
    if not values.all_finite(scales):
        scales[scales == -np.inf] = np.log(values.MIN_SCALE)


def finite_rows(gaussians: Gaussians) -> NDArray[np.bool_]:
    """Mask (n,), True for Gaussians whose values are all finite."""
    rows = np.ones(len(gaussians), bool)
    for array in gaussians.arrays().values():
        if not values.all_finite(array):
            rows &= np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    return rows


def without_rotation(gaussians: Gaussians) -> NDArray[np.bool_]:
    """Mask (n,), True for Gaussians with a quaternion of 0."""
    return np.asarray(~gaussians.quaternions.any(axis=1))


def repaired(gaussians: Gaussians, where: Path | str, activated: Activated | None = None) -> Gaussians:
    """Repair or leave out Gaussians with invalid values (see the module).

    Works in place, unless Gaussians are left out or `activated` is given.

    activated: the values that the file stores as opacities or scales; they are converted to logits or logs of scales.
        None means that the file stores logits and logs.
    where: prefix of messages.
    Warns once for each kind of repair, with the Gaussians' indices in the file. Raises InputError if no Gaussian is
    left.
    """
    replace_infinities(gaussians)
    good = finite_rows(gaussians)
    numbers = np.flatnonzero(good)
    if not good.all():
        first, bad = int((~good).argmax()), int((~good).sum())
        name = next(
            name
            for name, array in zip(values.GAUSSIAN_ARRAY_NOUNS, gaussians.arrays().values(), strict=True)
            if not np.isfinite(array[first]).all()
        )
        found = (
            f"{where}: {bad:,} of {len(good):,} Gaussians {values.have(bad)} a value that is not finite, the first is "
            f"{name} of Gaussian {first}"
        )
        if bad == len(good):
            raise InputError(f"{found}; expected at least one with finite values; is the file damaged?")
        warn(f"{found}; {'it is' if bad == 1 else 'they are'} left out")
        gaussians = take(gaussians, good)
    _turn(gaussians, numbers, len(good), where)
    return _deactivated(gaussians, activated, numbers, where) if activated else gaussians


def _turn(gaussians: Gaussians, numbers: NDArray[np.intp], count: int, where: Path | str) -> None:
    quaternions = gaussians.quaternions
    with np.errstate(over="ignore", under="ignore"):
        squares = np.einsum("ij,ij->i", quaternions, quaternions)
    odd = np.flatnonzero(~((squares > DRAWN_QUATERNION_SQUARES[0]) & (squares < DRAWN_QUATERNION_SQUARES[1])))
    if not len(odd):
        return
    none = numbers[odd[~quaternions[odd].any(axis=1)]]
    quaternions[odd] = values.unit_quaternions(quaternions[odd])
    if len(none):
        warn(
            f"{where}: {len(none):,} of {count:,} Gaussians {values.have(len(none))} a quaternion of 0, the first is "
            f"Gaussian {none[0]}; {'it is' if len(none) == 1 else 'they are'} drawn unrotated, other programs may not "
            f"draw {'it' if len(none) == 1 else 'them'}"
        )


def encoding_warnings(logits: Float32, log_scales: Float32) -> list[str]:
    """Warnings, without the file's name, about values that look like opacities or scales instead of logits or logs.

    There are none for a model of fewer than MIN_GAUSSIANS_FOR_ENCODING_WARNINGS Gaussians.
    """
    if len(logits) < MIN_GAUSSIANS_FOR_ENCODING_WARNINGS:
        return []
    seen = {"opacities": _seen_opacities(logits), "scales": _seen_scales(log_scales)}
    which = "both" if all(seen.values()) else "".join(name for name, found in seen.items() if found)
    return [
        f"{found} and are read as {kind}; if they are {name}, `clsplat convert --activated {which}` "
        "writes a correct model"
        for (name, found), kind in zip(seen.items(), ("logits", "logs"), strict=True)
        if found
    ]


def _seen_opacities(logits: Float32) -> str:
    low, high = float(logits.min()), float(logits.max())
    if low < -BYTE_LOGIT_ERROR or low == high or high > (1 + BYTE_LOGIT_ERROR) * (white := _white(logits)):
        return ""
    if white == 1 and not _spread(logits):
        return ""
    kind = {1.0: "opacities from 0 to 1", 100.0: "percentages"}.get(white, "levels")
    return f"all opacities are between {low:.3g} and {high:.3g}, as {kind} are,"


def _spread(opacities: Float32) -> bool:
    """True if values from 0 to 1 are distributed like opacities, and not like the logits of a pruned model."""
    if len(np.unique(opacities)) <= MAX_HANDMADE_LOGITS:
        return False
    reach = bool(np.percentile(opacities, 1) < TRAINED_OPACITY_SPREAD[0]) and bool(
        opacities.max() > TRAINED_OPACITY_SPREAD[1]
    )
    return reach or float((np.abs(opacities - 1) <= CLIPPED_OPACITY_SHARE[0]).mean()) >= CLIPPED_OPACITY_SHARE[1]


def _white(stored: Float32) -> float:
    """Guess the number that stands for an opacity of 1 from all opacities (n,) as a file stores them.

    It is 100 for percentages, and 255 or a wider type's maximum for integer levels. Percentages and levels are whole
    numbers; the largest number tells which they are (PERCENTAGE_MAXIMA). For fractions and logits the result is 1.
    """
    whole = (
        stored.max() > LARGEST_USEFUL_LOGIT
        and bool((stored == np.rint(stored)).all())
        and len(np.unique(stored)) > MAX_HANDMADE_LOGITS
    )
    if whole and PERCENTAGE_MAXIMA[0] <= stored.max() <= PERCENTAGE_MAXIMA[1]:
        return PERCENTAGE_MAXIMA[1]
    return values.full_scale(stored) if whole else 1.0


def _seen_scales(log_scales: Float32) -> str:
    if ((log_scales < 0) & (log_scales > ZERO_SCALE_LOG_LIMIT)).any():
        return ""
    lengths = log_scales[log_scales > ZERO_SCALE_LOG_LIMIT]
    p0, p1, p50, p99, p100 = (
        (float(value) for value in np.percentile(lengths, (0, 1, 50, 99, 100))) if len(lengths) else [0.0] * 5
    )
    if p0 == p100 or (p50 >= 1 and p99 - p50 <= LENGTH_SKEW_RATIO * (p50 - p1)):
        return ""
    return f"all scales are between {p0:.3g} and {p100:.3g}, half of them under {p50:.3g}, as lengths are,"


def _deactivated(gaussians: Gaussians, which: Activated, numbers: NDArray[np.intp], where: Path | str) -> Gaussians:
    """Convert opacities (fractions, percentages or levels) to logits, or scales to logs, or both.

    which: the values to convert. numbers: index of each Gaussian in the file, for messages.
    Raises InputError, prefixed with `where`, for values that cannot be opacities or scales, and for whole numbers that
    may be percentages or levels.
    """
    logits, log_scales = gaussians.opacity_logits, gaussians.log_scales
    if which in ("opacities", "both"):
        white, most = _white(logits), float(logits.max())
        if white > PERCENTAGE_MAXIMA[1] and most < PERCENTAGE_MAXIMA[0]:
            raise InputError(
                f"{where}: opacities are whole numbers up to {most:g}, which may be percentages or levels from 0 to "
                f"255; expected fractions from 0 to 1, or a largest opacity of at least {PERCENTAGE_MAXIMA[0]:g}"
            )
        opacity = logits / np.float32(white)
        near = (opacity >= -BYTE_LOGIT_ERROR) & (opacity <= 1 + BYTE_LOGIT_ERROR)
        opacity = np.where(near, np.clip(opacity, 0, 1), opacity)
        logits = values.logits_of(opacity, where, numbers)
    if which in ("scales", "both"):
        scales = log_scales.copy()
        scales[scales < ZERO_SCALE_LOG_LIMIT] = 0
        if (bad := (scales < 0).any(axis=1)).any():
            at = int(bad.argmax())
            raise InputError(
                f"{where}: Gaussian {numbers[at]} has a scale of {scales[at].min():g}, expected lengths; are these "
                "logs?"
            )
        log_scales = np.log(np.maximum(scales, values.MIN_SCALE, dtype=np.float64)).astype(np.float32)
    return replace(gaussians, opacity_logits=logits, log_scales=log_scales)
