# SPDX-License-Identifier: Apache-2.0
"""Launches pose.cl: the gradient by the pose of the camera that a step's view has."""

from __future__ import annotations

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import POSE_ROWS
from clsplat.device.profile import stage
from clsplat.stages.device_gaussians import DeviceGaussians


def sums_of(work: Workspace, count: int) -> DeviceArray:
    """Room for the sums of `count` Gaussians: `pose_rows` fills it, with one row for each POSE_ROWS of them."""
    return work.array("pose_rows", (-(-count // POSE_ROWS), 6))


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
    """Add up what the gradients of these Gaussians say of the camera, in `sums` (ceil(n / POSE_ROWS), 6) of a model in
    which `first_row` is their first, a multiple of POSE_ROWS. device: with the switches of the camera's projection."""
    launch_items(
        device,
        device.kernels("pose", LANES=1).pose_rows,
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
def pose_gradient(device: Device, work: Workspace, sums: DeviceArray) -> DeviceArray:
    """The sum (1, 6) of all sums (m, 6): by the turn and the shift of `Camera.moved`."""
    kernel, level = device.kernels("pose", LANES=1).pose_sums, 0
    while sums.shape[0] > 1:
        level += 1
        fewer = work.array(f"pose_sums_{level}", (-(-sums.shape[0] // POSE_ROWS), 6))
        launch_items(device, kernel, fewer.size, sums.shape[0], sums, fewer)
        sums = fewer
    return sums
