# SPDX-License-Identifier: Apache-2.0
"""Findings about an installation, on machines that are made up of a few files."""

from __future__ import annotations

from pathlib import Path

import pytest

from clsplat.device.context import Device
from clsplat.device.drivers import diagnostics
from clsplat.device.drivers.diagnostics import (
    access_findings,
    device_findings,
    driver_findings,
    gpu_findings,
    gpus,
    list_findings,
    loader_finding,
)
from clsplat.device.drivers.quirks import driver_files, gpu_advice

NVIDIA, AMD, INTEL = "0x10de", "0x1002", "0x8086"


def card(bus: Path, name: str, vendor: str, kind: str = "0x030000") -> None:
    (bus / name).mkdir(parents=True)
    (bus / name / "vendor").write_text(f"{vendor}\n")
    (bus / name / "class").write_text(f"{kind}\n")


def shown(platform: str, name: str, kind: str = "gpu") -> dict[str, object]:
    return {"index": 0, "platform": platform, "name": name, "version": "OpenCL 3.0", "kind": kind}


def test_gpus_are_read_from_the_bus(tmp_path: Path) -> None:
    card(tmp_path, "0000:00:02.0", INTEL)
    card(tmp_path, "0000:00:1f.0", INTEL, kind="0x060100")  # a bridge
    card(tmp_path, "0000:01:00.0", NVIDIA, kind="0x030200")
    card(tmp_path, "0000:02:00.0", NVIDIA)
    card(tmp_path, "0000:03:00.0", "0x1a03")  # a server's console
    (tmp_path / "0000:04:00.0").mkdir()
    assert gpus(tmp_path) == ["Intel", "NVIDIA"]
    assert gpus(tmp_path / "none") == []


@pytest.mark.parametrize(
    ("maker", "platform", "name"),
    [
        ("NVIDIA", "NVIDIA CUDA", "NVIDIA GeForce RTX 4090"),
        ("AMD", "AMD Accelerated Parallel Processing", "gfx1100"),
        ("AMD", "rusticl", "AMD Radeon RX 7900 XTX (radeonsi)"),
        ("Intel", "Intel(R) OpenCL Graphics", "Intel(R) Arc(TM) A770"),
    ],
)
def test_a_gpu_that_opencl_shows(maker: str, platform: str, name: str) -> None:
    (finding,) = gpu_findings([maker], [shown(platform, name)])
    assert (finding.state, finding.advice) == ("ok", "")


@pytest.mark.parametrize("device", [None, shown("Intel(R) OpenCL", "Intel(R) Xeon(R)", kind="cpu")])
def test_a_gpu_without_a_driver_has_advice_for_this_system(
    monkeypatch: pytest.MonkeyPatch, device: dict[str, object] | None
) -> None:
    monkeypatch.setattr(diagnostics, "families", lambda: ["ubuntu", "debian"])
    (finding,) = gpu_findings(["Intel"], [device] if device else [])
    assert finding.state == "note"
    assert finding.text == "Intel: in this machine, but no OpenCL driver shows it"
    assert finding.advice == "apt install intel-opencl-icd"


def test_advice_by_system() -> None:
    assert gpu_advice("NVIDIA", ["ubuntu", "debian"]).startswith("apt install nvidia-driver-")
    assert gpu_advice("NVIDIA", ["debian"]).startswith("apt install nvidia-opencl-icd")
    assert gpu_advice("AMD", ["cachyos", "arch"]) == "pacman -S rocm-opencl-runtime"
    assert gpu_advice("AMD", ["void"]) == "install AMD's OpenCL driver"
    assert gpu_advice("AMD", []) == "install AMD's own graphics driver, which includes OpenCL"


def test_drivers_that_cannot_be_loaded_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.icd").write_text("/no/such/libdriver.so\n")
    (tmp_path / "b.icd").write_bytes(b"\xff\xfe")
    (tmp_path / "c.icd").write_text("libc.so.6\n")
    findings = driver_findings(driver_files({"OCL_ICD_VENDORS": str(tmp_path)})[:3])
    assert [finding.state for finding in findings] == ["note", "note", "ok"]
    assert (
        "a.icd: /no/such/libdriver.so cannot be loaded: /no/such/libdriver.so: cannot open shared" in findings[0].text
    )
    assert findings[0].advice == f"install it again, or remove {tmp_path / 'a.icd'}"
    assert "b.icd: cannot be read" in findings[1].text


def test_a_loader_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pyopencl.py").write_text("import time; time.sleep(60)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("CLSPLAT_DRIVER_TIMEOUT", "0.5")
    finding = loader_finding()
    assert (finding.state, finding.text) == ("missing", "the import of pyopencl does not finish within 0.5 s")


def test_no_device_and_trouble_are_missing() -> None:
    (none,) = device_findings([], "")
    (aborted,) = device_findings([], "a driver crashed (signal 6)")
    assert (none.state, none.text) == ("missing", "no OpenCL device found")
    assert (aborted.state, aborted.text) == ("missing", "a driver crashed (signal 6)")
    assert none.advice
    assert aborted.advice


def test_how_lists_are_made(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of devices with groups of items; the driver's probe is in a process of its own."""
    listed = {"index": default_device.index, "name": "a device", "shape": "1 lanes x 64 items"}
    monkeypatch.setenv("CLSPLAT_SHAPE", "1x64")
    (finding,) = list_findings([{**listed, "shape": "8 lanes x 1 items"}, listed])
    lists = f"{default_device.index}: training on a device lists each tile's Gaussians"
    assert (finding.state, finding.text) == ("ok", f"{lists} by append")
    monkeypatch.setenv("CLSPLAT_PRETEND", "no-atomics")
    (finding,) = list_findings([listed])
    assert finding.state == "note"
    assert finding.text == f"{lists} by radix sort, because it has no 32-bit integer atomics"
    (finding,) = list_findings([{**listed, "index": 999}])
    assert "by radix sort, because the probe fails: " in finding.text
    monkeypatch.setenv("CLSPLAT_DRIVER_TIMEOUT", "0.01")
    (finding,) = list_findings([listed])
    assert finding.text.endswith("does not finish within 0.01 s")


def test_a_node_that_may_not_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = tmp_path / "renderD128"
    node.touch()
    assert access_findings([node]) == []
    monkeypatch.setattr(diagnostics.os, "access", lambda *_: False)
    (finding,) = access_findings([node])
    assert finding.text == f"{node}: may not be opened by this user"
