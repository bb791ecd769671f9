# SPDX-License-Identifier: Apache-2.0
"""Resolution of the pictures in each training step (--warmup): small at first, as there is no fine detail to fit yet.
Uses no OpenCL."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """Schedule of the pictures' size: the divisor of width and height in each step.

    until: pairs (last step, factor), with increasing steps and decreasing factors. After the last of these steps the
        size is full.
    """

    until: tuple[tuple[int, float], ...]

    @property
    def factors(self) -> tuple[float, ...]:
        """Divisors of the photographs' width and height in the course of the training, in order."""
        return (*(factor for _, factor in self.until), 1.0)

    def factor(self, step: int) -> float:
        """Divisor of the photographs' width and height at step number `step`, which counts from 1."""
        for last, factor in self.until:
            if step <= last:
                return factor
        return 1.0


def by_doubling(warmup: tuple[int, ...]) -> Sizes:
    """Schedule in which the size doubles after each step of `warmup`, up to full size (Kerbl et al. 2023, 7.1)."""
    return Sizes(tuple((last, float(2 ** (len(warmup) - index))) for index, last in enumerate(warmup)))
