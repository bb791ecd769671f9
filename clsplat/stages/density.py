# SPDX-License-Identifier: Apache-2.0
"""Launches density.cl: the statistics that density control reads, and the moving of rows that it orders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import group_shapes
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostArray, HostGaussians
from clsplat.stages.project import Projected, Screen

NO_ROW = np.uint32(0xFFFFFFFF)
"""Entry of a list of rows that stands for a row of zeros."""


def gaussian_bytes(*, agreement: bool, contributions: bool) -> int:
    """Bytes of each Gaussian's statistics: sums, views, radii; agreeing views; two epochs of two contributions."""
    return 4 * (3 + agreement + 4 * contributions)


CONTRIBUTIONS = ("current_totals", "current_largest", "whole_totals", "whole_largest")


@dataclass(frozen=True, eq=False)
class DensityStatistics:
    """Since the last densification, per Gaussian: gradient_sums, seen (views), radii (largest, in pixels), agreeing
    (views with a gradient over the threshold; None where they are not counted); (n,).

    CONTRIBUTIONS to the pictures of an epoch of the training views, in pixels, whenever Gaussians were densified: over
    the views of the current one and of the last whole one, and the largest to one of them. Infinite, from its first
    view on, for Gaussians that were not there or not looked at; None where nothing goes by them.
    """

    gradient_sums: DeviceArray
    seen: DeviceArray
    radii: DeviceArray
    agreeing: DeviceArray | None = None
    current_totals: DeviceArray | None = None
    current_largest: DeviceArray | None = None
    whole_totals: DeviceArray | None = None
    whole_largest: DeviceArray | None = None

    def rows(self, start: int, stop: int) -> DensityStatistics:
        """The statistics of the Gaussians from start to before stop."""
        return DensityStatistics(**{name: array.rows(start, stop) for name, array in self.named().items()})

    def named(self) -> dict[str, DeviceArray]:
        """Every array by its name, which it has in a checkpoint too."""
        return {name: array for name, array in vars(self).items() if array is not None}

    def moved(self, rows: NDArray[np.uint32], fresh: NDArray[np.bool_], *, densified: bool) -> dict[str, Float32]:
        """The arrays that are kept, on the host by `named`, when row j becomes what row rows[j] was: contributions,
        infinite for fresh rows; and everything else if nothing was densified."""
        going_on = {name: array for name, array in self.named().items() if name in CONTRIBUTIONS or not densified}
        values = {name: array.get()[rows] for name, array in going_on.items()}
        for array in values.values():
            array[fresh] = np.inf
        return values

    def load(self, values: Mapping[str, Float32]) -> None:
        """Take those of the arrays `named` that `values` has from the host."""
        for name, array in self.named().items():
            if name in values:
                array.set(values[name])

    def forget_contributions(self) -> None:
        """Forget the Gaussians' contributions, until the next epoch is over."""
        for name, array in self.named().items():
            if name in CONTRIBUTIONS:
                array.fill(np.inf)

    def next_epoch(self) -> DensityStatistics:
        """The same with the epoch under way as the last whole one, and a new one that begins."""
        if self.whole_totals is None or self.whole_largest is None:
            return self
        self.whole_totals.fill(0.0)
        self.whole_largest.fill(0.0)
        return replace(
            self,
            current_totals=self.whole_totals,
            current_largest=self.whole_largest,
            whole_totals=self.current_totals,
            whole_largest=self.current_largest,
        )


def new_statistics(
    device: Device, count: int, *, agreement: bool = False, contributions: bool = False
) -> DensityStatistics:
    """Statistics of `count` Gaussians of which nothing is known yet: zeros, contributions infinite."""
    names = ["gradient_sums", "seen", "radii", *(["agreeing"] if agreement else [])]
    arrays = {
        name: allocate(device, (count,), np.float32) for name in [*names, *(CONTRIBUTIONS if contributions else ())]
    }
    for name, array in arrays.items():
        array.fill(np.inf if name in CONTRIBUTIONS else 0.0)
    return DensityStatistics(**arrays)


@stage("statistics")
def add_statistics(
    device: Device,
    statistics: DensityStatistics,
    camera: Camera,
    projected: Projected,
    screen: Screen,
    threshold: float = 0.0,
) -> None:
    """Add one view: the norm of each visible mean's gradient, in NDC as the paper's threshold is. Where agreeing views
    are counted, those with at least the threshold count."""
    n = projected.tile_counts.shape[0]
    kernels = device.kernels("density")
    to_ndc = (0.5 * camera.width, 0.5 * camera.height)
    view, sums = (projected.tile_counts, screen.gradients), (statistics.gradient_sums, statistics.seen)
    launch_items(device, kernels.density_statistics, n, n, *to_ndc, *view, projected.splats, *sums, statistics.radii)
    if statistics.agreeing is not None:
        launch_items(device, kernels.view_agreement, n, n, *to_ndc, threshold, *view, statistics.agreeing)


@stage("statistics")
def add_contributions(
    device: Device, statistics: DensityStatistics, projected: Projected, contributions: DeviceArray, area: float
) -> None:
    """Add what one view's Gaussians contributed, (n,), to the epoch under way. area: what a pixel counts, as with less
    than the full resolution it is several."""
    n = projected.tile_counts.shape[0]
    kernel, view = device.kernels("density").contribution_statistics, (projected.tile_counts, contributions)
    launch_items(device, kernel, n, n, area, *view, statistics.current_totals, statistics.current_largest)


def try_gather(device: Device, count: int, source: AnyGaussians) -> None:
    """Launch what `gather` does, on arrays that are there already and of no use afterwards; for `launch.only_tried`."""
    if isinstance(source, DeviceGaussians):
        array, kernel = source["opacity_logits"], device.kernels("density").gather_rows
        few = min(count, source.count)
        launch_items(device, kernel, few, few, 1, array, array, array)


def gather(device: Device, rows: NDArray[np.uint32], source: AnyGaussians) -> AnyGaussians:
    """New arrays, where the source is, of which row j is row rows[j] of the source, or zeros at NO_ROW. Parameters and
    moments alike."""
    count = len(rows)
    if isinstance(source, HostGaussians):
        host = {name: array.values[np.where(rows == NO_ROW, 0, rows)] for name, array in source.arrays.items()}
        for values in host.values():
            values[rows == NO_ROW] = 0.0
        return replace(source, count=count, arrays={name: HostArray(values) for name, values in host.items()})
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
    rest = np.zeros(group_shapes(source.count, coefficients)["sh_rest"], np.float32)
    rest[:, : source.coefficients - 1] = source["sh_rest"].get()
    if isinstance(source, HostGaussians):
        return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": HostArray(rest)})
    return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": upload(device, rest)})
