# SPDX-License-Identifier: Apache-2.0
"""Launches project.cl and project_grad.cl: Gaussians to ellipses on the image, and the gradient back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import CAMERA, SPLAT, TILE
from clsplat.device.profile import stage
from clsplat.gaussians import Gaussians

GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
"""The parameter groups on the device: as in `Gaussians`, with SH split into its constant and the rest."""


@dataclass(frozen=True, eq=False)
class DeviceGaussians:
    """Parameters, or their gradients or moments: arrays by group name, the first axis of each being `count`."""

    count: int
    coefficients: int
    arrays: dict[str, DeviceArray]

    def __getitem__(self, group: str) -> DeviceArray:
        return self.arrays[group]


def group_shapes(count: int, coefficients: int) -> dict[str, tuple[int, ...]]:
    """The arrays of `count` Gaussians with `coefficients` SH coefficients a channel."""
    return {
        "means": (count, 3),
        "quaternions": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count,),
        "sh_dc": (count, 3),
        "sh_rest": (count, coefficients - 1, 3),
    }


def allocate_gaussians(device: Device, count: int, coefficients: int, *, zero: bool = False) -> DeviceGaussians:
    """Arrays for `count` Gaussians."""
    arrays = {name: allocate(device, shape, np.float32) for name, shape in group_shapes(count, coefficients).items()}
    if zero:
        for array in arrays.values():
            array.fill(0.0)
    return DeviceGaussians(count, coefficients, arrays)


def upload_gaussians(device: Device, gaussians: Gaussians) -> DeviceGaussians:
    """A copy on the device."""
    host = {
        "means": gaussians.means,
        "quaternions": gaussians.quaternions,
        "log_scales": gaussians.log_scales,
        "opacity_logits": gaussians.opacity_logits,
        "sh_dc": gaussians.sh[:, 0],
        "sh_rest": gaussians.sh[:, 1:],
    }
    arrays = {name: upload(device, np.ascontiguousarray(values, np.float32)) for name, values in host.items()}
    return DeviceGaussians(len(gaussians), gaussians.sh.shape[1], arrays)


def download_gaussians(gaussians: DeviceGaussians) -> Gaussians:
    """A copy on the host."""
    host = {name: array.get() for name, array in gaussians.arrays.items()}
    return Gaussians(
        means=host["means"],
        quaternions=host["quaternions"],
        log_scales=host["log_scales"],
        opacity_logits=host["opacity_logits"],
        sh=np.concatenate([host["sh_dc"][:, None], host["sh_rest"]], axis=1),
    )


def pack_camera(camera: Camera) -> NDArray[np.float32]:
    """A camera in the order of `layout.CAMERA`: its values rounded to float32, and as _LOW what that left of them."""
    half_w, half_h = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    values = {
        "FX": camera.fx,
        "FY": camera.fy,
        "CX": camera.cx,
        "CY": camera.cy,
        "NEAR": camera.near,
        "XMIN": -camera.cx / camera.fx - 0.3 * half_w,
        "XMAX": (camera.width - camera.cx) / camera.fx + 0.3 * half_w,
        "YMIN": -camera.cy / camera.fy - 0.3 * half_h,
        "YMAX": (camera.height - camera.cy) / camera.fy + 0.3 * half_h,
    }
    for row in range(3):
        values[f"T{row}"] = float(camera.translation[row])
        values["P" + "XYZ"[row]] = float(camera.position[row])
        for column in range(3):
            values[f"R{row}{column}"] = float(camera.rotation[row, column])
    rounded = {name: np.float32(value) for name, value in values.items()}
    rounded.update({f"{name}_LOW": np.float32(value - float(rounded[name])) for name, value in values.items()})
    return np.array([rounded[name] for name in CAMERA], np.float32)


def tiles_of(camera: Camera) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


@dataclass(frozen=True, eq=False)
class Projected:
    """splats (n, SPLAT), tile_counts (n): 0 where culled."""

    splats: DeviceArray
    tile_counts: DeviceArray


@stage("project")
def project(
    device: Device, work: Workspace, gaussians: DeviceGaussians, camera: Camera, camera_array: DeviceArray
) -> Projected:
    """Project all Gaussians (Kerbl et al. 2023, section 4) and count the tiles that each reaches."""
    n = gaussians.count
    splats = work.array("splats", (n, len(SPLAT)))
    tile_counts = work.array("tile_counts", (n,), np.uint32)
    tiles_x, tiles_y = tiles_of(camera)
    launch_items(
        device,
        device.kernels("project").project,
        -(-n // device.shape.lanes),
        n,
        gaussians.coefficients,
        tiles_x,
        tiles_y,
        camera_array,
        *(gaussians[group] for group in GROUPS),
        splats,
        tile_counts,
    )
    return Projected(splats, tile_counts)


@dataclass(frozen=True, eq=False)
class Slots:
    """values (pairs, SLOT), where those of Gaussian i begin at first_slots[i]; without first_slots they are added up
    already: (n, SLOT)."""

    values: DeviceArray
    first_slots: DeviceArray | None = None


@stage("project_grad")
def add_slots(
    device: Device,
    work: Workspace,
    tile_counts: DeviceArray,
    slots: Slots,
    sums: DeviceArray | None,
    *,
    absolute: bool = False,
) -> DeviceArray:
    """Add one band's slots to the sums by Gaussian (n, SLOT), which begin as None; bands have to come in order."""
    (n,) = tile_counts.shape
    if sums is None:
        sums = work.array("slot_sums", (n, slots.values.shape[1]))
        sums.fill(0.0)
    defines = {"ABSOLUTE_GRADIENTS": True} if absolute else {}
    launch_items(
        device,
        device.kernels("project_grad", **defines).add_slots,
        n if slots.values.shape[0] else 0,
        n,
        tile_counts,
        slots.first_slots,
        slots.values,
        sums,
    )
    return sums


@stage("project_grad")
def project_grad(
    device: Device,
    gaussians: DeviceGaussians,
    camera_array: DeviceArray,
    projected: Projected,
    slots: Slots,
    gradients: DeviceGaussians,
    screen: DeviceArray,
    *,
    absolute: bool = False,
) -> None:
    """Fill the visible Gaussians' rows of `gradients` and `screen` (n, 2) from the pairs' slots."""
    defines = {"ABSOLUTE_GRADIENTS": absolute, "ADDED_UP": slots.first_slots is None}
    defines = {name: True for name, wanted in defines.items() if wanted}
    n = gaussians.count
    launch_items(
        device,
        device.kernels("project_grad", **defines).project_grad,
        -(-n // device.shape.lanes) if slots.values.shape[0] else 0,
        n,
        gaussians.coefficients,
        camera_array,
        projected.tile_counts,
        slots.first_slots or projected.tile_counts,  # not looked at where they are added up
        slots.values,
        projected.splats,
        *(gaussians[group] for group in GROUPS),
        *(gradients[group] for group in GROUPS),
        screen,
    )
