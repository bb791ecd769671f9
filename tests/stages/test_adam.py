# SPDX-License-Identifier: Apache-2.0
"""adam.cl against the float64 twin over several steps."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_close

from clsplat.config import OptimiserConfig
from clsplat.device.context import Device
from clsplat.reference.adam import adam as reference
from clsplat.stages.adam import adam
from clsplat.stages.project import GROUPS, allocate_gaussians, group_shapes


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 100])
def test_steps(shaped_device: Device, count: int) -> None:
    rng = np.random.default_rng(count)
    rates = {group: 10.0**-index for index, group in enumerate(GROUPS)}
    shapes = group_shapes(count, 4)
    p, g, m, v = (allocate_gaussians(shaped_device, count, 4, zero=True) for _ in range(4))
    wanted = {}
    for group in GROUPS:
        values = rng.standard_normal(shapes[group]).astype(np.float32)
        p[group].set(values)
        wanted[group] = (values.astype(np.float64), np.zeros(shapes[group]), np.zeros(shapes[group]))
    for step in range(1, 5):
        for group in GROUPS:
            gradient = (10.0 ** rng.uniform(-8, 2) * rng.standard_normal(shapes[group])).astype(np.float32)
            g[group].set(gradient)
            wanted[group] = reference(
                wanted[group][0], gradient.astype(np.float64), *wanted[group][1:], step, rates[group], 0.9, 0.999, 1e-15
            )
        adam(shaped_device, step, rates, OptimiserConfig(), p, g, m, v)
    for group in GROUPS:
        # beta2 in float32 is 1e-8 off in 1 - beta2 = 1e-3: 1e-5 of a step, of which there were four.
        assert_close(p[group].get(), wanted[group][0], relative=1e-6, absolute=1e-4 * rates[group])
        assert not g[group].get().any(), "the gradient is to be left zero"


def test_no_gradient_no_step(device: Device) -> None:
    p, g, m, v = (allocate_gaussians(device, 20, 1, zero=True) for _ in range(4))
    p["means"].fill(0.5)
    adam(device, 1, dict.fromkeys(GROUPS, 0.1), OptimiserConfig(), p, g, m, v)
    assert np.all(p["means"].get() == 0.5)
