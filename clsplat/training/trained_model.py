# SPDX-License-Identifier: Apache-2.0
"""Gaussians in training: parameters, Adam's moments, density statistics, and their rows after density control."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.chunks.manifest import Manifest
from clsplat.chunks.order import ORDERED_ROWS, space_order
from clsplat.chunks.store import ChunkStore, record_type
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.errors import CapacityError, warn
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, floats_of
from clsplat.models.edit import take
from clsplat.rendering.memory_needs import MODELS
from clsplat.rendering.memory_plan import Plan
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.runs.scratch import ScratchFiles
from clsplat.stages.chunk_pool import ChunkPool, StoredArray
from clsplat.stages.density import (
    KIND,
    DensityStatistics,
    DeviceMarker,
    carried,
    gather,
    gaussian_bytes,
    new_statistics,
    new_values,
    pooled_statistics,
    statistics_fields,
    try_gather,
    widen,
)
from clsplat.stages.device_gaussians import (
    KINDS,
    AnyArray,
    AnyGaussians,
    CopiedRows,
    HostArray,
    HostGaussians,
    Models,
    ReadableArray,
    allocate_gaussians,
    by_field,
    change_rows,
    fields_of,
    host_gaussians,
    host_zeros,
    pooled,
    set_rows_at,
    to_device,
    to_host,
    upload_gaussians,
)
from clsplat.stages.region import rows_inside
from clsplat.training.density import RowPlan
from clsplat.training.moved_rows import Move, halve, ordered
from clsplat.training.stability.health import examine

_STAY = Move()
EXAMINED_CHUNKS = 64
"""Number of chunks that are searched for non-finite values at a time."""
HALVED_ROWS = 1 << 15
"""Number of split Gaussians whose halves are computed at a time, if the model is in a store of chunks."""


class TrainedModel:
    """Parameters, first and second moments and statistics, on the device or streamed from the host.

    make_plan: function that plans the device's memory for a number of Gaussians.
    plan_view: function from the current plan, and the numbers of chunks of a view and of a step, to the plan for them
        (`MemoryPlanner.plan_view`).
    scratch: function from bytes of chunks to the path of a new scratch file, or None to keep them in main memory.
    files: the training's scratch files; None if there is no folder for them.
    sh_degree: final SH degree.
    counts_contributions: True if the statistics have contributions.
    """

    parameters: AnyGaussians
    first: AnyGaussians
    second: AnyGaussians
    statistics: DensityStatistics
    plan: Plan

    def __init__(
        self,
        device: Device,
        work: Workspace,
        make_plan: Callable[[int], Plan],
        plan_view: Callable[[Plan, int, int], Plan],
        scratch: Callable[[int], Path | None],
        files: ScratchFiles | None,
        *,
        sh_degree: int,
        counts_contributions: bool,
    ) -> None:
        self._device, self._work, self._scratch, self._files = device, work, scratch, files
        self._make_plan, self._plan_view = make_plan, plan_view
        self._pool: ChunkPool | None = None
        self._sh_degree, self._counts_contributions = sh_degree, counts_contributions

    def begin(self, initial: Gaussians, look: Callable[[Gaussians], None]) -> None:
        """Start from a model on the host. The rows of a large model are sorted along a curve through space.

        look: function that is called with the sorted model before memory is planned.
        """
        if len(initial) > ORDERED_ROWS:
            initial = take(initial, space_order(initial.means).astype(np.int64))
        look(initial)
        self.plan = self._make_plan(len(initial))
        if self.plan.streamed:  # `set` keeps a small model, but copies a large one into a store of chunks
            initial = initial if len(initial) > ORDERED_ROWS else copy.deepcopy(initial)
            self.set(host_gaussians(initial, self.plan.rows))
        else:
            self.set(upload_gaussians(self._device, initial))

    def load(self, models: Sequence[HostGaussians], checkpoint: Checkpoint) -> None:
        """Continue with the models and the statistics of a checkpoint (`saved_model`).

        Statistics that the checkpoint does not have get their initial values.
        Raises InputError for statistics of another model.
        """
        self.free()
        count, arrays = models[0].count, checkpoint.named(f"{KIND}/")
        self.plan = self._make_plan(count)
        for name, array in arrays.items():
            if array.shape != (count,) or (isinstance(array, np.ndarray) and array.dtype != np.float32):
                raise unusable(checkpoint, f"{KIND}/{name} has shape {array.shape}, expected float32 of ({count},)")
        if not self._go_on_in(checkpoint.manifest, models[0].coefficients):
            held = {name: HostArray(each) if isinstance(each, np.ndarray) else each for name, each in arrays.items()}
            self._place(models, held)

    def free(self) -> None:
        """Free all arrays, and close the scratch file."""
        self.close()
        del self.parameters, self.first, self.second, self.statistics

    def set(
        self, parameters: AnyGaussians, first: AnyGaussians | None = None, second: AnyGaussians | None = None
    ) -> None:
        """Replace the model, and begin new statistics. The plan decides if the model goes to the device or to the host.
        Moments that are not given are zero."""
        self._place((parameters, first, second), {})

    def kinds(self) -> dict[str, AnyGaussians]:
        """Return parameters, first and second moments by their names in a checkpoint."""
        return {"parameters": self.parameters, "first": self.first, "second": self.second}

    @property
    def with_moments(self) -> tuple[AnyGaussians, AnyGaussians, AnyGaussians]:
        """Parameters, first moments and second moments of all Gaussians."""
        return self.parameters, self.first, self.second

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return parameters, moments and statistics by their names in a checkpoint."""
        return {name: array.get() for name, array in self._by_field().items()}

    def _by_field(self) -> dict[str, AnyArray]:
        return by_field(self.with_moments) | self.statistics.by_field()

    def by_kind(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Mapping[str, AnyArray]]:
        """Return parameters and moments by kind ("parameters", "first", "second") and parameter group. Their
        values are in `arrays` of a checkpoint, or in the scratch file if the checkpoint has only a manifest."""
        if self.in_file:
            return {kind: model.arrays for kind, model in self.kinds().items()}
        return {kind: _host_arrays({g: arrays[f"{kind}/{g}"] for g in PARAMETER_GROUPS}) for kind in KINDS}

    @property
    def store(self) -> ChunkStore | None:
        """The store of chunks if it is in a scratch file; None if the model is in memory."""
        return self._pool.store if self._pool is not None and self._pool.store.path is not None else None

    def record(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Return the model's arrays and state for a checkpoint; for a model in a scratch file, the file's manifest."""
        if (store := self.store) is None or self._pool is None:
            return self.arrays(), {}
        if store.file.is_lost:
            warn(f"{store.path}: has been removed while it was in use; the Gaussians go to a new file")
            self._place()
            return self.record()
        self._pool.write_back()
        manifest = store.manifest()
        return manifest.arrays(), manifest.state()

    def saved_now(self) -> None:
        """Update the scratch files after a checkpoint has been written: slots that it names are kept."""
        if self._files is not None:
            self._files.saved(self.store)

    def changes_are_finite(self) -> bool:
        """True if the Gaussians are in a scratch file, and all chunks that have changed since the last checkpoint are
        finite."""
        if (store := self.store) is None or self._pool is None:
            return False
        self._pool.write_back()
        changed = np.flatnonzero(store.slots.in_place(np.arange(store.chunks)))
        for begin in range(0, len(changed), EXAMINED_CHUNKS):
            numbers = changed[begin : begin + EXAMINED_CHUNKS]
            rows = store.rows_of(numbers, KINDS, PARAMETER_GROUPS)
            if np.any(examine({kind: _host_arrays(rows[kind]) for kind in KINDS})):
                return False
        return True

    def marker(self) -> DeviceMarker:
        """Return an object that applies density rules to the Gaussians, and lists the resulting rows."""
        return DeviceMarker(self._device, self._work, self.parameters, self.statistics)

    def widen(self, coefficients: int, changes: Callable[[], None]) -> None:
        """Increase the number of SH coefficients. The new ones are zero.

        changes: function that is called before the first change.
        """
        if self._pool is not None:
            self._move_chunks(Move(coefficients=coefficients, changes=changes))
            return
        changes()
        if not self.plan.gathers:
            self.parameters, self.first, self.second = [to_host(model) for model in self.with_moments]
        self._place([widen(self._device, model, coefficients) for model in self.with_moments])

    def rearrange(self, plan: RowPlan, changes: Callable[[], None]) -> DeviceArray | HostArray | None:
        """Carry out a plan of density control, or of a repair. Returns the source row of each row; None if no row has
        moved.

        changes: function that is called just before the first change, after the kernels have been tried in the sandbox
            and memory for the moved rows is allocated. It may be called several times.
        Raises CapacityError, before any change, if there is too little memory for the moved rows.
        """
        moved = ordered(plan, self.parameters)
        if moved is not None:
            self._move(moved.rows, changes, new_statistics=plan.new_statistics)
            if moved.halves and plan.halves is not None:
                halve(self.parameters, moved, plan.halves, plan.halved, HALVED_ROWS if self._pool is not None else 0)
        changes()
        for group, (rows, values) in plan.values.items():
            set_rows_at(self.parameters[group], rows if moved is None else moved.at(rows), values)
        of_region = rows_inside(self.parameters["means"], plan.region) if plan.changes and plan.region else None
        for group, change in plan.changes.items():
            change_rows(self.parameters[group], change, of_region)
        for group in plan.restarted:
            self.first[group].fill(0.0)
            self.second[group].fill(0.0)
        if plan.forget_contributions:
            self.statistics.forget_contributions()
        if moved is None:
            return None
        return moved.rows if isinstance(moved.rows, DeviceArray) else HostArray(moved.rows)

    def change_moments(self, change: Callable[[Float32], Float32]) -> None:
        """Apply a function to all moments, some rows at a time."""
        for model, group in product((self.first, self.second), PARAMETER_GROUPS):
            change_rows(model[group], change)

    def _place(
        self, models: Models | None = None, statistics: Mapping[str, ReadableArray] | None = None, move: Move = _STAY
    ) -> None:
        """Put Gaussians where the plan assigns them: on the device, in main memory, or in a store of chunks.

        models: new parameters and moments, not in a store. None keeps the Gaussians of this model, which are in a store
            now or will be.
        statistics: statistics of new models by name. Missing ones get their initial values; None keeps the old ones.
        move: the new rows and number of coefficients, if the Gaussians are in a store now or will be.
        """
        parameters = self.parameters if models is None else models[0]
        assert parameters is not None
        count, coefficients = move.count(parameters.count), move.coefficients or parameters.coefficients
        move = replace(move, coefficients=coefficients)
        del parameters
        if self.plan.streamed and count > ORDERED_ROWS:
            self._to_store(models, statistics, count, move)
        elif models is None:
            self._from_store(count, move)
        else:
            placed = [self._placed(model) for model in models if model is not None]
            self.close()
            self.parameters, *moments = placed
            self.first, self.second = moments or (self._zeros(count, coefficients), self._zeros(count, coefficients))
            if statistics is not None:
                self.statistics = new_statistics(self._device, count, contributions=self._counts_contributions)
                self.statistics.load({name: array.get() for name, array in statistics.items()})

    def _to_store(
        self, models: Models | None, statistics: Mapping[str, ReadableArray] | None, count: int, move: Move
    ) -> None:
        """Put `count` Gaussians into a new store of chunks, and make its pool.

        models, statistics: the Gaussians and their statistics by name; None takes this model's Gaussians or statistics.
        move: the new rows and number of coefficients.
        """
        source, old = self.with_moments if models is None else models, self._pool if models is None else None
        named = self.statistics.named() if statistics is None else statistics
        arrays = by_field(source) | {f"{KIND}/{name}": array for name, array in named.items()}
        copied = CopiedRows(arrays, move.rows, move.values)
        path, fields = self._scratch(self._record_bytes(move.coefficients) * count), self._fields(move.coefficients)
        starts = old.store.starts if old is not None and move.rows is None else None
        store = ChunkStore(count, fields, path, widest=self._widest, starts=starts)
        make = partial(ChunkPool, self._device, store, self.plan.rows)
        try:
            pool = make() if isinstance(source[0], HostGaussians) and old is None else None
            copied.to_store(store)
        except BaseException:
            store.close()
            raise
        move.changes()
        del source, old, named, arrays, copied  # frees the old arrays' memory for the new pool
        vars(self).pop("statistics", None)
        self._free_models()
        self._use(pool or make(), move.coefficients)

    def _move_chunks(self, move: Move) -> None:
        """Move the rows of a model in a store of chunks.

        The model leaves the store if it no longer has to be streamed or has become small. The store moves to a scratch
        file if main memory has no room for it any longer."""
        assert self._pool is not None
        count, store = move.count(self.parameters.count), self._pool.store
        to_file = store.path is None and self._scratch(self._record_bytes(move.coefficients) * count) is not None
        if to_file or not self.plan.streamed or count <= ORDERED_ROWS:
            self._place(move=move)
            return
        self._pool.release()
        store.move(move.rows, move.values, move.changes, self._fields(move.coefficients) if move.rows is None else None)
        cull = self._pool.cull if move.rows is None else None
        self._pool.free()
        self._pool = None
        self._free_models()
        self._use(ChunkPool(self._device, store, self.plan.rows, cull), move.coefficients)

    def _fields(self, coefficients: int) -> dict[str, tuple[int, ...]]:
        """Shape of a row of each array in a chunk's record, by name (such as "first/means").

        coefficients: number of SH coefficients.
        """
        return fields_of(coefficients) | statistics_fields(contributions=self._counts_contributions)

    @property
    def _widest(self) -> dict[str, tuple[int, ...]]:
        """Shape of a row of each array in a chunk's record, by name, with the final SH degree."""
        return self._fields((self._sh_degree + 1) ** 2)

    def _record_bytes(self, coefficients: int) -> int:
        """Return the bytes of a Gaussian in a store. coefficients: number of SH coefficients."""
        return MODELS * 4 * floats_of(coefficients) + gaussian_bytes(contributions=self._counts_contributions)

    def _from_store(self, count: int, move: Move) -> None:
        """Move this model's Gaussians from its store to arrays. count: number of rows after the move."""
        old, self._pool = self._pool, None
        assert old is not None
        old.write_back()
        move.changes()
        self._free_models()
        old.free()
        if self.plan.streamed:
            to = [host_zeros(count, move.coefficients, self.plan.rows) for _ in KINDS]
            self.parameters, self.first, self.second = to
        else:
            on_device = [allocate_gaussians(self._device, count, move.coefficients) for _ in KINDS]
            self.parameters, self.first, self.second = on_device
        self.statistics = new_statistics(self._device, count, contributions=self._counts_contributions)
        stored = {name: StoredArray(old, name) for name in old.store.fields}
        CopiedRows(stored, move.rows, move.values).to_arrays(self._by_field())
        old.close()

    def _free_models(self) -> None:
        """Free parameters and moments, on the device or in a store."""
        self.close()
        for name in ("parameters", "first", "second"):
            vars(self).pop(name, None)

    def _go_on_in(self, manifest: Manifest | None, coefficients: int) -> bool:
        """Continue in the scratch file of a checkpoint. Returns False if this model can use no such file."""
        if (
            manifest is None
            or dict(manifest.fields) != self._fields(coefficients)
            or manifest.slot_bytes != record_type(self._widest).itemsize
            or not self.plan.streamed
            or self._files is None
            or not self._files.may_write(manifest.path)
        ):
            return False
        if self._scratch(self._record_bytes(coefficients) * int(manifest.lengths.sum())) is None:
            return False
        self.close()
        store = ChunkStore.opened(manifest, writable=True)
        self._use(ChunkPool(self._device, store, self.plan.rows), coefficients)
        return True

    def _use(self, pool: ChunkPool, coefficients: int) -> None:
        """Take parameters, moments and statistics from the store of `pool` from now on."""
        if self._files is not None and pool.store.path is not None:
            self._files.follow(pool.store)
        self._pool, pool.before_view = pool, self._before_view
        self.parameters, self.first, self.second = pooled(pool, coefficients)
        self.statistics = pooled_statistics(pool)

    def _before_view(self, chunks: int, of_step: int) -> None:
        """Plan the memory for a step whose view shows `chunks` chunks. Make the pool smaller if the view's arrays need
        some of its memory. No bit of a result depends on the pool's size. Raises CapacityError, before any change, and
        WriteError."""
        assert self._pool is not None
        self.plan = self._plan_view(self.plan, chunks, of_step)
        if self.plan.rows < self._pool.rows:
            self._pool.resize(self.plan.rows)
            self.parameters, self.first, self.second = pooled(self._pool, self.parameters.coefficients)

    @property
    def in_file(self) -> bool:
        """True if the model is in a scratch file, because main memory has no room for it."""
        return self.store is not None

    def fetch_ahead(self) -> None:
        """Bring the chunks of a streamed model that the next step's views may show to the device."""
        if self._pool is not None:
            self._pool.fetch_ahead()

    @property
    def moved_bytes(self) -> int:
        """Bytes of chunks that have crossed the bus so far, in both directions."""
        return 0 if self._pool is None else self._pool.moved_bytes

    def close(self) -> None:
        """End the use of a streamed model: remove its scratch file, unless a checkpoint names the file."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def _zeros(self, count: int, coefficients: int) -> AnyGaussians:
        if isinstance(self.parameters, HostGaussians):
            return host_zeros(count, coefficients, self.parameters.rows)
        return allocate_gaussians(self._device, count, coefficients, zero=True)

    def _placed(self, model: AnyGaussians) -> AnyGaussians:
        """Move a model to the device or to the host, as the plan assigns, if it is not there yet."""
        if isinstance(model, HostGaussians):
            return (
                replace(to_host(model), rows=self.plan.rows) if self.plan.streamed else to_device(self._device, model)
            )
        return model

    def _move(
        self, rows: DeviceArray | NDArray[np.uint32], changes: Callable[[], None], *, new_statistics: bool
    ) -> None:
        """Rearrange all arrays: new row j becomes the old row rows[j], with zero moments if FRESH is set in rows[j]."""
        count, before, gathers = rows.shape[0], self.parameters.count, self.plan.gathers
        with only_tried(self._device):
            try_gather(self._device, count, self.parameters)
        try:
            self.plan = self._make_plan(count)
            if self._pool is not None or (self.plan.streamed and count > ORDERED_ROWS):
                values = new_values(densified=new_statistics)
                move = Move(_on_host(rows), self.parameters.coefficients, changes, values)
                self._place(move=move) if self._pool is None else self._move_chunks(move)
                return
            rows = self._gather(rows, on_device=gathers and self.plan.gathers, changes=changes)
        except CapacityError as error:
            raise CapacityError(f"{error}; with --density.max-gaussians {before} the model grows no further") from None
        statistics = self.statistics.named()
        del self.statistics
        self.statistics = carried(self._device, self._work, rows, statistics, densified=new_statistics)

    def _gather(
        self, rows: DeviceArray | NDArray[np.uint32], *, on_device: bool, changes: Callable[[], None]
    ) -> DeviceArray | NDArray[np.uint32]:
        """Copy the rows `rows` of a model that is not in a store to new arrays, on the device if `on_device`, else on
        the host. Returns `rows`, on the device if `on_device`."""
        if on_device:
            rows = rows if isinstance(rows, DeviceArray) else upload(self._device, rows)
        else:
            self.parameters, self.first, self.second = [to_host(model) for model in self.with_moments]
        to_gather = rows if on_device else _on_host(rows)
        moved = [
            gather(self._device, to_gather, model, renews=index > 0) for index, model in enumerate(self.with_moments)
        ]
        changes()
        self._free_models()
        self._place(moved)
        return rows


def _host_arrays(arrays: Mapping[str, NDArray[Any]]) -> dict[str, AnyArray]:
    return {name: HostArray(values) for name, values in arrays.items()}


def _on_host(rows: DeviceArray | NDArray[np.uint32]) -> NDArray[np.uint32]:
    return rows.get() if isinstance(rows, DeviceArray) else rows
