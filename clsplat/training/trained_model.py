# SPDX-License-Identifier: Apache-2.0
"""The Gaussians in training: parameters, Adam's moments, density statistics, and the moves of their rows."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.chunks.manifest import Manifest
from clsplat.chunks.order import ORDERED_ROWS, beside_parents, space_order
from clsplat.chunks.store import ChunkStore
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.errors import CapacityError
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, floats_of
from clsplat.models.edit import take
from clsplat.optimisation.density_rules import FRESH
from clsplat.rendering.memory_needs import MODELS
from clsplat.rendering.memory_plan import Plan
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.runs.scratch import ScratchFiles
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.stages.density import (
    DensityStatistics,
    DeviceMarker,
    DeviceRowList,
    carry,
    gather,
    list_rows,
    new_statistics,
    try_gather,
    widen,
)
from clsplat.stages.device_gaussians import (
    KINDS,
    AnyGaussians,
    HostGaussians,
    allocate_gaussians,
    host_gaussians,
    host_model,
    host_zeros,
    in_memory,
    pooled,
    saved_arrays,
    saved_models,
    store_of,
    to_device,
    to_host,
    upload_gaussians,
)
from clsplat.training.density import RowPlan
from clsplat.training.stability.health import examine

EXAMINED_CHUNKS = 64
"""Chunks whose numbers are examined at once."""


class TrainedModel:
    """Parameters, first and second moments and statistics, on the device or streamed from the host.

    make_plan: function that plans the device's memory for a number of Gaussians.
    scratch: function that names a new file for so many bytes of chunks, or returns None to keep them in main memory.
    files: the training's files of chunks; None if there is no folder for them.
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
        scratch: Callable[[int], Path | None],
        files: ScratchFiles | None,
        *,
        sh_degree: int,
        counts_contributions: bool,
    ) -> None:
        self._device, self._work, self._make_plan, self._scratch, self._files = device, work, make_plan, scratch, files
        self._pool: ChunkPool | None = None
        self._sh_degree, self._counts_contributions = sh_degree, counts_contributions

    def begin(self, initial: Gaussians) -> None:
        """Start from a model on the host. The rows of a large one are put in order of their places in space."""
        if len(initial) > ORDERED_ROWS:
            initial = take(initial, space_order(initial.means).astype(np.int64))
        self.plan = self._make_plan(len(initial))
        if self.plan.streamed:  # a store of chunks is a copy already
            initial = initial if len(initial) > ORDERED_ROWS else copy.deepcopy(initial)
            self.set(host_gaussians(initial, self.plan.rows))
        else:
            self.set(upload_gaussians(self._device, initial))

    @contextmanager
    def saved(self, checkpoint: Checkpoint) -> Iterator[tuple[list[HostGaussians], Checkpoint]]:
        """Context with parameters, first and second moments of a checkpoint, and the checkpoint with their arrays.

        A scratch file that has them is open in the context. Raises InputError for arrays of another model.
        """
        with ExitStack() as reading:
            try:
                if checkpoint.manifest is not None:
                    store = reading.enter_context(closing(ChunkStore.opened(checkpoint.manifest, writable=False)))
                    models = saved_models(store)
                else:
                    models = [host_model(checkpoint.arrays, kind) for kind in KINDS]
                n, most = max(model.coefficients for model in models), (self._sh_degree + 1) ** 2
                if n > most:
                    raise ValueError(f"has {n} SH coefficients, more than the {most} of --sh-degree {self._sh_degree}")
            except ValueError as error:
                raise unusable(checkpoint, str(error)) from None
            yield models, replace(checkpoint, arrays={**checkpoint.arrays, **saved_arrays(models)})

    def load(self, models: Sequence[HostGaussians], checkpoint: Checkpoint) -> None:
        """Continue with the models (`saved`) and the statistics of a checkpoint.

        Statistics that the settings did not need before the checkpoint stay unknown.
        Raises InputError for statistics of another model.
        """
        self.free()
        self.plan = self._make_plan(models[0].count)
        if not self._go_on_in(checkpoint.manifest, models[0].coefficients):
            self._place(*models)
        self.statistics = new_statistics(self._device, models[0].count, contributions=self._counts_contributions)
        statistics = checkpoint.named("statistics/")
        for name, array in self.statistics.named().items():
            if name in statistics and (statistics[name].shape, statistics[name].dtype) != (array.shape, array.dtype):
                raise unusable(checkpoint, f"statistics/{name} has shape {statistics[name].shape}")
        self.statistics.load(statistics)

    def free(self) -> None:
        """Free all arrays."""
        del self.parameters, self.first, self.second, self.statistics

    def set(
        self, parameters: AnyGaussians, first: AnyGaussians | None = None, second: AnyGaussians | None = None
    ) -> None:
        """Set the arrays, where the plan assigns them, with new statistics. Moments that are not given start from
        zero."""
        self._place(parameters, first, second)
        self.statistics = new_statistics(self._device, parameters.count, contributions=self._counts_contributions)

    def kinds(self) -> dict[str, AnyGaussians]:
        """Parameters, first and second moments, by their names in a checkpoint."""
        return {"parameters": self.parameters, "first": self.first, "second": self.second}

    @property
    def with_moments(self) -> tuple[AnyGaussians, AnyGaussians, AnyGaussians]:
        """Parameters, first and second moments."""
        return self.parameters, self.first, self.second

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, without the statistics."""
        return {
            f"{kind}/{group}": model[group].get() for kind, model in self.kinds().items() for group in PARAMETER_GROUPS
        }

    @property
    def store(self) -> ChunkStore | None:
        """The store of the chunks, if they are in a scratch file."""
        return self._pool.store if self._pool is not None and self._pool.store.path is not None else None

    def record(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Arrays and state of a checkpoint, without the statistics: a manifest if there is a scratch file."""
        if (store := self.store) is None or self._pool is None:
            return self.arrays(), {}
        self._pool.write_back()
        manifest = store.manifest()
        return manifest.arrays(), manifest.state()

    def saved_now(self) -> None:
        """Note that a checkpoint has been written."""
        if self._files is not None:
            self._files.saved(self.store)

    def changes_are_finite(self) -> bool:
        """True if the Gaussians are in a scratch file, and those that have changed since the last checkpoint are
        finite."""
        if (store := self.store) is None or self._pool is None:
            return False
        self._pool.write_back()
        changed = np.flatnonzero(store.slots.in_place(np.arange(store.chunks)))
        for begin in range(0, len(changed), EXAMINED_CHUNKS):
            numbers = changed[begin : begin + EXAMINED_CHUNKS]
            if np.any(examine(**store.rows_of(numbers, KINDS, PARAMETER_GROUPS))):
                return False
        return True

    def marker(self) -> DeviceMarker:
        """Marker of the Gaussians by density rules."""
        return DeviceMarker(self._device, self._work, self.parameters, self.statistics)

    def widen(self, coefficients: int) -> None:
        """Make room for more SH coefficients, which start from zero."""
        if not self.plan.gathers:
            self._take_down()
        self._place(*(widen(self._device, model, coefficients) for model in self.with_moments))

    def rearrange(self, plan: RowPlan, changes: Callable[[], None]) -> DeviceArray | None:
        """Carry out a plan of density control, or of a repair. Returns the list of rows if rows have moved.

        changes: function that is called just before the first change, when the kernels have been tried in the sandbox
            and the moved rows have their memory.
        Raises CapacityError, before any change, if there is too little memory for the moved rows.
        """
        listed = plan.listed
        if plan.rows is not None:
            listed = list_rows(self._device, plan.rows, plan.fresh)
        moved, places = None, None
        if listed is not None:
            assert isinstance(listed, DeviceRowList)
            moved, places = self._ordered(listed)
            self._move(moved, changes, new_statistics=plan.new_statistics)
            if listed.halves and plan.halves is not None:
                self._halve(listed, places, plan.halves, plan.halved)
        changes()
        for group, (rows, values) in plan.values.items():
            self._set_rows(group, rows if places is None else places[rows], values)
        for group, change in plan.changes.items():
            self.parameters[group].set(change(self.parameters[group].get()))
        for group in plan.restarted:
            self.first[group].fill(0.0)
            self.second[group].fill(0.0)
        if plan.forget_contributions:
            self.statistics.forget_contributions()
        return moved

    def _place(self, parameters: AnyGaussians, first: AnyGaussians | None, second: AnyGaussians | None) -> None:
        """Put the arrays where the plan assigns them. The rows of a large streamed model are in a store of chunks."""
        count, coefficients = parameters.count, parameters.coefficients
        if self.plan.streamed and count > ORDERED_ROWS:
            store = store_of((parameters, first, second), self._scratch(MODELS * 4 * floats_of(coefficients) * count))
            self.close()
            self._use(store, coefficients)
            return
        models = [self._placed(model) for model in (parameters, first, second) if model is not None]
        self.close()
        self.parameters, *moments = models
        self.first, self.second = moments or (self._zeros(count, coefficients), self._zeros(count, coefficients))

    def _go_on_in(self, manifest: Manifest | None, coefficients: int) -> bool:
        """Go on in the scratch file of a checkpoint. Returns False if the Gaussians belong elsewhere."""
        if (
            manifest is None
            or not self.plan.streamed
            or self._files is None
            or not self._files.may_write(manifest.path)
        ):
            return False
        if self._scratch(MODELS * 4 * floats_of(coefficients) * manifest.count) is None:
            return False
        self.close()
        self._use(ChunkStore.opened(manifest, writable=True), coefficients)
        return True

    def _use(self, store: ChunkStore, coefficients: int) -> None:
        """Let the rows be those of a store of chunks."""
        if self._files is not None and store.path is not None:
            self._files.follow(store)
        pool = self._pool = ChunkPool(self._device, self._work, store, self.plan.rows)
        self.parameters, self.first, self.second = pooled(pool, coefficients)

    @property
    def in_file(self) -> bool:
        """True if main memory has no room for the whole model."""
        return self.store is not None

    @property
    def moved_bytes(self) -> int:
        """Bytes of chunks that have gone to or come from the device."""
        return 0 if self._pool is None else self._pool.moved_bytes

    def close(self) -> None:
        """Remove the scratch file of a streamed model, unless a checkpoint names it. The model cannot be used any
        longer."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def _zeros(self, count: int, coefficients: int) -> AnyGaussians:
        if isinstance(self.parameters, HostGaussians):
            return host_zeros(count, coefficients, self.parameters.rows)
        return allocate_gaussians(self._device, count, coefficients, zero=True)

    def _take_down(self) -> None:
        """Move parameters, first and second moments to the host, and free them on the device."""
        self.parameters, self.first, self.second = [to_host(model) for model in self.with_moments]

    def _placed(self, model: AnyGaussians) -> AnyGaussians:
        """The model on the device or on the host, as the plan assigns; it is moved there if necessary."""
        if isinstance(model, HostGaussians):
            return in_memory(model, self.plan.rows) if self.plan.streamed else to_device(self._device, model)
        return model

    def _ordered(self, listed: DeviceRowList) -> tuple[DeviceArray, NDArray[np.int64] | None]:
        """The rows of a list in the model's order, and the place there of each row of the list; None if they are the
        same.

        In a large model new rows stand behind those that they come from. When a model becomes large, its rows are put
        in order of their places in space.
        """
        if listed.count <= ORDERED_ROWS:
            return listed.rows, None
        entries = listed.rows.get()
        sources = entries & ~FRESH
        if self.parameters.count > ORDERED_ROWS:
            order = beside_parents(sources)
        else:
            order = space_order(self.parameters["means"].get()[sources])
        return upload(self._device, entries[order]), np.argsort(order)

    def _halve(
        self,
        listed: DeviceRowList,
        places: NDArray[np.int64] | None,
        halves: Callable[[Mapping[str, Float32]], Mapping[str, Float32]],
        halved: Sequence[str],
    ) -> None:
        """Replace the last rows of a list, which are copies of split Gaussians, with their halves, computed from the
        groups `halved`.

        places: place in the model of each row of the list. With None, only rows of the halves are copied to the host.
        """
        begin, middle = listed.count - listed.halves, listed.count - listed.halves // 2
        if places is None:
            split = {group: self.parameters[group].get_rows(middle, listed.count) for group in halved}
            for group, values in halves(split).items():
                self.parameters[group].set_rows(begin, values)
            return
        split = {group: self.parameters[group].get()[places[middle:]] for group in halved}
        for group, values in halves(split).items():
            self._set_rows(group, places[begin:], values)

    def _set_rows(self, group: str, rows: NDArray[Any], values: Float32) -> None:
        """Set rows of a parameter group."""
        changed = self.parameters[group].get()
        changed[rows] = values
        self.parameters[group].set(changed)

    def _move(self, listed: DeviceArray, changes: Callable[[], None], *, new_statistics: bool) -> None:
        """Move all arrays, so that row j becomes the old row listed[j], with zero moments if it is FRESH."""
        gathers = self.plan.gathers
        with only_tried(self._device):
            try_gather(self._device, listed.shape[0], self.parameters)
        try:
            self.plan = self._make_plan(listed.shape[0])
            rows: DeviceArray | NDArray[np.uint32] = listed
            if not (gathers and self.plan.gathers):
                self._take_down()
                rows = listed.get()
            moved = [
                gather(self._device, rows, model, renews=index > 0) for index, model in enumerate(self.with_moments)
            ]
        except CapacityError as error:
            count = self.parameters.count
            raise CapacityError(f"{error}; with --density.max-gaussians {count} the model grows no further") from None
        changes()
        statistics = self.statistics
        self.free()
        self.set(*(self._placed(model) for model in moved))
        carry(self._device, listed, statistics, self.statistics, densified=new_statistics)
