# SPDX-License-Identifier: Apache-2.0
"""Limits of mixes, and renders with a record's gains and vignette against the twin."""

from __future__ import annotations

import numpy as np
from compare import assert_close

from clsplat.config.colour_models import COLOUR_MODELS
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.layouts.columns import READBACK
from clsplat.reference import ppisp
from clsplat.reference.appearance import spread
from clsplat.runs.appearance import held_out_looks, unmixing
from clsplat.stages.appearance import Gains, step_gains

PPISP = COLOUR_MODELS["ppisp"]


def test_mixes_stay_where_they_can_be_undone(shaped_device: Device) -> None:
    entries = np.zeros((2, PPISP.entries), np.float32)
    colours = Gains.on(shaped_device, entries)
    readback = upload(shaped_device, np.zeros(len(READBACK), np.uint32))
    columns = upload(shaped_device, np.ones((PPISP.sums, 16), np.float32))
    for number in range(1, 40):
        step_gains(shaped_device, colours, 0, columns, number, 1.0, readback)
    logs = colours.logs.get().astype(np.float64)
    assert np.abs(logs[:, 3:]).max() == np.float32(0.2)
    assert np.linalg.cond(unmixing(logs[0, 3:])) < 10


def test_what_is_put_on_is_what_developing_takes() -> None:
    """A held-out render through the record's gains and vignette is developed to the render again."""
    rng = np.random.default_rng(6)
    image, vignette, logs = rng.random((6, 9, 3)), [-0.5, 0.25, -0.125], [0.5, -0.25, 0.0]
    record = {"held_out": {"a": {"log2_gains": logs, "vignette": vignette, "centre": [4 / 9, 3.5 / 6]}}}
    seen = held_out_looks(record)("a", image)
    squared = spread(9, 6, (4.0, 3.5))
    again = ppisp.developed(seen, np.array([*logs, *np.zeros(6)]), np.array(vignette), squared)
    assert_close(again, image, relative=3e-7)  # factors are float32
