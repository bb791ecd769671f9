# SPDX-License-Identifier: Apache-2.0
"""The version of the installed package."""

from __future__ import annotations

from functools import cache


@cache
def package_version() -> str:
    """The version, such as "0.1.0", or "0+unknown" for a checkout that is on the path but not installed."""
    from importlib import metadata  # slow to import, and most verbs never ask

    try:
        return metadata.version("clsplat")
    except metadata.PackageNotFoundError:
        return "0+unknown"
