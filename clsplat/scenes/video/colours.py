# SPDX-License-Identifier: Apache-2.0
"""Conversion of video frames to the space of photographs: display values of Rec.709 primaries, 8 bits, as in a JPEG.

Frames of standard range keep their display values, apart from wider primaries. HLG (ARIB STD-B67) and PQ (SMPTE
ST 2084) become display light by Rec. ITU-R BT.2100, divided by the reference white of BT.2408, 203 cd/m^2. A curve
compresses highlights, and the result is encoded by sRGB's curve (IEC 61966-2-1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32

REFERENCE_WHITE_NITS = 203.0
"""Luminance in cd/m^2 of diffuse white in HLG and PQ (BT.2408, table 1). It is the linear value 1 before highlights are
compressed."""
HDR_PEAK_NITS = 1000.0
"""Luminance in cd/m^2 that becomes white, as all brighter values do: HLG's nominal peak in BT.2100."""
HIGHLIGHT_KNEE = 0.6
"""Linear value up to which light stays unchanged. Higher values, up to the peak, are compressed to 1 at most."""
HLG_SYSTEM_GAMMA = 1.2
"""Exponent of HLG's opto-optical transfer function for a display of 1000 cd/m^2 (BT.2100, table 5)."""
SDR_DISPLAY_GAMMA = 2.4
"""Exponent of a display of standard range (BT.1886)."""
HLG, PQ = 18, 16
"""Transfer characteristics of HLG and PQ, by H.273."""
LUMA_WEIGHTS_BY_MATRIX = {
    1: (0.2126, 0.7152, 0.0722),
    4: (0.30, 0.59, 0.11),
    5: (0.299, 0.587, 0.114),
    6: (0.299, 0.587, 0.114),
    7: (0.212, 0.701, 0.087),
    9: (0.2627, 0.6780, 0.0593),
    10: (0.2627, 0.6780, 0.0593),
}
"""Weights of red, green and blue in luma, by the number of the matrix in H.273: Rec.709, FCC, Rec.601 twice, SMPTE
240M and BT.2020 twice."""
_REC2020_TO_REC709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]], np.float32
)
"""Matrix to linear Rec.709 from linear BT.2020 (BT.2087, equation 5)."""
_P3_TO_REC709 = np.array(
    [[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098274]], np.float32
)
"""Matrix to linear Rec.709 from linear Display P3 (SMPTE EG 432-1, white D65)."""
_MATRIX_TO_REC709 = {9: _REC2020_TO_REC709, 12: _P3_TO_REC709}
CURVE_TABLE_ENTRIES = 1 << 16
"""Entries of a tabulated curve. Where sRGB's curve is steepest, neighbouring entries differ by 0.05/255."""
_ROWS = 64


@dataclass(frozen=True)
class Coding:
    """Coding of a video's pixels.

    matrix, primaries, transfer: numbers of the luma matrix, the primaries and the transfer function in H.273.
    full_range: True if luma uses all values, False if it has black at 16 and white at 235 (for 8 bits).
    """

    matrix: int
    primaries: int
    transfer: int
    full_range: bool

    @property
    def is_hdr(self) -> bool:
        """True for HLG and PQ."""
        return self.transfer in (HLG, PQ)

    @property
    def label(self) -> str:
        """Name of the transfer function for users: HLG, PQ or SDR."""
        return {HLG: "HLG", PQ: "PQ"}.get(self.transfer, "SDR")


@dataclass(frozen=True, eq=False)
class Planes:
    """Luma (H, W) and chroma of a frame. Chroma has full or half width and height. bits: bits per value."""

    y: NDArray[Any]
    cb: NDArray[Any]
    cr: NDArray[Any]
    bits: int


def display_rgb(planes: Planes, coding: Coding, quarter_turns: int = 0) -> NDArray[np.uint8]:
    """Return a frame (H, W, 3) in the space of photographs, turned counter-clockwise by `quarter_turns`.

    Chroma of half width is interpolated linearly. A chroma sample lies on the left one of two luma samples, as in H.264
    and HEVC.
    """
    height, width = planes.y.shape
    pixels = np.empty((height, width, 3), np.uint8)
    chroma = [_widened(plane, width) for plane in (planes.cb, planes.cr)]
    for top in range(0, height, _ROWS):
        rows = slice(top, min(top + _ROWS, height))
        rgb = _signal(planes, chroma, rows, coding)
        pixels[rows] = _encoded(rgb, coding)
    return np.ascontiguousarray(np.rot90(pixels, quarter_turns))


def _widened(plane: NDArray[Any], width: int) -> Float32:
    """Return chroma as floats, interpolated to the width of luma. Samples of half width lie on even columns."""
    values = plane.astype(np.float32)
    if plane.shape[1] == width:
        return values
    wide = np.empty((plane.shape[0], 2 * plane.shape[1]), np.float32)
    wide[:, 0::2] = values
    wide[:, 1:-1:2] = 0.5 * (values[:, :-1] + values[:, 1:])
    wide[:, -1] = values[:, -1]
    return wide[:, :width]


