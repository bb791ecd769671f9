# SPDX-License-Identifier: Apache-2.0
"""Launches grid.cl: a photograph's bilateral grid, its gradient and its update by Adam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid, launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import GRID_SHAPE
from clsplat.stages.appearance import APPEARANCE_BETA1, APPEARANCE_BETA2, APPEARANCE_EPSILON

GRID_FLOATS = int(np.prod(GRID_SHAPE))


@dataclass(frozen=True, eq=False)
class Grids:
    """Grids of all photographs, (photographs, *GRID_SHAPE) float32, and their Adam moments.

    mean: (*GRID_SHAPE,), the mean of the initial grids over the photographs, which `centre_grids` keeps.
    """

    grids: DeviceArray
    first: DeviceArray
    second: DeviceArray
    mean: DeviceArray

    @classmethod
    def on(cls, device: Device, grids: NDArray[np.float32]) -> Grids:
        """Upload these grids, with Adam moments of zero."""
        zeros = np.zeros_like(grids)
        mean = grids.mean(axis=0, dtype=np.float64).astype(np.float32)
        return cls(*(upload(device, values) for values in (grids, zeros, zeros, mean)))


def _spans(width: int, height: int) -> tuple[float, float]:
    """Return the number of columns and of rows of a grid that a pixel spans."""
    return (GRID_SHAPE[2] - 1) / width, (GRID_SHAPE[1] - 1) / height


def device_bytes(photographs: int, sizes: Sequence[tuple[int, int]]) -> int:
    """Bytes per pixel, padding included: the planes of the transformed image, and a share of the other arrays.

    These are the grids, their moments and mean, the gradient with respect to a grid, and the gradient's sums along
    image rows, for the largest of the `sizes` (width, height).
    """
    lines = max((height for _, height in sizes), default=0) * GRID_SHAPE[2] * 12 * GRID_SHAPE[0]
    held = 4 * (3 * GRID_FLOATS * photographs + 2 * GRID_FLOATS + lines)
    return 12 + -(-held // max((width * height for width, height in sizes), default=1))


@stage("appearance")
def apply_grid(
    device: Device, work: Workspace, grids: Grids, photograph: int, image: DeviceArray, size: tuple[int, int]
) -> DeviceArray:
    """Apply the colour transforms of a photograph's grid to `image`, and return the new planes (3, rows, stride).

    photograph: the photograph's index in `grids`.
    size: width and height of the image in pixels, without padding.
    """
    _, rows, stride = image.shape
    seen = work.array("appearance_seen", image.shape)
    sizes = (photograph, stride, rows * stride, *_spans(*size))
    kernel = device.kernels("grid", {"LANES": 1}).slice
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
    size: tuple[int, int],
    weight: float,
    place: int = 0,
) -> DeviceArray:
    """Compute the gradients with respect to a photograph's grid and, in place, with respect to the image.

    Returns the gradient with respect to the grid, plus `weight` times the gradient of the grid's total variation.

    gradient: planes (3, rows, stride), the gradient with respect to the transformed image. It is overwritten by the
    gradient with respect to `image`, the image before the transform.
    place: index of the view in the batch; the result of each view is in an array of its own.
    """
    (width, height), (_, rows, stride) = size, image.shape
    plane, (across, down) = rows * stride, _spans(width, height)
    lines = work.array("appearance_lines", (height, GRID_SHAPE[2], 12, GRID_SHAPE[0]))
    by_grid = work.array(f"appearance_by_grid_{place}", GRID_SHAPE)
    kernels = device.kernels("grid", {"LANES": 1})
    sizes, sources = (width, stride, plane, across), (image, gradient)
    launch_grid(device, kernels.line_sums, (GRID_SHAPE[2], height, 3), *sizes, *sources, lines)
    launch_items(
        device, kernels.grid_sums, GRID_FLOATS, photograph, height, down, float(weight), grids.grids, lines, by_grid
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
    """Update a photograph's grid by Adam. Nothing changes if the step's pass has stopped (kernels/duplicate.cl).

    by_grid: the gradient with respect to the grid.
    visit: the number of this update of the grid, from 1.
    rate: learning rate.
    """
    kernel = device.kernels("grid", {"LANES": 1}).move_grid
    constants = (
        rate / (1 - APPEARANCE_BETA1**visit),
        (1 - APPEARANCE_BETA2**visit) ** -0.5,
        APPEARANCE_BETA1,
        APPEARANCE_BETA2,
        APPEARANCE_EPSILON,
    )
    state = (grids.grids, grids.first, grids.second)
    launch_items(device, kernel, GRID_FLOATS, photograph, *constants, readback, by_grid, *state)


@stage("appearance")
def centre_grids(device: Device, grids: Grids, readback: DeviceArray) -> None:
    """Shift all grids so that their mean over the photographs is that of the initial grids. Nothing changes if the
    step's pass has stopped."""
    kernel = device.kernels("grid", {"LANES": 1}).centre_grids
    launch_items(device, kernel, GRID_FLOATS, grids.grids.shape[0], readback, grids.mean, grids.grids)
