# SPDX-License-Identifier: Apache-2.0
"""Cryptomatte channels and headers (Friedman and Jones 2015; version 1.2.0, https://github.com/Psyop/Cryptomatte).

Each pixel stores the ids and coverages of the objects that cover the largest parts of it. The header maps names to ids.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float32
from clsplat.config.channels import CRYPTOMATTE_LAYERS

_UINT32_MASK = 0xFFFFFFFF


def murmur3(data: bytes, seed: int = 0) -> int:
    """Return the hash MurmurHash3_x86_32 of `data` (Appleby 2011, public domain)."""
    value, whole = seed, len(data) // 4 * 4

    def mixed(word: int) -> int:
        word = word * 0xCC9E2D51 & _UINT32_MASK
        word = (word << 15 | word >> 17) & _UINT32_MASK
        return word * 0x1B873593 & _UINT32_MASK

    for at in range(0, whole, 4):
        value ^= mixed(int.from_bytes(data[at : at + 4], "little"))
        value = (value << 13 | value >> 19) & _UINT32_MASK
        value = (value * 5 + 0xE6546B64) & _UINT32_MASK
    if tail := data[whole:]:
        value ^= mixed(int.from_bytes(tail, "little"))
    value ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        value = (value ^ value >> shift) * factor & _UINT32_MASK
    return value ^ value >> 16


def id_bits(name: str) -> int:
    """Return the Cryptomatte id of a name: 32 bits which, read as a float, are neither denormal, infinite nor NaN."""
    bits = murmur3(name.encode())
    return bits ^ (1 << 23) if bits >> 23 & 255 in (0, 255) else bits


def header_of(layer: str, names: Sequence[str]) -> dict[str, str]:
    """Return a Cryptomatte layer's EXR attributes: its name, how ids are made, and each object's id by name."""
    key = f"cryptomatte/{murmur3(layer.encode()):08x}"[: len("cryptomatte/") + 7]
    manifest = json.dumps({name: f"{id_bits(name):08x}" for name in names}, separators=(",", ":"))
    return {
        f"{key}/name": layer,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": manifest,
    }


def ranked(coverage: Float32, names: Sequence[str]) -> Float32:
    """Return ids and coverages (H, W, 4 CRYPTOMATTE_LAYERS) of the objects that cover most of each pixel.

    Ids and coverages alternate along the last axis, the largest coverage first. Unused entries are 0. Objects with
    equal coverage are in the order of `names`.

    coverage: (H, W, objects), the fraction of each pixel that each object covers.
    """
    kept = min(2 * CRYPTOMATTE_LAYERS, len(names))
    ids = np.array([id_bits(name) for name in names], np.uint32).view(np.float32)
    order = np.argsort(-coverage, axis=2, kind="stable")[:, :, :kept]
    share = np.take_along_axis(coverage, order, axis=2)
    planes = np.zeros((*coverage.shape[:2], 2 * CRYPTOMATTE_LAYERS, 2), np.float32)
    planes[:, :, :kept, 0] = np.where(share > 0, ids[order], 0)
    planes[:, :, :kept, 1] = np.where(share > 0, share, 0)
    return planes.reshape(*coverage.shape[:2], 4 * CRYPTOMATTE_LAYERS)
