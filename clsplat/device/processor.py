# SPDX-License-Identifier: Apache-2.0
"""A name for the processor that PoCL 3.0's compiler knows.

The LLVM 14 in the PoCL that pip brings knows AMD's processors by their family. It has no name for Zen 5 and later, and
says "generic", which its own front end refuses: nothing can be built. Zen 4 it takes for Zen 3, without AVX-512, while
PoCL links built-ins that use it: kernels with vectors of 16 end the process. Later versions of PoCL name the processor
by its features, as is done here. docs/decisions/0020-processors-are-named-by-features.md.
"""

from __future__ import annotations

import ctypes
import os
import struct
from contextlib import suppress
from functools import cache
from pathlib import Path

import pyopencl as cl

from clsplat.device.quirks import misnames_processors

BY_FEATURES = (
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
    ("haswell", {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}),
    ("sandybridge", {"avx", "popcnt", "aes", "pclmulqdq"}),
    ("x86-64", set[str]()),
)
"""LLVM's names from the most to the least that a processor can have, by features as Linux calls them."""
LIMIT = 2048
"""Bytes of PoCL's record of a device in which the name is looked for; in PoCL 3.0 it is at 640."""
_kept: dict[int, ctypes.Array[ctypes.c_char]] = {}
"""Texts that the devices' records point to, by address of a device."""


@cache
def features(path: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """The processor's features, as Linux calls them; none on another system."""
    with suppress(OSError):
        for line in path.read_text(encoding="ascii", errors="replace").splitlines():
            name, _, words = line.partition(":")
            if name.strip() == "flags":
                return frozenset(words.split())
    return frozenset()


def better_name(name: str, present: frozenset[str]) -> str:
    """The name for a processor with these features that LLVM 14 calls `name`; the same where that will do."""
    if not present or not (name == "generic" or name.startswith("znver")):
        return name
    by_features = next(better for better, needed in BY_FEATURES if needed <= present)
    return by_features if name == "generic" or by_features == BY_FEATURES[0][0] else name


def name_processor(device: cl.Device) -> str:
    """Give PoCL 3.0 for x86-64 a name for the processor that its compiler knows. Returns the name that is then in use;
    empty for another driver, or where the name is not found."""
    if not misnames_processors(device):
        return ""
    address = _place(device.int_ptr)
    if address is None:
        return ""
    name = _text(_word(address)) or ""
    better = better_name(name, features())
    if better != name:
        # kept for as long as the process runs: the driver reads it at every build
        _kept[address] = ctypes.create_string_buffer(better.encode())
        ctypes.c_void_p.from_address(address).value = ctypes.addressof(_kept[address])
    return better


def _place(record: int) -> int | None:
    """The address of the pointer to the name, which follows the one to the target's triple; None where they are not."""
    for address in range(record, record + LIMIT, 8):
        triple = _text(_word(address))
        if triple is not None and triple.startswith("x86_64-") and "linux" in triple:
            return address + 8 if _text(_word(address + 8)) else None
    return None


def _word(address: int) -> int:
    content = _memory(address, 8)
    return struct.unpack("<Q", content)[0] if len(content) == 8 else 0


def _text(address: int) -> str | None:
    """A short printable text in memory, None where there is none."""
    text, end, _ = _memory(address, 64).partition(b"\0")
    return text.decode("ascii") if end and text.isascii() and text.decode("ascii").isprintable() else None


def _memory(address: int, size: int) -> bytes:
    """Bytes of this process, none where there is no memory: to follow a number that is no address does no harm."""
    with suppress(OSError, OverflowError), open("/proc/self/mem", "rb", buffering=0) as memory:
        return os.pread(memory.fileno(), size, address)
    return b""
