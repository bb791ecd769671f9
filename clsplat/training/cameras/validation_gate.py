# SPDX-License-Identifier: Apache-2.0
"""Validation gate of refined cameras: return to earlier cameras if held-out views get worse. Uses no OpenCL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.cameras.poses import checked_arrays, first_step
from clsplat.training.density.adaptive import is_due, is_reset_due

MAX_GATE_VIEWS = 8
"""Maximum number of held-out views whose PSNR validates refined cameras."""
GATE_MEASUREMENTS = 10
"""Number of times that cameras are validated in a training, besides the first time, when refinement begins."""
LOW_MEASUREMENTS_IN_A_ROW = 2
"""Number of consecutive low PSNRs that end refinement. A single one may be low because of a densification."""
RESET_SETTLING_DIVISOR = 3
"""Divisor of the interval between opacity resets. The quotient is the number of steps in which a model recovers from a
reset. In these steps, cameras cannot be validated."""
DRIFT_ITERATIONS, MIN_DRIFT_RESIDUAL = 10, 1e-12
"""Number of iterations in which `drift` reweights and fits, and the limit below which a residual counts as zero."""


def steps_of(config: TrainConfig) -> tuple[int, ...]:
    """Steps after which cameras are validated, ascending: when refinement begins, and at every tenth of the training.

    Just after a densification, and for long after an opacity reset, the model is too bad to validate cameras with. A
    measurement that is due then is made earlier, at the last step before the densification or reset.
    """
    density, first = config.density, first_step(config)
    settling = (density.opacity_reset_every or DensityConfig.opacity_reset_every) // RESET_SETTLING_DIVISOR
    white, resets = config.background == "white", density.growth != "mcmc"

    def settled(step: int) -> int:
        late = range(step, max(step - density.every, 0), -1)
        step = next((each for each in late if is_due(density, each)), step)
        late = range(step, max(step - settling, 0) if resets else step, -1)
        return next((each for each in late if is_reset_due(density, each, white=white)), step)

    wanted = {first, *(part * config.iterations // GATE_MEASUREMENTS for part in range(1, GATE_MEASUREMENTS + 1))}
    return tuple(sorted({settled(step) for step in wanted if step >= first}))


@dataclass(frozen=True, eq=False)
class Drift:
    """Similarity transform of the world: x becomes scale * rotation @ x + shift. rotation (3, 3), shift (3,)."""

    scale: float
    rotation: Float64
    shift: Float64

    def taken_along(self, camera: Camera) -> Camera:
        """`camera` moved along with the drift, so that it shows the same part of the scene as before."""
        rotation = camera.rotation @ self.rotation.T
        position = self.scale * self.rotation @ camera.position + self.shift
        return camera.posed(rotation, -rotation @ position)

    def points(self, points: Float64) -> Float64:
        """Points (N, 3) of the original world, moved to the drifted world."""
        moved: Float64 = self.scale * points @ self.rotation.T + self.shift
        return moved


def drift(given: Sequence[Camera], refined: Sequence[Camera], length_unit: float) -> Drift:
    """Similarity transform that best maps the n given poses to the n refined poses.

    A camera's residual is the root of (angle^2 + (distance/length_unit)^2), with the angle in radians. Squared
    residuals have Huber weights with the median residual as the bound, so that a few outliers have little influence.
    The rotation fits positions and axes together (Kabsch 1976), because cameras may lie on a line or in one point. The
    scale is Umeyama's (1991), from the positions.
    """
    old, new = (np.array([camera.rotation for camera in cameras]) for cameras in (given, refined))
    at, to = (np.array([camera.position for camera in cameras]) / length_unit for cameras in (given, refined))
    turns, weights = new.transpose(0, 2, 1) @ old, np.ones(len(old))
    for _ in range(DRIFT_ITERATIONS):
        parts = weights / weights.sum()
        from_middle, to_middle = parts @ at, parts @ to
        a, b = at - from_middle, to - to_middle
        left, _, right = np.linalg.svd((parts[:, None, None] * turns).sum(axis=0) + 2 * (parts * b.T) @ a)
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        rotation = left @ right
        turned, squares = a @ rotation.T, float((parts * (a * a).T).sum())
        scale = float((parts * (b * turned).T).sum()) / squares if squares > MIN_DRIFT_RESIDUAL else 1.0
        angles = np.square(new @ rotation - old).sum(axis=(1, 2)) / 2  # 4 sin^2(angle / 2), nearly the squared angle
        residuals = np.sqrt(angles + np.square(b - scale * turned).sum(axis=1))
        bound = max(float(np.median(residuals)), MIN_DRIFT_RESIDUAL)
        weights = bound / np.maximum(residuals, bound)
    return Drift(scale, rotation, length_unit * (to_middle - scale * rotation @ from_middle))


class CameraGate:
    """Record of the held-out PSNR while cameras are refined, and of the cameras with the best PSNR.

    measured: step and PSNR in dB of each measurement.
    ended: step after which refinement ended, None while it continues.
    """

    def __init__(self, config: TrainConfig, held_out: int) -> None:
        self.on = config.refines and config.refine_gate > 0 and held_out > 0
        self._config, self._steps = config, steps_of(config) if self.on else ()
        self.measured: list[tuple[int, float]] = []
        self.ended: int | None = None
        self._best: dict[str, NDArray[Any]] = {}

    def is_due(self, step: int) -> bool:
        """True if a validation is due after step number `step`, or was due earlier and has been skipped."""
        last = self.measured[-1][0] if self.measured else -1
        return any(last < due <= step for due in self._steps)

    @property
    def best(self) -> tuple[int, float]:
        """Step and PSNR of the best measurement before refinement ended; the first one if several are equal."""
        known = [each for each in self.measured if self.ended is None or each[0] <= self.ended]
        return max(known, key=lambda each: each[1])

    def validate(
        self, step: int, psnr: float, cameras: Mapping[str, NDArray[Any]]
    ) -> tuple[dict[str, NDArray[Any]] | None, str]:
        """Record the held-out PSNR after a step, in dB, and decide if refinement goes back to earlier cameras.

        cameras: the current cameras, as arrays of a checkpoint.
        Returns two values: the arrays of the cameras to go back to, or None to keep the current ones; and the text of a
        warning, or "".
        """
        self.measured.append((step, psnr))
        if self.ended is not None:
            return None, ""
        at, best = self.best
        if at == step:
            self._best = {name: array.copy() for name, array in cameras.items()}
            return None, ""
        low = list(takewhile(lambda each: each[1] < best - self._config.refine_gate, reversed(self.measured)))[::-1]
        if len(low) < LOW_MEASUREMENTS_IN_A_ROW:
            return None, ""
        poses = self._config.refine_poses
        flag, reach = ("--refine-poses", "--pose-reach") if poses else ("--refine-lenses", "--lens-reach")
        figures, steps = (
            " and ".join(each) for each in zip(*((f"{value:.2f}", str(on)) for on, value in low), strict=True)
        )
        found = f"{flag}: held-out views had {best:.2f} dB at step {at}, but {figures} dB at steps {steps}"
        advice = f"try a smaller {reach}, or train without {flag}"
        if step >= self._config.iterations:
            return None, f"{found}: the latest cameras are kept, as no step is left to train with others; {advice}"
        self.ended = step
        return self._best, f"{found}: the cameras of step {at} are restored, and refinement ends; {advice}"

    def record(self) -> dict[str, Any]:
        """Return the measurements so far, at least one, for the key `gate` in a line of metrics.jsonl."""
        measured = [{"step": step, "psnr": psnr} for step, psnr in self.measured]
        return {"measured": measured, "best": self.best[0], "ended": self.ended}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Measurements and the best cameras, keyed by their names in a checkpoint."""
        if not self.measured:
            return {}
        ended = np.array([-1 if self.ended is None else self.ended], np.int64)
        own = {"measured": np.array(self.measured, np.float64), "ended": ended, **self._best}
        return {f"gate/{name}": array for name, array in own.items()}

    def load(self, arrays: Mapping[str, NDArray[Any]], cameras: Mapping[str, NDArray[Any]]) -> None:
        """Load the measurements and the best cameras from a checkpoint's arrays.

        arrays: by name without the prefix "gate/"; {} before the first measurement.
        cameras: arrays of the current cameras; the loaded arrays must have the same shapes.
        Raises ValueError for arrays of other views.
        """
        self.measured, self.ended, self._best = [], None, {}
        if not self.on or not arrays:
            return
        measured = arrays.get("measured", np.zeros(0))
        if measured.ndim != 2 or measured.shape[1] != 2 or not len(measured) or not np.isfinite(measured).all():
            raise ValueError(f"gate/measured has shape {measured.shape}, expected finite steps and dB (n, 2)")
        like = {"gate/ended": np.zeros(1, np.int64), **{f"gate/{name}": array for name, array in cameras.items()}}
        self._best = checked_arrays(like, arrays, "gate/")
        ended = int(self._best.pop("ended")[0])
        self.ended = None if ended < 0 else ended
        self.measured = [(int(step), float(psnr)) for step, psnr in measured]
