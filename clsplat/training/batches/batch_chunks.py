# SPDX-License-Identifier: Apache-2.0
"""Steps of several views over the chunks that the views may show: lists of chunks, sums of gradients, and rows to send
to further devices (docs/decisions/0024-a-batch-of-views.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.chunks.division import chunks_of, listed_chunks
from clsplat.chunks.store import record_type
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK
from clsplat.stages.adam import AdamStep
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.stages.chunk_records import copy_chunks
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostGaussians,
    allocate_gaussians,
    chunk_parts,
)
from clsplat.training.step.inputs import PlacedChunks, ViewInputs

HostRoom = Callable[[str, tuple[int, ...]], Float32]
"""Function that returns a float32 array of a shape in main memory, which it keeps by name and reuses."""


class GradientSums:
    """Sums of the gradients of a step's views, on the device. Between steps they are zero: `adam` sets them to zero."""

    def __init__(self) -> None:
        self._held: DeviceGaussians | None = None

    def take(self, device: Device, rows: int, coefficients: int) -> DeviceGaussians:
        """Return arrays of zeros for `rows` rows. Arrays of earlier steps are reused if they are large enough."""
        held = self._held
        if held is None or held.count < rows or held.coefficients != coefficients:
            del held
            self._held = None
            held = self._held = allocate_gaussians(device, rows, coefficients, zero=True)
        arrays = {group: array.reshaped(rows, *array.shape[1:]) for group, array in held.arrays.items()}
        return DeviceGaussians(rows, coefficients, arrays)

    def free(self) -> None:
        """Free the arrays."""
        self._held = None


