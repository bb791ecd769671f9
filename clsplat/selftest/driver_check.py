# SPDX-License-Identifier: Apache-2.0
"""Check of a driver: the self-test, in a worker process that the driver may crash, and the driver records.

A record is keyed by device, driver version, kernel shape and kernel sources. `clsplat selftest` does not use the
records: it always tests, and deletes a recorded failure if the test passes.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field

from clsplat.device import sandbox
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers import driver_records
from clsplat.device.drivers.quirks import title
from clsplat.device.drivers.shapes import Shape, failures, instead, shapes_to_try, wanted_shape
from clsplat.device.drivers.worker_process import (
    TRUST_DRIVER_VARIABLE,
    WorkerEndedError,
    WorkerProcess,
    driver_timeout,
    python_module,
    regardless,
)
from clsplat.errors import DeviceError, DriverError
from clsplat.selftest.result import FORWARD_STAGES, SELFTEST_STAGES, TRAINING_STAGES, Result


@dataclass
class DriverReport:
    """The self-test result of a device.

    digests: digest of each stage's output, by "scene/stage".
    build_seconds: seconds to build all kernels; None if they were not built before the test.
    end: description of how the worker process ended if it did not finish its work, or empty.
    crashed: True if the driver ended the process.
    hung: True if the process did not answer in time.
    kernels: the kernels that were built and launched, named as in `device.sandbox`.
    remembered: a recorded failure in this shape that this test did not clear, or empty.
    """

    results: list[Result] = field(default_factory=list)
    digests: dict[str, str] = field(default_factory=dict)
    build_seconds: float | None = None
    end: str = ""
    crashed: bool = False
    hung: bool = False
    wanted: tuple[str, ...] = SELFTEST_STAGES
    kernels: dict[str, str] = field(default_factory=dict)
    remembered: str = ""

    @property
    def failure(self) -> str:
        """The reason why the driver cannot be trusted, or an empty string."""
        for result in self.results:
            if result.trouble:
                return f"{result.stage}: {result.trouble}"
            if not result.passed:
                most = f"where at most {result.bound:g} are expected"
                return f"{result.stage}: {result.where} is off by {result.ulp:.3g} ulp, {most}"
        return self.end

    @property
    def other_bits(self) -> list[str]:
        """Stages that passed, but with other bits than the stored digests."""
        return [result.stage for result in self.results if result.same_bits is False and result.passed]

    @property
    def verdict(self) -> str:
        """The verdict in one sentence."""
        if self.failure:
            return f"cannot be trusted: {self.failure}"
        if not self.other_bits:
            return "can be trusted"
        otherwise = [name for result in self.results for name in result.otherwise]
        names = " and ".join(otherwise)
        reason = f"this device does not follow IEEE 754 in {names}" if otherwise else "the reason is not known"
        return (
            f"can be trusted, but its bits are not those of other devices in {', '.join(self.other_bits)}: {reason}; "
            "every error is within its bound"
        )


def examine(index: int, shape: Shape, stages: Sequence[str] = SELFTEST_STAGES, *, quick: bool = False) -> DriverReport:
    """Test the `index`-th device in a worker process. stages: a part of SELFTEST_STAGES in the same order, which
    includes FORWARD_STAGES."""
    report = DriverReport(wanted=tuple(stages))
    begun, seconds = "starting", driver_timeout()
    words = [str(index), shape.label, ",".join(stages), *(["quick"] if quick else [])]
    with closing(WorkerProcess(python_module("clsplat.selftest.worker", *words))) as child:
        try:
            while True:
                message = child.receive(seconds, begun)
                begun = message.get("begins", begun)
                report.build_seconds = message.get("built", report.build_seconds)
                if "result" in message:
                    report.results.append(Result(**message["result"]))
                    report.digests = message["digests"]
                if "done" in message or "failed" in message:
                    report.kernels, report.end = message.get("done", {}), message.get("failed", "")
                    report.crashed = bool(report.end)
                    return report
        except WorkerEndedError as ended:
            report.end = f"the {'driver' if ended.hung else 'process'} {ended}"
            report.crashed, report.hung = ended.crashed, ended.hung
    return report


def require(device: Device, stages: Sequence[str] = TRAINING_STAGES) -> Device:
    """Test a device on its first use and record that it passed. It takes a second, and the time to build kernels.

    Nothing is tested if there is a record of these stages, or if CLSPLAT_TRUST_DRIVER=1.

    stages: the stages of SELFTEST_STAGES that will be used; the stages of a frame are tested in any case.
    Returns the device. If its driver crashes or hangs in the present kernel shape, it warns and returns the device in
    another shape. Raises DriverError if this happens in every shape, and DeviceError if results are wrong.
    """
    if regardless():
        return device
    cl_device, given = device.cl_device, device.shape
    entries, failed, wanted = driver_records.entries(cl_device), failures(cl_device), wanted_shape(cl_device)
    shapes = shapes_to_try(cl_device, given, failed)
    for shape in shapes:
        tried = device if shape == given else device.with_shape(shape.label)
        known = entries.get(shape.label, driver_records.Entry())
        if known.failed or not set(stages) <= known.stages:
            if shape == shapes[0]:
                print(f"{title(cl_device)}: first use, a short test of its driver", file=sys.stderr)
            if failure := _short_test(tried, stages):
                driver_records.remember(cl_device, shape.label, failed=failure)
                failed[shape.label] = failure
                continue
        if shape != given:
            first = wanted if device.is_another and wanted.label in failed else given
            driver_records.tell_once(instead(cl_device, first, shape, failed[first.label]))
        return tried
    raise DriverError(
        f"{title(cl_device)}, kernels in the shape {given.label}: {failed[given.label]}; none of "
        f"{', '.join(failed)} works; {_ADVICE}"
    )


_ADVICE = f"clsplat selftest has details, CLSPLAT_DEVICE selects another device, {TRUST_DRIVER_VARIABLE}=1 ignores this"


def _short_test(device: Device, stages: Sequence[str]) -> str:
    """Run the short test, and record the stages that passed.

    Returns a description if the driver crashed or hung in the device's shape, otherwise an empty string. Raises
    DriverError if the test could not run, and DeviceError if results are wrong.
    """
    wanted = [name for name in SELFTEST_STAGES if name in FORWARD_STAGES or name in stages]
    report = examine(device.index, device.shape, wanted, quick=True)
    if report.crashed and not report.hung:  # another program may have killed the driver's linker
        report = examine(device.index, device.shape, wanted, quick=True)
    if report.crashed:
        return report.end
    if report.end:
        raise DriverError(f"{title(device.cl_device)}: its test could not be made: {report.end}; {_ADVICE}")
    if report.failure:
        raise DeviceError(f"{title(device.cl_device)}: the driver {report.verdict}; {_ADVICE}")
    if report.other_bits:
        warnings.warn(f"{title(device.cl_device)}: {report.verdict}", stacklevel=2)
    driver_records.remember(device.cl_device, device.shape.label, stages=wanted, kernels=report.kernels, failed="")
    return ""


def examine_device(index: int) -> DriverReport:
    """Run the whole test in the device's preferred shape.

    If it passes, a recorded failure in this shape is deleted, unless the kernel that failed then fails again.
    """
    device = all_devices()[index]
    shape = wanted_shape(device)
    report = examine(index, shape)
    entry = driver_records.entry(device, shape.label)
    if entry.failed and not report.failure:
        report.remembered = _still(index, entry, report)
        if not report.remembered:
            driver_records.remember(device, shape.label, failed="")
    return report


def _still(index: int, entry: driver_records.Entry, report: DriverReport) -> str:
    """The reason why a recorded failure is kept, or an empty string."""
    name, build = entry.trial.get("name"), entry.trial.get("build")
    if not entry.trial or name in report.kernels:  # this test has covered the failure
        return ""
    if build is None:
        return f"{entry.failed}; this test does not use that kernel"
    trouble = sandbox.again(index, entry.trial)
    return f"{entry.failed}; tried once more: {trouble}" if trouble else ""
