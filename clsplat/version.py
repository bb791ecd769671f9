# SPDX-License-Identifier: Apache-2.0
"""The version of the installed package."""

from __future__ import annotations

from functools import cache


@cache
def package_version() -> str:
    """The version, such as "0.1.0". A checkout that is on the path but not installed has "0+unknown"."""
    from importlib import metadata  # slow to import, and most verbs do not need the version

    try:
        return metadata.version("clsplat")
    except metadata.PackageNotFoundError:
        return "0+unknown"
