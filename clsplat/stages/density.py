# SPDX-License-Identifier: Apache-2.0
"""Launches density.cl: the statistics that density control reads, and the moving of rows that it orders."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.stages.project import AnyGaussians, DeviceGaussians, HostArray, HostGaussians, Projected, group_shapes

NO_ROW = np.uint32(0xFFFFFFFF)
"""In a list of rows: a row of zeros."""


@dataclass(frozen=True, eq=False)
class DensityStatistics:
    """Since the last densification, per Gaussian: gradient_sums, seen (views), radii (largest, in pixels); (n,)."""

    gradient_sums: DeviceArray
    seen: DeviceArray
    radii: DeviceArray

    def rows(self, start: int, stop: int) -> DensityStatistics:
        """Of the Gaussians from start to before stop."""
        return DensityStatistics(*(a.rows(start, stop) for a in (self.gradient_sums, self.seen, self.radii)))


def new_statistics(device: Device, count: int) -> DensityStatistics:
    """Zeros for `count` Gaussians."""
    arrays = [allocate(device, (count,), np.float32) for _ in range(3)]
    for array in arrays:
        array.fill(0.0)
    return DensityStatistics(*arrays)


@stage("statistics")
def add_statistics(
    device: Device,
    statistics: DensityStatistics,
    camera: Camera,
    projected: Projected,
    screen: DeviceArray,
) -> None:
    """Add one view: the norm of each visible mean's gradient, from pixels to NDC, as the paper's threshold wants."""
    n = projected.tile_counts.shape[0]
    launch_items(
        device,
        device.kernels("density").density_statistics,
        n,
        n,
        0.5 * camera.width,
        0.5 * camera.height,
        projected.tile_counts,
        screen,
        projected.splats,
        statistics.gradient_sums,
        statistics.seen,
        statistics.radii,
    )


def _gather_on_host(rows: NDArray[np.uint32], source: HostGaussians) -> HostGaussians:
    arrays = {}
    for name, array in source.arrays.items():
        values = array.values[np.where(rows == NO_ROW, 0, rows)]
        values[rows == NO_ROW] = 0.0
        arrays[name] = HostArray(values)
    return replace(source, count=len(rows), arrays=arrays)


def gather(device: Device, rows: NDArray[np.uint32], source: AnyGaussians) -> AnyGaussians:
    """New arrays, where the source is, of which row j is row rows[j] of the source, or zeros at NO_ROW. Parameters and
    moments alike."""
    if isinstance(source, HostGaussians):
        return _gather_on_host(rows, source)
    count = len(rows)
    rows_array = upload(device, rows)
    kernel = device.kernels("density").gather_rows
    arrays = {}
    for name, shape in group_shapes(count, source.coefficients).items():
        arrays[name] = allocate(device, shape, np.float32)
        width = int(np.prod(shape[1:]))
        if width:
            launch_items(device, kernel, count, count, width, rows_array, source[name], arrays[name])
    return DeviceGaussians(count, source.coefficients, arrays)


def widen(device: Device, source: AnyGaussians, coefficients: int) -> AnyGaussians:
    """The same, where it was, with room for more SH coefficients, the new ones 0."""
    rest = np.zeros((source.count, coefficients - 1, 3), np.float32)
    rest[:, : source.coefficients - 1] = source["sh_rest"].get()
    if isinstance(source, HostGaussians):
        return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": HostArray(rest)})
    return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": upload(device, rest)})
