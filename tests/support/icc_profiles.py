# SPDX-License-Identifier: Apache-2.0
"""ICC profiles of RGB spaces, written by hand (ICC.1:2001-04, matrix and curves), and the conversion in closed form."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

REC709 = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
ADOBE = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
ROMM = ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001))
"""Chromaticities x and y of red, green and blue of sRGB, Display P3, Adobe RGB and ProPhoto."""
SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
"""The sRGB curve as parameters of ICC's parametric curve, function type 3."""
ADOBE_CURVE = (563 / 256,)
_D50 = np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def to_xyz(primaries: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Matrix (3, 3) from linear values to XYZ, for the white D65."""
    (white,) = _xyz(((0.3127, 0.3290),)).T
    columns = _xyz(primaries)
    return columns * np.linalg.solve(columns, white)


def _xyz(chromaticities: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    return np.array([[x / y, 1, (1 - x - y) / y] for x, y in chromaticities]).T


def profile(primaries: tuple[tuple[float, float], ...], curve: tuple[float, ...]) -> bytes:
    """An ICC profile of a space with the white D65. curve: an exponent, or the five numbers of function type 3."""
    white = to_xyz(primaries).sum(axis=1)
    adapted = np.linalg.inv(_BRADFORD) @ np.diag((_BRADFORD @ _D50) / (_BRADFORD @ white)) @ _BRADFORD
    matrix = adapted @ to_xyz(primaries)
    one = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(256 * curve[0]))
    several = b"para\0\0\0\0" + struct.pack(">HH", 3, 0) + _fixed(curve)
    shape = one if len(curve) == 1 else several
    name = b"a space\0"
    tags = [(b"desc", b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78)), (b"wtpt", _point(_D50))]
    tags += [(letter + b"XYZ", _point(column)) for letter, column in zip((b"r", b"g", b"b"), matrix.T, strict=True)]
    tags += [(letter + b"TRC", shape) for letter in (b"r", b"g", b"b")]
    tags += [(b"cprt", b"text\0\0\0\0none\0")]
    table, body = struct.pack(">I", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for signature, data in tags:
        table += signature + struct.pack(">II", start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", start + len(body), b"none", 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H", 2024, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + _fixed(tuple(_D50))
    return head.ljust(128, b"\0") + table + body


def _fixed(values: tuple[float, ...]) -> bytes:
    return b"".join(struct.pack(">i", round(65536 * value)) for value in values)


def _point(values: NDArray[np.float64]) -> bytes:
    return b"XYZ \0\0\0\0" + _fixed(tuple(values))


def in_srgb_by_hand(
    values: NDArray[Any], primaries: tuple[tuple[float, float], ...], curve: tuple[float, ...]
) -> NDArray[np.float64]:
    """Colours (..., 3) from 0 to 1 of a space with the white D65, in sRGB, clipped to 0 and 1."""
    values = np.asarray(values, np.float64)
    linear = values ** curve[0]
    if len(curve) > 1:
        exponent, a, b, slope, edge = curve
        linear = np.where(values >= edge, (a * values + b) ** exponent, slope * values)
    linear = np.clip(linear @ np.linalg.solve(to_xyz(REC709), to_xyz(primaries)).T, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
