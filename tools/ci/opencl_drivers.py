# SPDX-License-Identifier: Apache-2.0
"""Make all OpenCL drivers of this machine visible at once: system-wide drivers, those from PyPI, and an unpacked Debian
PoCL if CLSPLAT_DEBIAN_POCL names its libpocl.so.

The PoCL of `pyopencl[pocl]` is always loaded, whatever OCL_ICD_VENDORS is. Any other driver needs an .icd file in the
folder that OCL_ICD_VENDORS names, which is read when pyopencl is first imported. Intel's CPU runtime from PyPI has .icd
files, but they name a path that does not exist.

Run as a script, it prints the devices found.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
BESIDE = "CLSPLAT_DEBIAN_POCL"
PACKAGED_LIBRARIES = ("libintelocl.so",)
"""Drivers that packages from PyPI install in sys.prefix/lib."""


def list_drivers(folder: Path) -> list[str]:
    """Write an .icd file for each driver into `folder`, which is created if missing. Returns the drivers' names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    if SYSTEM_VENDORS.is_dir():
        for icd in sorted(SYSTEM_VENDORS.glob("*.icd")):
            shutil.copyfile(icd, folder / icd.name)
            names.append(icd.stem)
    if BESIDE in os.environ and "pocl" not in names:
        (folder / "pocl.icd").write_text(f"{os.environ[BESIDE]}\n")
        names.append("pocl")
    for library in PACKAGED_LIBRARIES:
        path = Path(sys.prefix) / "lib" / library
        if path.exists():
            name = path.name.split(".")[0]
            (folder / f"{name}.icd").write_text(f"{path.resolve()}\n")
            names.append(name)
    return names


def use_every_driver() -> Path | None:
    """Point OCL_ICD_VENDORS at a temporary folder with every driver. Call it before pyopencl is imported.

    Returns the folder, which is removed when the process ends. If the variable is already set, it stays, so that a run
    can be limited to one driver, and the result is None. Raises RuntimeError if pyopencl is already imported.
    """
    if "OCL_ICD_VENDORS" in os.environ:
        return None
    if "pyopencl" in sys.modules:
        raise RuntimeError("pyopencl has been imported already: its driver list is read only once")
    folder = Path(tempfile.mkdtemp(prefix="clsplat-drivers-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    list_drivers(folder)
    os.environ["OCL_ICD_VENDORS"] = str(folder)
    return folder


def main() -> int:
    """Print each device with its driver."""
    use_every_driver()
    import pyopencl as cl

    for platform in cl.get_platforms():
        for device in platform.get_devices():
            print(f"{platform.name} | {platform.version} | {device.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
