# SPDX-License-Identifier: Apache-2.0
"""Launches density.cl: the statistics that density control reads, and the moving of rows that it orders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.marking import FRESH, MarkRules
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import SPLAT
from clsplat.device.profile import stage
from clsplat.gaussians import group_shapes
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostArray, HostGaussians, parts
from clsplat.stages.project import Projected, Screen
from clsplat.stages.scan import scan


def gaussian_bytes(*, agreement: bool, contributions: bool) -> int:
    """Bytes of each Gaussian's statistics: sums, views, radii; agreeing views; two epochs of two contributions."""
    return 4 * (3 + agreement + 4 * contributions)


SCORED = ("whole_totals", "whole_largest", "current_largest")
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
        if (start, stop) == (0, self.seen.shape[0]):
            return self
        return DensityStatistics(**{name: array.rows(start, stop) for name, array in self.named().items()})

    def named(self) -> dict[str, DeviceArray]:
        """Every array by its name, which it has in a checkpoint too."""
        return {name: array for name, array in vars(self).items() if array is not None}

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
    rays = camera.kind.rays
    kernels = device.kernels("density", **({"RAYS": camera.kind.defines["RAYS"]} if rays else {}))
    to_ndc = (0.5 * camera.width, 0.5 * camera.height)
    view, sums = (projected.tile_counts, screen.gradients), (statistics.gradient_sums, statistics.seen)
    sizes = (*to_ndc, camera.fx) if rays else to_ndc
    launch_items(device, kernels.density_statistics, n, n, *sizes, *view, projected.splats, *sums, statistics.radii)
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


@dataclass(frozen=True, eq=False)
class RowList:
    """Rows of a model as they are to become, on the device: (m,) uint32, each the row that it is a copy of, and FRESH.
    halves: how many, at its end, are halves: first one of each Gaussian that is split, then the other ones."""

    rows: DeviceArray
    halves: int

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.rows.shape[0]


@dataclass(frozen=True, eq=False)
class Marker:
    """Marks the Gaussians of a model by their statistics. What it writes lies in the scratch of `work` where a frame
    has its splats: there is no frame meanwhile, and the lists are good until the next one."""

    device: Device
    work: Workspace
    parameters: AnyGaussians
    statistics: DensityStatistics

    def scores(self, rules: MarkRules) -> Float32:
        """Mean gradients (n,) of what may be densified, less than 0 for the rest."""
        return _scored(self.device, self, rules).scores.get()

    def rows(self, rules: MarkRules, scores: Float32 | None = None) -> RowList:
        """List of the rows as they become by the rules; scores (n,): in place of those that `scores` has."""
        return _listed(self.device, self, rules, scores)


@dataclass(frozen=True, eq=False)
class _Scratch:
    """scores (n) f32; room for marks (3n), places (3n) and rows (2n), all u32."""

    scores: DeviceArray
    marks: DeviceArray
    places: DeviceArray
    rows: DeviceArray


