# SPDX-License-Identifier: Apache-2.0
"""Differences between drivers. This is the one module that knows drivers by their names.

It is imported before pyopencl: what `offer_packaged`, `make_cache_folder` and `pin_threads` put into the environment is
read as a driver is loaded.
"""

from __future__ import annotations

import atexit
import importlib.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from clsplat.errors import DeviceError

if TYPE_CHECKING:
    import pyopencl as cl

CPU, GPU = 2, 4
"""Bits of a device's type: CL_DEVICE_TYPE_CPU and CL_DEVICE_TYPE_GPU."""
TARGET = "CL_CONFIG_"
"""Variables that begin so tell Intel's runtime which processor to build for, and how."""
_ICD_FILENAMES = "OCL_ICD_FILENAMES"
_INTEL = Path("Library", "bin", "intelocl64.dll")
"""Path of intel-opencl-rt's driver, below `sys.prefix`, with the libraries that it needs beside it."""
_POCL_CACHE = "POCL_CACHE_DIR"
_POCL_PINNED = "POCL_AFFINITY"
_POCL_COUNTS = ("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "POCL_MAX_COMPUTE_UNITS")
"""Variables, by version, that have PoCL use fewer processors than there are."""
_VENDORS = "OCL_ICD_VENDORS"
"""Variable for another folder of drivers than the system's."""
VARIABLES = (
    *(_VENDORS, _ICD_FILENAMES, _POCL_CACHE, _POCL_PINNED, *_POCL_COUNTS),
    *("POCL_DEVICES", "RUSTICL_ENABLE", "CUDA_VISIBLE_DEVICES"),
)
"""Variables of loaders and drivers that change which devices there are, or how they work."""
MAKERS = {0x10DE: "NVIDIA", 0x1002: "AMD", 0x8086: "Intel"}
"""Makers of GPUs by their number on the PCI bus."""
_SUBGROUP_SIZES = (16, 32, 8)
"""Items of a sub-group where the kernel may choose, the first to try first."""
_GPU_PACKAGES = {
    "NVIDIA": {
        "debian": "apt install nvidia-opencl-icd, beside the driver; in a container the host's libraries, with "
        "NVIDIA_DRIVER_CAPABILITIES=compute,utility",
        "ubuntu": "apt install nvidia-driver-NUMBER, which brings libnvidia-compute",
        "fedora": "dnf install xorg-x11-drv-nvidia-cuda (RPM Fusion)",
        "arch": "pacman -S opencl-nvidia",
    },
    "AMD": {
        "debian": "AMD's rocm-opencl-runtime, or apt install mesa-opencl-icd and set RUSTICL_ENABLE=radeonsi",
        "fedora": "dnf install rocm-opencl, or mesa-libOpenCL and set RUSTICL_ENABLE=radeonsi",
        "arch": "pacman -S rocm-opencl-runtime",
    },
    "Intel": {
        "debian": "apt install intel-opencl-icd",
        "fedora": "dnf install intel-compute-runtime",
        "arch": "pacman -S intel-compute-runtime",
    },
}
"""Packages with a GPU's OpenCL driver, by maker and family of Linux."""


def kind_of(device: cl.Device) -> str:
    """cpu, gpu or other."""
    if device.type & GPU:
        return "gpu"
    return "cpu" if device.type & CPU else "other"


def title(device: cl.Device) -> str:
    """A device and its driver for a line of text: PoCL lists its build options after two spaces."""
    return f"{device.name.strip()}, {device.platform.version.split('  ')[0].strip()}"


def _pocl_version(device: cl.Device) -> tuple[int, int] | None:
    words = device.platform.version.split()
    if "PoCL" not in words:
        return None
    digits = words[words.index("PoCL") + 1].split("-")[0].split("+")[0].split(".")
    return int(digits[0]), int(digits[1])


def _is_rusticl(device: cl.Device) -> bool:
    return str(device.platform.name).strip() == "rusticl"


def most_lanes(device: cl.Device) -> int:
    """Pixels in the longest vectors that the driver's compiler can take, of a CPU."""
    if _is_rusticl(device):  # with vectors llvmpipe does not come back from the larger kernels
        return 1
    return 8 if _pocl_version(device) == (3, 0) else 16  # PoCL 3.0 aborts on some float16 built-ins


def subgroup_ways(device: cl.Device) -> list[dict[str, object]]:
    """Defines for kernels with sub-groups, the first to try first; none where a device offers no sub-groups of a size
    that is known when a kernel is built. What they exchange is probed before it is used (`Device.kernels`)."""
    extensions = device.extensions.split()
    if "cl_nv_device_attribute_query" in extensions:  # by inline PTX, as NVIDIA's OpenCL has no such functions
        return [{"SUBGROUP": 32, "SHUFFLE_PTX": True}]
    if "cl_amd_device_attribute_query" in extensions:  # by the compiler's own functions
        return [{"SUBGROUP": 32, "SHUFFLE_AMD": True}]
    functions = {"cl_khr_subgroup_shuffle": "SHUFFLE_KHR", "cl_intel_subgroups": "SHUFFLE_INTEL"}
    offered = [define for extension, define in functions.items() if extension in extensions]
    if "cl_intel_required_subgroup_size" not in extensions:
        return []
    return [
        {"SUBGROUP": size, define: True, "SUBGROUP_IS_ASKED": True} for define in offered for size in _SUBGROUP_SIZES
    ]


def misnames_processors(device: cl.Device) -> bool:
    """True for PoCL 3.0, whose compiler may not know the name that it gives to the processor."""
    return str(device.platform.version).startswith("OpenCL 3.0 PoCL 3.0")


def tells_group_sizes(device: cl.Device) -> bool:
    """False for a driver that is wrong about the work-items that it allows a group of a kernel: Rusticl of Mesa 22.3
    says 32 of every kernel, and runs groups of 1024."""
    return not _is_rusticl(device)


def caches_programs(device: cl.Device) -> bool:
    """True for a driver that keeps what it builds on the disk, so that a second build takes no time."""
    return _pocl_version(device) is not None


def compiles_by_size(device: cl.Device) -> bool:
    """True for a driver that compiles a kernel anew for a group of another size, and for launches from 65,536 items."""
    return _pocl_version(device) is not None


def wants_cache(device: cl.Device) -> bool:
    """True for a driver that is known to build everything anew in each process, and to load its binaries again:
    Intel's runtime for CPUs. Other drivers have a cache of their own, or have not been tried."""
    return kind_of(device) == "cpu" and str(device.platform.name).strip() == "Intel(R) OpenCL"


def build_advice(log: str) -> str:
    """Advice on a build that failed with this log."""
    if "unknown target CPU" in log:
        return "this driver is older than the processor: take another one, such as your distribution's PoCL"
    return "CLSPLAT_DEBUG=1 shows the log and the source"


def driver_advice(system: str | None = None, machine: str | None = None) -> str:
    """Advice on which driver to install, in a line without a full stop.

    system, machine: as `platform.system` and `platform.machine` give them; this one's unless given.
    """
    system, machine = system or platform.system(), (machine or platform.machine()).lower()
    pc = machine in ("x86_64", "amd64")
    if system == "Darwin":
        return "take conda-forge's packages, with a driver for the CPU: conda install pyopencl pocl (see README)"
    if system == "Windows" and pc:
        cpu = ", or one for the CPU: pip install intel-opencl-rt (an administrator has to register it, see README)"
    elif system == "Windows":
        cpu = ""
    elif system == "Linux" and pc:
        cpu = ", or one for the CPU: pip install 'pyopencl[pocl]'"
    else:
        cpu = ", or one for the CPU: your distribution's PoCL, such as apt install pocl-opencl-icd"
    return f"install your GPU's driver{cpu}"


def gpu_advice(maker: str, families: Sequence[str]) -> str:
    """Advice on the OpenCL driver of a maker's GPU. families: this Linux and those that it is like, empty elsewhere."""
    if not families:
        return f"install {maker}'s own graphics driver, which has OpenCL in it"
    packages = _GPU_PACKAGES.get(maker, {})
    return next((packages[name] for name in families if name in packages), f"install {maker}'s OpenCL driver")


def of_maker(platform_name: str, device_name: str, maker: str) -> bool:
    """True if an OpenCL GPU is one of this maker's: its driver's name or its own says so."""
    names = f"{platform_name} {device_name}".lower()
    return any(word in names for word in {"AMD": ("amd", "radeon", "gfx")}.get(maker, (maker.lower(),)))


def driver_files(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """The .icd files, each of which names a driver's library in a line: of the system's folder or the one that is given
    in its place, and of packages of Python."""
    folders = [Path(environment.get(_VENDORS) or "/etc/OpenCL/vendors")]
    spec = importlib.util.find_spec("pyopencl")
    folders += [Path(place) / ".libs" for place in (spec.submodule_search_locations or ())] if spec else []
    return [path for folder in folders for path in ([folder] if folder.is_file() else sorted(folder.glob("*.icd")))]


def no_device() -> DeviceError:
    """The error that there is no device at all."""
    return DeviceError(f"no OpenCL device found: {driver_advice()}")


def offer_packaged(
    *,
    windows: bool = os.name == "nt",
    prefix: str = sys.prefix,
    environment: MutableMapping[str, str] = os.environ,
) -> None:
    """Tell OpenCL's loader, in this process and its children, of Intel's driver for CPUs that pip has installed.

    On Windows the loader reads the registry, which pip does not write, and OCL_ICD_FILENAMES, which it passes over in a
    process with an administrator's rights. A variable that is set is left as it is. On Linux PyPI's PoCL is found by
    itself; macOS has no loader.
    """
    driver = Path(prefix) / _INTEL
    if windows and _ICD_FILENAMES not in environment and driver.is_file():
        environment[_ICD_FILENAMES] = str(driver)


def make_cache_folder(environment: MutableMapping[str, str] = os.environ) -> Path | None:
    """Give PoCL a folder for this process and its children, where it could not make its own below the home.

    PoCL shows no device at all then, as if it were not installed. Returns the folder, which goes when this process
    ends; None where nothing had to be done, or could be.
    """
    if os.name == "nt" or environment.get(_POCL_CACHE):
        return None
    home = environment.get("HOME")
    base = environment.get("XDG_CACHE_HOME") or (f"{home}/.cache" if home else "")
    if not base or _can_be_made(Path(base) / "pocl" / "kcache"):
        return None
    try:
        folder = tempfile.mkdtemp(prefix="clsplat-pocl-")
    except OSError:
        return None
    owner = os.getpid()

    def remove() -> None:
        if os.getpid() == owner:  # and not a fork of it
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    environment[_POCL_CACHE] = folder
    return Path(folder)


def pin_threads(environment: MutableMapping[str, str] = os.environ) -> None:
    """Have each thread of PoCL keep to the processor of its number, in this process and its children.

    Else two threads that wake up together are on one processor for whole kernels while another idles. Not where the
    process may use only some processors, or PoCL is told to use fewer: two processes of one thread each would share the
    first. A variable that is set is left as it is.
    """
    if sys.platform != "linux" or any(name in environment for name in (_POCL_PINNED, *_POCL_COUNTS)):
        return
    if os.sched_getaffinity(0) == set(range(os.cpu_count() or 0)):
        environment[_POCL_PINNED] = "1"


def _can_be_made(folder: Path) -> bool:
    """True if files can be put there, once folders that are missing are made."""
    for place in (folder, *folder.parents):
        if os.path.lexists(place):
            return place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    return False
