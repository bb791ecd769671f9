# SPDX-License-Identifier: Apache-2.0
"""Launches probe_atomics.cl: the probe of a driver's integer atomics, which lists by append need (append.cl). If the
atomics are faulty, a step sorts with sort_radix.cl.

As a program, `python -m clsplat.stages.probe_atomics INDEX`, the module prints the fault of a device.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import allocate, upload
from clsplat.device.context import Device
from clsplat.device.drivers.capabilities import capabilities_of
from clsplat.device.launch import launch_groups
from clsplat.device.selection import open_device
from clsplat.errors import DriverError, KernelBuildError

_GROUPS, _COUNTERS = 64, 5
"""Number of groups of the probe, so many that several run at a time, and number of counters that their items share."""


def atomics_fault(device: Device) -> str:
    """The fault of a device's integer atomics in global or local memory, in words; empty if they count correctly.

    The first call launches the probe in the device's kernel shape.
    """
    if not device.atomics_faults:
        found = _found(device)
        if device.only_tries:  # nothing was launched
            return ""
        device.atomics_faults.append(found)
    return device.atomics_faults[0]


def _found(device: Device) -> str:
    if not capabilities_of(device.cl_device).atomics:
        return "it has no 32-bit integer atomics"
    items = device.shape.items
    try:
        kernel = device.kernels("probe_atomics", {"PROBED": _COUNTERS}).probe_atomics
        counters = upload(device, np.zeros(_COUNTERS, np.uint32))
        places = allocate(device, (2, _GROUPS * items), np.uint32)
        launch_groups(device, kernel, _GROUPS, items, counters, places)
    except (KernelBuildError, DriverError):
        return "a kernel with integer atomics fails"
    of_all, of_groups = places.get()
    counter = np.arange(len(of_all)) % _COUNTERS
    own = np.stack([np.repeat(np.arange(_GROUPS), items), np.tile(np.arange(items) % _COUNTERS, _GROUPS)])
    right = _are_counts(of_all, counter[None]) and _are_counts(of_groups, own)
    return "" if right else "its integer atomics count wrongly"


def _are_counts(places: NDArray[np.integer], counters: NDArray[np.integer]) -> bool:
    """True if each counter gave its items the values 0, 1, 2, ... in some order.

    places: (items,), the value that each item got.
    counters: (keys, items), the keys that identify each item's counter.
    """
    order = np.lexsort((places, *counters))
    begins = np.ones(len(places), np.bool_)
    begins[1:] = (counters[:, order[1:]] != counters[:, order[:-1]]).any(axis=0)
    numbers = np.arange(len(places))
    return bool(np.array_equal(places[order], numbers - np.maximum.accumulate(np.where(begins, numbers, 0))))


if __name__ == "__main__":
    print(atomics_fault(open_device(sys.argv[1])), end="")
