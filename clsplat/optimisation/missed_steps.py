# SPDX-License-Identifier: Apache-2.0
"""Factors by which late Adam (--optimiser.late) makes up for the steps that a Gaussian missed while out of view.

Steps that Adam refuses because values are not finite: `kernels/shared/adam.h`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.config.training import OptimiserConfig

MOST_MISSED = 256
"""Largest number of steps that a Gaussian may miss. Every 256 steps all Gaussians make up for the steps that they
missed, which takes as long as one step of Adam over all rows. The 256th missed step moves a parameter by 2e-12 of
what the first one does."""


class MissedSteps:
    """Factors for Gaussians that missed the last 0 to MOST_MISSED steps.

    groups: names of the parameter groups.
    factors: (MOST_MISSED + 1, groups, 3), by the number of missed steps. The last axis has factors a, b and c.
        In the missed steps, a parameter moves by -a m / (sqrt(v) + epsilon), and its moments m, v become b m, c v.
    """

    def __init__(self, config: OptimiserConfig, groups: Sequence[str], factors: Float64 | None = None) -> None:
        if factors is None:
            factors = np.zeros((MOST_MISSED + 1, len(groups), 3))
            factors[:, :, 1:] = 1.0
        self.groups, self.factors = tuple(groups), factors
        # Decays are rounded to float32, as in Adam's kernels. With a float64 decay of 0.999, moments would differ by
        # 3e-6 after 256 steps.
        self._decays = np.array([config.beta1, config.beta2], np.float32).astype(np.float64)

    def add(self, scales: Mapping[str, float]) -> None:
        """Take one more step into account in the factors (equations (190) and (191) of docs/gradients.md).

        scales: learning rate times sqrt(1 - beta2^t) / (1 - beta1^t), for each group that the step updates.
        """
        self.factors[1:] = self.factors[:-1]
        self.factors[0] = 0.0, 1.0, 1.0
        for index, group in enumerate(self.groups):
            if group in scales:
                missed = self.factors[1:, index]
                missed[:, 1:] *= self._decays
                missed[:, 0] += scales[group] * missed[:, 1] / np.sqrt(missed[:, 2])

    def rounded(self) -> Float32:
        """The factors in float32, for the device."""
        return self.factors.astype(np.float32)
