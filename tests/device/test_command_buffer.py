# SPDX-License-Identifier: Apache-2.0
"""Launches that are put on the queue a second time from a command buffer, and when they are not."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import numpy as np
import pyopencl as cl
import pytest
from calls import raising

from clsplat.device import command_buffer
from clsplat.device.buffers import DeviceArray, Workspace, allocate
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups, only_tried
from clsplat.device.program import Kernel, Kernels, Variant, build
from clsplat.errors import DriverError

TEXT = """
__kernel void words(const uint a, const int b, const float c, __global uint *out, __local uint *some) {
  some[0] = a;
  out[0] += some[0]; out[1] = (uint)b; out[2] = as_uint(c);
}
"""


class Owner:
    """An object with arrays of its own."""


@pytest.fixture
def words(device: Device) -> Kernel:
    variant = Variant("words", TEXT, ("-cl-std=CL1.2",))
    program, _ = build(device.context, device.cl_device, variant)
    return Kernels(variant, program).words


class Work:
    """A fill, two launches and a copy to the host, counted as often as Python makes them."""

    def __init__(self, device: Device, work: Workspace, kernel: Kernel) -> None:
        self.device, self.work, self.kernel, self.made = device, work, kernel, 0
        self.owner = Owner()

    def __call__(self) -> Callable[[], np.ndarray]:
        out, self.made = self.work.array("out", (3,), np.uint32), self.made + 1
        out.fill(1)
        for a in (1, 2**31):
            launch_groups(self.device, self.kernel, 1, 1, a, -7, -0.1, out, cl.LocalMemory(4))
        return out.begin_get()

    def replayed(self, key: str = "key") -> list[int]:
        return list(self.work.replayed(self.owner, (key,), self)())


@pytest.fixture
def made(device: Device, words: Kernel) -> Work:
    return Work(device, Workspace(device), words)


EXPECTED = [2**31 + 2, 2**32 - 7, int(np.array([-0.1], np.float32).view(np.uint32)[0])]


def test_the_second_time_has_the_same_bytes_and_counts(device: Device, made: Work) -> None:
    start = copy(device.calls)
    assert made.replayed() == EXPECTED
    recorded, start = device.calls.since(start), copy(device.calls)
    assert made.replayed() == EXPECTED
    assert made.made == 1
    assert device.calls.since(start) == recorded
    assert (recorded.launches, recorded.fills, recorded.reads) == (2, 1, 1)
    assert made.replayed("another") == EXPECTED
    assert made.made == 2


def test_arguments_are_those_of_the_tape(made: Work, words: Kernel) -> None:
    """A launch of the same kernel in between changes nothing."""
    made.replayed()
    other = allocate(made.device, (3,), np.uint32)
    launch_groups(made.device, words, 1, 1, 5, 6, 7.0, other, cl.LocalMemory(4))
    assert made.replayed() == EXPECTED
    assert made.made == 1


def test_numbers_that_are_given_anew(made: Work) -> None:
    """In order, and the command buffer's others are those that were recorded."""
    for number in (0.1, -0.1, 1e-45):
        values = [number, 2 * number]

        def make(values: list[float] = values) -> Callable[[], np.ndarray]:
            made.made += 1
            first, second = (made.work.array(name, (3,), np.uint32) for name in ("first", "second"))
            for out, value in zip((first, second), values, strict=True):
                out.fill(1)
                arguments = (1, -7, command_buffer.LaunchParameter(value), out, cl.LocalMemory(4))
                launch_groups(made.device, made.kernel, 1, 1, *arguments)
            one, other = first.begin_get(), second.begin_get()
            return lambda: np.stack([one(), other()])

        got = made.work.replayed(made.owner, ("numbers",), make, tuple(values))()
        assert got[:, :2].tolist() == [[2, 2**32 - 7]] * 2
        assert got[:, 2].tolist() == np.array(values, np.float32).view(np.uint32).tolist()
    assert made.made == 1


def test_only_numbers_that_have_changed_are_set(device: Device, words: Kernel) -> None:
    """Each costs a call of the driver. Numbers are compared by their bits, so that -0 replaces 0."""
    out, sets = allocate(device, (3,), np.uint32), []

    def make() -> None:
        for number in (0.5, 0.0):
            arguments = (1, -7, command_buffer.LaunchParameter(number), out, cl.LocalMemory(4))
            launch_groups(device, words, 1, 1, *arguments)

    _, commands = device.record(make)
    assert commands is not None
    setters = enumerate(commands.setters)
    commands.setters = [(lambda _, value, at=at: sets.append((at, value)), index) for at, (_, index) in setters]
    for numbers, expected in (((0.5, 0.0), []), ((0.5, -0.0), [1]), ((0.25, -0.0), [0]), ((0.5, 0.0), [0, 1])):
        sets.clear()
        commands.set(numbers)
        assert sets == [(place, np.float32(numbers[place]).tobytes()) for place in expected]


