# SPDX-License-Identifier: Apache-2.0
"""adam.cl against the float64 twin over several steps."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_close
from quick import quick

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import READBACK, REFUSED
from clsplat.reference.adam import adam as reference
from clsplat.reference.adam import add_views
from clsplat.stages.adam import AdamStep, adam, add_view
from clsplat.stages.device_gaussians import allocate_gaussians


@pytest.mark.parametrize("count", quick([1, 7, 8, 9, 63, 64, 65], 1, 9, 65))
def test_views_are_added_in_order(shaped_device: Device, count: int) -> None:
    """Rows that a view does not show are not looked at, whatever is there."""
    rng = np.random.default_rng(count)
    sums = allocate_gaussians(shaped_device, count, 4, zero=True)
    shown, views = upload(shaped_device, np.zeros(count, np.uint32)), []
    for _ in range(3):
        seen = rng.random(count) < 0.6
        gradients, values = allocate_gaussians(shaped_device, count, 4), {}
        for group, shape in group_shapes(count, 4).items():
            values[group] = rng.standard_normal(shape).astype(np.float32)
            values[group][~seen] = np.nan
            gradients[group].set(values[group])
        views.append((seen, values))
        add_view(shaped_device, upload(shaped_device, 5 * seen.astype(np.uint32)), gradients, sums, shown)
    for group in PARAMETER_GROUPS:
        exact = add_views([values[group].astype(np.float64) for _, values in views], [seen for seen, _ in views])
        # two roundings, of sums that are at most three times as large as their largest term
        assert_close(sums[group].get(), exact, relative=1e-6, absolute=1e-6)
    np.testing.assert_array_equal(shown.get() > 0, np.any([seen for seen, _ in views], axis=0))
    before = sums["sh_rest"].get()
    add_view(shaped_device, upload(shaped_device, np.ones(count, np.uint32)), sums, sums, sh_rest=False)
    np.testing.assert_array_equal(sums["sh_rest"].get(), before)


@pytest.mark.smoke
def test_no_gradient_no_step(device: Device) -> None:
    p, g, m, v = (allocate_gaussians(device, 20, 1, zero=True) for _ in range(4))
    p["means"].fill(0.5)
    adam(
        device,
        AdamStep(OptimiserConfig(), 1, dict.fromkeys(PARAMETER_GROUPS, 0.1)),
        p,
        g,
        m,
        v,
        upload(device, np.ones(20, np.uint32)),
    )
    assert np.all(p["means"].get() == 0.5)


@pytest.mark.parametrize("count", quick([1, 7, 8, 9, 100], 1, 9))
def test_sparse_steps_are_those_of_the_visible(shaped_device: Device, count: int) -> None:
    """Rows that the view shows get the bits of the dense step, the others keep all of theirs."""
    rng = np.random.default_rng(count)
    visible = rng.random(count) < 0.4
    visible[: count // 3] = False  # whole vectors of hidden ones, and of visible ones
    visible[2 * count // 3 :] = True
    counts = upload(shaped_device, visible.astype(np.uint32) * 3)
    dense, sparse = ([allocate_gaussians(shaped_device, count, 16, zero=True) for _ in range(4)] for _ in range(2))
    before = {}
    for group, shape in group_shapes(count, 16).items():
        for index in range(4):
            values = rng.random(shape).astype(np.float32)
            if index == 1:
                values[~visible] = 0.0
            before[group, index] = values
            dense[index][group].set(values)
            sparse[index][group].set(values)
    rates = dict.fromkeys(PARAMETER_GROUPS, 0.1)
    adam(shaped_device, AdamStep(OptimiserConfig(), 3, rates), *dense, counts)
    adam(shaped_device, AdamStep(OptimiserConfig(sparse=True), 3, rates), *sparse, counts)
    for (group, index), values in before.items():
        got = sparse[index][group].get()
        np.testing.assert_array_equal(got[visible], dense[index][group].get()[visible], err_msg=group)
        np.testing.assert_array_equal(got[~visible], values[~visible], err_msg=group)


@pytest.mark.smoke
def test_sh_rest_waits_for_its_step(device: Device) -> None:
    """Its second update, at step 6 of every third, is Adam's second step."""
    config = OptimiserConfig(sh_rest_every=3)
    p, g, m, v = (allocate_gaussians(device, 5, 4, zero=True) for _ in range(4))
    counts = upload(device, np.ones(5, np.uint32))
    wanted = (np.zeros((5, 3, 3)), np.zeros((5, 3, 3)), np.zeros((5, 3, 3)))
    for step in range(1, 8):
        g["sh_rest"].fill(0.5 * step if step % 3 == 0 else 0.0)
        before = p["sh_rest"].get()
        adam(device, AdamStep(config, step, dict.fromkeys(PARAMETER_GROUPS, 0.1)), p, g, m, v, counts)
        if step % 3:
            np.testing.assert_array_equal(p["sh_rest"].get(), before)
        else:
            wanted = reference(wanted[0], np.full((5, 3, 3), 0.5 * step), *wanted[1:], step // 3, 0.1)
    assert_close(p["sh_rest"].get(), wanted[0], relative=1e-6, absolute=1e-5)  # as in test_steps


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("count", [1, 7, 8, 9, 100])
def test_what_is_not_finite_is_refused_and_marked(shaped_device: Device, count: int, sparse: bool) -> None:
    """Element by element, whatever shares its vector; counted by what was wrong."""
    device, rng = shaped_device, np.random.default_rng(count)
    rates = dict.fromkeys(PARAMETER_GROUPS, 0.01)
    spoils = {  # array, value, what is then in the first and second moment, place in the counts
        "parameter": (0, np.nan, (0, np.inf), 0),
        "coefficient": (0, -2e7, (0, np.inf), 0),
        "gradient": (1, -np.inf, (0, np.inf), 1),
        "large gradient": (1, 1e30, (0, np.inf), 3),
        "first moment": (2, np.nan, (0, 0), 2),
        "second moment": (3, -1.0, (0, 0), 2),
    }
    for name, (which, value, marks, place) in spoils.items():
        group = "sh_dc" if name == "coefficient" else "means"
        row, column = rng.integers(count), rng.integers(3)
        start = {
            g: rng.uniform(0.5, 1.0, (4, *shape)).astype(np.float32) for g, shape in group_shapes(count, 4).items()
        }
        found = upload(device, np.zeros(len(READBACK), np.uint32))
        models = []
        for spoilt in (True, False):
            arrays = [allocate_gaussians(device, count, 4) for _ in range(4)]
            for g in PARAMETER_GROUPS:
                for index, array in enumerate(arrays):
                    values = start[g][index].copy()
                    if spoilt and (g, index) == (group, which):
                        values[row, column] = value
                    array[g].set(values)
            shown = upload(device, np.ones(count, np.uint32))
            counts = found if spoilt else upload(device, np.zeros(len(READBACK), np.uint32))
            adam(device, AdamStep(OptimiserConfig(sparse=sparse), 5, rates), *arrays, shown, counts)
            models.append([{g: array[g].get() for g in PARAMETER_GROUPS} for array in arrays])
        before_them = len(READBACK) - len(REFUSED)
        assert found.get().tolist() == [0] * before_them + [int(index == place) for index in range(len(REFUSED))], name
        got, wanted = models
        before = np.float32(value) if which == 0 else start[group][0][row, column]
        np.testing.assert_equal(got[0][group][row, column], before)
        assert (got[2][group][row, column], got[3][group][row, column]) == marks, name
        assert not any(got[1][g].any() for g in PARAMETER_GROUPS), "the gradient is to be left zero"
        for index in (0, 2, 3):
            got[index][group][row, column] = wanted[index][group][row, column]
            for g in PARAMETER_GROUPS:
                # A neighbour in the vector is worked out as a scalar, whose root a driver may round otherwise.
                assert_close(got[index][g], wanted[index][g], relative=1e-6)
