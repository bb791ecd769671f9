# SPDX-License-Identifier: Apache-2.0
"""A training step of several views (--batch), on one device or several: gradients are summed, then Adam steps once.

The first device has the model. Each further device has a thread and a copy of the parameters, and returns the results
of its views. Gradients are summed in the order of the views, so neither the speed nor the number of devices changes a
bit of the result.
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
from clsplat.errors import InputError
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import SPLAT
from clsplat.optimisation.step_noise import Exploration
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.adam import adam, add_view
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostArray,
    HostGaussians,
    allocate_gaussians,
    host_zeros,
    parts,
)
from clsplat.stages.loss import Loss
from clsplat.stages.noise import noise
from clsplat.stages.project import Projected, Screen
from clsplat.training.step.gradient_step import GradientStep, StepProbe, view_gradients
from clsplat.training.step.inputs import StepRows, ViewInputs, ViewRows
from clsplat.training.supervision.image_cache import ImageCache

OWNER_ARRAYS_PER_PARAMETER, REPLICA_ARRAYS_PER_PARAMETER = 5, 2
"""Number of arrays for each parameter of the model, on the first device and on each further device.

The first has the parameter, two moments, a view's gradient and the sum of gradients; a further device the parameter and
a view's gradient.
"""


def scaled(config: OptimiserConfig, batch: int) -> OptimiserConfig:
    """Return Adam's settings for steps of `batch` views: moments decay as much per view as in steps of one view.

    Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 4.
    """
    every = max(config.sh_rest_every // batch, 1)
    return replace(config, beta1=config.beta1**batch, beta2=config.beta2**batch, sh_rest_every=every)


def scaled_rates(rates: Mapping[str, float], batch: int) -> dict[str, float]:
    """Return the learning rates for steps of `batch` views, from `rates` for steps of one view.

    Gradients of different views are nearly independent, so their sum grows with the root of their number. Adam divides
    by the sum's size, which cancels this growth, so the rates are multiplied by the root (Zhao et al. 2024, section 4).
    """
    return {group: rate * sqrt(batch) for group, rate in rates.items()}


def shares(count: int, devices: int) -> list[range]:
    """Divide the `count` views of a step among devices. Returns the range of consecutive views of each device."""
    size = -(-count // devices)
    return [range(min(k * size, count), min((k + 1) * size, count)) for k in range(devices)]


@dataclass(frozen=True, eq=False)
class Losses:
    """Losses of the views of a batch."""

    views: tuple[Loss, ...]

    def read(self) -> tuple[float, float]:
        """Mean loss and mean squared error of the views; waits for the device."""
        value, squared = np.mean([view.read() for view in self.views], axis=0)
        return float(value), float(squared)


@dataclass(eq=False)
class _AddedView(GradientStep):
    """Step of one view that adds the view's gradients to the batch's sums, instead of taking Adam's step.

    The `model` that it runs on consists of the parameters and the batch's sums of gradients, without moments.

    own: gradients of each view's parts (`ViewPart`), by the view's position in the batch.
    noise: noise that the batch adds after its last view.
    """

    own: dict[int, Sequence[DeviceArray | None]]
    noise: Exploration

    def learn(self, inputs: ViewInputs, own: Sequence[DeviceArray | None]) -> None:
        """Keep the gradients of the view's parts until the batch ends, as all its views use the same parameters."""
        self.own[inputs.place] = own

    def update(self, rows: StepRows) -> None:
        """Add the rows' gradients to the sums. In a sandbox trial, also try the kernels that follow the last view."""
        assert rows.gradients is not None, "the batch asks for them"
        parameters, sums = rows.model
        step, counts = self.adam_step, rows.projected.tile_counts
        add_view(self.device, counts, rows.gradients, sums, sh_rest=step.updates_sh_rest)
        if self.device.only_tries:
            models = (parameters, sums, rows.gradients, rows.gradients)
            adam(self.device, step, *models, readback=self.rasterizer.readback)
            noise(self.device, self.noise, parameters, rows.start, self.rasterizer.readback, self.region)


