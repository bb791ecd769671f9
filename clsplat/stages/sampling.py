# SPDX-License-Identifier: Apache-2.0
"""Launches sampling.cl: scales that are no less than what the pictures can show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clsplat.camera import Camera, ProjectionKind
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import AnyGaussians, parts

GAUSSIAN_BYTES = 4
"""Bytes of each Gaussian: its least scale."""


@dataclass(frozen=True, eq=False)
class UploadedCameras:
    """Cameras of one projection, (views, CAMERA), that count from where the means do."""

    kind: ProjectionKind
    values: DeviceArray


def upload_cameras(device: Device, cameras: Sequence[Camera]) -> list[UploadedCameras]:
    """The cameras by their projections."""
    by_kind: dict[int, list[Camera]] = {}
    for camera in cameras:
        by_kind.setdefault(id(camera.kind), []).append(camera)
    return [
        UploadedCameras(group[0].kind, upload(device, np.stack([pack_camera(camera) for camera in group])))
        for group in by_kind.values()
    ]


@stage("sampling")
def sampling_limits(
    device: Device, work: Workspace, gaussians: AnyGaussians, cameras: Sequence[UploadedCameras], least: DeviceArray
) -> None:
    """Fill least (n,): the natural log of the least standard deviation, in world units, that the pictures of the
    cameras can show of each Gaussian (Yu et al. 2024, Mip-Splatting, section 5.1); -1e30 for one that is in none."""
    for start, stop, (part,) in parts(work, gaussians):
        for index, group in enumerate(cameras):
            kernel = device.kernels("sampling", LANES=1, **group.kind.defines).sampling_limits
            arrays = (group.values, part["means"], least.rows(start, stop))
            launch_items(device, kernel, part.count, part.count, group.values.shape[0], int(index > 0), *arrays)


@stage("sampling")
def limit_scales(device: Device, work: Workspace, gaussians: AnyGaussians, least: DeviceArray) -> None:
    """Make the log scales that are less than `least` (n,) that."""
    kernel = device.kernels("sampling", LANES=1).limit_scales
    for start, stop, (part,) in parts(work, gaussians, keep=True):
        launch_items(device, kernel, part.count, part.count, least.rows(start, stop), part["log_scales"])
