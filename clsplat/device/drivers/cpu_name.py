# SPDX-License-Identifier: Apache-2.0
"""Processor name (LLVM target CPU) that PoCL 3.0's compiler accepts.

The PoCL that pip installs has LLVM 14, which identifies AMD processors by their family. For Zen 5 and later it reports
"generic", a name that its own front end refuses, so nothing can be built. Zen 4 is identified as Zen 3, which has no
AVX-512. But PoCL links built-ins that use AVX-512, so kernels with vectors of 16 crash. Like later versions of PoCL,
this module names the processor by its features. See docs/decisions/0020-processors-are-named-by-features.md.
"""

from __future__ import annotations

import ctypes
import os
import struct
from contextlib import suppress
from functools import cache
from pathlib import Path

import pyopencl as cl

from clsplat.device.drivers.quirks import misnames_processors

CPU_NAMES_BY_FEATURES = (
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    ("haswell", {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}),
    ("sandybridge", {"avx", "popcnt", "aes", "pclmulqdq"}),
    ("x86-64", set[str]()),
)
"""Processor names of LLVM, the most capable first, and the features that each requires, named as in Linux."""
DEVICE_RECORD_BYTES = 2048
"""Number of bytes of PoCL's device record (`cl_device_id`) that are searched for the processor name. In PoCL 3.0 the
name is at byte 640."""
_kept: dict[int, ctypes.Array[ctypes.c_char]] = {}
"""Processor names set by `name_processor`, by the address of the device record's pointer to the name. They are kept
here because the driver reads them at every build."""
_places: dict[int, int | None] = {}
"""Results of `_place`, by the address of the device record. Records of whole devices stay where they are as long as the
process lives, and the search takes 5 ms."""


@cache
def features(path: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """The processor's features, named as in Linux; empty on other systems."""
    with suppress(OSError):
        for line in path.read_text(encoding="ascii", errors="replace").splitlines():
            name, _, words = line.partition(":")
            if name.strip() == "flags":
                return frozenset(words.split())
    return frozenset()


def better_name(name: str, present: frozenset[str]) -> str:
    """Return the best processor name of LLVM for a processor with the features `present`.

    name: the name that LLVM 14 reports, which is returned if none is better.
    """
    if not present or not (name == "generic" or name.startswith("znver")):
        return name
    by_features = next(better for better, needed in CPU_NAMES_BY_FEATURES if needed <= present)
    return by_features if name == "generic" or by_features == CPU_NAMES_BY_FEATURES[0][0] else name


def name_processor(device: cl.Device) -> str:
    """Replace the processor name in a device record of PoCL 3.0 by a name that PoCL's compiler accepts.

    Returns the resulting name. For other drivers, and if no name is found in the record, nothing is changed, and the
    result is "".
    """
    if not misnames_processors(device):
        return ""
    record = device.int_ptr
    if record not in _places:
        _places[record] = _place(record)
    address = _places[record]
    if address is None:
        return ""
    name = _text(_word(address)) or ""
    better = better_name(name, features())
    if better != name:
        _kept[address] = ctypes.create_string_buffer(better.encode())
        ctypes.c_void_p.from_address(address).value = ctypes.addressof(_kept[address])
    return better


def _place(record: int) -> int | None:
    """Find the pointer to the processor name in the device record at address `record`.

    Returns the pointer's address; None if it is not found.

    The pointer follows the pointer to the target triple, such as x86_64-pc-linux-gnu.
    """
    for address in range(record, record + DEVICE_RECORD_BYTES, 8):
        triple = _text(_word(address))
        if triple is not None and triple.startswith("x86_64-") and "linux" in triple:
            return address + 8 if _text(_word(address + 8)) else None
    return None


def _word(address: int) -> int:
    content = _memory(address, 8)
    return struct.unpack("<Q", content)[0] if len(content) == 8 else 0


def _text(address: int) -> str | None:
    """Return the text that begins at an address and ends with a zero byte; None if it is not printable ASCII."""
    text, end, _ = _memory(address, 64).partition(b"\0")
    return text.decode("ascii") if end and text.isascii() and text.decode("ascii").isprintable() else None


def _memory(address: int, size: int) -> bytes:
    """Read `size` bytes of this process's memory from an address; empty if the address is not mapped."""
    with suppress(OSError, OverflowError), open("/proc/self/mem", "rb", buffering=0) as memory:
        return os.pread(memory.fileno(), size, address)
    return b""