@stage("density")
def _scored(device: Device, marker: Marker, rules: MarkRules) -> _Scratch:
    n, statistics, unit = marker.parameters.count, marker.statistics, device.row_alignment
    sizes = (n, 3 * n, 3 * n, 2 * n)
    begins = [0, *np.cumsum([-(-size // unit) * unit for size in sizes]).tolist()]
    space = marker.work.array("splats", (max(begins[-1], len(SPLAT) * n),), np.uint32)
    scores, *rest = (space.rows(begin, begin + size) for begin, size in zip(begins, sizes, strict=False))
    scratch = _Scratch(replace(scores, dtype=np.dtype(np.float32)), *rest)
    views = (statistics.gradient_sums, statistics.seen)
    known = [getattr(statistics, name) or statistics.seen for name in ("agreeing", *SCORED)]
    edges = (rules.gradient, rules.agreeing, rules.contribution, *rules.least)
    launch_items(device, device.kernels("density").density_scores, n, n, *edges, *views, *known, scratch.scores)
    return scratch


@stage("density")
def _listed(device: Device, marker: Marker, rules: MarkRules, scores: Float32 | None) -> RowList:
    n, model, kernels = marker.parameters.count, marker.parameters, device.kernels("density")
    scratch, counts = _scored(device, marker, rules), allocate(device, (2,), np.uint32)
    if scores is not None:
        scratch.scores.set(scores)
    columns = model.only("log_scales", "opacity_logits")
    edges = (rules.large, rules.transparent, rules.oversized, rules.oversized_half, rules.radius)
    for start, stop, (part,) in parts(marker.work, columns):
        some, arrays = stop - start, (scratch.scores, marker.statistics.radii, *part.arrays.values(), scratch.marks)
        launch_items(device, kernels.density_marks, some, n, start, some, *rules.strongest, *edges, *arrays)
    scan(device, marker.work, scratch.marks, scratch.places, counts)
    launch_items(device, kernels.density_rows, n, n, scratch.marks, scratch.places, scratch.rows, counts)
    total, splits = (int(number) for number in counts.get())
    return RowList(scratch.rows.reshaped(total + splits), 2 * splits)


def list_rows(device: Device, rows: NDArray[np.uint32], fresh: NDArray[np.bool_] | None) -> RowList:
    """A list from the host: row j is a copy of row rows[j], and fresh where that says so."""
    entries = rows.astype(np.uint32) if fresh is None else np.where(fresh, rows | FRESH, rows).astype(np.uint32)
    return RowList(upload(device, entries), halves=0)


def try_gather(device: Device, count: int, source: AnyGaussians) -> None:
    """Launch what `gather` does, on arrays that are there already and of no use afterwards; for `launch.only_tried`."""
    if isinstance(source, DeviceGaussians):
        array = source["opacity_logits"]
        _gather_array(device, array.reshaped(min(count, source.count)), array, array, None)


@stage("density")
def gather(
    device: Device, rows: DeviceArray | NDArray[np.uint32], source: AnyGaussians, *, renews: bool = False
) -> AnyGaussians:
    """New arrays, where the source and the rows are, of which row j is row rows[j] of the source; renews: those that
    are FRESH are zeros. Parameters and moments alike."""
    count = rows.shape[0]
    if isinstance(rows, DeviceArray):
        assert isinstance(source, DeviceGaussians)
        arrays = {}
        for name, shape in group_shapes(count, source.coefficients).items():
            arrays[name] = allocate(device, shape, np.float32)
            _gather_array(device, rows, source[name], arrays[name], 0.0 if renews else None)
        return DeviceGaussians(count, source.coefficients, arrays)
    assert isinstance(source, HostGaussians)
    host = {name: array.values[rows & ~FRESH] for name, array in source.arrays.items()}
    for values in host.values() if renews else ():
        values[rows >= FRESH] = 0.0
    return replace(source, count=count, arrays={name: HostArray(values) for name, values in host.items()})


@stage("density")
def carry(
    device: Device, rows: DeviceArray, source: DensityStatistics, to: DensityStatistics, *, densified: bool
) -> None:
    """Go on with statistics in arrays of new sizes: contributions, and everything else if nothing was densified; row j
    is row rows[j] of the source, and infinite where it is FRESH."""
    for name, array in to.named().items():
        if name in CONTRIBUTIONS or not densified:
            _gather_array(device, rows, source.named()[name], array, np.inf)


def _gather_array(device: Device, rows: DeviceArray, source: DeviceArray, to: DeviceArray, fresh: float | None) -> None:
    """Gather rows of an array. fresh: the value of those that are FRESH, None for copies."""
    count, width = rows.shape[0], int(np.prod(source.shape[1:]))
    kernel = device.kernels("density").gather_rows
    if width:
        launch_items(device, kernel, count, count, width, fresh is not None, float(fresh or 0.0), rows, source, to)


def widen(device: Device, source: AnyGaussians, coefficients: int) -> AnyGaussians:
    """The same, where it was, with room for more SH coefficients, the new ones 0."""
    rest = np.zeros(group_shapes(source.count, coefficients)["sh_rest"], np.float32)
    rest[:, : source.coefficients - 1] = source["sh_rest"].get()
    if isinstance(source, HostGaussians):
        return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": HostArray(rest)})
    return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": upload(device, rest)})
