# SPDX-License-Identifier: Apache-2.0
"""Trials: the first build and the first launch of every kernel run in a sandbox process that a driver may crash.

A driver's compiler may abort or hang at the build, or, like PoCL's code generator, only at the launch. So before a
driver first gets a kernel's text and options here, another process builds the kernel, and launches it on zero-filled
arrays of the same sizes. The outcome is recorded (`driver_records`), and the trial is not repeated with that driver.
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
"""Seconds after which the idle process is ended, as it occupies device memory, and needs only 0.5 s to start again."""
MAX_TRIAL_BYTES = 2 << 30
"""Bytes of a launch's arrays beyond which the kernel is only built: the memory may not hold them twice."""
MAX_TRIAL_ITEMS = 1 << 17
"""The most work-items of a trial's launch along each axis. PoCL compiles the same code for any larger number, and other
code for less than 65,536. This many take almost no time."""


class _Process:
    """The sandbox process of one device, started when needed and ended when idle."""

    def __init__(self, index: int) -> None:
        self._index = index
        self._lock = threading.Lock()
        self._child: WorkerProcess | None = None
        self._timer: threading.Timer | None = None

    def ask(self, trial: Mapping[str, Any]) -> dict[str, Any]:
        """The outcome of a trial, a message of `sandbox_worker`. `lasting` is False if it says nothing of the driver.

        A crash counts only if a second try crashes too, as the driver's linker may have been killed the first time.
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
            return {"memory": ended.killed, "trouble": f"the process that tried it {ended}", "lasting": ended.crashed}

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
    """The kernels that a driver has been seen to build and launch, in one kernel shape, LANESxITEMS.

    In a worker process that tests a driver, like `clsplat.selftest.worker`, no sandbox is used. `say`, if set, is
    called there with the name of each kernel before its first use.
    """

    def __init__(self, device: cl.Device, index: int, shape: str) -> None:
        self._device, self._index, self._shape = device, index, shape
        self._failed: dict[str, str] = {}
        self.say: Callable[[str], None] | None = None

    @cached_property
    def known(self) -> dict[str, str]:
        """Names of working builds and launches, with the salt of `Variant.anew` that each text needs.

        In a worker process: names of the builds and launches that it has begun.
        """
        return {} if regardless() else dict(driver_records.entry(self._device, self._shape).kernels)

    def build(self, variant: Variant) -> Variant:
        """Check that the kernel file can be built, and return the text to build. Raises DriverError."""
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
        """Check that the kernel can be launched in this form (`launch.form_of`). Raises DriverError."""
        given = [_described(argument) for argument in arguments]
        if regardless() or sum(value for kind, value in given if kind == "buffer") <= MAX_TRIAL_BYTES:
            launch = {"kernel": kernel.name, "size": _few(size, local), "local": local, "arguments": given}
            self._try(kernel.variant, kernel.name, f"{kernel.variant.digest} {kernel.name}{form}", {"launch": launch})

    def built(self, variant: Variant, salt: str) -> None:
        """Note the salt that this process's own build of the text needed."""
        self.known[variant.digest] = salt or self.known[variant.digest]

    def _try(self, variant: Variant, kernel: str, name: str, asked: Mapping[str, Any] = {}) -> None:
        """Try a build, or the launch in `asked`, in the sandbox, unless the driver's record has its name."""
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
        if answer.get("memory"):  # no fault of the driver, and the trial need not be repeated at every launch
            driver_records.tell_once(
                f"{self._device.name.strip()}: not enough memory to try every kernel in a process of its own before it "
                "is used here"
            )
        elif trouble := answer.get("trouble"):
            trial = {**asked, "name": name, "build": {"stem": variant.stem, "options": variant.options}}
            error = self.fail(variant, kernel, trouble, trial, lasting=answer.get("lasting", True))
            self._failed[name] = str(error)  # so that this process does not try it again
            raise error
        self.known[name] = str(answer.get("salt", ""))
        if "salt" in answer:  # a launch refused with a reason is refused here as well
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
        """The error to raise for a failure.

        trial: the failed trial (`driver_records.Entry`), if there was one.
        lasting: also record that the driver cannot be used in this shape.
        """
        advice = f"CLSPLAT_DEVICE takes another device, {TRUST_DRIVER_VARIABLE}=1 goes on regardless"
        if lasting and not regardless():
            trial = trial or {"name": f"{variant.digest} {kernel}"}
            driver_records.remember(self._device, self._shape, failed=_text(variant, kernel, trouble), trial=trial)
            advice = f"the next process takes another shape if one works; {advice}"
        return self.error(variant, kernel, f"{trouble}; {advice}")

    def error(self, variant: Variant, kernel: str, trouble: str) -> DriverError:
        """The error to raise for trouble with a kernel file, or with a kernel in it."""
        text = _text(variant, kernel, trouble)
        return DriverError(f"{title(self._device)}, kernels in the shape {self._shape}: {text}")


def _text(variant: Variant, kernel: str, trouble: str) -> str:
    return f"{variant.stem}.cl{f', {kernel},' if kernel else ''} {trouble}"


def again(index: int, trial: Mapping[str, Any]) -> str:
    """Repeat a failed trial (`driver_records.Entry.trial`) on the `index`-th device.

    Returns the failure in words, or an empty string. A record that clsplat did not write may raise any exception.
    """
    build = trial["build"]
    variant = Variant(build["stem"], text_of(build["stem"]), tuple(build["options"]))
    answer = _process(index).ask({**trial, "build": asdict(variant)})
    return "not enough memory to try it" if answer.get("memory") else str(answer.get("trouble", ""))


def _few(size: tuple[int, ...], local: tuple[int, ...] | None) -> list[int]:
    """The size of the launch along each axis, at most MAX_TRIAL_ITEMS, in whole groups."""
    groups = local or tuple(1 for _ in size)
    return [min(n, max(MAX_TRIAL_ITEMS // group, 1) * group) for n, group in zip(size, groups, strict=True)]


def _described(argument: Any) -> tuple[str, Any]:
    """A launch argument as JSON: its kind, and its bytes or value."""
    if isinstance(argument, cl.LocalMemory):
        return "local", argument.size
    if isinstance(argument, cl.MemoryObject):
        return "buffer", argument.size
    value = np.asarray(argument)
    return value.dtype.str, value.item()
