# SPDX-License-Identifier: Apache-2.0
"""The list of visible OpenCL devices, and `Device`: an open device with its queue, kernel shape and kernels."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, TypeVar

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsplat.device.command_buffer import CommandBuffer
from clsplat.device.drivers import forks
from clsplat.device.drivers.capabilities import capabilities_of
from clsplat.device.drivers.cpu_name import name_processor
from clsplat.device.drivers.driver_records import tell_once
from clsplat.device.drivers.quirks import compiles_by_size, register_limit, subgroup_ways, title
from clsplat.device.drivers.shapes import Shape, shape_of
from clsplat.device.drivers.worker_process import DRIVER_TIMEOUT_VARIABLE, driver_timeout
from clsplat.device.memory_account import Memory
from clsplat.device.profile import Calls, Recorder
from clsplat.device.program import Kernel, Kernels, build, text_of, variant_of
from clsplat.device.sandbox import KernelTrials
from clsplat.device.source import kernel_source
from clsplat.errors import CapacityError, ClsplatError, DeviceError, DriverError, KernelBuildError, amount, switched_on
from clsplat.process import undisturbed

T = TypeVar("T")

SYNC_VARIABLE = "CLSPLAT_SYNC"
"""Environment variable that makes each launch wait for its kernel, so that an error message names the kernel that hangs
or fails."""


def all_devices() -> list[cl.Device]:
    """Return all visible OpenCL devices in order of their index. Raises DeviceError in a forked process (`forks`)."""
    forks.claim()
    with undisturbed():  # keeps Ctrl-C from compilers and linkers that the driver starts
        devices = _visible()
    for device in devices:
        name_processor(device)
    return devices


def _visible() -> list[cl.Device]:
    try:
        platforms = cl.get_platforms()
    except cl.Error:
        return []
    devices: list[cl.Device] = []
    for platform in platforms:
        try:
            devices += platform.get_devices()
        except cl.Error:
            continue
    return devices


class Device:
    """A device with its context, in-order queue, kernel shape and built kernels.

    why: warning that the preferred shape failed and another is used, shown at the first use of the device; usually "".
    only_tries: True while kernels run in the sandbox only, not on this device (`launch.only_tried`).
    waits: True if the host waits for each kernel (SYNC_VARIABLE).
    shares_memory: True for CPUs, whose kernels read and write the host's arrays in place.
    calls: counts of the calls on its queue.
    command_buffers: the command buffers that are being recorded.
    under_way: events and buffers that keep host arrays alive while the device may still read them.
    part: the whole device and the part's number, if this is a part of a device (`open_devices`); otherwise None.
    index: position in the list of devices. A part has the position of its whole device.
    atomics_faults: the faults that `probe_atomics` has found, shared by all copies of the device; empty before it runs.
    """

    def __init__(
        self,
        device: cl.Device,
        shape: Shape | None = None,
        *,
        profile: bool = False,
        why: str = "",
        part: tuple[cl.Device, int] | None = None,
    ) -> None:
        self.cl_device, self._part = device, part
        self.index = all_devices().index(device if part is None else part[0])
        self.name = device.name.strip() + ("" if part is None else f"/{part[1]}")
        self.driver = device.platform.version.strip()
        capabilities = capabilities_of(device)
        self.kind = capabilities.kind
        self.shape, self._why_another = (shape, why) if shape else shape_of(device)
        self.only_tries = False
        self.waits = switched_on(SYNC_VARIABLE)
        self.shares_memory = self.kind == "cpu"
        self.compiles_by_size = compiles_by_size(device)
        self.max_allocation, self.max_group = capabilities.allocation, capabilities.group
        self.memory = Memory()
        self.context = cl.Context([device])
        self.profile = profile
        self._queue = self._new_queue()
        self.calls = Calls()
        self.command_buffers: list[CommandBuffer] = []
        self.under_way: list[object] = []
        self._options = "-cl-std=CL1.2"  # no fast-math, so that all drivers compute the same bits
        if capabilities.exact_division:
            self._options += " -cl-fp32-correctly-rounded-divide-sqrt"
        self._kernels: dict[tuple[str, tuple[tuple[str, object], ...], int], Kernels] = {}
        self._switches: Mapping[str, object] = {}
        self.recorder = Recorder(self._queue)
        self.trials = KernelTrials(device, self.index, self.shape.label)
        self._fma: list[dict[str, object]] = [] if capabilities.contraction else [{}]
        self._subgroups: list[dict[str, object]] = []
        self.atomics_faults: list[str] = []

    @property
    def queue(self) -> cl.CommandQueue:
        """The in-order queue. Raises DeviceError in a forked process (`forks`)."""
        forks.check()
        return self._queue

    def kernels(self, stem: str, defines: Mapping[str, object] = {}, registers: int = 0) -> Kernels:
        """Return the kernels of `stem`.cl for this device's shape and these defines. The first call builds them.

        registers: maximum registers per work-item, if the driver has an option for it; 0 for no limit.
        """
        # Warn here and not when the device is opened, as the self-test may change the shape in between.
        if self._why_another:
            tell_once(self._why_another)
        if self._switches:
            text = kernel_source(stem)
            defines = {**{name: value for name, value in self._switches.items() if name in text}, **defines}
        if self.shape.subgroups and "SUBGROUPED" in kernel_source(stem):
            defines = {**self._with_subgroups(), **defines}
        key = (stem, tuple(sorted(defines.items())) if defines else (), registers)
        kernels = self._kernels.get(key)
        if kernels is None:
            if not self._fma:
                self._fma.append(self._probe_fma())  # the list is changed in place, as copies of this device share it
            kernels = self._kernels[key] = self._built(stem, {**self._fma[0], **defines}, registers)
        return kernels

    def _built(self, stem: str, defines: Mapping[str, object], registers: int = 0) -> Kernels:
        given, text = {"LANES": self.shape.lanes, "ITEMS": self.shape.items, **defines}, text_of(stem)
        # Only defines that occur in the text are passed. A driver's cache is keyed by the options, so all shapes share
        # the cached build of a file that does not depend on the shape.
        named = {name: value for name, value in given.items() if name.partition("(")[0] in text}
        limit = register_limit(self.cl_device, registers) if registers else ""
        variant = variant_of(stem, named, f"{self._options} {limit}")
        program, salt = build(self.context, self.cl_device, self.trials.build(variant))
        self.trials.built(variant, salt)
        return Kernels(variant, program)

    def with_shape(
        self, label: str = "", *, lanes: int | None = None, items: int | None = None, chunks: int | None = None
    ) -> Device:
        """Open this device again with another kernel shape.

        label: the shape's label, such as 8x1; "" for this device's shape.
        lanes, items, chunks: replace these fields of the `Shape`; None keeps a field. If one of them is given, the new
        shape has neither `by_gaussian` nor `subgroups`.
        """
        shape = self.shape.relabelled(label) if label else self.shape
        if lanes or items or chunks:
            shape = Shape(lanes or shape.lanes, items or shape.items, chunks or shape.chunks)
        device = Device(self.cl_device, shape, profile=self.profile, part=self._part)
        device.memory.limit = self.memory.limit
        return device

    def with_switches(self, switches: Mapping[str, object]) -> Device:
        """Copy this device, with the same queue. The copy passes these defines to kernel files that contain them."""
        device = copy(self)
        device._switches = {**self._switches, **switches}  # noqa: SLF001  # the copy is of this class
        return device

    @property
    def is_another(self) -> bool:
        """True if the driver failed in the preferred kernel shape, so that the device uses another shape."""
        return bool(self._why_another)

    def switched(self, *names: str) -> bool:
        """Return True if `with_switches` has set any of the defines `names`."""
        return any(name in self._switches for name in names)

    def beside(self) -> Device:
        """Copy this device, with a second in-order queue. The two queues run side by side, unless one waits for the
        other (`mark`, `follow`).

        Returns this device itself if the driver has no second queue.
        """
        device = copy(self)
        try:
            device._queue = self._new_queue()  # noqa: SLF001  # the copy is of this class
        except cl.Error:
            return self
        device.command_buffers, device.under_way = [], []
        return device

    def _new_queue(self) -> cl.CommandQueue:
        properties = cl.command_queue_properties.PROFILING_ENABLE if self.profile else 0
        return cl.CommandQueue(self.context, self.cl_device, properties)

    def mark(self) -> cl.Event:
        """Put a marker on the queue, and start its commands. Returns the marker's event, which is complete when all
        commands before it are."""
        try:
            event = cl.enqueue_marker(self.queue)
            self.queue.flush()
        except cl.Error as error:
            raise self.failed("starting its commands", error) from None
        return event

    def follow(self, event: cl.Event) -> None:
        """Let all later commands on the queue wait for an event, which may be of another queue of this device."""
        try:
            cl.enqueue_barrier(self.queue, wait_for=[event])
        except cl.Error as error:
            raise self.failed("waiting for other commands", error) from None

    def with_memory_limit(self, limit: int | None) -> Device:
        """Copy this device, with the same queue and kernels. The copy's buffers may take at most `limit` bytes."""
        device = copy(self)
        device.memory = Memory(limit)
        return device

    @property
    def budget(self) -> int:
        """Bytes that all buffers together may take: the memory limit, or without a limit all of the device's memory."""
        return self.memory.limit or int(self.cl_device.global_mem_size)

    @property
    def row_alignment(self) -> int:
        """The first row of a view (`DeviceArray.rows`) must be a multiple of this number.

        OpenCL requires sub-buffers to be aligned, and kernels read whole vectors. The number suffices for rows of at
        least four bytes.
        """
        return max(int(self.cl_device.mem_base_addr_align) // 32, self.shape.lanes, 32)

    def enqueue(
        self,
        kernel: Kernel,
        size: tuple[int, ...],
        local: tuple[int, ...] | None,
        values: Sequence[Any],
        *,
        wait: bool = False,
    ) -> cl.Event:
        """Put a launch on the queue, and return its event. Wait for the kernel if `wait`, or if CLSPLAT_SYNC=1.

        size, local: work-items in all and in a group, along each axis. With None the driver chooses the groups.
        values: the kernel's arguments.
        Raises DriverError, and CapacityError if the device has no memory left for the kernel.
        """
        try:
            event = kernel.cl_kernel(self.queue, size, local, *values)
            self.calls.launches += 1
            if self.waits:
                self._wait_for(event, kernel)
            elif wait:  # waits here, so that the last kernel in the log is the one that crashed
                self.queue.finish()
                self.under_way.clear()
        except cl.Error as error:
            raise self._not_launched(kernel, error) from None
        for commands in self.command_buffers:
            commands.add_launch(self.queue, kernel, size, local, values)
        return event

    def _not_launched(self, kernel: Kernel, error: cl.Error) -> ClsplatError:
        if isinstance(error, cl.MemoryError):
            return self.used_up(f"{kernel.name} of {kernel.variant.stem}.cl")
        return self.trials.error(kernel.variant, kernel.name, f"cannot be launched: {' '.join(str(error).split())}")

    def record(self, work: Callable[[], T], given: Sequence[cl.Buffer] = ()) -> tuple[T, CommandBuffer | None]:
        """Run `work`. Return its result, and a command buffer of the commands that it put on the queue.

        The second result is None if these commands cannot be replayed.

        given: buffers that a replay may replace by other buffers (`CommandBuffer`).
        """
        commands, before = CommandBuffer(given), copy(self.calls)
        self.command_buffers.append(commands)
        try:
            result = work()
        finally:
            self.command_buffers.remove(commands)
        return result, commands if commands.is_all_of(self.calls.since(before)) else None

    def replay(self, commands: CommandBuffer) -> None:
        """Put the commands of a command buffer on the queue. Raises DriverError and CapacityError, like `enqueue`."""
        kernel = None
        try:
            for kernel, call in commands.entries:  # noqa: B007  # the loop variable names the kernel in an error
                call()
        except cl.Error as error:
            if kernel is None:
                raise
            raise self._not_launched(kernel, error) from None
        self.calls.add(commands.calls)

    @property
    def replays(self) -> bool:
        """True if command buffers may be replayed: not with CLSPLAT_SYNC=1, in a profile or in `only_tried`."""
        return not (self.waits or self.recorder.on or self.only_tries)

    def _wait_for(self, event: cl.Event, kernel: Kernel) -> None:
        """Wait for a kernel that is on the queue. Raises DriverError if it fails or does not finish in time."""
        self.queue.flush()
        start, seconds, pause = time.monotonic(), driver_timeout(), 1e-5
        while (status := event.command_execution_status) > cl.command_execution_status.COMPLETE:
            if time.monotonic() - start > seconds:
                text = f"does not finish within {seconds:g} s ({DRIVER_TIMEOUT_VARIABLE})"
                raise self.trials.error(kernel.variant, kernel.name, text)
            time.sleep(pause)
            pause = min(2 * pause, 1e-2)
        if status < 0:
            raise self.trials.error(kernel.variant, kernel.name, f"failed with OpenCL's status {status}")

    def finish(self) -> None:
        """Wait until the device is idle. Raises DriverError and CapacityError."""
        try:
            self.queue.finish()
        except cl.Error as error:
            raise self.failed("waiting for the device", error) from None
        self.under_way.clear()

    def failed(self, work: str, error: cl.Error) -> ClsplatError:
        """Return the error to raise if `work`, a command other than a launch, fails with `error`. The cause may be an
        earlier kernel, or a device that was lost."""
        if isinstance(error, cl.MemoryError):
            return self.used_up(work)
        return DriverError(f"{title(self.cl_device)}: {work} failed ({' '.join(str(error).split())})")

    def used_up(self, work: str) -> CapacityError:
        """Return the error to raise if the device has no memory left for `work`. Many drivers report this at the first
        use of a buffer, not at its allocation."""
        used = amount(self.memory.used)
        return CapacityError(
            f"{self.name} has no memory left for {work}, with {used} in use: set --max-device-mem below {used}"
        )

    def timed(self, work: Callable[[], T]) -> tuple[T, float]:
        """Run `work`. Return its result and the milliseconds until the device has finished it."""
        self.finish()
        start = time.perf_counter()
        result = work()
        self.finish()
        return result, 1e3 * (time.perf_counter() - start)

    def _probe_fma(self) -> dict[str, object]:
        """Return the define FMA_BY_CONTRACTION if the compiler fuses a*b + c in vectors; otherwise no define.

        With this define, kernels write a*b + c instead of fma(a, b, c), which is faster and gives the same bits. A
        shape without vectors never gets the define: Intel's runtime vectorises loops by itself, and then fuses only
        some of the multiply-adds.
        """
        if self.shape.lanes == 1:
            return {}
        fused: dict[str, object] = {"FMA_BY_CONTRACTION": True}
        numbers = (np.float32(1 + 2.0**-12), np.float32(-(1 + 2.0**-11)))
        results = self._probed(self._built("probe", fused).probe_fma, 1, 2 * self.shape.lanes, *numbers)
        return fused if np.all(results == np.float32(2.0**-24)) else {}

    def _with_subgroups(self) -> dict[str, object]:
        """Return the first set of defines in `subgroup_ways` for which a probe kernel exchanges values in sub-groups.

        Raises DeviceError if the values are wrong with every set.
        """
        if self._subgroups:
            return self._subgroups[0]
        for defines in subgroup_ways(self.cl_device):
            bits = int(str(defines["SUBGROUP"])).bit_length() - 1
            wanted = np.arange(self.shape.items) ^ (1 << np.arange(bits)[:, None])
            try:
                got = self._probed(
                    self._built("probe_subgroup", defines).probe_subgroup, self.shape.items, wanted.shape
                )
            except (KernelBuildError, DriverError):
                continue
            if np.array_equal(got, wanted):
                self._subgroups.append(defines)  # the list is changed in place, as copies of this device share it
                return defines
        raise DeviceError(
            f"{title(self.cl_device)}: the work-items of a sub-group got wrong values from each other; choose a shape "
            f"without sub-groups, such as CLSPLAT_SHAPE={self.shape.label.removesuffix('s')}"
        )

    def _probed(
        self, kernel: Kernel, items: int, shape: int | tuple[int, ...], *numbers: object
    ) -> NDArray[np.float32]:
        """Run a probe kernel in one group of `items` work-items, and return the array that it writes.

        shape: shape of this array, which is the kernel's first argument.
        numbers: the kernel's further arguments.
        """
        results = np.empty(shape, np.float32)
        buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, results.nbytes)
        values = (buffer, *numbers)
        self.trials.launch(kernel, (items,), (items,), values)
        self.enqueue(kernel, (items,), (items,), values)
        cl.enqueue_copy(self.queue, results, buffer, is_blocking=True)
        return results

    def __repr__(self) -> str:
        return f"<Device {self.name} | {self.driver.split('  ')[0].strip()} | {self.shape.label}>"
