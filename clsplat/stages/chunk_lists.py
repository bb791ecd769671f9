# SPDX-License-Identifier: Apache-2.0
"""Lists of the chunks of a model over whose rows stages run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK


@dataclass(frozen=True, eq=False)
class ChunkList:
    """Chunks of a model over whose rows a launch runs (`kernels/shared/chunks.h`), or slots of a pool that have them.

    numbers: uint32, numbers of chunks in rising order, or of slots in the order of their chunks; then NO_CHUNK.
    model_rows: number of rows of the model, or of all slots.
    first_rows: of slots, (k,) uint32, the number of each chunk's first row in the model; None if nobody asks for it.
    """

    numbers: DeviceArray
    model_rows: int
    first_rows: DeviceArray | None = None

    @property
    def rows(self) -> int:
        """Number of rows of a launch."""
        return CHUNK_ROWS * self.numbers.shape[0]

    @property
    def key(self) -> tuple[object, ...]:
        """All that launches over these chunks depend on, except the numbers of the chunks."""
        first = None if self.first_rows is None else self.first_rows.buffer
        return self.numbers.buffer, self.numbers.shape, self.model_rows, first

    @property
    def arguments(self) -> tuple[DeviceArray, int]:
        """The kernels' arguments CHUNK_PARAMETERS."""
        return self.numbers, self.model_rows


def padded_chunks(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """The numbers of chunks, then NO_CHUNK, in one of few lengths, so that arrays and command buffers are reused.

    The length is at most a quarter more than needed, or 1.
    """
    wanted = max(len(numbers), 1)
    unit = 1 << max(wanted.bit_length() - 3, 0)
    padded = np.full(-(-wanted // unit) * unit, NO_CHUNK, np.uint32)
    padded[: len(numbers)] = numbers
    return padded


def send_chunks(
    work: Workspace,
    name: str,
    numbers: NDArray[np.uint32],
    model_rows: int,
    first_rows: NDArray[np.integer[Any]] | None = None,
) -> ChunkList:
    """Send a list (`ChunkList`) to the workspace's array `name`, and its first rows to another."""
    padded = padded_chunks(numbers)
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
    """Send a list as `send_chunks` does, without any NO_CHUNK."""
    sent = []
    for array, values in ((name, numbers), (f"{name}_rows", first_rows)):
        sent.append(work.array(array, values.shape, np.uint32))
        sent[-1].set(values.astype(np.uint32))
    return ChunkList(sent[0], model_rows, sent[1])


@dataclass(frozen=True, eq=False)
class ChunkNumbers:
    """Chunks of a streamed model, in rising order, of which only some at a time have room on the device.

    numbers: their numbers.
    """

    numbers: NDArray[np.integer[Any]]

    @property
    def rows(self) -> int:
        """Number of rows of all launches."""
        return CHUNK_ROWS * len(self.numbers)
