# SPDX-License-Identifier: Apache-2.0
"""Launches pose.cl: the gradient with respect to the pose and the lens of a training view's camera."""

from __future__ import annotations

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import POSE_ROWS
from clsplat.stages.device_gaussians import DeviceGaussians

POSE_NUMBERS, LENS_NUMBERS = 6, 4
"""Number of parameters of a pose (rotation, translation) and of a lens (logs of the focal lengths, principal
point)."""


def sums_of(work: Workspace, count: int, numbers: int = POSE_NUMBERS) -> DeviceArray:
    """Return an array for partial sums of the gradient of a pose or lens, which `pose_rows` or `lens_rows` fills.

    It has a row of `numbers` sums for every POSE_ROWS of the `count` Gaussians.
    """
    return work.array(f"rows_of_{numbers}", (-(-count // POSE_ROWS), numbers))


@stage("pose")
def pose_rows(
    device: Device,
    gaussians: DeviceGaussians,
    camera_array: DeviceArray,
    tile_counts: DeviceArray,
    gradients: DeviceGaussians,
    sums: DeviceArray,
    first_row: int = 0,
) -> None:
    """Compute the gradient with respect to a camera's pose, as a partial sum for every POSE_ROWS Gaussians.

    device: the device with the kernel switches of the camera model.
    gaussians: all Gaussians of the model, or consecutive rows of it.
    tile_counts: their tile counts in the view. Gaussians with a count of 0 are left out.
    gradients: the gradients with respect to the parameters of these Gaussians.
    sums: (ceil(rows of the model / POSE_ROWS), 6), of which the rows of these Gaussians are filled.
    first_row: the model's row that is the first of `gaussians`, a multiple of POSE_ROWS.
    """
    launch_items(
        device,
        device.kernels("pose", {"LANES": 1}).pose_rows,
        -(-gaussians.count // POSE_ROWS),
        gaussians.count,
        first_row // POSE_ROWS,
        gaussians.coefficients,
        camera_array,
        tile_counts,
        *(gaussians[group] for group in ("means", "quaternions", "sh_rest")),
        *(gradients[group] for group in ("means", "quaternions", "sh_dc")),
        sums,
    )


@stage("pose")
def lens_rows(
    device: Device, tile_counts: DeviceArray, by_lens: DeviceArray, sums: DeviceArray, first_row: int = 0
) -> None:
    """Compute the gradient with respect to a camera's lens, as a partial sum for every POSE_ROWS Gaussians.

    by_lens: (n, LENS_NUMBERS), the gradients of n Gaussians from `project_grad`.
    tile_counts, sums, first_row: as in `pose_rows`, with LENS_NUMBERS columns.
    """
    (n,) = tile_counts.shape
    kernel = device.kernels("pose", {"LANES": 1}).lens_rows
    launch_items(device, kernel, -(-n // POSE_ROWS), n, first_row // POSE_ROWS, tile_counts, by_lens, sums)


@stage("pose")
def sum_of(device: Device, work: Workspace, sums: DeviceArray) -> DeviceArray:
    """Sum the rows of partial sums (m, numbers) into one row (1, numbers).

    For a pose the row is the gradient with respect to the rotation and translation of `Camera.moved`; for a lens, with
    respect to ln fx, ln fy, cx and cy.
    """
    kernel, numbers, level = device.kernels("pose", {"LANES": 1}).pose_sums, sums.shape[1], 0
    while sums.shape[0] > 1:
        level += 1
        fewer = work.array(f"sums_of_{numbers}_{level}", (-(-sums.shape[0] // POSE_ROWS), numbers))
        launch_items(device, kernel, fewer.size, sums.shape[0], numbers, sums, fewer)
        sums = fewer
    return sums
