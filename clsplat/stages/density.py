# SPDX-License-Identifier: Apache-2.0
"""Launches density.cl: statistics for density control, and copies of the rows that density control keeps or clones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.chunks.gathering import SourceList, in_source_order
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.command_buffer import LaunchParameter
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import group_shapes
from clsplat.layouts.columns import SPLAT
from clsplat.optimisation.density_rules import FRESH, MarkRules
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostArray, HostGaussians
from clsplat.stages.project import Projected, Screen
from clsplat.stages.scan import scan


def gaussian_bytes(*, contributions: bool) -> int:
    """Bytes of each Gaussian's statistics: sum, views, radius; with contributions, two values in each of two epochs."""
    return 4 * (3 + 4 * contributions)


SCORED_STATISTICS = ("whole_largest", "current_largest")
LISTED_ROWS = 1 << 16
"""Rows of a list on the host that are uploaded at a time."""
CONTRIBUTION_STATISTICS = ("current_totals", "current_largest", "whole_totals", "whole_largest")


@dataclass(frozen=True, eq=False)
class DensityStatistics:
    """Statistics per Gaussian, (n,) each.

    These count since the last densification:

    gradient_sums: sums of gradient norms.
    seen: number of views that show the Gaussian.
    radii: largest radius in pixels.

    CONTRIBUTION_STATISTICS are sums of blending weights in the images of the training views, in pixels. They count per
    epoch, whether or not Gaussians are densified. `totals` is the sum over the views, `largest` the maximum of one
    view; `current` is the current epoch, `whole` the last complete epoch. They are infinite for a Gaussian that was
    not measured in some view of the epoch, for example a new one. They are None if no rule uses them.
    """

    gradient_sums: DeviceArray
    seen: DeviceArray
    radii: DeviceArray
    current_totals: DeviceArray | None = None
    current_largest: DeviceArray | None = None
    whole_totals: DeviceArray | None = None
    whole_largest: DeviceArray | None = None

    def rows(self, start: int, stop: int) -> DensityStatistics:
        """The statistics of the Gaussians [start, stop)."""
        if (start, stop) == (0, self.seen.shape[0]):
            return self
        return DensityStatistics(**{name: array.rows(start, stop) for name, array in self.named().items()})

    def named(self) -> dict[str, DeviceArray]:
        """The arrays by name; a checkpoint uses the same names."""
        return {name: array for name, array in vars(self).items() if array is not None}

    def load(self, values: Mapping[str, Float32]) -> None:
        """Upload the arrays that `values` contains, by name."""
        for name, array in self.named().items():
            if name in values:
                array.set(values[name])

    def forget_contributions(self) -> None:
        """Set all contributions to infinity, so that none counts as small until an epoch is complete."""
        for name, array in self.named().items():
            if name in CONTRIBUTION_STATISTICS:
                array.fill(np.inf)

    def next_epoch(self) -> DensityStatistics:
        """Statistics at the start of a new epoch: the current epoch becomes the last complete epoch."""
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


def new_statistics(device: Device, count: int, *, contributions: bool = False) -> DensityStatistics:
    """Initial statistics of `count` Gaussians: zero, with infinite contributions."""
    names = ("gradient_sums", "seen", "radii", *(CONTRIBUTION_STATISTICS if contributions else ()))
    arrays = {name: allocate(device, (count,), np.float32) for name in names}
    for name, array in arrays.items():
        array.fill(np.inf if name in CONTRIBUTION_STATISTICS else 0.0)
    return DensityStatistics(**arrays)


def statistics_numbers(camera: Camera) -> tuple[float, ...]:
    """Arguments of `add_statistics` that differ between cameras of one size."""
    return (camera.fx,) if camera.model.along_rays else ()


@stage("statistics", density_statistics=3)
def add_statistics(
    device: Device,
    statistics: DensityStatistics,
    camera: Camera,
    projected: Projected,
    screen: Screen,
) -> None:
    """Add a view to the statistics. Gradient norms are with respect to means in NDC, as is the paper's threshold.

    projected: all rows of the statistics, or those of its `chunks`.
    """
    n = projected.tile_counts.shape[0]
    rays = camera.model.along_rays
    kernels = device.kernels("density", projected.chunk_defines | ({"RAYS": True} if rays else {}))
    to_ndc = (0.5 * camera.width, 0.5 * camera.height)
    view, sums = (projected.tile_counts, screen.gradients), (statistics.gradient_sums, statistics.seen)
    sizes = (*to_ndc, *(LaunchParameter(number) for number in statistics_numbers(camera)))
    arrays = (*view, projected.splats, *sums, statistics.radii)
    launch_items(device, kernels.density_statistics, n, n, *sizes, *arrays, *projected.chunk_arguments)


