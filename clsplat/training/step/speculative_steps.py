# SPDX-License-Identifier: Apache-2.0
"""Training steps by capacity: launched before their number of pairs is known, and checked one step later.

A step with more pairs than its capacity is repeated (docs/decisions/0025-launch-by-capacity.md).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.errors import switched_on
from clsplat.layouts.columns import READBACK
from clsplat.rendering.rasterizer import MAX_COUNTED_PASSES, ForwardPass, PairCapacity, Rasterizer
from clsplat.stages.append import MAX_LIST_PAIRS
from clsplat.stages.duplicate import Totals
from clsplat.stages.loss import Loss
from clsplat.training.stability.non_finite import LastStep, NonFiniteMonitor

BY_CAPACITY_VARIABLE = "CLSPLAT_BY_CAPACITY"
"""Environment variable that switches launches by capacity on or off. By default they are on, except on CPUs."""

_STOPPED, _PAIRS, _LONGEST = (READBACK.index(name) for name in ("STOPPED", "PAIRS", "LONGEST"))

Run = Callable[[int, PairCapacity | None], Loss]
"""Function that runs one step. Its arguments are the index of the array for the sums of the loss, and the capacity in
pairs. If the capacity is None, the step counts its pairs first."""


@dataclass(eq=False)
class _Step:
    """Launched step whose number of pairs the host has not read yet.

    run: function that runs the step again.
    turn: index of the array that this step uses for the sums of its loss (`SpeculativeSteps.turns`).
    number: number of the step's last view.
    readback: the step's counts on the device.
    counts: function that waits for these counts, and returns them.
    before: value of `NonFiniteMonitor.last` before this step.
    kept: host memory that the device may still have to read.
    """

    run: Run
    turn: int
    number: int
    result: Loss
    readback: DeviceArray
    counts: Callable[[], NDArray[Any]]
    before: LastStep | None
    kept: list[object]


def by_capacity(device: Device) -> bool:
    """True if steps on this device are launched by capacity. Raises InputError for an invalid CLSPLAT_BY_CAPACITY."""
    return switched_on(BY_CAPACITY_VARIABLE) if os.environ.get(BY_CAPACITY_VARIABLE) else device.kind != "cpu"


class SpeculativeSteps:
    """Steps that were launched by capacity, at most two at a time, and the capacity of the next step.

    begin: function that is called before a step is repeated, with the step's number. It repairs the non-finite values
        that `monitor` has found.
    redone: number of steps repeated so far.
    """

    def __init__(self, device: Device, monitor: NonFiniteMonitor, begin: Callable[[int], None]) -> None:
        self.on = by_capacity(device)
        self._device, self._monitor, self._begin = device, monitor, begin
        self._steps: list[_Step] = []
        self._kept: list[object] = []
        self._most: int | None = None
        self._of: tuple[object, int] = (None, 0)
        self._appends = True
        self._turn = 0
        self._counted: Totals | None = None
        """Counts of the latest step by capacity."""
        self.redone = 0

    @property
    def turns(self) -> int:
        """Number of arrays for the sums of the loss, which the steps use in turn."""
        return MAX_COUNTED_PASSES if self.on else 1

    def forget(self) -> None:
        """Forget all steps, because the model has been replaced."""
        self._steps.clear()
        self._most = None

    def seen(self, frame: ForwardPass) -> None:
        """Record the number of pairs of a step that has just been launched, or how to wait for it."""
        counted = frame.listed.counted
        # exact counts are not kept, because the next step needs the memory of their arrays
        self._counted = counted if counted.arriving is not None else None
        if self._counted is None:
            self._count(counted.pairs if len(frame.bands) == 1 else None)

    def _count(self, pairs: int | None) -> None:
        self._most = None if pairs is None else max(pairs, self._most or 0)

    def room(self, rasterizer: Rasterizer, size: object, gaussians: int) -> int:
        """Capacity in pairs of the next step; 0 to count its pairs first.

        The capacity is a quarter more than the largest number of pairs of earlier steps with photographs of this
        `size`, multiplied by the growth to `gaussians` Gaussians. It is 0 if steps are not launched by capacity, if no
        earlier number is known, or if it would exceed the rasterizer's capacity.

        size: any value that differs between sizes, and is compared only for equality.
        """
        if not self.on or not rasterizer.takes_room:
            return 0
        if (before := self._of) != (size, gaussians):
            self._of, self._appends = (size, gaussians), True
            grown = max(gaussians / max(before[1], 1), 1.0)
            self._most = round(self._most * grown) if self._most is not None and size == before[0] else None
        if self._most is None:
            return 0
        wanted = max(self._most + self._most // 4, 1024)
        step = 1 << (wanted.bit_length() - 4)  # round up to a multiple of this, so that arrays are seldom resized
        wanted = -(-wanted // step) * step
        return wanted if wanted <= rasterizer.capacity else 0

    def launch(self, run: Run, room: int, *, number: int, reads_loss: bool) -> Loss:
        """Run a step with capacity `room`, or with an exact count if `room` is 0. Then check if the previous step had
        enough capacity.

        number: number of the step's last view.
        reads_loss: True to check this step too, because its loss will be read.
        """
        if not self.on:
            return run(0, None)
        if not room:
            self.settle()
        # steps with exact counts use the arrays of loss sums in turn too, because their loss is read a step later
        turn = self._turn = (self._turn + 1) % self.turns
        before, result = self._monitor.last, run(turn, PairCapacity(room, turn, self._appends) if room else None)
        if not room:
            return result
        counted, under_way = self._counted, self._device.under_way
        assert counted is not None, "it was launched by capacity"
        assert counted.arriving is not None, "it was launched by capacity"
        assert counted.on_device is not None, "it was launched by capacity"
        step = _Step(run, turn, number, result, counted.on_device, counted.arriving, before, list(under_way))
        self._steps.append(step)
        under_way.clear()
        self._look(0 if reads_loss else 1)
        return step.result if reads_loss else result.copied(lambda: self._sums(step))

    def _sums(self, step: _Step) -> NDArray[Any]:
        """Return the sums of a step's loss, after checking the step and repeating it if it is incomplete."""
        self.settle()
        copy = step.result.copy
        return copy() if copy is not None else step.result.sums.get()

    def settle(self) -> None:
        """Wait until the device has done all launched steps, and repeat the incomplete ones.

        Call it before reading or changing the model, its statistics, or the random state that steps use.
        """
        self._look(0)

    def _look(self, left: int) -> None:
        """Read the counts of all launched steps except the last `left`, and repeat steps that had too many pairs."""
        while len(self._steps) > left:
            counts = self._steps[0].counts().tolist()
            if counts[_STOPPED]:
                self._again()
                return
            self._count(counts[_PAIRS])
            self._appends &= counts[_LONGEST] <= MAX_LIST_PAIRS
            self._kept = self._steps.pop(0).kept  # copies launched after the counts may still be reading this memory

    def _again(self) -> None:
        """Repeat, with exact counts, the step that had too many pairs, and later steps, which the device skipped."""
        steps, self._steps = self._steps, []
        values = steps[0].readback.get()
        values[_STOPPED] = 0
        steps[0].readback.set(values)
        self._monitor.last = steps[0].before
        for step in steps:
            self._begin(step.number)
            step.result = step.run(step.turn, None)
            self.redone += 1
