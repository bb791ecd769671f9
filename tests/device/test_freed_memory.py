# SPDX-License-Identifier: Apache-2.0
"""Compilers of drivers read no memory that they have freed, as Intel's does of kernels of barriers and many blocks.

glibc fills what is freed where MALLOC_PERTURB_ says so: what was luck without it ends the process.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.device.context import Device

BUILD = """
import sys
from clsplat.device.context import open_device
device = open_device(sys.argv[1]).with_shape(sys.argv[2])
for stem, defines in (("duplicate", {}), ("duplicate", {"RAYS": 1}), ("scan", {}), ("sort_radix", {})):
    device.kernels(stem, defines)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's variable")
def test_builds_with_freed_memory_filled(device: Device, tmp_path: Path) -> None:
    here = {"MALLOC_PERTURB_": "165", "XDG_CACHE_HOME": str(tmp_path), "CLSPLAT_BINARIES": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(device.index), "1x32"],
        env={**os.environ, **here, "POCL_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
