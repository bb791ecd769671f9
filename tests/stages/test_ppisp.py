# SPDX-License-Identifier: Apache-2.0
"""ppisp.cl against the float64 twin, and the twin against finite differences and what the record makes of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from compare import assert_close, assert_close_gradient, assert_same_bits
from planes import padded

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import READBACK
from clsplat.reference import appearance, ppisp
from clsplat.runs.appearance import held_out_looks, unmixing
from clsplat.stages.appearance import GainEntries, Gains, step_gains
from clsplat.stages.ppisp import COLOUR_ENTRIES, VIGNETTE_ENTRIES, VIGNETTE_GAINS, PhotoLens, camera_gradient, develop

Array = np.ndarray


def made_up(rng: np.random.Generator, photographs: int, lenses: int) -> tuple[Array, Array]:
    """Entries of photographs and vignettes of lenses."""
    gains, mixes = rng.uniform(-1, 1, (photographs, 3)), rng.uniform(-0.2, 0.2, (photographs, 6))
    entries = np.concatenate([gains, mixes], axis=1).astype(np.float32)
    return entries, rng.uniform(-0.5, 0.2, (lenses, VIGNETTE_ENTRIES)).astype(np.float32)


@pytest.mark.slow_in_groups
@pytest.mark.parametrize(
    ("width", "height"), [pytest.param(1, 1, marks=pytest.mark.slow), (16, 16), (17, 33), (40, 15)]
)
def test_photographs_developed_and_the_gradient(shaped_device: Device, width: int, height: int) -> None:
    rng = np.random.default_rng(width)
    image, photograph = rng.random((2, height, width, 3)).astype(np.float32)
    by_image = rng.normal(0.3, 1, image.shape).astype(np.float32)
    entries, lenses = made_up(rng, 5, 3)
    work, taken = Workspace(shaped_device), PhotoLens(3, 2, (0.4, 0.55))
    colours, vignettes = Gains.on(shaped_device, entries), Gains.on(shaped_device, lenses)
    planes = np.concatenate([padded(photograph), padded(photograph)[:1]])  # the fourth is of alpha
    target = upload(shaped_device, planes)
    develop(shaped_device, colours, vignettes, taken, target, width, height)
    squared = ppisp.spread(width, height, (0.4 * width, 0.55 * height))
    wide = photograph.astype(np.float64), entries[3].astype(np.float64), lenses[2].astype(np.float64)
    # A dozen roundings of colours up to 4, where gains are a half and mixes take as much away.
    assert_close(target.get()[:3, :height, :width].transpose(1, 2, 0), ppisp.developed(*wide, squared), absolute=4e-6)
    assert_same_bits(target.get()[3], planes[3])
    below = padded(by_image)
    below[:, height:] = np.nan  # the loss leaves it unwritten
    gradient = upload(shaped_device, below)
    columns = camera_gradient(shaped_device, work, taken, upload(shaped_device, padded(image)), gradient, width, height)
    sums = columns.get().sum(axis=1, dtype=np.float64)
    sums[[0, 1, 2, 9, 10, 11]] *= np.log(2)
    wanted = ppisp.gradient(image.astype(np.float64), by_image.astype(np.float64), squared)
    for part in (slice(0, 3), slice(3, 9), slice(9, 12)):  # gains, mixes, vignette, each class by itself
        assert_close_gradient(sums[part], wanted[part], 1e-5)
    assert_same_bits(gradient.get(), below)


def test_steps_of_colours_and_of_lenses(shaped_device: Device) -> None:
    rng = np.random.default_rng(1)
    entries, lenses = made_up(rng, 4, 2)
    entries[:, 3:] /= 4
    entries -= entries.mean(axis=0)
    colours, vignettes = Gains.on(shaped_device, entries), Gains.on(shaped_device, lenses)
    readback = upload(shaped_device, np.zeros(len(READBACK), np.uint32))
    state: Any = entries.astype(np.float64), np.zeros((4, COLOUR_ENTRIES)), np.zeros((4, COLOUR_ENTRIES))
    through: Any = lenses.astype(np.float64), np.zeros((2, VIGNETTE_ENTRIES)), np.zeros((2, VIGNETTE_ENTRIES))
    factors = np.log(2) ** (np.arange(COLOUR_ENTRIES) < 3)
    rates = 0.01 * np.where(np.arange(COLOUR_ENTRIES) < 3, 1.0, 0.1)
    for number in range(1, 12):
        columns = rng.normal(0, 1, (COLOUR_ENTRIES + VIGNETTE_ENTRIES, 16)).astype(np.float32)
        sums = columns.astype(np.float64).sum(axis=1)
        by_entries, by_lenses = np.zeros((4, COLOUR_ENTRIES)), np.zeros((2, VIGNETTE_ENTRIES))
        by_entries[number % 4], by_lenses[number % 2] = (
            factors * sums[:COLOUR_ENTRIES],
            np.log(2) * sums[COLOUR_ENTRIES:],
        )
        state = appearance.step(*state, by_entries, number, rates)
        through = appearance.step(*through, by_lenses, number, 0.02, centred=False)
        of_step = upload(shaped_device, columns), number
        step_gains(shaped_device, colours, number % 4, *of_step, 0.01, readback, GainEntries(mix_rate=0.1))
        step_gains(shaped_device, vignettes, number % 2, *of_step, 0.02, readback, VIGNETTE_GAINS)
    # Eleven steps; a sum of 16 floats that nearly cancel is good to 1e-5 of itself.
    assert_close(colours.logs.get(), state[0], absolute=1e-5)
    assert_close(colours.gains.get()[:, :3], np.exp2(state[0][:, :3]), absolute=1e-5)
    assert_close(vignettes.logs.get(), through[0], absolute=1e-5)


def test_mixes_stay_where_they_can_be_undone(shaped_device: Device) -> None:
    entries = np.zeros((2, COLOUR_ENTRIES), np.float32)
    colours = Gains.on(shaped_device, entries)
    readback = upload(shaped_device, np.zeros(len(READBACK), np.uint32))
    columns = upload(shaped_device, np.ones((COLOUR_ENTRIES + VIGNETTE_ENTRIES, 16), np.float32))
    for number in range(1, 40):
        step_gains(shaped_device, colours, 0, columns, number, 1.0, readback)
    logs = colours.logs.get().astype(np.float64)
    assert np.abs(logs[:, 3:]).max() == np.float32(0.2)
    assert np.linalg.cond(unmixing(logs[0, 3:])) < 10


def test_a_panorama_has_no_vignette(default_device: Device) -> None:
    rng = np.random.default_rng(5)
    image = rng.random((16, 16, 3)).astype(np.float32)
    entries, lenses = made_up(rng, 1, 1)
    taken = PhotoLens(0, 0, (0.5, 0.5), flat=False)
    colours, vignettes = Gains.on(default_device, entries), Gains.on(default_device, lenses)
    target = upload(default_device, padded(image))
    develop(default_device, colours, vignettes, taken, target, 16, 16)
    wide = image.astype(np.float64), entries[0].astype(np.float64)
    wanted = ppisp.developed(*wide, np.zeros(3), np.zeros((16, 16)))
    assert_close(target.get().transpose(1, 2, 0), wanted, absolute=4e-6)  # as above
    planes = upload(default_device, padded(image))
    columns = camera_gradient(default_device, Workspace(default_device), taken, planes, planes, 16, 16)
    assert not columns.get()[COLOUR_ENTRIES:].any()


def test_the_twin_against_finite_differences() -> None:
    """The loss of the render as it is seen through x against the developed photograph has this gradient at x = 0."""
    rng = np.random.default_rng(2)
    image, photograph = rng.random((2, 4, 5, 3))
    entries, lenses = made_up(rng, 1, 1)
    squared = ppisp.spread(5, 4, (2.25, 1.75))
    target = ppisp.developed(photograph, entries[0].astype(float), lenses[0].astype(float), squared)

    def loss(x: Array) -> float:
        mixed = image @ (2 * np.eye(3) - ppisp.unmixing(x[3:9])).T  # of small mixes put on, not taken
        seen = mixed * np.exp2(x[:3]) * ppisp.light(x[9:], squared)[:, :, None]
        return float(np.square(seen - target).sum())

    numeric = [(loss(d) - loss(-d)) / 2e-6 for d in 1e-6 * np.eye(12)]
    assert_close_gradient(ppisp.gradient(image, 2 * (image - target), squared), np.array(numeric), 1e-7)


def test_what_is_put_on_is_what_developing_takes() -> None:
    """A held-out render through the record's gains and vignette is developed to the render again."""
    rng = np.random.default_rng(6)
    image, vignette, logs = rng.random((6, 9, 3)), [-0.5, 0.25, -0.125], [0.5, -0.25, 0.0]
    record = {"held_out": {"a": {"log2_gains": logs, "vignette": vignette, "centre": [4 / 9, 3.5 / 6]}}}
    seen = held_out_looks(record)("a", image)
    squared = ppisp.spread(9, 6, (4.0, 3.5))
    again = ppisp.developed(seen, np.array([*logs, *np.zeros(6)]), np.array(vignette), squared)
    assert_close(again, image, relative=3e-7)  # factors are float32
