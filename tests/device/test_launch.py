# SPDX-License-Identifier: Apache-2.0
"""How kernels get their arguments, and what is said of groups that a driver does not allow."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from clsplat.device import cl, launch
from clsplat.device.buffers import allocate
from clsplat.device.context import Device
from clsplat.device.program import Kernel, Kernels, Variant, build
from clsplat.errors import DriverError

TEXT = """
__kernel void words(const uint a, const int b, const float c, const ulong d, __global uint *out) {
  out[0] = a; out[1] = (uint)b; out[2] = as_uint(c); out[3] = (uint)(d >> 32); out[4] = (uint)d;
}
"""


@pytest.fixture
def words(default_device: Device) -> Kernel:
    variant = Variant("words", TEXT, ("-cl-std=CL1.2",))
    program, _ = build(default_device.context, default_device.cl_device, variant)
    return Kernels(variant, program).words


def test_scalars_arrive_as_they_are(default_device: Device, words: Kernel) -> None:
    """The types are told at the first launch, and hold for what comes later, whatever its sign and size."""
    out = allocate(default_device, (5,), np.uint32)
    for a, b, c, d in (
        (1, 1, 0.5, 1),
        (2**32 - 1, -1, -0.1, 2**40 + 7),
        (True, -(2**31), 1e-45, 2**64 - 1),
        (0, 2**31 - 1, np.float32(3), 0),
    ):
        launch.launch_groups(default_device, words, 1, 1, a, b, c, np.uint64(d), out)
        bits = np.array([c], np.float32).view(np.uint32)[0]
        assert out.get().tolist() == [a, b % 2**32, bits, d >> 32, d % 2**32]


def test_no_reference_to_a_kernel_is_left_behind(words: Kernel) -> None:
    """Otherwise the driver would keep each program for ever, of which a run of all tests builds thousands."""
    assert words.cl_kernel.reference_count == 1


def test_types_are_told_once(default_device: Device, words: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """An untyped scalar takes OpenCL's wrapper ten microseconds, a typed one half of one."""
    out = allocate(default_device, (5,), np.uint32)
    arguments = (1, 2, 0.5, np.uint64(3), out)
    assert not words.tried
    launch.launch_groups(default_device, words, 1, 1, *arguments)
    assert words.tried
    monkeypatch.setattr(launch, "_first", lambda *_: pytest.fail("the types were told twice"))
    launch.launch_groups(default_device, words, 1, 1, *arguments)
    with pytest.raises((TypeError, RuntimeError)):  # what has no type is not told apart by its value
        launch.launch_groups(default_device, words, 1, 1, 1.5, *arguments[1:])


def test_a_group_that_the_driver_does_not_allow(
    default_device: Device, words: Kernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As drivers say of a kernel that takes many registers, which nobody knows before it is built."""
    monkeypatch.setattr(Kernel, "most_items", lambda *_: 32)
    monkeypatch.setattr(launch, "tells_group_sizes", lambda _: True)
    label = default_device.shape.label
    wanted = rf"shape {label}: words\.cl, words, has 64 items in a group, but the driver allows at most 32"
    with pytest.raises(DriverError, match=wanted):
        launch.launch_groups(default_device, words, 1, 64, 1, 2, 0.5, np.uint64(3), None)


@pytest.mark.parametrize(("reported", "built_for", "most"), [(256, [1024, 1, 1], 1024), (256, [0, 0, 0], 256)])
def test_a_kernel_may_have_the_group_that_it_was_built_for(
    words: Kernel, monkeypatch: pytest.MonkeyPatch, reported: int, built_for: list[int], most: int
) -> None:
    """NVIDIA's driver reports 256 for each kernel, also for one whose reqd_work_group_size is 1024."""
    info = cl.kernel_work_group_info
    told = {info.WORK_GROUP_SIZE: reported, info.COMPILE_WORK_GROUP_SIZE: built_for}
    monkeypatch.setattr(words, "cl_kernel", Mock(get_work_group_info=lambda which, _: told[which]))
    assert words.most_items(Mock()) == most


def test_a_limit_that_is_known_to_be_wrong(
    default_device: Device, words: Kernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rusticl says 32 of every kernel."""
    monkeypatch.setattr(Kernel, "most_items", lambda *_: 32)
    monkeypatch.setattr(launch, "tells_group_sizes", lambda _: False)
    out = allocate(default_device, (5,), np.uint32)
    launch.launch_groups(default_device, words, 1, 64, 1, 2, 0.5, np.uint64(3), out)
    assert out.get()[0] == 1


def test_a_launch_that_the_driver_refuses(default_device: Device, words: Kernel) -> None:
    most = default_device.max_group
    with pytest.raises(DriverError, match=r"words\.cl, words, (cannot be launched|has \d+ items in a group)"):
        launch.launch_groups(default_device, words, 1, 2 * most, 1, 2, 0.5, np.uint64(3), None)
