# SPDX-License-Identifier: Apache-2.0
"""Measure the limits of a device one by one with small kernels: memory, groups, launches, latencies, atomics.

Each function of MEASURED returns figures by name, as in the rows of docs/gpus/calibration.json, from which the model's
constants follow. Times are the device's own, from events, except for launches.
"""

from __future__ import annotations

import ctypes
import importlib
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from clsplat.device.context import Device
from clsplat.device.drivers.capabilities import capabilities_of

SOURCE = Path(__file__).with_suffix(".cl")
REPEATS = 7
"""Number of timed runs of each kernel, whose median is used."""
LINE = 128
"""Number of bytes between two elements of the pointer chase, so that each cache line has one."""
ABREAST = 8
"""Number of independent multiply-adds in a step of an item."""
RECIPROCALS = 1 << 23
"""Number of floats in [1, 2)."""


@dataclass(frozen=True)
class Sizes:
    """Amounts of work.

    copied: number of copied bytes.
    groups, launches: number of empty groups, and of empty launches.
    steps: number of steps in loops that measure a latency.
    chased: sizes of the pointer chases in KiB.
    counted: number of atomic increments of global counters.
    items: number of work-items for multiply-adds.
    """

    copied: int
    groups: int
    launches: int
    steps: int
    chased: tuple[int, ...]
    counted: int
    items: int


FULL = Sizes(1 << 28, 1 << 20, 1000, 20_000, (64, 4096, 262_144), 3_400_000, 1 << 19)
TINY = Sizes(1 << 20, 1 << 10, 50, 200, (64, 256), 10_000, 1 << 8)
"""Amounts for a dry run."""


class Limits:
    """A device under measurement, with a queue that times kernels."""

    def __init__(self, device: Device, sizes: Sizes) -> None:
        self.device, self.sizes = device, sizes
        self.context, self.cl_device = device.context, device.cl_device
        self.queue = cl.CommandQueue(self.context, self.cl_device, cl.command_queue_properties.PROFILING_ENABLE)
        self._exact = capabilities_of(self.cl_device).exact_division
        self._kept: list[Any] = []

    @cache  # noqa: B019  # one object per trial
    def _program(self, wide: int) -> cl.Program:
        exact = ["-cl-fp32-correctly-rounded-divide-sqrt"] if self._exact else []
        return cl.Program(self.context, SOURCE.read_text("utf-8")).build(options=[f"-DWIDE={wide}", *exact])

    def kernel(self, name: str, *arguments: Any, wide: int = 1) -> cl.Kernel:
        """A kernel with its arguments, which are kept until `free`, because a kernel does not keep its buffers alive.

        wide: the define WIDE of the kernel `copy`.
        """
        kernel = cl.Kernel(self._program(wide), name)
        kernel.set_args(*arguments)
        self._kept += arguments
        return kernel

    def buffer(self, nbytes: int) -> cl.Buffer:
        """A buffer of zeros."""
        buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, nbytes)
        cl.enqueue_fill_buffer(self.queue, buffer, np.uint32(0), 0, nbytes)
        return buffer

    def upload(self, values: np.ndarray) -> cl.Buffer:
        """A buffer with these values."""
        buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, values.nbytes)
        cl.enqueue_copy(self.queue, buffer, values)
        return buffer

    def ns(self, kernel: cl.Kernel, items: int, local: int) -> float:
        """Median nanoseconds of a launch."""
        events = []
        for _ in range(REPEATS + 1):
            events.append(cl.enqueue_nd_range_kernel(self.queue, kernel, (items,), (local,)))
            events[-1].wait()
        return max(float(statistics.median(each.profile.end - each.profile.start for each in events[1:])), 1.0)

    def free(self) -> None:
        """Free all buffers."""
        self.queue.finish()
        self._kept.clear()

    @property
    def group_sizes(self) -> Iterator[int]:
        """The group sizes of 64, 256 and 1024 that the device supports."""
        return (items for items in (64, 256, 1024) if items <= self.cl_device.max_work_group_size)


def clocks(on: Limits) -> dict[str, float]:
    """Figures of the device that its driver reports."""
    device = on.cl_device
    return {
        "units": device.max_compute_units,
        "clock": device.max_clock_frequency,
        "local_mem": device.local_mem_size,
        "global_mem": device.global_mem_size,
    }


