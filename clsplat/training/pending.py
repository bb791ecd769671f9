# SPDX-License-Identifier: Apache-2.0
"""Training steps by capacity: launched before the number of their pairs is known, looked at a step later, and made
again where there were more (docs/decisions/0025-launch-by-capacity.md)."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.device.layout import READBACK
from clsplat.errors import switched_on
from clsplat.rendering.rasterizer import TURNS, Frame, Rasterizer, Room
from clsplat.stages.loss import Loss
from clsplat.training.monitor import LastStep, Watch

VARIABLE = "CLSPLAT_BY_CAPACITY"
"""Variable that decides whether steps are launched by capacity; unset, they are on what is no CPU."""

Run = Callable[[int, Room | None], Loss]
"""A function that makes one step: with a turn, and a room or the exact count of pairs."""


@dataclass(eq=False)
class _Step:
    """A step whose counts the host has not seen. readback, counts: these on the device, and a function that waits for
    their copy; before: the step that was watched until then; kept: what the device may still have to read from the
    host."""

    run: Run
    turn: int
    result: Loss
    readback: DeviceArray
    counts: Callable[[], NDArray[Any]]
    before: LastStep | None
    kept: list[object]


def by_capacity(device: Device) -> bool:
    """True if steps are launched by capacity on this device where they can be. Raises InputError."""
    return switched_on(VARIABLE) if os.environ.get(VARIABLE) else device.kind != "cpu"


class Pending:
    """The steps of one training that are launched by capacity, at most two at a time, and the capacity that the next
    one gets.

    begin: called before a step is made again, as it begins with mending what `watch` has noticed; redone: how many
    were.
    """

    def __init__(self, device: Device, watch: Watch, begin: Callable[[], None]) -> None:
        self.on = by_capacity(device)
        self._device, self._watch, self._begin = device, watch, begin
        self._steps: list[_Step] = []
        self._kept: list[object] = []
        self._most: int | None = None
        self._of: tuple[object, int] = (None, 0)
        self._turn = 0
        self._frame: Frame | None = None
        self.redone = 0

    @property
    def turns(self) -> int:
        """Losses whose sums are kept at a time."""
        return TURNS if self.on else 1

    def forget(self) -> None:
        """Forget all steps: the model is a new one."""
        self._steps.clear()
        self._most = None

    def seen(self, frame: Frame) -> None:
        """Take note of a step's frame, as soon as it is launched."""
        self._frame = frame
        if frame.part.counted.arriving is None:
            self._count(frame.part.counted.pairs if len(frame.bands) == 1 else None)

    def _count(self, pairs: int | None) -> None:
        self._most = None if pairs is None else max(pairs, self._most or 0)

    def room(self, rasterizer: Rasterizer, size: object, gaussians: int) -> int:
        """Pairs to make room for: a quarter more than were seen at this size of photographs, with so many more
        Gaussians; 0 if that is not known, or not to be had."""
        if (before := self._of) != (size, gaussians):
            self._of = size, gaussians
            grown = max(gaussians / max(before[1], 1), 1.0)
            self._most = round(self._most * grown) if self._most is not None and size == before[0] else None
        if self._most is None:
            return 0
        wanted = max(self._most + self._most // 4, 1024)
        step = 1 << (wanted.bit_length() - 4)  # few sizes, so that arrays keep theirs
        wanted = -(-wanted // step) * step
        return wanted if wanted <= rasterizer.capacity else 0

    def launch(self, run: Run, room: int, *, reads_loss: bool) -> Loss:
        """Make a step: by capacity, if there is room, and then have the one before looked at. reads_loss: of this one
        too."""
        if not self.on:
            return run(0, None)
        if not room:
            self.settle()
        turn = self._turn = (self._turn + 1) % self.turns  # of exact ones too: their loss is looked at a step later
        before, result = self._watch.last, run(turn, Room(room, turn) if room else None)
        if not room:
            return result
        assert self._frame is not None, "each step has a frame"
        counted, under_way = self._frame.part.counted, self._device.under_way
        assert counted.arriving is not None, "it was launched by capacity"
        assert counted.on_device is not None, "it was launched by capacity"
        step = _Step(run, turn, result, counted.on_device, counted.arriving, before, list(under_way))
        self._steps.append(step)
        under_way.clear()
        self._look(0 if reads_loss else 1)
        return step.result if reads_loss else result.copied(lambda: self._sums(step))

    def _sums(self, step: _Step) -> NDArray[Any]:
        """The sums of a step's loss, once it is known to have been one."""
        self.settle()
        copy = step.result.copy
        return copy() if copy is not None else step.result.sums.get()

    def settle(self) -> None:
        """Wait until all steps are known to have been made, or make them again. Whatever reads or changes the model,
        its statistics or the random state that steps go by comes after this."""
        self._look(0)

    def _look(self, left: int) -> None:
        """Look at all steps but the last `left`."""
        while len(self._steps) > left:
            counts = self._steps[0].counts()
            if counts[READBACK.index("STOPPED")]:
                self._again()
                return
            self._count(int(counts[READBACK.index("PAIRS")]))
            self._kept = self._steps.pop(0).kept  # what came behind the counts may be under way

    def _again(self) -> None:
        """Make the steps again that the device has left out, with exact counts."""
        steps, self._steps = self._steps, []
        values = steps[0].readback.get()
        values[READBACK.index("STOPPED")] = 0
        steps[0].readback.set(values)
        self._watch.last = steps[0].before
        for step in steps:
            self._begin()
            step.result = step.run(step.turn, None)
            self.redone += 1
