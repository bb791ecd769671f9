# SPDX-License-Identifier: Apache-2.0
"""Launches density.cl: statistics for density control, and copies of the rows that density control keeps or clones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.chunks.gathering import NewValues, SourceList, in_source_order
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.command_buffer import LaunchParameter
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import group_shapes
from clsplat.layouts.columns import CHUNK_ROWS, SPLAT
from clsplat.optimisation.density_rules import FRESH, MarkRules
from clsplat.stages.chunk_pool import ChunkPool, StoredArray
from clsplat.stages.device_gaussians import AnyArray, AnyGaussians, DeviceGaussians, HostArray, HostGaussians
from clsplat.stages.project import Projected, Screen
from clsplat.stages.region import region_build
from clsplat.stages.scan import scan

SCORED_STATISTICS = ("whole_largest", "current_largest")
LISTED_ROWS = 1 << 16
"""Number of entries of a row list on the host that are uploaded at a time."""
CONTRIBUTION_STATISTICS = ("current_totals", "current_largest", "whole_totals", "whole_largest")
NEXT_EPOCH = {"whole_totals": "current_totals", "whole_largest": "current_largest"}
NEXT_EPOCH |= {current: whole for whole, current in NEXT_EPOCH.items()}
"""New names of contributions when an epoch begins. The arrays that become current are set to 0 first."""
KIND = "statistics"
"""First part of the names of statistics in a checkpoint and in a store of chunks, before "/"."""


def statistics_names(*, contributions: bool) -> tuple[str, ...]:
    """Return the names of the arrays of `DensityStatistics`. contributions: include CONTRIBUTION_STATISTICS."""
    return ("gradient_sums", "seen", "radii", *(CONTRIBUTION_STATISTICS if contributions else ()))


def gaussian_bytes(*, contributions: bool) -> int:
    """Return the number of bytes that a Gaussian's statistics take. contributions: include contributions."""
    return 4 * len(statistics_names(contributions=contributions))


def initial_value(name: str) -> float:
    """Return the value in new arrays of the statistic `name`: infinity for contributions, otherwise 0."""
    return np.inf if name in CONTRIBUTION_STATISTICS else 0.0


def statistics_fields(*, contributions: bool) -> dict[str, tuple[int, ...]]:
    """Return the shape of a row of each statistic in a chunk's record, by name (such as "statistics/radii")."""
    return {f"{KIND}/{name}": () for name in statistics_names(contributions=contributions)}


def new_values(*, densified: bool = False) -> NewValues:
    """Return the values that density control gives to rows of a store, where it does not copy them from old rows.

    Rows with the bit FRESH get zero moments and infinite statistics.

    densified: True if all statistics except contributions start from zero in every row.
    """
    names = statistics_names(contributions=True)
    anew = frozenset(f"{KIND}/{name}" for name in names if densified and name not in CONTRIBUTION_STATISTICS)
    initial = {f"{KIND}/{name}": initial_value(name) for name in CONTRIBUTION_STATISTICS}
    return NewValues({"first": 0.0, "second": 0.0, KIND: np.inf}, initial, anew)


