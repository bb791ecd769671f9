# SPDX-License-Identifier: Apache-2.0
"""Finds the kernels and makes one text of a file and what it includes."""

from __future__ import annotations

import re
from functools import cache, lru_cache
from pathlib import Path

from clsplat.device.layout import header

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


@lru_cache(maxsize=1)
def kernel_root() -> Path:
    """The folder of the OpenCL sources: `clsplat/kernels` in a wheel, `kernels/` beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for root in (package / "kernels", package.parent / "kernels"):
        if (root / "project.cl").is_file():
            return root
    raise FileNotFoundError(f"no kernels/ inside or beside {package}: the installation is incomplete")


@cache
def kernel_source(stem: str) -> str:
    """The layouts and the text of `stem`.cl, each `#include "..."` (relative to the kernel root) put in once.

    The text is whole, rather than relying on `-I`, so that drivers' caches see a changed header.
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
    return header() + "\n".join(lines) + "\n"
