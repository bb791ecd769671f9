# SPDX-License-Identifier: Apache-2.0
"""Measurements on the frames of a video: sharpness, brightness, and the motion of each block from frame to frame.

Motion is measured by phase correlation of square blocks (Kuglin and Hines 1975). Lengths are fractions of the frame's
longer side, so that they do not depend on the number of pixels. Texts call this unit "longer sides".
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.scenes.thumbnail import SHARPNESS_SIDE_PX, THUMBNAIL_SIDE_PX, sharpness_of

MOTION_SIDE_PX = 240
"""Longer side in pixels of the frames between which motion is measured."""
MAX_BLOCK_SIDE_PX = 64
"""Largest side in pixels of a block, a power of two. Motion of up to half of the side can be measured."""
BLOCK_COLUMNS, BLOCK_ROWS = 4, 3
"""Number of blocks across the longer and the shorter side of a frame."""
MIN_BLOCK_CONTRAST = 2.5 / 255
"""Standard deviation, of values in [0, 1], below which a block has no texture that could be matched."""
MIN_CORRELATION_PEAK = 0.17
"""Smallest peak of the phase correlation of two blocks that match; equal blocks have 1. Of unrelated blocks with a side
of 64 pixels, 1 in 1000 has a higher peak. For smaller blocks the limit rises in inverse proportion to the side."""
LOST_MOTION = 0.2
"""Motion, in longer sides, that is assumed between two frames whose textured blocks do not match."""
_LOW_PASS_CYCLES = 0.2
"""Standard deviation, in cycles per pixel, of the Gaussian weight of frequencies in phase correlation."""


def reduced_luma(luma: NDArray[np.unsignedinteger[Any]], side: int) -> NDArray[np.uint32]:
    """Sum luma (H, W) over squares, so that the longer side has at most `side` pixels. Sums are exact integers."""
    return np.asarray(_summed(luma, -(-max(luma.shape) // side), np.uint32), np.uint32)


def _summed(image: NDArray[Any], factor: int, dtype: type[np.generic]) -> NDArray[Any]:
    """Sum an image (H, W) over squares of `factor` x `factor` pixels. Incomplete squares at the edges are left out.

    Slices are added one by one, because NumPy's sums over short axes take several times as long.
    """
    height, width = (length // factor for length in image.shape)
    cut = image[: height * factor, : width * factor]
    down = cut[0::factor].astype(dtype)
    for row in range(1, factor):
        down += cut[row::factor]
    total = np.array(down[:, 0::factor])
    for column in range(1, factor):
        total += down[:, column::factor]
    return total


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements on all frames of a video, in display order. F: frames, B: blocks.

    seconds: (F,), times since the first frame.
    whole: (F,), False for frames in which the decoder concealed errors.
    sharpness: (F,), by `thumbnail.sharpness_of`.
    brightness: (F,), mean luma in [0, 1].
    textured: (F,), fraction of the blocks with texture.
    flow: (F, B, 2), motion x, y of each block since the frame before, in longer sides; NaN for blocks without a match.
    motion: (F,), mean length of the flow; LOST_MOTION if most textured blocks do not match; 0 for the first frame.
    places: (B, 2), centres of the blocks, in longer sides from the frame's centre.
    thumbnails: (F, h, w) uint8.
    """

    seconds: Float64
    whole: NDArray[np.bool_]
    sharpness: Float64
    brightness: Float64
    textured: Float64
    flow: Float64
    motion: Float64
    places: Float64
    thumbnails: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.seconds)


