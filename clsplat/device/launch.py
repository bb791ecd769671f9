# SPDX-License-Identifier: Apache-2.0
"""Puts kernels on a device's queue."""

from __future__ import annotations

from typing import Any

import numpy as np

from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device

_LOCAL = 64
"""Work-items a group where they do not co-operate: enough for a GPU's wave, short enough for a CPU's chunk."""


def _arguments(arguments: tuple[Any, ...]) -> list[Any]:
    values: list[Any] = []
    for argument in arguments:
        if isinstance(argument, DeviceArray):
            values.append(argument.buffer)
        elif isinstance(argument, bool | int):
            values.append(np.uint32(argument) if argument >= 0 else np.int32(argument))
        elif isinstance(argument, float):
            values.append(np.float32(argument))
        else:
            values.append(argument)
    return values


_UPDATED = {
    "adam": 4,
    "density_statistics": 3,
    "view_agreement": 1,
    "contribution_statistics": 2,
    "add_slots": 1,
}
"""Kernels that read and write some arrays in place: so many of their last ones."""


def _enqueue(
    device: Device, kernel: Any, size: tuple[int, ...], local: tuple[int, ...] | None, arguments: tuple[Any, ...]
) -> None:
    event = kernel(device.queue, size, local, *_arguments(arguments))
    if device.recorder.on:
        name = kernel.function_name
        arrays = [argument for argument in arguments if isinstance(argument, DeviceArray)]
        updated = arrays[len(arrays) - _UPDATED.get(name, 0) :]
        once = {id(array.buffer): array.nbytes for array in arrays}
        device.recorder.add(name, event, sum(once.values()) + sum(array.nbytes for array in updated))


def launch_items(device: Device, kernel: Any, items: int, *arguments: Any) -> None:
    """One work-item for each of `items`; the kernel guards the rounding up. Nothing for 0 items."""
    if items > 0:
        size = -(-items // _LOCAL) * _LOCAL
        _enqueue(device, kernel, (size,), (_LOCAL,), arguments)


def launch_groups(device: Device, kernel: Any, groups: int, items: int, *arguments: Any) -> None:
    """`groups` work-groups of `items`. Nothing for 0 groups."""
    if groups > 0:
        _enqueue(device, kernel, (groups * items,), (items,), arguments)


def launch_grid(device: Device, kernel: Any, size: tuple[int, ...], *arguments: Any) -> None:
    """A grid of work-items: a row of it is a group's loop on a CPU, which the driver would else make one group of all.

    Nothing where a side is 0.
    """
    if all(size):
        local = (size[0], *(1 for _ in size[1:])) if device.kind == "cpu" and size[0] <= 1024 else None
        _enqueue(device, kernel, size, local, arguments)
