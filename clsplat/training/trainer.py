# SPDX-License-Identifier: Apache-2.0
"""The model in training: its step, and the state that a checkpoint contains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.masks import NO_MASKS
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import warn
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.optimisation.density_rules import FRESH
from clsplat.optimisation.step_noise import exploration_of
from clsplat.rendering.memory_needs import MODELS, StepMemory, plan_step
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import PairCapacity, Rasterizer
from clsplat.rendering.renderer import Renderer, RenderResult
from clsplat.runs.appearance import held_out_looks
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.scenes.start.initialise import from_scene
from clsplat.stages.density import DensityStatistics, gaussian_bytes
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostGaussians,
    download_gaussians,
    host_model,
)
from clsplat.stages.loss import Loss
from clsplat.training.appearance.choice import appearance_of
from clsplat.training.batch import OWNER_ARRAYS_PER_PARAMETER, REPLICA_ARRAYS_PER_PARAMETER, Batch, Losses
from clsplat.training.cameras.refinement import Cameras
from clsplat.training.cameras.validation import ValidationViews, validate
from clsplat.training.density import ModelState, RowPlan, Strategy
from clsplat.training.density.choice import strategy_of
from clsplat.training.host_memory import UNLIMITED, HostMemory
from clsplat.training.learning_rates import rates_at
from clsplat.training.mip_filter import MipFilter
from clsplat.training.stability.health import RetryBudget
from clsplat.training.stability.non_finite import NonFiniteMonitor, Repair
from clsplat.training.step.component import Component
from clsplat.training.step.gradient_step import GradientStep, StepMaker, StepProbe, slot_fields, view_gradients
from clsplat.training.step.inputs import ViewInputs
from clsplat.training.step.late_adam import ROW_BYTES, LateAdam
from clsplat.training.step.monitor import StepMonitor
from clsplat.training.step.speculative_steps import SpeculativeSteps
from clsplat.training.supervision.depth_targets import DepthTargets
from clsplat.training.supervision.host_photographs import reading_threads
from clsplat.training.supervision.image_cache import ImageCache
from clsplat.training.supervision.resolution import by_doubling
from clsplat.training.trained_model import TrainedModel

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


@dataclass(frozen=True)
class _Mark:
    """A point in the training at which a checkpoint is possible.

    step: number of steps done.
    rng: state of the random generator.
    queue: views that are left in the epoch.
    controlled: True if the density control before the next step has been done.
    """

    step: int
    rng: Mapping[str, Any]
    queue: list[int]
    controlled: bool


class Trainer:
    """A model in training: parameters, moments, statistics and the random state, which a checkpoint holds.

    step: number of views done.
    monitor: monitor of non-finite values in the model.
    pending: steps that have been launched but may have to be repeated.
    mark: state that `step_back` restores; None once the arrays no longer have that state.
    further: devices in addition to the model's.
    memory: limit of main memory, and the cache of photographs.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        device: Device,
        initial: Gaussians | None = None,
        strategy: Callable[[TrainConfig], Strategy] = strategy_of,
        further: Sequence[Device] = (),
        memory: HostMemory = UNLIMITED,
    ) -> None:
        self.scene, self.config, self.device, self._new_strategy = scene, config, device, strategy
        self.views = scene.require_training_views()
        self.rasterizer = Rasterizer(device, config.rasterizer, antialiased=config.antialiased)
        self.memory, self._begins, self._tight = memory, True, False
        self.photographs = ImageCache(device, memory.photographs(scene, config))
        self.renderer = Renderer(device, self.rasterizer)
        self.validation_views = ValidationViews(scene, device, config)
        self.depths = DepthTargets(config, self.views, scene.length_unit, scene.near, self._pixels)
        self.batch = Batch(self.rasterizer, self.photographs, config, further) if config.batch > 1 else None
        self.sizes = by_doubling(config.warmup)
        self.background: NDArray[np.float32] = np.array(background_colour(config.background), np.float32)
        self.given = initial
        self.monitor = NonFiniteMonitor(self.rasterizer.readback)
        self.pending = SpeculativeSteps(device, self.monitor, self._begin_again)
        self.pending.on &= self.batch is None and not config.refines  # batches read losses, refinement reads gradients
        self._start()

    def _start(self) -> None:
        """Set up the model and the state of step 0."""
        self._rng = np.random.default_rng(self.config.seed)
        self._rng_state: Mapping[str, Any] | None = None
        self.step = 0
        self.queue: list[int] = []
        self.controlled, self.last_views = False, 1
        self.mark: _Mark | None = None
        self.tried: set[tuple[object, ...]] = set()
        self.strategy = self._new_strategy(self.config)
        self._looks_at_steps = type(self.strategy).after_gradient is not Strategy.after_gradient
        initial = self.given
        if initial is None:
            initial = from_scene(self.scene, self.config.random_points, self.rng)
        self.appearance = appearance_of(self.config, self.device, self.scene)
        self.cameras = Cameras(self.config, self.scene, self.rasterizer.work)
        self.origin, self.near = initial.origin, self.scene.near
        asked = self.config.perspective
        self.by_rays = asked == "rays" or (asked == "auto" and any(view.camera.model.along_rays for view in self.views))
        self._cameras: dict[int, tuple[Camera, Camera]] = {}
        cameras = [self.local(view.camera) for view in self.views]
        mip_filter = MipFilter(self.config, self.device, self.rasterizer.work, cameras)
        self.components: tuple[Component, ...] = (mip_filter, self.appearance, self.cameras, self.depths)
        self._active = [component for component in self.components if component.on]
        contributions = self.strategy.needs().contributions
        self.model = TrainedModel(
            self.device, self.rasterizer.work, self._make_plan, counts_contributions=contributions
        )
        self.model.begin(initial)
        self.late = LateAdam(self.device, self.config.optimiser, len(initial)) if self.config.optimiser.late else None

    def _make_plan(self, count: int) -> Plan:
        """Plan the device's memory for `count` Gaussians with their final number of SH coefficients."""
        needs, batch = self.strategy.needs(), self.batch
        memory = StepMemory(
            fields=slot_fields(needs, nearness=bool(self.config.depth_use)),
            photographs=sum(view.camera.width * view.camera.height for view in self.views),
            turns=self.pending.turns,
            masks=self.config.mask_use != NO_MASKS,
            row_bytes=sum(component.row_bytes for component in self.components)
            + ROW_BYTES * self.config.optimiser.late,
            pixel_bytes=sum(component.pixel_bytes for component in self.components),
        )

        def plan(device: Device, models: int) -> Plan:
            return plan_step(
                device,
                count,
                (self.config.sh_degree + 1) ** 2,
                [view.camera for view in self.scene.views],
                self.config.rasterizer,
                memory,
                models=models,
            )

        models = max(component.models for component in self.components)
        made = plan(self.device, models or (MODELS if batch is None else OWNER_ARRAYS_PER_PARAMETER))
        self.rasterizer.follow(made)
        self.photographs.follow(made.photographs)
        on_host = self.device.shares_memory or made.streamed
        model = made.need.model + gaussian_bytes(contributions=needs.contributions)
        enough = self.memory.share(self.photographs.host, count, count * model if on_host else 0, begins=self._begins)
        if not enough and not self._tight:
            self._tight = True
            warn(
                f"--max-host-mem is exceeded from here on: {count:,} Gaussians leave too little of it for photographs; "
                "--density.max-gaussians limits the number of Gaussians"
            )
        if batch is not None:
            batch.follow([plan(replica.device, REPLICA_ARRAYS_PER_PARAMETER) for replica in batch.replicas])
        return made

    @property
    def rng(self) -> np.random.Generator:
        """Random generator of the training. Whoever asks for it may draw from it."""
        self._rng_state = None
        return self._rng

    @property
    def parameters(self) -> AnyGaussians:
        """Parameters of the model."""
        return self.model.parameters

    @property
    def first(self) -> AnyGaussians:
        """First moments of Adam."""
        return self.model.first

    @property
    def second(self) -> AnyGaussians:
        """Second moments of Adam."""
        return self.model.second

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
        self._begins = False
        if self.mark is None or self._looks_at_steps:
            self._note()
        if self.monitor.noticed:
            self.repair()
        if self.cameras.gate.on:
            self.validate()
        if not self.controlled:
            self._control_density()
            self.controlled = True
        if self.mark is None:
            self._note()
        views = self.views_ahead
        if self.late is not None and self.late.is_due(self.step):
            self.catch_up()
        self.step += views
        self._raise_sh_degree()
        if self._active:
            self._prepare_components(views)
        inputs, step, factor = self._inputs(views), self._gradient_step(), self.sizes.factor(self.step)
        if not self.photographs.host.has_all(factor):
            self.photographs.host.read_ahead(self._next_photographs())
        result: Loss | Losses
        if self.batch is None:
            run = partial(self._run, step, inputs[0], reads_loss)
            result = self.pending.launch(run, self._room(factor), reads_loss=reads_loss)
            if self.queue:  # upload the next step's photograph, at this resolution
                self.photographs.ahead(self.queue[-1], factor)
        else:
            gathers, model = self.strategy.needs(self.step).gradients, (self.parameters, self.first, self.second)
            result = self.batch.run(step(), model, inputs, factor, self._watched_in_batch, statistics=gathers)
            self._after_adam()
        self.controlled, self.last_views = False, views
        self._note()
        if self._looks_at_steps:
            self._rearrange(self.strategy.after_gradient(self._state()))
        return result

    def _next_photographs(self) -> list[tuple[int, float]]:
        """Views of the next steps and their size divisors, in the order of their use, until the end of the epoch."""
        batch, ahead = self.config.batch, self.queue[: -1 - reading_threads() - self.config.batch : -1]
        return [(view, self.sizes.factor(self.step + (1 + place // batch) * batch)) for place, view in enumerate(ahead)]

    def _prepare_components(self, views: int) -> None:
        """Let the components do the work that is due before a step of `views` views."""
        if due := [component for component in self._active if component.is_due(self.step, views)]:
            self.catch_up()
            for component in due:
                component.before_step(self.parameters)

    def _inputs(self, views: int) -> Sequence[ViewInputs]:
        """Inputs of the step's views, with the components' parts in them."""
        inputs: Sequence[ViewInputs] = [self._view_inputs(place) for place in range(views)]
        for component in self._active:
            inputs = component.join(inputs, self.step, self.parameters.count)
        return inputs

    def _gradient_step(self) -> StepMaker:
        """Maker of the step; without `turn` and `room` it has an exact count of pairs."""
        rates, count, unit = self.rates(), self.parameters.count, self.scene.length_unit
        fields = slot_fields(self.strategy.needs(self.step), nearness=self.depths.on)
        explore = exploration_of(self.config, self.step, rates["means"], count, unit)
        of = (self.device, self.rasterizer, self.config, self.step, rates, fields)
        return partial(GradientStep, *of, explore=explore, late=self.late)

    def _run(self, make: StepMaker, inputs: ViewInputs, reads_loss: bool, turn: int, room: PairCapacity | None) -> Loss:
        """Make a step of one view."""
        step = make(turn=turn, room=room)
        of = self.model
        model, probe = (of.parameters, of.first, of.second), self._watched(inputs, step, step.step)
        result = step.run(model, inputs, probe, self._view_gradients(inputs), reads_loss=reads_loss)
        self._after_adam()
        return result

    def _room(self, factor: float) -> int:
        """Capacity, in pairs, with which the next step is launched.

        0 if the pairs have to be counted first, for example if the strategy inspects the model after each step.
        """
        if not self.pending.on or self._looks_at_steps or not self.rasterizer.takes_room:
            return 0
        return self.pending.room(self.rasterizer, (factor, self.rasterizer), self.parameters.count)

    def _begin_again(self) -> None:
        """Prepare for repeating a step. This invalidates `mark`."""
        self.mark = None
        self.repair()

    def settle(self) -> None:
        """Wait for all launched steps, and repeat the incomplete ones (`SpeculativeSteps`)."""
        self.pending.settle()

    def catch_up(self) -> None:
        """Let all Gaussians take the steps that they missed (`LateAdam`), after all launched steps are done."""
        self.settle()
        if self.late is not None:
            self.late.settle(self.rasterizer.work, tuple(self.models().values()), self.rasterizer.readback)

    @property
    def complete_parameters(self) -> AnyGaussians:
        """Parameters with all steps that Gaussians missed (`LateAdam`): a copy, so that looking changes no bit."""
        self.settle()
        return self.parameters if self.late is None else self.late.settled(tuple(self.models().values()))

    def _pixels(self, view: int) -> NDArray[Any]:
        """Photograph of a view at the step's size, on the host."""
        return self.photographs.load(view, self.sizes.factor(self.step))

    def _view_inputs(self, place: int) -> ViewInputs:
        """Inputs of the next view. Without a batch its photograph is on the device."""
        begins, view, factor = not self.queue, self._next_view(), self.sizes.factor(self.step)
        bring = self.photographs.bring if self.batch is None else self.photographs.load
        image = bring(view, factor)
        if self.config.random_background:
            self.background = self.rng.random(3, dtype=np.float32)
        height, width = image.shape[:2]
        full = self.views[view].camera
        return ViewInputs(
            view,
            image,
            self.camera(view, width, height),
            self.background,
            begins,
            self.photographs.kept(view, factor),
            area=full.width * full.height / (width * height),
            place=place,
            name=self.views[view].name,
        )

    def _view_gradients(self, inputs: ViewInputs) -> DeviceGaussians | None:
        """Arrays for the rows' gradients; None if no component reads them."""
        if not inputs.parts or not any(part.wants_gradients for part in inputs.parts):
            return None
        return view_gradients(self.rasterizer.work, self.parameters, zero=True)

    def _after_adam(self) -> None:
        for component in self._active:
            component.after_adam(self.parameters)

    def _watched(self, inputs: ViewInputs, step: GradientStep, number: int) -> StepMonitor:
        """Probe of a view."""
        needs = self.strategy.needs(number)
        return StepMonitor(
            step, number, inputs, needs, self.statistics, self.monitor, self.pending, self.tried, self._unmark
        )

    def _unmark(self) -> None:
        self.mark = None

    def _watched_in_batch(self, inputs: ViewInputs, step: GradientStep) -> StepProbe:
        """Probe of a view in a batch. It may begin an epoch, so the statistics of earlier views must be complete."""
        if inputs.begins:
            self._turn_epoch()
        return self._watched(inputs, step, self.step)

    def draw(self, camera: Camera) -> RenderResult:
        """Render the current model with a camera in world coordinates, over the background of evaluations."""
        background = background_colour(self.config.background)
        return self.renderer.render(self.complete_parameters, self.local(camera), background)

    def validate(self) -> bool:
        """Validate the refined cameras, if that is due. Returns True if they were measured."""
        if not self.cameras.gate.is_due(self.step):
            return False
        self.settle()
        look = held_out_looks(self.appearance.record())
        validate(self.cameras, self.validation_views, self.step, lambda camera: self.draw(camera).image, look)
        return True

    def _note(self, *, begun: bool = False) -> None:
        """Mark the current state. Until it changes, `step_back` returns to it.

        begun: True if the step number has already been increased for the current step, which has one view.
        """
        state = self._rng_state = self._rng_state or self._rng.bit_generator.state
        self.mark = _Mark(self.step - begun, state, list(self.queue), self.controlled)

    def step_back(self) -> bool:
        """After an error, return to the last point at which a checkpoint was possible.

        That point is before the current step, or after the step's density control if that is done. Returns False if the
        state there is lost.
        """
        mark = self.mark
        if mark is None:
            return False
        self.step, self.queue, self.controlled = mark.step, list(mark.queue), mark.controlled
        self.rng.bit_generator.state = mark.rng
        return True

    def repair(self, *, look: bool = False) -> None:
        """Repair Gaussians with non-finite values, if any were noticed.

        look: True to read `adam`'s counts first.
        """
        if look:
            self.settle()
            self.monitor.look()
        self._apply(self.monitor.examine(self.models()))

    def models(self) -> dict[str, AnyGaussians]:
        """Parameters, first and second moments, by their names in a checkpoint."""
        return self.model.kinds()

    def _apply(self, repair: Repair | None) -> None:
        if repair is None:
            return
        for kind, groups in repair.moments.items():
            for group, values in groups.items():
                self.models()[kind][group].set(values)
        self._rearrange(RowPlan(repair.rows))

    def rates(self) -> dict[str, float]:
        """Learning rate of each group at this step."""
        return rates_at(self.config, self.step, self.scene.length_unit, self.monitor.retries.rate_factor)

    def _next_view(self) -> int:
        if not self.queue:
            self.queue = [int(index) for index in self.rng.permutation(len(self.views))]
            if self.batch is None:  # a batch may still have to count views of the last epoch
                self._turn_epoch()
                self._note(begun=True)
        return self.queue.pop()

    def _turn_epoch(self) -> None:
        """Begin a pass through all views."""
        if self.statistics.whole_totals is not None:
            self.settle()
        self.mark = None
        self.model.statistics = self.statistics.next_epoch()

    def _raise_sh_degree(self) -> None:
        """Raise the SH degree in use. Higher bands have no arrays yet: their gradients, and so their steps, would be
        zero."""
        every = self.config.sh_degree_every
        degree = min(self.step // every, self.config.sh_degree) if every > 0 else self.config.sh_degree
        coefficients = (degree + 1) ** 2
        if coefficients > self.parameters.coefficients:
            self.settle()
            self.model.widen(coefficients)

    def _control_density(self) -> None:
        """Run the density control that is due after one of the last step's views."""
        steps = [step for step in range(self.step - self.last_views + 1, self.step + 1) if self.strategy.is_due(step)]
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
        lengths = self.scene.length_unit, self.scene.extent
        return ModelState(model.count, step, *lengths, model.arrays, statistics, self.rng, self.model.marker())

    def _rearrange(self, plan: RowPlan | None) -> None:
        """Carry out a plan of density control, or of a repair, for the rows of all arrays."""
        if plan is None:
            return
        moved = self.model.rearrange(plan, self._unmark)
        if self.batch is not None:
            self.batch.changed()
        if moved is None:
            return
        if self.late is not None:
            self.late.moved(moved.get())
        for component in self.components:
            component.rows_moved()
        if type(self.strategy).rearranged is not Strategy.rearranged:
            entries = moved.get()
            self.strategy.rearranged(entries & ~FRESH, entries >= FRESH)

    def finish(self) -> None:
        """Remove Gaussians that a finished model does not need."""
        self.catch_up()
        self._rearrange(self.strategy.at_end(self._state()))

    def close(self) -> None:
        """End the threads of a batch, and those that read photographs."""
        self.photographs.host.close()
        if self.batch is not None:
            self.batch.close()

    def local(self, camera: Camera) -> Camera:
        """Camera in the coordinates of the model in training, from a camera in the world: see `Gaussians.local`."""
        return camera.from_origin(self.origin).before(self.near).along_rays(self.by_rays)

    def camera(self, view: int, width: int, height: int) -> Camera:
        """Camera of a training view at the size of its photograph.

        It returns the same object while the size and the refined camera stay the same.
        """
        (of, camera), now = self._cameras.get(view, (None, None)), self.cameras.of(view)
        if camera is None or of is not now or (camera.width, camera.height) != (width, height):
            camera = self.local(now.resized(width, height))
            self._cameras[view] = now, camera
        return camera

    def gaussians(self) -> Gaussians:
        """Model so far, on the host, with room for its final SH degree."""
        model = download_gaussians(self.complete_parameters)
        full = np.zeros((len(model), (self.config.sh_degree + 1) ** 2, 3), np.float32)
        full[:, : model.sh.shape[1]] = model.sh
        model.sh, model.origin, model.near = full, self.origin, self.near
        model.antialiased, model.by_rays = self.config.antialiased, self.by_rays
        return model

    def checkpoint(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """All state that the remaining steps depend on: arrays and JSON state.

        The whole model is finite, unless `monitor.retries.lost`.
        """
        self.repair(look=True)
        arrays = self._arrays()
        if (
            repair := self.monitor.examine_all(arrays)
        ) is not None:  # finds non-finite values in Gaussians that no step has visited
            self._apply(repair)
            arrays = self._arrays()
        state = {"rng": self.rng.bit_generator.state, "queue": self.queue, "patience": asdict(self.monitor.retries)}
        views = {"views": self.last_views} if self.last_views > 1 else {}
        return arrays, {**state, **views, **({"controlled": True} if self.controlled else {})}

    def _arrays(self) -> dict[str, NDArray[Any]]:
        arrays = {f"statistics/{name}": array.get() for name, array in self.statistics.named().items()}
        arrays.update({f"strategy/{name}": array for name, array in self.strategy.arrays().items()})
        arrays |= self.model.arrays()
        arrays |= {} if self.late is None else self.late.arrays()
        for component in self.components:
            arrays |= component.arrays()
        return arrays

    def restart(self) -> None:
        """Start again from step 0, with the rate factor of `monitor.retries`."""
        self.pending.forget()
        self.model.free()
        self.monitor.forget()
        self._start()

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint."""
        loaded = [self._loaded(checkpoint, kind) for kind in ("parameters", "first", "second")]
        self.step = checkpoint.step
        try:
            self.rng.bit_generator.state = checkpoint.state["rng"]
            queue = list(checkpoint.state["queue"])
            if not all(type(index) is int and index >= 0 for index in queue):
                raise ValueError(f"the queue of views begins with {queue[:3]}")
            retries = RetryBudget(**checkpoint.state.get("patience", {}))
            last_views = checkpoint.state.get("views", 1)
            if type(last_views) is not int or not 1 <= last_views <= max(checkpoint.step, 1):
                raise ValueError(f"the last step had {last_views!r:.20} views")
        except (KeyError, TypeError, ValueError, IndexError) as error:
            why = f"{type(error).__name__}: {error}"
            raise unusable(checkpoint, f"its state is not as this version writes it ({why})") from None
        self.queue = queue if max(queue, default=0) < len(self.views) else []  # the scene had more views before
        self.controlled, self.mark = bool(checkpoint.state.get("controlled", False)), None
        self.last_views = last_views
        self.monitor.retries = retries
        self.monitor.forget()
        self.pending.forget()
        self.model.free()
        self.model.load(loaded)
        statistics = checkpoint.named("statistics/")
        for name, array in self.statistics.named().items():
            if name in statistics and (statistics[name].shape, statistics[name].dtype) != (array.shape, array.dtype):
                raise unusable(checkpoint, f"statistics/{name} has shape {statistics[name].shape}")
        self.statistics.load(statistics)  # statistics that the settings did not need before the checkpoint stay unknown
        self.strategy.load(checkpoint.named("strategy/"))
        try:
            for component in self.components:
                component.load(checkpoint.named, self.parameters.count)
            if self.late is not None:
                self.late.load(checkpoint.named, self.step, self.parameters.count)
        except ValueError as error:
            raise unusable(checkpoint, str(error)) from None

    def _loaded(self, checkpoint: Checkpoint, kind: str) -> HostGaussians:
        most, degree = (self.config.sh_degree + 1) ** 2, self.config.sh_degree
        try:
            model = host_model(checkpoint.arrays, kind)
            if (n := model.coefficients) > most:
                raise ValueError(f"has {n} SH coefficients, more than the {most} of --sh-degree {degree}")
        except ValueError as error:
            raise unusable(checkpoint, str(error)) from None
        return model