def test_arrays_that_are_given_anew(made: Work) -> None:
    """They take the place of the array that was recorded, in each of its launches, and no other array's."""
    kept, kernel = made.work.array("kept", (3,), np.uint32), made.kernel
    kept.fill(0)
    for number in range(3):
        given = allocate(made.device, (3,), np.uint32)
        given.fill(number)

        def make(given: DeviceArray = given) -> None:
            made.made += 1
            for array in (given, kept, given):
                launch_groups(made.device, kernel, 1, 1, 10, -7, 0.5, array, cl.LocalMemory(4))

        made.work.replayed(made.owner, ("given",), make, given=(given,))
        assert given.get()[0] == number + 20
        assert kept.get()[0] == 10 * (number + 1)
    assert made.made == 1


def test_a_given_array_in_another_place_is_noticed(made: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(command_buffer.TAPES_VARIABLE, command_buffer.CHECK_TAPES)
    work = Workspace(made.device)
    one, other = (allocate(made.device, (3,), np.uint32) for _ in range(2))

    def launched(array: DeviceArray, given: DeviceArray) -> None:
        def make() -> None:
            launch_groups(made.device, made.kernel, 1, 1, 10, -7, 0.5, array, cl.LocalMemory(4))

        work.replayed(made.owner, ("given",), make, given=(given,))

    launched(one, one)
    launched(other, other)
    with pytest.raises(AssertionError, match=r"words: a replay would pass wrong values of .* with index \[3\]"):
        launched(one, other)


def test_a_tape_goes_with_a_buffer(made: Work) -> None:
    made.replayed()
    used = made.device.memory.used
    made.work.array("out", (300,), np.uint32)
    assert made.device.memory.used >= used + 4 * 297  # and no more than that: the command buffer keeps none alive
    assert made.device.memory.used <= used + 4 * 600
    assert [made.replayed(), made.replayed(), made.made] == [EXPECTED, EXPECTED, 2]
    made.work.clear()
    assert [made.replayed(), made.replayed(), made.made] == [EXPECTED, EXPECTED, 3]


def test_a_tape_goes_with_its_owner(made: Work) -> None:
    for owner in range(3):
        made.owner = Owner()
        assert made.replayed() == EXPECTED
        assert made.made == owner + 1


def test_a_buffer_that_grows_meanwhile(made: Work) -> None:
    """The launches before it are of one that is no more."""

    def grows() -> Callable[[], np.ndarray]:
        made.work.array("out", (2,), np.uint32)
        return made()

    for _ in range(2):
        made.work.clear()
        assert list(made.work.replayed(made.owner, ("grows",), grows)()) == EXPECTED
    assert list(made.work.replayed(made.owner, ("grows",), grows)()) == EXPECTED
    assert made.made == 3


@pytest.mark.parametrize("what", ["write", "blocking write", "blocking read"])
def test_what_is_not_on_a_tape(made: Work, what: str) -> None:
    values = np.arange(3, dtype=np.uint32)

    def make() -> None:
        out = made.work.array("out", (3,), np.uint32)
        made()
        {"write": lambda: out.send(values), "blocking write": lambda: out.set(values), "blocking read": out.get}[what]()

    for _ in range(3):
        made.work.replayed(made.owner, ("key",), make)
    made.device.finish()
    assert made.made == 3


@pytest.mark.parametrize("how", ["poison", "wait", "record", "try"])
def test_where_each_launch_is_wanted(made: Work, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    if how == "poison":
        monkeypatch.setenv("CLSPLAT_POISON", "1")
        made.work = Workspace(made.device)
    for _ in range(2):
        made.replayed()
    before = made.made
    if how == "wait":
        monkeypatch.setattr(made.device, "waits", True)
    if how == "record":
        with made.device.recorder.recording(wait=False) as stages:
            made.replayed()
        assert sum(stage.launches for stage in stages.values()) == 4
    elif how == "try":
        with only_tried(made.device):
            made.work.replayed(made.owner, ("key",), made)()
    else:
        made.replayed()
    assert made.made == before + 1


def test_a_launch_that_fails_is_named(made: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    made.replayed()
    monkeypatch.setattr(command_buffer.cl, "enqueue_nd_range_kernel", raising(cl.RuntimeError("OUT_OF_RESOURCES")))
    assert made.replayed("another key") == EXPECTED  # kernels are called there
    with pytest.raises(DriverError, match=r"words\.cl, words, cannot be launched: .*OUT_OF_RESOURCES"):
        made.replayed("another key")
    assert not made.device.command_buffers
