# SPDX-License-Identifier: Apache-2.0
"""Launches sampling.cl: lower limits of the scales from the photographs' sampling rate, as in Mip-Splatting."""

from __future__ import annotations

from collections.abc import Sequence

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.stages.device_camera import UploadedCameras
from clsplat.stages.device_gaussians import AnyGaussians, parts
from clsplat.stages.region import region_build

SAMPLING_GAUSSIAN_BYTES = 4
"""Bytes per Gaussian for the lower limit of its scales."""


@stage("sampling")
def sampling_limits(
    device: Device,
    work: Workspace,
    gaussians: AnyGaussians,
    cameras: Sequence[UploadedCameras],
    least: DeviceArray,
    region: TrainedRegion | None = None,
) -> None:
    """Fill `least` (n,) with the natural log of the smallest standard deviation, in world units, that the photographs
    resolve.

    See Yu et al. 2024, Mip-Splatting, section 5.1. A Gaussian that no camera sees gets -1e30.

    cameras: the cameras of all photographs, from `upload_cameras`.
    region: the region in which scales have limits, in the coordinates of the means; None for everywhere. Gaussians
    outside it get -1e30.
    """
    defines, bounds = region_build(region)
    for start, stop, (part,) in parts(work, gaussians):
        for index, group in enumerate(cameras):
            kernel = device.kernels("sampling", {"LANES": 1, **group.model.defines, **defines}).sampling_limits
            arrays = (group.values, part["means"], least.rows(start, stop))
            launch_items(
                device, kernel, part.count, part.count, group.values.shape[0], int(index > 0), *arrays, *bounds
            )


@stage("sampling", limit_scales=1)
def limit_scales(device: Device, work: Workspace, gaussians: AnyGaussians, least: DeviceArray) -> None:
    """Replace each log scale of Gaussian i that is less than least[i] by least[i]. least: (n,)."""
    kernel = device.kernels("sampling", {"LANES": 1}).limit_scales
    for start, stop, (part,) in parts(work, gaussians, keep=True):
        launch_items(device, kernel, part.count, part.count, least.rows(start, stop), part["log_scales"])
