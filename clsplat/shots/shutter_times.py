# SPDX-License-Identifier: Apache-2.0
"""Times of a frame's samples. No OpenCL here."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.pictures import SamplingConfig


def sample_times(count: int) -> Float64:
    """`count` stratified times in (0, 1), one per interval of equal length.

    Their order, the ranks of van der Corput's sequence, is uncorrelated with the lens samples.
    """
    index, radical, digit = np.arange(count), np.zeros(count), 0.5
    while index.any():
        radical += digit * (index & 1)
        index, digit = index >> 1, digit / 2
    return np.asarray((np.argsort(np.argsort(radical)) + 0.5) / count)


def sample_moments(config: SamplingConfig) -> list[float]:
    """The time of each sample, in frames from the frame: spread over the open shutter, or its middle without motion
    blur."""
    if not config.on or config.samples == 1:
        return [config.middle]
    if not config.moves:
        return [config.middle] * config.samples
    begin, end = config.shutter
    return [float(time) for time in begin + (end - begin) * sample_times(config.samples)]
