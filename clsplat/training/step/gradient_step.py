# SPDX-License-Identifier: Apache-2.0
"""Training step of one view: forward, loss, backward and Adam."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, partial
from typing import TypeVar
from weakref import ref

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.gaussians import group_shapes
from clsplat.layouts.columns import SlotFields
from clsplat.optimisation.dropout import Thinning, thinning_of
from clsplat.optimisation.step_noise import NO_EXPLORATION, Exploration
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.rendering.rasterizer import ForwardPass, PairCapacity, Rasterizer
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostGaussians, chunk_parts, parts
from clsplat.stages.loss import Loss, loss
from clsplat.stages.loss_terms import LossTerm, RenderTerms
from clsplat.stages.noise import noise, noise_numbers
from clsplat.stages.project import Projected, Slots, project_grad, project_step, step_numbers, thinning_numbers
from clsplat.stages.target import is_photograph, on_device, target
from clsplat.training.density import StatisticsNeeds
from clsplat.training.step.inputs import PlacedChunks, StepRows, ViewInputs, ViewRows
from clsplat.training.step.loss_terms import loss_terms

R = TypeVar("R")


class StepProbe:
    """Callbacks of a training step: the step calls these methods as it launches stages. By default they do nothing.

    The device may still be computing a stage when the stage's method is called. `before_rows` and `after_rows` are not
    called in a replay of a command buffer: it contains the launches that they made.
    """

    @property
    def key(self) -> tuple[object, ...]:
        """Key of the probe's own launches in a command buffer: all that these launches depend on, except `numbers`."""
        return ()

    @property
    def numbers(self) -> tuple[float, ...]:
        """Numbers that change from step to step in the probe's own launches (`LaunchParameter`), in order."""
        return ()

    def forward(self, frame: ForwardPass) -> None:
        """Observe the forward pass, after its kernels have been launched."""

    def loss(self, result: Loss) -> None:
        """Observe the loss, after its kernels have been launched."""

    def pair_gradients(self, slots: Slots) -> None:
        """Observe the pairs' gradients, after the gradient of blending has been launched."""

    def before_replay(self) -> None:
        """Called before the replay of a command buffer that launches Adam, so before the model changes."""

    def before_rows(self, rows: StepRows) -> None:
        """Observe rows of the model, on which Adam is about to be launched."""

    def after_rows(self, rows: ViewRows) -> None:
        """Observe rows of the model, after Adam has been launched on them. In a batch, this is called for each view,
        after its gradients have been added to the sums."""


NO_PROBE = StepProbe()
"""A probe whose methods do nothing."""


