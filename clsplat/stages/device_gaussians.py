# SPDX-License-Identifier: Apache-2.0
"""Parameters, gradients and moments: on the device, or streamed to it in parts from the host or a store of chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from clsplat.chunks.division import NEW, Division, even_starts
from clsplat.chunks.gathering import NewValues, OldChunks, gathered
from clsplat.chunks.slot_file import runs
from clsplat.chunks.store import ChunkStore, record_type
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, floats_of, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers, exact_chunks
from clsplat.stages.chunk_pool import ChunkPool, StoredArray


@dataclass(frozen=True, eq=False)
class ShStorage:
    """Storage of the SH coefficients in a model that is only rendered.

    coefficients: number of coefficients per channel.
    degrees: (n,) uint8, the highest degree evaluated for each Gaussian; None evaluates all degrees.
    half: store the bands above 0 as float16.
    """

    coefficients: int
    degrees: NDArray[np.uint8] | None = None
    half: bool = False

    @property
    def floats(self) -> int:
        """Memory per Gaussian, in floats of 4 bytes, rounded up. A stored SH degree takes one float, and a coefficient
        stored as a half takes half a float."""
        rest = 3 * (self.coefficients - 1)
        kept = -(-rest // 2) if self.half else rest
        return floats_of(self.coefficients) - rest + kept + (self.degrees is not None)


A = TypeVar("A")


@dataclass(frozen=True, eq=False)
class _ByGroup(Generic[A]):
    """Base class of parameters, gradients or moments: arrays by group name, whose first axis has length `count`."""

    count: int
    coefficients: int
    arrays: Mapping[str, A]

    def __getitem__(self, group: str) -> A:
        return self.arrays[group]

    def only(self, *groups: str) -> Self:
        """Return a copy of this object with the arrays of these groups only."""
        return replace(self, arrays={group: self.arrays[group] for group in groups})


@dataclass(frozen=True, eq=False)
class DeviceGaussians(_ByGroup[DeviceArray]):
    """Gaussians on the device.

    In a model that is only rendered (`ShStorage`), sh_rest may be float16, and there may be sh_degrees (count) uint8.
    """


@dataclass(frozen=True, eq=False)
class HostArray:
    """A host array with the interface of a DeviceArray."""

    values: NDArray[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    def get(self) -> NDArray[Any]:
        """Return a copy of this array."""
        return self.values.copy()

    def set(self, values: NDArray[Any]) -> None:
        """Copy the array `values` into this one."""
        self.values[...] = values

    def get_rows(self, start: int, stop: int) -> NDArray[Any]:
        """A copy of the rows [start, stop)."""
        return self.values[start:stop].copy()

    def set_rows(self, start: int, values: NDArray[Any]) -> None:
        """Replace the rows from `start` on with `values`."""
        self.values[start : start + len(values)] = values

    def fill(self, value: float) -> None:
        """Set all elements to `value`."""
        self.values.fill(value)


@dataclass(frozen=True, eq=False)
class SavedArray:
    """An array of a checkpoint whose chunks are in a scratch file, with a DeviceArray's methods for reading."""

    store: ChunkStore
    field: str

    @property
    def shape(self) -> tuple[int, ...]:
        return self.store.count, *self.store.fields[self.field]

    def get(self) -> NDArray[np.float32]:
        """Return a copy of all rows of the array."""
        return self.get_rows(0, self.store.count)

    def get_rows(self, start: int, stop: int) -> NDArray[np.float32]:
        """A copy of the rows [start, stop)."""
        return self.store.get_rows(self.field, start, stop)

    def __getitem__(self, rows: slice) -> NDArray[np.float32]:
        """Return a copy of consecutive rows."""
        start, stop, _ = rows.indices(self.store.count)
        return self.get_rows(start, stop)


