# SPDX-License-Identifier: Apache-2.0
"""The trainer: a model in training, its training step, and the state that a checkpoint saves and restores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.optimisation.density_rules import FRESH
from clsplat.optimisation.step_noise import exploration_of
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import PairCapacity, Rasterizer
from clsplat.rendering.renderer import Renderer, RenderResult
from clsplat.runs.appearance import held_out_looks
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.scenes.start.initialise import from_scene
from clsplat.stages.density import DensityStatistics
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, download_gaussians
from clsplat.stages.loss import Loss
from clsplat.training.appearance.choice import appearance_of
from clsplat.training.batches.batch import Batch, Losses
from clsplat.training.cameras.refinement import Cameras, ValidationViews
from clsplat.training.density import ModelState, RowPlan, StatisticsNeeds, Strategy
from clsplat.training.density.choice import strategy_of
from clsplat.training.learning_rates import rates_at
from clsplat.training.memory import UNLIMITED, HostMemory, MemoryPlanner
from clsplat.training.moved_rows import drop_outside
from clsplat.training.preparation import is_along_rays, saved_model
from clsplat.training.stability.health import finite_or_zero
from clsplat.training.stability.non_finite import NonFiniteMonitor, Repair
from clsplat.training.start import Start, check_region, region_state
from clsplat.training.step.components import components_of
from clsplat.training.step.gradient_step import GradientStep, StepMaker, StepProbe, slot_fields, view_gradients
from clsplat.training.step.inputs import ViewInputs
from clsplat.training.step.monitor import StepMonitor
from clsplat.training.step.position import Mark, Position
from clsplat.training.step.speculative_steps import SpeculativeSteps
from clsplat.training.step.view_order import ViewOrder
from clsplat.training.supervision.depth_targets import DepthTargets
from clsplat.training.supervision.image_cache import ImageCache
from clsplat.training.supervision.resolution import by_doubling
from clsplat.training.supervision.view_loader import ViewLoader
from clsplat.training.trained_model import TrainedModel

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


class Trainer:
    """A model in training: parameters, moments, statistics and random state. A checkpoint contains all of these.

    position: step, random state and views left in the epoch.
    monitor: monitor of non-finite values in the model.
    pending: launched steps that may have to be repeated, because their counts are not read yet.
    mark: position that `step_back` returns to; None after the model has changed.
    further: devices in addition to the model's.
    loader: loader of the steps' photographs and cameras.
    order: order of the views in each pass.
    region: region in which Gaussians are trained, in the coordinates of their means; None for everywhere.
    background: background of the last view.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        device: Device,
        initial: Gaussians | Start | None = None,
        strategy: Callable[[TrainConfig], Strategy] = strategy_of,
        further: Sequence[Device] = (),
        memory: HostMemory = UNLIMITED,
    ) -> None:
        self.scene, self.config, self.device, self._new_strategy = scene, config, device, strategy
        self.views = scene.require_training_views()
        cameras = [view.camera for view in self.views]
        self.order = ViewOrder(cameras, scene.length_unit, near=config.view_order == "near")
        self.rasterizer = Rasterizer(device, config.rasterizer, antialiased=config.antialiased)
        self.photographs = ImageCache(device, memory.photographs(scene, config))
        self.renderer = Renderer(device, self.rasterizer)
        self.validation_views = ValidationViews(scene, device, config)
        self.depths = DepthTargets(config, self.views, scene.length_unit, scene.near, self._pixels)
        self.batch = Batch(self.rasterizer, self.photographs, config, further) if config.batch > 1 else None
        self.planner = MemoryPlanner(scene, config, self.rasterizer, self.photographs, memory, self.batch)
        self.sizes = by_doubling(config.warmup)
        self.background: NDArray[np.float32] = np.array(background_colour(config.background), np.float32)
        self.begins_with = initial if isinstance(initial, Start) else Start(initial)
        self.monitor = NonFiniteMonitor(self.rasterizer.readback)
        self.pending = SpeculativeSteps(device, self.monitor, self._begin_again)
        self.pending.on &= self.batch is None and not config.refines  # batches and refinement wait for each step
        self._start()

    def _start(self) -> None:
        """Set up the model, the components and the position of step 0."""
        self.position = Position(np.random.default_rng(self.config.seed))
        self.mark: Mark | None = None
        self.tried: set[tuple[object, ...]] = set()
        self.strategy = self._new_strategy(self.config)
        self._looks_at_steps = type(self.strategy).after_gradient is not Strategy.after_gradient
        initial = self.begins_with.model or from_scene(self.scene, self.config.random_points, self.position.rng)
        self.appearance = appearance_of(self.config, self.device, self.scene)
        if (earlier := self.begins_with.appearance_of) is not None:
            self.appearance.begin_from(earlier, keeps_lenses=self.begins_with.region is not None)
        self.cameras = Cameras(self.config, self.scene, self.rasterizer.work)
        self.origin, self.near, region = initial.origin, self.scene.near, self.begins_with.region
        self.region = None if region is None else region.relative_to(self.origin)
        self.by_rays = is_along_rays(self.config, self.views)
        self.loader = ViewLoader(self.config, self.views, self.photographs, self.sizes, self.cameras.of, self.local)
        cameras = [self.local(view.camera) for view in self.views]
        others = (self.config, self.rasterizer, (self.appearance, self.cameras, self.depths))
        of_model = (len(initial), self.scene.length_unit, partial(self.loader.next_cameras, self.position))
        self.components = components_of(*others, cameras, self.region, *of_model)
        self._active = [component for component in self.components if component.on]
        of, files = (self.device, self.rasterizer.work), (self.planner.scratch_file, self.planner.scratch_files)
        plans, contributions = (self._make_plan, self.planner.plan_view), self.strategy.needs().contributions
        self.model = TrainedModel(
            *of, *plans, *files, sh_degree=self.config.sh_degree, counts_contributions=contributions
        )
        self.model.begin(initial, partial(self.planner.look, self.local))

    def _make_plan(self, count: int) -> Plan:
        return self.planner.plan(count, self.strategy.needs(), self.components, self.pending.turns)

    @property
    def step(self) -> int:
        """Number of views that training has used so far."""
        return self.position.step

    @property
    def parameters(self) -> AnyGaussians:
        """Parameters of the model."""
        return self.model.parameters

    @property
    def statistics(self) -> DensityStatistics:
        """Density statistics of the model."""
        return self.model.statistics

    @property
    def plan(self) -> Plan:
        """Plan of the device's memory."""
        return self.model.plan

    @property
    def views_ahead(self) -> int:
        """Number of views of the next step."""
        return max(min(self.config.batch, self.config.iterations - self.step), 1)

    def train_step(self, *, reads_loss: bool = False) -> Loss | Losses:
        """Run the pending density control, then one view, or a batch of them: forward, loss, backward, Adam.

        reads_loss: True if the loss will be read. Reading then waits only for the loss, not for the whole step.

        Kerbl et al. 2023, algorithm 1, but density control comes first instead of last. So a model is rendered, saved
        or finished before its Gaussians are split or made transparent, and not right after.
        """
        self.planner.begins = False
        if self.mark is None or self._looks_at_steps:
            self._note()
        if self.monitor.noticed:
            self.repair()
        if self.cameras.gate.on:
            self.validate()
        if not self.position.controlled:
            self._control_density()
            self.position.controlled = True
        if self.mark is None:
            self._note()
        views = self.views_ahead
        self.position.step += views
        self._raise_sh_degree()
        self._prepare_components(views)
        needs, factor = self.strategy.needs(self.step), self.sizes.factor(self.step)
        inputs, step = self._inputs(views), self._gradient_step(needs)
        self.loader.read_ahead(self.position)
        result: Loss | Losses
        if self.batch is None:
            run = partial(self._run, step, inputs[0], needs, reads_loss)
            counted = (self.rasterizer, (factor, self.rasterizer), self.parameters.count)
            room = 0 if self._looks_at_steps else self.pending.room(*counted)
            result = self.pending.launch(run, room, number=self.step, reads_loss=reads_loss)
            if self.position.queue:  # fetch the next step's photograph
                self.photographs.ahead(self.position.queue[-1], factor)
        else:
            of = (step(), self.model.with_moments, inputs, factor, partial(self._watched_in_batch, needs))
            result = self.batch.run(*of, statistics=needs.gradients)
            self._after_adam()
        self.position.controlled, self.position.last_views = False, views
        self._note()
        self.model.fetch_ahead()
        if self._looks_at_steps:
            self.catch_up_exactly()
            self._rearrange(self.strategy.after_gradient(self._state()))
        return result

    def _prepare_components(self, views: int) -> None:
        """Let components do the work that is due before the current step, which has `views` views."""
        if due := [component for component in self._active if component.is_due(self.step, views)]:
            (self.catch_up if any(component.reads_all_rows for component in due) else self.settle)()
            for component in due:
                component.before_step(self.parameters)

    def _inputs(self, views: int) -> Sequence[ViewInputs]:
        """Inputs of the step's views, with the components' parts in them."""
        inputs: Sequence[ViewInputs] = [self._view_inputs(place) for place in range(views)]
        for component in self._active:
            inputs = component.join(inputs, self.step, self.parameters.count)
        return inputs

    def _gradient_step(self, needs: StatisticsNeeds) -> StepMaker:
        """Return a function that makes this step's `GradientStep` from its arguments `turn` and `room`."""
        rates, count, unit = self.rates(), self.parameters.count, self.scene.length_unit
        fields = slot_fields(needs, nearness=self.depths.on)
        explore = exploration_of(self.config, self.step, rates["means"], count, unit)
        of = (self.device, self.rasterizer, self.config, self.step, rates, fields)
        return partial(GradientStep, *of, explore=explore, region=self.region)

    def _run(
        self,
        make: StepMaker,
        inputs: ViewInputs,
        needs: StatisticsNeeds,
        reads_loss: bool,
        turn: int,
        room: PairCapacity | None,
    ) -> Loss:
        """Run a step of one view.

        make: function that makes the `GradientStep` from `turn` and `room` (`_gradient_step`).
        needs: statistics that the step gathers for density control.
        turn: index of the array for the sums of the loss. room: capacity in pairs; None counts the pairs first.
        """
        step = make(turn=turn, room=room)
        model, probe = self.model.with_moments, self._watched(needs, inputs, step, step.step)
        result = step.run(model, inputs, probe, self._view_gradients(inputs), reads_loss=reads_loss)
        self._after_adam()
        return result

    def _begin_again(self, step: int) -> None:
        """Prepare for repeating step number `step`. This invalidates `mark`."""
        self.mark = None
        for component in self.components:
            component.step_back(step - 1)
        self.repair()

    def settle(self) -> None:
        """Wait for all launched steps, and repeat the incomplete ones (`SpeculativeSteps`)."""
        self.pending.settle()

    def catch_up(self) -> None:
        """Wait for all launched steps. Then make all changes to Gaussians that components have postponed."""
        self.settle()
        for component in self.components:
            component.complete(*self.model.with_moments)

    def catch_up_exactly(self) -> None:
        """Wait for all launched steps. Then make the postponed changes that give the same bits now as later."""
        self.settle()
        for component in self.components:
            component.complete_exactly(*self.model.with_moments)

    @property
    def complete_parameters(self) -> AnyGaussians:
        """Parameters with all postponed changes. They may be a copy, so that reading them does not change the model."""
        self.catch_up_exactly()
        parameters = self.parameters
        for component in self.components:
            parameters = component.completed(parameters, *self.model.with_moments[1:])
        return parameters

    def _pixels(self, view: int) -> NDArray[Any]:
        """Photograph of a view at the step's size, on the host."""
        return self.photographs.load(view, self.sizes.factor(self.step))

    def _view_inputs(self, place: int) -> ViewInputs:
        """Inputs of the next view. place: index of the view within the step."""
        begins, view = not self.position.queue, self._next_view()
        inputs = self.loader.inputs(view, self.position, place, begins=begins)
        self.background = inputs.background
        return inputs

    def _view_gradients(self, inputs: ViewInputs) -> DeviceGaussians | None:
        """Arrays for the gradients of a view with respect to parameters; None if no component reads them."""
        if not inputs.parts or not any(part.wants_gradients for part in inputs.parts):
            return None
        return view_gradients(self.rasterizer.work, self.parameters, zero=True)

    def _after_adam(self) -> None:
        for component in self._active:
            component.after_adam(self.parameters)

    def _watched(self, needs: StatisticsNeeds, inputs: ViewInputs, step: GradientStep, number: int) -> StepMonitor:
        """Return the probe of a view's step. number: number of views used so far, including this step's views."""
        return StepMonitor(
            step, number, inputs, needs, self.statistics.on_device, self.monitor, self.pending, self.tried, self._unmark
        )

    def _unmark(self) -> None:
        self.mark = None

    def _watched_in_batch(self, needs: StatisticsNeeds, inputs: ViewInputs, step: GradientStep) -> StepProbe:
        """Return the probe of a batch's view. Call it in view order: an epoch's first view resets contributions."""
        if inputs.begins:
            self._turn_epoch()
        return self._watched(needs, inputs, step, self.step)

    def draw(self, camera: Camera) -> RenderResult:
        """Render the current model with a camera in world coordinates, over the background of evaluations."""
        background = background_colour(self.config.background)
        return self.renderer.render(self.complete_parameters, self.local(camera), background)

    def validate(self) -> bool:
        """Validate the refined cameras, if that is due. Returns True if they were validated."""
        if not self.cameras.gate.is_due(self.step):
            return False
        self.settle()
        look = held_out_looks(self.appearance.record())
        self.cameras.validate(self.validation_views, self.step, lambda camera: self.draw(camera).image, look)
        return True

    def _note(self, *, begun: bool = False) -> None:
        """Mark the current position. `step_back` returns to it, until the model changes.

        begun: True if the step number has already been increased for the current step, which has one view.
        """
        self.mark = self.position.mark(begun=begun)

    def step_back(self) -> bool:
        """After an error, return to `mark`, where a checkpoint is possible: before the step, or after its density
        control if that is done. Returns False if the model has changed since."""
        if self.mark is None:
            return False
        self.position.go_back(self.mark)
        for component in self.components:
            component.step_back(self.step)
        return True

    def repair(self, *, look: bool = False) -> None:
        """Repair Gaussians with non-finite values, if any were noticed.

        look: True to read first from the device how many elements `adam` refused.
        """
        if look or self.monitor.noticed:
            self.catch_up_exactly()
        if look:
            self.monitor.look()
        self._apply(self.monitor.examine(self.model.kinds()))

    def _apply(self, repair: Repair | None) -> None:
        if repair is None:
            return
        if repair.moments:
            self.model.change_moments(finite_or_zero)
        self._rearrange(RowPlan(repair.rows))

    def rates(self) -> dict[str, float]:
        """Learning rate of each parameter group at this step."""
        return rates_at(self.config, self.step, self.scene.length_unit, self.monitor.retries.rate_factor)

    def _next_view(self) -> int:
        if not self.position.queue:
            self.position.queue = self.order.next_pass(self.position.rng)
            if self.batch is None:  # in a batch, views of the last epoch have not added their contributions yet
                self._turn_epoch()
                self._note(begun=True)
        return self.position.queue.pop()

    def _turn_epoch(self) -> None:
        """Begin a pass through all views, with new totals of the contributions."""
        if self.statistics.whole_totals is not None:
            self.settle()
        self.mark = None
        self.model.statistics = self.statistics.next_epoch()

    def _raise_sh_degree(self) -> None:
        """Raise the SH degree in use when due, by adding coefficients of zero to the model. Bands above the degree in
        use have no arrays."""
        every = self.config.sh_degree_every
        degree = min(self.step // every, self.config.sh_degree) if every > 0 else self.config.sh_degree
        coefficients = (degree + 1) ** 2
        if coefficients > self.parameters.coefficients:
            self.settle()
            self.model.widen(coefficients, self._unmark)

    def _control_density(self) -> None:
        """Run density control for each view of the last step after which it is due."""
        last = range(self.step - self.position.last_views + 1, self.step + 1)
        steps = list(filter(self.strategy.is_due, last))
        for step in steps if self.step > 0 else ():
            self.repair(look=True)
            if step == steps[0]:
                self._note()
            self.catch_up()
            self._rearrange(self.strategy.before_step(self._state(step)))
        if steps:
            self.mark = None  # rows may have moved, and random numbers may have been drawn

    def _state(self, step: int | None = None) -> ModelState:
        model, statistics, step = self.parameters, self.statistics.named(), step or self.step
        sizes, arrays = (model.count, step, self.scene.length_unit, self.scene.extent), (model.arrays, statistics)
        return ModelState(*sizes, *arrays, self.position.rng, self.model.marker(), self.region)

    def _rearrange(self, plan: RowPlan | None) -> None:
        """Carry out a plan of density control, or of a repair, on the rows of all arrays."""
        if plan is None:
            return
        moved = self.model.rearrange(plan, self._unmark)
        if self.batch is not None:
            self.batch.changed()
        if moved is None:
            for component in self.components if plan.values or plan.changes else ():
                component.rows_changed({*plan.values, *plan.changes})
            return
        for component in self.components:
            component.rows_moved(moved)
        if type(self.strategy).rearranged is not Strategy.rearranged:
            entries = moved.get()
            self.strategy.rearranged(entries & ~FRESH, entries >= FRESH)

    def finish(self) -> None:
        """Finish the model: remove Gaussians that the strategy drops at the end, and those outside the region."""
        self.catch_up()
        self._rearrange(self.strategy.at_end(self._state()))
        self._rearrange(drop_outside(self.parameters["means"], self.region))

    def close(self) -> None:
        """End the threads of a batch and of reading photographs, and close the model's scratch file."""
        self.photographs.host.close()
        self.model.close()
        if self.batch is not None:
            self.batch.close()

    def local(self, camera: Camera) -> Camera:
        """Camera in the coordinates of the model, from a camera in world coordinates (see `Gaussians.local`)."""
        return camera.from_origin(self.origin).before(self.near).along_rays(self.by_rays)

    def gaussians(self) -> Gaussians:
        """Current model on the host, with all SH coefficients; those of degrees that are not in use yet are zeros."""
        return self._of_rows(self.complete_parameters, 0, self.parameters.count)

    def rows(self) -> Callable[[int, int], Gaussians]:
        """Function that returns the rows [start, stop) of the model that `gaussians` returns."""
        return partial(self._of_rows, self.complete_parameters)

    def _of_rows(self, parameters: AnyGaussians, start: int, stop: int) -> Gaussians:
        model = download_gaussians(parameters, start, stop)
        unused = (self.config.sh_degree + 1) ** 2 - model.sh.shape[1]
        model.sh, model.origin, model.near = np.pad(model.sh, ((0, 0), (0, unused), (0, 0))), self.origin, self.near
        model.antialiased, model.by_rays = self.config.antialiased, self.by_rays
        return model

    def checkpoint(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """All state that the remaining steps depend on: arrays by name, and JSON values. The whole model is finite,
        unless `monitor.retries.lost` is True."""
        self.repair(look=True)
        arrays, state = self._arrays()
        if not self.model.changes_are_finite():  # examine also Gaussians that no step has updated
            repair = self.monitor.examine_all(self.model.by_kind(arrays))
            if repair is not None:
                self._apply(repair)
                arrays, state = self._arrays()
        return arrays, self.position.state(self.monitor.retries) | region_state(self.begins_with.region) | state

    def _arrays(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        arrays, state = self.model.record()
        arrays.update({f"strategy/{name}": array for name, array in self.strategy.arrays().items()})
        for component in self.components:
            arrays |= component.arrays()
        return arrays, state

    def restart(self) -> None:
        """Start again from step 0, with the rate factor of `monitor.retries`."""
        self.pending.forget()
        self.model.free()
        self.monitor.forget()
        self._start()

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint. Raises InputError for a checkpoint of another training."""
        check_region(checkpoint, self.begins_with.region)
        with saved_model(checkpoint, self.config.sh_degree) as (models, saved):
            self.monitor.retries, self.mark = self.position.load(checkpoint, len(self.views)), None
            self.monitor.forget()
            self.pending.forget()
            self.model.load(models, saved)
            self.strategy.load(checkpoint.named("strategy/"))
            try:
                for component in self.components:
                    component.load(saved.named, self.step, self.parameters.count)
            except ValueError as error:
                raise unusable(checkpoint, str(error)) from None
