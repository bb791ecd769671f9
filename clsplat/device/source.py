# SPDX-License-Identifier: Apache-2.0
"""The kernel sources: their folder, and the text of a file with its includes inserted."""

from __future__ import annotations

import re
from functools import cache, lru_cache
from pathlib import Path

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


@lru_cache(maxsize=1)
def kernel_root() -> Path:
    """The folder of the OpenCL sources: `clsplat/kernels` in a wheel, `kernels/` next to the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for root in (package / "kernels", package.parent / "kernels"):
        if (root / "project.cl").is_file():
            return root
    raise FileNotFoundError(f"no kernels/ inside or beside {package}: the installation is incomplete")


@cache
def kernel_source(stem: str) -> str:
    """The text of `stem`.cl, with each `#include "..."` (relative to the kernel root) inserted once.

    Headers are inserted here, not by the compiler's `-I`. Drivers cache builds by the source text, and would otherwise
    miss a change of a header.
    """
    seen: set[str] = set()
    lines: list[str] = []

    def append(name: str) -> None:
        if name in seen:
            return
        seen.add(name)
        for line in (kernel_root() / name).read_text(encoding="utf-8").splitlines():
            match = _INCLUDE.match(line)
            if match:
                append(match.group(1))
            else:
                lines.append(line)

    append(f"{stem}.cl")
    return "\n".join(lines) + "\n"
