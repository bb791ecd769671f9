# SPDX-License-Identifier: Apache-2.0
"""Steps of a large model over the chunks that the view may show: bounds of chunks, and steps that hidden chunks missed
(docs/decisions/0051-chunks.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.chunks.bounds import largest_resumed_step, measured_sides
from clsplat.chunks.bounds_table import BoundsTable, Movement
from clsplat.chunks.culling import PictureBorders, visible
from clsplat.chunks.division import chunks_of
from clsplat.chunks.order import ORDERED_ROWS
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.context import Device
from clsplat.device.launch import DEFAULT_GROUP_ITEMS
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.optimisation.dropout import thinning_of
from clsplat.rendering.rasterizer import MAX_COUNTED_PASSES, Rasterizer
from clsplat.stages.adam import AdamStep
from clsplat.stages.bounds import BOUNDS_FLOATS, bounds
from clsplat.stages.catch_up import StepTable, catch_up, step_table
from clsplat.stages.chunk_lists import ChunkNumbers, send_chunks
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostArray, HostGaussians
from clsplat.training.step.component import Component, Named
from clsplat.training.step.inputs import PlacedChunks, ViewInputs
from clsplat.training.step.movement import MovementLimits

STEPS_PER_MEASUREMENT = 16
"""Number of steps after which the bounds of the chunks that took part in them are measured again. With more steps,
bounds get wider, because each step widens them by an upper limit of the movement. With fewer steps, the host waits more
often for the device."""
MAX_SHARE_IN_VIEW = 0.7
"""Share of the chunks in view above which a step runs over the whole model. On a CPU, steps of dense Adam over the
chunks in view take 0.90 to 0.95 of the time of steps over the whole model at a share of 0.6, 0.97 to 0.99 at 0.7, and
1.00 to 1.02 at 0.8."""
_BOUNDED_GROUPS = ("means", "log_scales")
"""Parameter groups that the bounds of a chunk are measured from."""
_ROWS_AT_ONCE = 1 << 16
"""Number of rows of a checkpoint that are read at a time."""
MOST_MISSED_STEPS = 1024
"""Number of missed steps after which a chunk is caught up even if no view shows it."""
_KEPT_BORDERS = 4096
"""Number of cameras whose picture's borders are kept, because making them takes as long as culling 500 chunks."""


def settings_of_whole_steps(config: TrainConfig) -> list[str]:
    """Return the options in use, such as "--batch", that make each step run over the whole model. With them, a step
    reads the gradients of Gaussians that the view does not show, or changes such Gaussians in addition to Adam."""
    wanted = {
        "--density.growth mcmc": config.density.growth == "mcmc",
        "--antialiased": config.antialiased,
        "--optimiser.late": config.optimiser.late,
        "--batch with --thinning": config.batch > 1 and config.thinning > 0,
        "--refine-poses": config.refine_poses,
        "--refine-lenses": config.refine_lenses,
    }
    return [name for name, given in wanted.items() if given]


def runs_by_chunk(config: TrainConfig, device: Device) -> bool:
    """True if a step may run over the chunks in view alone, instead of the whole model."""
    return not settings_of_whole_steps(config) and device.max_group >= DEFAULT_GROUP_ITEMS


def streams_by_chunk(config: TrainConfig, device: Device, count: int) -> bool:
    """True if a model of `count` Gaussians may be streamed by chunks."""
    return count > ORDERED_ROWS and runs_by_chunk(config, device)


@dataclass(frozen=True, eq=False)
class Missed:
    """Steps that chunks have missed because no view showed them.

    numbers: the chunks, in rising order.
    last: (chunks,) uint32, the last step that each chunk has taken.
    step: number of the last missed step.
    table: the steps from number `first_step` on (`stages.catch_up.step_table`).
    """

    numbers: NDArray[np.uint32]
    last: NDArray[np.uint32]
    step: int
    table: Float32
    first_step: int


