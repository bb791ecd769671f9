# SPDX-License-Identifier: Apache-2.0
"""Launches bounds.cl: the bounds of a model's chunks. Also lists of chunks, over whose rows other stages run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import DEFAULT_GROUP_ITEMS, launch_groups
from clsplat.device.profile import stage
from clsplat.layouts.columns import CHUNK_ROWS, NO_CHUNK
from clsplat.stages.device_gaussians import DeviceGaussians

BOUNDS_FLOATS = 7
"""Floats for each chunk's bounds: least and greatest coordinates of the means, greatest log scale."""


@dataclass(frozen=True, eq=False)
class ChunkList:
    """Chunks of a model over whose rows a launch runs (`kernels/shared/chunks.h`).

    numbers: uint32, numbers of chunks in rising order, then NO_CHUNK.
    model_rows: number of rows of the model.
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
    """The numbers of chunks, then NO_CHUNK, in one of few lengths, so that arrays and command buffers are reused.

    The length is at most a quarter more than needed, or 1.
    """
    wanted = max(len(numbers), 1)
    unit = 1 << max(wanted.bit_length() - 3, 0)
    padded = np.full(-(-wanted // unit) * unit, NO_CHUNK, np.uint32)
    padded[: len(numbers)] = numbers
    return padded


def send_chunks(work: Workspace, name: str, numbers: NDArray[np.uint32], model_rows: int) -> ChunkList:
    """Send a list of chunks, in rising order, to the workspace's array `name`."""
    padded = padded_chunks(numbers)
    array = work.array(name, padded.shape, np.uint32)
    array.send(padded)
    return ChunkList(array, model_rows)


@stage("bounds")
def bounds(device: Device, work: Workspace, gaussians: DeviceGaussians, chunks: ChunkList) -> Float32:
    """The bounds (chunks, BOUNDS_FLOATS) of these chunks.

    Bounds of NO_CHUNK are empty: from infinity to -infinity.
    """
    count = chunks.numbers.shape[0]
    items = 1 if device.shape.lanes > 1 or device.max_group < DEFAULT_GROUP_ITEMS else DEFAULT_GROUP_ITEMS
    found = work.array("chunk_bounds", (count, BOUNDS_FLOATS))
    kernel = device.kernels("bounds", {"ITEMS": items}).bounds
    launch_groups(device, kernel, count, items, *chunks.arguments, gaussians["means"], gaussians["log_scales"], found)
    return found.get()
