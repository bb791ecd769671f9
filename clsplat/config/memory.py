# SPDX-License-Identifier: Apache-2.0
"""Sizes of memory as they are written on the command line."""

from __future__ import annotations

import re

from clsplat.errors import InputError

_SIZE = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([kmgt]?)(i?b)?\s*", re.IGNORECASE)


def parse_bytes(text: str | int | None) -> int | None:
    """Bytes of "256MiB", "2GiB", "1.5G" (the same as GiB), "500MB" (decimal) or a number. Raises InputError."""
    if text is None:
        return None
    match = _SIZE.fullmatch(str(text))
    size = 0
    if match is not None:
        number, prefix, ending = match.groups()
        base, power = 1000 if (ending or "").lower() == "b" else 1024, ["", *"kmgt"].index(prefix.lower())
        size = int(float(number) * base**power)
    if size < 1:
        raise InputError(f"--max-device-mem {text}: expected a size such as 256MiB, 1.5G or a number of bytes")
    return size
