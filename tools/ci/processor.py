# SPDX-License-Identifier: Apache-2.0
"""Name of this machine's processor, for tables that depend on it."""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")


@cache
def processor() -> str:
    """The processor's name, and whether it has AVX-512."""
    try:
        lines = CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return f"{next(named, platform.machine())}, {'with' if has_avx512() else 'without'} AVX-512"


def has_avx512() -> bool:
    """True if the system reports that the processor has AVX-512."""
    try:
        return "avx512f" in CPUINFO.read_text(encoding="utf-8", errors="replace").split()
    except OSError:
        return False