@dataclass(frozen=True, eq=False)
class HostGaussians(_ByGroup[Any]):
    """Gaussians on the host or in a store of chunks, as `HostArray`, `StoredArray` or `SavedArray`.

    rows: number of Gaussians that are on the device at once.
    pool: pool of the store's chunks on the device; None for arrays in main memory, and for a checkpoint's store.
    kind: "parameters", "first" or "second" if the arrays are fields `kind`/GROUP of a store; "" in main memory.
    culls: False to project chunks out of view too, for results that cover every Gaussian of the model.
    """

    rows: int
    pool: ChunkPool | None = None
    kind: str = ""
    culls: bool = True

    @property
    def in_pool(self) -> DeviceGaussians:
        """The pool's arrays of this model, with the rows of all slots that the pool has now."""
        assert self.pool is not None
        return self.first_in_pool(self.pool.rows)

    def first_in_pool(self, rows: int) -> DeviceGaussians:
        """Return the first `rows` rows of the pool's arrays of this model."""
        assert self.pool is not None
        arrays = {name: self.pool.arrays[f"{self.kind}/{name}"].rows(0, rows) for name in self.arrays}
        return DeviceGaussians(rows, self.coefficients, arrays)


AnyGaussians = DeviceGaussians | HostGaussians
AnyArray = DeviceArray | HostArray | StoredArray
ReadableArray = AnyArray | SavedArray
KINDS = ("parameters", "first", "second")
"""First parts of names, before "/", of parameters, first and second moments in checkpoints and stores of chunks."""


def parts(
    work: Workspace, *models: AnyGaussians, keep: bool = False
) -> Iterator[tuple[int, int, tuple[DeviceGaussians, ...]]]:
    """Bring models to the device part by part. Yields (start, stop, the models' rows [start, stop) on the device).

    Models on the device have a single part. Each part of a streamed model is valid until the next part is requested.

    models: all on the device, or all streamed. Streamed models in a pool come first, and share one pool; the others are
        in main memory. With a pool, each part has as many rows as all slots of the pool.
    keep: True if the caller changes the parts. They are then copied back to main memory, or to the pool's store.
    """
    on_device = tuple(model for model in models if isinstance(model, DeviceGaussians))
    if len(on_device) == len(models):
        yield 0, models[0].count, on_device
        return
    streamed = [model for model in models if isinstance(model, HostGaussians)]
    count, pool = streamed[0].count, streamed[0].pool
    rows = streamed[0].rows if pool is None else pool.rows
    for start in range(0, count, rows):
        stop = min(start + rows, count)
        if pool is not None:
            pool.place_rows(start, stop)
        there = [
            model.first_in_pool(stop - start) if model.pool is not None else _uploaded(work, index, model, start, stop)
            for index, model in enumerate(streamed)
        ]
        yield start, stop, tuple(there)
        if keep and pool is not None:
            pool.keep_rows(start, stop)
        for model, part in zip(streamed, there, strict=True) if keep else ():
            for name, array in part.arrays.items() if model.pool is None else ():
                array.read_into(model[name].values[start:stop])


def _uploaded(work: Workspace, index: int, model: HostGaussians, start: int, stop: int) -> DeviceGaussians:
    """Upload the rows [start, stop) of model number `index` from main memory to arrays of the workspace."""
    arrays = {}
    for name, whole in model.arrays.items():
        values = whole.values[start:stop]
        arrays[name] = work.array(f"part{index}_{name}", values.shape, values.dtype)
        arrays[name].set(values)
    return DeviceGaussians(stop - start, model.coefficients, arrays)


