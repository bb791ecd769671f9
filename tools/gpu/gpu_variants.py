# SPDX-License-Identifier: Apache-2.0
"""Record the kernel launches of clsplat in a child process, for `gpu_static.py`.

    gpu_variants.py LANESxITEMS FRAME...    a training step, or only a picture, of frames with these counts, in JSON
    gpu_variants.py "variant N" FRAME...    the same with the Nth of trial_variants.VARIANTS

The step is simulated: nothing is compiled, queued or allocated, and the numbers that it reads back are the frame's.
Only the kernels' launches and arguments are recorded.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

os.environ["CLSPLAT_TRUST_DRIVER"] = "1"  # no self-test, as nothing is launched
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import pyopencl as cl
from trial_variants import VARIANTS, Variant, VariedDevice

from clsplat.bench.stages import trainer_of
from clsplat.bench.workload import Subject
from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device import buffers, profile, program
from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers.shapes import Shape
from clsplat.device.program import variant_of
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import COUNTED, READBACK
from clsplat.training.step.visible_chunks import VisibleChunks

MEMORY = 64 << 30
"""Bytes of memory of the simulated device: enough to allocate a step's arrays whole."""
OPTIONS = "-cl-std=CL1.2 -cl-fp32-correctly-rounded-divide-sqrt"
"""Options of a build. NVIDIA's and AMD's drivers support correctly rounded division and square roots."""

REGISTERS = "-cl-nv-maxrregcount="
"""Option of NVIDIA's driver, which `gpu_compilers.py` gives to ptxas."""

SUBGROUPS = {"SUBGROUP": 32, "SHUFFLE_PTX": True}
"""Defines of a shape with sub-groups. `gpu_compilers.py` adds the target's functions for exchanging values."""


def noted(variant: program.Variant) -> dict[str, Any]:
    """A build variant for JSON: stem and options."""
    return {"stem": variant.stem, "options": [each for each in variant.options if not each.startswith("-DTRIAL_")]}


class _Buffer:
    """Replaces a buffer. It has only a size and an address."""

    def __init__(self, context: object, flags: object, size: int) -> None:
        del context, flags
        self.size, self.int_ptr = size, id(self)

    def get_sub_region(self, origin: int, size: int) -> _Buffer:
        del origin
        return _Buffer(None, None, size)


class _Kernel:
    """Replaces a kernel: its variant and name."""

    def __init__(self, variant: program.Variant, name: str) -> None:
        self.variant, self.name = variant, name
        self.tried: set[str] = set()
        self.cl_kernel = self

    def most_items(self, device: object) -> int:
        del device
        return 1024

    def set_scalar_arg_dtypes(self, types: object) -> None:
        del types


class _Kernels:
    """Replaces the kernels of a file."""

    def __init__(self, variant: program.Variant) -> None:
        self.variant = variant
        self.made: dict[str, _Kernel] = {}

    def __getattr__(self, name: str) -> _Kernel:
        if name.startswith("_"):
            raise AttributeError(name)
        return self.made.setdefault(name, _Kernel(self.variant, name))