@stage("statistics", contribution_statistics=2)
def add_contributions(
    device: Device, statistics: DensityStatistics, projected: Projected, contributions: DeviceArray, area: float
) -> None:
    """Add the contributions (n,) that the Gaussians make to a view to the statistics of the current epoch.

    projected: as for `add_statistics`.
    area: number of full-resolution pixels per pixel of a reduced image; contributions are multiplied by it.
    """
    n = projected.tile_counts.shape[0]
    kernel, view = device.kernels("density", projected.chunk_defines).contribution_statistics, projected.tile_counts
    arrays = (view, contributions, statistics.current_totals, statistics.current_largest)
    launch_items(device, kernel, n, n, LaunchParameter(area), *arrays, *projected.chunk_arguments)


@dataclass(frozen=True, eq=False)
class DeviceRowList:
    """The rows of a model after density control, on the device: (m,) uint32, a source row each, plus FRESH if new.

    halves: the number of halves of split Gaussians, which are the last rows. The first halves of all split Gaussians
    precede the second halves.
    """

    rows: DeviceArray
    halves: int

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.rows.shape[0]

    def entries(self) -> NDArray[np.uint32]:
        """The list on the host."""
        entries: NDArray[np.uint32] = self.rows.get()
        return entries


@dataclass(frozen=True, eq=False)
class DeviceMarker:
    """Marks the Gaussians of a model by their statistics.

    The results overwrite a frame's splats in `work`. So no frame may be in use then, and the results are valid only
    until the next frame is rendered.
    """

    device: Device
    work: Workspace
    parameters: AnyGaussians
    statistics: DensityStatistics

    def scores(self, rules: MarkRules) -> Float32:
        """Mean gradient norms (n,) of the Gaussians that may be densified; negative for the others."""
        found = np.empty(self.parameters.count, np.float32)
        for start, stop in self._pieces():
            found[start:stop] = _scored(self.device, self, rules, start, stop).scores.get()
        return found

    def rows(self, rules: MarkRules) -> DeviceRowList | SourceList:
        """List the rows that the rules produce; those of a streamed model on the host."""
        if isinstance(self.parameters, DeviceGaussians):
            return _listed(self.device, self, rules, 0, self.parameters.count)
        pieces = (_listed(self.device, self, rules, *piece) for piece in self._pieces())
        return in_source_order(piece.entries() for piece in pieces)

    def _pieces(self) -> Iterator[tuple[int, int]]:
        """Rows that are marked together: as many as the plan brings to the device."""
        model = self.parameters
        rows = model.rows if isinstance(model, HostGaussians) else max(model.count, 1)
        for start in range(0, model.count, rows):
            yield start, min(start + rows, model.count)


@dataclass(frozen=True, eq=False)
class _Scratch:
    """Scratch memory for n rows: scores (n), log scales (n, 3) and opacity logits (n), float32; marks (3n), places (3n)
    and rows (2n), uint32."""

    scores: DeviceArray
    log_scales: DeviceArray
    opacity_logits: DeviceArray
    marks: DeviceArray
    places: DeviceArray
    rows: DeviceArray


