# SPDX-License-Identifier: Apache-2.0
"""density.cl: rows are moved to the bit, and gradients in NDC do not depend on the resolution."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from pipeline import Pipeline

from clsplat.chunks.gathering import row_entries
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.stages.density import add_statistics, gather, new_statistics, widen
from clsplat.stages.device_gaussians import DeviceGaussians, to_host
from clsplat.stages.project import Screen

SIZES = (1, 2, 63, 64, 65, 127, 129, 1025)
"""A launch is rounded up to groups of 64."""


def numbered(device: Device, count: int, coefficients: int) -> tuple[DeviceGaussians, dict[str, np.ndarray]]:
    """Arrays in which every element has its own value; on the device and on the host."""
    rng = np.random.default_rng(count)
    host = {
        name: rng.permutation(int(np.prod(shape))).astype(np.float32).reshape(shape) + 1
        for name, shape in group_shapes(count, coefficients).items()
    }
    arrays = {name: upload(device, values) for name, values in host.items()}
    return DeviceGaussians(count, coefficients, arrays), host


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("coefficients", [1, 4, 16])
def test_gather_takes_rows_and_zeros(device: Device, count: int, coefficients: int) -> None:
    source, host = numbered(device, count, coefficients)
    rng = np.random.default_rng(1)
    for length in (1, count, 2 * count + 1):
        rows = rng.integers(0, count, length).astype(np.uint32)
        rows[-1] = count - 1
        fresh = np.arange(length) % 3 == 0
        listed = row_entries(rows, fresh)
        for renews in (False, True):
            got = gather(device, upload(device, listed), source, renews=renews)
            on_host = gather(device, listed, to_host(source), renews=renews)
            assert (got.count, got.coefficients) == (length, coefficients)
            for name in PARAMETER_GROUPS:
                wanted = host[name][rows]
                wanted[fresh & renews] = 0
                np.testing.assert_array_equal(got[name].get(), wanted, err_msg=name)
                np.testing.assert_array_equal(on_host[name].get(), wanted, err_msg=f"{name} on the host")
    for name in PARAMETER_GROUPS:
        np.testing.assert_array_equal(source[name].get(), host[name], err_msg=f"{name} of the source")


@pytest.mark.parametrize("count", SIZES)
def test_any_rows_are_read_and_written(device: Device, count: int) -> None:
    host = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    array = upload(device, host)
    for start in {0, 1, count // 2, count}:
        assert_same_bits(array.get_rows(start, count), host[start:])
        array.set_rows(start, -host[start:])
        host[start:] *= -1
        assert_same_bits(array.get(), host)


@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 9), (1, 16), (9, 16)])
def test_widen_keeps_values_and_adds_zeros(device: Device, before: int, after: int) -> None:
    source, host = numbered(device, 65, before)
    got = widen(device, source, after)
    assert (got.count, got.coefficients) == (65, after)
    rest = got["sh_rest"].get()
    assert rest.shape == (65, after - 1, 3)
    np.testing.assert_array_equal(rest[:, : before - 1], host["sh_rest"])
    assert not rest[:, before - 1 :].any()
    for name in list(PARAMETER_GROUPS)[:-1]:
        np.testing.assert_array_equal(got[name].get(), host[name], err_msg=name)


def test_gradients_in_ndc_do_not_depend_on_the_resolution(device: Device) -> None:
    """Twice the pixels: half the gradient a pixel of the mean's move, the same in NDC, as the threshold wants it."""
    gaussians, camera = scenes.one(96, 64)
    sums = []
    for view in (camera, camera.resized(48, 32)):
        run = Pipeline.run(device, (gaussians, view))
        pixels = view.width * view.height
        _, screen = run.backward(np.tile(np.linspace(0, 1, view.width)[None, :, None], (view.height, 1, 3)) / pixels)
        statistics = new_statistics(device, 1)
        add_statistics(device, statistics, view, run.frame.projected, Screen(upload(device, screen)))
        sums.append(float(statistics.gradient_sums.get()[0]))
    # the low-pass of 0.3 square pixels and the pixel grid weigh more at half the size
    assert sums[0] > 0
    assert sums[1] == pytest.approx(sums[0], rel=0.1)
