# SPDX-License-Identifier: Apache-2.0
"""adam.cl: sums of views, steps that are left out, and elements that are refused."""

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
from clsplat.selftest.case import fresh_readback
from clsplat.selftest.cases.steps import ADAM_CASE, uploaded_groups
from clsplat.stages.adam import AdamStep, adam, add_view
from clsplat.stages.device_gaussians import allocate_gaussians


@pytest.mark.parametrize("count", quick([1, 7, 8, 9, 63, 64, 65], 1, 9, 65))
def test_views_are_added_in_order(shaped_device: Device, count: int) -> None:
    """Rows that a view does not show are not looked at, whatever is there."""
    rng = np.random.default_rng(count)
    sums = allocate_gaussians(shaped_device, count, 4, zero=True)
    views = []
    for _ in range(3):
        seen = rng.random(count) < 0.6
        gradients, values = allocate_gaussians(shaped_device, count, 4), {}
        for group, shape in group_shapes(count, 4).items():
            values[group] = rng.standard_normal(shape).astype(np.float32)
            values[group][~seen] = np.nan
            gradients[group].set(values[group])
        views.append((seen, values))
        add_view(shaped_device, upload(shaped_device, 5 * seen.astype(np.uint32)), gradients, sums)
    for group in PARAMETER_GROUPS:
        exact = add_views([values[group].astype(np.float64) for _, values in views], [seen for seen, _ in views])
        # two roundings, of sums that are at most three times as large as their largest term
        assert_close(sums[group].get(), exact, relative=1e-6, absolute=1e-6)
    before = sums["sh_rest"].get()
    add_view(shaped_device, upload(shaped_device, np.ones(count, np.uint32)), sums, sums, sh_rest=False)
    np.testing.assert_array_equal(sums["sh_rest"].get(), before)


@pytest.mark.smoke
def test_no_gradient_no_step(device: Device) -> None:
    models = [allocate_gaussians(device, 20, 1, zero=True) for _ in range(4)]
    models[0]["means"].fill(0.5)
    step = AdamStep(OptimiserConfig(), 1, dict.fromkeys(PARAMETER_GROUPS, 0.1))
    adam(device, step, *models, upload(device, np.ones(20, np.uint32)))
    assert np.all(models[0]["means"].get() == 0.5)


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
    assert_close(p["sh_rest"].get(), wanted[0], relative=1e-6, absolute=1e-5)  # as of a step in the case


@pytest.mark.parametrize("rows", [{}, {"sparse": True}, {"late": True}], ids=["all", "sparse", "late"])
@pytest.mark.parametrize("count", [1, 7, 8, 9, 100])
def test_what_is_not_finite_is_refused_and_marked(shaped_device: Device, count: int, rows: dict[str, bool]) -> None:
    """Element by element, whatever shares its vector; counted by what was wrong."""
    device, rng = shaped_device, np.random.default_rng(count)
    step = AdamStep(OptimiserConfig(**rows), 5, dict.fromkeys(PARAMETER_GROUPS, 0.01))
    spoils = {  # array, value, what is then in the first and second moment, place in the counts
        "parameter": ("parameters", np.nan, (0, np.inf), 0),
        "coefficient": ("parameters", -2e7, (0, np.inf), 0),
        "gradient": ("gradients", -np.inf, (0, np.inf), 1),
        "large gradient": ("gradients", 1e30, (0, np.inf), 3),
        "first moment": ("first", np.nan, (0, 0), 2),
        "second moment": ("second", -1.0, (0, 0), 2),
    }
    for name, (which, value, marks, place) in spoils.items():
        group = "sh_dc" if name == "coefficient" else "means"
        at = rng.integers(count), rng.integers(3)
        plain, spoilt = (ADAM_CASE.random(np.random.default_rng(count), count).arrays for _ in range(2))
        for kind, values in plain.items():
            for each in values:
                values[each][...] = spoilt[kind][each][...] = rng.uniform(0.5, 1.0, values[each].shape)
        spoilt[which][group][at] = value
        found, results = fresh_readback(device), []
        for arrays, readback in ((spoilt, found), (plain, fresh_readback(device))):
            models = uploaded_groups(device, arrays)
            adam(device, step, *models, upload(device, np.ones(count, np.uint32)), readback)
            names = zip(arrays, models, strict=True)
            results.append({kind: {each: model[each].get() for each in PARAMETER_GROUPS} for kind, model in names})
        before_them = len(READBACK) - len(REFUSED)
        assert found.get().tolist() == [0] * before_them + [int(index == place) for index in range(len(REFUSED))], name
        got, wanted = results
        np.testing.assert_equal(got["parameters"][group][at], spoilt["parameters"][group][at])
        assert (got["first"][group][at], got["second"][group][at]) == marks, name
        assert not any(values.any() for values in got.pop("gradients").values()), "the gradient is to be left zero"
        for kind, values in got.items():
            values[group][at] = wanted[kind][group][at]
            for each in PARAMETER_GROUPS:
                # A neighbour in the vector is worked out as a scalar, whose root a driver may round otherwise.
                assert_close(values[each], wanted[kind][each], relative=1e-6)
