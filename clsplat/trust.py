# SPDX-License-Identifier: Apache-2.0
"""Whether a driver computes what it is asked to: the self-test in a process of its own, which a driver may take down,
and the memory of what has passed it.

What is remembered counts for one device, driver, kernel shape and set of kernels; `clsplat selftest` remembers nothing
and asks nothing, it tests.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

from clsplat.device import known
from clsplat.device.child import REGARDLESS, Child, patience, python_module, regardless
from clsplat.device.context import Device, all_devices
from clsplat.device.shapes import Shape, another_shape, failures, instead, wanted_shape
from clsplat.errors import DeviceError, DriverError
from clsplat.selftest_result import FORWARD, STAGES, TRAINING, Result


@dataclass
class Report:
    """What became of a device. build_seconds: None where the kernels were not built first; end: how the process ended
    before its work was done, in words, or empty; kernels: those that were built and launched, as
    `device.rehearsal` names them."""

    results: list[Result] = field(default_factory=list)
    build_seconds: float | None = None
    end: str = ""
    wanted: tuple[str, ...] = STAGES
    kernels: list[str] = field(default_factory=list)

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
    return python_module("clsplat.selftest", *words)


def examine(index: int, shape: Shape, stages: Sequence[str] = STAGES, *, quick: bool = False) -> Report:
    """Test the `index`-th device in a process of its own; stages: in the order of STAGES, FORWARD among them."""
    report = Report(wanted=tuple(stages))
    begun, seconds = "starting", patience()
    with Child(command(index, shape, stages, quick=quick)) as child:
        try:
            while (told := child.receive(seconds)) is not None:
                begun = told.get("begins", begun)
                report.build_seconds = told.get("built", report.build_seconds)
                if "result" in told:
                    report.results.append(Result(**told["result"]))
                if "done" in told or "failed" in told:
                    report.kernels, report.end = told.get("done", []), told.get("failed", "")
                    return report
            report.end = f"the process {child.ending(begun)}"
        except TimeoutError as error:
            report.end = f"the driver {error} from {begun}"
    return report


def require(device: Device, stages: Sequence[str] = TRAINING) -> Device:
    """Test a device that is met for the first time, in about a second beside the building of its kernels, and remember
    that it passed; nothing if it is remembered, or if CLSPLAT_TRUST_DRIVER=1.

    stages: what will be used, of STAGES; what a frame needs is tested with it. Returns the device, in another shape
    of the kernels, with a warning, where its driver aborts or hangs in its own. Raises DriverError where it does so in
    every shape, and DeviceError where its numbers cannot be trusted.
    """
    if regardless():
        return device
    wanted = [name for name in STAGES if name in FORWARD or name in stages]
    name = f"{device.name}, {device.driver.split('  ')[0].strip()}"
    advice = f"clsplat selftest tells more, --device takes another device, {REGARDLESS}=1 goes on regardless"
    given, cl_device, told = device, device.cl_device, False
    while True:
        label = device.shape.label
        entry = known.entries(cl_device).get(label, known.Entry())
        if not entry.failed and set(stages) <= entry.stages:
            break
        if not entry.failed:
            if not told:
                print(f"{name}: used for the first time, a short test of its driver", file=sys.stderr)
            told = True
            report = examine(all_devices().index(cl_device), device.shape, wanted, quick=True)
            if not report.end:
                _check(report, name, advice)
                known.remember(cl_device, label, stages=wanted, kernels=dict.fromkeys(report.kernels, ""))
                break
            known.remember(cl_device, label, failed=report.end)
        other = another_shape(cl_device)
        if other is None:
            failed = failures(cl_device)
            raise DriverError(
                f"{name}, kernels in the shape {given.shape.label}: {failed[given.shape.label]}; none of "
                f"{', '.join(failed)} works; {advice}"
            )
        device = given.with_shape(lanes=other.lanes, items=other.items)
    if device is not given:
        warnings.warn(
            instead(cl_device, given.shape, device.shape, failures(cl_device)[given.shape.label]), stacklevel=2
        )
    return device


def _check(report: Report, name: str, advice: str) -> None:
    """Raise DeviceError where the driver computes wrongly; warn where its bits are others."""
    if report.failure:
        raise DeviceError(f"{name}: the driver {report.verdict}; {advice}")
    if report.other_bits:
        warnings.warn(f"{name}: {report.verdict}", stacklevel=3)


def examine_device(index: int) -> Report:
    """`examine` the whole, in the shape that is wanted of the device; what had failed and passes is used again."""
    device = all_devices()[index]
    shape = wanted_shape(device)
    report = examine(index, shape)
    if not report.end and shape.label in known.entries(device):
        known.remember(device, shape.label, failed="")
    return report
