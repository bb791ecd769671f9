# SPDX-License-Identifier: Apache-2.0
"""Variants of a step's kernels: other shapes, group sizes, register limits and constants.

Each variant is timed, and the bits of its results are compared with those of the usual form.

A variant is a row of VARIANTS. All of a scene's variants run on one model in memory, as `VariedDevice` changes its
builds while it is open.
"""

from __future__ import annotations

import os
import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.stages import trainer_of
from clsplat.bench.workload import Subject
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.command_buffer import TAPES_VARIABLE
from clsplat.device.context import Device
from clsplat.device.drivers.driver_records import BREAK_KERNEL_VARIABLE
from clsplat.device.drivers.quirks import register_limit, subgroup_ways
from clsplat.device.drivers.shapes import Shape, most_items
from clsplat.device.program import Kernels
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import LOSS_GROUP_ROWS, SPLAT
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians

USUAL_SHAPE = "1x64"
"""Shape that variants change: the default of GPUs."""
WARM_UP = 2
"""Number of steps before the timed ones."""
COPIES = ("write", "read", "fill")
"""Names in the recorder's results that are not kernels."""


@dataclass(frozen=True)
class Variant:
    """A change of a step's kernels.

    of: the kernels or stages on which it is measured; empty for all.
    shape: shape of all kernels.
    registers: limit of registers per work-item, by kernel file; 0 for none.
    text: a change of the text, by kernel file: WORDS => WORDS as in CLSPLAT_BREAK_KERNEL; at most one.
    values: values of the package's constants, by MODULE.NAME.
    """

    name: str
    of: tuple[str, ...] = ()
    shape: str = USUAL_SHAPE
    registers: Mapping[str, int] = field(default_factory=dict)
    text: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, int] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The name, with the kernels or stages on which the variant is measured."""
        return f"{' and '.join(self.of)}, {self.name}" if self.of else self.name

    def changed_text(self) -> AbstractContextManager[object]:
        """A context manager, inside which kernel files are built with the variant's change of text, or unchanged if it
        has none."""
        assert len(self.text) <= 1, "CLSPLAT_BREAK_KERNEL changes one file"
        texts = {BREAK_KERNEL_VARIABLE: f"{stem}: {words}" for stem, words in self.text.items()}  # noqa: B035  # one
        return patch.dict(os.environ, texts)

    def lacking(self, device: Device) -> str:
        """The reason why the variant would be the usual form on this device, or cannot run there; or empty."""
        shape = device.shape.relabelled(self.shape)
        if shape.items > most_items(device.cl_device):
            return f"groups of {shape.items} items do not fit"
        if shape.subgroups and not subgroup_ways(device.cl_device):
            return "the driver has no sub-groups whose items exchange values"
        if self.registers and not register_limit(device.cl_device, 1):
            return "the driver takes no limit of registers"
        return ""

    def measures(self, stage: str, kernel: str) -> bool:
        """True if the variant is measured on this kernel."""
        return kernel not in COPIES and (not self.of or stage in self.of or kernel in self.of)


USUAL = Variant(USUAL_SHAPE)
_GROUP_ITEMS = ("clsplat.device.launch.DEFAULT_GROUP_ITEMS", "clsplat.stages.project.DEFAULT_GROUP_ITEMS")
_SORT_CHUNK = "clsplat.stages.scan.CHUNK_ELEMENTS_PER_ITEM"


def _rows_of_loss(rows: int) -> Variant:
    """The variant of the loss in blocks of this many rows."""
    text = {"loss": f"#define LOSS_GROUP_ROWS {LOSS_GROUP_ROWS} => #define LOSS_GROUP_ROWS {rows}"}
    values = {"clsplat.stages.loss.LOSS_GROUP_ROWS": rows}
    return Variant(f"blocks of {rows} rows", ("loss",), text=text, values=values)


VARIANTS = (
    USUAL,
    *(Variant(shape, shape=shape) for shape in ("1x32", "1x128", "1x256")),
    *(Variant(shape, ("blend_grad",), shape) for shape in ("1x32g", "1x64g", "1x32s", "1x64s")),
    *(Variant(f"{most} registers", ("project_step",), registers={"project_grad": most}) for most in (72, 88, 128)),
    Variant("registers not limited", ("project_step",), registers={"project_grad": 0}),
    *(Variant(f"{most} registers", ("blend",), registers={"blend": most}) for most in (64, 48)),
    *(Variant(f"{most} registers", ("blend_grad",), registers={"blend_grad": most}) for most in (64, 80, 128)),
    Variant("registers not limited", ("blend_grad",), registers={"blend_grad": 0}),
    *(Variant(f"{most} registers", ("project",), registers={"project": most}) for most in (64, 48)),
    *(Variant(f"{most} registers", ("loss",), registers={"loss": most}) for most in (64, 48)),
    *(_rows_of_loss(rows) for rows in (5, 6)),
    *(Variant(f"{64 * k} keys a group", ("duplicate", "ranges"), values={_SORT_CHUNK: k}) for k in (32, 64, 128)),
    *(
        Variant(f"groups of {items}", ("project", "project_grad"), values=dict.fromkeys(_GROUP_ITEMS, items))
        for items in (32, 128)
    ),
)
"""All variants in the order in which they are measured. To measure a new form of a kernel, add a row."""
DRY = ("1x64", "1x64g", "blocks of 5 rows", "2048 keys a group", "groups of 32")
"""Variants of a dry run: one for each kind of change that a CPU's driver supports."""
OUTPUTS = {
    "project": "project",
    "duplicate": "lists",
    "ranges": "lists",
    "blend": "blend",
    "target": "loss",
    "loss": "loss",
    "blend_grad": "blend_grad",
    "project_grad": "project_step",
}
"""Names of the arrays of `TrialScene.outputs` that a stage's kernels make, by stage."""


