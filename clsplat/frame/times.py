# SPDX-License-Identifier: Apache-2.0
"""Times of a frame's samples. Policy: no OpenCL."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.pictures import SamplingConfig


def sample_times(count: int) -> Float64:
    """`count` times in (0, 1), each in an interval of its own, in an order that has nothing to do with the lens's
    (ranks of van der Corput's sequence)."""
    index, radical, digit = np.arange(count), np.zeros(count), 0.5
    while index.any():
        radical += digit * (index & 1)
        index, digit = index >> 1, digit / 2
    return np.asarray((np.argsort(np.argsort(radical)) + 0.5) / count)


def sample_moments(config: SamplingConfig) -> list[float]:
    """The time of each sample, in frames from the frame: all over the shutter's where it stays open, else its
    middle."""
    if not config.on or config.samples == 1:
        return [config.middle]
    if not config.moves:
        return [config.middle] * config.samples
    begin, end = config.shutter
    return [float(time) for time in begin + (end - begin) * sample_times(config.samples)]
