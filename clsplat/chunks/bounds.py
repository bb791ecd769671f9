# SPDX-License-Identifier: Apache-2.0
"""Bounding boxes of chunks for culling, and how far Adam may have moved the Gaussians since they were measured.

Noise, density control and repairs move Gaussians too. Chunks are measured again after each of these.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Bool, Float32, Float64
from clsplat.config.training import OptimiserConfig
from clsplat.layouts.columns import CHUNK_ROWS

_HALF_ULP = 2.0**-24
"""Largest rounding error of a float32, relative to its value."""
_ROUNDING = 1e-6
"""Relative slack of sqrt(r), the ratio in `largest_step`, for the rounding of a step's moments. It is more than eight
roundings of float32."""
_SLACK = 1e-3
"""Relative slack of the bound of a step of Adam. It covers the step's rounding, and second moments that underflow."""
GROUP_FACTOR = 1.5
"""Factor on half the diagonal of a group's box, for a sphere that contains the spheres around the boxes of its chunks.
These reach at most sqrt(2) half diagonals from the middle of the group's box."""
_LEAST_EPSILON = 1e-15
"""Smallest epsilon of Adam with which second moments that underflow move a parameter by less than _SLACK."""


@dataclass(frozen=True, eq=False)
class ChunkBounds:
    """Bounds of B chunks.

    terms: (8, B), float64. The rows are the middles (3) and half sides (3) of boxes around the means, in world units,
        the largest standard deviations, and magnitudes. A magnitude, which rounding errors are relative to, is `factor`
        times the sum of the absolute coordinates of the box's farthest corner. NaN in all rows of a chunk whose bounds
        are not finite.
    factor: factor on the radii of spheres around the boxes, and on the magnitudes. It is GROUP_FACTOR for bounds of
        groups, so that a group is visible wherever one of its chunks is.
    """

    terms: Float64
    factor: float = 1.0

    @classmethod
    def of_sides(cls, lowest: Float64, highest: Float64, largest: Float64) -> ChunkBounds:
        """Return the bounds of chunks, given the smallest and largest coordinates (B, 3) of their means, and their
        largest log scales (B,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            bounds = cls.around(lowest.T, highest.T, np.exp(largest))
            finite = np.isfinite(lowest.sum(axis=1) + highest.sum(axis=1) + largest)
        bounds.terms[:, ~finite] = np.nan
        return bounds

    @classmethod
    def around(cls, lowest: Float64, highest: Float64, deviation: Float64, factor: float = 1.0) -> ChunkBounds:
        """Return the bounds of boxes, given their smallest and largest coordinates (3, B), and their largest standard
        deviations (B,). factor: as in the class."""
        terms = np.empty((8, len(deviation)))
        terms[:3], terms[3:6], terms[6] = 0.5 * (lowest + highest), 0.5 * (highest - lowest), deviation
        terms[7] = factor * (np.abs(terms[:3]) + terms[3:6]).sum(axis=0)
        return cls(terms, factor)

    @classmethod
    def measured(cls, means: Float32, log_scales: Float32, rows: int = CHUNK_ROWS) -> ChunkBounds:
        """Return the bounds of the chunks of a model, given means and log scales (n, 3). NaNs give bounds of NaN.

        rows: number of Gaussians in a chunk.
        """
        lowest, highest, largest = np.hsplit(measured_sides(means, log_scales, rows).astype(np.float64), (3, 6))
        return cls.of_sides(lowest, highest, largest[:, 0])

    def __len__(self) -> int:
        """Number of chunks."""
        return len(self.terms[0])

    @property
    def lowest(self) -> Float64:
        """The smallest coordinates (B, 3) of the means."""
        return np.asarray((self.terms[:3] - self.terms[3:6]).T)

    @property
    def highest(self) -> Float64:
        """The largest coordinates (B, 3) of the means."""
        return np.asarray((self.terms[:3] + self.terms[3:6]).T)

    @property
    def finite(self) -> Bool:
        """Array (B,): True for chunks with finite bounds."""
        return np.asarray(np.isfinite(self.terms.sum(axis=0)))

    @property
    def radius(self) -> Float64:
        """Radii (B,) of spheres around the boxes: half the diagonal, times `factor`."""
        half = self.terms[3:6]
        return np.asarray(self.factor * np.sqrt(np.einsum("ij,ij->j", half, half)))

    def widened(self, mean_step: float | Float64, log_scale_step: float | Float64) -> ChunkBounds:
        """Return the bounds after training steps that may have moved the Gaussians.

        mean_step, log_scale_step: the most by which a coordinate of a mean, and a log scale, have changed: a number for
            all chunks, or an array (B,). `with_rounding` adds the rounding of updates.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            return ChunkBounds(self.terms.copy(), self.factor).widen(mean_step, log_scale_step)

    def widen(self, mean_step: float | Float64, log_scale_step: float | Float64) -> ChunkBounds:
        """Widen these bounds in place, and return them. The arguments are those of `widened`. NumPy may warn of
        infinities."""
        self.terms[3:6] += mean_step
        self.terms[7] += 3 * self.factor * mean_step
        self.terms[6] *= np.exp(log_scale_step)
        return self

    def with_rounding(self, updates: int) -> ChunkBounds:
        """Return the bounds after `updates` updates of each parameter by 0, each of which rounds it to float32. For
        other updates, widen the result by their sum times `rounded_share(updates)`.

        After a change by d a value is at most size + d, if its absolute value before is at most `size`. So each
        rounding is at most (size + d) 2^-24, and the change with n roundings is at most

            d = (step + n 2^-24 size) / (1 - n 2^-24),

        where `step` is the largest sum of all updates without rounding.
        """
        terms, share = self.terms, updates * _HALF_ULP * rounded_share(updates)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            size = (np.abs(terms[:3]) + terms[3:6]).max(axis=0, initial=0.0)
            return self.widened(share * size, share * np.abs(np.log(terms[6])))


