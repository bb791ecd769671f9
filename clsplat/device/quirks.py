# SPDX-License-Identifier: Apache-2.0
"""Differences between drivers, by the drivers' names."""

from __future__ import annotations

import pyopencl as cl


def kind_of(device: cl.Device) -> str:
    """cpu, gpu or other."""
    if device.type & cl.device_type.GPU:
        return "gpu"
    return "cpu" if device.type & cl.device_type.CPU else "other"


def pocl_version(device: cl.Device) -> tuple[int, int] | None:
    words = device.platform.version.split()
    if "PoCL" not in words:
        return None
    digits = words[words.index("PoCL") + 1].split("-")[0].split("+")[0].split(".")
    return int(digits[0]), int(digits[1])


def is_rusticl(device: cl.Device) -> bool:
    return str(device.platform.name).strip() == "rusticl"


def tells_group_sizes(device: cl.Device) -> bool:
    """False for a driver that is wrong about the work-items that it allows a group of a kernel: Rusticl of Mesa 22.3
    says 32 of every kernel, and runs groups of 1024."""
    return not is_rusticl(device)


def caches_programs(device: cl.Device) -> bool:
    """True for a driver that keeps what it builds on the disk, so that a second build takes no time."""
    return pocl_version(device) is not None


def compiles_by_size(device: cl.Device) -> bool:
    """True for a driver that compiles a kernel anew for a group of another size, and for launches from 65,536 items."""
    return pocl_version(device) is not None


def wants_cache(device: cl.Device) -> bool:
    """True for a driver that is known to build everything anew in each process, and to load its binaries again:
    Intel's runtime for CPUs. Other drivers have a cache of their own, or have not been tried."""
    return kind_of(device) == "cpu" and str(device.platform.name).strip() == "Intel(R) OpenCL"
