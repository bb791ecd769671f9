# SPDX-License-Identifier: Apache-2.0
"""Compilers of drivers read no memory that they have freed, as Intel's does of kernels of barriers and many blocks.

glibc fills what is freed where MALLOC_PERTURB_ says so: what was luck without it ends the process.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from calls import python

from clsplat.device.context import Device

BUILD = """
import sys
from clsplat.device.selection import open_device
device = open_device(sys.argv[1]).with_shape(sys.argv[2])
for stem, defines in (("duplicate", {}), ("duplicate", {"RAYS": 1}), ("scan", {}), ("sort_radix", {})):
    device.kernels(stem, defines)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's variable")
def test_builds_with_freed_memory_filled(device: Device, tmp_path: Path) -> None:
    here = dict.fromkeys(("XDG_CACHE_HOME", "CLSPLAT_BINARIES", "POCL_CACHE_DIR"), str(tmp_path))
    environment = {**os.environ, **here, "MALLOC_PERTURB_": "165"}
    done = python("-c", BUILD, device.index, "1x32", env=environment, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