class VisibleChunks(Component):
    """The chunks of a training's model: their bounds, how far Gaussians may have moved since the measurement of bounds,
    and the last step that each chunk has taken.

    A chunk that a step leaves out has no Gaussian that the view shows. Before a view shows it again, the chunk takes
    the steps that it has missed, and gets the bits that steps over the whole model would give. So no bit of a result
    depends on the bounds.

    unit: the scene's length unit.
    count: number of Gaussians.
    next_cameras: function that returns the cameras of the next step's views, as far as they are known. With the
        argument True it also returns cameras whose picture may get another size.
    """

    def __init__(
        self,
        config: TrainConfig,
        rasterizer: Rasterizer,
        unit: float,
        count: int,
        next_cameras: Callable[[bool], Sequence[Camera]],
    ) -> None:
        self._config, self._rasterizer, self._next_cameras = config, rasterizer, next_cameras
        self._limits = MovementLimits(config, unit)
        self._borders = lru_cache(_KEPT_BORDERS)(PictureBorders.of)
        self._ahead: dict[tuple[Camera, int, BoundsTable], NDArray[np.uint32]] = {}
        """Chunks that a view of the next step may show, by its camera, the step's number and the bounds."""
        self._begin(count, 0)

    def _begin(self, count: int, step: int, chunks: int = 0) -> None:
        """Forget all bounds. The model has `count` Gaussians, and all have taken step number `step`.

        chunks: number of the model's chunks; 0 if all but the last are full, so that `count` gives their number.
        """
        chunks = chunks or chunks_of(count)
        self._count = count
        missed = 0 if self._config.optimiser.sparse else MOST_MISSED_STEPS
        self._found = BoundsTable(chunks, missed + STEPS_PER_MEASUREMENT)
        self._unmeasured = np.ones(chunks, np.bool_)
        self._since: int | None = None
        """Steps since the last measurement; None if there is none."""
        # room for twice as many steps as a chunk may miss, so that the table's rows seldom have to be moved
        most = 2 * (MOST_MISSED_STEPS + STEPS_PER_MEASUREMENT)
        self._table = np.zeros((most, 2 + len(PARAMETER_GROUPS)), np.float32)
        """The steps from `_first_step` on, of which chunks may have missed some (`stages.catch_up.step_table`)."""
        self._begin_table(step, chunks)
        self._before: dict[int, tuple[NDArray[np.uint32], NDArray[np.uint32]]] = {}
        """For each of the latest steps, by number, its chunks and their values in `_last` before it, because the step
        may be repeated."""
        self._caught: DeviceArray | None = None

    def _divide(self, pool: ChunkPool | None) -> None:
        """Forget all bounds and missed steps if the number of chunks has changed because rows have moved.

        pool: pool of a streamed model; None for a model on the device.
        """
        chunks = chunks_of(self._count) if pool is None else pool.store.chunks
        if chunks != len(self._last):
            self._begin(self._count, self.step, chunks)

    def _begin_table(self, step: int, chunks: int) -> None:
        """Begin an empty table of steps. All `chunks` chunks have taken step number `step`."""
        self.step, self._first_step = step, step + 1
        self._last = np.full(chunks, step, np.uint32)
        """For each chunk the last step that it has taken. Not kept with sparse Adam, where chunks miss no step."""
        self._oldest = step
        """Lower limit of `_last`."""

    @property
    def on(self) -> bool:
        """True if steps may leave out chunks that the view does not show. Steps with the present settings then change
        the Gaussians of such chunks only by Adam, and do not read their gradients."""
        return runs_by_chunk(self._config, self._rasterizer.device) and self._limits.finite

    def is_due(self, step: int, views: int) -> bool:  # noqa: ARG002
        """True if bounds must be measured before the next step."""
        return self._count > ORDERED_ROWS and (self._since is None or self._since >= STEPS_PER_MEASUREMENT)

    @property
    def reads_all_rows(self) -> bool:
        """True if some chunk has missed so many steps that all chunks are caught up before bounds are next measured."""
        oldest = self.step if self._config.optimiser.sparse else int(self._last.min(initial=self.step))
        return self.step - oldest >= MOST_MISSED_STEPS

    def before_step(self, gaussians: AnyGaussians) -> None:
        """Measure the bounds of chunks whose Gaussians may have moved."""
        pool = gaussians.pool if isinstance(gaussians, HostGaussians) else None
        if isinstance(gaussians, HostGaussians) and pool is None:
            return
        self._divide(pool)
        self._before_view = None if pool is None else pool.before_view
        if pool is not None:
            pool.cull = self.in_view
        self._since, self._oldest = 0, int(self._last.min(initial=self.step))
        numbers = np.flatnonzero(self._unmeasured).astype(np.uint32)
        if len(numbers) == 0:
            return
        self._found.measure(numbers, self._measured(gaussians, numbers))
        self._unmeasured[numbers] = False

    def _measured(self, gaussians: AnyGaussians, numbers: NDArray[np.uint32]) -> Float32:
        """Measure the bounds (chunks, BOUNDS_FLOATS) of the chunks `numbers`."""
        if isinstance(gaussians, DeviceGaussians):
            return self._measured_on_device(gaussians, numbers)
        assert gaussians.pool is not None
        store, slots = gaussians.pool.store, gaussians.pool.slots_of(numbers)
        found, there = np.empty((len(numbers), BOUNDS_FLOATS), np.float32), slots >= 0
        if there.any():
            found[there] = self._measured_on_device(gaussians.in_pool, slots[there].astype(np.uint32))
        for place in np.flatnonzero(~there):
            rows = store.starts[numbers[place] : numbers[place] + 2].tolist()
            means, log_scales = (store.get_rows(f"parameters/{group}", *rows) for group in _BOUNDED_GROUPS)
            found[place] = measured_sides(means, log_scales)[0]
        return found

    def _measured_on_device(self, gaussians: DeviceGaussians, numbers: NDArray[np.uint32]) -> Float32:
        work = self._rasterizer.work
        chunks = send_chunks(work, "chunks", numbers, gaussians.count)
        return bounds(self._rasterizer.device, work, gaussians, chunks)[: len(numbers)]

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:
        """Return the step's views, each with the chunks that it may show.

        step: number of the step's last view.
        count: number of Gaussians.
        """
        if count <= ORDERED_ROWS or self._since is None:
            return inputs
        step = self._number(step)
        if self.step < step - 1:  # earlier steps ran over all rows, as the model was small or streamed
            self._begin_table(step - 1, len(self._last))
        hidden, most_hidden = self._hidden_movement(step)
        by_view = []
        for each in inputs:
            found = self._ahead.get((each.camera, step, self._found))
            found = self._shown(each.camera, step, hidden, most_hidden) if found is None else found
            by_view.append(found if len(found) else np.zeros(1, np.uint32))  # a further device needs some rows
        numbers = by_view[0] if len(by_view) == 1 else np.unique(np.concatenate(by_view))
        if self._before_view is not None:
            self._before_view(max(map(len, by_view)), len(numbers))
        whole = self._before_view is None and sum(map(len, by_view)) > MAX_SHARE_IN_VIEW * len(self._last) * len(inputs)
        self._since += 1
        if whole:
            numbers = np.arange(len(self._last), dtype=np.uint32)
        moved = self._limits.in_step(step)
        self._note_movement(numbers, moved if hidden is None else moved + hidden(numbers))
        missed = self._missed(numbers, step - 1)
        of_step = _ChunksInView(self, numbers, numbers, missed, self._found, whole=whole)
        for each, found in zip(inputs, by_view, strict=True):
            each.chunks = of_step if len(inputs) == 1 else replace(of_step, in_view=found)
        return inputs

    def after_adam(self, gaussians: AnyGaussians) -> None:
        """Find the chunks that the next step's views may show, while the device still computes the step just launched.

        Before the next step, limits of movement may shrink and bounds may be measured. The chunks found here may then
        be more than that step needs, which changes no bit of its result.
        """
        pool = gaussians.pool if isinstance(gaussians, HostGaussians) else None
        cameras, step = self._next_cameras(pool is not None and pool.looks_ahead), self.step + 1
        self._ahead.clear()
        if cameras and self._count > ORDERED_ROWS and self._since is not None:
            hidden = self._hidden_movement(step)
            for camera in cameras:
                self._ahead[camera, step, self._found] = self._shown(camera, step, *hidden)
            if pool is not None:
                pool.expected = np.unique(np.concatenate(list(self._ahead.values())))

    def in_view(self, camera: Camera) -> NDArray[np.uint32]:
        """Numbers of the chunks that a camera may show after the last step."""
        return self._shown_by(camera, 1.0, *self._hidden_movement(self.step + 1))

    def _shown(self, camera: Camera, step: int, hidden: Movement | None, most: Float64 | float) -> NDArray[np.uint32]:
        """Chunks that the view of a camera may show in step number `step`, in rising order.

        hidden, most: results of `_hidden_movement`.
        """
        thinning = thinning_of(self._config, step)
        return self._shown_by(camera, 1.0 if thinning is None else thinning.factor, hidden, most)

    def _shown_by(
        self, camera: Camera, factor: float, hidden: Movement | None, most: Float64 | float
    ) -> NDArray[np.uint32]:
        """Chunks that a camera may show if opacities are multiplied by `factor`. hidden, most: as for `_shown`."""
        picture = self._borders(camera, self._config.rasterizer, factor)
        return self._found.seen(partial(visible, picture), hidden, most)

    def _hidden_movement(self, step: int) -> tuple[Movement | None, Float64 | float]:
        """Compute limits of the movement of means and log scales in missed steps, before step number `step`.

        Returns a function from chunk numbers (n,) to these limits (2, n), and an upper limit of all of them (2, 1).
        With sparse Adam, which moves no hidden Gaussian, these are None and 0.
        """
        if self._config.optimiser.sparse:
            return None, 0.0
        oldest = min(self._oldest, step - 1)
        path = partial(self._limits.in_missed_steps, oldest, step)
        return lambda chunks: path(self._last[chunks]), path(oldest)

    def _number(self, views: int) -> int:
        """Return Adam's number of the step that the training's view number `views` is in."""
        return -(-views // self._config.batch)

    def _note_movement(self, chunks: NDArray[np.uint32], limit: Float64) -> None:
        """Widen the bounds of the chunks by `limit` (2, n or 1), the limit of their movement."""
        self._found.move(chunks, limit)
        self._unmeasured[chunks] = True

    def _missed(self, chunks: NDArray[np.uint32], step: int) -> Missed | None:
        """The steps up to number `step` that these chunks have missed; None if no chunk has missed a step."""
        if self._config.optimiser.sparse:
            return None
        numbers = chunks[self._last[chunks] < step]
        if len(numbers) == 0:
            return None
        last, first = self._last[numbers], int(self._last[numbers].min()) + 1
        table = self._table[first - self._first_step : step + 1 - self._first_step].copy()
        return Missed(numbers, last, step, table, first)

    def prepare(self, model: tuple[AnyGaussians, ...], step: AdamStep, chunks: _ChunksInView) -> PlacedChunks | None:
        """Catch up the chunks that a step's view shows, and send their list. A repeated step gives the same bits."""
        if chunks.of_rows is not self._found:  # rows have moved since, after all chunks were caught up
            self._divide(_pool_of(model))
            everything = np.arange(len(self._last), dtype=np.uint32)
            chunks = _ChunksInView(self, everything, everything, None, self._found, whole=True)
        if chunks.missed is not None:
            self._catch_up(model, chunks.missed)
        self.step = step.number
        if not self._config.optimiser.sparse:
            self._note(step, chunks.numbers)
        return None if chunks.whole and _pool_of(model) is None else self.place(model, chunks.numbers, "of_step")

    def place(self, model: tuple[AnyGaussians, ...], numbers: NDArray[np.uint32], name: str) -> PlacedChunks:
        """Send the list of the chunks `numbers` to the device. For a streamed model, bring the chunks to the pool.

        name: part of the names of the lists' arrays. A list is valid until the next one with its name.
        """
        work, pool = self._rasterizer.work, _pool_of(model)
        if pool is None:
            return PlacedChunks(model, send_chunks(work, f"chunks_{name}", numbers, model[0].count))
        if len(numbers) > pool.slots:
            return PlacedChunks(model, ChunkNumbers(numbers))
        first_rows = pool.store.starts[numbers] if self._config.thinning > 0 else None
        slots = send_chunks(work, f"slots_{name}", pool.place(numbers, changes=True), pool.rows, first_rows)
        return PlacedChunks(_in_pool(model), slots)

    def _note(self, step: AdamStep, chunks: NDArray[np.uint32]) -> None:
        """Record a step that chunks take, and add it to the table of steps that others may have missed. If the table is
        full, first remove the steps that all chunks have taken."""
        older = {number: each for number, each in self._before.items() if number >= step.number - MAX_COUNTED_PASSES}
        self._before = {**older, step.number: (chunks, self._last[chunks])}
        self._last[chunks] = step.number
        if step.number - self._first_step >= len(self._table):
            # a repeated step begins with the values of `_last` in `_before`
            values = (self._last, *(last for _, last in self._before.values()))
            past = min(int(last.min(initial=step.number)) for last in values) + 1 - self._first_step
            self._table[:-past] = self._table[past:].copy()
            self._first_step += past
        self._table[step.number - self._first_step] = step_table([step])[0]

    def _catch_up(self, model: tuple[AnyGaussians, ...], missed: Missed) -> None:
        pool, work = _pool_of(model), self._rasterizer.work
        table = work.array("missed_steps", missed.table.shape)
        table.send(missed.table)
        steps = StepTable(table, missed.first_step)
        if pool is None:
            if self._caught is None:
                self._caught = allocate(self._rasterizer.device, self._last.shape, np.uint32)
                self._caught.fill(0)
            self._catch_up_rows(_on_device(model), missed.numbers, missed.last, self._caught, missed.step, steps)
            return
        for begin in range(0, len(missed.numbers), pool.slots):
            some = slice(begin, begin + pool.slots)
            slots = pool.place(missed.numbers[some], changes=True)
            self._catch_up_rows(_in_pool(model), slots, missed.last[some], pool.caught, missed.step, steps)

    def _catch_up_rows(
        self,
        model: tuple[DeviceGaussians, ...],
        numbers: NDArray[np.uint32],
        last: NDArray[np.uint32],
        caught: DeviceArray,
        step: int,
        table: StepTable,
    ) -> None:
        """Take the steps of Adam up to number `step` that chunks of a model on the device have missed.

        numbers: numbers of the chunks, or for a streamed model their slots in the pool.
        last: for each of `numbers`, the last step that updated the chunk with its gradients.
        caught: for every chunk or slot, the step up to which the device has caught it up.
        table: the missed steps.
        """
        device, work, readback = self._rasterizer.device, self._rasterizer.work, self._rasterizer.readback
        chunks = send_chunks(work, "chunks_behind", numbers, model[0].count)
        on_device = work.array("last_steps", chunks.numbers.shape, np.uint32)
        padded = np.full(on_device.shape, step, np.uint32)
        padded[: len(last)] = last
        on_device.send(padded)
        catch_up(device, self._limits.optimiser, model, chunks, on_device, caught, step, table, readback)

    def step_back(self, step: int) -> None:
        """Return to the state after the step that ended with view number `step`. Chunks that have been caught up since
        then are not caught up twice: the device knows the step of each."""
        step = self._number(step)
        for number in range(self.step, step, -1) if not self._config.optimiser.sparse else ():
            chunks, last = self._before.pop(number)
            self._last[chunks] = last
            self._oldest = min(self._oldest, int(last.min(initial=step)))
        self.step = min(self.step, step)

    def complete_exactly(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Catch up all chunks: take the steps of Adam that they have missed."""
        missed = self._missed(np.arange(len(self._last), dtype=np.uint32), self.step)
        if missed is None:
            return
        self._catch_up((parameters, first, second), missed)
        limit = self._limits.in_missed_steps(self._oldest, missed.step + 1, self._last[missed.numbers])
        self._note_movement(missed.numbers, limit)
        self._last[missed.numbers] = missed.step

    def rows_changed(self, groups: set[str]) -> None:
        """Forget all bounds if means or scales have changed. The next step measures them."""
        if not groups.isdisjoint(_BOUNDED_GROUPS):
            self._begin(self._count, self.step)

    def rows_moved(self, listed: DeviceArray | HostArray) -> None:
        """Forget all bounds, because rows have moved. The next step measures them."""
        self._begin(listed.shape[0], self.step)

    def load(self, named: Named, step: int, count: int) -> None:
        """Continue from a checkpoint of `count` Gaussians after `step` views, without bounds. Its moments may come from
        other decay rates, so they are read for the limit of a parameter's movement in one step.

        named: function from a prefix to the checkpoint's arrays whose names have this prefix.
        """
        first, second = named("first/"), named("second/")
        ratio = 0.0
        for begin in range(0, count, _ROWS_AT_ONCE):
            rows = slice(begin, begin + _ROWS_AT_ONCE)
            for group in _BOUNDED_GROUPS:
                with np.errstate(divide="ignore", invalid="ignore"):
                    each = np.abs(first[group][rows]) / np.sqrt(second[group][rows])
                ratio = float(np.max(each, initial=ratio, where=~np.isnan(each)))  # NaN is 0 / 0: no gradient yet
        self._limits.set(largest_resumed_step(self._limits.optimiser, ratio, self._number(step)))
        self._begin(count, self._number(step))

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian on the device: the bytes of a chunk's bounds and missed steps, divided by its rows,
        rounded up."""
        return 1 if self.on else 0


@dataclass(frozen=True, eq=False)
class _ChunksInView:
    """The chunks of a step's view, and the steps that some of them have missed.

    of: the component that made this object.
    numbers: chunks that any view of the step may show.
    in_view: chunks that this view may show.
    of_rows: the bounds from which the chunks were chosen. When rows move, the component makes new bounds, which shows
        that the list of chunks is outdated.
    whole: True if the step runs over the whole model; `numbers` then lists all its chunks.
    """

    of: VisibleChunks
    numbers: NDArray[np.uint32]
    in_view: NDArray[np.uint32]
    missed: Missed | None
    of_rows: BoundsTable
    whole: bool

    def prepare(self, model: tuple[AnyGaussians, ...], step: AdamStep) -> PlacedChunks | None:
        """Catch up the chunks of the step, and send their list to the device."""
        return self.of.prepare(model, step, self)

    def place(self, model: tuple[AnyGaussians, ...]) -> PlacedChunks:
        """Send the list of this view's chunks to the device."""
        return self.of.place(model, self.in_view, "of_view")


def _pool_of(model: Sequence[AnyGaussians]) -> ChunkPool | None:
    return model[0].pool if isinstance(model[0], HostGaussians) else None


def _in_pool(model: Sequence[AnyGaussians]) -> tuple[DeviceGaussians, ...]:
    return tuple(each.in_pool for each in model if isinstance(each, HostGaussians))


def _on_device(model: Sequence[AnyGaussians]) -> tuple[DeviceGaussians, ...]:
    return tuple(each for each in model if isinstance(each, DeviceGaussians))
