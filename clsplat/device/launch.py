# SPDX-License-Identifier: Apache-2.0
"""Kernel launches: conversion of arguments, group sizes, and the sandbox trial before the first launch of a kernel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import prod
from typing import Any

import numpy as np

from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.device.drivers.quirks import tells_group_sizes
from clsplat.device.profile import UPDATED_ARRAYS_BY_KERNEL
from clsplat.device.program import Kernel

DEFAULT_GROUP_ITEMS = 64
"""Work-items per group in kernels whose items do not co-operate: enough to fill a GPU's wave, and few enough to divide
the work over a CPU's processors."""
_LOW_32_BITS = 0xFFFFFFFF
_RECOMPILED_SIZE_ITEMS = 1 << 16
"""PoCL compiles a kernel again for launches with this number of work-items or more along an axis."""


@contextmanager
def only_tried(device: Device) -> Iterator[None]:
    """Inside the block, a launch runs nothing on the device. A kernel that had no trial is tried in the sandbox.

    So if a driver fails in a trial, no array has been changed yet.
    """
    device.only_tries = True
    try:
        yield
    finally:
        device.only_tries = False


def _values(arguments: tuple[Any, ...]) -> list[Any]:
    """Convert arguments for OpenCL: arrays to their buffers, whole numbers to their low 32 bits, others unchanged."""
    return [
        argument.buffer
        if (kind := type(argument)) is DeviceArray
        else (argument & _LOW_32_BITS if kind is int or kind is bool else argument)
        for argument in arguments
    ]


def _type(value: Any) -> Any:
    """Return the NumPy type to which pyopencl converts a scalar argument of a kernel; None for other arguments."""
    if isinstance(value, int):
        return np.uint32
    if isinstance(value, float):
        return np.float32
    return value.dtype if isinstance(value, np.generic) else None


def form_of(device: Device, size: tuple[int, ...], local: tuple[int, ...] | None) -> str:
    """Return the suffix that a kernel's name gets in the record of sandbox trials, for a launch of this size.

    It is "" unless the driver compiles a kernel again for other launch sizes. Then launches of 65,536 work-items or
    more along an axis have trials of their own, and so do those whose groups the driver chooses (`local` is None).
    Launches with a given group size share a trial, because otherwise each width of an image would need its own.
    """
    if not device.compiles_by_size:
        return ""
    groups = "" if local else " of any groups"
    return groups if max(size) < _RECOMPILED_SIZE_ITEMS else groups + " of many items"


def _first(
    device: Device,
    kernel: Kernel,
    size: tuple[int, ...],
    local: tuple[int, ...] | None,
    values: Sequence[Any],
    form: str,
) -> None:
    """Prepare a kernel's first launch: set the types of its arguments, and try the launch in the sandbox.

    size, local, values: as for `Device.enqueue`.
    form: the kind of launch, a suffix from `form_of`.
    Raises DriverError.
    """
    types = [_type(value) for value in values]
    most = device.max_group
    if tells_group_sizes(device.cl_device):
        most = min(most, kernel.most_items(device.cl_device))
    if local is not None and prod(local) > most:
        raise device.trials.fail(
            kernel.variant,
            kernel.name,
            f"has {prod(local)} items in a group, but the driver allows at most {most}",
        )
    typed = [value if kind is None else np.dtype(kind).type(value) for kind, value in zip(types, values, strict=True)]
    device.trials.launch(kernel, size, local, typed, form)
    kernel.cl_kernel.set_scalar_arg_dtypes(types)
    kernel.tried.add(form)


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
    event = device.enqueue(kernel, size, local, values, wait=first and device.trials.say is not None)
    if device.recorder.on:
        name = kernel.name
        arrays = [argument for argument in arguments if isinstance(argument, DeviceArray)]
        updated = arrays[len(arrays) - UPDATED_ARRAYS_BY_KERNEL.get(name, 0) :]
        once = {id(array.buffer): array.nbytes for array in arrays}
        device.recorder.add(name, event, sum(once.values()) + sum(array.nbytes for array in updated))


def launch_items(device: Device, kernel: Kernel, items: int, *arguments: Any) -> None:
    """Launch `items` work-items, rounded up to whole groups; the kernel must ignore the excess. 0 launches nothing."""
    if items > 0:
        size = -(-items // DEFAULT_GROUP_ITEMS) * DEFAULT_GROUP_ITEMS
        local = (DEFAULT_GROUP_ITEMS,) if device.max_group >= DEFAULT_GROUP_ITEMS else None
        _enqueue(device, kernel, (size,), local, arguments)


def launch_groups(
    device: Device, kernel: Kernel, groups: int | tuple[int, int, int], items: int, *arguments: Any
) -> None:
    """Launch work-groups of `items` work-items each.

    groups: number of groups, or their numbers along the three axes of a grid. If one is 0, nothing is launched.
    """
    first, *further = groups if isinstance(groups, tuple) else (groups,)
    if all((first, *further)):
        _enqueue(device, kernel, (first * items, *further), (items, *(1 for _ in further)), arguments)


def launch_grid(device: Device, kernel: Kernel, size: tuple[int, ...], *arguments: Any) -> None:
    """Launch a grid with `size` work-items along each axis. If one of the sizes is 0, nothing is launched.

    On a CPU each row is a group; otherwise the driver might make the whole grid a single group.
    """
    if all(size):
        fits = size[0] <= min(device.max_group, 1024)
        local = (size[0], *(1 for _ in size[1:])) if device.kind == "cpu" and fits else None
        _enqueue(device, kernel, size, local, arguments)
