# SPDX-License-Identifier: Apache-2.0
"""Names of photographs in survey files."""

from __future__ import annotations

from clsplat.errors import InputError
from clsplat.scenes.readers.colmap import name_inside


def inner_name(where: str, name: str) -> str:
    """Return a listed name as a path inside the photographs' folder: without a drive, a root or "..".

    where: beginning of the error message.
    Raises InputError if nothing legible is left.
    """
    if (inner := name_inside(name)) is None:
        raise InputError(f"{where}: has the name {name[:80]!r}, expected a photograph's file name; export it again")
    return inner
