# SPDX-License-Identifier: Apache-2.0
"""The version of the installed package."""

from __future__ import annotations

from functools import cache


@cache
def package_version() -> str:
    """The version, such as "0.1.0"; "0+unknown" if the package runs from a checkout that is not installed."""
    from importlib import metadata  # slow to import, and most commands do not need the version

    try:
        return metadata.version("clsplat")
    except metadata.PackageNotFoundError:
        return "0+unknown"