@dataclass(frozen=True, eq=False)
class DensityStatistics:
    """Statistics per Gaussian for density control, (n,) each: on the device, or fields of a streamed model's chunks.

    Since the last densification:

    gradient_sums: sums of gradient norms.
    seen: number of views that show the Gaussian.
    radii: largest radius in pixels.

    CONTRIBUTION_STATISTICS are sums of blending weights in the images of the training views, in pixels. They belong to
    an epoch, which has each view once, and do not start again when Gaussians are densified. `totals` is the sum over
    the views, `largest` the maximum over the views; `current` is the current epoch, `whole` the last complete epoch.
    They are infinite for a Gaussian that was not measured in some view of the epoch, for example a new one. They are
    None if no rule uses them.

    of_slots: True if the arrays are a pool's, with the rows of its slots.
    """

    gradient_sums: DeviceArray | StoredArray
    seen: DeviceArray | StoredArray
    radii: DeviceArray | StoredArray
    current_totals: DeviceArray | StoredArray | None = None
    current_largest: DeviceArray | StoredArray | None = None
    whole_totals: DeviceArray | StoredArray | None = None
    whole_largest: DeviceArray | StoredArray | None = None
    of_slots: bool = False

    @classmethod
    def of(cls, arrays: Mapping[str, Any], *, of_slots: bool = False) -> DensityStatistics:
        """Make statistics of `arrays`, by the names of this class's attributes."""
        return cls(**arrays, of_slots=of_slots)

    @property
    def on_device(self) -> DensityStatistics:
        """The statistics as arrays on the device, for kernels. For a streamed model they are the arrays of its pool."""
        if not isinstance(self.seen, StoredArray):
            return self
        return self.of({name: array.in_pool for name, array in self.named().items()}, of_slots=True)

    def rows(self, start: int, stop: int) -> DensityStatistics:
        """Return the statistics of the Gaussians [start, stop) on the device. In a pool they are in the first rows."""
        start, stop = (0, stop - start) if self.of_slots else (start, stop)
        if (start, stop) == (0, self.seen.shape[0]):
            return self
        arrays = {name: array.rows(start, stop) for name, array in self.named().items()}
        return self.of(arrays, of_slots=self.of_slots)

    def named(self) -> dict[str, Any]:
        """Return the arrays that are not None, by name."""
        names = statistics_names(contributions=True)
        return {name: array for name in names if (array := getattr(self, name)) is not None}

    def by_field(self) -> dict[str, Any]:
        """Return the arrays by their names in checkpoints and stores of chunks (such as "statistics/radii")."""
        return {f"{KIND}/{name}": array for name, array in self.named().items()}

    def load(self, values: Mapping[str, Float32]) -> None:
        """Set each array to the array of its name in `values`. Arrays without a name in `values` stay unchanged."""
        for name, array in self.named().items():
            if name in values:
                array.set(values[name])

    def forget_contributions(self) -> None:
        """Set all contributions to infinity, so that no Gaussian is pruned by them until an epoch is complete."""
        for name, array in self.named().items():
            if name in CONTRIBUTION_STATISTICS:
                array.fill(np.inf)

    def next_epoch(self) -> DensityStatistics:
        """Return the statistics for a new epoch: the current epoch becomes the last complete epoch."""
        if self.whole_totals is None or self.whole_largest is None:
            return self
        self.whole_totals.fill(0.0)
        self.whole_largest.fill(0.0)
        if isinstance(self.whole_totals, StoredArray):
            self.whole_totals.pool.rename({f"{KIND}/{old}": f"{KIND}/{new}" for old, new in NEXT_EPOCH.items()})
            return self
        return replace(self, **{new: getattr(self, old) for old, new in NEXT_EPOCH.items()})


def new_statistics(device: Device, count: int, *, contributions: bool = False) -> DensityStatistics:
    """Make the initial statistics of `count` Gaussians: zeros, and infinite contributions."""
    names = statistics_names(contributions=contributions)
    arrays = {name: allocate(device, (count,), np.float32) for name in names}
    for name, array in arrays.items():
        array.fill(initial_value(name))
    return DensityStatistics.of(arrays)


def pooled_statistics(pool: ChunkPool) -> DensityStatistics:
    """Return the statistics that a streamed model has in the store of its pool."""
    names = [name for name in statistics_names(contributions=True) if f"{KIND}/{name}" in pool.store.fields]
    return DensityStatistics.of({name: StoredArray(pool, f"{KIND}/{name}") for name in names})


def statistics_numbers(camera: Camera) -> tuple[float, ...]:
    """Return the kernel arguments of `add_statistics` that differ between cameras with images of the same size."""
    return (camera.fx,) if camera.model.along_rays else ()