def _signal(planes: Planes, chroma: list[Float32], rows: slice, coding: Coding) -> Float32:
    """Return the non-linear R'G'B' of some rows, nominally in [0, 1], by H.273's equations of matrix and range.

    chroma: Cb and Cr at the width of luma, and at its height or half of it.
    """
    unit = 2.0 ** (planes.bits - 8)
    largest = 2**planes.bits - 1
    scale_y, scale_c = (largest, largest) if coding.full_range else (219 * unit, 224 * unit)
    black = 0.0 if coding.full_range else 16 * unit
    y = (planes.y[rows].astype(np.float32) - np.float32(black)) * np.float32(1 / scale_y)
    tall = chroma[0].shape[0] == planes.y.shape[0]
    cb, cr = (
        ((plane[rows] if tall else _heightened(plane, rows)) - np.float32(128 * unit)) * np.float32(1 / scale_c)
        for plane in chroma
    )
    red, green, blue = LUMA_WEIGHTS_BY_MATRIX.get(coding.matrix, LUMA_WEIGHTS_BY_MATRIX[1])
    rgb = np.empty((*y.shape, 3), np.float32)
    rgb[:, :, 0] = y + np.float32(2 * (1 - red)) * cr
    rgb[:, :, 2] = y + np.float32(2 * (1 - blue)) * cb
    of_cb, of_cr = 2 * blue * (1 - blue) / green, 2 * red * (1 - red) / green
    rgb[:, :, 1] = y - np.float32(of_cb) * cb - np.float32(of_cr) * cr
    return rgb


def _heightened(plane: Float32, rows: slice) -> Float32:
    """Interpolate chroma of half height to some rows of luma. A row of chroma lies midway between two rows of luma."""
    at = np.arange(rows.start, rows.stop)
    near = np.minimum(at // 2, len(plane) - 1)
    far = np.clip(np.where(at % 2 == 0, near - 1, near + 1), 0, len(plane) - 1)
    return np.asarray(np.float32(0.75) * plane[near] + np.float32(0.25) * plane[far])


def _encoded(rgb: Float32, coding: Coding) -> NDArray[np.uint8]:
    """Convert a video's non-linear R'G'B' to 8-bit display values of Rec.709 primaries."""
    matrix = _MATRIX_TO_REC709.get(9 if coding.is_hdr and coding.primaries == 2 else coding.primaries)
    if coding.is_hdr:
        light = display_light(rgb, coding.transfer)
        return _looked_up(_srgb_table(), compressed(light if matrix is None else light @ matrix.T))
    if matrix is not None:
        light = np.clip(rgb, 0, 1) ** np.float32(SDR_DISPLAY_GAMMA)
        rgb = np.clip(light @ matrix.T, 0, 1) ** np.float32(1 / SDR_DISPLAY_GAMMA)
    return np.asarray(np.clip(np.rint(rgb * np.float32(255)), 0, 255), np.uint8)


def display_light(signal: Float32, transfer: int) -> Float32:
    """Return the display's linear light (..., 3) of an HLG or PQ signal, in multiples of REFERENCE_WHITE_NITS.

    HLG's light depends on the pixel's luminance, with the weights of BT.2020 (BT.2100, table 5).
    """
    light = _looked_up(_light_table(transfer), signal)
    if transfer == PQ:
        return light
    luminance = light @ np.array(LUMA_WEIGHTS_BY_MATRIX[9], np.float32)
    peak = np.float32(HDR_PEAK_NITS / REFERENCE_WHITE_NITS)
    gain = peak * np.maximum(luminance, np.float32(1e-6)) ** np.float32(HLG_SYSTEM_GAMMA - 1)
    return np.asarray(light * gain[..., None])


def _looked_up(table: NDArray[Any], values: Float32) -> NDArray[Any]:
    """Clip values to [0, 1], and return the nearest entries of a table that covers this range evenly."""
    last = np.float32(len(table) - 1)
    return np.asarray(table[(np.clip(values, 0, 1) * last + np.float32(0.5)).astype(np.intp)])


@lru_cache(maxsize=2)
def _light_table(transfer: int) -> Float32:
    """Return linear light at equidistant signals in [0, 1].

    For HLG it is scene light in [0, 1], for PQ display light in multiples of REFERENCE_WHITE_NITS.

    BT.2100, table 4 for PQ (the EOTF) and table 5 for HLG (the inverse OETF).
    """
    signal = np.linspace(0, 1, CURVE_TABLE_ENTRIES)
    if transfer == PQ:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
        root = signal ** (1 / m2)
        light = 10000 / REFERENCE_WHITE_NITS * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
    else:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    return light.astype(np.float32)


def compressed(light: Float32) -> Float32:
    """Compress highlights of linear light (..., 3): values up to HIGHLIGHT_KNEE stay, HDR_PEAK_NITS becomes 1.

    All three channels are scaled by the factor of the largest one, which keeps the hue. The curve is the hyperbola that
    continues the line y = x with the same slope at the knee (FFmpeg's tonemap calls the curve Möbius).
    """
    peak, knee = np.float32(HDR_PEAK_NITS / REFERENCE_WHITE_NITS), np.float32(HIGHLIGHT_KNEE)
    most = light.max(axis=-1)
    a = -(knee**2) * (peak - 1) / (knee**2 - 2 * knee + peak)
    b = (knee**2 - 2 * knee * peak + peak) / (peak - 1)
    bent = (b**2 + 2 * b * knee + knee**2) / (b - a) * (most + a) / np.maximum(most + b, np.float32(1e-6))
    factor = np.where(most <= knee, np.float32(1), bent / np.maximum(most, np.float32(1e-6)))
    return np.asarray(light * factor[..., None])


@lru_cache(maxsize=1)
def _srgb_table() -> NDArray[np.uint8]:
    """Return sRGB's display values of 8 bits at equidistant linear light in [0, 1] (IEC 61966-2-1)."""
    light = np.linspace(0, 1, CURVE_TABLE_ENTRIES)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * signal), np.uint8)
