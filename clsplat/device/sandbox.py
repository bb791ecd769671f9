# SPDX-License-Identifier: Apache-2.0
"""Trials of kernels: the first build and the first launch of each kernel run in a sandbox process.

A driver's compiler may abort or hang when it builds a kernel, or, like PoCL's code generator, at the launch. So a
kernel is first built in another process, and launched there on zero-filled arrays of the same sizes. The outcome is
recorded (`driver_records`), so that the trial is not repeated with the same driver. A driver that does not answer for
`worker_process.driver_timeout` seconds has failed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from typing import Any

import numpy as np
import pyopencl as cl

from clsplat.device.drivers import driver_records
from clsplat.device.drivers.quirks import title
from clsplat.device.drivers.worker_process import (
    TRUST_DRIVER_VARIABLE,
    WorkerEndedError,
    WorkerProcess,
    driver_timeout,
    ending_at_once,
    python_module,
    regardless,
)
from clsplat.device.program import Kernel, Variant, text_of
from clsplat.errors import DriverError

SANDBOX_IDLE_SECONDS = 20.0
"""Seconds after which an idle sandbox process is ended, as it occupies device memory. The next one starts in 0.5 s."""
MAX_TRIAL_BYTES = 2 << 30
"""Maximum bytes of a launch's arrays for which the launch is tried. With larger arrays the kernel is only built, as
memory may not suffice for the arrays in both processes."""
MAX_TRIAL_ITEMS = 1 << 17
"""Maximum work-items along each axis of a trial launch. Such a launch takes almost no time. PoCL compiles the same code
for larger launches, but other code for fewer than 65,536 items."""


class _Process:
    """The sandbox process of a device, which is started when needed and ended when idle."""

    def __init__(self, index: int) -> None:
        self._index = index
        self._lock = threading.Lock()
        self._child: WorkerProcess | None = None
        self._timer: threading.Timer | None = None

    def ask(self, trial: Mapping[str, Any]) -> dict[str, Any]:
        """Run a trial and return its outcome, as `sandbox_worker` sends it.

        If the process ends without an answer, `lasting` in the outcome is True if the driver is the cause. After a
        crash the trial is repeated once, as another program may have killed the driver's linker.
        Raises TrialInterrupted, and DriverError if the process cannot be started.
        """
        try:
            try:
                return self._once(trial)
            except WorkerEndedError as ended:
                if ended.hung or not ended.crashed:
                    raise
                return self._once(trial)
        except WorkerEndedError as ended:
            trouble = f"fails its trial: the sandbox process {ended}"
            return {"memory": ended.killed, "trouble": trouble, "lasting": ended.crashed}

    def _once(self, trial: Mapping[str, Any]) -> dict[str, Any]:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            try:
                with ending_at_once():
                    if self._child is None:
                        self._child = WorkerProcess(python_module("clsplat.device.sandbox_worker", str(self._index)))
                    seconds = driver_timeout()
                    self._child.send({**trial, "seconds": seconds})
                    answer = self._child.receive(seconds)
            except BaseException:
                self._end()
                raise
            self._timer = threading.Timer(SANDBOX_IDLE_SECONDS, self.close)
            self._timer.daemon = True
            self._timer.start()
            return answer

    def close(self) -> None:
        """End the process; the next request starts another."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


_processes: dict[int, _Process] = {}


def _process(index: int) -> _Process:
    return _processes.setdefault(index, _Process(index))


