# SPDX-License-Identifier: Apache-2.0
"""A step of several views, on one device or several: gradients are added in the order of the views, then Adam.

The first device has the model. The others have copies of its parameters, each with a thread, and hand back what their
views found. So which is quicker changes no bit, nor does their number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, shared, upload
from clsplat.device.context import Device
from clsplat.device.layout import SPLAT
from clsplat.errors import InputError
from clsplat.gaussians import GROUPS, group_shapes
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.adam import adam, add_view, updates_sh_rest
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostGaussians,
    allocate_gaussians,
    host_zeros,
    parts,
)
from clsplat.stages.loss import Loss
from clsplat.stages.noise import noise
from clsplat.stages.project import Projected, Screen
from clsplat.training.appearance import ViewAppearance
from clsplat.training.photographs import Photographs
from clsplat.training.step import GradientStep, Sample, StepProbe, StepRows, ViewRows, view_gradients

OWNER_MODELS, REPLICA_MODELS = 5, 2
"""Arrays for each parameter on the first device, parameters, two moments, a view's gradients and their sum, and on the
others, parameters and a view's gradients."""


def scaled(config: OptimiserConfig, batch: int) -> OptimiserConfig:
    """Adam's constants for steps of `batch` views: as much of the moments is kept from view to view as with one (Zhao
    et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 4)."""
    every = max(config.sh_rest_every // batch, 1)
    return replace(config, beta1=config.beta1**batch, beta2=config.beta2**batch, sh_rest_every=every)


def scaled_rates(rates: Mapping[str, float], batch: int) -> dict[str, float]:
    """Learning rates for steps of `batch` views: gradients of different views are nearly independent, so that their sum
    grows with the root of their number, by which Adam divides (the same)."""
    return {group: rate * sqrt(batch) for group, rate in rates.items()}


def shares(count: int, devices: int) -> list[range]:
    """The views of a step that each device has, those of a device following each other."""
    size = -(-count // devices)
    return [range(min(k * size, count), min((k + 1) * size, count)) for k in range(devices)]


@dataclass(frozen=True, eq=False)
class Losses:
    """Losses of a step's views."""

    views: tuple[Loss, ...]

    def read(self) -> tuple[float, float]:
        """Means of (loss, mean squared error); waits for the device."""
        value, squared = np.mean([view.read() for view in self.views], axis=0)
        return float(value), float(squared)


@dataclass(frozen=True, eq=False)
class _AddedView(GradientStep):
    """A view whose gradients are added to the sums, which are second in the model that it is given. shown (n,): the
    Gaussians that any view shows, where Adam wants to know; columns: gradients of appearances, by the views' places."""

    shown: DeviceArray | None
    columns: dict[int, DeviceArray]

    def learn(self, appearance: ViewAppearance, columns: DeviceArray) -> None:
        """Keep the gradient: all views of the batch see the appearances as they were before it."""
        self.columns[appearance.place] = columns

    def update(self, rows: StepRows) -> None:
        """Add the rows' gradients; while kernels are only tried, try Adam's too."""
        assert rows.gradients is not None, "the batch asks for them"
        parameters, sums = rows.model
        shown = None if self.shown is None else self.shown.rows(rows.start, rows.stop)
        sh_rest = updates_sh_rest(self.config.optimiser, self.step)
        add_view(self.device, rows.projected.tile_counts, rows.gradients, sums, shown, sh_rest=sh_rest)
        if self.device.only_tries:
            models, counts = (parameters, sums, rows.gradients, rows.gradients), rows.projected.tile_counts
            adam(self.device, self.step, self.rates, self.config.optimiser, *models, counts, self.rasterizer.readback)
            if self.explore is not None:
                noise(self.device, self.explore, parameters, 0, self.rasterizer.readback)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of a view on another device, on the host until the next step: by name the arrays of its rows, and its
    gradients by group; the loss; the gradient of its appearance, if that is learnt."""

    arrays: dict[str, NDArray[Any]]
    gradients: dict[str, NDArray[np.float32]]
    loss: Loss
    columns: NDArray[Any] | None = None


@dataclass(frozen=True, eq=False)
class _RemoteView(GradientStep):
    """A view on another device than the model, whose results go to the host."""

    arrays: dict[str, NDArray[Any]]
    outcome: dict[str, NDArray[np.float32]]
    columns: list[NDArray[Any]]

    def learn(self, appearance: ViewAppearance, columns: DeviceArray) -> None:  # noqa: ARG002  # the owner does
        """Copy the gradient to the host."""
        self.columns.append(columns.get())

    def update(self, rows: StepRows) -> None:
        """Copy the rows' results to the host."""
        assert rows.gradients is not None, "the batch asks for them"
        on_device = {
            "tile_counts": rows.projected.tile_counts,
            "splats": rows.projected.splats,
            "screen": rows.screen.gradients,
            "contributions": rows.screen.contributions,
        }
        for name, host in self.arrays.items():
            array = on_device[name]
            assert array is not None, name
            array.read_into(host[rows.start : rows.stop])
        for group, host in self.outcome.items():
            shape = (rows.stop - rows.start, *host.shape[1:])
            rows.gradients[group].reshaped(*shape).read_into(host[rows.start : rows.stop])


class Replica:
    """A further device of a training, with a copy of the parameters, and a thread."""

    def __init__(self, device: Device, config: TrainConfig, photographs: Photographs) -> None:
        self.device, self.config, self.photographs = device, config, photographs.for_device(device)
        self.rasterizer = Rasterizer(device, config.rasterizer)
        self.rasterizer.antialias(on=config.antialiased)
        self.thread = ThreadPoolExecutor(1, f"clsplat-{device.name}")
        self.plan: Plan | None = None
        self.parameters: AnyGaussians | None = None
        self._room: dict[tuple[int, str], NDArray[Any]] = {}

    def follow(self, plan: Plan) -> None:
        """Work in as much of the device's memory as the plan has for it."""
        self.plan, self.parameters = plan, None
        self._room.clear()
        self.rasterizer.follow(plan)
        self.photographs.follow(plan.photographs)

    def take(self, values: Mapping[str, NDArray[np.float32]], coefficients: int) -> None:
        """Take the parameters of these groups, of `coefficients` SH coefficients, from the host."""
        assert self.plan is not None, "planned before the first step"
        count = self.plan.need.gaussians
        if self.parameters is None or self.parameters.coefficients != coefficients:
            self.parameters = None
            if self.plan.streamed:
                self.parameters = host_zeros(count, coefficients, self.plan.rows)
            else:
                self.parameters = allocate_gaussians(self.device, count, coefficients)
        for group, array in values.items():
            self.parameters[group].set(array)

    def view(
        self,
        place: int,
        sample: Sample,
        factor: float,
        step: GradientStep,
        gains: NDArray[np.float32] | None,
        *,
        splats: bool,
    ) -> Outcome:
        """Forward, loss and backward of a view; place: its number among this device's; factor: of its resolution;
        gains: of its photograph, where they are learnt; splats: True if density control goes by its gradients."""
        parameters, photograph = self.parameters, self.photographs.bring(sample.view, factor)
        assert parameters is not None, "taken before the view"
        n, sh_rest = parameters.count, updates_sh_rest(step.config.optimiser, step.step)
        shapes = group_shapes(n, parameters.coefficients)
        gradients = {g: self._host(place, g, shapes[g]) for g in GROUPS if g != "sh_rest" or sh_rest}
        arrays = {"tile_counts": self._host(place, "tile_counts", (n,), np.uint32)}
        if splats:
            arrays["splats"] = self._host(place, "splats", (n, len(SPLAT)))
            arrays["screen"] = self._host(place, "screen", (n, 2))
        if step.fields.contributions:
            arrays["contributions"] = self._host(place, "contributions", (n,))
        settings = (self.device, self.rasterizer, step.config, step.step, step.rates, step.fields)
        room = view_gradients(self.rasterizer.work, parameters)
        pixels = (photograph, sample.camera, sample.background)
        appearance = step.appearance.on(self.device, gains) if step.appearance and gains is not None else None
        columns: list[NDArray[Any]] = []
        view = _RemoteView(*settings, arrays, gradients, columns, explore=step.explore, appearance=appearance)
        result = view.run((parameters,), *pixels, StepProbe(), room, reads_loss=True, **sample.known)
        return Outcome(arrays, gradients, result, next(iter(columns), None))

    def _host(self, place: int, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> NDArray[Any]:
        """Room on the host, the same from step to step: fresh pages would cost as much as the copy."""
        held = self._room.get((place, name))
        if held is None or held.shape != shape:
            held = self._room[place, name] = np.empty(shape, dtype)
        return held


class Batch:
    """The gradients of several views, and Adam along their sum.

    rasterizer, photographs: of the device that has the model; further: the other devices. Raises InputError for a
    device that is there twice.
    """

    def __init__(
        self, rasterizer: Rasterizer, photographs: Photographs, config: TrainConfig, further: Sequence[Device]
    ) -> None:
        devices = (rasterizer.device, *further)
        if len({device.queue.int_ptr for device in devices}) < len(devices):
            raise InputError(
                f"several devices to train on: got {', '.join(device.name for device in devices)}, of which two have "
                "one queue and one set of kernels; expected each opened on its own, as a thread works with it"
            )
        self.rasterizer, self.photographs, self.config = rasterizer, photographs, config
        self.replicas = [Replica(device, config, photographs) for device in further]
        self._sums: AnyGaussians | None = None
        self._sent: AnyGaussians | None = None
        self._room: dict[str, NDArray[np.float32]] = {}

    def follow(self, plans: Sequence[Plan]) -> None:
        """Work in as much of the further devices' memory as the plans have for it. What was planned before goes."""
        self._sums = self._sent = None
        self._room.clear()
        for replica, plan in zip(self.replicas, plans, strict=True):
            replica.follow(plan)

    def changed(self) -> None:
        """Note that something other than Adam has changed the parameters."""
        self._sent = None

    def close(self) -> None:
        """End the threads."""
        for replica in self.replicas:
            replica.thread.shutdown()

    def run(
        self,
        step: GradientStep,
        model: tuple[AnyGaussians, AnyGaussians, AnyGaussians],
        samples: Sequence[Sample],
        factor: float,
        probes: Callable[[Sample, GradientStep], StepProbe],
        appearances: Sequence[ViewAppearance] = (),
        *,
        statistics: bool,
    ) -> Losses:
        """Update the model (parameters, first and second moments) by the samples.

        step: one of a single view, from which this one follows; its number counts views; factor: of the photographs'
        resolution; probes: makes one for a view; appearances: of the samples, where they are learnt; statistics:
        density control goes by the views' gradients.
        """
        batch, work, device = self.config.batch, self.rasterizer.work, step.device
        optimiser, number = scaled(self.config.optimiser, batch), -(-step.step // batch)
        config, rates = replace(self.config, optimiser=optimiser), scaled_rates(step.rates, batch)
        sums, shown = self._room_for(device, model[0])
        explore = step.explore
        columns: dict[int, DeviceArray] = {}
        settings = (device, self.rasterizer, config, number, rates, step.fields, shown, columns)
        step_of_view = _AddedView(*settings, explore=explore and explore.of_view())
        steps = [replace(step_of_view, appearance=appearance) for appearance in appearances]
        steps = steps or [step_of_view] * len(samples)
        gains = [each.values() if self.replicas else None for each in appearances] or [None] * len(samples)
        first, *others = shares(len(samples), 1 + len(self.replicas))
        transfers = self._send(model[0])
        pending: list[tuple[int, Future[Outcome]]] = []
        try:
            for replica, share in zip(self.replicas, others, strict=True):
                for place, index in enumerate(share):
                    of_view = (samples[index], factor, steps[index], gains[index])
                    view = partial(replica.view, place, *of_view, splats=statistics)
                    pending.append((index, replica.thread.submit(view)))
            losses = [self._view((model[0], sums), samples[index], factor, steps[index], probes) for index in first]
            for transfer in transfers:
                transfer.result()
            for index, future in pending:
                outcome = future.result()
                losses.append(self._take(sums, outcome, step_of_view, probes(samples[index], step_of_view)))
                if outcome.columns is not None:
                    columns[index] = upload(device, outcome.columns)
        finally:  # what an error has ended goes on in no thread
            under_way: list[Future[Any]] = [*transfers, *(future for _, future in pending)]
            wait([future for future in under_way if not future.cancel()])
        for start, stop, (parameters, moments, squares, gradients) in parts(work, *model, sums, keep=True):
            counts = self.rasterizer.readback if shown is None else shown.rows(start, stop)
            models = (parameters, gradients, moments, squares)
            adam(device, number, rates, optimiser, *models, counts, self.rasterizer.readback)
            if explore is not None:
                noise(device, explore.scaled(sqrt(batch)), parameters, start, self.rasterizer.readback)
        for appearance in appearances:
            appearance.update(columns[appearance.place], self.rasterizer.readback)
        self._sent = None if updates_sh_rest(optimiser, number) else model[0]
        return Losses(tuple(losses))

    def _room_for(self, device: Device, parameters: AnyGaussians) -> tuple[AnyGaussians, DeviceArray | None]:
        """The sums, all zero, as `adam` leaves them, and where Adam wants to know the Gaussians shown, none yet."""
        count, coefficients, sums = parameters.count, parameters.coefficients, self._sums
        if sums is None or (sums.count, sums.coefficients) != (count, coefficients):
            del sums
            self._sums = None
            if isinstance(parameters, HostGaussians):
                self._sums = host_zeros(count, coefficients, parameters.rows)
            else:
                self._sums = allocate_gaussians(device, count, coefficients, zero=True)
            sums = self._sums
        if not self.config.optimiser.sparse:
            return sums, None
        shown = self.rasterizer.work.array("shown_in_batch", (count,), np.uint32)
        shown.fill(0)
        return sums, shown

    def _send(self, parameters: AnyGaussians) -> list[Future[None]]:
        """Send the parameters to the further devices, but for the higher bands of SH where these have them already."""
        if not self.replicas:
            return []
        groups = [group for group in GROUPS if group != "sh_rest" or self._sent is not parameters]
        values = {group: self._on_host(group, parameters) for group in groups}
        return [replica.thread.submit(replica.take, values, parameters.coefficients) for replica in self.replicas]

    def _on_host(self, group: str, parameters: AnyGaussians) -> NDArray[np.float32]:
        array = parameters[group]
        if not isinstance(array, DeviceArray):
            return array.values
        held = self._room.get(group)
        if held is None or held.shape != array.shape:
            held = self._room[group] = np.empty(array.shape, np.float32)
        array.read_into(held)
        return held

    def _view(
        self,
        model: tuple[AnyGaussians, AnyGaussians],
        sample: Sample,
        factor: float,
        step: _AddedView,
        probes: Callable[[Sample, GradientStep], StepProbe],
    ) -> Loss:
        """A view on the device that has the model, which here are its parameters and the sums."""
        gradients = view_gradients(self.rasterizer.work, model[0])
        pixels = (self.photographs.bring(sample.view, factor), sample.camera, sample.background)
        return step.run(model, *pixels, probes(sample, step), gradients, reads_loss=True, **sample.known)

    def _take(self, sums: AnyGaussians, outcome: Outcome, step: _AddedView, probe: StepProbe) -> Loss:
        """Add what a view has found on another device, in the memory of a view on this one."""
        device, work = step.device, self.rasterizer.work
        probe.loss(outcome.loss)
        for start, stop, (part,) in parts(work, sums, keep=True):
            rows = {name: _brought(work, device, name, values[start:stop]) for name, values in outcome.arrays.items()}
            arrays = {
                group: _brought(work, device, f"view_{group}", values[start:stop])
                for group, values in outcome.gradients.items()
            }
            gradients, counts = DeviceGaussians(part.count, part.coefficients, arrays), rows["tile_counts"]
            shown = None if step.shown is None else step.shown.rows(start, stop)
            add_view(device, counts, gradients, part, shown, sh_rest="sh_rest" in arrays)
            screen = Screen(rows.get("screen", counts), rows.get("contributions"))
            probe.after_rows(ViewRows(start, stop, Projected(rows.get("splats", counts), counts), screen))
        return outcome.loss


def _brought(work: Workspace, device: Device, name: str, values: NDArray[Any]) -> DeviceArray:
    """An array of another device's, which is on the host until the next step."""
    if device.shares_memory and values.size:
        return shared(device, values)
    array = work.array(name, values.shape, values.dtype.type)
    array.send(values)
    return array
