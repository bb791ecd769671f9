# SPDX-License-Identifier: Apache-2.0
"""catch_up.cl against Adam over all rows at every step, to the bit: in values, and in refusals by reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from numpy.typing import NDArray
from quick import quick

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK, READBACK, REFUSED, SPLAT
from clsplat.selftest.case import fresh_readback
from clsplat.selftest.cases.steps import uploaded_groups
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.catch_up import StepTable, catch_up, step_table
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import DeviceGaussians
from clsplat.stages.project import Projected, Screen, Slots, ViewSlots, project_step

Arrays = dict[str, dict[str, NDArray[np.float32]]]
"""Parameters and both moments, by group."""
KINDS = ("parameters", "first", "second")
DENSE = OptimiserConfig()
RATES = {group: 10.0**-index for index, group in enumerate(PARAMETER_GROUPS, 1)}


def falling(number: int) -> float:
    return 0.999**number


def steps_of(
    config: OptimiserConfig, first: int, count: int, schedule: Callable[[int], float] = falling
) -> list[AdamStep]:
    """Steps from number `first` on."""
    return [
        AdamStep(config, number, {group: rate * schedule(number) for group, rate in RATES.items()})
        for number in range(first, first + count)
    ]


def trained(count: int, coefficients: int, seed: int = 0) -> Arrays:
    """A model with moments of any magnitude, also denormal ones and zeros of both signs."""
    rng = np.random.default_rng([seed, count])
    made: Arrays = {kind: {} for kind in KINDS}
    for group, shape in group_shapes(count, coefficients).items():
        size = np.where(rng.random(shape) < 0.1, 10 ** rng.uniform(-24, 1, shape), 10 ** rng.uniform(-8, -2, shape))
        first = rng.standard_normal(shape) * size
        second = size**2 * 10 ** rng.uniform(-1, 2, shape)
        none = rng.random(shape) < 0.2
        first[none] = rng.choice([0.0, -0.0], shape)[none]
        second[none & (rng.random(shape) < 0.5)] = 0.0
        made["parameters"][group] = rng.standard_normal(shape) * rng.choice([1.0, 1e-3, 0.0], shape, p=[0.7, 0.2, 0.1])
        made["first"][group] = np.where(rng.random(shape) < 0.05, first * 1e-40 / size, first)
        made["second"][group] = np.where(rng.random(shape) < 0.02, 10 ** rng.uniform(-44, -38, shape), second)
    return {kind: {group: values.astype(np.float32) for group, values in by.items()} for kind, by in made.items()}


def healthy(count: int, seed: int = 0) -> Arrays:
    """A model none of whose elements is refused."""
    rng, shapes = np.random.default_rng([seed, count]), group_shapes(count, 4)
    sizes = dict(zip(KINDS, ((-1.0, 1.0), (-0.01, 0.01), (1e-5, 1e-3)), strict=True))
    return {
        kind: {group: rng.uniform(*ends, shape).astype(np.float32) for group, shape in shapes.items()}
        for kind, ends in sizes.items()
    }


def rows_of(arrays: Arrays, rows: slice) -> Arrays:
    return {kind: {group: values[rows] for group, values in by.items()} for kind, by in arrays.items()}


def read(model: Sequence[DeviceGaussians]) -> Arrays:
    return {
        kind: {group: each[group].get() for group in PARAMETER_GROUPS} for kind, each in zip(KINDS, model, strict=True)
    }


def dense(device: Device, arrays: Arrays, steps: Sequence[AdamStep]) -> tuple[Arrays, NDArray[np.uint32]]:
    """The model after Adam's steps over all rows with gradient zero, and the refusals."""
    parameters, first, second = uploaded_groups(device, arrays)
    zeros = {group: upload(device, np.zeros_like(values)) for group, values in arrays["parameters"].items()}
    gradients, readback = DeviceGaussians(parameters.count, parameters.coefficients, zeros), fresh_readback(device)
    for step in steps:
        adam(device, step, parameters, gradients, first, second, readback=readback)
    return read((parameters, first, second)), readback.get()


