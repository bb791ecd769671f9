# SPDX-License-Identifier: Apache-2.0
"""Files in the .ksplat format, which clsplat only reads."""

from __future__ import annotations

import struct

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.spherical_harmonics import SH_C0


def ksplat(model: Gaussians, level: int, counts: tuple[int, ...], *, bucket: int = 5) -> tuple[bytes, Gaussians]:
    """Bytes of a .ksplat file, and the Gaussians that a reader should find in it.

    counts: number of the model's Gaussians in each section. Above level 0 these are in full buckets and two partial
        ones.
    bucket: number of Gaussians in a full bucket.
    """
    degree, block, half = model.sh_degree, 4.0, 32767
    bands = [model.sh[:, b * b : (b + 1) ** 2].transpose(0, 2, 1).reshape(len(model), -1) for b in range(1, degree + 1)]
    rest = np.concatenate([np.zeros((len(model), 0), np.float32), *bands], axis=1)
    rgba = np.random.default_rng(2).integers(1, 255, (len(model), 4))
    wanted = edit.take(model, np.arange(len(model)))
    wanted.sh[:, 0] = (rgba[:, :3] / 255 - 0.5) / SH_C0
    wanted.opacity_logits = np.log(rgba[:, 3] / (255 - rgba[:, 3])).astype(np.float32)
    header = bytearray(4096)
    struct.pack_into("<BBxxIIIIHxx3fff", header, 0, 0, 1, *[len(counts)] * 2, *[len(model)] * 2, level, 0, 0, 0, -2, 2)
    heads, bodies, first = b"", b"", 0
    for count in counts:
        full = max(0, (count - 3) // bucket)
        partial = [count - full * bucket - 2, 2] if level else []
        buckets = full + len(partial) if level else 0
        head = bytearray(1024)
        sizes = (count, count + 2, bucket, buckets, block, 12)
        struct.pack_into("<IIIIfHxxI4xIIH", head, 0, *sizes, half, full if level else 0, len(partial), degree)
        heads += bytes(head)
        which = np.minimum(np.arange(count) // bucket, full) + (np.arange(count) >= count - 2)
        if full and count - 2 < full * bucket:
            raise ValueError("the last two are a bucket of their own")
        centres = np.array([[0.5 * i, -i, 0.25] for i in range(buckets)], np.float32).reshape(-1, 3)
        bodies += struct.pack(f"<{len(partial)}I", *partial) + centres.tobytes()
        rows = slice(first, first + count)
        scales = np.exp(model.log_scales[rows])
        if level == 0:
            parts = [model.means[rows].view("u1"), scales.view("u1"), model.quaternions[rows].view("u1")]
            sh = rest[rows].astype("<f4")
        else:
            steps = np.random.default_rng(3).integers(0, 65536, (count, 3)).astype("<u2")
            wanted.means[rows] = (steps.astype(float) - half) * (block / 2 / half) + centres[which]
            halves = [scales.astype("<f2"), model.quaternions[rows].astype("<f2")]
            wanted.log_scales[rows] = np.log(halves[0].astype(float))
            wanted.quaternions[rows] = halves[1]
            parts = [steps.view("u1"), *(each.view("u1") for each in halves)]
            sh = rest[rows].astype("<f2") if level == 1 else np.clip(rest[rows] * 64 + 128, 0, 255).astype("u1")
            back = sh.astype(np.float32) if level == 1 else sh / np.float32(255) * 4 - 2
            at = 0
            for band in range(1, degree + 1):
                width = 2 * band + 1
                values = back[:, at : at + 3 * width].reshape(count, 3, width).transpose(0, 2, 1)
                wanted.sh[rows, band**2 : (band + 1) ** 2] = values
                at += 3 * width
        table = np.concatenate([*parts, rgba[rows].astype("u1"), np.ascontiguousarray(sh).view("u1")], axis=1)
        bodies += table.tobytes() + bytes(2 * table.shape[1])  # unused space for two more Gaussians
        first += count
    return bytes(header) + heads + bodies, wanted
