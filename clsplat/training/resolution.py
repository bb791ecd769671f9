# SPDX-License-Identifier: Apache-2.0
"""Size of the pictures in each training step: low first, as nothing fine is fitted yet. Policy only: no device."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FACTORS = (8.0, 4 * 2**0.5, 4.0, 2 * 2**0.5, 2.0, 2**0.5)
"""Divisors of the sizes while the resolution rises by the photographs' spectra."""


@dataclass(frozen=True)
class Sizes:
    """until: (last step, factor) with rising steps and falling factors; after the last one the size is full."""

    until: tuple[tuple[int, float], ...]

    def factor(self, step: int) -> float:
        """Divisor of the photographs' width and height at `step`, from 1."""
        return next((factor for last, factor in self.until if step <= last), 1.0)


def by_doubling(warmup: tuple[int, ...]) -> Sizes:
    """Twice the size after each of these steps (Kerbl et al. 2023, section 7.1)."""
    return Sizes(tuple((last, float(2 ** (len(warmup) - index))) for index, last in enumerate(warmup)))


def by_spectra(images: Iterable[NDArray[np.float32]], steps: int) -> Sizes:
    """The size is 1/factor until the share of `steps` that is the share of the photographs' spectra, in amplitudes,
    that such a size can hold (DashGaussian, Chen et al. 2025, section 4.1: as much time for a frequency as it has
    weight).

    images: some photographs, (H, W, 3 or 4).
    """
    shares = np.mean([spectrum_shares(image) for image in images], axis=0)
    lasts = [round(steps * float(share)) for share in shares]
    return Sizes(tuple((last, factor) for last, factor in zip(lasts, FACTORS, strict=True) if last > 0))


def spectrum_shares(image: NDArray[np.float32]) -> NDArray[np.float64]:
    """Shares of the amplitudes of the image's grey values, their mean left out, for each of FACTORS: those under the
    highest frequency that an image smaller by it has, along either axis; (len(FACTORS),), rising. 0 for a blank image,
    which says nothing."""
    grey = image[..., :3].astype(np.float64).mean(axis=2)
    height, width = grey.shape
    window = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])  # else the image's edges are in it
    amplitudes = np.abs(np.fft.rfft2((grey - grey.mean()) * window))
    amplitudes[:, 1 : (width + 1) // 2] *= 2  # of columns that stand for their mirror images too
    total = amplitudes.sum()
    if total <= 1e-9 * grey.size:
        return np.zeros(len(FACTORS))
    vertical, horizontal = np.abs(np.fft.fftfreq(height))[:, None], np.fft.rfftfreq(width)[None]
    highest = np.maximum(vertical, horizontal)
    return np.array([amplitudes[highest < 0.5 / factor].sum() / total for factor in FACTORS])


def sizes_of(
    warmup: tuple[int, ...], frequency_steps: int, count: int, load: Callable[[int], NDArray[np.float32]]
) -> Sizes:
    """Sizes by the spectra of at most 16 of `count` photographs, evenly spread and each read by `load`; by doubling
    where `frequency_steps` is 0."""
    if frequency_steps == 0:
        return by_doubling(warmup)
    some = sorted({round(index) for index in np.linspace(0, count - 1, min(count, 16))})
    return by_spectra((load(index) for index in some), frequency_steps)
