# SPDX-License-Identifier: Apache-2.0
"""Sizes of memory as they are written on the command line."""

from __future__ import annotations

import re

from clsplat.errors import InputError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}
_SIZE = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([kmgt]?)(i?b)?\s*", re.IGNORECASE)


def parse_bytes(text: str | int | None, flag: str = "--max-device-mem") -> int | None:
    """Bytes of "256MiB", "2GiB", "1.5G" (the same as GiB), "500MB" (decimal) or a number. Raises InputError."""
    if text is None:
        return None
    match = _SIZE.fullmatch(str(text))
    size = 0
    if match is not None:
        number, prefix, ending = match.groups()
        decimal = prefix and (ending or "").lower() == "b"
        unit = 1000 ** "kmgt".index(prefix.lower()) * 1000 if decimal else _UNITS[prefix.lower()]
        size = int(float(number) * unit)
    if size < 1:
        raise InputError(f"{flag} {text}: expected a size such as 256MiB, 1.5G or a number of bytes")
    return size
