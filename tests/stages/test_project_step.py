# SPDX-License-Identifier: Apache-2.0
"""project_step against project_grad and adam one after the other, to the bit: these two are held against float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from numpy.typing import NDArray
from pipeline import BACKGROUND
from quick import quick

from clsplat.camera import Camera
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, group_shapes
from clsplat.layouts.columns import PLAIN_SLOTS, READBACK, REFUSED, WIDEST_SLOTS, SlotFields
from clsplat.optimisation.step_noise import NO_EXPLORATION, Exploration
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, upload_gaussians
from clsplat.stages.project import Screen, Slots, ViewSlots, add_slots, project_grad, project_step

EVERY_ROW = OptimiserConfig()
RATES = {group: 10.0**-index for index, group in enumerate(PARAMETER_GROUPS, 1)}
UNREACHED = 3
"""The first Gaussian, of every fifth, whose slots are zero, as those of Gaussians behind others are."""


@dataclass(frozen=True)
class Case:
    """A build of the kernel, at one step."""

    degree: int = 3
    optimiser: OptimiserConfig = EVERY_ROW
    fields: SlotFields = PLAIN_SLOTS
    added_up: bool = False
    step: int = 5
    explore: Exploration = NO_EXPLORATION

    @property
    def adam_step(self) -> AdamStep:
        return AdamStep(self.optimiser, self.step, RATES)


CASES = {
    "degree 3": Case(),
    "degree 2": Case(degree=2),
    "degree 1": Case(degree=1),
    "degree 0": Case(degree=0),
    "sparse": Case(optimiser=OptimiserConfig(sparse=True)),
    "the higher SH bands wait": Case(optimiser=OptimiserConfig(sh_rest_every=3)),
    "the higher SH bands' second step, sparse": Case(optimiser=OptimiserConfig(sparse=True, sh_rest_every=3), step=6),
    "all fields of slots": Case(degree=1, fields=WIDEST_SLOTS),
    "several bands": Case(degree=1, added_up=True),
    "penalties": Case(explore=Exploration(opacity=0.2, scale=0.3)),
    "penalties, all fields of slots, sparse": Case(
        optimiser=OptimiserConfig(sparse=True),
        fields=WIDEST_SLOTS,
        explore=Exploration(opacity=0.2),
    ),
}


def cloud(count: int, degree: int) -> tuple[Gaussians, Camera]:
    """Gaussians of which a quarter are behind the camera, among them a whole vector of lanes."""
    gaussians, camera = scenes.random_cloud(count, 11, 70, 50, degree=degree)
    hidden = np.arange(count) % 4 == 1
    hidden[16:40] = True
    gaussians.means[hidden] -= 100 * camera.rotation[2].astype(np.float32)
    return gaussians, camera


def numbers(array: DeviceArray, rng: np.random.Generator, low: float, high: float) -> None:
    array.set(rng.uniform(low, high, array.shape).astype(np.float32))


def steps(
    device: Device, case: Case, count: int, spoil: str = ""
) -> tuple[list[dict[str, NDArray[np.float32]]], list[dict[str, NDArray[np.float32]]]]:
    """Arrays after the one launch, and after the two."""
    gaussians, camera = cloud(count, case.degree)
    rasterizer, work = Rasterizer(device), Workspace(device)
    held = upload_gaussians(device, gaussians)
    frame = rasterizer.forward(held, camera, upload(device, np.array(BACKGROUND, np.float32)))
    counts = frame.projected.tile_counts.get()
    pairs = int(counts.sum())
    rng = np.random.default_rng(count)
    values = rng.normal(0, 1, (pairs, case.fields.floats)).astype(np.float32)
    assert frame.listed.counted.first_slots is not None
    first_slots = frame.listed.counted.first_slots.get()
    for index in range(UNREACHED, count, 5):
        values[first_slots[index] : first_slots[index] + counts[index]] = 0.0
    if spoil == "gradient" and pairs:
        values[first_slots[np.argmax(counts)]] = np.nan
    slots = Slots(upload(device, values), frame.listed.counted.first_slots, case.fields)
    if case.added_up:
        slots = Slots(add_slots(device, work, frame.projected.tile_counts, slots, None), fields=case.fields)
    results = []
    for fused in (True, False):
        rng = np.random.default_rng(count)
        parameters = upload_gaussians(device, gaussians)
        first, second = (allocate_gaussians(device, count, held.coefficients) for _ in range(2))
        for group in PARAMETER_GROUPS:
            numbers(first[group], rng, -0.1, 0.1)
            numbers(second[group], rng, 0.0, 0.1)
        if spoil == "moment":
            for group in PARAMETER_GROUPS:
                broken = first[group].get()
                broken.reshape(count, -1)[count // 2, -1:] = np.inf
                first[group].set(broken)
        arrays = after_step(device, case, (parameters, first, second), fused=fused, frame=frame, slots=slots)
        results.append(arrays)
    return results[0], results[1]


def after_step(
    device: Device,
    case: Case,
    model: tuple[DeviceGaussians, DeviceGaussians, DeviceGaussians],
    *,
    fused: bool,
    frame: ForwardPass,
    slots: Slots,
) -> list[dict[str, NDArray[np.float32]]]:
    """Model, view and counts on the host, after a step."""
    parameters, first, second = model
    projected, count, coefficients = frame.projected, parameters.count, parameters.coefficients
    readback = upload(device, np.zeros(len(READBACK), np.uint32))
    contributions = upload(device, np.zeros(count, np.float32)) if case.fields.contributions else None
    screen = Screen(upload(device, np.zeros((count, 2), np.float32)), contributions)
    view = ViewSlots(frame.camera_array, projected, slots)
    if fused:
        project_step(device, case.adam_step, model, view, screen, readback, explore=case.explore)
    else:
        gradients = allocate_gaussians(device, count, coefficients, zero=True)
        also = {"sh_rest": case.adam_step.updates_sh_rest, "explore": case.explore}
        project_grad(device, parameters, view, gradients, screen, **also)
        models = (parameters, gradients, first, second)
        adam(device, case.adam_step, *models, projected.tile_counts, readback)
    view_arrays = {"screen": screen.gradients.get(), "counts": readback.get()}
    if contributions is not None:
        view_arrays["contributions"] = contributions.get()
    return [*({group: each[group].get() for group in PARAMETER_GROUPS} for each in model), view_arrays]


def assert_alike(device: Device, case: Case, count: int, spoil: str = "") -> list[dict[str, NDArray[np.float32]]]:
    got, wanted = steps(device, case, count, spoil)
    for kind, one, other in zip(("parameters", "first", "second", "view"), got, wanted, strict=True):
        for name, values in other.items():
            assert_same_bits(one[name], values, f"{kind} {name}")
    return got


@pytest.mark.parametrize("name", quick(CASES, "degree 3", "sparse"))
def test_one_launch_has_the_bits_of_two(shaped_device: Device, name: str) -> None:
    case = CASES[name]
    arrays = assert_alike(shaped_device, case, 203)
    assert not arrays[3]["counts"].any()
    gaussians, _ = cloud(203, case.degree)
    moved = (arrays[0]["means"] != gaussians.means).any(axis=1)
    assert moved[0]
    assert moved[20] != case.optimiser.sparse, "a hidden Gaussian moves by its moments"
    assert moved[UNREACHED] != case.optimiser.sparse, "so does one in view whose mean has no gradient"
    waits = not case.adam_step.updates_sh_rest
    assert (arrays[0]["sh_rest"].tobytes() == gaussians.sh[:, 1:].tobytes()) == (waits or case.degree == 0)


@pytest.mark.parametrize("count", quick([1, 7, 8, 9, 63, 64, 65, 127, 128, 129], 1, 9, 129))
def test_sizes_at_the_seams(shaped_device: Device, count: int) -> None:
    assert_alike(shaped_device, CASES["degree 3"], count)
    assert_alike(shaped_device, CASES["sparse"], count)


@pytest.mark.parametrize("name", ["degree 3", "sparse"])
@pytest.mark.parametrize("count", [5, 66])
def test_what_is_not_finite_is_refused_alike(shaped_device: Device, name: str, count: int) -> None:
    case = CASES[name]
    for spoil, reason in (("gradient", "gradients"), ("moment", "moments")):
        counts = assert_alike(shaped_device, case, count, spoil)[3]["counts"]
        refused = dict(zip(REFUSED, counts[-len(REFUSED) :], strict=True))
        # Every element of a Gaussian gets a gradient that is not finite; one of each group has such a moment.
        floats = sum(int(np.prod(shape)) for shape in group_shapes(1, 16).values())
        shown = spoil == "gradient" or not case.optimiser.sparse or (count // 2) % 4 != 1
        most = floats if spoil == "gradient" else len(PARAMETER_GROUPS)
        assert (0 < refused[reason] <= most) or not shown
        assert sum(counts) == refused[reason], "and for no other reason"
