# SPDX-License-Identifier: Apache-2.0
"""Lists of the chunks that a launch runs over, such as the chunks that a view shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK


@dataclass(frozen=True, eq=False)
class ChunkList:
    """Chunks whose rows a launch runs over (`kernels/shared/chunks.h`). In a pool, the slots that hold the chunks.

    numbers: uint32, numbers of the chunks in rising order, or their slots in the same order; then NO_CHUNK as padding.
    model_rows: number of rows of the model, or of all slots of the pool.
    """

    numbers: DeviceArray
    model_rows: int

    @property
    def rows(self) -> int:
        """Number of rows that a launch runs over, padding included."""
        return CHUNK_ROWS * self.numbers.shape[0]

    @property
    def key(self) -> tuple[object, ...]:
        """Key for command buffers: everything that launches over these chunks depend on, except the chunks' numbers."""
        return self.numbers.buffer, self.numbers.shape, self.model_rows

    @property
    def arguments(self) -> tuple[DeviceArray, int]:
        """Kernel arguments for CHUNK_PARAMETERS of kernels/shared/chunks.h."""
        return self.numbers, self.model_rows


def padded_chunks(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Pad numbers of chunks with NO_CHUNK to one of few lengths, so that arrays and command buffers are reused.

    The length is at least 1, and at most a quarter more than needed.
    """
    wanted = max(len(numbers), 1)
    unit = 1 << max(wanted.bit_length() - 3, 0)
    padded = np.full(-(-wanted // unit) * unit, NO_CHUNK, np.uint32)
    padded[: len(numbers)] = numbers
    return padded


def send_chunks(work: Workspace, name: str, numbers: NDArray[np.uint32], model_rows: int) -> ChunkList:
    """Upload a padded list of chunks to the workspace's array `name`, without waiting for the device."""
    padded = padded_chunks(numbers)
    array = work.array(name, padded.shape, np.uint32)
    array.send(padded)
    return ChunkList(array, model_rows)


def exact_chunks(work: Workspace, name: str, numbers: NDArray[np.integer[Any]], model_rows: int) -> ChunkList:
    """Upload a list of chunks without padding to the workspace's array `name`."""
    array = work.array(name, numbers.shape, np.uint32)
    array.set(numbers.astype(np.uint32))
    return ChunkList(array, model_rows)


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