@dataclass
class Meter:
    """Measures frames one after the other, in display order.

    black, white: the stored luma of black and of white.
    """

    black: float
    white: float
    _rows: list[tuple[float, bool, float, float, float]] = field(default_factory=list)
    _flows: list[Float64] = field(default_factory=list)
    _thumbnails: list[NDArray[np.uint8]] = field(default_factory=list)
    _last: BlockSpectra | None = None

    def add(self, luma: NDArray[Any], seconds: float, *, whole: bool) -> None:
        """Measure a frame.

        luma: (H, W), as stored; all frames have the same size.
        seconds: time since the first frame.
        whole: False if the decoder concealed errors in the frame.
        """
        sums = reduced_luma(luma, SHARPNESS_SIDE_PX)
        per_pixel = (-(-max(luma.shape) // SHARPNESS_SIDE_PX)) ** 2
        scale = np.float32(1 / ((self.white - self.black) * per_pixel))
        grey = np.clip((sums.astype(np.float32) - np.float32(self.black * per_pixel)) * scale, 0, 1)
        spectra = BlockSpectra.of(_averaged(grey, MOTION_SIDE_PX))
        flow = spectra.flow_from(self._last) if self._last is not None else np.zeros((len(spectra.places), 2))
        self._last = spectra
        self._flows.append(flow)
        self._rows.append((seconds, whole, sharpness_of(grey), float(grey.mean()), float(spectra.textured.mean())))
        self._thumbnails.append(np.rint(255 * _averaged(grey, THUMBNAIL_SIDE_PX)).astype(np.uint8))

    def measurements(self) -> Measurements:
        """Return the measurements on all frames added so far. There must be at least one."""
        assert self._last is not None
        seconds, whole, sharpness, brightness, textured = (np.array(column) for column in zip(*self._rows, strict=True))
        flow = np.stack(self._flows)
        motion = _motion(flow, textured)
        return Measurements(
            seconds, whole.astype(bool), sharpness, brightness, textured, flow, motion, self._last.places,
            np.stack(self._thumbnails),
        )  # fmt: skip


def _averaged(grey: Float32, side: int) -> Float32:
    """Average a picture (H, W) over squares, so that the longer side has at most `side` pixels."""
    factor = -(-max(grey.shape) // side)
    return np.asarray(_summed(grey, factor, np.float32) * np.float32(1 / factor**2), np.float32)


def _motion(flow: Float64, textured: Float64) -> Float64:
    """Return the mean motion (F,) of each frame's matched blocks; LOST_MOTION if under a quarter of the textured match.

    flow, textured: as in Measurements.
    """
    lengths = np.linalg.norm(flow, axis=2)
    matched = np.isfinite(lengths)
    mean = np.where(matched, lengths, 0).sum(axis=1) / np.maximum(matched.sum(axis=1), 1)
    expected = np.minimum(textured, np.concatenate([textured[:1], textured[:-1]])) * flow.shape[1]
    lost = matched.sum(axis=1) < 0.25 * expected
    lost[0] = False
    return np.where(lost, LOST_MOTION, mean)


@lru_cache(maxsize=4)
def _grid(height: int, width: int) -> tuple[int, tuple[tuple[int, int], ...]]:
    """Return the side of the blocks of a frame, and their corners (top, left)."""
    side = min(MAX_BLOCK_SIDE_PX, 1 << int(np.log2(min(height, width) / 1.4)))
    rows, columns = (BLOCK_ROWS, BLOCK_COLUMNS) if width >= height else (BLOCK_COLUMNS, BLOCK_ROWS)
    tops, lefts = (
        np.linspace(0, length - side, count).astype(int) for length, count in ((height, rows), (width, columns))
    )
    return side, tuple((int(top), int(left)) for top in tops for left in lefts)


@lru_cache(maxsize=4)
def _windows(side: int) -> tuple[Float32, Float32]:
    """Return the window (side, side) of a block, and the weights (side, side / 2 + 1) of its frequencies.

    Over the full spectrum, with the frequencies that a real transform leaves out, the weights sum to 1.
    """
    from scipy import fft  # imported here, as the import takes 0.1 s and few commands need it

    hann = np.hanning(side + 2)[1:-1]
    squared = fft.fftfreq(side)[:, None] ** 2 + fft.rfftfreq(side)[None] ** 2
    weights = np.exp(-0.5 * squared / _LOW_PASS_CYCLES**2)
    weights[0, 0] = 0  # the mean brightness does not move
    both = weights.copy()
    both[:, 1 : side // 2] *= 2  # count also for the conjugate frequencies, which a real transform leaves out
    return np.outer(hann, hann).astype(np.float32), (weights / both.sum()).astype(np.float32)


@dataclass(frozen=True, eq=False)
class BlockSpectra:
    """Fourier transforms of a frame's blocks.

    spectra: (B, side, side / 2 + 1), each value divided by its magnitude.
    textured: (B,), True for blocks with enough contrast.
    places: (B, 2), centres of the blocks, in longer sides from the frame's centre.
    side: side of a block in pixels. longest: longer side of the frame in pixels.
    """

    spectra: NDArray[np.complex64]
    textured: NDArray[np.bool_]
    places: Float64
    side: int
    longest: int

    @classmethod
    def of(cls, grey: Float32) -> BlockSpectra:
        """Transform the blocks of a frame (H, W) of values in [0, 1]."""
        from scipy import fft  # as above

        height, width = grey.shape
        side, corners = _grid(height, width)
        blocks = np.stack([grey[top : top + side, left : left + side] for top, left in corners])
        blocks = blocks - blocks.mean(axis=(1, 2), keepdims=True)
        textured = blocks.std(axis=(1, 2)) >= MIN_BLOCK_CONTRAST
        spectra = fft.rfft2(blocks * _windows(side)[0])
        spectra /= np.maximum(np.abs(spectra), np.float32(1e-9))
        longest = max(height, width)
        centres = np.array([(left + side / 2 - width / 2, top + side / 2 - height / 2) for top, left in corners])
        return cls(spectra, textured, centres / longest, side, longest)

    def flow_from(self, earlier: BlockSpectra) -> Float64:
        """Return the motion (B, 2) of the blocks since an earlier frame, in longer sides; NaN without a match."""
        from scipy import fft  # as above

        surface = fft.irfft2(self.spectra * earlier.spectra.conj() * _windows(self.side)[1], s=(self.side, self.side))
        surface *= np.float32(self.side**2)
        count = len(surface)
        at = surface.reshape(count, -1).argmax(axis=1)
        rows, columns = at // self.side, at % self.side
        every = np.arange(count)
        peak = surface[every, rows, columns]
        shifts = np.empty((count, 2))
        for axis, place in enumerate((columns, rows)):
            sides = []
            for step in (-1, 1):
                near = (place + step) % self.side
                sides.append(surface[every, rows, near] if axis == 0 else surface[every, near, columns])
            whole = (place + self.side // 2) % self.side - self.side // 2
            shifts[:, axis] = whole + _vertex(sides[0], peak, sides[1])
        least = MIN_CORRELATION_PEAK * MAX_BLOCK_SIDE_PX / self.side
        matched = self.textured & earlier.textured & (peak >= least)
        return np.where(matched[:, None], shifts / self.longest, np.nan)


def _vertex(left: Float32, middle: Float32, right: Float32) -> Float64:
    """Return the offset in pixels from `middle` to the peak of a Gaussian through three neighbouring values.

    It is 0 if the values have no peak.

    The correlation of two shifted blocks is a Gaussian, because its frequencies have Gaussian weights.
    """
    logs = [np.log(np.maximum(values, 1e-6)).astype(np.float64) for values in (left, middle, right)]
    bend = logs[0] - 2 * logs[1] + logs[2]
    offset = np.where(bend < -1e-9, 0.5 * (logs[0] - logs[2]) / np.where(bend < -1e-9, bend, 1), 0.0)
    return np.clip(offset, -0.5, 0.5)
