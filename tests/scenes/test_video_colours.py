# SPDX-License-Identifier: Apache-2.0
"""Colours of videos: closed forms of BT.2100, BT.2408 and H.273, and FFmpeg's zscale and tonemap as a judge."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from walk_videos import hlg_signal

from clsplat.scenes.video.colours import (
    HDR_PEAK_NITS,
    HIGHLIGHT_KNEE,
    HLG,
    PQ,
    REFERENCE_WHITE_NITS,
    Coding,
    Planes,
    compressed,
    display_light,
    display_rgb,
)

REC709 = Coding(matrix=1, primaries=1, transfer=1, full_range=False)
HDR = Coding(matrix=9, primaries=9, transfer=HLG, full_range=False)
PEAK = HDR_PEAK_NITS / REFERENCE_WHITE_NITS


def flat(y: int, cb: int, cr: int, bits: int = 8, size: tuple[int, int] = (4, 6)) -> Planes:
    dtype = np.uint8 if bits == 8 else np.uint16
    return Planes(*(np.full(size, value, dtype) for value in (y, cb, cr)), bits)  # type: ignore[misc]


def grey(values: NDArray[np.float64] | list[float]) -> NDArray[np.float32]:
    return np.repeat(np.asarray(values, np.float32)[:, None], 3, axis=1)


@pytest.mark.parametrize(
    ("planes", "coding", "wanted"),
    [
        (flat(16, 128, 128), REC709, (0, 0, 0)),
        (flat(235, 128, 128), REC709, (255, 255, 255)),
        (flat(940, 512, 512, 10), REC709, (255, 255, 255)),
        (flat(255, 128, 128), Coding(1, 1, 1, full_range=True), (255, 255, 255)),
        (flat(128, 128, 128), Coding(1, 1, 1, full_range=True), (128, 128, 128)),
        (flat(1, 128, 128), REC709, (0, 0, 0)),  # below black
        # pure red by hand: Y = 16 + 219 Kr, Cb = 128 - 112 Kr / (1 - Kb), Cr = 128 + 112; rounded to integers
        (flat(63, 102, 240), REC709, (255, 0, 0)),
        (flat(81, 90, 240), Coding(6, 6, 6, full_range=False), (254, 0, 0)),
    ],
)
def test_codes_of_known_colours(planes: Planes, coding: Coding, wanted: tuple[int, int, int]) -> None:
    # one level: the codes of red are rounded to integers, which are up to 1.2 levels apart
    np.testing.assert_allclose(display_rgb(planes, coding)[1, 2].astype(int), wanted, atol=1)


def test_reference_white_and_peak_of_hdr() -> None:
    """BT.2408, table 1: 203 cd/m^2 is 75 % of HLG and 58 % of PQ; HLG's peak is 1000 cd/m^2, PQ's 10,000."""
    # HLG's 75 % is 203.2 cd/m^2 by the formulas, and 58 % of PQ is 201.7; the table's percentages are rounded
    np.testing.assert_allclose(display_light(grey([0.75]), HLG), 1, rtol=2e-3)
    np.testing.assert_allclose(display_light(grey([0.58]), PQ), 1, rtol=8e-3)
    # one entry of the table of 65,536: 2e-5 of the signal, 1.6e-4 of PQ's light
    np.testing.assert_allclose(display_light(grey([0, 1.0, 1.2]), HLG)[:, 0], [0, PEAK, PEAK], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(display_light(grey([0, 1.0]), PQ)[:, 1], [0, 10000 / 203], rtol=1e-5, atol=1e-6)


def test_highlights_are_compressed_from_the_knee_on() -> None:
    light = np.linspace(0, PEAK, 500)
    out = compressed(grey(light))[:, 0]
    below = light <= HIGHLIGHT_KNEE
    np.testing.assert_array_equal(out[below], light.astype(np.float32)[below])
    assert out[-1] == pytest.approx(1, abs=1e-5)
    assert (np.diff(out) > 0).all()
    slopes = np.diff(out) / np.diff(light)
    assert np.abs(np.diff(slopes)).max() < 0.05  # without a kink: the slope falls from 1 within some 20 steps
    hue = np.array([[4.0, 2.0, 1.0]], np.float32)
    np.testing.assert_allclose(compressed(hue) / compressed(hue)[0, 0], hue / 4, rtol=1e-6)


@pytest.mark.parametrize(("turns", "corner"), [(0, (0, 0)), (1, (-1, 0)), (2, (-1, -1)), (3, (0, -1))])
def test_a_turned_frame(turns: int, corner: tuple[int, int]) -> None:
    planes = flat(16, 128, 128)
    planes.y[0, 0] = 235
    turned = display_rgb(planes, REC709, turns)
    assert turned.shape == ((4, 6, 3) if turns % 2 == 0 else (6, 4, 3))
    assert turned[corner].tolist() == [255, 255, 255]
    assert turned.sum() == 3 * 255


@pytest.mark.parametrize("width", [2, 3, 8, 9])
@pytest.mark.parametrize("height", [2, 3, 63, 64, 65, 129])
def test_chroma_of_half_size_is_sited_left_and_between_rows(width: int, height: int) -> None:
    """A ramp of chroma in the picture is the same ramp after interpolation, but at the edges. Sizes at a band's end."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    ramp = 100 + 4.0 * x + 0.25 * y  # a step of 4 is a whole number at half the columns
    small = 100 + 8.0 * np.arange(-(-width // 2))[None] + (0.5 * np.arange(-(-height // 2)) + 0.125)[:, None]
    half, whole = (np.asarray(plane, np.float32) for plane in (small, ramp))
    luma = np.full((height, width), 128, np.uint8)
    found = display_rgb(Planes(luma, half, np.full_like(half, 128), 8), REC709)
    wanted = display_rgb(Planes(luma, whole, np.full_like(whole, 128), 8), REC709)
    inside = (slice(1, height - 1), slice(0, width - 2 + width % 2))
    # one level: values at a rounding edge may fall to either side
    np.testing.assert_allclose(found[inside].astype(int), wanted[inside], atol=1)


def test_hlg_of_a_photograph_comes_back() -> None:
    rng = np.random.default_rng(0)
    photograph = rng.uniform(0, 1, (8, 8, 3))
    signal = hlg_signal(photograph)
    weights = np.array([0.2627, 0.6780, 0.0593])
    luma = signal @ weights
    chroma = [(signal[:, :, channel] - luma) / (2 * (1 - weights[channel])) for channel in (2, 0)]
    codes = [64 + 876 * luma, *(512 + 896 * plane for plane in chroma)]
    planes = Planes(*(np.rint(plane).astype(np.uint16) for plane in codes), 10)  # type: ignore[misc]
    # 10 bits of HLG, whose steps are up to 1.6 levels of 255 in the darks, and chroma's rounding
    assert np.abs(display_rgb(planes, HDR).astype(int) - 255 * photograph).mean() < 0.6
    assert np.abs(display_rgb(planes, HDR).astype(int) - 255 * photograph).max() < 4


@dataclass(frozen=True)
class Judged:
    """A conversion by FFmpeg's zscale: H.273 numbers, names of the same for zscale, and the pixel format."""

    coding: Coding
    zscale: str
    form: str = "yuv444p"


HDR_CHAIN = (
    "zscale=min=2020_ncl:pin=2020:tin={0}:rin=limited:t=linear:p=2020:m=gbr:r=full:npl=203:agamma=false,"
    "format=gbrpf32le,zscale=p=709,format=gbrpf32le,tonemap=mobius:param=0.6:desat=0:peak=4.926108,"
    "zscale=t=iec61966-2-1:r=full,format=gbrp"
)
SDR_CHAIN = "zscale=min={}:pin={}:tin=709:rin={}:m=gbr:r=full:p=709:t=709,format=gbrp"


@pytest.mark.needs("ffmpeg")
@pytest.mark.parametrize(
    "judged",
    [
        Judged(HDR, HDR_CHAIN.format("arib-std-b67"), "yuv444p10le"),
        Judged(HDR, HDR_CHAIN.format("arib-std-b67"), "yuv420p10le"),
        Judged(Coding(9, 9, PQ, full_range=False), HDR_CHAIN.format("smpte2084"), "yuv444p10le"),
        Judged(Coding(9, 9, PQ, full_range=False), HDR_CHAIN.format("smpte2084"), "yuv420p10le"),
        Judged(REC709, SDR_CHAIN.format("709", "709", "limited")),
        Judged(REC709, SDR_CHAIN.format("709", "709", "limited"), "yuv422p10le"),
        Judged(Coding(1, 1, 1, full_range=True), SDR_CHAIN.format("709", "709", "full")),
        Judged(Coding(6, 1, 1, full_range=False), SDR_CHAIN.format("170m", "709", "limited")),
        Judged(Coding(9, 9, 1, full_range=False), SDR_CHAIN.format("2020_ncl", "2020", "limited")),
        Judged(Coding(1, 12, 1, full_range=False), SDR_CHAIN.format("709", "smpte432", "limited")),
    ],
    ids=lambda judged: f"{judged.form}-{judged.zscale[:50]}",
)
def test_zscale_and_tonemap_agree(judged: Judged) -> None:
    """Smooth planes, so that FFmpeg's filters of chroma and ours agree; colours within HLG's and PQ's gamut."""
    rng = np.random.default_rng(1)
    bits = 10 if "10le" in judged.form else 8

    def smooth(low: float, high: float) -> NDArray[Any]:
        noise = ndimage.gaussian_filter(rng.uniform(0, 1, (48, 64)), 8)
        level = (noise - noise.min()) / (noise.max() - noise.min())
        return np.rint((low + (high - low) * level) * 2 ** (bits - 8)).astype(np.uint8 if bits == 8 else "<u2")

    down, across = (2 if "420" in judged.form else 1), (1 if "444" in judged.form else 2)
    y, cb, cr = smooth(60, 205), smooth(116, 140)[::down, ::across], smooth(116, 140)[::down, ::across]
    planes = Planes(y, np.ascontiguousarray(cb), np.ascontiguousarray(cr), bits)
    raw = b"".join(np.ascontiguousarray(plane).tobytes() for plane in (planes.y, planes.cb, planes.cr))
    command = ["ffmpeg", "-v", "error", "-f", "rawvideo", "-pix_fmt", judged.form, "-s", "64x48", "-i", "-"]
    command += ["-vf", judged.zscale, "-f", "rawvideo", "-pix_fmt", "gbrp", "-"]
    green, blue, red = np.frombuffer(subprocess.run(command, input=raw, capture_output=True, check=True).stdout, np.uint8).reshape(3, 48, 64)  # fmt: skip # noqa: E501
    found, theirs = display_rgb(planes, judged.coding).astype(int), np.stack([red, green, blue], axis=-1).astype(int)
    # rounding falls to either side in a few pixels. Chroma of fewer samples: other rules at the edge, 2 pixels wide,
    # and chroma rounded after interpolation there: 1 level
    if down * across > 1:
        found, theirs = found[3:-3, 3:-3], theirs[3:-3, 3:-3]
    assert np.abs(found - theirs).max() <= 1
    assert np.abs(found - theirs).mean() < (0.02 if down * across == 1 else 0.1)