class KernelTrials:
    """The trials of a driver in one kernel shape, and the names of the builds and launches that passed.

    A worker process that tests a driver, such as `clsplat.selftest.worker`, uses no sandbox. Such a process may set
    `say`, a function that is called with the name of each kernel before the kernel's first use.
    """

    def __init__(self, device: cl.Device, index: int, shape: str) -> None:
        self._device, self._index, self._shape = device, index, shape
        self._failed: dict[str, str] = {}
        self.say: Callable[[str], None] | None = None

    @cached_property
    def known(self) -> dict[str, str]:
        """Names of the builds and launches that passed, each with the salt (`Variant.anew`) of the build, usually "".

        In a worker process that tests a driver: names of the builds and launches that have begun.
        """
        return {} if regardless() else dict(driver_records.entry(self._device, self._shape).kernels)

    def build(self, variant: Variant) -> Variant:
        """Try the build of a kernel file. Return the variant that this process should build. Raises DriverError."""
        self._try(variant, "", variant.digest)
        return variant.anew(self.known[variant.digest])

    def launch(
        self,
        kernel: Kernel,
        size: tuple[int, ...],
        local: tuple[int, ...] | None,
        arguments: Sequence[Any],
        form: str = "",
    ) -> None:
        """Try a launch of the kernel with arguments of these sizes and values. Raises DriverError.

        size, local: as for `Device.enqueue`.
        form: the kind of launch, a suffix from `launch.form_of`.
        """
        given = [_described(argument) for argument in arguments]
        if regardless() or sum(value for kind, value in given if kind == "buffer") <= MAX_TRIAL_BYTES:
            launch = {"kernel": kernel.name, "size": _few(size, local), "local": local, "arguments": given}
            self._try(kernel.variant, kernel.name, f"{kernel.variant.digest} {kernel.name}{form}", {"launch": launch})

    def built(self, variant: Variant, salt: str) -> None:
        """Note the salt (`Variant.anew`) that the build of `variant` in this process needed, usually ""."""
        self.known[variant.digest] = salt or self.known[variant.digest]

    def _try(self, variant: Variant, kernel: str, name: str, asked: Mapping[str, Any] = {}) -> None:
        """Try a build, or the launch that `asked` describes, in the sandbox. Do nothing if it has passed before.

        kernel: name of the launched kernel; "" for a build.
        name: name of the build or launch in the driver record.
        """
        if regardless():
            self.known.setdefault(name, "")
            if self.say is not None:
                self.say(f"{variant.stem}.cl{kernel and f', {kernel}'}")
            return
        if name in self.known:
            return
        if name in self._failed:
            raise DriverError(self._failed[name])
        text = variant.anew(self.known.get(variant.digest, ""))
        answer = _process(self._index).ask({"build": asdict(text), **asked})
        if answer.get("memory"):  # the driver has not failed, so this process goes on as if the trial had passed
            driver_records.tell_once(
                f"{self._device.name.strip()}: not enough memory to try every kernel in a separate process before its "
                "first use, so kernels are used without this trial"
            )
        elif trouble := answer.get("trouble"):
            trial = {**asked, "name": name, "build": {"stem": variant.stem, "options": variant.options}}
            error = self.fail(variant, kernel, trouble, trial, lasting=answer.get("lasting", True))
            self._failed[name] = str(error)  # the error is kept, so that this process does not repeat the trial
            raise error
        self.known[name] = str(answer.get("salt", ""))
        if "salt" in answer:  # without a salt, the compiler has refused the text, and this process will report that
            driver_records.remember(self._device, self._shape, kernels={name: self.known[name]})

    def fail(
        self,
        variant: Variant,
        kernel: str,
        trouble: str,
        trial: Mapping[str, Any] | None = None,
        *,
        lasting: bool = True,
    ) -> DriverError:
        """Return the error to raise if the driver fails in a kernel file or in a kernel.

        trouble: the failure, as a predicate of a sentence.
        trial: the failed trial (`driver_records.Entry`), if there was one.
        lasting: True also records the failure, so that the driver is not used in this shape again.
        """
        advice = f"CLSPLAT_DEVICE selects another device; {TRUST_DRIVER_VARIABLE}=1 skips this test"
        if lasting and not regardless():
            trial = trial or {"name": f"{variant.digest} {kernel}"}
            driver_records.remember(self._device, self._shape, failed=_text(variant, kernel, trouble), trial=trial)
            advice = f"the next process uses another kernel shape if one works; {advice}"
        return self.error(variant, kernel, f"{trouble}; {advice}")

    def error(self, variant: Variant, kernel: str, trouble: str) -> DriverError:
        """Return the error to raise for `trouble`, a predicate of a sentence about a kernel file or a kernel in it."""
        text = _text(variant, kernel, trouble)
        return DriverError(f"{title(self._device)}, kernels in the shape {self._shape}: {text}")


def _text(variant: Variant, kernel: str, trouble: str) -> str:
    return f"{variant.stem}.cl{f', {kernel},' if kernel else ''} {trouble}"


def again(index: int, trial: Mapping[str, Any]) -> str:
    """Repeat a failed trial (`driver_records.Entry.trial`) on the `index`-th device.

    Returns the failure as a predicate of a sentence, or "" if the trial passes. Any exception may be raised for a
    `trial` that clsplat has not recorded.
    """
    build = trial["build"]
    variant = Variant(build["stem"], text_of(build["stem"]), tuple(build["options"]))
    answer = _process(index).ask({**trial, "build": asdict(variant)})
    return "not enough memory to try it" if answer.get("memory") else str(answer.get("trouble", ""))


def _few(size: tuple[int, ...], local: tuple[int, ...] | None) -> list[int]:
    """Limit the work-items `size` of a launch along each axis to MAX_TRIAL_ITEMS, in whole groups of `local`."""
    groups = local or tuple(1 for _ in size)
    return [min(n, max(MAX_TRIAL_ITEMS // group, 1) * group) for n, group in zip(size, groups, strict=True)]


def _described(argument: Any) -> tuple[str, Any]:
    """Encode a launch argument for JSON: "buffer" or "local" and its bytes, or a scalar's dtype and value."""
    if isinstance(argument, cl.LocalMemory):
        return "local", argument.size
    if isinstance(argument, cl.MemoryObject):
        return "buffer", argument.size
    value = np.asarray(argument)
    return value.dtype.str, value.item()
