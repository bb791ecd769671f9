# SPDX-License-Identifier: Apache-2.0
"""The list of OpenCL devices; functions that select them by --device or CLSPLAT_DEVICE, and open each only once."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import lru_cache

import pyopencl as cl

from clsplat.config.checks import device_names
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers.capabilities import capabilities_of, pretended
from clsplat.device.drivers.quirks import no_device, title
from clsplat.device.drivers.shapes import Shape, asked_shape, default_shape, shape_of, shape_text
from clsplat.device.drivers.worker_process import driver_timeout
from clsplat.errors import DeviceError


@dataclass(frozen=True)
class DeviceInfo:
    """A device's entry in the list of `clsplat devices`."""

    index: int
    name: str
    platform: str
    version: str
    kind: str
    compute_units: int
    memory_bytes: int
    shape: str


def list_devices() -> list[DeviceInfo]:
    """Describe every visible OpenCL device, in the order of their index, as `clsplat devices` lists them.

    Raises DeviceError if CLSPLAT_SHAPE or CLSPLAT_PRETEND is malformed. If a device cannot run CLSPLAT_SHAPE,
    the `shape` of its entry says so.
    """
    asked_shape()
    return [
        DeviceInfo(
            index=index,
            name=device.name.strip(),
            platform=device.platform.name.strip(),
            version=device.platform.version.strip(),
            kind=capabilities_of(device).kind,
            compute_units=device.max_compute_units,
            memory_bytes=device.global_mem_size,
            shape=shape_text(device),
        )
        for index, device in enumerate(all_devices())
    ]


def limits(device: cl.Device) -> dict[str, object]:
    """Return the values of OpenCL device queries, by name, that a bug report needs: versions and limits."""
    names = (
        *("driver_version", "opencl_c_version", "extensions", "max_clock_frequency", "max_compute_units"),
        *("max_work_group_size", "local_mem_size", "max_constant_buffer_size", "max_mem_alloc_size", "global_mem_size"),
        *("mem_base_addr_align", "native_vector_width_float", "single_fp_config", "host_unified_memory"),
    )
    values: dict[str, object] = {}
    for name in names:
        try:
            value = getattr(device, name)
        except cl.Error as error:
            value = str(error)
        values[name] = value.strip() if isinstance(value, str) else int(value)
    return values


def select(selector: str | None) -> cl.Device:
    """Return the first device that `selector` names: an index, `cpu`, `gpu`, or part of a name, platform or version.

    With None, CLSPLAT_DEVICE is the selector. If it is not set either, a GPU is preferred: the result is the
    first GPU, or without a GPU the first device. Raises DeviceError.
    """
    driver_timeout()  # refuses an invalid CLSPLAT_DRIVER_TIMEOUT now and not at the first kernel
    devices = list(zip(all_devices(), list_devices(), strict=True))
    if not devices:
        raise no_device()
    named = f"--device {selector}" if selector else f"CLSPLAT_DEVICE={os.environ.get('CLSPLAT_DEVICE', '')}"
    selector = selector or os.environ.get("CLSPLAT_DEVICE") or None
    if selector is None:
        return next((device for device, info in devices if info.kind == "gpu"), devices[0][0])
    wanted = selector.lower() if selector.strip() else None  # a blank selector would match any name
    for device, info in devices:
        words = f"{info.name} {info.platform} {info.version}".lower()
        by_name = wanted is not None and (wanted == info.kind or wanted in words)
        if int(selector) == info.index if selector.isdigit() else by_name:
            return device
    names = "; ".join(f"{info.index}: {info.name} ({info.version.split('  ')[0]})" for _, info in devices)
    raise DeviceError(f"{named}: no such device, expected cpu, gpu, a part of a name, or an index of these: {names}")


def find_device(selector: str | None) -> DeviceInfo:
    """Describe the device that `selector` names (see `select`). Raises DeviceError."""
    chosen = select(selector)
    return list_devices()[all_devices().index(chosen)]


def _names(selector: str | None) -> list[str]:
    """Split a list of selectors at its commas. Raises DeviceError if `selector` is not text."""
    if not isinstance(selector, str | None):
        raise DeviceError(f"device is {selector!r}, expected text, such as '0', 'gpu' or a part of a name")
    return device_names(selector)


def _part_of(name: str) -> tuple[str, int | None]:
    """Split the selector NAME/NUMBER of a part of a device. The number is None for the selector of a whole device."""
    whole, slash, number = name.rpartition("/")
    return (whole, int(number)) if slash and whole and number.isdigit() else (name, None)


@lru_cache(maxsize=8)
def _divided(index: int, parts: int) -> list[cl.Device]:
    """Divide the `index`-th device into `parts` equal parts, by OpenCL's device fission. Return [] if that fails."""
    device = all_devices()[index]
    try:
        units = device.max_compute_units // parts
        return list(device.create_sub_devices([cl.device_partition_property.EQUALLY, units])) if units else []
    except cl.Error:
        return []


@lru_cache(maxsize=8)
def _open(
    index: int, shape: Shape, why: str, _pretended: str, *, profile: bool, part: tuple[int, int] | None = None
) -> Device:
    device = all_devices()[index]
    if part is None:
        return Device(device, shape, profile=profile, why=why)
    divided = _divided(index, part[1])
    if len(divided) < part[1]:
        units = f"{device.max_compute_units} compute unit{'' if device.max_compute_units == 1 else 's'}"
        raise DeviceError(
            f"--device {index}/{part[0]}: {title(device)}, with {units}, cannot be divided into {part[1]} equal parts; "
            f"expected a device that can be divided, or --device {index} for the whole"
        )
    chosen = divided[part[0]]
    shape = replace(shape, chunks=default_shape(chosen).chunks)
    return Device(chosen, shape, profile=profile, why=why, part=(device, part[0]))


def open_devices(
    selector: str | None = None, memory_limit: int | None = None, *, profile: bool = False
) -> list[Device]:
    """Open the devices of a list of selectors (see `select`), separated by commas.

    NAME/K selects part K of a device, counted from 0. OpenCL divides the device into max(2, largest K + 1) equal parts.
    Without `memory_limit`, repeated calls return the same object for the same device.

    memory_limit: maximum bytes of all buffers of each returned device.
    profile: True makes queues that record timings.
    Raises DeviceError if a device is named twice.
    """
    chosen: list[tuple[int, int | None]] = []
    for name in _names(selector):
        whole, number = _part_of(name)
        index = all_devices().index(select(whole if selector or number is not None else None))
        if any(index == other and (number == part or None in (number, part)) for other, part in chosen):
            raise DeviceError(f"--device {selector}: has {name} twice, expected different devices, or parts of them")
        chosen.append((index, number))
    opened = []
    for index, number in chosen:
        parts = max([2, *(part + 1 for other, part in chosen if other == index and part is not None)])
        part = None if number is None else (number, parts)
        opened.append(_open(index, *shape_of(all_devices()[index]), pretended(), profile=profile, part=part))
    return opened if memory_limit is None else [device.with_memory_limit(memory_limit) for device in opened]


def open_device(selector: str | None = None, memory_limit: int | None = None, *, profile: bool = False) -> Device:
    """Open the one device that `selector` names. All arguments are as for `open_devices`."""
    if len(_names(selector)) > 1:
        raise DeviceError(f"--device {selector}: expected one device here; only train and render take several")
    return open_devices(selector, memory_limit, profile=profile)[0]
