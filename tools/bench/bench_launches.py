#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measure the host's microseconds for a step's launches, with an empty kernel and different ways of launching.

    python tools/bench/bench_launches.py [--device DEVICE] [--repeat 41] [--json]

The ways are: pyopencl, which makes an event for each launch; ctypes, without events; and, if the driver has
cl_khr_command_buffer, a command buffer of the driver, which may be on the queue several times at once. If the driver
aborts, this process ends too. As in bench_host.py, the queue waits for a user event meanwhile, and the thread's CPU
time is measured.
"""

from __future__ import annotations

import ctypes
import importlib
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl
from measuring import Result, machine, options_parser, parsed, show, tool

from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.progress import aligned

LAUNCHES = 11
"""Number of launches of a training step by capacity, on devices where kernels run in groups."""
ROUNDS = 8
"""Number of successive steps, over which the time is averaged."""
ITEMS = 64
TEXT = "__kernel void nothing(__global int *x, int n) { if (n == 77) x[0] = 1; }"
FLAGS_KEY, SIMULTANEOUS_USE = 0x1293, 1
"""CL_COMMAND_BUFFER_FLAGS_KHR and CL_COMMAND_BUFFER_SIMULTANEOUS_USE_KHR."""
POINTER, COUNT, STATUS = ctypes.c_void_p, ctypes.c_uint, ctypes.c_int

Launch = Callable[[], object]


def checked(status: int, call: str) -> None:
    """Raise pyopencl's RuntimeError if an OpenCL call has returned an error status."""
    if status:
        raise cl.RuntimeError(f"{call}: returned status {status}, expected 0")


class Driver:
    """OpenCL's functions from the library that pyopencl has loaded, for calls that pyopencl does not support."""

    def __init__(self, device: Device) -> None:
        self._library = ctypes.CDLL(importlib.import_module("pyopencl._cl").__file__)
        self._platform = device.cl_device.platform.int_ptr
        self.launch = self._library.clEnqueueNDRangeKernel
        self.launch.argtypes = [POINTER, POINTER, COUNT, *[POINTER] * 3, COUNT, POINTER, POINTER]

    def extension(self, name: str, *types: Any) -> Callable[..., Any]:
        """A function of an OpenCL extension, by its name. types: its result's type, then its arguments' types."""
        find = self._library.clGetExtensionFunctionAddressForPlatform
        find.restype, find.argtypes = POINTER, [POINTER, ctypes.c_char_p]
        address = find(self._platform, name.encode())
        if not address:
            raise cl.RuntimeError(f"{name}: the driver has the extension without this function")
        return ctypes.CFUNCTYPE(*types)(address)

    def command_buffer(self, queue: cl.CommandQueue, kernels: Sequence[cl.Kernel]) -> Launch:
        """A function that puts a command buffer of these kernels on the queue."""
        create = self.extension("clCreateCommandBufferKHR", POINTER, COUNT, POINTER, POINTER, POINTER)
        add = self.extension(
            "clCommandNDRangeKernelKHR", STATUS, *[POINTER] * 4, COUNT, *[POINTER] * 3, COUNT, *[POINTER] * 3
        )
        finalise = self.extension("clFinalizeCommandBufferKHR", STATUS, POINTER)
        enqueue = self.extension("clEnqueueCommandBufferKHR", STATUS, COUNT, POINTER, POINTER, COUNT, POINTER, POINTER)
        status, size = STATUS(), (ctypes.c_size_t * 1)(ITEMS)
        properties = (ctypes.c_uint64 * 3)(FLAGS_KEY, SIMULTANEOUS_USE, 0)
        made = create(1, (POINTER * 1)(queue.int_ptr), properties, ctypes.byref(status))
        checked(status.value, "clCreateCommandBufferKHR")
        for kernel in kernels:
            checked(
                add(made, None, None, kernel.int_ptr, 1, None, size, size, 0, None, None, None),
                "clCommandNDRangeKernelKHR",
            )
        checked(finalise(made), "clFinalizeCommandBufferKHR")
        return lambda: checked(enqueue(0, None, made, 0, None, None), "clEnqueueCommandBufferKHR")


def ways(device: Device, kernels: Sequence[cl.Kernel]) -> dict[str, Launch]:
    """Functions that launch all kernels, keyed by the name of the way of launching."""
    driver, queue, size = Driver(device), device.queue, (ctypes.c_size_t * 1)(ITEMS)
    with_event = [partial(cl.enqueue_nd_range_kernel, queue, kernel, (ITEMS,), (ITEMS,)) for kernel in kernels]
    handles = [(POINTER(queue.int_ptr), POINTER(kernel.int_ptr)) for kernel in kernels]
    without = [partial(driver.launch, *each, 1, None, size, size, 0, None, None) for each in handles]

    def by_pyopencl() -> None:
        for launch in with_event:
            launch()

    def by_ctypes() -> None:
        for launch in without:
            checked(launch(), "clEnqueueNDRangeKernel")

    found: dict[str, Launch] = {"pyopencl, with events": by_pyopencl, "ctypes, without": by_ctypes}
    if "cl_khr_command_buffer" in device.cl_device.extensions.split():
        found["command buffer"] = driver.command_buffer(queue, kernels)
    return found


def held(device: Device, work: Launch) -> float:
    """Microseconds of this thread in a call of `work`, as the mean of ROUNDS calls. Kernels run only afterwards."""
    device.finish()
    gate = cl.UserEvent(device.context)
    cl.enqueue_barrier(device.queue, wait_for=[gate])
    start = time.thread_time_ns()
    try:
        for _ in range(ROUNDS):
            work()
        return 1e-3 * (time.thread_time_ns() - start) / ROUNDS
    finally:
        gate.set_status(cl.command_execution_status.COMPLETE)
        device.finish()


def measure(device: Device, repeat: int) -> Result:
    """Median and least microseconds of LAUNCHES launches, for each way."""
    program = cl.Program(device.context, TEXT).build()
    buffer = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 64)
    kernels = []
    for number in range(LAUNCHES):
        kernels.append(cl.Kernel(program, "nothing"))
        kernels[-1].set_args(buffer, np.int32(number))
    launched = ways(device, kernels)
    times: dict[str, list[float]] = {name: [] for name in launched}
    for _ in range(repeat):
        for name, launch in launched.items():
            times[name].append(held(device, launch))
    rows = {name: {"us": statistics.median(each), "least_us": min(each)} for name, each in times.items()}
    return {**machine(device, repeat), "launches": LAUNCHES, "ways": rows}


@tool("bench_launches")
def main(arguments: Sequence[str]) -> int:
    """Run the measurement and print its results."""
    options = parsed(options_parser(__doc__, 41, plot=False), arguments)
    result = measure(open_device(options.device), options.repeat)
    rows = [(name, f"{row['us']:.1f}", f"{row['least_us']:.1f}") for name, row in result["ways"].items()]
    lines = [f"{LAUNCHES} launches", "", *aligned([("way", "us", "least us"), *rows])]
    show(result, lines, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
