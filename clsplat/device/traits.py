# SPDX-License-Identifier: Apache-2.0
"""Traits of a device that decide which way a task is done, and CLSPLAT_PRETEND, which forces the other way.

With it the ways of a GPU, a small device and a plain compiler are tested where none is at hand.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from clsplat.device.quirks import kind_of
from clsplat.errors import DeviceError

if TYPE_CHECKING:
    import pyopencl as cl

PRETEND = "CLSPLAT_PRETEND"
"""Variable with what is pretended of every device, separated by commas."""


@dataclass(frozen=True)
class Traits:
    """The kind, limits and arithmetic of a device.

    kind: cpu, gpu or other; group: most work-items of a group; local_memory, allocation: bytes that a group and a
    buffer can have; exact_division: it can be asked for correctly rounded division and roots; contraction: it may be
    probed for multiplications and additions that are fused.
    """

    kind: str
    group: int
    local_memory: int
    allocation: int
    exact_division: bool = True
    contraction: bool = True


_WORDS: dict[str, dict[str, Any]] = {
    "gpu": {"kind": "gpu"},
    "no-exact-division": {"exact_division": False},
    "no-contraction": {"contraction": False},
}
"""Traits by the word that pretends them."""
_SIZES = {"group": "group", "local-memory": "local_memory", "allocation": "allocation"}
"""Limits by the name that pretends a lower one."""


def pretended() -> str:
    """CLSPLAT_PRETEND, or nothing."""
    return os.environ.get(PRETEND, "")


def traits_of(device: cl.Device) -> Traits:
    """The traits of a device, with those that CLSPLAT_PRETEND changes. Raises DeviceError for one that makes no
    sense."""
    from pyopencl import device_fp_config

    exact = bool(device.single_fp_config & device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT)
    group, local, allocation = (
        int(limit) for limit in (device.max_work_group_size, device.local_mem_size, device.max_mem_alloc_size)
    )
    traits = Traits(kind_of(device), group, local, allocation, exact_division=exact)
    for part in filter(None, pretended().split(",")):
        name, _, number = part.strip().partition("=")
        if name in _WORDS and not number:
            traits = replace(traits, **_WORDS[name])
        elif name in _SIZES and number.isascii() and number.isdigit() and int(number) > 0:
            limit = _SIZES[name]
            traits = replace(traits, **{limit: min(getattr(traits, limit), int(number))})
        else:
            raise DeviceError(
                f"{PRETEND}={pretended()}: {part.strip()!r} is none of {', '.join(_WORDS)}, "
                f"{', '.join(f'{size}=NUMBER' for size in _SIZES)}"
            )
    return traits
