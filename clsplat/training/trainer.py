# SPDX-License-Identifier: Apache-2.0
"""The model in training: the step on one screen, and the state that a checkpoint holds."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.marking import FRESH
from clsplat.config.masks import NO_MASKS
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.gaussians import GROUPS, Gaussians
from clsplat.images.alpha import background_colour
from clsplat.rendering.memory_needs import plan_step
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer, Room
from clsplat.runs.checkpoints import Checkpoint, unusable
from clsplat.scenes.initialise import from_scene
from clsplat.stages.density import (
    Marker,
    RowList,
    carry,
    gather,
    list_rows,
    new_statistics,
    try_gather,
    widen,
)
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    HostGaussians,
    allocate_gaussians,
    download_gaussians,
    host_gaussians,
    host_model,
    host_zeros,
    to_device,
    to_host,
    upload_gaussians,
)
from clsplat.stages.loss import Loss
from clsplat.training import depth, edges
from clsplat.training.appearance import appearance_of
from clsplat.training.batch import OWNER_MODELS, REPLICA_MODELS, Batch, Losses
from clsplat.training.cameras import MODELS, Cameras
from clsplat.training.density import ModelState, RowPlan, Strategy
from clsplat.training.density.choice import strategy_of
from clsplat.training.health import Patience
from clsplat.training.judging import Judges, judge
from clsplat.training.monitor import Remedy, Watch
from clsplat.training.pending import Pending
from clsplat.training.photographs import Photographs
from clsplat.training.rates import rates_at
from clsplat.training.resolution import sizes_of
from clsplat.training.sampling import SamplingFilter
from clsplat.training.step import GradientStep, Sample, StepProbe, slot_fields, view_gradients
from clsplat.training.watched import Watched

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


@dataclass(frozen=True)
class _Mark:
    """A place in the work that a checkpoint can be taken of: steps done, the random generator's state, the views that
    are left, and whether the next step's density control is done."""

    step: int
    rng: Mapping[str, Any]
    queue: list[int]
    controlled: bool