@stage("density")
def _scored(device: Device, marker: DeviceMarker, rules: MarkRules, start: int, stop: int) -> _Scratch:
    n, statistics, unit = stop - start, marker.statistics.rows(start, stop), device.row_alignment
    sizes = (n, 3 * n, n, 3 * n, 3 * n, 2 * n)
    begins = [0, *np.cumsum([-(-size // unit) * unit for size in sizes]).tolist()]
    space = marker.work.array("splats", (max(begins[-1], len(SPLAT) * n),), np.uint32)
    words = [space.rows(begin, begin + size) for begin, size in zip(begins, sizes, strict=False)]
    floats = [replace(array, dtype=np.dtype(np.float32)) for array in words[:3]]
    scratch = _Scratch(floats[0], floats[1].reshaped(n, 3), floats[2], *words[3:])
    views = (statistics.gradient_sums, statistics.seen)
    known = [getattr(statistics, name) or statistics.seen for name in SCORED_STATISTICS]
    edges = (rules.gradient, rules.contribution)
    launch_items(device, device.kernels("density").density_scores, n, n, *edges, *views, *known, scratch.scores)
    return scratch


@stage("density")
def _listed(device: Device, marker: DeviceMarker, rules: MarkRules, start: int, stop: int) -> DeviceRowList:
    """The list of the rows [start, stop), which the next one overwrites."""
    n, model, kernels = stop - start, marker.parameters, device.kernels("density")
    scratch, counts = _scored(device, marker, rules, start, stop), allocate(device, (2,), np.uint32)
    columns = {name: getattr(scratch, name) for name in ("log_scales", "opacity_logits")}
    for name, column in columns.items():
        array = model[name]
        if isinstance(array, DeviceArray):
            columns[name] = array
        else:
            column.set(array.get_rows(start, stop))
    edges = (rules.large, rules.transparent, rules.oversized, rules.oversized_half, rules.radius)
    arrays = (scratch.scores, marker.statistics.rows(start, stop).radii, *columns.values(), scratch.marks)
    launch_items(device, kernels.density_marks, n, n, start, *rules.cut_off, *edges, *arrays)
    scan(device, marker.work, scratch.marks, scratch.places, counts)
    launch_items(device, kernels.density_rows, n, n, start, scratch.marks, scratch.places, scratch.rows, counts)
    total, splits = (int(number) for number in counts.get())
    return DeviceRowList(scratch.rows.reshaped(total + splits), 2 * splits)


def try_gather(device: Device, count: int, source: AnyGaussians) -> None:
    """Try the kernels of `gather` on existing arrays. Call it only inside `launch.only_tried`: a real launch would
    overwrite the arrays."""
    if isinstance(source, DeviceGaussians):
        array = source["opacity_logits"]
        _gather_array(device, array.reshaped(min(count, source.count)), array, array, None)


@stage("density")
def gather(
    device: Device, rows: DeviceArray | NDArray[np.uint32], source: AnyGaussians, *, renews: bool = False
) -> AnyGaussians:
    """New arrays, on the device or host of the source, whose row j is row rows[j] of the source.

    renews: True sets FRESH rows to zero, for moments; False copies them too, for parameters.
    """
    count = rows.shape[0]
    if isinstance(rows, DeviceArray):
        assert isinstance(source, DeviceGaussians)
        arrays = {}
        for name, shape in group_shapes(count, source.coefficients).items():
            arrays[name] = allocate(device, shape, np.float32)
            _gather_array(device, rows, source[name], arrays[name], 0.0 if renews else None)
        return DeviceGaussians(count, source.coefficients, arrays)
    assert isinstance(source, HostGaussians)
    host = {name: whole.get()[rows & ~FRESH] for name, whole in source.arrays.items()}
    for values in host.values() if renews else ():
        values[rows >= FRESH] = 0.0
    gathered = {name: HostArray(values) for name, values in host.items()}
    return HostGaussians(count, source.coefficients, gathered, source.rows)


@stage("density")
def carried(
    device: Device,
    work: Workspace,
    rows: DeviceArray | NDArray[np.uint32],
    source: dict[str, DeviceArray],
    *,
    densified: bool,
) -> DensityStatistics:
    """Statistics of moved rows: row j is row rows[j] of the source, or infinite if FRESH.

    Contributions are always carried, the other statistics only if nothing was densified.

    source: arrays by name (`DensityStatistics.named`). Each is removed as soon as it is copied, so that the memory for
    one of them is enough.
    """
    arrays: dict[str, DeviceArray] = {}
    for name in tuple(source):
        old = source.pop(name)
        copies = name in CONTRIBUTION_STATISTICS or not densified
        if not copies:
            del old
        arrays[name] = allocate(device, rows.shape, np.float32)
        if not copies:
            arrays[name].fill(0.0)
            continue
        for begin, listed in _on_device(work, rows):
            to = arrays[name].rows(begin, begin + listed.shape[0])
            _gather_array(device, listed, old, to, np.inf)
    return DensityStatistics(**arrays)


def _on_device(work: Workspace, rows: DeviceArray | NDArray[np.uint32]) -> Iterator[tuple[int, DeviceArray]]:
    """A list of rows on the device, with its first place: all of it if it is there, else a part at a time."""
    if isinstance(rows, DeviceArray):
        yield 0, rows
        return
    for begin in range(0, len(rows), LISTED_ROWS):
        some = np.ascontiguousarray(rows[begin : begin + LISTED_ROWS])
        listed = work.array("listed_rows", some.shape, np.uint32)
        listed.set(some)
        yield begin, listed


def _gather_array(device: Device, rows: DeviceArray, source: DeviceArray, to: DeviceArray, fresh: float | None) -> None:
    """Gather rows of an array. fresh: the value for FRESH rows; None copies them like the others."""
    count, width = rows.shape[0], int(np.prod(source.shape[1:]))
    kernel = device.kernels("density").gather_rows
    if width:
        launch_items(device, kernel, count, count, width, fresh is not None, float(fresh or 0.0), rows, source, to)


def widen(device: Device, source: AnyGaussians, coefficients: int) -> AnyGaussians:
    """The model with more SH coefficients, on the same device or host; the additional ones are zero."""
    rest = np.zeros(group_shapes(source.count, coefficients)["sh_rest"], np.float32)
    rest[:, : source.coefficients - 1] = source["sh_rest"].get()
    if isinstance(source, HostGaussians):
        return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": HostArray(rest)})
    return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": upload(device, rest)})
