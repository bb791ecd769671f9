# SPDX-License-Identifier: Apache-2.0
"""The model on the host: a structure of arrays, as stored (raw quaternions, log scales, opacity logits)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


@dataclass(eq=False)
class Gaussians:
    """N Gaussians.

    means (N, 3); quaternions (N, 4), w x y z, not normalised; log_scales (N, 3), natural logs of the standard
    deviations; opacity_logits (N,); sh (N, K, 3), K = (degree + 1)^2 real SH coefficients per channel,
    colour = 0.5 + sum of basis times coefficient. All float32, C-contiguous.
    """

    means: Float32
    quaternions: Float32
    log_scales: Float32
    opacity_logits: Float32
    sh: Float32

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        return round(float(np.sqrt(self.sh.shape[1]))) - 1
