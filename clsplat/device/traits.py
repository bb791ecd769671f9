# SPDX-License-Identifier: Apache-2.0
"""Traits of a device that decide which way a task is done, and CLSPLAT_PRETEND, which forces the other way.

So that what a GPU, a small device or a plain compiler gets is tested where none is at hand.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

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


_WORDS: dict[str, Callable[[Traits], Traits]] = {
    "gpu": lambda traits: replace(traits, kind="gpu"),
    "no-exact-division": lambda traits: replace(traits, exact_division=False),
    "no-contraction": lambda traits: replace(traits, contraction=False),
}
_SIZES: dict[str, Callable[[Traits, int], Traits]] = {
    "group": lambda traits, most: replace(traits, group=min(traits.group, most)),
    "local-memory": lambda traits, most: replace(traits, local_memory=min(traits.local_memory, most)),
    "allocation": lambda traits, most: replace(traits, allocation=min(traits.allocation, most)),
}


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
            traits = _WORDS[name](traits)
        elif name in _SIZES and number.isascii() and number.isdigit() and int(number) > 0:
            traits = _SIZES[name](traits, int(number))
        else:
            raise DeviceError(
                f"{PRETEND}={pretended()}: {part.strip()!r} is none of {', '.join(_WORDS)}, "
                f"{', '.join(f'{size}=NUMBER' for size in _SIZES)}"
            )
    return traits
