# SPDX-License-Identifier: Apache-2.0
"""The model in training: the step on one screen, and the state that a checkpoint holds."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import allocate
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.device.layout import SlotFields
from clsplat.errors import ClsplatError, InputError
from clsplat.gaussians import GROUPS, Gaussians, group_shapes
from clsplat.images.alpha import background_colour
from clsplat.rendering.memory_needs import plan_step
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.runs.checkpoints import Checkpoint
from clsplat.scenes.initialise import from_scene
from clsplat.stages.adam import adam, updates_sh_rest
from clsplat.stages.density import (
    NO_ROW,
    DensityStatistics,
    add_contributions,
    add_statistics,
    gather,
    new_statistics,
    try_gather,
    widen,
)
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostArray,
    HostGaussians,
    allocate_gaussians,
    download_gaussians,
    host_gaussians,
    host_zeros,
    parts,
    to_device,
    to_host,
    upload_gaussians,
)
from clsplat.stages.loss import Loss, loss
from clsplat.stages.project import Projected, Screen
from clsplat.stages.target import target
from clsplat.training.density import adaptive
from clsplat.training.health import Patience
from clsplat.training.monitor import Remedy, Watch
from clsplat.training.photographs import Photographs
from clsplat.training.resolution import sizes_of

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene


_Moved = tuple[DeviceGaussians, DeviceGaussians, DeviceGaussians, DeviceGaussians]
"""Parameters, gradients, first and second moments."""


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

    watch: what is not finite in it, and how much of that there was.
    """

    def __init__(self, scene: Scene, config: TrainConfig, device: Device, initial: Gaussians | None = None) -> None:
        self.scene, self.config, self.device = scene, config, device
        self.views = scene.require_training_views()
        self.rasterizer = Rasterizer(device, config.rasterizer)
        self.photographs = Photographs(self.views)
        self.sizes = sizes_of(
            config.warmup, config.frequency_steps, len(self.views), lambda index: self.views[index].load()
        )
        self.background = allocate(device, (3,), np.float32)
        self.given = initial
        self.watch = Watch(self.rasterizer.readback, [view.name for view in self.views])
        self._start()

    def _start(self) -> None:
        """Begin with the first step."""
        self.rng = np.random.default_rng(self.config.seed)
        self.step = 0
        self.queue: list[int] = []
        self.controlled = False
        self._mark: _Mark | None = None
        self._second_halves: set[tuple[object, ...]] = set()
        device, initial = self.device, self.given if self.given is not None else self._initial()
        self.origin, self.near = initial.origin, self.scene.near
        self._make_plan(len(initial))
        if self.plan.streamed:
            self._set_parameters(host_gaussians(copy.deepcopy(initial), self.plan.rows))
        else:
            self._set_parameters(upload_gaussians(device, initial))

    def _initial(self) -> Gaussians:
        return from_scene(self.scene, self.config.random_points, self.rng)

    def _make_plan(self, count: int) -> None:
        """Plan the way of `count` Gaussians through the device's memory, with all of their SH coefficients in the
        end."""
        settings = self.config.density
        coefficients = (self.config.sh_degree + 1) ** 2
        cameras = [view.camera for view in self.scene.views]
        fields = SlotFields(settings.absolute_gradients, adaptive.wants_contributions(settings))
        self.plan = plan_step(
            self.device,
            count,
            coefficients,
            cameras,
            self.config.rasterizer,
            fields=fields,
            agreement=adaptive.wants_agreement(settings),
        )
        self.rasterizer.follow(self.plan)

    def _set_parameters(
        self, parameters: AnyGaussians, first: AnyGaussians | None = None, second: AnyGaussians | None = None
    ) -> None:
        """The model, on the device or streamed from the host; without moments they start from zero."""
        count, coefficients = parameters.count, parameters.coefficients
        self.parameters = parameters
        self.first = first or self._zeros(count, coefficients)
        self.second = second or self._zeros(count, coefficients)
        self.gradients = self._new_gradients()
        settings = self.config.density
        self.statistics = new_statistics(
            self.device,
            count,
            agreement=adaptive.wants_agreement(settings),
            contributions=adaptive.wants_contributions(settings),
        )

    def _zeros(self, count: int, coefficients: int) -> AnyGaussians:
        if isinstance(self.parameters, HostGaussians):
            return host_zeros(count, coefficients, self.parameters.rows)
        return allocate_gaussians(self.device, count, coefficients, zero=True)

    def _new_gradients(self) -> DeviceGaussians:
        """Zeros for the rows that are on the device at once; Adam leaves them so."""
        model = self.parameters
        rows = min(model.rows, model.count) if isinstance(model, HostGaussians) else model.count
        return allocate_gaussians(self.device, rows, model.coefficients, zero=True)

    def _take_down(self) -> list[HostGaussians]:
        """Parameters, first and second moments on the host, and none of them on the device."""
        models = [to_host(model) for model in (self.parameters, self.first, self.second)]
        del self.parameters, self.first, self.second, self.gradients
        return models

    def _placed(self, model: AnyGaussians) -> AnyGaussians:
        """The model where the plan wants it, if it is not there."""
        if isinstance(model, HostGaussians):
            return replace(model, rows=self.plan.rows) if self.plan.streamed else to_device(self.device, model)
        return model

    def train_step(self) -> Loss:
        """Density control as the last step left it to do, then one view: forward, loss, backward, Adam.

        Kerbl et al. 2023, algorithm 1, but for where the loop is cut: a model is looked at, kept or finished before
        its Gaussians are split or made transparent, not just after.
        """
        config, device, work = self.config, self.device, self.rasterizer.work
        self._note()
        self.mend()
        if not self.controlled:
            self._control_density()
            self.controlled = True
        self._note()
        self.step += 1
        self._raise_sh_degree()
        view, factor = self._next_view(), self.sizes.factor(self.step)
        image = self.photographs.load(view, factor)
        camera = self.local(self.views[view].camera.resized(image.shape[1], image.shape[0]))
        self.background.set(colour := self._background_colour())

        planes = target(device, work, image, self.background)
        frame = self.rasterizer.forward(self.parameters, camera, self.background)
        self.watch.notice(frame.refused)
        channels, settings = self.plan.channels, config.density
        fields = SlotFields(settings.absolute_gradients, adaptive.wants_contributions(settings, self.step))
        result = loss(
            device, work, frame.blended.image, planes, camera.width, camera.height, config.dssim_weight, channels
        )
        self.watch.follow(self.step, view, colour, result.sums)
        slots = self.rasterizer.pair_gradients(frame, result.gradient, fields=fields)
        model = (self.parameters, self.first, self.second)
        for start, stop, (parameters, first, second) in parts(work, *model, keep=True):  # one, if the model fits
            projected = frame.projected.rows(start, stop)
            screen = self.rasterizer.row_gradients(
                parameters,
                frame,
                projected,
                slots.rows(start, stop),
                self.gradients,
                fields=fields,
                sh_rest=updates_sh_rest(config.optimiser, self.step),
            )
            moved = (parameters, self.gradients, first, second)
            counted = (projected.tile_counts, self.rasterizer.readback)
            self._try_second_half(view, camera, projected, screen, moved)
            self._mark = None
            self._add_statistics(self.statistics.rows(start, stop), view, camera, projected, screen)
            adam(device, self.step, self.rates(), config.optimiser, *moved, *counted)
        self.controlled = False
        self._note()
        return result

    def _note(self, *, begun: bool = False) -> None:
        """Mark the state as it is now: until something of it is changed, `step_back` leads here. begun: the step's
        number has risen."""
        self._mark = _Mark(self.step - begun, self.rng.bit_generator.state, list(self.queue), self.controlled)

    def step_back(self) -> bool:
        """After an error within a step: make the state that of its beginning, or of after its density control. Returns
        whether that can be."""
        mark = self._mark
        if mark is None:
            return False
        self.step, self.queue, self.controlled = mark.step, list(mark.queue), mark.controlled
        self.rng.bit_generator.state = mark.rng
        return True

    def _try_second_half(self, view: int, camera: Camera, projected: Projected, screen: Screen, moved: _Moved) -> None:
        """Have every kernel rehearsed that changes the state, before the first does: a driver may fail in any."""
        parameters, settings = moved[0], self.config.optimiser
        key = (
            parameters.count,
            parameters.coefficients,
            updates_sh_rest(settings, self.step),
            self.step < self.config.density.stop,
            screen.contributions is not None,
        )
        if key in self._second_halves:
            return
        with only_tried(self.device):
            self._add_statistics(
                self.statistics.rows(0, projected.tile_counts.shape[0]), view, camera, projected, screen
            )
            adam(
                self.device, self.step, self.rates(), settings, *moved, projected.tile_counts, self.rasterizer.readback
            )
        self._second_halves.add(key)

    def _add_statistics(
        self, statistics: DensityStatistics, view: int, camera: Camera, projected: Projected, screen: Screen
    ) -> None:
        """Add the step to the statistics that density control goes by, as long as it needs them."""
        settings = self.config.density
        if self.step < settings.stop:
            add_statistics(self.device, statistics, camera, projected, screen, settings.gradient_threshold)
        if screen.contributions is not None and statistics.current is not None:
            full = self.views[view].camera
            area = full.width * full.height / (camera.width * camera.height)
            add_contributions(self.device, statistics.current, projected, screen.contributions, area)

    def mend(self, *, look: bool = False) -> None:
        """See to the Gaussians in which something was not finite, if that has been noticed; look: read whether there
        is something to notice."""
        if look:
            self.watch.look()
        self._apply(self.watch.examine(self.parameters, self.first, self.second))

    def _apply(self, remedy: Remedy | None) -> None:
        if remedy is None:
            return
        for kind, groups in (remedy.moments or {}).items():
            for group, values in groups.items():
                (self.first if kind == "first" else self.second)[group].set(values)
        if remedy.rows is not None:
            none = np.zeros(len(remedy.rows), bool)
            self._rearrange(adaptive.Plan(remedy.rows, none, none), densified=False)

    def rates(self) -> dict[str, float]:
        """Learning rate of each group at this step. The means' falls exponentially; all fall in the cooldown, and with
        each return to a checkpoint."""
        optimiser = self.config.optimiser
        into = optimiser.cooldown - max(self.config.iterations - self.step, 0)
        cooled = optimiser.cooldown_to ** (into / optimiser.cooldown) if into > 0 else 1.0
        fraction = min(self.step / optimiser.means_rate_steps, 1.0)
        means_rate = optimiser.means_rate ** (1 - fraction) * optimiser.means_rate_end**fraction
        rates = {name: getattr(optimiser, group.rate) for name, group in GROUPS.items()}
        rates["means"] = means_rate * self.scene.extent
        return {group: rate * cooled * self.watch.patience.rate_factor for group, rate in rates.items()}

    def _next_view(self) -> int:
        if not self.queue:
            self.queue = [int(index) for index in self.rng.permutation(len(self.views))]
            self._mark = None
            self.statistics = self.statistics.next_epoch()
            self._note(begun=True)
        return self.queue.pop()

    def _background_colour(self) -> NDArray[np.float32]:
        if self.config.background == "random":
            return self.rng.random(3, dtype=np.float32)
        return np.array(background_colour(self.config.background), np.float32)

    def _raise_sh_degree(self) -> None:
        """Bands that are not in use yet have no place in memory: their gradient, and so their step, would be zero."""
        every = self.config.sh_degree_every
        degree = min(self.step // every, self.config.sh_degree) if every > 0 else self.config.sh_degree
        coefficients = (degree + 1) ** 2
        if coefficients > self.parameters.coefficients:
            models = [self.parameters, self.first, self.second] if self.plan.gathers else self._take_down()
            self.parameters, self.first, self.second = (
                self._placed(widen(self.device, model, coefficients)) for model in models
            )
            self.gradients = self._new_gradients()

    def _control_density(self) -> None:
        config = self.config.density
        if self.step == 0:
            return
        due, prunes = adaptive.is_due(config, self.step), adaptive.is_pruning_due(config, self.step)
        resets = adaptive.is_reset_due(config, self.step, white=self.config.background == "white")
        self.mend(look=due or prunes or resets)
        self._note()
        if due:
            self._densify()
        elif prunes:
            self._prune()
        if resets:
            logits = self.parameters["opacity_logits"]
            logits.set(adaptive.reset_opacities(config, logits.get()))
            self.first["opacity_logits"].fill(0.0)
            self.second["opacity_logits"].fill(0.0)
            self.statistics.forget_contributions()

    def _contributions(self) -> adaptive.Contributions | None:
        current, whole = self.statistics.current, self.statistics.whole
        if current is None or whole is None:
            return None
        return adaptive.Contributions(whole.totals.get(), np.maximum(current.largest.get(), whole.largest.get()))

    def _prune(self) -> None:
        plan = adaptive.plan_pruning(
            self.config.density,
            self.step,
            opacity_logits=self.parameters["opacity_logits"].get(),
            contributions=self._contributions(),
        )
        self._rearrange(plan, densified=False)

    def _densify(self) -> None:
        config, agreeing = self.config.density, self.statistics.agreeing
        plan = adaptive.plan(
            config,
            self.step,
            self.scene.extent,
            gradient_sums=self.statistics.gradient_sums.get(),
            seen=self.statistics.seen.get(),
            radii=self.statistics.radii.get(),
            log_scales=self.parameters["log_scales"].get(),
            opacity_logits=self.parameters["opacity_logits"].get(),
            agreeing=agreeing.get() if agreeing is not None else None,
            contributions=self._contributions(),
        )
        self._rearrange(plan, densified=True)

    def _rearrange(self, plan: adaptive.Plan, *, densified: bool) -> None:
        """Move the rows of everything to their places in the plan."""
        config, device = self.config.density, self.device
        if len(plan.rows) == 0:
            raise ClsplatError(
                f"step {self.step}: every Gaussian was pruned; lower --density.min-opacity"
                + (" or --density.min-contribution" if config.min_contribution > 0 else "")
            )
        gathers = self.plan.gathers
        with only_tried(device):
            try_gather(device, len(plan.rows), self.parameters)
        self._mark = None
        self._make_plan(len(plan.rows))
        models = [self.parameters, self.first, self.second] if gathers and self.plan.gathers else self._take_down()
        statistics = self.statistics.moved(plan.rows, plan.fresh, densified=densified)
        del self.statistics
        moment_rows = np.where(plan.fresh, NO_ROW, plan.rows)
        rows_of = (plan.rows, moment_rows, moment_rows)
        parameters, first, second = (gather(device, r, model) for r, model in zip(rows_of, models, strict=True))
        del models
        if plan.split.any():
            host = {name: parameters[name].get() for name in ("means", "quaternions", "log_scales")}
            halves = {name: values[plan.split] for name, values in host.items()}
            means, log_scales = adaptive.split_halves(config, **halves, rng=self.rng)
            host["means"][plan.split], host["log_scales"][plan.split] = means, log_scales
            parameters["means"].set(host["means"])
            parameters["log_scales"].set(host["log_scales"])
        self._set_parameters(*(self._placed(model) for model in (parameters, first, second)))
        self.statistics.load(statistics)

    def local(self, camera: Camera) -> Camera:
        """A camera in the world as one for the model in training: see `Gaussians.local`."""
        return camera.from_origin(self.origin).before(self.near)

    def gaussians(self) -> Gaussians:
        """The model so far, on the host, with room for the SH degree it is trained to."""
        model = download_gaussians(self.parameters)
        full = np.zeros((len(model), (self.config.sh_degree + 1) ** 2, 3), np.float32)
        full[:, : model.sh.shape[1]] = model.sh
        model.sh, model.origin, model.near = full, self.origin, self.near
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
        return arrays, {**state, "controlled": True} if self.controlled else state

    def _arrays(self) -> dict[str, NDArray[Any]]:
        arrays = {f"statistics/{name}": array.get() for name, array in self.statistics.named().items()}
        for kind, source in (("parameters", self.parameters), ("first", self.first), ("second", self.second)):
            arrays.update({f"{kind}/{group}": source[group].get() for group in GROUPS})
        return arrays

    def restart(self) -> None:
        """Begin again, at the rates that `watch.patience` allows."""
        del self.parameters, self.first, self.second, self.gradients, self.statistics
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
        except (KeyError, TypeError, ValueError, IndexError) as error:
            why = f"{type(error).__name__}: {error}"
            raise unusable(checkpoint, f"its state is not as this version writes it ({why})") from None
        self.queue = queue if max(queue, default=0) < len(self.views) else []  # of a scene that had more of them
        self.controlled, self._mark = bool(checkpoint.state.get("controlled", False)), None
        self.watch.patience = patience
        self.watch.forget()
        del self.parameters, self.first, self.second, self.gradients, self.statistics
        self._make_plan(loaded[0].count)
        self._set_parameters(*(self._placed(model) for model in loaded))
        prefix = "statistics/"
        found = {name[len(prefix) :]: each for name, each in checkpoint.arrays.items() if name.startswith(prefix)}
        for name, array in self.statistics.named().items():
            if name in found and (found[name].shape, found[name].dtype) != (array.shape, array.dtype):
                raise unusable(checkpoint, f"{prefix}{name} has shape {found[name].shape}")
        self.statistics.load(found)  # what the settings did not ask for before the checkpoint is not known

    def _loaded(self, checkpoint: Checkpoint, kind: str) -> HostGaussians:
        for group in GROUPS:
            if f"{kind}/{group}" not in checkpoint.arrays:
                raise unusable(checkpoint, f"has no {kind}/{group}")
        host = {group: checkpoint.arrays[f"{kind}/{group}"] for group in GROUPS}
        count, coefficients = len(host["means"]), host["sh_rest"].shape[1] + 1
        for group, shape in group_shapes(count, coefficients).items():
            if host[group].shape != shape or host[group].dtype != np.float32 or count == 0:
                raise unusable(checkpoint, f"{kind}/{group} has shape {host[group].shape} of {host[group].dtype}")
        most = (self.config.sh_degree + 1) ** 2
        if coefficients > most:
            raise unusable(
                checkpoint,
                f"has {coefficients} SH coefficients, more than the {most} of --sh-degree {self.config.sh_degree}",
            )
        arrays = {group: HostArray(values) for group, values in host.items()}
        return HostGaussians(count, coefficients, arrays, count)


def unusable(checkpoint: Checkpoint, why: str) -> InputError:
    """The error of a checkpoint that is whole, and not one to go on with."""
    advice = "is it of another run or version?"
    return InputError(f"checkpoint of step {checkpoint.step}: {why}; {advice}")