@dataclass(frozen=True, eq=False)
class ViewOutcome:
    """Results of a view that a further device computed, on the host until the next step.

    arrays: tile counts, splats, screen-space gradients and contributions of all Gaussians, by name.
    gradients: gradients of all Gaussians, by parameter group.
    own: gradients of the view's parts, such as its appearance; None for a part without parameters.
    """

    arrays: dict[str, NDArray[Any]]
    gradients: dict[str, NDArray[np.float32]]
    loss: Loss
    own: Sequence[NDArray[Any] | None] = ()


@dataclass(eq=False)
class _RemoteView(GradientStep):
    """Step of one view on a further device. It copies the view's results to the host, instead of taking Adam's step."""

    arrays: dict[str, NDArray[Any]]
    outcome: dict[str, NDArray[np.float32]]
    own: list[NDArray[Any] | None]

    def learn(self, inputs: ViewInputs, own: Sequence[DeviceArray | None]) -> None:  # noqa: ARG002
        """Copy the parts' gradients to the host, for Adam on the first device."""
        self.own.extend(None if gradient is None else gradient.get() for gradient in own)

    def update(self, rows: StepRows) -> None:
        """Copy the results for these rows to the host: their gradients, and the values that density control needs."""
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
    """Further device of a training, with a copy of the parameters and a thread of its own."""

    def __init__(self, device: Device, config: TrainConfig, photographs: ImageCache) -> None:
        self.device, self.config = device, config
        self.photographs = ImageCache(device, photographs.host)
        self.rasterizer = Rasterizer(device, config.rasterizer, antialiased=config.antialiased)
        self.thread = ThreadPoolExecutor(1, f"clsplat-{device.name}")
        self.plan: Plan | None = None
        self.parameters: AnyGaussians | None = None
        self._room: dict[tuple[int, str], NDArray[Any]] = {}

    def follow(self, plan: Plan) -> None:
        """Use at most the device memory that `plan` allows. Arrays of an earlier plan are freed."""
        self.plan, self.parameters = plan, None
        self._room.clear()
        self.rasterizer.follow(plan)
        self.photographs.follow(plan.photographs)

    def take(self, values: Mapping[str, NDArray[np.float32]], coefficients: int) -> None:
        """Upload the model's parameters from the host.

        values: parameters by group. A group that is left out keeps its values.
        coefficients: number of SH coefficients of the model.
        """
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
        inputs: ViewInputs,
        factor: float,
        step: GradientStep,
        values: Sequence[NDArray[np.float32]],
        *,
        splats: bool,
    ) -> ViewOutcome:
        """Run forward, loss and backward of a view on this device.

        place: the view's position among this device's views of the batch.
        factor: divisor of the photographs' resolution.
        step: the step of the batch's views on the first device, from which this device takes all settings.
        values: parameters of each of `inputs.parts`, as `ViewPart.values` returned them.
        splats: True to return splats and screen-space gradients too, which density control uses.
        """
        parameters, photograph = self.parameters, self.photographs.bring(inputs.view, factor)
        assert parameters is not None, "taken before the view"
        n, sh_rest = parameters.count, step.adam_step.updates_sh_rest
        shapes = group_shapes(n, parameters.coefficients)
        gradients = {g: self._host(place, g, shapes[g]) for g in PARAMETER_GROUPS if g != "sh_rest" or sh_rest}
        arrays = {"tile_counts": self._host(place, "tile_counts", (n,), np.uint32)}
        if splats:
            arrays["splats"] = self._host(place, "splats", (n, len(SPLAT)))
            arrays["screen"] = self._host(place, "screen", (n, 2))
        if step.fields.contributions:
            arrays["contributions"] = self._host(place, "contributions", (n,))
        settings = (self.device, self.rasterizer, step.config, step.step, step.rates, step.fields)
        room = view_gradients(self.rasterizer.work, parameters)
        shares = tuple(part.on(self.device, each) for part, each in zip(inputs.parts, values, strict=True))
        own: list[NDArray[Any] | None] = []
        view = _RemoteView(*settings, arrays, gradients, own, explore=step.explore, region=step.region)
        here = replace(inputs, photograph=photograph, parts=shares)
        return ViewOutcome(arrays, gradients, view.run((parameters,), here, StepProbe(), room, reads_loss=True), own)

    def _host(self, place: int, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> NDArray[Any]:
        """Return the host array that takes the result `name` of a view. place: the view's position among this device's
        views of the batch. The array is reused in each step: fresh memory would take as much time as the copy."""
        held = self._room.get((place, name))
        if held is None or held.shape != shape:
            held = self._room[place, name] = np.empty(shape, dtype)
        return held


class Batch:
    """Steps of several views: the devices compute the views' gradients, and Adam takes one step with their sum.

    rasterizer, photographs: rasterizer and image cache of the device that has the model.
    further: the other devices.
    Raises InputError if a device occurs twice.
    """

    def __init__(
        self, rasterizer: Rasterizer, photographs: ImageCache, config: TrainConfig, further: Sequence[Device]
    ) -> None:
        devices = (rasterizer.device, *further)
        if len({device.queue.int_ptr for device in devices}) < len(devices):
            raise InputError(
                f"cannot train on {', '.join(device.name for device in devices)} together: two of them share a "
                "queue and kernels; open each device on its own, because each needs a thread of its own"
            )
        self.rasterizer, self.photographs, self.config = rasterizer, photographs, config
        self.replicas = [Replica(device, config, photographs) for device in further]
        self._sums: AnyGaussians | None = None
        self._sent: AnyGaussians | None = None
        self._room: dict[str, NDArray[np.float32]] = {}

    def follow(self, plans: Sequence[Plan]) -> None:
        """Use at most the device memory that `plans` allow: a plan for each further device. Frees arrays of earlier
        plans."""
        self._sums = self._sent = None
        self._room.clear()
        for replica, plan in zip(self.replicas, plans, strict=True):
            replica.follow(plan)

    def changed(self) -> None:
        """Note that the parameters were changed, but not by Adam: the next step sends all of them to the devices."""
        self._sent = None

    def close(self) -> None:
        """End the threads of the further devices."""
        for replica in self.replicas:
            replica.thread.shutdown()

    def run(
        self,
        step: GradientStep,
        model: tuple[AnyGaussians, AnyGaussians, AnyGaussians],
        views: Sequence[ViewInputs],
        factor: float,
        probes: Callable[[ViewInputs, GradientStep], StepProbe],
        *,
        statistics: bool,
    ) -> Losses:
        """Update the model (parameters, first and second moments) with the views of a step.

        step: settings of the step. Its step number counts views.
        factor: divisor of the photographs' resolution.
        probes: function that makes the `StepProbe` of a view from the view's inputs and its step.
        statistics: True if density control uses the views' gradients.
        """
        batch, work, device = self.config.batch, self.rasterizer.work, step.device
        optimiser, number = scaled(self.config.optimiser, batch), -(-step.step // batch)
        config, rates = replace(self.config, optimiser=optimiser), scaled_rates(step.rates, batch)
        sums = self._sums_for(device, model[0])
        own: dict[int, Sequence[DeviceArray | None]] = {}
        explore = step.explore.scaled(sqrt(batch))
        settings = (device, self.rasterizer, config, number, rates, step.fields, own, explore)
        step_of_view = _AddedView(*settings, explore=step.explore.of_view(), region=step.region)
        adam_step = step_of_view.adam_step
        first, *others = shares(len(views), 1 + len(self.replicas))
        transfers = self._send(model[0])
        pending: list[tuple[int, Future[ViewOutcome]]] = []
        try:
            for replica, share in zip(self.replicas, others, strict=True):
                for place, index in enumerate(share):
                    values = [part.values() for part in views[index].parts]
                    view = partial(replica.view, place, views[index], factor, step_of_view, values, splats=statistics)
                    pending.append((index, replica.thread.submit(view)))
            losses = [self._view((model[0], sums), views[index], factor, step_of_view, probes) for index in first]
            for transfer in transfers:
                transfer.result()
            for index, future in pending:
                outcome = future.result()
                losses.append(self._take(model[0], sums, outcome, step_of_view, probes(views[index], step_of_view)))
                own[index] = [None if each is None else upload(device, each) for each in outcome.own]
        finally:  # after an error, no thread may still be working on this batch
            under_way: list[Future[Any]] = [*transfers, *(future for _, future in pending)]
            wait([future for future in under_way if not future.cancel()])
        for start, _, (parameters, moments, squares, gradients) in parts(work, *model, sums, keep=True):
            models = (parameters, gradients, moments, squares)
            adam(device, adam_step, *models, readback=self.rasterizer.readback)
            noise(device, explore, parameters, start, self.rasterizer.readback, step.region)
        for inputs in views:
            for part, gradient in zip(inputs.parts, own[inputs.place], strict=True):
                part.update(gradient, self.rasterizer.readback)
        self._sent = None if adam_step.updates_sh_rest else model[0]
        return Losses(tuple(losses))

    def _sums_for(self, device: Device, parameters: AnyGaussians) -> AnyGaussians:
        """Return arrays for the sums of gradients. They contain zeros, as `adam` sets them to zero after each use."""
        count, coefficients, sums = parameters.count, parameters.coefficients, self._sums
        if sums is None or (sums.count, sums.coefficients) != (count, coefficients):
            del sums
            self._sums = None
            if isinstance(parameters, HostGaussians):
                self._sums = host_zeros(count, coefficients, parameters.rows)
            else:
                self._sums = allocate_gaussians(device, count, coefficients, zero=True)
            sums = self._sums
        return sums

    def _send(self, parameters: AnyGaussians) -> list[Future[None]]:
        """Begin to send the parameters to the further devices, without the higher SH bands if these are unchanged.
        Returns the transfers, for which the caller has to wait."""
        if not self.replicas:
            return []
        groups = [group for group in PARAMETER_GROUPS if group != "sh_rest" or self._sent is not parameters]
        values = {group: self._on_host(group, parameters) for group in groups}
        return [replica.thread.submit(replica.take, values, parameters.coefficients) for replica in self.replicas]

    def _on_host(self, group: str, parameters: AnyGaussians) -> NDArray[np.float32]:
        array = parameters[group]
        if not isinstance(array, DeviceArray):
            return array.values if isinstance(array, HostArray) else array.get()
        held = self._room.get(group)
        if held is None or held.shape != array.shape:
            held = self._room[group] = np.empty(array.shape, np.float32)
        array.read_into(held)
        return held

    def _view(
        self,
        model: tuple[AnyGaussians, AnyGaussians],
        inputs: ViewInputs,
        factor: float,
        step: _AddedView,
        probes: Callable[[ViewInputs, GradientStep], StepProbe],
    ) -> Loss:
        """Run the step of a view on the first device, and return its loss.

        model: parameters, and sums of gradients.
        probes: function that makes the view's `StepProbe` from the view's inputs and its step.
        """
        gradients = view_gradients(self.rasterizer.work, model[0])
        inputs = replace(inputs, photograph=self.photographs.bring(inputs.view, factor))
        return step.run(model, inputs, probes(inputs, step), gradients, reads_loss=True)

    def _take(
        self, parameters: AnyGaussians, sums: AnyGaussians, outcome: ViewOutcome, step: _AddedView, probe: StepProbe
    ) -> Loss:
        """Add the gradients of a view that a further device has computed to the sums, and the view's other results to
        the density statistics (`probe.after_rows`). Returns the view's loss.

        parameters: the model's parameters. If they are streamed, results are added for a part of the rows at a time.
        outcome: results of the view on the host. They pass through scratch arrays on the first device.
        """
        device, work = step.device, self.rasterizer.work
        probe.loss(outcome.loss)
        for start, stop, (_, part) in parts(work, parameters, sums, keep=True):
            rows = {name: _brought(work, device, name, values[start:stop]) for name, values in outcome.arrays.items()}
            arrays = {
                group: _brought(work, device, f"view_{group}", values[start:stop])
                for group, values in outcome.gradients.items()
            }
            gradients, counts = DeviceGaussians(part.count, part.coefficients, arrays), rows["tile_counts"]
            add_view(device, counts, gradients, part, sh_rest="sh_rest" in arrays)
            screen = Screen(rows.get("screen", counts), rows.get("contributions"))
            probe.after_rows(ViewRows(start, stop, Projected(rows.get("splats", counts), counts), screen))
        return outcome.loss


def _brought(work: Workspace, device: Device, name: str, values: NDArray[Any]) -> DeviceArray:
    """Copy `values` from the host to a scratch array `name` on the device. A device that shares main memory uses the
    values in place, so they must not change until the next step."""
    if device.shares_memory and values.size:
        return shared(device, values)
    array = work.array(name, values.shape, values.dtype.type)
    array.send(values)
    return array