def measured_sides(means: Float32, log_scales: Float32, rows: int = CHUNK_ROWS) -> Float32:
    """Return an array (B, 7) for a model's chunks: the smallest coordinates (3) of their means, the largest coordinates
    (3), and the largest log scales. The kernel `bounds` (`stages/bounds.py`) measures the same on a device.

    means, log_scales: (n, 3). rows: number of Gaussians in a chunk.
    """
    starts = np.arange(0, len(means), rows)
    if len(starts) == 0:
        return np.zeros((0, 7), np.float32)
    lowest, highest = np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts)
    largest = np.maximum.reduceat(log_scales.max(axis=1), starts)
    return np.column_stack([lowest, highest, largest])


def rounded_share(updates: int) -> float:
    """Return the factor on the sum of all updates in `ChunkBounds.with_rounding`; infinite for too many updates."""
    share = updates * _HALF_ULP
    return 1 / (1 - share) if share < 1 else math.inf


def largest_step(config: OptimiserConfig) -> float:
    """Return the largest change of a parameter by a step of Adam, as a multiple of the learning rate: 7.3 by default.

    Let b1, b2 be the decays, r = b1^2 / b2 < 1, and S(x) = 1 + x + ... + x^(t - 1). Take t steps with gradients g_i. By
    Cauchy and Schwarz, their moments m and v have the bound

        |m| <= (1 - b1) sum b1^(t - i) |g_i|
             = (1 - b1) sum r^((t - i) / 2) b2^((t - i) / 2) |g_i|
            <= (1 - b1) sqrt(S(r)) sqrt(v / (1 - b2)).

    With the corrections by 1 - b1^t = (1 - b1) S(b1) and 1 - b2^t, the step is at most sqrt(S(r) S(b2)) / S(b1) rates.
    This is 1 at t = 1, and rises towards its limit

        (1 - b1) / sqrt((1 - b2) (1 - r)).

    It rises because log S(e^u) grows from t to t + 1 by a convex function of u, and b1 is the geometric mean of r and
    b2. A row with fewer updates than the t of the corrections has a smaller S(r), so the bound holds for it too.

    The bound takes into account that the kernel has float32 decays, and the corrections float64 ones. It is infinite if
    r >= 1, or if epsilon is so small that second moments below float32's range matter.
    """
    beta1, beta2, root = _decays(config)
    if root >= 1 or beta2 >= 1 or config.epsilon < _LEAST_EPSILON:
        return math.inf
    limit = (1 - beta1) / math.sqrt((1 - beta2) * (1 - root**2))
    # the moments have float32 decays and the corrections float64 decays, which matters most at the first step
    first = (1 - beta1) / (1 - config.beta1)
    second = math.sqrt((1 - config.beta2) / (1 - beta2))
    return limit * max(first, 1.0) * max(second, 1.0) * (1 + _SLACK)


def largest_resumed_step(config: OptimiserConfig, ratio: float, step: int) -> float:
    """Return `largest_step` after a resume from a checkpoint whose moments may be from a training with other decays.

    Let c be the limit in `largest_step`, so that (1 - b1)^2 / (1 - b2) = (1 - r) c^2. Let |m| <= d sqrt(v) with d >= c.
    By Cauchy and Schwarz, the next moments have the bound

        |b1 m + (1 - b1) g| <= sqrt(r d^2 + (1 - r) c^2) sqrt(b2 v + (1 - b2) g^2) <= d sqrt(v of the next step).

    So d stays a bound. The correction of a later step is at most 1 / (1 - b1^t).

    ratio: the largest |m| / sqrt(v) in the checkpoint.
    step: number of the checkpoint's step.
    """
    return max(largest_step(config), ratio / (1 - config.beta1 ** (step + 1)) * (1 + _SLACK))


def hidden_path(config: OptimiserConfig, step: float | None = None) -> float:
    """Return the largest change of a parameter by any number of steps with gradient 0: 66 learning rates by default.

    In the k-th step with gradient 0, the first moment has fallen to b1^k times its value, and the root of the second to
    b2^(k / 2) times. So by the argument of `largest_step` that step is at most (b1 / sqrt(b2))^k times the bound of a
    step, and the sum over k = 1, 2, ... is a geometric series. Sparse Adam takes no steps with gradient 0.

    step: bound of a step, as a multiple of the learning rate; None takes `largest_step`.
    """
    _, _, root = _decays(config)
    step = largest_step(config) if step is None else step
    return step * root / (1 - root) if math.isfinite(step) else math.inf


def _decays(config: OptimiserConfig) -> tuple[float, float, float]:
    """Return the kernel's float32 decays b1 and b2, and sqrt(r) = b1 / sqrt(b2), enlarged by _ROUNDING."""
    beta1, beta2 = float(np.float32(config.beta1)), float(np.float32(config.beta2))
    root = beta1 / math.sqrt(beta2) * (1 + _ROUNDING) if beta2 > 0 else math.inf
    return beta1, beta2, root
