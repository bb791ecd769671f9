# SPDX-License-Identifier: Apache-2.0
"""Trials: the first build and the first launch of every kernel run in a sandbox process that a driver may crash.

A driver's compiler may abort or hang at the build, or, like PoCL's code generator, only at the launch. So before a
driver first gets a kernel's text and options here, another process builds the kernel, and launches it on zero-filled
arrays of the same sizes. The outcome is recorded (`driver_records`), and the trial is not repeated with that driver.
"""

from __future__ import annotations

import atexit
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

    def ask(self, message: dict[str, Any]) -> tuple[dict[str, Any], str, bool]:
        """The answer, a text on how the process ended (empty if it has not), and True if the driver crashed it.

        A crash counts only if a second try crashes too, as the driver's linker may have been killed the first time.
        Raises TrialInterrupted, and DriverError if the process cannot be started.
        """
        answer, ending, crashed = self._once(message)
        return (answer, ending, crashed) if not crashed or answer.get("hung") else self._once(message)

    def _once(self, message: dict[str, Any]) -> tuple[dict[str, Any], str, bool]:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            try:
                with ending_at_once():
                    answer, ending, crashed = self._asked(message)
            except BaseException:
                self._end()
                raise
            if ending:
                self._end()
            else:
                self._timer = threading.Timer(SANDBOX_IDLE_SECONDS, self.close)
                self._timer.daemon = True
                self._timer.start()
            return answer, ending, crashed

    def _asked(self, message: dict[str, Any]) -> tuple[dict[str, Any], str, bool]:
        if self._child is None:
            self._child = WorkerProcess(python_module("clsplat.device.sandbox_worker", str(self._index)))
        seconds = driver_timeout()
        self._child.send({**message, "seconds": seconds})
        try:
            answer = self._child.receive(seconds)
        except TimeoutError as error:
            return {"hung": True}, str(error), True
        if answer is not None:
            return answer, "", False
        return {"memory": self._child.killed}, self._child.ending(), self._child.crashed

    def close(self) -> None:
        """End the process; the next request starts another."""
        with self._lock:
            self._end()

    def end(self) -> None:
        """End the process together with this one, without waiting for a trial."""
        if (child := self._child) is not None:
            child.abandon()
        if self._lock.acquire(timeout=1.0):
            self._end()
            self._lock.release()

    def _end(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


_processes: dict[int, _Process] = {}


def _process(index: int) -> _Process:
    if index not in _processes:
        _processes[index] = _Process(index)
        atexit.register(_processes[index].end)
    return _processes[index]


class KernelTrials:
    """The kernels that a driver has been seen to build and launch, in one kernel shape, LANESxITEMS.

    In a worker process that tests a driver, like `clsplat.selftest.worker`, no sandbox is used. There `done` holds the
    names of the kernels that were built and launched, each with the salt of `Variant.anew` that its text needed. `say`,
    if set, is called with the name of each kernel before its first use.
    """

    def __init__(self, device: cl.Device, index: int, shape: str) -> None:
        self._device, self._index, self._shape = device, index, shape
        self.done: dict[str, str] = {}
        self._failed: dict[str, str] = {}
        self.say: Callable[[str], None] | None = None

    def build(self, variant: Variant) -> Variant:
        """Check that the kernel file can be built, and return the text to build. Raises DriverError."""
        if regardless():
            self._begin(f"{variant.stem}.cl", variant.digest)
            return variant
        if variant.digest not in self._known:
            self._ask({"build": asdict(variant)}, variant, "", variant.digest)
        return variant.anew(self._known[variant.digest])

    def launch(
        self,
        kernel: Kernel,
        size: tuple[int, ...],
        local: tuple[int, ...] | None,
        arguments: Sequence[Any],
        form: str = "",
    ) -> None:
        """Check that the kernel can be launched in this form (`launch.form_of`). Raises DriverError."""
        name = f"{kernel.variant.digest} {kernel.name}{form}"
        if regardless():
            self._begin(f"{kernel.variant.stem}.cl, {kernel.name}", name)
        elif name not in self._known:
            given = [_described(argument) for argument in arguments]
            if sum(value for kind, value in given if kind == "buffer") <= MAX_TRIAL_BYTES:
                launch = {"kernel": kernel.name, "size": _few(size, local), "local": local, "arguments": given}
                text = asdict(kernel.variant.anew(self._known.get(kernel.variant.digest, "")))
                self._ask({"build": text, "launch": launch}, kernel.variant, kernel.name, name)

    def built(self, variant: Variant, salt: str) -> None:
        """Record the salt that this process's own build of the text needed."""
        if variant.digest in self.done:
            self.done[variant.digest] = salt

    def _begin(self, what: str, name: str) -> None:
        self.done.setdefault(name, "")
        if self.say is not None:
            self.say(what)

    def fail(
        self,
        variant: Variant,
        kernel: str,
        trouble: str,
        *,
        lasting: bool = True,
        trial: Mapping[str, Any] | None = None,
    ) -> DriverError:
        """The error to raise for a failure.

        lasting: also record that the driver cannot be used in this shape.
        trial: the failed trial (`driver_records.Entry`), if there was one.
        """
        text = f"{variant.stem}.cl{f', {kernel},' if kernel else ''} {trouble}"
        advice = f"CLSPLAT_DEVICE takes another device, {TRUST_DRIVER_VARIABLE}=1 goes on regardless"
        if lasting and not regardless():
            trial = trial or {"name": f"{variant.digest} {kernel}"}
            driver_records.remember(self._device, self._shape, failed=text, trial=trial)
            advice = f"the next process takes another shape if one works; {advice}"
        return DriverError(f"{title(self._device)}, kernels in the shape {self._shape}: {text}; {advice}")

    @cached_property
    def _known(self) -> dict[str, str]:
        """Names of working builds and launches, with the salt of `Variant.anew` that each text needs."""
        return dict(driver_records.entries(self._device).get(self._shape, driver_records.Entry()).kernels)

    def _ask(self, message: dict[str, Any], variant: Variant, kernel: str, name: str) -> None:
        if name in self._failed:
            raise DriverError(self._failed[name])
        answer, ending, crashed = _process(self._index).ask(message)
        if answer.get(
            "memory"
        ):  # lack of memory is no fault of the driver, and the trial need not be repeated at every launch
            self._known[name] = ""
            driver_records.tell_once(
                f"{self._device.name.strip()}: not enough memory to try every kernel in a process of its own before it "
                "is used here"
            )
            return
        if trouble := _trouble(answer, ending):
            trial = {**message, "name": name, "build": {"stem": variant.stem, "options": variant.options}}
            error = self.fail(variant, kernel, trouble, lasting=crashed or not ending, trial=trial)
            self._failed[name] = str(error)  # so that this process does not try it again
            raise error
        self._known[name] = str(answer.get("salt", ""))
        if not answer.get("refused"):  # a launch refused with a reason is refused here as well
            driver_records.remember(self._device, self._shape, kernels={name: self._known[name]})


def again(index: int, trial: Mapping[str, Any]) -> str:
    """Repeat a failed trial (`driver_records.Entry.trial`) on the `index`-th device.

    Returns the failure in words, or an empty string. A record that clsplat did not write may raise any exception.
    """
    given = trial["build"]
    variant = Variant(given["stem"], text_of(given["stem"]), tuple(given["options"]))
    message = {"build": asdict(variant), **{key: trial[key] for key in ("launch",) if key in trial}}
    answer, ending, _ = _process(index).ask(message)
    return "not enough memory to try it" if answer.get("memory") else _trouble(answer, ending)


def _trouble(answer: Mapping[str, Any], ending: str) -> str:
    return f"the process that tried it {ending}" if ending else str(answer.get("trouble", ""))


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
