# SPDX-License-Identifier: Apache-2.0
"""Trust in a driver: the self-test in a process of its own, which a driver may take down, and the memory of what has
passed it.

What is remembered counts for one device, driver, kernel shape and set of kernels; `clsplat selftest` asks nothing of
it: it tests, and forgets a failure where the test passes.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field

from clsplat.device import known, rehearsal
from clsplat.device.child import REGARDLESS, Child, patience, python_module, regardless
from clsplat.device.context import Device, all_devices
from clsplat.device.quirks import title
from clsplat.device.shapes import Shape, failures, instead, shapes_in_turn, wanted_shape
from clsplat.errors import DeviceError, DriverError
from clsplat.selftest.result import FORWARD, STAGES, TRAINING, Result


@dataclass
class Report:
    """The test of a device. digests: of what each stage made, by "scene/stage"; build_seconds: None where the kernels
    were not built first; end: the end of the process before its work was done, in words, or empty; crashed: True if
    that was the driver's doing; hung: True if it did not come back; kernels: those that were built and launched, in the
    form of `device.rehearsal`; remembered: a failure in this shape that has not been seen to be gone, in words, or
    empty."""

    results: list[Result] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)
    build_seconds: float | None = None
    end: str = ""
    crashed: bool = False
    hung: bool = False
    wanted: tuple[str, ...] = STAGES
    kernels: dict[str, str] = field(default_factory=dict)
    remembered: str = ""

    @property
    def failure(self) -> str:
        """The reason that the driver cannot be trusted, or nothing."""
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


def examine(index: int, shape: Shape, stages: Sequence[str] = STAGES, *, quick: bool = False) -> Report:
    """Test the `index`-th device in a process of its own; stages: in the order of STAGES, FORWARD among them."""
    report = Report(wanted=tuple(stages))
    begun, seconds = "starting", patience()
    words = [str(index), shape.label, ",".join(stages), *(["quick"] if quick else [])]
    with closing(Child(python_module("clsplat.selftest.child", *words))) as child:
        try:
            while (message := child.receive(seconds)) is not None:
                begun = message.get("begins", begun)
                report.build_seconds = message.get("built", report.build_seconds)
                if "result" in message:
                    report.results.append(Result(**message["result"]))
                    report.digests = message["digests"]
                if "done" in message or "failed" in message:
                    report.kernels, report.end = message.get("done", {}), message.get("failed", "")
                    report.crashed = bool(report.end)
                    return report
            report.end, report.crashed = f"the process {child.ending(begun)}", child.crashed
        except TimeoutError as error:
            report.end, report.crashed, report.hung = f"the driver {error} from {begun}", True, True
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
    cl_device, given = device.cl_device, device.shape
    failed, wanted = failures(cl_device), wanted_shape(cl_device)
    shapes = [shape for shape in (given, *shapes_in_turn(cl_device)) if shape.label not in failed]
    # where all have failed, the reason may be gone: the one that is wanted is tried anew
    announced = False
    for shape in dict.fromkeys(shapes or [given]):
        tried = device if shape == given else device.with_shape(shape.label)
        if not _has_passed(tried, stages):
            if not announced:
                print(f"{title(cl_device)}: used for the first time, a short test of its driver", file=sys.stderr)
            announced = True
            if failure := _short_test(tried, stages):
                known.remember(cl_device, shape.label, failed=failure)
                failed[shape.label] = failure
                continue
        if shape != given:
            first = wanted if device.is_another and wanted.label in failed else given
            known.tell_once(instead(cl_device, first, shape, failed[first.label]))
        return tried
    raise DriverError(
        f"{title(cl_device)}, kernels in the shape {given.label}: {failed[given.label]}; none of "
        f"{', '.join(failed)} works; {_ADVICE}"
    )


_ADVICE = f"clsplat selftest tells more, CLSPLAT_DEVICE takes another device, {REGARDLESS}=1 goes on regardless"


def _has_passed(device: Device, stages: Sequence[str]) -> bool:
    entry = known.entries(device.cl_device).get(device.shape.label, known.Entry())
    return not entry.failed and set(stages) <= entry.stages


def _short_test(device: Device, stages: Sequence[str]) -> str:
    """The driver's abort or hang in the device's shape, in words, or nothing; what passed is remembered. Raises
    DriverError where the test itself could not be made, and DeviceError like `require`."""
    wanted = [name for name in STAGES if name in FORWARD or name in stages]
    report = examine(device.index, device.shape, wanted, quick=True)
    if report.crashed and not report.hung:  # the driver's linker may have been killed
        report = examine(device.index, device.shape, wanted, quick=True)
    if report.crashed:
        return report.end
    if report.end:
        raise DriverError(f"{title(device.cl_device)}: its test could not be made: {report.end}; {_ADVICE}")
    if report.failure:
        raise DeviceError(f"{title(device.cl_device)}: the driver {report.verdict}; {_ADVICE}")
    if report.other_bits:
        warnings.warn(f"{title(device.cl_device)}: {report.verdict}", stacklevel=2)
    known.remember(device.cl_device, device.shape.label, stages=wanted, kernels=report.kernels, failed="")
    return ""


def examine_device(index: int) -> Report:
    """`examine` the whole, in the shape that is wanted of the device. Where that passes, and with it the kernel that
    failed before, if it was one, the shape is used again."""
    device = all_devices()[index]
    shape = wanted_shape(device)
    report = examine(index, shape)
    entry = known.entries(device).get(shape.label, known.Entry())
    if entry.failed and not report.failure:
        report.remembered = _still(index, entry, report)
        if not report.remembered:
            known.remember(device, shape.label, failed="")
    return report


def _still(index: int, entry: known.Entry, report: Report) -> str:
    """The reason that a failure is not forgotten, or nothing."""
    name, build = entry.trial.get("name"), entry.trial.get("build")
    if not entry.trial or name in report.kernels:  # a stage of the test, or a kernel that it has launched
        return ""
    if build is None:
        return f"{entry.failed}; this test does not come to it"
    trouble = rehearsal.again(index, entry.trial)
    return f"{entry.failed}; tried once more: {trouble}" if trouble else ""
