# SPDX-License-Identifier: Apache-2.0
"""The bytes of SPZ's values, described in clsplat/models/formats/spz.py: arrays of a row for each
Gaussian."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.models.codec.axes import UP_BACK, sh_signs
from clsplat.models.codec.values import OTHERS, restore_largest

Bytes = NDArray[np.uint8]

ROOT_HALF = 0.5**0.5


def fixed(block: Bytes) -> NDArray[np.float32]:
    """Signed integers of 24 bits, (n, 9) -> (n, 3)."""
    wide = np.zeros((len(block), 3, 4), np.uint8)
    wide[:, :, 1:] = block.reshape(-1, 3, 3)
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.float32)


def first_three(block: Bytes) -> NDArray[np.float32]:
    """Version 2: (n, 3) of x y z -> (n, 4) quaternions w x y z."""
    result = np.empty((len(block), 4), np.float32)
    result[:, 1:] = block * np.float32(1 / 127.5) - np.float32(1)
    result[:, 0] = np.sqrt(np.maximum(0, 1 - np.square(result[:, 1:]).sum(axis=1)))
    return result


def smallest_three(block: Bytes) -> NDArray[np.float32]:
    """Quaternions w x y z, (n, 4), from bytes (n, 4) of version 3 and later."""
    packed = np.ascontiguousarray(block).view("<u4")[:, 0]
    fields = packed[:, None] >> np.array([20, 10, 0], np.uint32)
    three = (fields & 511).astype(np.float32) * np.float32(ROOT_HALF / 511)
    three = np.where(fields & 512, -three, three)
    return restore_largest(packed >> 30, three)[:, [3, 0, 1, 2]]  # from x y z w


def to_byte(values: NDArray[np.float32]) -> Bytes:
    """To the nearest from 0 to 255."""
    return np.asarray(np.clip(np.floor(values + np.float32(0.5)), 0, 255).astype(np.uint8))


def to_fixed(values: NDArray[np.float64]) -> Bytes:
    """(n, 3) that fit into 24 bits -> (n, 3, 3), the low bytes first."""
    return np.rint(values).astype("<i4")[:, :, None].view(np.uint8)[:, :, :3]


def to_first_three(unit: NDArray[np.float32]) -> Bytes:
    """Bytes (n, 3) of unit quaternions (n, 4), w x y z."""
    unit = np.where(unit[:, :1] < 0, -unit, unit)
    return to_byte(unit[:, 1:] * np.float32(127.5) + np.float32(127.5))


def to_smallest_three(unit: NDArray[np.float32]) -> Bytes:
    """Bytes (4 n,) of unit quaternions (n, 4), w x y z."""
    q = unit[:, [1, 2, 3, 0]]
    largest = np.abs(q).argmax(axis=1)
    negate = np.take_along_axis(q, largest[:, None], axis=1) < 0
    magnitude = np.minimum(np.floor(np.abs(q) * np.float32(511 / ROOT_HALF) + np.float32(0.5)), 511).astype(np.uint32)
    fields = magnitude | (((q < 0) ^ negate).astype(np.uint32) << 9)
    three = np.take_along_axis(fields, OTHERS[largest], axis=1)
    packed = largest.astype(np.uint32) << 30 | three[:, 0] << 20 | three[:, 1] << 10 | three[:, 2]
    return np.asarray(packed.astype("<u4").view(np.uint8))


def to_sh(rest: NDArray[np.float32], sh_bits: tuple[int, int]) -> Bytes:
    """Bytes of coefficients (n, K - 1, 3) in our frame. sh_bits: bits that band 1, and those above, keep."""
    coefficients = rest.shape[1]
    steps = np.array([1 << (8 - sh_bits[0 if index < 3 else 1]) for index in range(coefficients)], np.int16)[:, None]
    signs = sh_signs(UP_BACK)[1 : coefficients + 1, None]
    values = np.clip(rest * (signs * np.float32(128)) + np.float32(128.5), 0, 256).astype(np.int16)
    return np.asarray(np.minimum((values + steps // 2) & -steps, 255).astype(np.uint8))  # steps are powers of two