class Rehearsed:
    """Records the launches of a simulated step."""

    def __init__(self, frame: Mapping[str, Any]) -> None:
        self.frame = frame
        self.launches: list[dict[str, Any]] = []

    def install(self) -> None:
        """Replace the methods and classes that call the driver."""
        rehearsed = self

        def built(device: Device, stem: str, defines: Mapping[str, object], registers: int = 0) -> _Kernels:
            shape = {"LANES": device.shape.lanes, "ITEMS": device.shape.items}
            limit = f" {REGISTERS}{registers}" if registers else ""
            return _Kernels(variant_of(stem, {**shape, **defines}, OPTIONS + limit))

        def enqueue(device: Device, kernel: Any, size: Any, local: Any, values: Any, *, wait: bool = False) -> None:
            del device, wait
            memory = sum(value.size for value in values if isinstance(value, cl.LocalMemory))
            entry = {"kernel": kernel.name, **noted(kernel.variant), "size": size, "local": local, "shared": memory}
            entry["scalars"] = [float(value) for value in values if isinstance(value, (int, float, np.number))]
            rehearsed.launches.append(entry)

        def add(recorder: profile.Recorder, name: str, event: object, nbytes: int) -> None:
            del event
            stack = recorder._stack  # noqa: SLF001
            entry = {"stage": stack[0] if stack else profile.TRANSFERS_STAGE, "bytes": nbytes}
            if rehearsed.launches and rehearsed.launches[-1]["kernel"] == name:
                rehearsed.launches[-1].update(entry)
            else:
                rehearsed.launches.append({"kernel": name, **entry})

        def note(array: DeviceArray, name: str) -> None:
            if array.device.recorder.on:
                array.device.recorder.add(name, None, array.nbytes)

        def read_into(array: DeviceArray, host: np.ndarray) -> None:
            host[...] = 0
            if array.shape in ((len(COUNTED),), (len(READBACK),)):
                host[: len(COUNTED)] = rehearsed.counted()
            note(array, "read")

        Device._built = built  # type: ignore[assignment,method-assign]  # noqa: SLF001
        Device._with_subgroups = lambda self: dict(SUBGROUPS)  # type: ignore[method-assign]  # noqa: SLF001
        Device.enqueue = enqueue  # type: ignore[assignment,method-assign]
        profile.Recorder.add = add  # type: ignore[assignment,method-assign]
        buffers._Buffer = _Buffer  # type: ignore[assignment,misc]  # noqa: SLF001
        DeviceArray.read_into = read_into  # type: ignore[assignment,method-assign]

        def begin_get(self: DeviceArray, into: np.ndarray | None = None) -> Callable[[], np.ndarray]:
            del into
            note(self, "read")
            return lambda: np.zeros(self.shape, self.dtype)

        DeviceArray.begin_get = begin_get  # type: ignore[method-assign]
        DeviceArray.set = lambda array, values: note(array, "write")  # type: ignore[assignment,method-assign]
        DeviceArray.send = lambda array, values: note(array, "write")  # type: ignore[assignment,method-assign]
        DeviceArray.fill = lambda array, value: note(array, "fill")  # type: ignore[assignment,method-assign]

    def counted(self) -> list[int]:
        """The numbers of the frame that a forward pass would read back."""
        least = 0x3F800000
        largest = least + (1 << self.frame["key_bits"]) - 1
        return [self.frame["visible"], self.frame["listed"], 2**32 - 1 - least, largest, 0]


def step(variant: Variant, frame: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The launches and copies of a training step of this frame, or of its forward pass if it has `picture`, each with
    its stage and bytes."""
    rehearsed = Rehearsed(frame)
    rehearsed.install()
    whole = VariedDevice(all_devices()[0], Shape(1, 1, chunks=64))
    with whole.varied(variant):
        return _step(rehearsed, whole, frame)


def _step(rehearsed: Rehearsed, whole: VariedDevice, frame: Mapping[str, Any]) -> list[dict[str, Any]]:
    device = whole.with_memory_limit(MEMORY)
    device.kind, device.max_allocation, device.shares_memory = "gpu", MEMORY, False
    width, height, count = frame["width"], frame["height"], frame["gaussians"]
    camera = Camera(width, height, float(width), float(width), width / 2, height / 2, np.eye(3), np.zeros(3))
    groups = ((3,), (4,), (3,), (), ((frame["sh_degree"] + 1) ** 2, 3))
    means, quaternions, sizes, logits, sh = (np.zeros((count, *group), np.float32) for group in groups)
    gaussians = Gaussians(means, quaternions, sizes, logits, sh)
    photograph = np.zeros((height, width, 3), np.uint8)
    trainer = trainer_of(Subject("rehearsed", gaussians, camera, photograph), device, RasterizerConfig())
    # The capacity is the frame's number of pairs, so that launches have no items without work, which would count too.
    trainer.pending.room = lambda *_: frame["listed"]  # type: ignore[method-assign]
    trainer.rasterizer.work.tight = False
    # Without VisibleChunks, as a simulated step has no bounds of chunks. Frames show most of their Gaussians anyway.
    trainer._active = [  # noqa: SLF001
        each for each in trainer.components if each.on and not isinstance(each, VisibleChunks)
    ]
    device.atomics_faults.append("")

    def forward() -> None:
        trainer.rasterizer.forward(trainer.parameters, camera, np.zeros(3, np.float32), backward=False)

    work = forward if frame.get("picture") else trainer.train_step
    work()  # the first call fills caches
    rehearsed.launches.clear()
    device.recorder.on = trainer.device.recorder.on = True
    work()
    device.recorder.on = False
    return rehearsed.launches


def main(arguments: list[str]) -> int:
    """Print the launches of the frames in the arguments."""
    label, *frames = arguments
    place = label.removeprefix("variant ")
    variant = VARIANTS[int(place)] if place != label else Variant(label, shape=label)
    print(json.dumps([step(variant, json.loads(frame)) for frame in frames]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
