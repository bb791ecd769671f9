# SPDX-License-Identifier: Apache-2.0
"""Capabilities of a device by which algorithms are chosen, and CLSPLAT_PRETEND, which overrides them.

With CLSPLAT_PRETEND any machine can test the code paths for GPUs, for small devices and for simple compilers.
Whether arrays are shared with the host follows from the kind: `Device.shares_memory` of `clsplat/device/context.py`.
Sub-groups: `subgroup_ways` of `quirks.py`, tried by `Device.kernels`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from clsplat.device.drivers.quirks import kind_of
from clsplat.errors import DeviceError

if TYPE_CHECKING:
    import pyopencl as cl

PRETEND_VARIABLE = "CLSPLAT_PRETEND"
"""Environment variable that lists, separated by commas, the capabilities that every device pretends to have."""


@dataclass(frozen=True)
class Capabilities:
    """The kind, limits and arithmetic of a device.

    kind: cpu, gpu or other.
    group: maximum work-items in a group.
    local_memory: maximum bytes of a group's local memory.
    allocation: maximum bytes of a buffer.
    exact_division: True if the device supports correctly rounded division and square roots.
    contraction: False to skip the probe that finds out whether the compiler fuses a*b + c (`Device._probe_fma`).
    atomics: True if the device has 32-bit integer atomics in global and in local memory.
    """

    kind: str
    group: int
    local_memory: int
    allocation: int
    exact_division: bool = True
    contraction: bool = True
    atomics: bool = True


_CAPABILITIES_BY_WORD: dict[str, dict[str, Any]] = {
    "gpu": {"kind": "gpu"},
    "no-exact-division": {"exact_division": False},
    "no-contraction": {"contraction": False},
    "no-atomics": {"atomics": False},
}
"""Fields of `Capabilities` and their new values, by the word in CLSPLAT_PRETEND that sets them."""
_ATOMICS = {"cl_khr_global_int32_base_atomics", "cl_khr_local_int32_base_atomics"}
"""Extensions for integer atomics that a device of OpenCL 1.0 may lack. From OpenCL 1.1 on every device has them."""
_LIMIT_FIELDS = {"group": "group", "local-memory": "local_memory", "allocation": "allocation"}
"""Limits that CLSPLAT_PRETEND can lower, by their names in this variable, with the fields of `Capabilities`."""


def pretended() -> str:
    """Return the value of CLSPLAT_PRETEND, or an empty string if it is not set."""
    return os.environ.get(PRETEND_VARIABLE, "")


def capabilities_of(device: cl.Device) -> Capabilities:
    """Return a device's capabilities, changed as CLSPLAT_PRETEND says. Raises DeviceError for an invalid value."""
    from pyopencl import device_fp_config

    exact = bool(device.single_fp_config & device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT)
    group, local, allocation = (
        int(limit) for limit in (device.max_work_group_size, device.local_mem_size, device.max_mem_alloc_size)
    )
    atomics = device.version.split()[1] != "1.0" or set(device.extensions.split()) >= _ATOMICS
    capabilities = Capabilities(kind_of(device), group, local, allocation, exact_division=exact, atomics=atomics)
    for part in filter(None, pretended().split(",")):
        name, _, number = part.strip().partition("=")
        if name in _CAPABILITIES_BY_WORD and not number:
            capabilities = replace(capabilities, **_CAPABILITIES_BY_WORD[name])
        elif name in _LIMIT_FIELDS and number.isascii() and number.isdigit() and int(number) > 0:
            limit = _LIMIT_FIELDS[name]
            capabilities = replace(capabilities, **{limit: min(getattr(capabilities, limit), int(number))})
        else:
            raise DeviceError(
                f"{PRETEND_VARIABLE}={pretended()}: {part.strip()!r} is not known, expected one of "
                f"{', '.join(_CAPABILITIES_BY_WORD)}, {', '.join(f'{size}=NUMBER' for size in _LIMIT_FIELDS)}"
            )
    return capabilities
