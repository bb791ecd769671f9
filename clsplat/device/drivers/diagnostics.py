# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of an installation: GPUs of the machine, driver files and devices, with advice on missing parts.

Each check that loads a driver runs in a process of its own, because the driver may crash this process.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from clsplat.device.drivers.quirks import GPU_MAKERS_BY_PCI_VENDOR, driver_advice, driver_files, gpu_advice, of_maker
from clsplat.device.drivers.worker_process import driver_timeout, python_module

_PCI_DISPLAY_CLASS = "0x03"
"""First digits of the PCI class code of display controllers."""
_LOAD_LIBRARY_CODE = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"


def _outcome(*command: str) -> subprocess.CompletedProcess[str] | None:
    """Run a command, and return its exit status and output; None if it does not finish in time."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=driver_timeout(), check=False)
    except subprocess.TimeoutExpired:
        return None


def _last_line(result: subprocess.CompletedProcess[str]) -> str:
    """Return why a process failed: the last line of its standard error, or its exit status if there is no line."""
    line = (result.stderr.strip().splitlines() or [f"status {result.returncode}"])[-1]
    return line.removeprefix("OSError: ").removeprefix("clsplat: error: ")


@dataclass(frozen=True)
class Diagnostic:
    """A finding about a part of the installation, which `clsplat doctor` prints as a line of text.

    state: ok, note (no action needed) or missing.
    advice: an action to take, or empty.
    """

    part: str
    state: Literal["ok", "note", "missing"]
    text: str
    advice: str = ""


def families() -> list[str]:
    """Names of this Linux distribution and of those it is based on, from os-release; empty on other systems."""
    if platform.system() != "Linux":
        return []
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return ["unknown"]
    return [release.get("ID", "unknown"), *release.get("ID_LIKE", "").split()]


def gpus(bus: Path = Path("/sys/bus/pci/devices")) -> list[str]:
    """Return the makers of this machine's GPUs, such as NVIDIA, each once; empty on systems other than Linux."""
    makers = []
    for folder in sorted(bus.glob("*")):
        try:
            kind, number = ((folder / name).read_text(encoding="utf-8").strip() for name in ("class", "vendor"))
        except OSError:
            continue
        if kind.startswith(_PCI_DISPLAY_CLASS) and (maker := GPU_MAKERS_BY_PCI_VENDOR.get(int(number, 16))):
            makers.append(maker)
    return list(dict.fromkeys(makers))


def driver_findings(files: Iterable[Path]) -> list[Diagnostic]:
    """Return a finding for each .icd file, which says whether the driver library that it names can be loaded."""
    return [_driver(path) for path in files]


def _driver(path: Path) -> Diagnostic:
    try:
        library = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        return Diagnostic("driver", "note", f"{path}: cannot be read ({error})")
    name = str(path.parent / library) if (path.parent / library).is_file() else library
    result = _outcome(sys.executable, "-c", _LOAD_LIBRARY_CODE, name)
    if result is None:
        return Diagnostic("driver", "note", f"{path}: {library} hangs when it is loaded", f"remove {path}")
    if result.returncode == 0:
        return Diagnostic("driver", "ok", f"{path}: {library}")
    text = f"{path}: {library} cannot be loaded: {_last_line(result)}"
    return Diagnostic("driver", "note", text, f"install it again, or remove {path}")


def listed_devices() -> tuple[list[dict[str, Any]], str]:
    """Return the devices that `clsplat devices --json` lists, and why the command failed; "" if it has not failed."""
    result = _outcome(*python_module("clsplat", "devices", "--json"))
    if result is None:
        return [], f"a driver does not answer within {driver_timeout():g} s"
    if result.returncode == 0:
        return json.loads(result.stdout[result.stdout.index("[") :]), ""
    if result.returncode < 0:
        return [], f"a driver crashed (signal {-result.returncode})"
    return [], _last_line(result)


def device_findings(devices: Sequence[dict[str, Any]], trouble: str) -> list[Diagnostic]:
    """Return a finding for each device. If there is none or they could not be listed, return one finding with advice.

    devices, trouble: the results of `listed_devices`.
    """
    if trouble or not devices:
        return [Diagnostic("device", "missing", trouble or "no OpenCL device found", driver_advice())]
    return [
        Diagnostic("device", "ok", f"{info['index']}: {info['name']}, {info['version'].split('  ')[0]}")
        for info in devices
    ]


def list_findings(devices: Sequence[dict[str, Any]]) -> list[Diagnostic]:
    """Return a finding for each device whose kernels have several work-items in a group. It says whether training lists
    each tile's Gaussians by append or by radix sort.

    devices: as from `listed_devices`.
    """
    findings = []
    for info in devices:
        if " x 1 items" in info["shape"]:
            continue
        result, name = _outcome(*python_module("clsplat.stages.probe_atomics", str(info["index"]))), info["name"]
        if result is None:
            fault = f"the probe of integer atomics does not finish within {driver_timeout():g} s"
        else:
            fault = result.stdout if result.returncode == 0 else f"the probe fails: {_last_line(result)}"
        way = f"by radix sort, because {fault}" if fault else "by append"
        text = f"{info['index']}: training on {name} lists each tile's Gaussians {way}"
        findings.append(Diagnostic("lists", "note" if fault else "ok", text))
    return findings


def gpu_findings(makers: Sequence[str], devices: Sequence[dict[str, Any]]) -> list[Diagnostic]:
    """Return a finding for each GPU maker in `makers`, which says whether `devices` has a GPU of this maker.

    devices: as from `listed_devices`.
    """
    findings = []
    for maker in makers:
        shown = any(info["kind"] == "gpu" and of_maker(info["platform"], info["name"], maker) for info in devices)
        advice = "" if shown else gpu_advice(maker, families())
        text = "shown by OpenCL" if shown else "in this machine, but no OpenCL driver shows it"
        findings.append(Diagnostic("GPU", "ok" if shown else "note", f"{maker}: {text}", advice))
    return findings


def access_findings(nodes: Sequence[Path] | None = None) -> list[Diagnostic]:
    """Return a finding for each of the GPU device nodes (by default all, on Linux) that this user may not open."""
    if nodes is None:
        nodes = [*Path("/dev/dri").glob("renderD*"), *(path for path in (Path("/dev/kfd"),) if path.exists())]
    closed = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    advice = "add the user to the group render, and log in again"
    return [Diagnostic("GPU", "note", f"{node}: may not be opened by this user", advice) for node in closed]


def loader_finding() -> Diagnostic:
    """Return a finding that says whether pyopencl, which contains OpenCL's driver loader, can be imported."""
    result = _outcome(sys.executable, "-c", "import pyopencl; print(pyopencl.VERSION_TEXT)")
    if result is None:
        text = f"the import of pyopencl does not finish within {driver_timeout():g} s"
        return Diagnostic("loader", "missing", text)
    if result.returncode == 0:
        return Diagnostic("loader", "ok", f"pyopencl {result.stdout.strip()}")
    text = f"pyopencl cannot be imported: {_last_line(result)}"
    return Diagnostic("loader", "missing", text, "pip install --force-reinstall pyopencl")


def findings() -> list[Diagnostic]:
    """All findings about the installation, in the order in which they are printed."""
    loader = loader_finding()
    devices, trouble = listed_devices() if loader.state == "ok" else ([], "devices cannot be listed without pyopencl")
    return [
        loader,
        *driver_findings(driver_files()),
        *device_findings(devices, trouble),
        *list_findings(devices),
        *gpu_findings(gpus(), devices),
        *access_findings(),
    ]