def caught_up(
    device: Device, arrays: Arrays, steps: Sequence[AdamStep], last: dict[int, int], stopped: bool = False
) -> tuple[Arrays, NDArray[np.uint32]]:
    """The model after `catch_up` of the chunks in `last` by number, then NO_CHUNK, and what it counted."""
    model = tuple(uploaded_groups(device, arrays))
    counts = np.zeros(len(READBACK), np.uint32)
    counts[READBACK.index("STOPPED")] = stopped
    readback = upload(device, counts)
    numbers = upload(device, np.array([*last, NO_CHUNK, NO_CHUNK], np.uint32))
    caught = upload(device, np.zeros(-(-model[0].count // CHUNK_ROWS), np.uint32))
    given = (upload(device, np.array([*last.values(), 0, 0], np.uint32)), caught, steps[-1].number)
    table = StepTable(upload(device, step_table(steps)), steps[0].number)
    catch_up(device, steps[0].config, model, ChunkList(numbers, model[0].count), *given, table, readback)
    return read(model), readback.get()


def assert_alike(got: Arrays, wanted: Arrays) -> None:
    for kind, by in wanted.items():
        for group, values in by.items():
            assert_same_bits(got[kind][group], values, f"{kind} {group}")


def check(device: Device, arrays: Arrays, steps: Sequence[AdamStep], last: dict[int, int]) -> Arrays:
    """Compare chunks with dense steps, and the other chunks with what they were. Returns the model after the steps."""
    got, counts = caught_up(device, arrays, steps, last)
    count, refused = len(arrays["parameters"]["means"]), np.zeros(len(READBACK), np.uint32)
    for chunk in range(-(-count // CHUNK_ROWS)):
        rows = slice(chunk * CHUNK_ROWS, (chunk + 1) * CHUNK_ROWS)
        missed = [step for step in steps if step.number > last.get(chunk, steps[-1].number)]
        wanted, more = dense(device, rows_of(arrays, rows), missed)
        assert_alike(rows_of(got, rows), wanted)
        refused += more
    assert counts.tolist() == refused.tolist()
    return got


@pytest.mark.parametrize("degree", quick([0, 1, 2, 3], 0, 3))
def test_chunks_have_the_bits_of_dense_steps(shaped_device: Device, degree: int) -> None:
    """Chunks that missed different numbers of steps, the last of them with a part of its rows; one is not listed."""
    arrays = trained(3 * CHUNK_ROWS + 39, (degree + 1) ** 2)
    steps = steps_of(DENSE, 101, 255)
    got = check(shaped_device, arrays, steps, {0: 338, 2: 354, 3: 100})
    assert (got["parameters"]["means"][:CHUNK_ROWS] != arrays["parameters"]["means"][:CHUNK_ROWS]).mean() > 0.5


@pytest.mark.parametrize("count", quick([1, 7, 8, 9, 63, 64, 65, 127, 128, 129, CHUNK_ROWS], 1, 9, 129))
@pytest.mark.parametrize("missed", [2, 17])
def test_sizes_at_the_seams(shaped_device: Device, count: int, missed: int) -> None:
    check(shaped_device, trained(count, 4), steps_of(DENSE, 1, missed), {0: 0})


def test_a_model_without_moments(shaped_device: Device) -> None:
    """Zeros lose their sign, once; then nothing changes."""
    arrays, rng = healthy(129), np.random.default_rng(0)
    for kind in KINDS[1:]:
        for values in arrays[kind].values():
            values[...] = rng.choice([0.0, -0.0], values.shape)
    got = check(shaped_device, arrays, steps_of(DENSE, 1, 33), {0: 0})
    assert not any(np.signbit(values).any() for kind in KINDS[1:] for values in got[kind].values())


def test_thousands_of_steps(shaped_device: Device) -> None:
    """Moments become denormal on the way, and most stop there."""
    arrays = trained(9, 4)
    got = check(shaped_device, arrays, steps_of(DENSE, 30_001, 5000), {0: 30_000})
    assert (np.abs(got["first"]["sh_rest"]) < 1e-37).all()


@pytest.mark.parametrize("last", [100, 101, 102, 103])
def test_higher_sh_bands_wait_for_their_steps(shaped_device: Device, last: int) -> None:
    config = OptimiserConfig(sh_rest_every=3)
    arrays = trained(150, 16)
    got = check(shaped_device, arrays, steps_of(config, 101, 40), {0: last})
    assert (got["parameters"]["sh_rest"] != arrays["parameters"]["sh_rest"]).any()
    two = check(shaped_device, arrays, steps_of(config, 100, 2), {0: 99})
    assert_same_bits(two["second"]["sh_rest"], arrays["second"]["sh_rest"])


@pytest.mark.parametrize("betas", [(0.9, 0.95), (0.99, 0.9), (0.99, 0.5), (0.4, 0.8), (0.0, 0.5)])
def test_other_betas(shaped_device: Device, betas: tuple[float, float]) -> None:
    """With a small beta1 moments go to zero; with a beta2 under that of (193) movements may grow."""
    config = OptimiserConfig(beta1=betas[0], beta2=betas[1])
    check(shaped_device, trained(90, 4), steps_of(config, 51, 300), {0: 50})
    slow = steps_of(config, 51, 300, lambda _: 1e-6)
    arrays = healthy(90)
    got = check(shaped_device, arrays, slow, {0: 50})
    if betas[0] ** 2 > betas[1]:
        assert (got["parameters"]["means"] != arrays["parameters"]["means"]).any()


@pytest.mark.parametrize("late", [60, 150])
def test_rates_that_rise_again(shaped_device: Device, late: int) -> None:
    """A movement that was lost in rounding shows again."""
    steps = steps_of(DENSE, 1001, 200, lambda number: 1e9 if number - 1000 == late else 1.0)
    arrays = trained(90, 4)
    got = check(shaped_device, arrays, steps, {0: 1000})
    without, _ = dense(shaped_device, arrays, steps_of(DENSE, 1001, 200, lambda _: 1.0))
    assert (got["parameters"]["sh_dc"] != without["parameters"]["sh_dc"]).mean() > 0.3


SPOILS: dict[str, tuple[str, str, float, str | None]] = {  # kind, group, value, and how it is counted
    "parameter is not a number": ("parameters", "means", np.nan, "parameters"),
    "parameter is infinite": ("parameters", "log_scales", -np.inf, "parameters"),
    "coefficient over its limit": ("parameters", "sh_dc", -2e7, "parameters"),
    "mean under the limit of others": ("parameters", "means", 9e18, None),
    "first moment is not a number": ("first", "quaternions", np.nan, "moments"),
    "first moment is infinite": ("first", "sh_rest", np.inf, "moments"),
    "second moment is negative": ("second", "opacity_logits", -1.0, "moments"),
    "second moment is not a number": ("second", "means", np.nan, "moments"),
    "marked": ("second", "sh_rest", np.inf, "steps"),
    "second moment over the limit": ("second", "sh_rest", 1.1e14, "steps"),
    "second moment over the limit for three steps": ("second", "sh_rest", 1.0035e14, "steps"),
    "second moment under the limit after a step": ("second", "sh_rest", 1.0005e14, None),
}


@pytest.mark.parametrize("missed", [1, 20, 60])
@pytest.mark.parametrize(("count", "at_rest"), [(1, False), (37, False), (37, True)])
def test_what_is_not_finite_is_refused_and_marked(
    shaped_device: Device, count: int, missed: int, at_rest: bool
) -> None:
    """Once for each step, as over all rows, whether what shares its vector moves or not."""
    for index, (name, (kind, group, value, reason)) in enumerate(SPOILS.items()):
        arrays = healthy(count, index)
        at = np.unravel_index(index % arrays[kind][group].size, arrays[kind][group].shape)
        if kind == "second":
            arrays["first"][group][at] = 0.0
        if at_rest:
            for values in arrays["first"].values():
                values[...] = 0.0
        arrays[kind][group][at] = value
        steps = steps_of(DENSE, 11, missed)
        got = check(shaped_device, arrays, steps, {0: 10})
        _, counts = caught_up(shaped_device, arrays, steps, {0: 10})
        found = dict(zip(REFUSED, counts[-len(REFUSED) :].tolist(), strict=True))
        wanted = dict.fromkeys(REFUSED, 0)
        if reason is not None:
            wanted[reason] = 1 if reason == "moments" else missed  # moments begin again, the others are marked
        assert found == wanted, name
        if reason in ("parameters", "steps"):
            assert (got["first"][group][at], got["second"][group][at]) == (0, np.inf), name


def test_a_parameter_that_reaches_its_limit_on_the_way(shaped_device: Device) -> None:
    """It stops before the limit, at the same step as over all rows."""
    arrays = healthy(21)
    arrays["parameters"]["sh_rest"][13, 1] = 1e7 - 12
    arrays["first"]["sh_rest"][13, 1] = -0.5
    arrays["second"]["sh_rest"][13, 1] = 1.0
    steps = steps_of(DENSE, 1001, 40, lambda _: 1e7)  # the rate of sh_rest is 10, so that a movement is 3 to 4
    got = check(shaped_device, arrays, steps, {0: 1000})
    assert (got["parameters"]["sh_rest"][13, 1] > 1e7 - 6).all()
    assert np.isinf(got["second"]["sh_rest"][13, 1]).all()


def test_nothing_changes_after_a_stopped_pass_or_without_missed_steps(device: Device) -> None:
    arrays, steps = trained(CHUNK_ROWS + 5, 4), steps_of(DENSE, 11, 5)
    assert_alike(caught_up(device, arrays, steps, {0: 10, 1: 12}, stopped=True)[0], arrays)
    assert_alike(caught_up(device, arrays, steps, {0: 15, 1: 16})[0], arrays)
    assert_alike(caught_up(device, arrays, steps, {})[0], arrays)


def test_a_trial_on_zeros_reads_no_table(device: Device) -> None:
    """All arrays of a trial are zero, and its numbers are the launch's: chunk 0 has taken step 0, before the table."""
    arrays, steps = trained(5, 4), steps_of(DENSE, 1_000_000_000, 5)
    assert_alike(caught_up(device, arrays, steps, {0: 0})[0], arrays)


def test_a_table_that_ends_too_early_is_refused(default_device: Device) -> None:
    model = tuple(uploaded_groups(default_device, trained(3, 1)))
    chunks = ChunkList(upload(default_device, np.zeros(1, np.uint32)), 3)
    last, table = (
        upload(default_device, np.zeros(1, np.uint32)),
        upload(default_device, step_table(steps_of(DENSE, 1, 4))),
    )
    with pytest.raises(ValueError, match="has steps 1 to 4, but step 5 is needed"):
        steps = (last, last, 5, StepTable(table, 1))
        catch_up(default_device, DENSE, model, chunks, *steps, fresh_readback(default_device))


@pytest.mark.parametrize("every", [1, 3])
def test_bits_of_project_step(shaped_device: Device, every: int) -> None:
    """The step of a training on a view that shows no Gaussian."""
    device, count, config = shaped_device, 150, OptimiserConfig(sh_rest_every=every)
    arrays, steps = trained(count, 16), steps_of(config, 101, 30)
    parameters, first, second = uploaded_groups(device, arrays)
    _, camera = scenes.random_cloud(4, 11, 70, 50, degree=3)
    hidden = upload(device, np.zeros(count, np.uint32))
    projected = Projected(upload(device, np.zeros((count, len(SPLAT)), np.float32)), hidden)
    slots = Slots(upload(device, np.zeros((1, 9), np.float32)), hidden)
    view = ViewSlots(upload(device, pack_camera(camera)), projected, slots)
    screen = Screen(upload(device, np.zeros((count, 2), np.float32)))
    for step in steps:
        project_step(device, step, (parameters, first, second), view, screen, fresh_readback(device))
    got, _ = caught_up(device, arrays, steps, {0: 100})
    assert_alike(got, read((parameters, first, second)))
