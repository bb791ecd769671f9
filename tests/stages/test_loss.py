# SPDX-License-Identifier: Apache-2.0
"""loss.cl and target.cl against the float64 twin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from compare import assert_close, assert_same_bits
from pipeline import shaped

from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.drivers.driver_records import BREAK_KERNEL_VARIABLE
from clsplat.errors import KernelBuildError
from clsplat.images.reading import read_image
from clsplat.layouts.columns import LOSS_GROUP_ROWS
from clsplat.reference.loss import l1_dssim
from clsplat.selftest.case import Inputs, faults
from clsplat.selftest.cases.loss import LOSS_CASE
from clsplat.selftest.harness import planes_of
from clsplat.stages.blend import tile_items
from clsplat.stages.loss import loss, scratch_bytes
from clsplat.stages.target import target

REACH = 5
"""Pixels from the middle of a window to its edge."""


def test_dssim_alone(shaped_device: Device) -> None:
    rng = np.random.default_rng(17)
    x = rng.random((33, 17, 3)).astype(np.float32)
    y = np.clip(x + rng.normal(0, 0.2, x.shape), 0, 1).astype(np.float32)
    errors = LOSS_CASE.errors(shaped_device, Inputs(image=x, photograph=y, weight=1.0))
    # variances are differences of windowed moments in float32: 1e-7 against C2 = 9e-4
    assert errors["gradient"].error < 1e-4 and errors["loss"].error < 1e-5


def with_block_rows(device: Device, monkeypatch: pytest.MonkeyPatch, rows: int) -> Device:
    """The device in groups of 64 items, with blocks of so many rows; it builds kernels of its own."""
    change = f"loss: #define LOSS_GROUP_ROWS {LOSS_GROUP_ROWS} => #define LOSS_GROUP_ROWS {rows}"
    monkeypatch.setenv(BREAK_KERNEL_VARIABLE, change)
    monkeypatch.setattr("clsplat.stages.loss.LOSS_GROUP_ROWS", rows)
    return device.with_shape(lanes=1, items=64)


@pytest.mark.parametrize(("rows", "why"), [(REACH - 1, "must be at least REACH"), (8, "at least its runs")])
def test_blocks_that_would_be_wrong_do_not_build(
    default_device: Device, monkeypatch: pytest.MonkeyPatch, rows: int, why: str
) -> None:
    device = with_block_rows(default_device, monkeypatch, rows)
    with pytest.raises(KernelBuildError) as raised:
        device.kernels("loss", {"ITEMS": 64})
    assert why in raised.value.log


@pytest.mark.slow
def test_the_fewest_rows_of_a_block(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device = with_block_rows(default_device, monkeypatch, REACH)
    for size in LOSS_CASE.sizes[:4]:
        assert faults(LOSS_CASE.errors(device, LOSS_CASE.random(np.random.default_rng(0), size))) == []


def test_equal_images_have_no_loss(shaped_device: Device) -> None:
    x = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    array = upload(shaped_device, planes_of(x))
    value, squared = loss(shaped_device, Workspace(shaped_device), array, array, (30, 20), 0.2).read()
    assert abs(value) < 1e-6
    assert squared == 0


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_target_composites_alpha(device: Device, channels: int, dtype: type) -> None:
    rng = np.random.default_rng(channels)
    levels = rng.integers(0, 256, (19, 37, channels))
    image = levels.astype(np.uint8) if dtype is np.uint8 else (levels * np.float32(1 / 255)).astype(np.float32)
    background = np.array([0.2, 0.5, 0.9], np.float32)
    planes = target(device, Workspace(device), image, upload(device, background)).get()
    values = levels / 255
    wanted = values[:, :, :3]
    if channels == 4:
        wanted = wanted * values[:, :, 3:] + background * (1 - values[:, :, 3:])
    assert_close(planes, planes_of(wanted), absolute=2e-7)


def test_bytes_are_the_floats_of_a_photograph_that_was_read(device: Device, tmp_path: Path) -> None:
    """So a photograph can stay on the device in a quarter of the memory, and training keeps its bits."""
    columns = [np.roll(np.arange(256, dtype=np.uint8), shift) for shift in (0, 85, 170, 31)]
    levels = np.stack(columns, axis=1).reshape(16, 16, 4)  # every level in every channel
    file = oiio.ImageOutput.create(str(path := tmp_path / "levels.png"))
    assert file.open(str(path), oiio.ImageSpec(16, 16, 3, "uint8"))
    assert file.write_image(np.ascontiguousarray(levels[:, :, :3]))
    file.close()
    read = read_image(path)
    background = upload(device, np.array([0.2, 0.5, 0.9], np.float32))
    wanted = target(device, Workspace(device), read, background).get()
    assert_same_bits(target(device, Workspace(device), levels[:, :, :3], background).get(), wanted)
    floats = levels * np.float32(1 / 255)
    wanted = target(device, Workspace(device), floats, background).get()
    assert_same_bits(target(device, Workspace(device), levels, background).get(), wanted)


def noise(device: Device, width: int, height: int) -> list[DeviceArray]:
    return [
        upload(device, planes_of(image)) for image in np.random.default_rng(0).random((2, height, width, 3), np.float32)
    ]


@pytest.mark.parametrize("size", [(50, 135), (1100, 40), (1024, 12)], ids=str)
def test_however_many_blocks_it_has_the_same_bits(shaped_device: Device, size: tuple[int, int]) -> None:
    """Against one lane and few blocks, or few items: what is worked out for two of them is the same in both."""
    width, height = size
    held, items = [], min(tile_items(shaped_device), 16)
    for device in (shaped_device.with_shape(lanes=1, items=items, chunks=1), shaped_device.with_shape(chunks=64)):
        result = loss(device, Workspace(device), *noise(device, width, height), size, 0.2)
        held.append((result.gradient.get()[:, :height], result.read()))
    assert_same_bits(held[1][0], held[0][0])
    # sums of at most 1100 terms of up to 1 in float32, in another order
    assert_close(held[1][1], held[0][1], relative=1e-5)


def test_launches_and_memory(shaped_device: Device) -> None:
    device = shaped_device.with_memory_limit(2**30)  # with an account of its own
    pictures = noise(shaped_device, 70, 100)
    with device.recorder.recording(wait=False) as stages:
        result = loss(device, Workspace(device), *pictures, (70, 100), 0.2)
    assert stages["loss"].launches == (1 if tile_items(device) == 1 else 2)
    assert device.memory.peak == scratch_bytes(device, 100, 80) + result.gradient.nbytes


@pytest.mark.slow
@pytest.mark.parametrize("width", range(1, 66))
def test_every_width_up_to_two_blocks(default_device: Device, width: int) -> None:
    """In a shape of several items, of as many rows as columns and of one row."""
    device = shaped(default_device, 1, 64)
    for height in (1, width):
        given = LOSS_CASE.random(np.random.default_rng(width), (width, height))
        assert faults(LOSS_CASE.errors(device, given)) == []


@pytest.mark.parametrize(("brightness", "ripple"), [(0.95, 0.01), (10.0, 0.01), (100.0, 0.1)])
def test_bright_flat_pictures_keep_their_digits(shaped_device: Device, brightness: float, ripple: float) -> None:
    """Where E[x^2] - E[x]^2 cancels: at 0.95 the loss was off by 1e-4 of itself, at 10 by a tenth, at 100 nothing was
    right."""
    width, height = 61, 45
    rows, columns = np.mgrid[:height, :width]
    waves = [np.sin(0.7 * columns + phase) * np.cos(rows) for phase in (0.0, 0.5)]
    x, y = (np.repeat((brightness + ripple * wave)[:, :, None], 3, axis=2).astype(np.float32) for wave in waves)
    work, arrays = Workspace(shaped_device), [upload(shaped_device, planes_of(image)) for image in (x, y)]
    result = loss(shaped_device, work, *arrays, (width, height), 0.2)
    value, gradient = l1_dssim(x.astype(np.float64), y.astype(np.float64), 0.2)
    assert_close(result.read()[0], value, relative=1e-5)
    got = result.gradient.get()[:, :height, :width].transpose(1, 2, 0)
    assert np.linalg.norm(got - gradient) < 1e-4 * np.linalg.norm(gradient)
