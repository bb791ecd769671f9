# SPDX-License-Identifier: Apache-2.0
"""The update of photographs' gains and mixes (appearance.cl), and the twins of colour models against differences."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest
from compare import assert_close, assert_close_gradient, assert_same_bits
from scipy.sparse import csr_array

from clsplat.config.colour_models import COLOUR_MODELS, ColourModel
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.layouts.columns import READBACK
from clsplat.reference.appearance import spread
from clsplat.stages.appearance import Gains, step_gains


@pytest.mark.parametrize("count", [4, 256, 257, 513])
def test_the_mean_stays(shaped_device: Device, count: int) -> None:
    rng = np.random.default_rng(1)
    start = rng.normal(0.5, 0.1, (count, 3)).astype(np.float32)
    pull = np.zeros((count, count))
    pull[:4, :4] = np.diag([0.0, 20.0, 0.5, 20.0])
    pull[1, 3] = pull[3, 1] = 6.0
    gains = Gains.on(shaped_device, start, csr_array(pull))
    readback = upload(shaped_device, np.zeros(len(READBACK), np.uint32))
    for number in range(1, 12):
        columns = upload(shaped_device, rng.normal(0, 1, (3, 16)).astype(np.float32))
        step_gains(shaped_device, gains, number % 4, columns, number, 0.05, readback)
    logs, before = gains.logs.get().astype(np.float64), start.astype(np.float64)
    assert np.abs(logs - before).max() > 0.05
    # each of the logs near 0.5 is rounded to 6e-8
    assert_close(logs.mean(axis=0), before.mean(axis=0), absolute=1e-7)


def test_pulled_gains_do_not_hold_those_of_other_photographs(shaped_device: Device) -> None:
    """Two photographs begin where they are to be but for a common factor, which the third, not pulled, makes so."""
    truth = np.array([[0.5], [-0.5], [1.5]]) * np.ones(3)
    truth -= truth.mean(axis=0)
    start = truth.copy()
    start[2] = 0
    start -= start.mean(axis=0)
    gains = Gains.on(shaped_device, start.astype(np.float32), csr_array(np.diag([10.0, 10.0, 0.0])))
    readback = upload(shaped_device, np.zeros(len(READBACK), np.uint32))
    for number in range(1, 601):
        view = number % 3
        by_logs = gains.logs.get()[view] - truth[view]
        columns = upload(shaped_device, (by_logs[:, None] * np.ones(16) / (16 * np.log(2))).astype(np.float32))
        step_gains(shaped_device, gains, view, columns, number, 0.05 * 0.99**number, readback)
    # Of floats, in sums of 600 steps; a pull whose mean is not removed leaves 0.48 octaves (of the float64 twin).
    assert_close(gains.logs.get(), truth, absolute=0.02)


def test_a_step_that_stopped_or_is_not_finite(shaped_device: Device) -> None:
    gains = Gains.on(shaped_device, np.array([[0.5, 0.25, 0], [-0.5, -0.25, 0]], np.float32))
    before = gains.logs.get()
    values = np.zeros(len(READBACK), np.uint32)
    values[READBACK.index("STOPPED")] = 1
    columns = upload(shaped_device, np.ones((3, 16), np.float32))
    step_gains(shaped_device, gains, 1, columns, 1, 0.1, upload(shaped_device, values))
    assert_same_bits(gains.logs.get(), before)
    assert not gains.first.get().any()
    columns.fill(np.nan)
    step_gains(shaped_device, gains, 1, columns, 1, 0.1, upload(shaped_device, 0 * values))
    assert_same_bits(gains.logs.get(), before)


@pytest.mark.parametrize("model", COLOUR_MODELS.values(), ids=COLOUR_MODELS)
def test_a_twin_against_finite_differences(model: ColourModel) -> None:
    """Entries put on the render have the opposite derivative, where they are 0, of entries removed from it."""
    twin, rng = import_module(f"clsplat.reference.{model.stem}"), np.random.default_rng(2)
    image, by_image = rng.random((4, 5, 3)), rng.standard_normal((4, 5, 3))
    squared = spread(5, 4, (2.25, 1.75))
    assert_same_bits(twin.developed(image, *np.split(np.zeros(model.sums), [model.entries]), squared), image)
    moved = [
        [twin.developed(image, *np.split(step, [model.entries]), squared) for step in (-d, d)]
        for d in 1e-6 * np.eye(model.sums)
    ]
    numeric = [(by_image * (before - after)).sum() / 2e-6 for before, after in moved]
    assert_close_gradient(twin.terms(image, by_image, squared).sum(axis=(0, 1)), numeric, 1e-7)
