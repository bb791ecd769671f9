# SPDX-License-Identifier: Apache-2.0
"""A training step of several views (--batch), on one device or several: gradients are summed, then Adam steps once.

The first device has the model. Each further device has a thread, gets the parameters that its views show, and returns
the results of its views. Of a large model these are chunks of Gaussians, otherwise all Gaussians. Gradients are summed
in the order of the views, so neither the speed nor the number of devices changes a bit of the result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, shared, upload
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.optimisation.step_noise import Exploration
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.adam import adam, add_view
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostArray,
    HostGaussians,
    host_zeros,
    parts,
)
from clsplat.stages.loss import Loss
from clsplat.stages.noise import noise
from clsplat.stages.project import Projected, Screen
from clsplat.training.batches.batch_chunks import BatchChunks, GradientSums
from clsplat.training.batches.replica import Replica, ViewOutcome, reused
from clsplat.training.learning_rates import scaled, scaled_rates
from clsplat.training.step.gradient_step import GradientStep, StepProbe, view_gradients
from clsplat.training.step.inputs import PlacedChunks, StepRows, ViewInputs, ViewRows
from clsplat.training.supervision.image_cache import ImageCache

OWNER_ARRAYS_PER_PARAMETER, REPLICA_ARRAYS_PER_PARAMETER = 5, 2
"""Number of arrays for each parameter of the model, on the first device and on each further device.

