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
"""Different logits that a model made by hand may have."""
SPREAD = (0.35, 0.93)
"""Opacities of a trained model reach below the first, a hundredth of them, though it is pruned, and beyond the second.
Logits that do and are none under 0 would be of a model pruned to opacities from 0.5 to 0.58 on that had its largest
from 0.717 to 0.735: trained models have some over 0.8, and those of short trainings end lower."""
CLIPPED = (1e-3, 0.02)
"""Opacities next to 1, by how much at most, of which networks have this part at least; logits are dense nowhere."""
PERCENT = (40.0, 100.0)
"""The largest of percentages. As levels of 255 such would be of a model that has nothing more opaque than 0.4."""
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


def without_turn(gaussians: Gaussians) -> NDArray[np.bool_]:
    """(n,): the Gaussians with a quaternion of 0."""
    return np.asarray(~gaussians.quaternions.any(axis=1))


def sound(gaussians: Gaussians, where: Path | str, activated: Activated | None = None) -> Gaussians:
    """The model with what this module says done to it, in place where no Gaussian is left out. activated: what it has
    in place of logits and logs, which are taken of it. Warns, once of each kind, beginning with `where`; raises
    InputError where no Gaussian is left. Gaussians have their numbers in the file."""
    mend(gaussians)
    good = finite_rows(gaussians)
    numbers = np.flatnonzero(good)
    if not good.all():
        first, bad = int((~good).argmax()), int((~good).sum())
        name = next(
            name
            for name, array in zip(values.NAMES, gaussians.arrays().values(), strict=True)
            if not np.isfinite(array[first]).all()
        )
        found = (
            f"{where}: {bad:,} of {len(good):,} Gaussians {values.have(bad)} a value that is not finite, the first is "
            f"Gaussian {first} with {name}"
        )
        if bad == len(good):
            raise InputError(f"{found}; expected some that are finite; is it damaged?")
        warn(f"{found}; {'it is' if bad == 1 else 'they are'} left out")
        gaussians = replace(gaussians, **{name: array[good] for name, array in gaussians.arrays().items()})
    _turn(gaussians, numbers, len(good), where)
    return _deactivated(gaussians, activated, numbers, where) if activated else gaussians


def _turn(gaussians: Gaussians, numbers: NDArray[np.intp], count: int, where: Path | str) -> None:
    quaternions = gaussians.quaternions
    with np.errstate(over="ignore", under="ignore"):
        squares = np.einsum("ij,ij->i", quaternions, quaternions)
    odd = np.flatnonzero(~((squares > LENGTHS[0]) & (squares < LENGTHS[1])))
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
    if white == 1 and not _spread(logits):
        return ""
    kind = {1.0: "opacities from 0 to 1", 100.0: "percentages"}.get(white, "levels")
    return f"all opacities lie in {low:.3g} to {high:.3g}, as {kind} do,"


def _spread(opacities: Float32) -> bool:
    """True if values from 0 to 1 lie as opacities do, and not as the logits that a pruned model has left do."""
    if len(np.unique(opacities)) <= FEW:
        return False
    reach = bool(np.percentile(opacities, 1) < SPREAD[0]) and bool(opacities.max() > SPREAD[1])
    return reach or float((np.abs(opacities - 1) <= CLIPPED[0]).mean()) >= CLIPPED[1]


def _white(logits: Float32) -> float:
    """The largest that the opacities are levels of, if they are: 1 or, of whole numbers, 100, 255 or more."""
    whole = logits.max() > OPAQUE and bool((logits == np.rint(logits)).all()) and len(np.unique(logits)) > FEW
    if whole and PERCENT[0] <= logits.max() <= PERCENT[1]:
        return PERCENT[1]
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


def _deactivated(gaussians: Gaussians, which: Activated, numbers: NDArray[np.intp], where: Path | str) -> Gaussians:
    """The model whose opacities, 0 to 1, to 100 or to 255, or scales were taken for logits and logs, with logits and
    logs of them; numbers: of its Gaussians in the file. Raises InputError, which begins with `where`, for values that
    cannot be opacities or scales, and for levels of which it cannot be told what they are parts of."""
    changed: dict[str, Any] = {}
    if which in ("opacities", "both"):
        white, most = _white(gaussians.opacity_logits), float(gaussians.opacity_logits.max())
        if white > PERCENT[1] and most < PERCENT[0]:
            raise InputError(
                f"{where}: opacities are whole numbers up to {most:g}, expected 0 to 1, or some over {PERCENT[0]:g}; "
                "it cannot be known whether these are parts of 100 or of 255"
            )
        opacity = gaussians.opacity_logits / np.float32(white)
        near = (opacity >= -BYTE_STEP) & (opacity <= 1 + BYTE_STEP)
        opacity = np.where(near, np.clip(opacity, 0, 1), opacity)
        changed["opacity_logits"] = values.logits_of(opacity, where, numbers)
    if which in ("scales", "both"):
        scales = gaussians.log_scales.copy()
        scales[scales < NO_LOG] = 0
        if (bad := (scales < 0).any(axis=1)).any():
            at = int(bad.argmax())
            raise InputError(
                f"{where}: Gaussian {numbers[at]} has a scale of {scales[at].min():g}, expected lengths; are these "
                "logs?"
            )
        log = np.log(np.maximum(scales, values.LEAST_SCALE, dtype=np.float64))
        changed["log_scales"] = log.astype(np.float32)
    return replace(gaussians, **changed)
