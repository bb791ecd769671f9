# SPDX-License-Identifier: Apache-2.0
"""Check if a driver can be trusted: run the self-test in a worker process, which the driver may crash, and record
passes and failures.

A driver record is keyed by device, driver version, kernel shape and kernel sources. `clsplat selftest` always tests,
whatever the records say. If it passes, a recorded failure is deleted (`examine_device`).
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
    """The self-test's results for a device.

    digests: digests of the stages' results, by "scene/stage".
    build_seconds: seconds to build all kernels; None if they were not built before the test.
    end: description of how the worker process ended, if it did not finish its work; otherwise empty.
    crashed: True if the driver ended the process, did not answer in time (`hung`), or failed with an error.
    wanted: names of the stages that were to be tested.
    kernels: names of the builds and launches of the test, each with the salt of its build (`KernelTrials.known`).
    remembered: a recorded failure in this kernel shape that this test did not clear, or empty.
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
        """Names of the stages that passed, but whose bits differ from the stored digests."""
        return [result.stage for result in self.results if result.same_bits is False and result.passed]

    @property
    def verdict(self) -> str:
        """The verdict as a predicate, such as "can be trusted", for a sentence that begins with "the driver"."""
        if self.failure:
            return f"cannot be trusted: {self.failure}"
        if not self.other_bits:
            return "can be trusted"
        otherwise = [name for result in self.results for name in result.otherwise]
        names = " and ".join(otherwise)
        reason = f"this device does not follow IEEE 754 in {names}" if otherwise else "the reason is not known"
        return (
            f"can be trusted, but its results of {', '.join(self.other_bits)} are not bit for bit those of other "
            f"devices: {reason}; every error is within its bound"
        )


def examine(index: int, shape: Shape, stages: Sequence[str] = SELFTEST_STAGES, *, quick: bool = False) -> DriverReport:
    """Test the `index`-th device in a worker process, in the kernel shape `shape`.

    stages: some of SELFTEST_STAGES in their order, and among them all FORWARD_STAGES.
    quick: use only the two smaller frozen scenes, and build only the kernels that the stages use.
    """
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
    """Test a device at its first use, and record that it passed. Returns the device.

    The test takes a second, and the time to build kernels. Nothing is tested if a record says that the stages have
    passed, or if CLSPLAT_TRUST_DRIVER=1.

    stages: the stages of SELFTEST_STAGES that will be used. FORWARD_STAGES are always tested too.
    If the driver crashes or hangs in the device's kernel shape, a warning is given, and the result is the device in
    another shape.
    Raises DriverError if the driver crashes or hangs in every shape, and DeviceError if results are wrong.
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
                print(f"{title(cl_device)}: testing its driver briefly before its first use", file=sys.stderr)
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
        f"the kernel shapes {', '.join(failed)} works; {_ADVICE}"
    )


_ADVICE = (
    f"clsplat selftest has details; CLSPLAT_DEVICE selects another device; {TRUST_DRIVER_VARIABLE}=1 skips the test"
)


def _short_test(device: Device, stages: Sequence[str]) -> str:
    """Test the stages on the smaller frozen scenes, and record the stages that passed.

    Returns a description of the crash if the driver crashed or hung in the device's shape, otherwise an empty string.
    Raises DriverError if the test could not run, and DeviceError if results are wrong.
    """
    wanted = [name for name in SELFTEST_STAGES if name in FORWARD_STAGES or name in stages]
    report = examine(device.index, device.shape, wanted, quick=True)
    if report.crashed and not report.hung:  # try again: another program may have killed the driver's linker
        report = examine(device.index, device.shape, wanted, quick=True)
    if report.crashed:
        return report.end
    if report.end:
        raise DriverError(f"{title(device.cl_device)}: its driver could not be tested: {report.end}; {_ADVICE}")
    if report.failure:
        raise DeviceError(f"{title(device.cl_device)}: the driver {report.verdict}; {_ADVICE}")
    if report.other_bits:
        warnings.warn(f"{title(device.cl_device)}: {report.verdict}", stacklevel=2)
    driver_records.remember(device.cl_device, device.shape.label, stages=wanted, kernels=report.kernels, failed="")
    return ""


def examine_device(index: int) -> DriverReport:
    """Run the whole self-test on the `index`-th device, in the kernel shape that is preferred for it.

    If the test passes, a recorded failure in this shape is deleted, unless the kernel that had failed fails again.
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
    """Return why a recorded failure is kept although the self-test passed, or an empty string if it is cleared.

    entry: the record of the failure. report: the result of the self-test on the device number `index`.
    """
    name, build = entry.trial.get("name"), entry.trial.get("build")
    if not entry.trial or name in report.kernels:  # the self-test has launched the kernel that had failed
        return ""
    if build is None:
        return f"{entry.failed}; this test does not use that kernel"
    trouble = sandbox.again(index, entry.trial)
    return f"{entry.failed}; tried once more: {trouble}" if trouble else ""
