# SPDX-License-Identifier: Apache-2.0
"""Launches grid.cl: a photograph's bilateral grid, its gradient and Adam's step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid, launch_items
from clsplat.device.profile import stage
from clsplat.stages.appearance import BETA1, BETA2, EPSILON

SHAPE = (8, 16, 16, 3, 4)
"""Levels, rows and columns of a grid, and its colour maps."""
FLOATS = int(np.prod(SHAPE))


@dataclass(frozen=True, eq=False)
class Grids:
    """Grids of all photographs, (photographs, *SHAPE) float32, and Adam's moments of these."""

    grids: DeviceArray
    first: DeviceArray
    second: DeviceArray

    @classmethod
    def on(cls, device: Device, grids: NDArray[np.float32]) -> Grids:
        """These grids, and moments of zero."""
        zeros = np.zeros_like(grids)
        return cls(upload(device, grids), upload(device, zeros), upload(device, zeros))


def _spans(width: int, height: int) -> tuple[float, float]:
    """Columns of the grid a pixel, and rows."""
    return (SHAPE[2] - 1) / width, (SHAPE[1] - 1) / height


def device_bytes(photographs: int, sizes: Sequence[tuple[int, int]]) -> int:
    """Bytes of each pixel with its padding: the planes of what is seen, and a share of the grids with their moments and
    of the sums of lines in the largest of these sizes, (width, height)."""
    lines = max((height for _, height in sizes), default=0) * SHAPE[2] * 12 * SHAPE[0]
    held = 4 * (3 * FLOATS * photographs + FLOATS + lines)
    return 12 + -(-held // max((width * height for width, height in sizes), default=1))


@stage("appearance")
def apply_grid(
    device: Device, work: Workspace, grids: Grids, photograph: int, image: DeviceArray, width: int, height: int
) -> DeviceArray:
    """Planes (3, rows, stride) of the image of width x height pixels, with the photograph's colours."""
    _, rows, stride = image.shape
    seen = work.array("appearance_seen", image.shape)
    sizes = (photograph, stride, rows * stride, *_spans(width, height))
    kernel = device.kernels("grid", LANES=1).slice
    launch_grid(device, kernel, (stride, rows), *sizes, grids.grids, image, seen)
    return seen


@stage("appearance")
def grid_gradient(
    device: Device,
    work: Workspace,
    grids: Grids,
    photograph: int,
    image: DeviceArray,
    gradient: DeviceArray,
    width: int,
    height: int,
    weight: float,
    place: int = 0,
) -> DeviceArray:
    """Make the gradient by what was seen that by the image, in its place. Returns that by the photograph's grid, with
    `weight` times its variation's, for each `place` in a batch in an array of its own."""
    _, rows, stride = image.shape
    plane, (across, down) = rows * stride, _spans(width, height)
    lines = work.array("appearance_lines", (height, SHAPE[2], 12, SHAPE[0]))
    by_grid = work.array(f"appearance_by_grid_{place}", SHAPE)
    kernels = device.kernels("grid", LANES=1)
    sizes, sources = (width, stride, plane, across), (image, gradient)
    launch_grid(device, kernels.line_sums, (SHAPE[2], height, 3), *sizes, *sources, lines)
    launch_items(
        device, kernels.grid_sums, FLOATS, photograph, height, down, float(weight), grids.grids, lines, by_grid
    )
    pixel = (photograph, stride, plane, across, down, grids.grids, *sources)
    launch_grid(device, kernels.slice_gradient, (width, height), *pixel)
    return by_grid


@stage("appearance")
def step_grid(
    device: Device,
    grids: Grids,
    photograph: int,
    by_grid: DeviceArray,
    visit: int,
    rate: float,
    readback: DeviceArray,
) -> None:
    """Adam's step for the photograph's grid, at its visit number `visit` (from 1). A step by capacity that has stopped
    changes nothing."""
    kernel = device.kernels("grid", LANES=1).move_grid
    constants = (rate / (1 - BETA1**visit), (1 - BETA2**visit) ** -0.5, BETA1, BETA2, EPSILON)
    state = (grids.grids, grids.first, grids.second)
    launch_items(device, kernel, FLOATS, photograph, *constants, readback, by_grid, *state)


@stage("appearance")
def centre_grids(device: Device, grids: Grids, readback: DeviceArray) -> None:
    """Make the mean of all grids the identity. A step by capacity that has stopped changes nothing."""
    kernel = device.kernels("grid", LANES=1).centre_grids
    launch_items(device, kernel, FLOATS, grids.grids.shape[0], readback, grids.grids)
