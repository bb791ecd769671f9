# SPDX-License-Identifier: Apache-2.0
"""A processor name that PoCL 3.0's compiler knows.

The PoCL that pip installs has LLVM 14, which knows AMD processors by their family. For Zen 5 and later LLVM 14 reports
"generic", which its own front end refuses, so nothing can be built. It takes Zen 4 for Zen 3, which has no AVX-512, but
PoCL links built-ins that use AVX-512: kernels with vectors of 16 then end the process. Later versions of PoCL name the
processor by its features, as this module does. See docs/decisions/0020-processors-are-named-by-features.md.
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
"""LLVM's processor names, the most capable first, with the features that each needs, named as in Linux."""
DEVICE_RECORD_BYTES = 2048
"""Bytes of PoCL's device record that are searched for the name; PoCL 3.0 has it at byte 640."""
_kept: dict[int, ctypes.Array[ctypes.c_char]] = {}
"""Strings that the device records point to, by the address of the pointer."""


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
    """LLVM's name that suits a processor with these features; `name`, the name from LLVM 14, if that suits already."""
    if not present or not (name == "generic" or name.startswith("znver")):
        return name
    by_features = next(better for better, needed in CPU_NAMES_BY_FEATURES if needed <= present)
    return by_features if name == "generic" or by_features == CPU_NAMES_BY_FEATURES[0][0] else name


def name_processor(device: cl.Device) -> str:
    """Give PoCL 3.0 for x86-64 a processor name that its compiler knows.

    Returns the name then in use; empty for another driver, or if the name is not found.
    """
    if not misnames_processors(device):
        return ""
    address = _place(device.int_ptr)
    if address is None:
        return ""
    name = _text(_word(address)) or ""
    better = better_name(name, features())
    if better != name:
        # kept while the process runs: the driver reads it at every build
        _kept[address] = ctypes.create_string_buffer(better.encode())
        ctypes.c_void_p.from_address(address).value = ctypes.addressof(_kept[address])
    return better


def _place(record: int) -> int | None:
    """The address of the pointer to the name, which follows the pointer to the target triple; None if they are not
    found."""
    for address in range(record, record + DEVICE_RECORD_BYTES, 8):
        triple = _text(_word(address))
        if triple is not None and triple.startswith("x86_64-") and "linux" in triple:
            return address + 8 if _text(_word(address + 8)) else None
    return None


def _word(address: int) -> int:
    content = _memory(address, 8)
    return struct.unpack("<Q", content)[0] if len(content) == 8 else 0


def _text(address: int) -> str | None:
    """A short printable text in memory, or None."""
    text, end, _ = _memory(address, 64).partition(b"\0")
    return text.decode("ascii") if end and text.isascii() and text.decode("ascii").isprintable() else None


def _memory(address: int, size: int) -> bytes:
    """Bytes in this process's memory; empty at an address that is not mapped, so that any address may be asked for."""
    with suppress(OSError, OverflowError), open("/proc/self/mem", "rb", buffering=0) as memory:
        return os.pread(memory.fileno(), size, address)
    return b""