class Trainer:
    """A model in training: parameters, moments, statistics and the random state, all of which a checkpoint holds.

    step: views done; watch: what is not finite in the model, and how much of that there was; pending: the steps that
    are launched and not yet known to have been made; mark: where `step_back` leads, None from where the state changes
    on; further: devices beside the one that has the model.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        device: Device,
        initial: Gaussians | None = None,
        strategy: Callable[[TrainConfig], Strategy] = strategy_of,
        further: Sequence[Device] = (),
    ) -> None:
        self.scene, self.config, self.device, self._new_strategy = scene, config, device, strategy
        self.views = scene.require_training_views()
        self.rasterizer = Rasterizer(device, config.rasterizer)
        self.rasterizer.antialias(on=config.antialiased)
        self.photographs = Photographs(self.views, device)
        self.judges = Judges(scene, device)
        self.depths = depth.Depths(config, self.views, scene.extent, scene.near)
        self.batch = Batch(self.rasterizer, self.photographs, config, further) if config.batch > 1 else None
        self.sizes = sizes_of(
            config.warmup, config.frequency_steps, len(self.views), lambda index: self.views[index].load()
        )
        self.background: NDArray[np.float32] = np.zeros(3, np.float32)
        self.given = initial
        self.watch = Watch(self.rasterizer.readback, [view.name for view in self.views])
        self.pending = Pending(device, self.watch, self._begin_again)
        self.pending.on &= self.batch is None and not config.refines  # a batch reads its losses; cameras, gradients
        self._start()

    def _start(self) -> None:
        """Set up the model and the state of step 0."""
        self.rng = np.random.default_rng(self.config.seed)
        self.step = 0
        self.queue: list[int] = []
        self.controlled, self.last_views = False, 1
        self.mark: _Mark | None = None
        self.rehearsed: set[tuple[object, ...]] = set()
        self.strategy = self._new_strategy(self.config)
        self._looks_at_steps = type(self.strategy).after_gradient is not Strategy.after_gradient
        initial = self.given
        if initial is None:
            initial = from_scene(self.scene, self.config.random_points, self.rng)
        self.appearance = appearance_of(self.config, self.device, self.scene)
        self.cameras = Cameras(self.config, self.views, self.scene.extent, len(self.judges.views))
        self.origin, self.near = initial.origin, self.scene.near
        asked = self.config.perspective
        self.by_rays = asked == "rays" or (asked == "auto" and any(view.camera.kind.rays for view in self.views))
        self._cameras: dict[int, tuple[Camera, Camera]] = {}
        cameras = [self.local(view.camera) for view in self.views]
        self.sampling = SamplingFilter(self.config, self.device, self.rasterizer.work, cameras)
        self._make_plan(len(initial))
        if self.plan.streamed:
            self._set_parameters(host_gaussians(copy.deepcopy(initial), self.plan.rows))
        else:
            self._set_parameters(upload_gaussians(self.device, initial))

    def _make_plan(self, count: int) -> None:
        """Plan the device's memory for `count` Gaussians with all the SH coefficients that they will have."""
        needs, batch = self.strategy.needs(), self.batch

        def plan(device: Device, **models: int) -> Plan:
            return plan_step(
                device,
                count,
                (self.config.sh_degree + 1) ** 2,
                [view.camera for view in self.scene.views],
                self.config.rasterizer,
                fields=slot_fields(needs, nearness=bool(self.config.depth_use)),
                agreement=needs.agreement,
                photographs=sum(view.camera.width * view.camera.height for view in self.views),
                turns=self.pending.turns,
                antialiased=self.config.antialiased,
                masks=self.config.mask_use != NO_MASKS,
                lens=self.config.refine_lenses,
                further=self.appearance.pixel_bytes + sum(part.pixel_bytes(self.config) for part in (depth, edges)),
                **models,
            )

        models = MODELS if self.config.refines else 0 if batch is None else OWNER_MODELS
        self.plan = plan(self.device, models=models) if models else plan(self.device)
        self.rasterizer.follow(self.plan)
        self.photographs.follow(self.plan.photographs)
        if batch is not None:
            batch.follow([plan(replica.device, models=REPLICA_MODELS) for replica in batch.replicas])

    def _set_parameters(
        self, parameters: AnyGaussians, first: AnyGaussians | None = None, second: AnyGaussians | None = None
    ) -> None:
        """The model, on the device or streamed from the host; without moments they start from zero."""
        count, coefficients = parameters.count, parameters.coefficients
        self.parameters = parameters
        self.first = first or self._zeros(count, coefficients)
        self.second = second or self._zeros(count, coefficients)
        needs = self.strategy.needs()
        self.statistics = new_statistics(
            self.device, count, agreement=needs.agreement, contributions=needs.contributions
        )

    def _zeros(self, count: int, coefficients: int) -> AnyGaussians:
        if isinstance(self.parameters, HostGaussians):
            return host_zeros(count, coefficients, self.parameters.rows)
        return allocate_gaussians(self.device, count, coefficients, zero=True)

    def _take_down(self) -> list[HostGaussians]:
        """Parameters, first and second moments on the host, and none of them on the device."""
        models = [to_host(model) for model in self.models().values()]
        del self.parameters, self.first, self.second
        return models

    def _placed(self, model: AnyGaussians) -> AnyGaussians:
        """The model where the plan wants it, if it is not there."""
        if isinstance(model, HostGaussians):
            return replace(model, rows=self.plan.rows) if self.plan.streamed else to_device(self.device, model)
        return model

    @property
    def views_ahead(self) -> int:
        """Views of the next step."""
        return max(min(self.config.batch, self.config.iterations - self.step), 1)

    def train_step(self, *, reads_loss: bool = False) -> Loss | Losses:
        """Density control as the last step left it to do, then one view, or a batch of them: forward, loss, backward,
        Adam. reads_loss: the loss will be read, which then waits for no more than the loss.

        Kerbl et al. 2023, algorithm 1, but for where the loop is cut: a model is looked at, kept or finished before
        its Gaussians are split or made transparent, not just after.
        """
        if self.mark is None or self._looks_at_steps:
            self._note()
        self.mend()
        judge(self)
        if not self.controlled:
            self._control_density()
            self.controlled = True
        if self.mark is None:
            self._note()
        views = self.views_ahead
        self.step += views
        self._raise_sh_degree()
        if self.sampling.is_due(self.step, views):
            self.settle()
            self.sampling.renew(self.parameters)  # to no other effect if done again
        samples = [self._sample() for _ in range(views)]
        needs = self.strategy.needs(self.step)
        rates, count = self.rates(), self.parameters.count
        explore = self.strategy.exploration(self.step, rates["means"], count, self.scene.extent)
        fields = slot_fields(needs, nearness=bool(self.config.depth_use))
        settings = (self.device, self.rasterizer, self.config, self.step, rates, fields)
        factor, number = self.sizes.factor(self.step), self.step
        appearances = self.appearance.of_views([sample.view for sample in samples], self.step)

        def run(turn: int, room: Room | None) -> Loss:
            sample = samples[0]
            appearance = next(iter(appearances), None)
            seen = self.cameras.sums(self.rasterizer.work, self.parameters.count, sample.view, number)
            with_view: dict[str, Any] = {"explore": explore, "appearance": appearance, "seen": seen}
            step = GradientStep(*settings, turn=turn, room=room, **with_view)
            known = sample.known
            if seen is not None:
                known["gradients"] = view_gradients(self.rasterizer.work, self.parameters, zero=True)
            probe, model = Watched(self, step, number, sample, needs), (self.parameters, self.first, self.second)
            pixels = (sample.photograph, sample.camera, sample.background)
            result = step.run(model, *pixels, probe, reads_loss=reads_loss, **known)
            if seen is not None:
                self.cameras.move(sample, number, seen)
            self.sampling.apply(self.parameters)
            return result

        result: Loss | Losses
        if self.batch is None:
            result = self.pending.launch(run, self._room(factor), reads_loss=reads_loss)
            if self.queue:  # the next one, unless the resolution rises
                self.photographs.ahead(self.queue[-1], factor)
        else:
            model, look = (self.parameters, self.first, self.second), self._watched_in_batch
            exact = GradientStep(*settings, explore=explore)
            result = self.batch.run(exact, model, samples, factor, look, appearances, statistics=needs.gradients)
            self.sampling.apply(self.parameters)
        self.controlled, self.last_views = False, views
        self._note()
        if self._looks_at_steps:
            self._rearrange(self.strategy.after_gradient(self._state()))
        return result

    def _room(self, factor: float) -> int:
        """Pairs to launch the next step for, or 0 for the exact number, as where the strategy looks at each step's
        model."""
        if not self.pending.on or self._looks_at_steps or not self.rasterizer.takes_room:
            return 0
        return self.pending.room(self.rasterizer, (factor, self.rasterizer), self.parameters.count)

    def _begin_again(self) -> None:
        """Preparation for a step that is made again: there is no way back from here."""
        self.mark = None
        self.mend()

    def settle(self) -> None:
        """Wait until all steps are known to have been made, or make them again (`Pending`)."""
        self.pending.settle()

    def _sample(self) -> Sample:
        """The next view, its photograph on the device where it is one a step."""
        begins, view, factor = not self.queue, self._next_view(), self.sizes.factor(self.step)
        bring = self.photographs.bring if self.batch is None else self.photographs.load
        image = bring(view, factor)
        self.background = self._background_colour()
        camera, kept = self.camera(view, image.shape[1], image.shape[0]), self.photographs.kept(view, factor)
        aims = self.depths.aims(view, camera, self.step, self.photographs.load(view, factor))
        return Sample(view, image, camera, self.background, begins, kept, aims)

    def _watched_in_batch(self, sample: Sample, step: GradientStep) -> StepProbe:
        """The probe of a view, when the statistics of those before it are complete."""
        if sample.begins:
            self._turn_epoch()
        return Watched(self, step, self.step, sample, self.strategy.needs(self.step))

    def _note(self, *, begun: bool = False) -> None:
        """Mark the state as it is now: until something of it is changed, `step_back` leads here. begun: the step's
        number has risen, by the one view that it has."""
        self.mark = _Mark(self.step - begun, self.rng.bit_generator.state, list(self.queue), self.controlled)

    def step_back(self) -> bool:
        """After an error within a step, make the state that of its beginning, or of after its density control. False
        if that cannot be."""
        mark = self.mark
        if mark is None:
            return False
        self.step, self.queue, self.controlled = mark.step, list(mark.queue), mark.controlled
        self.rng.bit_generator.state = mark.rng
        return True

    def mend(self, *, look: bool = False) -> None:
        """Mend the Gaussians in which something was not finite, if that has been noticed; look: read the counts
        first."""
        if look:
            self.settle()
            self.watch.look()
        self._apply(self.watch.examine(self.models()))

    def models(self) -> dict[str, AnyGaussians]:
        """Parameters, first and second moments, by the names that they have in a checkpoint."""
        return {"parameters": self.parameters, "first": self.first, "second": self.second}

    def _apply(self, remedy: Remedy | None) -> None:
        if remedy is None:
            return
        for kind, groups in remedy.moments.items():
            for group, values in groups.items():
                self.models()[kind][group].set(values)
        self._rearrange(RowPlan(remedy.rows))

    def rates(self) -> dict[str, float]:
        """Learning rate of each group at this step."""
        return rates_at(self.config, self.step, self.scene.extent, self.watch.patience.rate_factor)

    def _next_view(self) -> int:
        if not self.queue:
            self.queue = [int(index) for index in self.rng.permutation(len(self.views))]
            if self.batch is None:  # a batch may have views of the epoch before to count
                self._turn_epoch()
                self._note(begun=True)
        return self.queue.pop()

    def _turn_epoch(self) -> None:
        """A pass through all views begins."""
        if self.statistics.whole_totals is not None:
            self.settle()
        self.mark = None
        self.statistics = self.statistics.next_epoch()

    def _background_colour(self) -> NDArray[np.float32]:
        if self.config.random_background:
            return self.rng.random(3, dtype=np.float32)
        return np.array(background_colour(self.config.background), np.float32)

    def _raise_sh_degree(self) -> None:
        """Bands that are not in use yet have no place in memory: their gradient, and so their step, would be zero."""
        every = self.config.sh_degree_every
        degree = min(self.step // every, self.config.sh_degree) if every > 0 else self.config.sh_degree
        coefficients = (degree + 1) ** 2
        if coefficients > self.parameters.coefficients:
            self.settle()
            models = [*self.models().values()] if self.plan.gathers else self._take_down()
            wider = (self._placed(widen(self.device, model, coefficients)) for model in models)
            self.parameters, self.first, self.second = wider

    def _control_density(self) -> None:
        """Do what is due after any of the last step's views."""
        steps = [step for step in range(self.step - self.last_views + 1, self.step + 1) if self.strategy.is_due(step)]
        for step in steps if self.step > 0 else ():
            self.mend(look=True)
            if step == steps[0]:
                self._note()
            self._rearrange(self.strategy.before_step(self._state(step)))
        if steps:
            self.mark = None  # of what a strategy has drawn, too

    def _state(self, step: int | None = None) -> ModelState:
        model, statistics = self.parameters, self.statistics.named()
        marker, step = Marker(self.device, self.rasterizer.work, model, self.statistics), step or self.step
        edge_sums, extent = partial(edges.edge_contributions, self), self.scene.extent
        return ModelState(model.count, step, extent, model.arrays, statistics, self.rng, marker, edge_sums)

    def _rearrange(self, plan: RowPlan | None) -> None:
        """Carry out what density control, or a repair, has planned for the rows of everything."""
        if plan is None:
            return
        listed = plan.listed
        if plan.rows is not None:
            listed = list_rows(self.device, plan.rows, plan.fresh)
        if listed is not None:
            assert isinstance(listed, RowList)
            self._move(listed.rows, new_statistics=plan.new_statistics)
            if listed.halves and plan.halves is not None:
                self._halve(listed, plan.halves, plan.halved)
        self.mark = None
        if self.batch is not None:
            self.batch.changed()
        for group, (rows, values) in plan.values.items():
            changed = self.parameters[group].get()
            changed[rows] = values
            self.parameters[group].set(changed)
        for group, change in plan.changes.items():
            self.parameters[group].set(change(self.parameters[group].get()))
        for group in plan.restarted:
            self.first[group].fill(0.0)
            self.second[group].fill(0.0)
        if plan.forget_contributions:
            self.statistics.forget_contributions()

    def finish(self) -> None:
        """Take away what a finished model has no use for."""
        self.settle()
        self._rearrange(self.strategy.at_end(self._state()))

    def _halve(
        self, listed: RowList, halves: Callable[[Mapping[str, Float32]], Mapping[str, Float32]], halved: Sequence[str]
    ) -> None:
        """Make the last rows, copies yet of what is split, the halves of that, by its groups `halved`."""
        count, half = listed.count, listed.halves // 2
        split = {group: self.parameters[group].get_rows(count - half, count) for group in halved}
        for group, values in halves(split).items():
            self.parameters[group].set_rows(count - listed.halves, values)

    def _move(self, listed: DeviceArray, *, new_statistics: bool) -> None:
        """Make row j of everything what row listed[j] was, with moments of zero where it is FRESH."""
        device, gathers = self.device, self.plan.gathers
        with only_tried(device):
            try_gather(device, listed.shape[0], self.parameters)
        self.mark = None
        self._make_plan(listed.shape[0])
        rows: DeviceArray | NDArray[np.uint32] = listed
        models = [*self.models().values()]
        if not (gathers and self.plan.gathers):
            del models
            models, rows = [*self._take_down()], listed.get()
        statistics = self.statistics
        moved = [gather(device, rows, model, renews=index > 0) for index, model in enumerate(models)]
        del models
        self._set_parameters(*(self._placed(model) for model in moved))
        self.sampling.forget()
        carry(device, listed, statistics, self.statistics, densified=new_statistics)
        if type(self.strategy).rearranged is not Strategy.rearranged:
            entries = listed.get()
            self.strategy.rearranged(entries & ~FRESH, entries >= FRESH)

    def close(self) -> None:
        """End what works beside this thread."""
        if self.batch is not None:
            self.batch.close()

    def local(self, camera: Camera) -> Camera:
        """A camera in the world as one for the model in training: see `Gaussians.local`."""
        return camera.from_origin(self.origin).before(self.near).along_rays(self.by_rays)

    def camera(self, view: int, width: int, height: int) -> Camera:
        """A training view's camera at the size of its photograph, the same object while that stays and nothing of it
        is refined."""
        (of, camera), now = self._cameras.get(view, (None, None)), self.cameras.of(view)
        if camera is None or of is not now or (camera.width, camera.height) != (width, height):
            camera = self.local(now.resized(width, height))
            self._cameras[view] = now, camera
        return camera

    def gaussians(self) -> Gaussians:
        """The model so far, on the host, with room for the SH degree it is trained to."""
        self.settle()
        model = download_gaussians(self.parameters)
        full = np.zeros((len(model), (self.config.sh_degree + 1) ** 2, 3), np.float32)
        full[:, : model.sh.shape[1]] = model.sh
        model.sh, model.origin, model.near = full, self.origin, self.near
        model.antialiased, model.by_rays = self.config.antialiased, self.by_rays
        return model

    def checkpoint(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Everything that the steps to come depend on: arrays and JSON state. All of the model is finite, unless
        `watch.patience.lost`."""
        self.mend(look=True)
        arrays = self._arrays()
        if (remedy := self.watch.examine_all(arrays)) is not None:  # hidden Gaussians, which no step has come by
            self._apply(remedy)
            arrays = self._arrays()
        state = {"rng": self.rng.bit_generator.state, "queue": self.queue, "patience": asdict(self.watch.patience)}
        views = {"views": self.last_views} if self.last_views > 1 else {}
        return arrays, {**state, **views, **({"controlled": True} if self.controlled else {})}

    def _arrays(self) -> dict[str, NDArray[Any]]:
        arrays = {f"statistics/{name}": array.get() for name, array in self.statistics.named().items()}
        arrays.update({f"strategy/{name}": array for name, array in self.strategy.arrays().items()})
        arrays |= {f"{kind}/{group}": model[group].get() for kind, model in self.models().items() for group in GROUPS}
        return arrays | self.sampling.arrays() | self.appearance.arrays() | self.cameras.arrays()

    def restart(self) -> None:
        """Begin again, at the rates that `watch.patience` allows."""
        self.pending.forget()
        del self.parameters, self.first, self.second, self.statistics
        self.watch.forget()
        self._start()

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint."""
        loaded = [self._loaded(checkpoint, kind) for kind in ("parameters", "first", "second")]
        self.step = checkpoint.step
        try:
            self.rng.bit_generator.state = checkpoint.state["rng"]
            queue = list(checkpoint.state["queue"])
            if not all(type(index) is int and index >= 0 for index in queue):
                raise ValueError(f"a queue of {queue[:3]}")
            patience = Patience(**checkpoint.state.get("patience", {}))
            last_views = checkpoint.state.get("views", 1)
            if type(last_views) is not int or not 1 <= last_views <= max(checkpoint.step, 1):
                raise ValueError(f"a step of {last_views!r:.20} views")
        except (KeyError, TypeError, ValueError, IndexError) as error:
            why = f"{type(error).__name__}: {error}"
            raise unusable(checkpoint, f"its state is not as this version writes it ({why})") from None
        self.queue = queue if max(queue, default=0) < len(self.views) else []  # of a scene that had more of them
        self.controlled, self.mark = bool(checkpoint.state.get("controlled", False)), None
        self.last_views = last_views
        self.watch.patience = patience
        self.watch.forget()
        self.pending.forget()
        del self.parameters, self.first, self.second, self.statistics
        self._make_plan(loaded[0].count)
        self._set_parameters(*(self._placed(model) for model in loaded))
        statistics = checkpoint.named("statistics/")
        for name, array in self.statistics.named().items():
            if name in statistics and (statistics[name].shape, statistics[name].dtype) != (array.shape, array.dtype):
                raise unusable(checkpoint, f"statistics/{name} has shape {statistics[name].shape}")
        self.statistics.load(statistics)  # what the settings did not ask for before the checkpoint is not known
        self.strategy.load(checkpoint.named("strategy/"))
        try:
            self.sampling.load(checkpoint.named("sampling/"), self.parameters.count)
            self.appearance.load(checkpoint.named("appearance/"))
            self.cameras.load(*(checkpoint.named(f"{part}/") for part in ("poses", "lenses", "gate")))
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
