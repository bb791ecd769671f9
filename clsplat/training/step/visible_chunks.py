# SPDX-License-Identifier: Apache-2.0
"""A step of a large model runs over the chunks that its view may show (docs/decisions/0051-chunks.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.chunks.bounds import ChunkBounds, hidden_path, largest_resumed_step, largest_step
from clsplat.chunks.bounds_table import BoundsTable, Movement
from clsplat.chunks.culling import PictureBorders, visible
from clsplat.chunks.order import ORDERED_ROWS
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.launch import DEFAULT_GROUP_ITEMS
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.dropout import thinning_of
from clsplat.rendering.rasterizer import MAX_COUNTED_PASSES, Rasterizer
from clsplat.stages.adam import AdamStep
from clsplat.stages.bounds import bounds, send_chunks
from clsplat.stages.catch_up import StepTable, catch_up, step_table
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostGaussians, upload_chunks
from clsplat.training.learning_rates import largest_rates
from clsplat.training.step.component import Component, Named
from clsplat.training.step.inputs import ChunksInView, PlacedChunks, ViewInputs

STEPS_PER_MEASUREMENT = 16
"""Steps after which the bounds of the chunks that took part in them are measured again. More steps widen the bounds,
whose growth by each step is an upper limit; fewer wait more often for the device."""
MAX_SHARE_IN_VIEW = 0.6
"""Share of the chunks in view above which a step runs over the whole model. On a CPU, with 0.4 of a town in view, steps
take 0.89 of the time of steps over the whole; with 0.78 of bonsai, 1.01."""
MOST_MISSED_STEPS = 1024
"""Steps after which a chunk is caught up even if no view shows it."""


@dataclass(frozen=True, eq=False)
class Missed:
    """Steps that chunks have missed because no view showed them.

    numbers: the chunks, in rising order.
    last: (chunks,) uint32, the last step that each has taken.
    step: the step up to which they are caught up.
    table: the steps from number `first_step` on (`stages.catch_up.step_table`).
    """

    numbers: NDArray[np.uint32]
    last: NDArray[np.uint32]
    step: int
    table: Float32
    first_step: int


class VisibleChunks(Component):
    """The chunks of a training's model: bounds, the movement of Gaussians since these were measured, and the last step
    that each chunk has taken.

    A chunk that a step leaves out has no Gaussian that the view shows. Before a view shows it again, it takes the steps
    that it has missed, with the bits that it would have. So no bit of a result depends on the bounds.

    unit: the scene's length unit.
    """

    def __init__(self, config: TrainConfig, rasterizer: Rasterizer, unit: float, count: int) -> None:
        self._config, self._rasterizer, self._unit = config, rasterizer, unit
        self._limit_movement(largest_step(config.optimiser))
        self._begin(count, 0)

    def _limit_movement(self, step: float) -> None:
        """Set the most by which a step moves a parameter, as a multiple of the learning rate."""
        self._step_limit = step
        self._hidden_limit = 0.0 if self._config.optimiser.sparse else hidden_path(self._config.optimiser, step)

    def _begin(self, count: int, step: int) -> None:
        """Forget all bounds, of a model of `count` Gaussians that have all taken step number `step`."""
        chunks = -(-count // CHUNK_ROWS)
        self._count = count
        self._found = BoundsTable(chunks)
        self._unmeasured = np.ones(chunks, np.bool_)
        self._since: int | None = None
        """Steps since the last measurement; None if there is none."""
        most = 2 * (MOST_MISSED_STEPS + STEPS_PER_MEASUREMENT)  # twice, so that the table is seldom moved
        self._table = np.zeros((most, 2 + len(PARAMETER_GROUPS)), np.float32)
        """The steps from `_first_step` on, of which chunks may have missed some (`stages.catch_up.step_table`)."""
        self._begin_table(step, chunks)
        self._before: dict[int, NDArray[np.uint32]] = {}
        """By number, `_last` as it was before the latest steps, which may be repeated."""
        self._caught: DeviceArray | None = None

    def _begin_table(self, step: int, chunks: int) -> None:
        """Begin with the next step, as all chunks have taken step number `step`."""
        self.step, self._first_step = step, step + 1
        self._last = np.full(chunks, step, np.uint32)

    @property
    def on(self) -> bool:
        """True if a step changes hidden Gaussians at most by Adam, and reads gradients of none of them."""
        config = self._config
        by_adam_only = config.density.growth != "mcmc" and not config.antialiased and not config.optimiser.late
        one_view = config.batch == 1 and not config.refines
        groups = self._rasterizer.device.max_group >= DEFAULT_GROUP_ITEMS
        return by_adam_only and one_view and groups and isfinite(self._step_limit)

    def is_due(self, step: int, views: int) -> bool:  # noqa: ARG002
        """True if bounds must be measured before the next step."""
        return self._count > ORDERED_ROWS and (self._since is None or self._since >= STEPS_PER_MEASUREMENT)

    @property
    def reads_all_rows(self) -> bool:
        """True if a chunk has missed so many steps that all are caught up at the next measurement."""
        return self.step - int(self._last.min(initial=self.step)) >= MOST_MISSED_STEPS

    def before_step(self, gaussians: AnyGaussians) -> None:
        """Measure the bounds of chunks whose Gaussians may have moved."""
        streams = isinstance(gaussians, HostGaussians)
        if streams and not (self._config.optimiser.sparse and self._config.thinning == 0):
            return  # neither the missed steps nor the random numbers are those of a part of the model
        self._since = 0
        numbers = np.flatnonzero(self._unmeasured).astype(np.uint32)
        if len(numbers) == 0:
            return
        self._found.measure(numbers, self._measured(gaussians, numbers))
        self._unmeasured[numbers] = False

    def _measured(self, gaussians: AnyGaussians, numbers: NDArray[np.uint32]) -> Float32:
        """Bounds (chunks, BOUNDS_FLOATS) of these chunks."""
        if isinstance(gaussians, DeviceGaussians):
            work = self._rasterizer.work
            chunks = send_chunks(work, "chunks", numbers, gaussians.count)
            return bounds(self._rasterizer.device, work, gaussians, chunks)[: len(numbers)]
        rows = (CHUNK_ROWS * numbers.astype(np.int64)[:, None] + np.arange(CHUNK_ROWS)).ravel()
        rows = rows[rows < gaussians.count]
        found = ChunkBounds.measured(*(gaussians[group].values[rows] for group in ("means", "log_scales")))
        return np.hstack([found.lowest, found.highest, found.largest[:, None]]).astype(np.float32)

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:
        """The view, with the chunks that it may show."""
        if count <= ORDERED_ROWS or self._since is None:
            return inputs
        (of_view,) = inputs
        if self.step < step - 1:  # the steps between ran over all rows of a model that was small or streamed
            self._begin_table(step - 1, len(self._last))
        hidden, most_hidden = self._hidden_movement(step)
        numbers = self._shown(of_view, step, hidden, most_hidden)
        whole = len(numbers) > MAX_SHARE_IN_VIEW * len(self._last)
        self._since += 1
        if whole:
            numbers = np.arange(len(self._last), dtype=np.uint32)
        self._note_movement(numbers, hidden(numbers))
        self._found.move(numbers, self._step_limit * self._mean_and_scale_rates(range(step, step + 1)))
        missed = self._missed(numbers, step - 1)
        return [replace(of_view, chunks=_ChunksInView(self, numbers, missed, self._found, whole=whole))]

    def _shown(self, of_view: ViewInputs, step: int, hidden: Movement, most: Float64) -> NDArray[np.uint32]:
        """The chunks that the view may show, in rising order. hidden, most: results of `_hidden_movement`."""
        thinning = thinning_of(self._config, step)
        factor = 1.0 if thinning is None else thinning.factor
        picture = PictureBorders.of(of_view.camera, self._config.rasterizer, factor)
        return self._found.seen(partial(visible, picture), hidden, most, MOST_MISSED_STEPS + STEPS_PER_MEASUREMENT)

    def _hidden_movement(self, step: int) -> tuple[Movement, Float64]:
        """The most by which means and log scales of some chunks move in the steps before number `step` that they have
        missed, and (2, 1) the most for any chunk."""
        longest = np.argmin(self._last, axis=0, keepdims=True)
        rates = self._mean_and_scale_rates(range(min(int(self._last[longest[0]]), step - 1) + 1, step + 1))

        def hidden(chunks: NDArray[np.integer]) -> Float64:
            path = np.minimum(self._step_limit * (step - 1 - self._last[chunks]), self._hidden_limit)
            return np.asarray(rates * path)

        return hidden, hidden(longest)

    def _mean_and_scale_rates(self, steps: range) -> Float64:
        """Upper limits (2, 1) of the learning rates of means and log scales in these steps."""
        rates = largest_rates(self._config, steps, self._unit)
        return np.array([[rates["means"]], [rates["log_scales"]]])

    def _note_movement(self, chunks: NDArray[np.uint32], hidden: Float64) -> None:
        """Note that these chunks move by `hidden` (2, n) in the steps that they have missed."""
        self._found.move(chunks, hidden)
        self._unmeasured[chunks] = True

    def _missed(self, chunks: NDArray[np.uint32], step: int) -> Missed | None:
        """The steps up to `step` that these chunks have missed; None if there is none."""
        if self._config.optimiser.sparse:
            return None
        numbers = chunks[self._last[chunks] < step]
        if len(numbers) == 0:
            return None
        last, first = self._last[numbers], int(self._last[numbers].min()) + 1
        table = self._table[first - self._first_step : step + 1 - self._first_step].copy()
        return Missed(numbers, last, step, table, first)

    def prepare(self, model: tuple[AnyGaussians, ...], step: AdamStep, chunks: _ChunksInView) -> PlacedChunks | None:
        """Catch up the chunks that a step's view shows, and send their list. A repeated step is the same again."""
        if chunks.of_rows is not self._found:  # rows have moved since, and all have taken every step
            chunks = _ChunksInView(self, np.arange(len(self._last), dtype=np.uint32), None, self._found, whole=True)
        if chunks.missed is not None:
            self._catch_up(_on_device(model), chunks.missed)
        older = {number: last for number, last in self._before.items() if number >= step.number - MAX_COUNTED_PASSES}
        self._before = {**older, step.number: self._last}
        self._last, self.step = self._last.copy(), step.number
        self._last[chunks.numbers] = step.number
        self._note(step)
        streamed = [each for each in model if isinstance(each, HostGaussians)]
        if chunks.whole or (streamed and CHUNK_ROWS * len(chunks.numbers) > streamed[0].rows):
            return None
        work = self._rasterizer.work
        listed = send_chunks(work, "chunks", chunks.numbers, model[0].count)
        if not streamed:
            return PlacedChunks(listed, model)
        numbers = chunks.numbers if len(chunks.numbers) else np.zeros(1, np.uint32)  # a model has a row
        return PlacedChunks(listed, *upload_chunks(work, numbers, *streamed))

    def _note(self, step: AdamStep) -> None:
        """Put a step into the table, from which steps go that all chunks have taken."""
        if self._config.optimiser.sparse:
            return
        if step.number - self._first_step >= len(self._table):
            oldest = min(int(last.min()) for last in (self._last, *self._before.values()))  # a step may be repeated
            past = oldest + 1 - self._first_step
            self._table[:-past] = self._table[past:].copy()
            self._first_step += past
        self._table[step.number - self._first_step] = step_table([step])[0]

    def _catch_up(self, model: tuple[DeviceGaussians, ...], missed: Missed) -> None:
        device, work, readback = self._rasterizer.device, self._rasterizer.work, self._rasterizer.readback
        if self._caught is None:
            self._caught = allocate(device, self._last.shape, np.uint32)
            self._caught.fill(0)
        chunks = send_chunks(work, "chunks_behind", missed.numbers, model[0].count)
        last = work.array("last_steps", chunks.numbers.shape, np.uint32)
        padded = np.full(last.shape, missed.step, np.uint32)
        padded[: len(missed.last)] = missed.last
        last.send(padded)
        table = work.array("missed_steps", missed.table.shape)
        table.send(missed.table)
        steps = (last, self._caught, missed.step, StepTable(table, missed.first_step))
        catch_up(device, self._config.optimiser, model, chunks, *steps, readback)

    def step_back(self, step: int) -> None:
        """Return to the state after step number `step`. Chunks that were caught up after it are marked as such."""
        if step >= self.step:
            return
        self._last, self.step = self._before[step + 1], step

    def complete_exactly(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Catch up all chunks."""
        missed = self._missed(np.arange(len(self._last), dtype=np.uint32), self.step)
        if missed is None:
            return
        self._catch_up(_on_device((parameters, first, second)), missed)
        hidden, _ = self._hidden_movement(missed.step + 1)
        self._note_movement(missed.numbers, hidden(missed.numbers))
        self._last[missed.numbers] = missed.step

    def rows_changed(self) -> None:
        """Measure all bounds again."""
        self._begin(self._count, self.step)

    def rows_moved(self, listed: DeviceArray) -> None:
        """Measure all bounds again."""
        self._begin(listed.shape[0], self.step)

    def load(self, named: Named, step: int, count: int) -> None:
        """Measure all bounds of the checkpoint's Gaussians, whose moments other decays may have made."""
        first, second = named("first/"), named("second/")
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = [np.abs(first[group]) / np.sqrt(second[group]) for group in ("means", "log_scales")]
        ratio = max(float(np.max(each, initial=0.0, where=~np.isnan(each))) for each in ratios)  # NaN: both are 0
        self._limit_movement(largest_resumed_step(self._config.optimiser, ratio, step))
        self._begin(count, step)

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian: those of a chunk in lists, bounds and missed steps, rounded up."""
        return 1 if self.on else 0


@dataclass(frozen=True, eq=False)
class _ChunksInView(ChunksInView):
    """The chunks of a step's view, and the steps that some of them have missed.

    of_rows: bounds of the chunks that are listed, an array of its own for each order of the model's rows.
    whole: True if the step runs over the whole model, of which all chunks are listed.
    """

    of: VisibleChunks
    numbers: NDArray[np.uint32]
    missed: Missed | None
    of_rows: BoundsTable
    whole: bool

    def prepare(self, model: tuple[AnyGaussians, ...], step: AdamStep) -> PlacedChunks | None:
        """Catch up these chunks, and send their list."""
        return self.of.prepare(model, step, self)


def _on_device(model: Sequence[AnyGaussians]) -> tuple[DeviceGaussians, ...]:
    assert all(isinstance(each, DeviceGaussians) for each in model), "a streamed model has nothing to catch up"
    return tuple(each for each in model if isinstance(each, DeviceGaussians))
