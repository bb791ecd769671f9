# SPDX-License-Identifier: Apache-2.0
"""Every OpenCL driver of this machine at once: the ones installed system-wide and those from PyPI, and Debian's PoCL
where it is unpacked beside the system and CLSPLAT_DEBIAN_POCL names its libpocl.so.

The PoCL that `pyopencl[pocl]` brings loads by itself, wherever OCL_ICD_VENDORS points. Any other driver needs an
.icd file in the one folder that OCL_ICD_VENDORS names, read when pyopencl is first imported. Intel's CPU runtime
from PyPI does bring .icd files, but they name a path that does not exist.

As a script, prints the devices that are found.
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
"""Drivers that a package on PyPI puts under sys.prefix/lib."""


def list_drivers(folder: Path) -> list[str]:
    """Write an .icd file for each driver into folder (made if missing); returns their names."""
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
    """Point OCL_ICD_VENDORS at a temporary folder with every driver; call it before pyopencl is imported.

    Returns the folder, which goes when the process ends; None where the variable was set already, which is left
    as it is, so that a run can be narrowed down to one driver. Raises RuntimeError where it is too late.
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
