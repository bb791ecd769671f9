# SPDX-License-Identifier: Apache-2.0
"""ppisp.cl against the float64 twin, and the twin against finite differences and what the record makes of it."""

from __future__ import annotations

import numpy as np
from compare import assert_close, assert_close_gradient

from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.layouts.columns import READBACK
from clsplat.reference import ppisp
from clsplat.reference.appearance import spread
from clsplat.runs.appearance import held_out_looks, unmixing
from clsplat.stages.appearance import COLOUR_MODELS, Gains, step_gains

Array = np.ndarray
PPISP = COLOUR_MODELS["ppisp"]


def made_up(rng: np.random.Generator, photographs: int, lenses: int) -> tuple[Array, Array]:
    """Entries of photographs and vignettes of lenses."""
    gains, mixes = rng.uniform(-1, 1, (photographs, 3)), rng.uniform(-0.2, 0.2, (photographs, 6))
    entries = np.concatenate([gains, mixes], axis=1).astype(np.float32)
    return entries, rng.uniform(-0.5, 0.2, (lenses, PPISP.lens_entries)).astype(np.float32)


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


def test_the_twin_against_finite_differences() -> None:
    """The loss of the render as it is seen through x against the developed photograph has this gradient at x = 0."""
    rng = np.random.default_rng(2)
    image, photograph = rng.random((2, 4, 5, 3))
    entries, lenses = made_up(rng, 1, 1)
    squared = spread(5, 4, (2.25, 1.75))
    target = ppisp.developed(photograph, entries[0].astype(float), lenses[0].astype(float), squared)

    def loss(x: Array) -> float:
        mixed = image @ (2 * np.eye(3) - ppisp.unmixing(x[3:9])).T  # of small mixes put on, not taken
        seen = mixed * np.exp2(x[:3]) * ppisp.light(x[9:], squared)[:, :, None]
        return float(np.square(seen - target).sum())

    numeric = [(loss(d) - loss(-d)) / 2e-6 for d in 1e-6 * np.eye(12)]
    assert_close_gradient(ppisp.terms(image, 2 * (image - target), squared).sum(axis=(0, 1)), np.array(numeric), 1e-7)


def test_what_is_put_on_is_what_developing_takes() -> None:
    """A held-out render through the record's gains and vignette is developed to the render again."""
    rng = np.random.default_rng(6)
    image, vignette, logs = rng.random((6, 9, 3)), [-0.5, 0.25, -0.125], [0.5, -0.25, 0.0]
    record = {"held_out": {"a": {"log2_gains": logs, "vignette": vignette, "centre": [4 / 9, 3.5 / 6]}}}
    seen = held_out_looks(record)("a", image)
    squared = spread(9, 6, (4.0, 3.5))
    again = ppisp.developed(seen, np.array([*logs, *np.zeros(6)]), np.array(vignette), squared)
    assert_close(again, image, relative=3e-7)  # factors are float32