def copies(on: Limits) -> dict[str, float]:
    """Bandwidth of copies in GB/s, read and written bytes together."""
    nbytes = on.sizes.copied
    source, copy = on.buffer(nbytes), on.buffer(nbytes)
    found = {}
    for items in on.group_sizes:
        for wide in (1, 2, 4):
            kernel = on.kernel("copy", source, copy, wide=wide)
            found[f"copy float4 x{wide}, {items}"] = 2 * nbytes / on.ns(kernel, nbytes // 16 // wide, items)
        found[f"copy float, {items}"] = 2 * nbytes / on.ns(on.kernel("copy_floats", source, copy), nbytes // 4, items)
    return found


def groups(on: Limits) -> dict[str, float]:
    """Number of empty groups per second, in 10^9."""
    kernel, count = on.kernel("nothing", on.buffer(4)), on.sizes.groups
    sizes = (items for items in (32, 64, 128, 256) if items <= on.cl_device.max_work_group_size)
    return {f"groups G/s, {items}": count / on.ns(kernel, count * items, items) for items in sizes}


def loader() -> ctypes.CDLL:
    """OpenCL's loader, by way of pyopencl's library, for calls without an event."""
    return ctypes.CDLL(importlib.import_module("pyopencl._cl").__file__)  # finds symbols of its dependencies too


def launches(on: Limits) -> dict[str, float]:
    """Microseconds per empty launch, on the host alone (`host`), and until the device has finished (`wall`)."""
    kernel, count = on.kernel("nothing", on.buffer(4)), on.sizes.launches
    plain = cl.CommandQueue(on.context, on.cl_device)
    enqueue, size = loader().clEnqueueNDRangeKernel, (ctypes.c_size_t * 1)(64)

    def without_event() -> None:
        pointers = (ctypes.c_void_p(plain.int_ptr), ctypes.c_void_p(kernel.int_ptr))
        status = enqueue(*pointers, 1, None, size, size, 0, None, None)
        if status:
            raise cl.RuntimeError(f"clEnqueueNDRangeKernel: returned status {status}, expected 0")

    ways: Mapping[str, tuple[cl.CommandQueue, Callable[[], object]]] = {
        "profiled": (on.queue, lambda: cl.enqueue_nd_range_kernel(on.queue, kernel, (64,), (64,))),
        "args kept": (plain, lambda: cl.enqueue_nd_range_kernel(plain, kernel, (64,), (64,))),
        "ctypes no event": (plain, without_event),
    }
    found = {}
    for name, (queue, launch) in ways.items():
        for _ in range(2):  # the first round is a warm-up
            queue.finish()
            start = time.perf_counter()
            for _ in range(count):
                launch()
            host = time.perf_counter() - start
            queue.finish()
            wall = time.perf_counter() - start
        found[f"launch us host, {name}"], found[f"launch us wall, {name}"] = 1e6 * host / count, 1e6 * wall / count
    return found


def latencies(on: Limits) -> dict[str, float]:
    """Nanoseconds of a load that waits for the load before it, by the size of the memory that is read."""
    steps, found = on.sizes.steps, {}
    for kib in on.sizes.chased:
        lines = kib * 1024 // LINE
        order = np.random.default_rng(0).permutation(lines).astype(np.uint32) * (LINE // 4)
        chain = np.zeros(lines * (LINE // 4), np.uint32)
        chain[order] = np.roll(order, -1)
        kernel = on.kernel("chase", np.uint32(steps), on.upload(chain), on.buffer(4))
        found[f"chase ns, {kib} KiB"] = on.ns(kernel, 1, 1) / steps
    return found


def barriers(on: Limits) -> dict[str, float]:
    """Nanoseconds of a barrier in a single group, by group size."""
    steps = on.sizes.steps
    kernel = on.kernel("barriers", np.uint32(steps), on.buffer(4))
    return {f"barrier ns, {items}": on.ns(kernel, items, items) / steps for items in on.group_sizes}


def atomics(on: Limits) -> dict[str, float]:
    """Times of atomic increments: nanoseconds of a round of a group's items in local memory, milliseconds of all
    increments in global memory."""
    steps, counted = on.sizes.steps, on.sizes.counted // 64 * 64
    kernel = on.kernel("local_atomics", np.uint32(steps), on.buffer(4))
    found = {"local atomic ns a round of 64": on.ns(kernel, 64, 64) / steps}
    for many in (6700, 1450):  # numbers of tiles of the synthetic scene and of fox
        kernel = on.kernel("global_atomics", np.uint32(many), on.buffer(4 * many))
        found[f"{counted / 1e6:.2g} M atomic_inc on {many}, ms"] = 1e-6 * on.ns(kernel, counted, 64)
    return found


def multiply_adds(on: Limits) -> dict[str, float]:
    """Number of fused multiply-adds per second, in 10^12."""
    steps, items = on.sizes.steps // 10, on.sizes.items
    kernel = on.kernel("multiply_adds", np.uint32(steps), on.buffer(4 * items))
    return {"Tfma/s": 1e-3 * ABREAST * steps * items / on.ns(kernel, items, 64)}


def reciprocals(on: Limits) -> dict[str, float]:
    """Accuracy of native_recip over all mantissas.

    Returns the number of wrong results, the largest error in ulp, and the number of results that are still wrong after
    two steps of Newton's method.
    """
    counters = on.buffer(12)
    kernel = on.kernel("reciprocals", counters)
    cl.enqueue_nd_range_kernel(on.queue, kernel, (RECIPROCALS,), (64,))
    counts = np.zeros(3, np.uint32)
    cl.enqueue_copy(on.queue, counts, counters)
    names = ("native_recip wrong", "native_recip ulp", "native_recip wrong after two steps")
    return dict(zip(names, map(int, counts), strict=True))


MEASURED: tuple[Callable[[Limits], dict[str, float]], ...] = (
    *(clocks, copies, groups, launches, latencies, barriers, atomics, multiply_adds, reciprocals),
)
