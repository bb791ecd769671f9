# SPDX-License-Identifier: Apache-2.0
"""adam.cl: sums of views, steps that are left out, elements that are refused, and steps over listed chunks."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_close, assert_same_arrays
from numpy.typing import NDArray
from quick import quick

from clsplat.arrays import Float32
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK, READBACK, REFUSED
from clsplat.reference.adam import adam as reference
from clsplat.reference.adam import add_views
from clsplat.selftest.case import fresh_readback
from clsplat.selftest.cases.steps import ADAM_CASE, ADAM_RATES, uploaded_groups
from clsplat.stages.adam import AdamStep, adam, add_view
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians


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


LISTS: dict[int, list[list[int]]] = {
    1: [[0]],
    CHUNK_ROWS - 1: [[0]],
    CHUNK_ROWS: [[0]],
    CHUNK_ROWS + 1: [[0], [1], [0, 1]],
    3 * CHUNK_ROWS + 129: [[1], [3], [0, 2, 3], [0, 1, 2, 3]],
}
"""Lists of chunks by the number of rows of the model. The last chunk is full, has one row, or lacks one."""


def _some_rows(model: DeviceGaussians, rows: NDArray[np.int64]) -> dict[str, Float32]:
    return {group: model[group].get()[rows] for group in PARAMETER_GROUPS}


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("count", quick(LISTS, 1, 3 * CHUNK_ROWS + 129))
def test_listed_chunks_take_the_step_alone(shaped_device: Device, count: int, sparse: bool) -> None:
    """Their rows get the bits of a step over the whole model, and other rows stay. The list has padding."""
    rng, step = np.random.default_rng(count), AdamStep(OptimiserConfig(sparse=sparse), 5, ADAM_RATES)
    arrays = ADAM_CASE.random(rng, count).arrays
    for values in arrays["gradients"].values():
        values[rng.random(count) < 0.5] = 0
    whole = uploaded_groups(shaped_device, arrays)
    adam(shaped_device, step, *whole)
    for numbers in LISTS[count]:
        listed = ChunkList(upload(shaped_device, np.array([*numbers, NO_CHUNK], np.uint32)), count)
        rows = np.flatnonzero(np.isin(np.arange(count) // CHUNK_ROWS, numbers))
        model = uploaded_groups(shaped_device, arrays)
        gradients = allocate_gaussians(shaped_device, listed.rows, model[1].coefficients, zero=True)
        for group, values in arrays["gradients"].items():
            gradients[group].set_rows(0, values[rows])
        parameters, _, *moments = model
        adam(shaped_device, step, parameters, gradients, *moments, chunks=listed)
        others = np.setdiff1d(np.arange(count), rows)
        for got, wanted, kind in zip(model, whole, arrays, strict=True):
            if kind == "gradients":
                assert not any(gradients[group].get().any() for group in PARAMETER_GROUPS)
                continue
            assert_same_arrays(_some_rows(got, rows), _some_rows(wanted, rows))
            assert_same_arrays(_some_rows(got, others), {g: v[others] for g, v in arrays[kind].items()})


def test_views_of_chunks_are_added_at_their_places(shaped_device: Device) -> None:
    """A view of chunks 2 and 5 in a step over 2, 3 and 5. The second launch has a part of the rows, and padding."""
    rng, view, chunks = np.random.default_rng(3), np.array([0, 2]), 3
    sums = allocate_gaussians(shaped_device, chunks * CHUNK_ROWS, 4, zero=True)
    wanted = {group: np.zeros(sums[group].shape, np.float32) for group in PARAMETER_GROUPS}
    for rows, places in ((2 * CHUNK_ROWS, view), (CHUNK_ROWS + 700, view), (2 * CHUNK_ROWS, [2, NO_CHUNK])):
        counts = rng.integers(0, 3, rows).astype(np.uint32)
        counts[CHUNK_ROWS:] *= places[-1] != NO_CHUNK
        gradients = allocate_gaussians(shaped_device, rows, 4)
        to = (np.repeat(CHUNK_ROWS * np.array(places), CHUNK_ROWS) + np.tile(np.arange(CHUNK_ROWS), 2))[:rows]
        for group, shape in group_shapes(rows, 4).items():
            values = rng.standard_normal(shape).astype(np.float32)
            gradients[group].set(values)
            wanted[group][to[counts > 0]] += values[counts > 0]
        listed = ChunkList(upload(shaped_device, np.array(places, np.uint32)), sums.count)
        add_view(shaped_device, upload(shaped_device, counts), gradients, sums, places=listed)
    assert_same_arrays({group: sums[group].get() for group in PARAMETER_GROUPS}, wanted)
