# SPDX-License-Identifier: Apache-2.0
"""Drivers that pip has installed where the loader of OpenCL does not look.

On Windows the loader reads the registry, which pip does not write, and OCL_ICD_FILENAMES, which it passes over in a
process with an administrator's rights. On Linux PyPI's PoCL is found by itself; macOS has no loader.
"""

from __future__ import annotations

import os
import sys
from collections.abc import MutableMapping
from pathlib import Path

VARIABLE = "OCL_ICD_FILENAMES"
INTEL = Path("Library", "bin", "intelocl64.dll")
"""Path of intel-opencl-rt's driver, below `sys.prefix`, with the libraries that it needs beside it."""


def offer(
    *,
    windows: bool = os.name == "nt",
    prefix: str = sys.prefix,
    environment: MutableMapping[str, str] = os.environ,
) -> None:
    """Tell the loader, in this process and its children, of a driver for CPUs that pip has installed; to be called
    before pyopencl first asks for platforms. A variable that is set is left as it is."""
    driver = Path(prefix) / INTEL
    if windows and VARIABLE not in environment and driver.is_file():
        environment[VARIABLE] = str(driver)
