# SPDX-License-Identifier: Apache-2.0
"""Puts kernels on a device's queue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import prod
from typing import Any

import numpy as np

from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.device.program import Kernel
from clsplat.device.quirks import tells_group_sizes

LOCAL = 64
"""Work-items a group where they do not co-operate: enough for a GPU's wave, short enough for a CPU's chunk."""
_WORD = 0xFFFFFFFF
_MANY = 1 << 16
"""Items along an axis from which on PoCL compiles a kernel anew."""


@contextmanager
def only_tried(device: Device) -> Iterator[None]:
    """Inside, the launches of this device are rehearsed where they have to be, and not made. So a driver's failure
    leaves nothing half done."""
    device.only_tries = True
    try:
        yield
    finally:
        device.only_tries = False


def _values(arguments: tuple[Any, ...]) -> list[Any]:
    """The arguments that the kernel gets: whole numbers as their 32 bits, with or without a sign."""
    return [
        argument.buffer
        if (kind := type(argument)) is DeviceArray
        else (argument & _WORD if kind is int or kind is bool else argument)
        for argument in arguments
    ]


def _type(value: Any) -> Any:
    """The type of an argument for OpenCL's wrapper; None for one that is no scalar."""
    if isinstance(value, int):
        return np.uint32
    if isinstance(value, float):
        return np.float32
    return value.dtype if isinstance(value, np.generic) else None


def form_of(device: Device, size: tuple[int, ...], local: tuple[int, ...] | None) -> str:
    """A name for the form of a launch, where the driver compiles a kernel anew for each form; empty for the usual one.

    The sizes of groups are not in it: an image's width is one, and each would be a trial.
    """
    if not device.compiles_by_size:
        return ""
    groups = "" if local else " of any groups"
    return groups if max(size) < _MANY else groups + " of many items"


def _first(
    device: Device,
    kernel: Kernel,
    size: tuple[int, ...],
    local: tuple[int, ...] | None,
    values: Sequence[Any],
    form: str,
) -> None:
    """Set the types of the kernel's arguments, and check that the driver can launch it. Raises DriverError."""
    types = [_type(value) for value in values]
    most = device.max_group
    if tells_group_sizes(device.cl_device):
        most = min(most, kernel.most_items(device.cl_device))
    if local is not None and prod(local) > most:
        raise device.rehearsal.fail(
            kernel.variant,
            kernel.name,
            f"has {prod(local)} items in a group, where the driver allows it {most}",
        )
    typed = [value if kind is None else np.dtype(kind).type(value) for kind, value in zip(types, values, strict=True)]
    device.rehearsal.launch(kernel, size, local, typed, form)
    kernel.cl_kernel.set_scalar_arg_dtypes(types)
    kernel.tried.add(form)


_UPDATED = {
    "adam": 4,
    "limit_scales": 1,
    "project_step": 18,
    "density_statistics": 3,
    "view_agreement": 1,
    "contribution_statistics": 2,
    "add_slots": 1,
    "add_view": 1,
    "join_view": 1,
    "add_noise": 1,
    "remove_gains": 1,
    "develop": 1,
}
"""Kernels that read and write some arrays in place: how many of their last ones."""


def _enqueue(
    device: Device, kernel: Kernel, size: tuple[int, ...], local: tuple[int, ...] | None, arguments: tuple[Any, ...]
) -> None:
    values = _values(arguments)
    form = form_of(device, size, local) if device.compiles_by_size else ""
    first = form not in kernel.tried
    if first:
        _first(device, kernel, size, local, values, form)
    if device.only_tries:
        return
    event = device.enqueue(kernel, size, local, values, wait=first and device.rehearsal.say is not None)
    if device.recorder.on:
        name = kernel.name
        arrays = [argument for argument in arguments if isinstance(argument, DeviceArray)]
        updated = arrays[len(arrays) - _UPDATED.get(name, 0) :]
        once = {id(array.buffer): array.nbytes for array in arrays}
        device.recorder.add(name, event, sum(once.values()) + sum(array.nbytes for array in updated))


def launch_items(device: Device, kernel: Kernel, items: int, *arguments: Any) -> None:
    """One work-item for each of `items`; the kernel guards the rounding up. Nothing for 0 items."""
    if items > 0:
        size = -(-items // LOCAL) * LOCAL
        local = (LOCAL,) if device.max_group >= LOCAL else None
        _enqueue(device, kernel, (size,), local, arguments)


def launch_groups(device: Device, kernel: Kernel, groups: int, items: int, *arguments: Any) -> None:
    """`groups` work-groups of `items`. Nothing for 0 groups."""
    if groups > 0:
        _enqueue(device, kernel, (groups * items,), (items,), arguments)


def launch_grid(device: Device, kernel: Kernel, size: tuple[int, ...], *arguments: Any) -> None:
    """A grid of work-items: a row of it is a group's loop on a CPU, which the driver would else make one group of all.

    Nothing where a side is 0.
    """
    if all(size):
        fits = size[0] <= min(device.max_group, 1024)
        local = (size[0], *(1 for _ in size[1:])) if device.kind == "cpu" and fits else None
        _enqueue(device, kernel, size, local, arguments)