class VariedDevice(Device):
    """A device whose shape and builds are those of a variant, which may change while the device is open.

    Its copies (`with_switches`) change too.
    """

    def __init__(self, device: Any, shape: Shape) -> None:
        self._now: dict[str, Any] = {"shape": shape, "variant": USUAL}  # shared with copies
        super().__init__(device, shape, profile=True)

    @property
    def shape(self) -> Shape:
        """The variant's shape."""
        shape: Shape = self._now["shape"]
        return shape

    @shape.setter
    def shape(self, shape: Shape) -> None:
        self._now["shape"] = shape

    @contextmanager
    def varied(self, variant: Variant) -> Iterator[None]:
        """A context manager, inside which the device builds and launches the kernels of the variant."""
        before, shape = dict(self._now), self.shape.relabelled(variant.shape)
        with ExitStack() as changes:
            changes.enter_context(variant.changed_text())
            for name, value in variant.values.items():
                module, _, constant = name.rpartition(".")
                changes.enter_context(patch.object(import_module(module), constant, value))
            self._now.update(shape=shape, variant=variant)
            try:
                yield
            finally:
                self._now.update(before)

    def kernels(self, stem: str, defines: Mapping[str, object] = {}, registers: int = 0) -> Kernels:
        """The variant's kernels. The variant's name is part of the cache's key, but the kernels do not use it."""
        variant: Variant = self._now["variant"]
        return super().kernels(stem, {**defines, "TRIAL_VARIANT": variant.name}, variant.registers.get(stem, registers))


Arrays = dict[str, list[NDArray[Any]]]
"""Arrays that a step's kernels make, by name."""


