# SPDX-License-Identifier: Apache-2.0
"""Further device of a training (--device A,B): it computes views of a batch, from parameters that the first device
sends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import SPLAT
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostArray,
    HostGaussians,
    allocate_gaussians,
    host_zeros,
)
from clsplat.stages.loss import Loss
from clsplat.training.step.gradient_step import GradientStep, StepProbe, view_gradients
from clsplat.training.step.inputs import PlacedChunks, StepRows, ViewInputs
from clsplat.training.supervision.image_cache import ImageCache


@dataclass(frozen=True, eq=False)
class ViewOutcome:
    """Results of a view that a further device computed, on the host until the next step.

    arrays: tile counts, splats, screen-space gradients and contributions of all Gaussians that the device got, by name.
    gradients: gradients of these Gaussians, by parameter group.
    own: gradients of the view's parts, such as its appearance; None for a part without parameters.
    """

    arrays: dict[str, NDArray[Any]]
    gradients: dict[str, NDArray[np.float32]]
    loss: Loss
    own: Sequence[NDArray[Any] | None] = ()

    @property
    def nbytes(self) -> int:
        """Number of bytes of the results of Gaussians."""
        return sum(array.nbytes for array in (*self.arrays.values(), *self.gradients.values()))


@dataclass(eq=False)
class _RemoteView(GradientStep):
    """Step of one view on a further device. It copies the view's results to the host, instead of taking Adam's step."""

    arrays: dict[str, NDArray[Any]]
    outcome: dict[str, NDArray[np.float32]]
    own: list[NDArray[Any] | None]

    def place(self, model: tuple[AnyGaussians, ...], inputs: ViewInputs) -> PlacedChunks | None:  # noqa: ARG002
        """Run over all rows that the device got."""
        return None

    def learn(self, inputs: ViewInputs, own: Sequence[DeviceArray | None]) -> None:  # noqa: ARG002
        """Copy the parts' gradients to the host, for Adam on the first device."""
        self.own.extend(None if gradient is None else gradient.get() for gradient in own)

    def update(self, rows: StepRows, inputs: ViewInputs) -> None:  # noqa: ARG002
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
    """Further device of a training, with a thread of its own, and a copy of the parameters that its view shows."""

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
        count, held = len(values["means"]), self.parameters
        if held is None or (held.count, held.coefficients) != (count, coefficients):
            held = self.parameters = None
            if self.plan.streamed:
                held = host_zeros(count, coefficients, self.plan.rows)
            else:
                held = allocate_gaussians(self.device, count, coefficients)
            self.parameters = held
        for group, array in values.items():
            held[group].set(array)

    def take_chunks(self, values: Mapping[str, NDArray[np.float32]], coefficients: int) -> None:
        """Upload the parameters of a view's chunks from the host, or stream them if the plan allows fewer rows.

        values: parameters by group, which must not change until the view is done.
        coefficients: number of SH coefficients of the model.
        """
        assert self.plan is not None, "planned before the first step"
        count, self.parameters = len(values["means"]), None
        if self.plan.streamed and count > self.plan.rows:
            streamed = {group: HostArray(array) for group, array in values.items()}
            self.parameters = HostGaussians(count, coefficients, streamed, self.plan.rows)
            return
        arrays = {group: self.rasterizer.work.array(f"chunks_{group}", each.shape) for group, each in values.items()}
        for group, array in arrays.items():
            array.set(values[group])
        self.parameters = DeviceGaussians(count, coefficients, arrays)

    def view_of_chunks(
        self, values: Mapping[str, NDArray[np.float32]], coefficients: int, view: Callable[[], ViewOutcome]
    ) -> ViewOutcome:
        """Upload the parameters of a view's chunks, and run the view. values, coefficients: as in `take_chunks`."""
        self.take_chunks(values, coefficients)
        return view()

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
        return reused(self._room, (place, name), shape, dtype)


def reused(
    room: dict[tuple[int, str], NDArray[Any]], key: tuple[int, str], shape: tuple[int, ...], dtype: type = np.float32
) -> NDArray[Any]:
    """Return an array of `shape` in main memory. The array of an earlier step with the same key is reused if it has
    enough rows, because fresh memory would take as much time as a copy."""
    held = room.get(key)
    if held is None or len(held) < shape[0] or held.shape[1:] != shape[1:]:
        held = room[key] = np.empty(shape, dtype)
    return held[: shape[0]]