@dataclass(eq=False)
class GradientStep:
    """Step of one view on one device: forward, loss, backward and Adam.

    step: number of the step, for learning rates and Adam.
    fields: values that the step computes for each pair in addition to the plain gradients.
    turn: index of the array that receives the sums of the loss (`stages.loss.loss`). Steps use several arrays in turn
        if the host may still have to read an earlier step's sums.
    room: number of pairs that there is memory for, if the step is launched by capacity; None counts the pairs first.
    explore: noise and penalties of the step.
    region: the region in which Gaussians change, in the coordinates of their means; None for everywhere.
    """

    device: Device
    rasterizer: Rasterizer
    config: TrainConfig
    step: int
    rates: Mapping[str, float]
    fields: SlotFields
    _: KW_ONLY
    turn: int = 0
    room: PairCapacity | None = None
    explore: Exploration = NO_EXPLORATION
    region: TrainedRegion | None = None

    @cached_property
    def thinning(self) -> Thinning | None:
        """Random choice of Gaussians that the step drops; None without --thinning."""
        return thinning_of(self.config, self.step)

    @property
    def adam_step(self) -> AdamStep:
        """Adam's constants, step number and learning rates."""
        return AdamStep(self.config.optimiser, self.step, self.rates)

    def run(
        self,
        model: tuple[AnyGaussians, ...],
        inputs: ViewInputs,
        probe: StepProbe,
        gradients: DeviceGaussians | None = None,
        *,
        reads_loss: bool = False,
    ) -> Loss:
        """Update the model (parameters, first and second moments) with a view. Returns the loss.

        gradients: arrays for the gradients of rows, as `view_gradients` makes them; None if neither the probe nor a
            part of the view reads gradients. The arrays contain zeros before and after the step. The model gets the
            same bits with and without them.
        reads_loss: True if the loss will be read. Reading then does not wait for the rest of the step.
        """
        camera = inputs.camera
        place = self.rasterizer.send if self.room is None else self.rasterizer.keep
        sent = place(camera, inputs.background)
        source = on_device(self.rasterizer.work, inputs.photograph)
        terms = loss_terms(self.config, inputs)
        placed = self.place(model, inputs)
        model, chunks = (model, None) if placed is None else (placed.model, placed.in_model)
        key = self._key(inputs, source, terms, chunks)
        gradient = partial(self._gradient, model[0], inputs, sent, source, terms, chunks)
        if key is None or reads_loss:
            frame, result, slots, own = gradient(probe, reads_loss=reads_loss)
        else:
            numbers, given = thinning_numbers(self.thinning), (source, sent[0])
            frame, result, slots, own = self.replayed(model[0], key, gradient, numbers, given)
            self.device.under_way.append(source.buffer)  # keeps the photograph's array until the device has read it
            frame = frame.for_camera(camera, sent[0])
            probe.forward(frame)
            probe.loss(result)
            probe.pair_gradients(slots)
        self._change(model, inputs, frame, slots, gradients, probe, placed)
        self.learn(inputs, own)
        return result

    def place(self, model: tuple[AnyGaussians, ...], inputs: ViewInputs) -> PlacedChunks | None:
        """Make the chunks that the step runs over ready. Returns None if the step runs over all rows of `model`."""
        return None if inputs.chunks is None else inputs.chunks.prepare(model, self.adam_step)

    def _gradient(
        self,
        of: AnyGaussians,
        inputs: ViewInputs,
        sent: tuple[DeviceArray, DeviceArray],
        source: DeviceArray,
        terms: Sequence[LossTerm],
        chunks: ChunkList | ChunkNumbers | None,
        probe: StepProbe = NO_PROBE,
        *,
        reads_loss: bool = False,
    ) -> tuple[ForwardPass, Loss, Slots, Sequence[DeviceArray | None]]:
        """Run forward and backward. Returns forward pass, loss, gradients of the pairs, and the parts' gradients.

        of: parameters of the model.
        sent: camera and background on the device.
        source: the photograph on the device.
        terms: terms of the loss in addition to L1 and D-SSIM.
        chunks: the chunks in view; None for the whole model.
        """
        camera = inputs.camera
        forward = partial(self.rasterizer.forward, of, camera, sent, room=self.room, thinning=self.thinning)
        frame = forward(nearness=self.fields.nearness, chunks=chunks)
        probe.forward(frame)
        result = self._compare(of, inputs, source, frame, terms)
        if reads_loss:
            result = result.fetched()
        probe.loss(result)
        view = (self.rasterizer.work, frame.blended.image, result.gradient, (camera.width, camera.height))
        own = [part.gradient(*view) for part in inputs.parts]
        slots = self.replayed(
            of,
            (frame.listed, frame.background, result.gradient, self.fields),
            lambda: self.rasterizer.pair_gradients(frame, result.gradient, fields=self.fields),
            given=sent[:1],
        )
        probe.pair_gradients(slots)
        return frame, result, slots, own

    def _key(
        self,
        inputs: ViewInputs,
        source: DeviceArray,
        terms: Sequence[LossTerm],
        chunks: ChunkList | ChunkNumbers | None,
    ) -> tuple[object, ...] | None:
        """Key of the command buffer with all launches of the view's gradient; None if no buffer can have them all.

        No buffer can have them all if pairs are counted exactly, if components have parts in the view, or if the view
        has a depth loss or a mask. With masks, each photograph has its own divisor of the loss.
        """
        keys, camera, room, fields = tuple(term.key for term in terms), inputs.camera, self.room, self.fields
        if room is None or inputs.parts or inputs.kept is not None or None in keys:
            return None
        of_view = (self.rasterizer.device_of(camera), source.shape, source.dtype)  # the camera has the size of `source`
        of_step = (room.pairs, room.turn, room.appends, fields.absolute, fields.contributions, fields.nearness)
        assert not isinstance(chunks, ChunkNumbers), "such a step has exact counts"
        rows = None if chunks is None else chunks.key
        return (*of_view, *of_step, self.turn, self.config.thinning > 0, keys, rows)

    def _compare(
        self,
        of: AnyGaussians,
        inputs: ViewInputs,
        source: DeviceArray,
        frame: ForwardPass,
        terms: Sequence[LossTerm],
    ) -> Loss:
        """Return the loss between a frame and the photograph `source`, with L1, D-SSIM and `terms`. of: parameters of
        the model in the frame."""
        work, size = self.rasterizer.work, (inputs.camera.width, inputs.camera.height)
        alpha = any(term.wants_alpha for term in terms)
        changed = any(part.changes_target for part in inputs.parts)
        planes = target(self.device, work, source, frame.background, frame.blended, alpha=alpha, in_planes=changed)
        image = frame.blended.image
        for part in inputs.parts:
            image = part.compare(work, image, planes, size)

        weight, further = self.config.dssim_weight, RenderTerms(frame.blended, terms)

        def compared() -> Loss:
            return loss(self.device, work, image, planes, size, weight, self.turn, kept=inputs.kept, further=further)

        keys = tuple(term.key for term in terms)
        if None in keys:
            return compared()
        key = (frame.listed, image.buffer, inputs.kept, keys, self.turn)
        if is_photograph(planes):  # each photograph has its own array, which the replay must be given
            return self.replayed(of, (*key, planes.shape, planes.dtype), compared, given=(planes,))
        return self.replayed(of, key, compared)

    def _change(
        self,
        model: tuple[AnyGaussians, ...],
        inputs: ViewInputs,
        frame: ForwardPass,
        slots: Slots,
        gradients: DeviceGaussians | None,
        probe: StepProbe,
        placed: PlacedChunks | None,
    ) -> None:
        """Take Adam's step for the whole model, or only for the chunks in `placed`. A streamed model comes to the
        device in parts."""
        chunks = None if placed is None else placed.in_model

        def change() -> None:
            for start, part, projected in self._parts(model, frame.projected, chunks):
                rows = self._rows(start, part, inputs, frame.camera_array, projected, slots, gradients)
                self._change_rows(rows, inputs, probe)

        if self.room is None or gradients is not None or any(part.changes_rows for part in inputs.parts):
            change()
            return
        step, explore = self.adam_step, self.explore
        assert not isinstance(chunks, ChunkNumbers), "such a step has exact counts"
        rows = None if chunks is None else chunks.key
        key = (slots, *map(ref, model[1:]), step.updates_sh_rest, bool(explore.weights), explore.amount != 0, rows)
        numbers = (*step_numbers(step, explore), *noise_numbers(explore), *probe.numbers)
        given = (frame.camera_array,)
        self.replayed(model[0], (*key, *probe.key), change, numbers, given, probe.before_replay)

    def _parts(
        self, model: tuple[AnyGaussians, ...], projected: Projected, chunks: ChunkList | ChunkNumbers | None
    ) -> Iterator[tuple[int, tuple[DeviceGaussians, ...], Projected]]:
        """Yield the parts in which the model comes to the device. A part is the number of its first row, its rows of
        each array of the model, and their projection."""
        work = self.rasterizer.work
        if isinstance(chunks, ChunkNumbers):
            for start, stop, part, slots in chunk_parts(work, chunks, *model, changes=True):
                yield start, part, replace(projected.rows(start, stop), chunks=slots)
            return
        for start, stop, part in parts(work, *model, keep=True):
            yield start, part, projected.rows(start, stop) if chunks is None else projected

    def _rows(
        self,
        start: int,
        model: tuple[DeviceGaussians, ...],
        inputs: ViewInputs,
        camera_array: DeviceArray,
        projected: Projected,
        slots: Slots,
        gradients: DeviceGaussians | None,
    ) -> StepRows:
        """Make the `StepRows` of a part of the model: the rows of `projected`, of which the first is row `start` of the
        step."""
        count = projected.tile_counts.shape[0]
        by_lens = (part.lens_gradients(count) for part in inputs.parts)
        return StepRows(
            start,
            start + count,
            projected,
            self.rasterizer.screen(count, self.fields),
            model,
            self.rasterizer.device_of(inputs.camera),
            camera_array,
            slots.rows(start, start + count),
            gradients,
            next((room for room in by_lens if room is not None), None),
        )

    def _change_rows(self, rows: StepRows, inputs: ViewInputs, probe: StepProbe) -> None:
        """Take Adam's step for some rows. Calls the probe before and after it."""
        if rows.gradients is not None:
            project_grad(
                rows.device,
                rows.parameters,
                rows.view,
                rows.gradients,
                rows.screen,
                sh_rest=self.adam_step.updates_sh_rest,
                explore=self.explore,
                by_lens=rows.by_lens,
                region=self.region,
            )
            for part in inputs.parts:
                part.add_rows(rows)
        probe.before_rows(rows)
        self.change(rows, inputs)
        probe.after_rows(rows)

    def change(self, rows: StepRows, inputs: ViewInputs) -> None:
        """Take Adam's step for some rows, after the changes that the view's parts make to them."""
        for part in inputs.parts:
            part.before_adam(rows, self.adam_step)
        self.update(rows, inputs)

    def replayed(
        self,
        of: object,
        key: tuple[object, ...],
        make: Callable[[], R],
        numbers: tuple[float, ...] = (),
        given: tuple[DeviceArray, ...] = (),
        before: Callable[[], None] | None = None,
    ) -> R:
        """Result of `make`, from a command buffer (`Workspace.replayed`) if the step is launched by capacity.

        A step with exact counts has new arrays each time, so its command buffer would never be reused.
        `Workspace.replayed` describes the arguments.
        """
        if self.room is None:
            return make()
        return self.rasterizer.work.replayed(of, key, make, numbers, given, before)

    def learn(self, inputs: ViewInputs, own: Sequence[DeviceArray | None]) -> None:
        """Take Adam's step for the parameters of the view's parts. own: the gradient of each part."""
        for part, gradient in zip(inputs.parts, own, strict=True):
            part.update(gradient, self.rasterizer.readback)

    def update(self, rows: StepRows, inputs: ViewInputs) -> None:  # noqa: ARG002
        """Take Adam's step for some rows. Before it, compute the gradient of projection, unless `rows` has it."""
        step, readback = self.adam_step, self.rasterizer.readback
        if rows.gradients is not None:
            parameters, first, second = rows.model
            models = (parameters, rows.gradients, first, second)
            adam(self.device, step, *models, rows.projected.tile_counts, readback)
        else:
            target = (rows.model, rows.view, rows.screen, readback)
            project_step(rows.device, step, *target, explore=self.explore, region=self.region)
        noise(self.device, self.explore, rows.parameters, rows.start, readback, self.region)


StepMaker = Callable[..., GradientStep]
"""Function that makes a `GradientStep` from its arguments `turn` and `room`."""


def view_gradients(
    work: Workspace, parameters: AnyGaussians, rows: int | None = None, *, zero: bool = False
) -> DeviceGaussians:
    """Arrays for a view's gradients of the rows that are on the device at the same time.

    rows: number of these rows, if the step runs over some chunks; None for the rows of the whole model.
    zero: True to fill the arrays with zeros, as `GradientStep.run` requires.
    """
    if rows is None:
        rows = min(parameters.rows, parameters.count) if isinstance(parameters, HostGaussians) else parameters.count
    shapes = group_shapes(rows, parameters.coefficients)
    arrays = {group: work.array(f"view_{group}", shape) for group, shape in shapes.items()}
    for array in arrays.values() if zero else ():
        array.fill(0.0)
    return DeviceGaussians(rows, parameters.coefficients, arrays)


def slot_fields(needs: StatisticsNeeds, *, nearness: bool = False) -> SlotFields:
    """Values that a step computes for each pair in addition to the plain gradients, for the density statistics `needs`.

    nearness: True if there is a depth loss, which needs the gradient with respect to nearness.
    """
    return SlotFields(needs.absolute, needs.contributions, nearness)
