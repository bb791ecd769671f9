# SPDX-License-Identifier: Apache-2.0
"""Lists of the chunks of a model over whose rows stages run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.division import listed_chunks
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK


@dataclass(frozen=True, eq=False)
class ChunkList:
    """Chunks of a model over whose rows a launch runs (`kernels/shared/chunks.h`), or slots of a pool that have them.

    numbers: uint32, numbers of chunks in rising order, or of slots in the order of their chunks; then NO_CHUNK.
    model_rows: number of rows of the model, or of all slots.
    """

    numbers: DeviceArray
    model_rows: int

    @property
    def rows(self) -> int:
        """Number of rows of a launch."""
        return CHUNK_ROWS * self.numbers.shape[0]

    @property
    def key(self) -> tuple[object, ...]:
        """All that launches over these chunks depend on, except the numbers of the chunks."""
        return self.numbers.buffer, self.numbers.shape, self.model_rows

    @property
    def arguments(self) -> tuple[DeviceArray, int]:
        """The kernels' arguments CHUNK_PARAMETERS."""
        return self.numbers, self.model_rows


def padded_chunks(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """The numbers of chunks, then NO_CHUNK, in one of few lengths, so that arrays and command buffers are reused."""
    padded = np.full(listed_chunks(len(numbers)), NO_CHUNK, np.uint32)
    padded[: len(numbers)] = numbers
    return padded


def send_chunks(work: Workspace, name: str, numbers: NDArray[np.uint32], model_rows: int) -> ChunkList:
    """Send a list (`ChunkList`) to the workspace's array `name`."""
    padded = padded_chunks(numbers)
    array = work.array(name, padded.shape, np.uint32)
    array.send(padded)
    return ChunkList(array, model_rows)


def exact_chunks(work: Workspace, name: str, numbers: NDArray[np.integer[Any]], model_rows: int) -> ChunkList:
    """Send a list as `send_chunks` does, without any NO_CHUNK."""
    array = work.array(name, numbers.shape, np.uint32)
    array.set(numbers.astype(np.uint32))
    return ChunkList(array, model_rows)


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