@stage("statistics", density_statistics=3)
def add_statistics(
    device: Device,
    statistics: DensityStatistics,
    camera: Camera,
    projected: Projected,
    screen: Screen,
) -> None:
    """Add a view to the statistics. The gradients are converted to NDC, because the paper's threshold is in NDC.

    projected: splats of the view, of all Gaussians or of those in the chunks `projected.chunks`.
    screen: gradients of the same Gaussians with respect to their means on the image.
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
    """Add a view's contributions to the statistics of the current epoch.

    projected: splats of the view, as for `add_statistics`.
    contributions: (n,), the contribution of each Gaussian of `projected` to the view, in pixels.
    area: number of full-resolution pixels per pixel of a reduced image; contributions are multiplied by it.
    """
    n = projected.tile_counts.shape[0]
    kernel, view = device.kernels("density", projected.chunk_defines).contribution_statistics, projected.tile_counts
    arrays = (view, contributions, statistics.current_totals, statistics.current_largest)
    launch_items(device, kernel, n, n, LaunchParameter(area), *arrays, *projected.chunk_arguments)


@dataclass(frozen=True, eq=False)
class DeviceRowList:
    """Row list on the device: where each row of a model after density control is copied from.

    rows: (m,) uint32, the old row that each row is copied from, with the bit FRESH set if the row is a new Gaussian.
    halves: number of halves of split Gaussians, which are the last rows: all first halves, then all second halves.
    """

    rows: DeviceArray
    halves: int

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.rows.shape[0]

    def entries(self) -> NDArray[np.uint32]:
        """Return a copy of `rows` on the host."""
        entries: NDArray[np.uint32] = self.rows.get()
        return entries


@dataclass(frozen=True, eq=False)
class DeviceMarker:
    """Marks which Gaussians of a model are kept, cloned and split, by their statistics.

    The results overwrite the splats of the last frame in the workspace `work`. So this frame must not be needed any
    more, and the results are valid only until the next frame is rendered.
    """

    device: Device
    work: Workspace
    parameters: AnyGaussians
    statistics: DensityStatistics

    def scores(self, rules: MarkRules) -> Float32:
        """Return each Gaussian's mean gradient norm (n,), or a negative number if it may not be densified."""
        found = np.empty(self.parameters.count, np.float32)
        for start, stop in self._pieces():
            found[start:stop] = _scored(self.device, self, rules, start, stop).scores.get()
        return found

    def rows(self, rules: MarkRules) -> DeviceRowList | SourceList:
        """Return the row list that the rules give: the rows to keep, clone and split. It is on the host for a streamed
        model."""
        if isinstance(self.parameters, DeviceGaussians):
            return _listed(self.device, self, rules, 0, self.parameters.count)
        pieces = (_listed(self.device, self, rules, *piece) for piece in self._pieces())
        return in_source_order(piece.entries() for piece in pieces)

    def _pieces(self) -> Iterator[tuple[int, int]]:
        """Yield the ranges [start, stop) of rows that are marked together.

        A streamed model is marked in parts. A part has as many rows as are on the device at once. With a pool it has
        half as many rows as the pool, so that marks and statistics fit in the memory of the splats.
        """
        model = self.parameters
        rows = model.rows if isinstance(model, HostGaussians) else max(model.count, 1)
        if isinstance(self.statistics.seen, StoredArray):
            rows = CHUNK_ROWS * max(self.statistics.seen.pool.slots // 2, 1)
        for start in range(0, model.count, rows):
            yield start, min(start + rows, model.count)


class _Scratch:
    """Scratch arrays for marking `n` rows (kernels/density.cl), in the memory of a frame's splats.

    scores: (n,) float32, the results of density_scores.
    marks, places: (3n,) uint32, the results of density_marks, and their prefix sums.
    rows: (2n,) uint32, memory for the row list.
    """

    def __init__(self, marker: DeviceMarker, n: int) -> None:
        self._n, unit = n, marker.device.row_alignment
        sizes = (n, 3 * n, 3 * n, 2 * n, *(_COLUMN_WIDTHS.get(name, 1) * n for name in _COLUMNS))
        begins = [0, *np.cumsum([-(-size // unit) * unit for size in sizes]).tolist()]
        space = marker.work.array("splats", (max(begins[-1], len(SPLAT) * n),), np.uint32)
        words = [space.rows(begin, begin + size) for begin, size in zip(begins, sizes, strict=False)]
        self.scores = replace(words[0], dtype=np.dtype(np.float32))
        self.marks, self.places, self.rows = words[1:4]
        self._columns = dict(zip(_COLUMNS, words[4:], strict=True))

    def column(self, name: str, array: AnyArray, start: int) -> DeviceArray:
        """Return the n rows of `array` from row `start` on, on the device.

        For an array on the host the result is a copy, which the next call with the same `name` overwrites.
        """
        if isinstance(array, DeviceArray):
            return array.rows(start, start + self._n)
        shape = (self._n, *array.shape[1:])
        column = replace(self._columns[name], dtype=np.dtype(np.float32)).reshaped(*shape)
        column.set(array.get_rows(start, start + self._n))
        return column


_COLUMNS = ("log_scales", "opacity_logits", "gradient_sums", "seen", *SCORED_STATISTICS)
_COLUMN_WIDTHS = {"log_scales": 3}


@stage("density")
def _scored(device: Device, marker: DeviceMarker, rules: MarkRules, start: int, stop: int) -> _Scratch:
    n, gathered, scratch = stop - start, marker.statistics.named(), _Scratch(marker, stop - start)
    columns = {name: scratch.column(name, gathered[name], start) for name in _COLUMNS if name in gathered}
    views = (columns["gradient_sums"], columns["seen"])
    known = [columns.get(name, columns["seen"]) for name in SCORED_STATISTICS]
    defines, bounds = region_build(rules.region)
    # The log scales' memory is free until the scores have been computed.
    means = [scratch.column("log_scales", marker.parameters["means"], start)] if bounds else []
    arrays, edges = (*views, *known, *means, scratch.scores), (rules.gradient, rules.contribution)
    launch_items(device, device.kernels("density", defines).density_scores, n, n, *edges, *arrays, *bounds)
    return scratch


@stage("density")
def _listed(device: Device, marker: DeviceMarker, rules: MarkRules, start: int, stop: int) -> DeviceRowList:
    """Return the row list that the rules give for the old rows [start, stop). The next call overwrites it."""
    n, model, (defines, _) = stop - start, marker.parameters, region_build(rules.region)
    kernels = device.kernels("density", defines)
    scratch, counts = _scored(device, marker, rules, start, stop), allocate(device, (2,), np.uint32)
    columns = [scratch.column(name, model[name], start) for name in ("log_scales", "opacity_logits")]
    # The scores have been computed, so the memory of `seen` is free.
    radii = scratch.column("seen", marker.statistics.radii, start)
    edges = (rules.large, rules.transparent, rules.oversized, rules.oversized_half, rules.radius)
    arrays = (scratch.scores, radii, *columns, scratch.marks)
    launch_items(device, kernels.density_marks, n, n, start, *rules.cut_off, *edges, *arrays)
    scan(device, marker.work, scratch.marks, scratch.places, counts)
    launch_items(device, kernels.density_rows, n, n, start, scratch.marks, scratch.places, scratch.rows, counts)
    total, splits = (int(number) for number in counts.get())
    return DeviceRowList(scratch.rows.reshaped(total + splits), 2 * splits)


def try_gather(device: Device, count: int, source: AnyGaussians) -> None:
    """Try the kernel of `gather` for `count` rows, with an array of `source` as input and output. Call it only inside
    `launch.only_tried`: a real launch would overwrite the array."""
    if isinstance(source, DeviceGaussians):
        array = source["opacity_logits"]
        _gather_array(device, array.reshaped(min(count, source.count)), array, array, None)


@stage("density")
def gather(
    device: Device, rows: DeviceArray | NDArray[np.uint32], source: AnyGaussians, *, renews: bool = False
) -> AnyGaussians:
    """Copy the rows that a row list names. Row j of the result is row rows[j] of `source`.

    rows: entries of a row list, with the bit FRESH in new rows. The list, source and result are all on the device, or
        all on the host.
    renews: True sets rows with the bit FRESH to zero, for moments. False copies them too, for parameters.
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
    """Return the statistics after density control. Row j is row rows[j] of the source, or infinite if rows[j] is
    FRESH.

    rows: entries of a row list, on the device or on the host.
    source: arrays by name (`DensityStatistics.named`). Each array is removed from the dictionary as soon as it is
        copied, so that only one array is in memory twice.
    densified: True if all statistics except contributions start from zero in every row.
    """
    arrays = {}
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
    return DensityStatistics.of(arrays)


def _on_device(work: Workspace, rows: DeviceArray | NDArray[np.uint32]) -> Iterator[tuple[int, DeviceArray]]:
    """Bring a list of rows to the device part by part. Yields the index of a part's first entry, and the part."""
    if isinstance(rows, DeviceArray):
        yield 0, rows
        return
    for begin in range(0, len(rows), LISTED_ROWS):
        some = np.ascontiguousarray(rows[begin : begin + LISTED_ROWS])
        listed = work.array("listed_rows", some.shape, np.uint32)
        listed.set(some)
        yield begin, listed


def _gather_array(device: Device, rows: DeviceArray, source: DeviceArray, to: DeviceArray, fresh: float | None) -> None:
    """Set row j of `to` to row rows[j] of `source`. fresh: the value of rows with the bit FRESH; None copies these."""
    count, width = rows.shape[0], int(np.prod(source.shape[1:]))
    kernel = device.kernels("density").gather_rows
    if width:
        launch_items(device, kernel, count, count, width, fresh is not None, float(fresh or 0.0), rows, source, to)


def widen(device: Device, source: AnyGaussians, coefficients: int) -> AnyGaussians:
    """Return a copy of the model with `coefficients` SH coefficients per channel. The additional ones are zero."""
    rest = np.zeros(group_shapes(source.count, coefficients)["sh_rest"], np.float32)
    rest[:, : source.coefficients - 1] = source["sh_rest"].get()
    if isinstance(source, HostGaussians):
        return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": HostArray(rest)})
    return replace(source, coefficients=coefficients, arrays={**source.arrays, "sh_rest": upload(device, rest)})
