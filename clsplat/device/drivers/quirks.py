# SPDX-License-Identifier: Apache-2.0
"""Quirks of OpenCL drivers: faults, limits, extensions and settings. Only this module recognises drivers by name.

The module is imported before pyopencl: `offer_packaged`, `make_cache_folder` and `pin_threads` set environment
variables that drivers read when they are loaded.
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

CL_DEVICE_TYPE_CPU, CL_DEVICE_TYPE_GPU = 2, 4
"""Bits of OpenCL's cl_device_type, copied because this module is imported before pyopencl."""
TARGET_VARIABLE_PREFIX = "CL_CONFIG_"
"""Prefix of the environment variables that select the processor and options for Intel's compiler."""
_ICD_FILENAMES = "OCL_ICD_FILENAMES"
_INTEL_DRIVER_PATH = Path("Library", "bin", "intelocl64.dll")
"""Path below `sys.prefix` of the driver that the package intel-opencl-rt installs."""
_POCL_CACHE = "POCL_CACHE_DIR"
_POCL_AFFINITY = "POCL_AFFINITY"
_POCL_COUNTS = ("POCL_CPU_MAX_CU_COUNT", "POCL_MAX_PTHREAD_COUNT", "POCL_MAX_COMPUTE_UNITS")
"""Environment variables that limit the number of processors used, in different versions of PoCL."""
_ICD_VENDORS = "OCL_ICD_VENDORS"
"""Environment variable that names a folder of .icd files, to be read instead of the system's."""
DRIVER_VARIABLES = (
    *(_ICD_VENDORS, _ICD_FILENAMES, _POCL_CACHE, _POCL_AFFINITY, *_POCL_COUNTS),
    *("POCL_DEVICES", "RUSTICL_ENABLE", "CUDA_VISIBLE_DEVICES"),
)
"""Environment variables of loaders and drivers that change the list of devices, or how the devices work."""
GPU_MAKERS_BY_PCI_VENDOR = {0x10DE: "NVIDIA", 0x1002: "AMD", 0x8086: "Intel"}
"""GPU makers by their PCI vendor number."""
_SUBGROUP_SIZES = (16, 32, 8)
"""Sub-group sizes to request, in the order to try, where a kernel may choose the size."""
_GPU_PACKAGES = {
    "NVIDIA": {
        "debian": "apt install nvidia-opencl-icd, in addition to the driver; in a container the host's libraries, with "
        "NVIDIA_DRIVER_CAPABILITIES=compute,utility",
        "ubuntu": "apt install nvidia-driver-NUMBER, which includes libnvidia-compute",
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
"""How to install a GPU's OpenCL driver, by the GPU's maker and the family of Linux distributions."""


def kind_of(device: cl.Device) -> str:
    """The kind of a device: cpu, gpu or other."""
    if device.type & CL_DEVICE_TYPE_GPU:
        return "gpu"
    return "cpu" if device.type & CL_DEVICE_TYPE_CPU else "other"


def title(device: cl.Device) -> str:
    """Return the names of a device and its driver, without the build options that PoCL adds after two spaces."""
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
    """Return the maximum pixels per vector in kernels that the driver can compile and run on a CPU."""
    if _is_rusticl(device):  # llvmpipe hangs in larger kernels with vectors
        return 1
    return 8 if _pocl_version(device) == (3, 0) else 16  # PoCL 3.0 aborts on some float16 built-ins


def subgroup_ways(device: cl.Device) -> list[dict[str, object]]:
    """Return sets of defines for kernels with sub-groups, in the order to try them.

    Empty if the device has no sub-groups whose size is known when a kernel is built. `Device.kernels` tests that
    work-items exchange the right values before it uses the defines.
    """
    extensions = device.extensions.split()
    if "cl_nv_device_attribute_query" in extensions:  # work-items exchange values by inline PTX
        return [{"SUBGROUP": 32, "SHUFFLE_PTX": True}]
    if "cl_amd_device_attribute_query" in extensions:  # work-items exchange values by built-in functions
        return [{"SUBGROUP": 32, "SHUFFLE_AMD": True}]
    functions = {"cl_khr_subgroup_shuffle": "SHUFFLE_KHR", "cl_intel_subgroups": "SHUFFLE_INTEL"}
    offered = [define for extension, define in functions.items() if extension in extensions]
    if "cl_intel_required_subgroup_size" not in extensions:
        return []
    return [
        {"SUBGROUP": size, define: True, "SUBGROUP_IS_ASKED": True} for define in offered for size in _SUBGROUP_SIZES
    ]


def register_limit(device: cl.Device, registers: int) -> str:
    """Build option that limits the registers per work-item; empty for a driver without such an option."""
    offered = "cl_nv_compiler_options" in device.extensions.split()
    return f"-cl-nv-maxrregcount={registers}" if offered else ""


def misnames_processors(device: cl.Device) -> bool:
    """True for PoCL 3.0, whose compiler may refuse the processor name that PoCL itself has detected."""
    return str(device.platform.version).startswith("OpenCL 3.0 PoCL 3.0")


def tells_group_sizes(device: cl.Device) -> bool:
    """False for a driver that reports a wrong group-size limit for kernels.

    Rusticl of Mesa 22.3 reports a limit of 32 for every kernel, but runs groups of 1024.
    """
    return not _is_rusticl(device)


def caches_programs(device: cl.Device) -> bool:
    """True for a driver that caches its builds on disk, so that a second build takes almost no time."""
    return _pocl_version(device) is not None


def compiles_by_size(device: cl.Device) -> bool:
    """True for a driver that compiles a kernel again for each group size, and for launches of at least 65,536 items."""
    return _pocl_version(device) is not None


def wants_cache(device: cl.Device) -> bool:
    """True for Intel's CPU runtime, which needs `binary_cache`: it builds everything again in each process.

    Other drivers have their own cache, or have not been tried.
    """
    return kind_of(device) == "cpu" and str(device.platform.name).strip() == "Intel(R) OpenCL"


def build_advice(log: str) -> str:
    """Return advice for the user after a failed build of a kernel, from the compiler's log."""
    if "unknown target CPU" in log:
        return "this driver is older than the processor: use another driver, such as your distribution's PoCL"
    return "CLSPLAT_DEBUG=1 shows the log and the source"


def driver_advice(system: str | None = None, machine: str | None = None) -> str:
    """Return advice on the driver to install: a line of text without a full stop.

    system, machine: as `platform.system` and `platform.machine` return them; None means this computer.
    """
    system, machine = system or platform.system(), (machine or platform.machine()).lower()
    pc = machine in ("x86_64", "amd64")
    if system == "Darwin":
        return "use conda-forge's packages, with a driver for the CPU: conda install pyopencl pocl (docs/drivers.md)"
    if system == "Windows" and pc:
        cpu = ", or one for the CPU: pip install intel-opencl-rt (registered by an administrator: docs/drivers.md)"
    elif system == "Windows":
        cpu = ""
    elif system == "Linux" and pc:
        cpu = ", or one for the CPU: pip install 'pyopencl[pocl]'"
    else:
        cpu = ", or one for the CPU: your distribution's PoCL, such as apt install pocl-opencl-icd"
    return f"install your GPU's driver{cpu}"


def gpu_advice(maker: str, families: Sequence[str]) -> str:
    """Return advice on the OpenCL driver to install for a maker's GPU.

    families: names of this Linux distribution and of those it is based on; empty on other systems.
    """
    if not families:
        return f"install {maker}'s own graphics driver, which includes OpenCL"
    packages = _GPU_PACKAGES.get(maker, {})
    return next((packages[name] for name in families if name in packages), f"install {maker}'s OpenCL driver")


def of_maker(platform_name: str, device_name: str, maker: str) -> bool:
    """True if the platform's or the device's name shows that an OpenCL GPU is from this maker."""
    names = f"{platform_name} {device_name}".lower()
    return any(word in names for word in {"AMD": ("amd", "radeon", "gfx")}.get(maker, (maker.lower(),)))


def driver_files(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """Return the paths of all .icd files. Each contains the name of a driver's library.

    The files are in the folder that OCL_ICD_VENDORS names, or without this variable in /etc/OpenCL/vendors, and in
    pyopencl's own folder of libraries.
    """
    folders = [Path(environment.get(_ICD_VENDORS) or "/etc/OpenCL/vendors")]
    spec = importlib.util.find_spec("pyopencl")
    folders += [Path(place) / ".libs" for place in (spec.submodule_search_locations or ())] if spec else []
    return [path for folder in folders for path in ([folder] if folder.is_file() else sorted(folder.glob("*.icd")))]


def no_device() -> DeviceError:
    """Return the error to raise if OpenCL lists no device."""
    return DeviceError(f"no OpenCL device found: {driver_advice()}")


def offer_packaged(
    *,
    windows: bool = os.name == "nt",
    prefix: str = sys.prefix,
    environment: MutableMapping[str, str] = os.environ,
) -> None:
    """Set OCL_ICD_FILENAMES so that, on Windows, OpenCL's loader finds the Intel CPU driver that pip has installed.

    Otherwise the loader only finds drivers in the registry, which pip does not write. In a process with administrator
    rights the loader ignores the variable. A variable that is already set is kept. On Linux the loader itself finds the
    PoCL that pip has installed; macOS has no loader.

    prefix: folder of the Python installation. environment: environment variables to change.
    """
    driver = Path(prefix) / _INTEL_DRIVER_PATH
    if windows and _ICD_FILENAMES not in environment and driver.is_file():
        environment[_ICD_FILENAMES] = str(driver)


def make_cache_folder(environment: MutableMapping[str, str] = os.environ) -> Path | None:
    """Make a cache folder for PoCL in this process and its children, if PoCL cannot make one in the home folder.

    Without a cache folder PoCL shows no device, as if it were not installed. Returns the folder, which is removed when
    this process ends; None if no folder is needed or none can be made.
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
        if os.getpid() == owner:  # a fork of this process must not remove the folder
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    environment[_POCL_CACHE] = folder
    return Path(folder)


def pin_threads(environment: MutableMapping[str, str] = os.environ) -> None:
    """Pin PoCL's thread number n to processor number n, in this process and its children.

    Otherwise two threads that wake up together may share a processor for whole kernels, while another is idle. Nothing
    is pinned if this process or PoCL is limited to some processors, because two processes of one thread each would then
    share the first processor. If POCL_AFFINITY is already set, it is kept.
    """
    if sys.platform != "linux" or any(name in environment for name in (_POCL_AFFINITY, *_POCL_COUNTS)):
        return
    if os.sched_getaffinity(0) == set(range(os.cpu_count() or 0)):
        environment[_POCL_AFFINITY] = "1"


def _can_be_made(folder: Path) -> bool:
    """True if the folder exists or can be made, and is writable."""
    for place in (folder, *folder.parents):
        if os.path.lexists(place):
            return place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    return False
