# SPDX-License-Identifier: Apache-2.0
"""Whether a driver computes what it is asked to: the self-test in a process of its own, which a driver may take down,
and the memory of what has passed it.

What is remembered counts for one device, driver, kernel shape and set of kernels; `clsplat selftest` remembers nothing
and asks nothing, it tests.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from clsplat.device.context import Device, all_devices
from clsplat.device.program import BREAK
from clsplat.device.shapes import Shape, saved_path, shape_of
from clsplat.device.source import kernel_root, kernel_source
from clsplat.errors import DeviceError
from clsplat.files import atomic_write, parse_json
from clsplat.selftest_result import FORWARD, MARK, STAGES, TRAINING, Result

PATIENCE = 300.0
"""Seconds without a word after which a driver counts as hung: the slowest that works builds a kernel in 60."""
REGARDLESS = "CLSPLAT_TRUST_DRIVER"


@dataclass
class Report:
    """What became of a device. build_seconds: None where the kernels were not built first; end: how the process ended
    before its work was done, in words, or empty."""

    results: list[Result] = field(default_factory=list)
    build_seconds: float | None = None
    end: str = ""
    wanted: tuple[str, ...] = STAGES

    @property
    def failure(self) -> str:
        """Why the driver cannot be trusted, or nothing."""
        for result in self.results:
            if result.trouble:
                return f"{result.stage}: {result.trouble}"
            if not result.passed:
                most = f"where at most {result.bound:g} are expected"
                return f"{result.stage}: {result.where} is off by {result.ulp:.3g} ulp, {most}"
        return self.end

    @property
    def other_bits(self) -> list[str]:
        """Stages that are right, with other bits than the stored ones."""
        return [result.stage for result in self.results if result.same_bits is False and result.passed]

    @property
    def verdict(self) -> str:
        """One sentence."""
        if self.failure:
            return f"cannot be trusted: {self.failure}"
        if not self.other_bits:
            return "can be trusted"
        otherwise = [name for result in self.results for name in result.otherwise]
        names = " and ".join(otherwise)
        reason = f"this device treats {names} otherwise than IEEE 754" if otherwise else "the reason is not known"
        return (
            f"can be trusted, but its bits are not those of other devices in {', '.join(self.other_bits)}: {reason}; "
            "every error is within its bound"
        )


def command(index: int, shape: Shape, stages: Sequence[str], *, quick: bool) -> list[str]:
    """The child."""
    words = [str(index), str(shape.lanes), str(shape.items), ",".join(stages), *(["quick"] if quick else [])]
    return [sys.executable, "-m", "clsplat.selftest", *words]


def examine(
    index: int, shape: Shape, stages: Sequence[str] = STAGES, *, quick: bool = False, patience: float = PATIENCE
) -> Report:
    """Test the `index`-th device in a process of its own; stages: in the order of STAGES, FORWARD among them."""
    report = Report(wanted=tuple(stages))
    environment = {**os.environ, "PYTHONPATH": _with_this_package()}
    with subprocess.Popen(
        command(index, shape, stages, quick=quick),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
    ) as child:
        try:
            _follow(child, report, patience)
        except BaseException:
            child.kill()
            raise
    return report


def _with_this_package() -> str:
    root = str(Path(__file__).resolve().parents[1])
    return os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH", "")) if part)


def _follow(child: subprocess.Popen[str], report: Report, patience: float) -> None:
    lines: queue.Queue[str | None] = queue.Queue()
    errors: list[str] = []

    def read(stream: IO[str]) -> None:
        for line in stream:
            lines.put(line)
        lines.put(None)

    assert child.stdout is not None
    assert child.stderr is not None
    stderr = child.stderr
    threads = [
        threading.Thread(target=read, args=(child.stdout,), daemon=True),
        threading.Thread(target=lambda: errors.extend(stderr), daemon=True),
    ]
    for thread in threads:
        thread.start()
    begun = "starting"
    while True:
        try:
            line = lines.get(timeout=patience)
        except queue.Empty:
            child.kill()
            report.end = f"the driver did not come back within {patience:g} s from {begun}"
            return
        if line is None:
            break
        if not line.startswith(MARK):
            continue
        told: dict[str, Any] = json.loads(line[len(MARK) :])
        begun = told.get("begins", begun)
        report.build_seconds = told.get("built", report.build_seconds)
        if "result" in told:
            report.results.append(Result(**told["result"]))
        if "done" in told:
            child.wait()
            return
    status = child.wait()
    threads[1].join(timeout=5)
    last = next((line.strip() for line in reversed(errors) if line.strip()), "")
    how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
    report.end = f"the process {how} in {begun}" + (f" ({last[:300]})" if last else "")


def memory_path() -> Path:
    """Where it is kept what passed."""
    return saved_path().with_name("trusted.json")


def _remembered() -> dict[str, list[str]]:
    """By device, driver, shape and kernels: the stages that passed. What is none of ours counts as not there."""
    try:
        saved = parse_json(memory_path().read_bytes())
    except (OSError, ValueError):
        return {}
    entries = saved.items() if isinstance(saved, dict) else ()
    return {key: names for key, names in entries if isinstance(names, list) and set(map(type, names)) <= {str}}


def _key(device: Any, shape: Shape) -> str:
    """All that the answer hangs on."""
    from clsplat import __version__

    texts = "".join(kernel_source(path.stem) for path in sorted(kernel_root().glob("*.cl")))
    kernels = zlib.crc32((texts + os.environ.get(BREAK, "")).encode())
    driver = f"{device.platform.version.strip()} | {device.driver_version.strip()}"
    return f"{device.name.strip()} | {driver} | {shape.lanes}x{shape.items} | clsplat {__version__} {kernels:08x}"


def require(device: Device, stages: Sequence[str] = TRAINING) -> None:
    """Test a device that is met for the first time, in about a second beside the building of its kernels, and remember
    that it passed; nothing if it is remembered, or if CLSPLAT_TRUST_DRIVER=1.

    stages: what will be used, of STAGES; what a frame needs is tested with it. Raises DeviceError where the driver
    cannot be trusted.
    """
    if os.environ.get(REGARDLESS, "") not in ("", "0"):
        return
    key, remembered = _key(device.cl_device, device.shape), _remembered()
    known = set(remembered.get(key, ()))
    if set(stages) <= known:
        return
    wanted = [name for name in STAGES if name in FORWARD or name in stages]
    name = f"{device.name}, {device.driver.split('  ')[0].strip()}"
    print(f"{name}: used for the first time, a short test of its driver", file=sys.stderr)
    report = examine(all_devices().index(device.cl_device), device.shape, wanted, quick=True)
    if report.failure:
        raise DeviceError(
            f"{name}: the driver {report.verdict}; clsplat selftest tells more, --device takes another device, "
            f"{REGARDLESS}=1 goes on regardless"
        )
    if report.other_bits:
        warnings.warn(f"{name}: {report.verdict}", stacklevel=2)
    remembered[key] = [name for name in STAGES if name in known or name in wanted]
    try:
        memory_path().parent.mkdir(parents=True, exist_ok=True)
        atomic_write(memory_path(), (json.dumps(remembered, indent=2, sort_keys=True) + "\n").encode())
    except OSError as error:
        warnings.warn(
            f"{memory_path()}: cannot be written ({error.strerror}), the test is made each time", stacklevel=2
        )


def examine_device(index: int, *, patience: float = PATIENCE) -> Report:
    """`examine` the whole, in the shape that the device gets."""
    return examine(index, shape_of(all_devices()[index]), patience=patience)