@dataclass(frozen=True, eq=False)
class BatchChunks:
    """The chunks that the views of a step may show.

    model: parameters, first and second moments, whole or streamed.
    numbers: numbers of the chunks, in rising order.
    placed: list of these chunks for Adam.
    sums: sums of the views' gradients, with rows for the chunks of `numbers`, one chunk after the other.
    """

    device: Device
    work: Workspace
    model: tuple[AnyGaussians, AnyGaussians, AnyGaussians]
    numbers: NDArray[np.uint32]
    placed: PlacedChunks
    sums: DeviceGaussians

    @classmethod
    def begin(
        cls,
        work: Workspace,
        device: Device,
        model: tuple[AnyGaussians, AnyGaussians, AnyGaussians],
        views: Sequence[ViewInputs],
        step: AdamStep,
        sums: GradientSums,
    ) -> BatchChunks | None:
        """Catch up the chunks that the views of Adam's step `step` may show. Returns None if the step runs over the
        whole model."""
        chunks = views[0].chunks
        placed = None if chunks is None else chunks.prepare(model, step)
        if chunks is None or placed is None:
            return None
        zeros = sums.take(device, placed.in_model.rows, model[0].coefficients)
        return cls(device, work, model, chunks.numbers, placed, zeros)

    @property
    def pool(self) -> ChunkPool | None:
        """Pool of a streamed model; None for a model on the device."""
        return self.model[0].pool if isinstance(self.model[0], HostGaussians) else None

    def gradient_rows(self, inputs: ViewInputs) -> int:
        """Number of rows that the gradients of a view of the first device need memory for."""
        most = chunks_of(self.model[0].count) if self.pool is None else self.pool.slots
        return CHUNK_ROWS * min(listed_chunks(len(_in_view(inputs))), most)

    def places(self, inputs: ViewInputs, start: int, stop: int) -> ChunkList:
        """Return, for the rows [start, stop) of a view, the list of each chunk's place among the chunks of the sums."""
        chunks = slice(start // CHUNK_ROWS, chunks_of(stop))
        numbers = np.full(chunks.stop - chunks.start, NO_CHUNK, np.uint32)
        found = np.searchsorted(self.numbers, _in_view(inputs)[chunks])
        numbers[: len(found)] = found
        array = self.work.array("chunk_places", numbers.shape, np.uint32)
        array.send(numbers)
        return ChunkList(array, self.sums.count)

    def of_view(self, inputs: ViewInputs, rows: int) -> Iterator[tuple[int, int, ChunkList]]:
        """Yield parts of the first `rows` rows of a view, for kernels that change statistics: the first row, the end of
        the rows, and the list of their chunks. Each part is valid until the next one is requested."""
        numbers = _in_view(inputs)
        if self.pool is None:
            array = self.work.array("chunks_of_view", numbers.shape, np.uint32)
            array.send(numbers)
            yield 0, rows, ChunkList(array, self.model[0].count)
            return
        for start, stop, _, slots in chunk_parts(self.work, ChunkNumbers(numbers), *self.model, changes=True):
            yield start, stop, slots

    def for_adam(self) -> Iterator[tuple[tuple[DeviceGaussians, ...], DeviceGaussians, ChunkList]]:
        """Yield the parts of the model for Adam: parameters, first and second moments on the device; the sums of
        gradients of some chunks; and the list of these chunks. Each part is valid until the next one is requested."""
        chunks = self.placed.in_model
        if isinstance(chunks, ChunkList):
            on_device = tuple(model for model in self.placed.model if isinstance(model, DeviceGaussians))
            yield on_device, self.sums, chunks
            return
        for start, stop, models, slots in chunk_parts(self.work, chunks, *self.model, changes=True):
            arrays = {group: array.rows(start, stop) for group, array in self.sums.arrays.items()}
            yield models, DeviceGaussians(stop - start, self.sums.coefficients, arrays), slots

    def parameters(self, inputs: ViewInputs, room: HostRoom) -> dict[str, Float32]:
        """Return a copy on the host of the parameters of a view's chunks, by group, without rows past the model's end.

        room: memory for the copy.
        """
        numbers, model = _in_view(inputs), self.model[0]
        whole, rest = numbers, 0
        if self.pool is None and len(numbers) and numbers[-1] == model.count // CHUNK_ROWS:
            whole, rest = numbers[:-1], model.count % CHUNK_ROWS  # the last chunk, which is not full
        shapes = {name: array.shape[1:] for name, array in model.arrays.items()}
        values = {name: room(name, (CHUNK_ROWS * len(whole) + rest, *shape)) for name, shape in shapes.items()}
        for start, stop, part, slots in self._whole_chunks(whole):
            for name in PARAMETER_GROUPS:  # through the arrays of gradients, which no view uses yet
                packed = self.work.array(f"view_{name}", (stop - start, *shapes[name]))
                _pack(part[name], slots, packed)
                packed.read_into(values[name][start:stop])
        for name in PARAMETER_GROUPS if rest else ():
            values[name][-rest:] = model[name].get_rows(model.count - rest, model.count)
        return values

    def _whole_chunks(self, numbers: NDArray[np.uint32]) -> Iterator[tuple[int, int, DeviceGaussians, DeviceArray]]:
        """Yield full chunks on the device, part by part: first row, end of the rows, parameters, and each chunk's place
        in the arrays of the parameters."""
        model = self.model[0]
        if isinstance(model, DeviceGaussians):
            if len(numbers):
                yield 0, CHUNK_ROWS * len(numbers), model, upload(self.device, numbers)
            return
        for start, stop, (part,), slots in chunk_parts(self.work, ChunkNumbers(numbers), model):
            yield start, stop, part, slots.numbers


def _in_view(inputs: ViewInputs) -> NDArray[np.uint32]:
    assert inputs.chunks is not None, "a step over chunks"
    return inputs.chunks.in_view


def _pack(array: DeviceArray, chunks: DeviceArray, packed: DeviceArray) -> None:
    """Copy the listed chunks of `array` to the array `packed`, one chunk after the other."""
    if packed.size:
        record = record_type({"values": array.shape[1:]})
        copy_chunks(array.device, chunks, packed, record, {"values": array}, to_records=True)
