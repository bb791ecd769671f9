# SPDX-License-Identifier: Apache-2.0
"""Main module of the sandbox process, which builds and launches kernels for trial. A crash of the driver ends this
process, and not the process that wants the kernels.

Limits of a trial's memory and items: `device/sandbox.py`.
"""

from __future__ import annotations

import faulthandler
import json
import sys
from typing import Any

import numpy as np
import pyopencl as cl

from clsplat.device.context import all_devices
from clsplat.device.drivers.quirks import caches_programs
from clsplat.device.drivers.worker_process import tell
from clsplat.device.program import Variant, build, kernels_of
from clsplat.errors import DriverError, KernelBuildError


def _given(context: cl.Context, queue: cl.CommandQueue, kind: str, value: Any) -> Any:
    """Make the kernel argument that `sandbox._described` encoded as `kind` and `value`. Buffers are filled with 0."""
    if kind == "local":
        return cl.LocalMemory(value)
    if kind != "buffer":
        return np.dtype(kind).type(value)
    buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, value)
    cl.enqueue_fill_buffer(queue, buffer, np.uint8(0), 0, value)
    return buffer


class _TrialDevice:
    """The device on which the worker tries kernels, with a queue and the kernels built so far."""

    def __init__(self, device: cl.Device) -> None:
        self._device, self._context = device, cl.Context([device])
        self._queue = cl.CommandQueue(self._context)
        self._kernels: dict[str, dict[str, Any]] = {}

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        """Build the kernel file that a message names, and launch a kernel if the message asks for it.

        Returns the answer to `sandbox.KernelTrials`: the build's `salt`, or the reason why the trial failed.
        """
        text = message["build"]
        variant = Variant(text["stem"], text["source"], tuple(text["options"]))
        try:
            salt = ""
            if variant.digest not in self._kernels:
                program, salt = build(self._context, self._device, variant)
                self._kernels[variant.digest] = kernels_of(program)
                if caches_programs(self._device) and build(self._context, self._device, variant.anew(salt))[1]:
                    return {"trouble": "has no kernels after it was loaded from the driver's cache"}
            if "launch" in message:
                self._launch(self._kernels[variant.digest], message["launch"])
        except (MemoryError, cl.MemoryError):
            return {"memory": True}
        except KernelBuildError as error:
            return {"refused": str(error)[:300]}
        except DriverError:
            return {"trouble": "has no kernels after the driver has built it"}
        except cl.Error as error:
            return {"trouble": "cannot be launched: " + " ".join(str(error).split())[:300]}
        return {"salt": salt}

    def _launch(self, kernels: dict[str, Any], launch: dict[str, Any]) -> None:
        arguments = [_given(self._context, self._queue, *argument) for argument in launch["arguments"]]
        size, local = tuple(launch["size"]), launch["local"] and tuple(launch["local"])
        kernels[launch["kernel"]](self._queue, size, local, *arguments)
        self._queue.finish()


def _serve(index: int) -> None:
    """Answer the parent's messages, on the `index`-th device, until the parent closes the pipe.

    If a driver hangs, this process ends after 1.5 times the message's time limit, with a traceback.
    """
    device = None
    for line in sys.stdin:
        message = json.loads(line)
        faulthandler.dump_traceback_later(1.5 * message["seconds"], exit=True)
        device = device or _TrialDevice(all_devices()[index])
        answer = device.answer(message)
        faulthandler.cancel_dump_traceback_later()
        tell(**answer)


if __name__ == "__main__":
    _serve(int(sys.argv[1]))