The first has the parameter, two moments, a view's gradient and the sum of gradients; a further device the parameter and
a view's gradient.
"""


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

    The `model` that it runs on consists of the parameters and the batch's sums of gradients, without moments; in a step
    over chunks, of the parameters alone.

    own: gradients of each view's parts (`ViewPart`), by the view's position in the batch.
    noise: noise that the batch adds after its last view.
    chunks: the chunks that the batch's views show; None if the step runs over the whole model.
    """

    own: dict[int, Sequence[DeviceArray | None]]
    noise: Exploration
    _: KW_ONLY
    chunks: BatchChunks | None = None

    def place(self, model: tuple[AnyGaussians, ...], inputs: ViewInputs) -> PlacedChunks | None:
        """Send the list of the view's chunks, which the batch has prepared."""
        return None if self.chunks is None or inputs.chunks is None else inputs.chunks.place(model)

    def learn(self, inputs: ViewInputs, own: Sequence[DeviceArray | None]) -> None:
        """Keep the gradients of the view's parts until the batch ends, as all its views use the same parameters."""
        self.own[inputs.place] = own

    def update(self, rows: StepRows, inputs: ViewInputs) -> None:
        """Add the rows' gradients to the sums. In a sandbox trial, also try the kernels that follow the last view."""
        assert rows.gradients is not None, "the batch asks for them"
        parameters, step, chunks = rows.parameters, self.adam_step, self.chunks
        sums = rows.model[1] if chunks is None else chunks.sums
        places = None if chunks is None else chunks.places(inputs, rows.start, rows.stop)
        counts, sh_rest = rows.projected.tile_counts, step.updates_sh_rest
        add_view(self.device, counts, rows.gradients, sums, sh_rest=sh_rest, places=places)
        if self.device.only_tries:
            models = (parameters, rows.gradients, parameters, parameters)
            adam(self.device, step, *models, readback=self.rasterizer.readback, chunks=rows.projected.chunks)
            noise(self.device, self.noise, parameters, rows.start, self.rasterizer.readback, self.region)


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
        self._sums = GradientSums()
        self._streamed_sums: HostGaussians | None = None
        self._sent: AnyGaussians | None = None
        self._room: dict[tuple[int, str], NDArray[Any]] = {}
        self.moved_bytes = 0
        """Bytes of Gaussians that have moved between the devices so far, in both directions."""

    def follow(self, plans: Sequence[Plan]) -> None:
        """Use at most the device memory that `plans` allow: a plan for each further device. Frees arrays of earlier
        plans."""
        self._sent = self._streamed_sums = None
        self._sums.free()
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
        settings = self._settings(step)
        adam_step = settings.adam_step
        chunks = BatchChunks.begin(self.rasterizer.work, step.device, model, views, adam_step, self._sums)
        added = replace(settings, chunks=chunks)
        own, sums = added.own, self._sums_for(step.device, model[0]) if chunks is None else None
        first, *others = shares(len(views), 1 + len(self.replicas))
        transfers = self._send(model[0]) if chunks is None else []
        pending: list[tuple[int, Future[ViewOutcome]]] = []
        try:
            for replica, share in zip(self.replicas, others, strict=True):
                for place, index in enumerate(share):
                    values = [part.values() for part in views[index].parts]
                    view: Callable[[], ViewOutcome]
                    view = partial(replica.view, place, views[index], factor, added, values, splats=statistics)
                    if chunks is not None:
                        view = self._with_chunks(replica, chunks, views[index], view)
                    pending.append((index, replica.thread.submit(view)))
            losses = [self._view((model[0], sums), views[index], factor, added, probes) for index in first]
            for transfer in transfers:
                transfer.result()
            for index, future in pending:
                outcome = future.result()
                losses.append(self._take((model[0], sums), views[index], outcome, added, probes(views[index], added)))
                own[index] = [None if each is None else upload(step.device, each) for each in outcome.own]
        finally:  # after an error, no thread may still be working on this batch
            under_way: list[Future[Any]] = [*transfers, *(future for _, future in pending)]
            wait([future for future in under_way if not future.cancel()])
        self._take_adam_step(added, model, sums)
        for inputs in views:
            for part, gradient in zip(inputs.parts, own[inputs.place], strict=True):
                part.update(gradient, self.rasterizer.readback)
        self._sent = None if adam_step.updates_sh_rest or chunks is not None else model[0]
        return Losses(tuple(losses))

    def _settings(self, step: GradientStep) -> _AddedView:
        """Return the step of each view of a batch. step: settings of the batch, whose step number counts views."""
        batch = self.config.batch
        config = replace(self.config, optimiser=scaled(self.config.optimiser, batch))
        number, rates, explore = -(-step.step // batch), scaled_rates(step.rates, batch), step.explore
        own: dict[int, Sequence[DeviceArray | None]] = {}
        of = (step.device, self.rasterizer, config, number, rates, step.fields, own, explore.scaled(sqrt(batch)))
        return _AddedView(*of, explore=explore.of_view(), region=step.region)

    def _take_adam_step(
        self,
        step: _AddedView,
        model: tuple[AnyGaussians, AnyGaussians, AnyGaussians],
        sums: AnyGaussians | None,
    ) -> None:
        """Take Adam's step with the sums of gradients. sums: None in a step over chunks, which has its own sums."""
        device, of, readback = step.device, step.adam_step, self.rasterizer.readback
        if step.chunks is not None:
            for (parameters, first, second), gradients, listed in step.chunks.for_adam():
                adam(device, of, parameters, gradients, first, second, readback=readback, chunks=listed)
            return
        assert sums is not None, "a step over the whole model"
        for start, _, (parameters, first, second, gradients) in parts(self.rasterizer.work, *model, sums, keep=True):
            adam(device, of, parameters, gradients, first, second, readback=readback)
            noise(device, step.noise, parameters, start, readback, step.region)

    def _with_chunks(
        self, replica: Replica, chunks: BatchChunks, inputs: ViewInputs, view: Callable[[], ViewOutcome]
    ) -> Callable[[], ViewOutcome]:
        """Return a function that sends the parameters of a view's chunks to a further device, and runs `view` there."""

        def room(group: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
            return reused(self._room, (inputs.place, group), shape)

        values = chunks.parameters(inputs, room)
        self.moved_bytes += sum(array.nbytes for array in values.values())
        return partial(replica.view_of_chunks, values, chunks.sums.coefficients, view)

    def _sums_for(self, device: Device, parameters: AnyGaussians) -> AnyGaussians:
        """Return sums of gradients for a step over the whole model. They contain zeros, as `adam` sets them to zero."""
        count, coefficients, held = parameters.count, parameters.coefficients, self._streamed_sums
        if not isinstance(parameters, HostGaussians):
            return self._sums.take(device, count, coefficients)
        if held is None or (held.count, held.coefficients) != (count, coefficients):
            del held
            self._streamed_sums = None
            held = self._streamed_sums = host_zeros(count, coefficients, parameters.rows)
        return held

    def _send(self, parameters: AnyGaussians) -> list[Future[None]]:
        """Begin to send the parameters to the further devices, without the higher SH bands if these are unchanged.
        Returns the transfers, for which the caller has to wait."""
        if not self.replicas:
            return []
        groups = [group for group in PARAMETER_GROUPS if group != "sh_rest" or self._sent is not parameters]
        values = {group: self._on_host(group, parameters) for group in groups}
        self.moved_bytes += len(self.replicas) * sum(array.nbytes for array in values.values())
        return [replica.thread.submit(replica.take, values, parameters.coefficients) for replica in self.replicas]

    def _on_host(self, group: str, parameters: AnyGaussians) -> NDArray[np.float32]:
        array = parameters[group]
        if not isinstance(array, DeviceArray):
            return array.values if isinstance(array, HostArray) else array.get()
        held = reused(self._room, (0, group), array.shape)
        array.read_into(held)
        return held

    def _view(
        self,
        model: tuple[AnyGaussians, AnyGaussians | None],
        inputs: ViewInputs,
        factor: float,
        step: _AddedView,
        probes: Callable[[ViewInputs, GradientStep], StepProbe],
    ) -> Loss:
        """Run the step of a view on the first device, and return its loss.

        model: parameters, and sums of gradients; no sums in a step over chunks, which has its own.
        probes: function that makes the view's `StepProbe` from the view's inputs and its step.
        """
        rows = None if step.chunks is None else step.chunks.gradient_rows(inputs)
        gradients = view_gradients(self.rasterizer.work, model[0], rows)
        inputs = replace(inputs, photograph=self.photographs.bring(inputs.view, factor))
        given = tuple(each for each in model if each is not None)
        return step.run(given, inputs, probes(inputs, step), gradients, reads_loss=True)

    def _take(
        self,
        model: tuple[AnyGaussians, AnyGaussians | None],
        inputs: ViewInputs,
        outcome: ViewOutcome,
        step: _AddedView,
        probe: StepProbe,
    ) -> Loss:
        """Add the gradients of a view that a further device has computed to the sums, and the view's other results to
        the density statistics (`probe.after_rows`). Returns the view's loss.

        model: as in `_view`. If the model is streamed, results are added for a part of the rows at a time.
        outcome: results of the view on the host. They pass through scratch arrays on the first device.
        """
        self.moved_bytes += outcome.nbytes
        probe.loss(outcome.loss)
        chunks, add = step.chunks, partial(self._add_rows, outcome, step, probe)
        if chunks is None:
            assert model[1] is not None, "a step over the whole model"
            for start, stop, (_, part) in parts(self.rasterizer.work, model[0], model[1], keep=True):
                add(start, stop, part)
            return outcome.loss
        for start, stop, listed in chunks.of_view(inputs, len(outcome.arrays["tile_counts"])):
            add(start, stop, chunks.sums, chunks.places(inputs, start, stop), listed)
        return outcome.loss

    def _add_rows(
        self,
        outcome: ViewOutcome,
        step: _AddedView,
        probe: StepProbe,
        start: int,
        stop: int,
        sums: DeviceGaussians,
        places: ChunkList | None = None,
        listed: ChunkList | None = None,
    ) -> None:
        """Add the rows [start, stop) of a view's results to the sums and the statistics.

        places: for each chunk of the rows its place in `sums`; listed: the chunks themselves. Both are None in a step
            over the whole model.
        """
        device, brought = step.device, partial(_brought, self.rasterizer.work, step.device)
        rows = {name: brought(name, values[start:stop]) for name, values in outcome.arrays.items()}
        arrays = {group: brought(f"view_{group}", values[start:stop]) for group, values in outcome.gradients.items()}
        gradients, counts = DeviceGaussians(stop - start, sums.coefficients, arrays), rows["tile_counts"]
        add_view(device, counts, gradients, sums, sh_rest="sh_rest" in arrays, places=places)
        projected = Projected(rows.get("splats", counts), counts, chunks=listed)
        screen = Screen(rows.get("screen", counts), rows.get("contributions"))
        probe.after_rows(ViewRows(start, stop, projected, screen))


def _brought(work: Workspace, device: Device, name: str, values: NDArray[Any]) -> DeviceArray:
    """Copy `values` from the host to a scratch array `name` on the device. A device that shares main memory uses the
    values in place, so they must not change until the next step."""
    if device.shares_memory and values.size:
        return shared(device, values)
    array = work.array(name, values.shape, values.dtype.type)
    array.send(values)
    return array
