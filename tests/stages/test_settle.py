# SPDX-License-Identifier: Apache-2.0
"""settle.cl: late Adam against dense Adam over many steps, and rows that it must leave alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from compare import assert_close, assert_same_arrays

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import READBACK
from clsplat.optimisation.missed_steps import MissedSteps
from clsplat.selftest.case import fresh_readback
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.device_gaussians import DeviceGaussians
from clsplat.stages.settle import settle

COUNT, STEPS = 90, 240
RATES = {group: 0.01 * (number + 1) for number, group in enumerate(PARAMETER_GROUPS)}
SHAPES = group_shapes(COUNT, 4)


def trained(device: Device, config: OptimiserConfig) -> list[dict[str, np.ndarray]]:
    """Parameters and moments after STEPS steps of given gradients, of which each step has a random part of the rows."""
    rng = np.random.default_rng(4)
    models = [
        DeviceGaussians(COUNT, 4, {g: upload(device, np.zeros(shape, np.float32)) for g, shape in SHAPES.items()})
        for _ in range(4)
    ]
    parameters, gradients, *moments = models
    late, missed, readback = (
        (parameters, *moments),
        MissedSteps(config, tuple(PARAMETER_GROUPS)),
        fresh_readback(device),
    )
    last, often = upload(device, np.zeros(COUNT, np.uint32)), np.linspace(0.005, 1, COUNT)
    for number in range(1, STEPS + 1):
        shown = rng.random(COUNT) < (often if number % 60 < 40 else 0)  # every row rests for 20 steps now and then
        for group, shape in SHAPES.items():
            values = rng.uniform(0.5, 1.0, shape) * rng.choice([-1, 1], shape)
            values[~shown] = 0.0
            gradients[group].set(values.astype(np.float32))
        counts = upload(device, shown.astype(np.uint32))
        step = AdamStep(config, number, {group: rate * 0.99**number for group, rate in RATES.items()})
        if config.late:
            settle(device, config, late, number - 1, last, upload(device, missed.rounded()), readback, counts)
        adam(device, step, parameters, gradients, *moments, counts, readback)
        missed.add(step.scales)
    if config.late:
        settle(device, config, late, STEPS, last, upload(device, missed.rounded()), readback)
    return [{group: model[group].get() for group in PARAMETER_GROUPS} for model in late]


@pytest.mark.parametrize("sh_rest_every", [1, 3])
def test_late_is_dense_to_rounding(device: Device, sh_rest_every: int) -> None:
    """With the same gradients. What sparse Adam drops is thousands of times the tolerance."""
    dense = trained(device, OptimiserConfig(sh_rest_every=sh_rest_every))
    late = trained(device, OptimiserConfig(sh_rest_every=sh_rest_every, late=True))
    sparse = trained(device, OptimiserConfig(sh_rest_every=sh_rest_every, sparse=True))
    for group in PARAMETER_GROUPS:
        # Dense Adam rounds each of 240 steps: a part in 2^24 of the parameter, a few of the step.
        size = max(np.abs(dense[0][group]).max(), 1.0)
        assert_close(late[0][group], dense[0][group], absolute=2e-5 * size)
        assert np.abs(sparse[0][group] - dense[0][group]).max() > 1e-2
        # The first moment is a sum of both signs; a rounding counts by its largest term, a tenth of a gradient.
        assert_close(late[1][group], dense[1][group], absolute=1e-6)
        assert_close(late[2][group], dense[2][group], relative=3e-5)


def test_every_driver_has_the_same_bits(device: Device, default_device: Device) -> None:
    config = OptimiserConfig(late=True)
    for got, wanted in zip(trained(device, config), trained(default_device, config), strict=True):
        assert_same_arrays(got, wanted)


def settled(device: Device, stopped: bool, spoilt: float = 0.5) -> tuple[Mapping[str, np.ndarray], np.ndarray]:
    """Means and opacity logits of 3 rows after 5 missed steps, and the last steps. Row 1 is hidden."""
    config = OptimiserConfig(late=True)
    missed = MissedSteps(config, tuple(PARAMETER_GROUPS))
    for number in range(1, 6):
        missed.add(AdamStep(config, number, RATES).scales)
    model = tuple(
        DeviceGaussians(3, 1, {g: upload(device, np.full(shape, 0.5, np.float32)) for g, shape in shapes.items()})
        for shapes in [group_shapes(3, 1)] * 3
    )
    model[1]["means"].set_rows(2, np.full((1, 3), spoilt, np.float32))
    values = np.zeros(len(READBACK), np.uint32)
    values[READBACK.index("STOPPED")] = stopped
    last, counts = upload(device, np.zeros(3, np.uint32)), upload(device, np.array([2, 0, 1], np.uint32))
    settle(device, config, model, 5, last, upload(device, missed.rounded()), upload(device, values), counts)
    return {group: model[0][group].get() for group in ("means", "opacity_logits")}, last.get()


def test_hidden_rows_and_stopped_passes_change_nothing(device: Device) -> None:
    moved, last = settled(device, stopped=False)
    assert np.all(moved["means"][[0, 2]] != 0.5)
    assert np.all(moved["means"][1] == 0.5)
    assert last.tolist() == [6, 0, 6]
    kept, last = settled(device, stopped=True)
    assert np.all(kept["means"] == 0.5)
    assert last.tolist() == [0, 0, 0]


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, 1e38])
def test_what_would_not_be_finite_keeps_its_parameter(device: Device, spoilt: float) -> None:
    moved, _ = settled(device, stopped=False, spoilt=spoilt)
    assert np.all(moved["means"][2] == 0.5)
    assert np.all(moved["opacity_logits"][2] != 0.5)