def fields_of(coefficients: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of a row of each array in a chunk's record, by name (such as "first/means"), for the parameters
    and their first and second moments. coefficients: number of SH coefficients per channel."""
    shapes = group_shapes(1, coefficients)
    return {f"{kind}/{name}": shape[1:] for kind in KINDS for name, shape in shapes.items()}


def chunk_parts(
    work: Workspace, chunks: ChunkNumbers, *models: AnyGaussians, changes: bool = False
) -> Iterator[tuple[int, int, tuple[DeviceGaussians, ...], ChunkList]]:
    """Bring chunks to the device part by part, as many at a time as the pool has slots.

    Yields (start, stop, models, slots): the part's rows [start, stop) in a launch over all of `chunks`, the pool's
    arrays of each model, and the slots of the part's chunks. Each part is valid until the next part is requested.

    models: models in one pool.
    changes: True if the device will change the models. The parts then come in reverse order: the previous pass, which
        only reads, ends with the last chunks, so these are still on the device.
    """
    streamed = [model for model in models if isinstance(model, HostGaussians)]
    pool = streamed[0].pool
    assert pool is not None, "only a pool has chunks"
    begins = range(0, len(chunks.numbers), pool.slots)
    for begin in reversed(begins) if changes else begins:
        numbers = chunks.numbers[begin : begin + pool.slots]
        placed, first_rows = pool.place(numbers, changes=changes), pool.store.starts[numbers]
        slots = exact_chunks(work, "chunk_slots", placed, pool.rows, first_rows)
        start = CHUNK_ROWS * begin
        yield start, start + CHUNK_ROWS * len(numbers), tuple(model.in_pool for model in streamed), slots


Models = Sequence["AnyGaussians | None"]
"""Parameters, first and second moments. Moments that are None are zero."""


def by_field(models: Models) -> dict[str, AnyArray]:
    """Return the arrays of parameters and moments by their names in a store (such as "first/means"). Moments that are
    None are left out."""
    given = {kind: model for kind, model in zip(KINDS, models, strict=True) if model is not None}
    return {f"{kind}/{name}": model[name] for kind, model in given.items() for name in PARAMETER_GROUPS}


@dataclass(frozen=True, eq=False)
class CopiedRows:
    """A copy of Gaussians, which `to_store` or `to_arrays` makes chunk by chunk.

    arrays: arrays to copy from, by name (such as "first/means"). Either all are in one pool's store, or none is in a
        store.
    rows: (m,), row j of the copy is row rows[j] of `arrays`; None copies all rows.
    values: values of new rows, and of arrays that the copy has in addition to `arrays`.
    """

    arrays: Mapping[str, ReadableArray]
    rows: NDArray[np.uint32] | None = None
    values: NewValues = field(default_factory=NewValues)

    def to_store(self, store: ChunkStore) -> None:
        """Write the copy to a store. Raises WriteError and ScratchError."""
        for numbers, records in self._records(store.record, store.starts):
            store.write(numbers, records)

    def to_arrays(self, arrays: Mapping[str, AnyArray]) -> None:
        """Write the copy to `arrays`, by name, on the device or in main memory. Raises ScratchError."""
        record = record_type({name: array.shape[1:] for name, array in arrays.items()})
        count = arrays["parameters/means"].shape[0]
        for numbers, records in self._records(record, even_starts(count)):
            begin = CHUNK_ROWS * int(numbers[0])
            end = min(begin + CHUNK_ROWS * len(numbers), count)
            for name in record.names or ():
                array = arrays[name]
                array.set_rows(begin, records[name].reshape(-1, *array.shape[1:])[: end - begin])

    def _records(
        self, record: np.dtype[Any], starts: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[Any]]]:
        means = self.arrays["parameters/means"]
        if isinstance(means, StoredArray):
            means.pool.write_back()
            old = OldChunks(means.pool.store.starts, means.pool.store.read)
        else:
            count = means.shape[0]
            old = OldChunks(even_starts(count), partial(_records, count, self.arrays))
        to = Division(starts, np.full(len(starts) - 1, NEW))
        return gathered(self.rows, old, to, record, values=self.values)


def _records(count: int, arrays: Mapping[str, ReadableArray], numbers: NDArray[np.int64]) -> NDArray[Any]:
    """Return the records of the chunks `numbers` (k,). arrays: the fields of all `count` Gaussians, by name."""
    records = np.empty(len(numbers), record_type({name: array.shape[1:] for name, array in arrays.items()}))
    for place, first, length in runs(numbers):
        begin, end = CHUNK_ROWS * first, min(CHUNK_ROWS * (first + length), count)
        for name in records.dtype.names or ():
            values = arrays[name].get_rows(begin, end)
            for chunk in range(length):
                some = values[CHUNK_ROWS * chunk : CHUNK_ROWS * (chunk + 1)]
                records[name][place + chunk, : len(some)] = some
    return records


def pooled(pool: ChunkPool, coefficients: int) -> tuple[HostGaussians, HostGaussians, HostGaussians]:
    """Return the parameters, first and second moments of the streamed model in a pool's store."""

    def of(kind: str) -> HostGaussians:
        arrays = {name: StoredArray(pool, f"{kind}/{name}") for name in PARAMETER_GROUPS}
        return HostGaussians(pool.store.count, coefficients, arrays, pool.rows, pool, kind)

    return of("parameters"), of("first"), of("second")


def saved_models(store: ChunkStore) -> list[HostGaussians]:
    """Return the parameters, first and second moments in a checkpoint's store. Raises ValueError if the store's records
    have other arrays than `fields_of` returns."""
    coefficients = store.fields.get("parameters/sh_rest", (0,))[0] + 1
    fields = {name: shape for name, shape in store.fields.items() if name.split("/")[0] in KINDS}
    if others := sorted({name for name, _ in fields.items() ^ fields_of(coefficients).items()}):
        raise ValueError(f"the fields of its chunks differ from the fields of this version: {', '.join(others):.200}")
    return [
        HostGaussians(
            store.count,
            coefficients,
            {name: SavedArray(store, f"{kind}/{name}") for name in PARAMETER_GROUPS},
            store.count,
            kind=kind,
        )
        for kind in KINDS
    ]


def rows_at(array: AnyArray, places: NDArray[np.integer[Any]] | slice) -> NDArray[np.float32]:
    """Return a copy of the rows of `array` at the indices `places`, which are (k,) or a slice."""
    if isinstance(places, slice):
        return array.get_rows(places.start, places.stop)
    if isinstance(array, StoredArray):
        return array.get_at(places)
    rows: NDArray[np.float32] = array.get()[places]
    return rows


def set_rows_at(array: AnyArray, places: NDArray[np.integer[Any]] | slice, values: NDArray[np.float32]) -> None:
    """Write `values` to the rows of `array` at the indices `places`, which are (k,) or a slice."""
    if isinstance(places, slice):
        array.set_rows(places.start, values)
        return
    if isinstance(array, StoredArray):
        array.set_at(places, values)
        return
    changed = array.get()
    changed[places] = values
    array.set(changed)


def change_rows(
    array: AnyArray,
    change: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    only: NDArray[np.uint32] | None = None,
) -> None:
    """Replace the rows of an array by the results of `change(rows)`, for all rows at once or chunk by chunk.

    only: (k,), the rows to replace; None for all.
    """
    if only is not None:
        set_rows_at(array, only, change(rows_at(array, only)))
    elif isinstance(array, StoredArray):
        array.change(change)
    else:
        array.set(change(array.get()))


def allocate_gaussians(device: Device, count: int, coefficients: int, *, zero: bool = False) -> DeviceGaussians:
    """Allocate arrays for `count` Gaussians. zero: fill them with zeros; otherwise they are not initialised."""
    arrays = {name: allocate(device, shape, np.float32) for name, shape in group_shapes(count, coefficients).items()}
    if zero:
        for array in arrays.values():
            array.fill(0.0)
    return DeviceGaussians(count, coefficients, arrays)


def _grouped(gaussians: Gaussians, sh: ShStorage) -> dict[str, NDArray[Any]]:
    host = {name: getattr(gaussians, group.field) for name, group in PARAMETER_GROUPS.items()}
    host |= {"sh_dc": gaussians.sh[:, 0], "sh_rest": gaussians.sh[:, 1 : sh.coefficients]}
    kinds = {"sh_rest": np.float16 if sh.half else np.float32}
    arrays = {name: np.ascontiguousarray(values, kinds.get(name, np.float32)) for name, values in host.items()}
    return arrays if sh.degrees is None else {**arrays, "sh_degrees": sh.degrees}


def upload_gaussians(device: Device, gaussians: Gaussians, sh: ShStorage | None = None) -> DeviceGaussians:
    """Upload Gaussians. sh: the SH storage, for a model that is only rendered."""
    sh = sh or ShStorage(gaussians.sh.shape[1])
    arrays = {name: upload(device, values) for name, values in _grouped(gaussians, sh).items()}
    return DeviceGaussians(len(gaussians), sh.coefficients, arrays)


def host_gaussians(gaussians: Gaussians, rows: int, sh: ShStorage | None = None) -> HostGaussians:
    """Wrap Gaussians on the host. They are streamed to the device, `rows` at a time.

    An array is copied only if its dtype or layout has to change.
    sh: the SH storage, for a model that is only rendered.
    """
    sh = sh or ShStorage(gaussians.sh.shape[1])
    arrays = {name: HostArray(values) for name, values in _grouped(gaussians, sh).items()}
    return HostGaussians(len(gaussians), sh.coefficients, arrays, rows)


def host_model(arrays: Mapping[str, NDArray[Any]], kind: str) -> HostGaussians:
    """Return the Gaussians whose arrays in a checkpoint have names that begin with `kind`/. Raises ValueError for
    missing arrays and for a wrong shape or dtype."""
    if missing := [group for group in PARAMETER_GROUPS if f"{kind}/{group}" not in arrays]:
        raise ValueError(f"has no {kind}/{missing[0]}")
    host = {group: arrays[f"{kind}/{group}"] for group in PARAMETER_GROUPS}
    count, coefficients = len(host["means"]), host["sh_rest"].shape[1] + 1
    for group, shape in group_shapes(count, coefficients).items():
        values = host[group]
        if values.shape != shape or values.dtype != np.float32 or count == 0:
            raise ValueError(f"{kind}/{group} has shape {values.shape} of {values.dtype}, expected {shape} of float32")
    return HostGaussians(count, coefficients, {group: HostArray(values) for group, values in host.items()}, count)


def host_zeros(count: int, coefficients: int, rows: int) -> HostGaussians:
    """Make zeros on the host, the initial moments of Adam, for `count` Gaussians. rows: as in `HostGaussians`."""
    shapes = group_shapes(count, coefficients)
    arrays = {name: HostArray(np.zeros(shape, np.float32)) for name, shape in shapes.items()}
    return HostGaussians(count, coefficients, arrays, rows)


def to_host(gaussians: AnyGaussians) -> HostGaussians:
    """Copy Gaussians from the device or from a store to main memory. Those in main memory are returned unchanged."""
    if isinstance(gaussians, HostGaussians) and not gaussians.kind:
        return gaussians
    arrays = {name: HostArray(array.get()) for name, array in gaussians.arrays.items()}
    return HostGaussians(gaussians.count, gaussians.coefficients, arrays, gaussians.count)


def to_device(device: Device, gaussians: HostGaussians) -> DeviceGaussians:
    """Copy streamed Gaussians to the device."""
    arrays = {name: upload(device, array.get_rows(0, gaussians.count)) for name, array in gaussians.arrays.items()}
    return DeviceGaussians(gaussians.count, gaussians.coefficients, arrays)


def download_gaussians(gaussians: AnyGaussians, start: int = 0, stop: int | None = None) -> Gaussians:
    """Return a host copy of the rows [start, stop) as `Gaussians`. stop: None for all rows from `start` on."""
    stop = gaussians.count if stop is None else stop
    host = {name: gaussians[name].get_rows(start, stop) for name in PARAMETER_GROUPS}
    sh = np.concatenate([host["sh_dc"][:, None], host["sh_rest"]], axis=1)
    return Gaussians(host["means"], host["quaternions"], host["log_scales"], host["opacity_logits"], sh)
