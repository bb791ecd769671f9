# SPDX-License-Identifier: Apache-2.0
"""Lists of the chunks that a launch runs over, such as the chunks that a view shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.division import chunks_of, listed_chunks
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK


@dataclass(frozen=True, eq=False)
class ChunkList:
    """List of the chunks whose rows a launch runs over (`kernels/shared/chunks.h`); for a pool, of the chunks' slots.

    numbers: uint32, numbers of the chunks in rising order, or their slots in the same order; then NO_CHUNK as padding.
    model_rows: number of rows of the model, or of all slots of the pool.
    first_rows: (k,) uint32, with slots: the first row of each chunk in the whole model; None if no kernel needs it.
    """

    numbers: DeviceArray
    model_rows: int
    first_rows: DeviceArray | None = None

    @property
    def rows(self) -> int:
        """Number of rows that a launch runs over, padding included."""
        return CHUNK_ROWS * self.numbers.shape[0]

    @property
    def key(self) -> tuple[object, ...]:
        """Key for command buffers: all that a launch over these chunks depends on, except the chunks' numbers."""
        first = None if self.first_rows is None else self.first_rows.buffer
        return self.numbers.buffer, self.numbers.shape, self.model_rows, first

    @property
    def arguments(self) -> tuple[DeviceArray, int]:
        """Arguments for the kernel parameters CHUNK_PARAMETERS (kernels/shared/chunks.h)."""
        return self.numbers, self.model_rows


def padded_chunks(numbers: NDArray[np.uint32], most: int | None = None) -> NDArray[np.uint32]:
    """Pad chunk numbers (k,) with NO_CHUNK to one of a few lengths, so that arrays and command buffers are reused.

    most: maximum length, at least k; None for no maximum.
    """
    length = listed_chunks(len(numbers))
    padded = np.full(length if most is None else min(length, most), NO_CHUNK, np.uint32)
    padded[: len(numbers)] = numbers
    return padded


def send_chunks(
    work: Workspace,
    name: str,
    numbers: NDArray[np.uint32],
    model_rows: int,
    first_rows: NDArray[np.integer[Any]] | None = None,
) -> ChunkList:
    """Upload a padded list of chunks to the workspace's array `name`, and the chunks' first rows, if given, to another
    array, without waiting for the device."""
    padded = padded_chunks(numbers, max(chunks_of(model_rows), 1))
    array, first = work.array(name, padded.shape, np.uint32), None
    array.send(padded)
    if first_rows is not None:
        rows = np.zeros(padded.shape, np.uint32)
        rows[: len(first_rows)] = first_rows
        first = work.array(f"{name}_rows", padded.shape, np.uint32)
        first.send(rows)
    return ChunkList(array, model_rows, first)


def exact_chunks(
    work: Workspace,
    name: str,
    numbers: NDArray[np.integer[Any]],
    model_rows: int,
    first_rows: NDArray[np.integer[Any]],
) -> ChunkList:
    """Upload a list of chunks without padding to the workspace's array `name`, and the chunks' first rows."""
    sent = []
    for array, values in ((name, numbers), (f"{name}_rows", first_rows)):
        sent.append(work.array(array, values.shape, np.uint32))
        sent[-1].set(values.astype(np.uint32))
    return ChunkList(sent[0], model_rows, sent[1])


@dataclass(frozen=True, eq=False)
class ChunkNumbers:
    """Chunks of a streamed model for a pass that brings them to the device in parts (`chunk_parts`).

    numbers: numbers of the chunks, in rising order.
    """

    numbers: NDArray[np.integer[Any]]

    @property
    def rows(self) -> int:
        """Number of rows that the launches of all parts run over."""
        return CHUNK_ROWS * len(self.numbers)
