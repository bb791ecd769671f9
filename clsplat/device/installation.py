# SPDX-License-Identifier: Apache-2.0
"""Findings about an installation: GPUs of the machine, drivers' files, devices, and what to do where one is missing.

It asks processes of their own, as a driver may take one down when it is only loaded.
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

from clsplat.device.child import patience, python_module
from clsplat.device.quirks import MAKERS, driver_advice, driver_files, gpu_advice, of_maker

_DISPLAY = "0x03"
"""Beginning of the class of a display controller on the PCI bus."""
_LOAD = "import ctypes, sys; ctypes.CDLL(sys.argv[1])"


def _last_line(result: subprocess.CompletedProcess[str]) -> str:
    """The reason that a process failed: the last line of its errors, or its status."""
    line = (result.stderr.strip().splitlines() or [f"status {result.returncode}"])[-1]
    return line.removeprefix("OSError: ").removeprefix("clsplat: error: ")


@dataclass(frozen=True)
class Finding:
    """A line about a part of the installation. state: ok, note (nothing has to be done) or missing; advice: what to do,
    or empty."""

    part: str
    state: Literal["ok", "note", "missing"]
    text: str
    advice: str = ""


def families() -> list[str]:
    """This Linux and those that it is like, as os-release names them; empty on other systems."""
    if platform.system() != "Linux":
        return []
    try:
        release = platform.freedesktop_os_release()
    except OSError:
        return ["unknown"]
    return [release.get("ID", "unknown"), *release.get("ID_LIKE", "").split()]


def gpus(bus: Path = Path("/sys/bus/pci/devices")) -> list[str]:
    """The makers of this machine's GPUs, each once; empty where the system does not list its PCI bus as Linux does."""
    makers = []
    for folder in sorted(bus.glob("*")):
        try:
            kind, number = ((folder / name).read_text(encoding="utf-8").strip() for name in ("class", "vendor"))
        except OSError:
            continue
        if kind.startswith(_DISPLAY) and (maker := MAKERS.get(int(number, 16))):
            makers.append(maker)
    return list(dict.fromkeys(makers))


def driver_findings(files: Iterable[Path]) -> list[Finding]:
    """A line for each .icd file: whether its library can be loaded."""
    return [_driver(path) for path in files]


def _driver(path: Path) -> Finding:
    try:
        library = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        return Finding("driver", "note", f"{path}: cannot be read ({error})")
    name = str(path.parent / library) if (path.parent / library).is_file() else library
    try:
        result = subprocess.run(
            [sys.executable, "-c", _LOAD, name], capture_output=True, text=True, timeout=patience(), check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("driver", "note", f"{path}: {library} does not come back from being loaded", f"remove {path}")
    if result.returncode == 0:
        return Finding("driver", "ok", f"{path}: {library}")
    text = f"{path}: {library} cannot be loaded: {_last_line(result)}"
    return Finding("driver", "note", text, f"install it again, or remove {path}")


def listed_devices() -> tuple[list[dict[str, Any]], str]:
    """The devices as `clsplat devices --json` lists them, and why it could not, or nothing."""
    command = [*python_module("clsplat", "devices", "--json")]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=patience(), check=False)
    except subprocess.TimeoutExpired:
        return [], f"a driver does not come back within {patience():g} s"
    if result.returncode == 0:
        return json.loads(result.stdout[result.stdout.index("[") :]), ""
    if result.returncode < 0:
        return [], f"a driver took the process down (signal {-result.returncode})"
    return [], _last_line(result)


def device_findings(devices: Sequence[dict[str, Any]], trouble: str) -> list[Finding]:
    """A line for each device, or that there is none."""
    if trouble or not devices:
        return [Finding("device", "missing", trouble or "no OpenCL device found", driver_advice())]
    return [
        Finding("device", "ok", f"{info['index']}: {info['name']}, {info['version'].split('  ')[0]}")
        for info in devices
    ]


def gpu_findings(makers: Sequence[str], devices: Sequence[dict[str, Any]]) -> list[Finding]:
    """A line for each maker of a GPU in this machine: whether OpenCL shows a GPU of that maker."""
    findings = []
    for maker in makers:
        shown = any(info["kind"] == "gpu" and of_maker(info["platform"], info["name"], maker) for info in devices)
        advice = "" if shown else gpu_advice(maker, families())
        text = "shown by OpenCL" if shown else "in this machine, and no OpenCL driver shows it"
        findings.append(Finding("GPU", "ok" if shown else "note", f"{maker}: {text}", advice))
    return findings


def access_findings(nodes: Sequence[Path] | None = None) -> list[Finding]:
    """A line for each node of a GPU that this user may not open, on Linux."""
    if nodes is None:
        nodes = [*Path("/dev/dri").glob("renderD*"), *(path for path in (Path("/dev/kfd"),) if path.exists())]
    closed = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    advice = "add the user to the group render, and log in again"
    return [Finding("GPU", "note", f"{node}: may not be opened by this user", advice) for node in closed]


def loader_finding() -> Finding:
    """A line about pyopencl, with the loader of drivers that it brings: whether it can be imported."""
    code = "import pyopencl; print(pyopencl.VERSION_TEXT)"
    try:
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=patience(), check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("loader", "missing", f"pyopencl does not come back from its import within {patience():g} s")
    if result.returncode == 0:
        return Finding("loader", "ok", f"pyopencl {result.stdout.strip()}")
    text = f"pyopencl cannot be imported: {_last_line(result)}"
    return Finding("loader", "missing", text, "pip install --force-reinstall pyopencl")


def findings() -> list[Finding]:
    """All of them."""
    loader = loader_finding()
    devices, trouble = listed_devices() if loader.state == "ok" else ([], "pyopencl is needed to find one")
    return [
        loader,
        *driver_findings(driver_files()),
        *device_findings(devices, trouble),
        *gpu_findings(gpus(), devices),
        *access_findings(),
    ]
