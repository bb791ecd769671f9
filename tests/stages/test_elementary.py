# SPDX-License-Identifier: Apache-2.0
"""Multiply-adds and halves through probe.cl; the elementary functions have a case."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid


def test_multiply_add_has_one_rounding(shaped_device: Device) -> None:
    lanes = shaped_device.shape.lanes
    out = allocate(shaped_device, (2 * lanes,), np.float32)
    factor = float(np.float32(1 + 2.0**-12))
    launch_grid(shaped_device, shaped_device.kernels("probe").probe_fma, (1,), out, factor, -(1 + 2.0**-11))
    np.testing.assert_array_equal(out.get(), np.float32(2.0**-24))


def test_every_finite_half(shaped_device: Device) -> None:
    bits = np.arange(2**16, dtype=np.uint16)
    bits = bits[np.isfinite(bits.view(np.float16))]
    out = allocate(shaped_device, (len(bits), 4), np.float32)
    launch_grid(
        shaped_device, shaped_device.kernels("probe").probe_half, (len(bits),), upload(shaped_device, bits), out
    )
    wanted = np.repeat(bits.view(np.float16).astype(np.float32)[:, None], 4, axis=1)
    np.testing.assert_array_equal(out.get().view(np.uint32), wanted.view(np.uint32))
