# SPDX-License-Identifier: Apache-2.0
"""Launches by capacity: kernels that find their number of elements on the device do what they do when they are told it,
and a pass with more pairs than it has room for changes nothing."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from quick import quick

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import PLAIN_SLOTS, READBACK
from clsplat.rendering.rasterizer import ForwardPass, PairCapacity, Rasterizer
from clsplat.stages.adam import AdamStep
from clsplat.stages.density import add_statistics, new_statistics
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, upload_gaussians
from clsplat.stages.project import ViewSlots, project_step
from clsplat.stages.scan import MAX_SINGLE_CHUNK_ELEMENTS, Elements, scan
from clsplat.stages.sort import MAX_BITONIC_KEYS, bitonic_sort, radix_sort

SEAMS = [
    (most, count)
    for most in (1, 64, 1023, 1024, 1025, MAX_SINGLE_CHUNK_ELEMENTS, MAX_SINGLE_CHUNK_ELEMENTS + 1, 20_000)
    for count in sorted({0, 1, most // 3, most - 1, most})
]
"""Elements that a launch is for at most, about a group's and a chunk's, and elements that there are."""
NAMES = ("VISIBLE", "PAIRS", "STOPPED", *(name for name in READBACK if name.startswith("REFUSED")))
RATES = dict.fromkeys(PARAMETER_GROUPS, 0.01)


def elements(device: Device, most: int, count: int) -> Elements:
    return Elements(most, upload(device, np.array([77, count, 99], np.uint32)), 1)


@pytest.mark.parametrize(("most", "count"), SEAMS)
def test_scan_of_as_many_as_the_device_says(shaped_device: Device, most: int, count: int) -> None:
    values = np.random.default_rng(most).integers(0, 4, most).astype(np.uint32)
    out, total = upload(shaped_device, np.full(most, 7, np.uint32)), allocate(shaped_device, (1,), np.uint32)
    work, found = Workspace(shaped_device), elements(shaped_device, most, count)
    scan(shaped_device, work, upload(shaped_device, values), out, total, found)
    expected = np.cumsum(values[:count]) - values[:count]
    assert_same_bits(out.get(), np.concatenate([expected, np.full(most - count, 7)]).astype(np.uint32))
    assert total.get()[0] == values[:count].sum()


@pytest.mark.slow
@pytest.mark.parametrize(("most", "count"), SEAMS)
def test_sorts_of_as_many_as_the_device_says(shaped_device: Device, most: int, count: int) -> None:
    keys = np.random.default_rng(most).integers(0, 1 << 17, most).astype(np.uint32)
    on_device, found = upload(shaped_device, keys), elements(shaped_device, most, count)
    order, work = np.argsort(keys[:count], kind="stable"), Workspace(shaped_device)
    results = [radix_sort(shaped_device, work, "radix", on_device, 17, 0, found)]
    if most <= MAX_BITONIC_KEYS:
        results.append(bitonic_sort(shaped_device, work, "bitonic", on_device, found))
    for sorted_keys, positions in results:
        assert_same_bits(sorted_keys.get()[:count], keys[order])
        assert_same_bits(positions.get()[:count], order.astype(np.uint32))


def scene(name: str) -> scenes.Scene:
    if name == "cloud":
        return scenes.random_cloud(900, 5, 150, 90)
    gaussians, camera = scenes.random_cloud(70, 6, 50, 40)
    if name == "hidden":
        gaussians.means[:, 2] = -10
    return gaussians, camera


def drawn(device: Device, name: str) -> tuple[Rasterizer, DeviceGaussians, ForwardPass]:
    """The rasterizer, the model and its frame with the exact number of pairs."""
    gaussians, camera = scene(name)
    rasterizer, held = Rasterizer(device), upload_gaussians(device, gaussians)
    return rasterizer, held, rasterizer.forward(held, camera, np.array([0.1, 0.2, 0.3], np.float32))


def by_capacity(
    rasterizer: Rasterizer, held: DeviceGaussians, exact: ForwardPass, pairs: int, *, appends: bool = True
) -> tuple[ForwardPass, dict[str, int]]:
    """A frame with room for so many pairs, and what its copy of the counts has."""
    frame = rasterizer.forward(held, exact.camera, exact.background, room=PairCapacity(pairs, 1, appends))
    by_append = appends and rasterizer.device.shape.items > 1
    assert (frame.listed.pairs is None) == by_append
    assert frame.listed.counted.arriving is not None
    arrived = frame.listed.counted.arriving()
    return frame, {name: int(arrived[READBACK.index(name)]) for name in NAMES}


def test_a_camera_is_sent_once_and_a_background_when_it_is_another(device: Device) -> None:
    rasterizer, first, other = Rasterizer(device), scene("few")[1], scene("cloud")[1]
    grey, red = np.full(3, 0.5, np.float32), np.array([1, 0, 0], np.float32)
    gc.collect()  # buffers of earlier tests
    writes, used = device.calls.writes, device.memory.used
    camera, background = rasterizer.keep(first, grey)
    rasterizer.keep(other, grey)
    assert rasterizer.keep(first, grey) == (camera, background)
    assert device.calls.writes == writes + 3
    assert_same_bits(camera.get(), pack_camera(first))
    assert_same_bits(background.get(), grey)
    assert rasterizer.keep(first, red) == (camera, background)
    assert device.calls.writes == writes + 4
    assert_same_bits(background.get(), red)
    del first, other, camera
    assert device.memory.used == used, "a camera's array goes with the camera"


@pytest.mark.parametrize("name", ["cloud", "few", "hidden"])
@pytest.mark.parametrize("spare", quick([0, 1, 3000], 1))
@pytest.mark.parametrize("appends", quick([True, False], True))
def test_a_pass_with_room_is_the_exact_one(shaped_device: Device, appends: bool, name: str, spare: int) -> None:
    _, _, exact = drawn(shaped_device, name)
    rasterizer, held, _ = drawn(shaped_device, "few")  # a workspace with something else in it
    held = upload_gaussians(shaped_device, scene(name)[0])
    count = exact.listed.counted.pairs
    assert (count == 0) == (name == "hidden")
    frame, counts = by_capacity(rasterizer, held, exact, max(count + spare, 1), appends=appends)
    assert (counts["VISIBLE"], counts["PAIRS"], counts["STOPPED"]) == (exact.listed.counted.visible, count, 0)
    assert_same_bits(frame.blended.image.get(), exact.blended.image.get())
    assert_same_bits(frame.listed.lists.ranges.get(), exact.listed.lists.ranges.get())
    assert_same_bits(frame.listed.lists.slot_from_sorted.get()[:count], exact.listed.lists.slot_from_sorted.get())
    gradient = upload(shaped_device, np.random.default_rng(1).normal(size=frame.blended.image.shape).astype(np.float32))
    slots = rasterizer.pair_gradients(frame, gradient).values.get()[:count]
    assert_same_bits(slots, Rasterizer(shaped_device).pair_gradients(exact, gradient).values.get())


@pytest.mark.slow
@pytest.mark.parametrize("cause", ["one pair too many", "a refused element", "an earlier stop"])
def test_a_pass_that_stops_changes_nothing(shaped_device: Device, cause: str) -> None:
    rasterizer, held, exact = drawn(shaped_device, "cloud")
    count, flags = exact.listed.counted.pairs, np.zeros(len(READBACK), np.uint32)
    if cause != "one pair too many":
        flags[READBACK.index("STOPPED" if cause == "an earlier stop" else "REFUSED_MOMENTS")] = 1
        rasterizer.readback.set(flags)
    frame, counts = by_capacity(rasterizer, held, exact, count - (cause == "one pair too many"))
    assert (counts["VISIBLE"], counts["PAIRS"], counts["STOPPED"]) == (0, 0, 1)
    assert not frame.listed.lists.ranges.get().any()
    assert not frame.projected.tile_counts.get().any()
    moments = [allocate_gaussians(shaped_device, held.count, held.coefficients, zero=True) for _ in range(2)]
    moments[0]["means"].fill(0.5)  # which alone would move what is not in view
    before = [model[group].get() for model in (held, *moments) for group in PARAMETER_GROUPS]
    gradient = upload(shaped_device, np.ones(frame.blended.image.shape, np.float32))
    slots, screen = rasterizer.pair_gradients(frame, gradient), rasterizer.screen(held.count, PLAIN_SLOTS)
    view = (ViewSlots(frame.camera_array, frame.projected, slots), screen, rasterizer.readback)
    project_step(shaped_device, AdamStep(OptimiserConfig(), 3, RATES), (held, *moments), *view)
    statistics = new_statistics(shaped_device, held.count)
    add_statistics(shaped_device, statistics, frame.camera, frame.projected, screen)
    after = [model[group].get() for model in (held, *moments) for group in PARAMETER_GROUPS]
    for one, other in zip(after, before, strict=True):
        assert_same_bits(one, other)
    assert not any(array.get().any() for array in statistics.named().values())
    exact_again = rasterizer.forward(held, exact.camera, exact.background)
    assert exact_again.listed.counted.pairs == count, "what is exact takes no notice"