class TrialScene:
    """A scene on a device, with a trainer whose steps leave the model as it is."""

    def __init__(self, subject: Subject, device: VariedDevice) -> None:
        self.subject, self.device = subject, device
        with patch.dict(os.environ, {TAPES_VARIABLE: "0"}):  # no replay of an earlier variant's launches
            self.trainer = trainer_of(subject, device, RasterizerConfig())
        count, coefficients = len(subject.gaussians), subject.gaussians.sh.shape[1]
        self._gradients = allocate_gaussians(device, count, coefficients, zero=True)
        self._usual: Arrays = {}

    def times(self, repeat: int) -> dict[tuple[str, str], float]:
        """Median milliseconds of each kernel of a step, by stage and name."""
        runs = []
        for _ in range(WARM_UP + repeat):
            with self.device.recorder.recording(wait=False) as stages:
                self.trainer.train_step()
            runs.append({(stage, name): ms for stage, each in stages.items() for name, ms in each.kernels.items()})
        last = runs[WARM_UP:]
        return {key: statistics.median(run.get(key, 0.0) for run in last) for key in last[-1]}

    def outputs(self, wanted: Sequence[str]) -> Arrays:
        """The arrays of these names that the present variant makes. Moments start from zero."""
        trainer, found = self.trainer, Arrays()
        trainer.settle()
        frame = trainer.rasterizer.forward(trainer.parameters, self.subject.camera, trainer.background)
        if "project" in wanted:
            counts, splats = frame.projected.tile_counts.get(), frame.projected.splats.get()
            found["project"] = [counts, np.delete(splats[counts > 0], SPLAT.index("UNUSED"), axis=1)]
        if "lists" in wanted:
            lists = frame.listed.lists
            found["lists"] = [lists.gaussian_from_sorted.get(), lists.ranges.get()]
        if "blend" in wanted:
            blended = frame.blended
            found["blend"] = [array.get() for array in (blended.image, blended.transmittance, blended.stops)]
        if "blend_grad" in wanted:
            parameters = trainer.parameters
            assert isinstance(parameters, DeviceGaussians), "the scene fits on the device"
            trainer.rasterizer.backward(parameters, frame, frame.blended.image, self._gradients)
            found["blend_grad"] = [self._gradients[group].get() for group in PARAMETER_GROUPS]
        if {"loss", "project_step"} & set(wanted):
            moments = [
                model[group] for model in (trainer.model.first, trainer.model.second) for group in PARAMETER_GROUPS
            ]
            for array in moments:
                array.fill(0.0)
            loss = trainer.train_step(reads_loss=True)
            trainer.settle()
            found["loss"] = [loss.gradient.get()]  # type: ignore[union-attr]  # of one view
            found["project_step"] = [array.get() for array in moments]
        return {name: arrays for name, arrays in found.items() if name in wanted}

    def measure(self, variant: Variant, repeat: int) -> list[dict[str, Any]]:
        """Rows of the variant's kernels: stage, kernel, milliseconds, and whether their bits are the usual form's."""
        with self.device.varied(variant):
            times = {key: ms for key, ms in self.times(repeat).items() if variant.measures(*key)}
            wanted = sorted({OUTPUTS[stage] for stage, _ in times if stage in OUTPUTS})
            found = self.outputs(wanted)
        if variant is USUAL:
            self._usual = found
        bits = {name: compared(found[name], self._usual[name]) for name in found if name in self._usual}
        return [
            {
                "kernel": name,
                "stage": stage,
                "variant": variant.name,
                "ms": ms,
                "bits": bits.get(OUTPUTS.get(stage, ""), ""),
            }
            for (stage, name), ms in times.items()
        ]


def compared(found: Sequence[NDArray[Any]], usual: Sequence[NDArray[Any]]) -> str:
    """`same`, or by how much two results differ: the largest norm of a difference relative to the usual array's."""
    if any(one.shape != other.shape for one, other in zip(found, usual, strict=True)):
        return "other sizes"
    both = zip(found, usual, strict=True)
    pairs = [(one, other) for one, other in both if not np.array_equal(one.view(np.uint8), other.view(np.uint8))]
    if not pairs:
        return "same"
    norms = ((np.linalg.norm(one.astype(np.float64) - other), np.linalg.norm(other)) for one, other in pairs)
    return f"off by {max(float(off) / max(float(size), 1e-30) for off, size in norms):.0e}"
