# SPDX-License-Identifier: Apache-2.0
"""The gradient of one view and Adam's step along it: what a training step does, and what `repro` repeats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol, TypeVar
from weakref import ref

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.exploring import Exploration
from clsplat.config.thinning import thinning_of
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.layout import SlotFields
from clsplat.gaussians import group_shapes
from clsplat.rendering.rasterizer import Frame, Rasterizer, Room
from clsplat.stages.adam import adam, updates_sh_rest
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostGaussians, parts
from clsplat.stages.loss import DepthAims, Loss, loss
from clsplat.stages.noise import noise
from clsplat.stages.project import Projected, Screen, Slots, project_grad, project_step, step_numbers
from clsplat.stages.target import target
from clsplat.training.appearance import ViewAppearance
from clsplat.training.density import StatisticsNeeds

R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Sample:
    """A view of a step: its index, photograph (H, W, 3 to 5), camera of that size, background; begins: with it a pass
    through all views begins; kept: pixels that its mask leaves, None without one; depth: its known depths."""

    view: int
    photograph: NDArray[Any] | DeviceArray
    camera: Camera
    background: NDArray[np.float32]
    begins: bool
    kept: int | None = None
    depth: DepthAims | None = None

    @property
    def known(self) -> dict[str, Any]:
        """Those that `GradientStep.run` takes by name."""
        return {"kept": self.kept, "depth": self.depth}


@dataclass(frozen=True, eq=False)
class ViewRows:
    """Rows of the model that are on the device at once, from start to before stop; all of them if the model fits.

    projected: what the step's view shows of these rows; screen: the gradients on its screen, from where the rows have
    changed on.
    """

    start: int
    stop: int
    projected: Projected
    screen: Screen


@dataclass(frozen=True, eq=False)
class StepRows(ViewRows):
    """The same with all that a step has of them: model: their parameters, and their moments or whatever else the step
    changes; device: with the switches of the view's projection; camera_array, slots: the step's view, and the gradients
    of their pairs; gradients: the rows' own, where they are asked for; by_lens (rows, 4): those by the view's lens."""

    model: tuple[DeviceGaussians, ...]
    device: Device
    camera_array: DeviceArray
    slots: Slots
    gradients: DeviceGaussians | None
    by_lens: DeviceArray | None = None

    @property
    def parameters(self) -> DeviceGaussians:
        """Their parameters."""
        return self.model[0]

    @property
    def first(self) -> DeviceGaussians:
        """Adam's first moments."""
        return self.model[1]


class CameraLook(Protocol):
    """Takes what the rows of a step's view say of its camera."""

    def room(self, rows: int) -> DeviceArray | None:
        """Room for what so many rows say of the lens, if that is wanted."""
        ...

    def add(self, rows: StepRows) -> None:
        """Add these rows, before they change."""


class StepProbe:
    """A look into a step. Each method is called when the kernels of its stage are launched; here none does anything."""

    def forward(self, frame: Frame) -> None:
        """The view is rendered."""

    def loss(self, result: Loss) -> None:
        """The render is compared with the photograph."""

    def pair_gradients(self, slots: Slots) -> None:
        """The gradient of blending is known."""

    def before_rows(self, rows: StepRows) -> None:
        """Adam is about to change these rows."""

    def after_rows(self, rows: ViewRows) -> None:
        """Adam has changed these rows."""


@dataclass(frozen=True, eq=False)
class GradientStep:
    """Forward, loss, backward and Adam of one view, on a device and in the memory of a rasterizer.

    fields: the fields of a slot that the step fills; turn: of `loss`; room: of `Rasterizer.forward`; explore: what the
    step does beside following the gradient of the loss; appearance: of the view's photograph, where it is learnt;
    seen: takes the gradient by the view's camera, where there is room for the gradients.
    """

    device: Device
    rasterizer: Rasterizer
    config: TrainConfig
    step: int
    rates: Mapping[str, float]
    fields: SlotFields
    _: KW_ONLY
    turn: int = 0
    room: Room | None = None
    explore: Exploration | None = None
    appearance: ViewAppearance | None = None
    seen: CameraLook | None = None

    def run(
        self,
        model: tuple[AnyGaussians, ...],
        photograph: NDArray[Any] | DeviceArray,
        camera: Camera,
        background: NDArray[np.float32],
        probe: StepProbe,
        gradients: DeviceGaussians | None = None,
        *,
        reads_loss: bool = False,
        kept: int | None = None,
        depth: DepthAims | None = None,
    ) -> Loss:
        """Update the model (parameters, first and second moments) by a photograph (H, W, 3 to 5) of the camera's size.

        gradients: room for those of the rows that are on the device at once, zeros before and after, for a probe that
        looks at them; the bits of the model are the same without; reads_loss: the loss will be read; kept: pixels that
        the photograph's mask, its fifth channel, leaves; depth: what the render's depths are compared with, where the
        step's fields have nearness.
        """
        device, rasterizer, work = self.device, self.rasterizer, self.rasterizer.work
        of_pass: dict[str, Any] = {"thinning": thinning_of(self.config, self.step), "nearness": self.fields.nearness}
        frame = rasterizer.forward(model[0], camera, background, room=self.room, **of_pass)
        probe.forward(frame)
        alpha_weight = self.config.alpha_loss if photograph.shape[2] > 3 else 0.0
        planes = target(device, work, photograph, frame.background, frame.blended, alpha=alpha_weight > 0)
        size, weight, appearance = (camera.width, camera.height), self.config.dssim_weight, self.appearance
        image = frame.blended.image
        if appearance is not None:
            image = appearance.share_colours(work, image, planes, *size)
        settings: dict[str, Any] = {"kept": kept, "alpha_weight": alpha_weight, "depth": depth}

        def compared() -> Loss:
            return loss(device, work, image, planes, *size, weight, self.turn, blended=frame.blended, **settings)

        if depth is None:
            key = (frame.part, image.buffer, kept, alpha_weight, self.turn)
            result = self.replayed(model[0], key, compared)
        else:  # known depths are sent
            result = compared()
        if reads_loss:
            result = result.fetched()
        probe.loss(result)
        if appearance is not None:
            columns = appearance.gradient(work, frame.blended.image, result.gradient, *size)
        slots = self.replayed(
            model[0],
            (frame.part, frame.background, result.gradient, self.fields),
            lambda: rasterizer.pair_gradients(frame, result.gradient, fields=self.fields),
        )
        probe.pair_gradients(slots)
        for start, stop, part in parts(work, *model, keep=True):
            projected, row_slots = frame.projected.rows(start, stop), slots.rows(start, stop)
            screen = rasterizer.screen(stop - start, self.fields)
            of_view = (rasterizer.device_of(camera), frame.camera_array, row_slots)
            by_lens = None if self.seen is None else self.seen.room(stop - start)
            rows = StepRows(start, stop, projected, screen, part, *of_view, gradients, by_lens)
            if gradients is not None:
                sh_rest = updates_sh_rest(self.config.optimiser, self.step)
                arrays = (part[0], frame.camera_array, projected, row_slots, gradients, screen)
                asked: dict[str, Any] = {"sh_rest": sh_rest, "explore": self.explore, "by_lens": by_lens}
                project_grad(rows.device, *arrays, fields=self.fields, **asked)
                if self.seen is not None:
                    self.seen.add(rows)
            probe.before_rows(rows)
            self.update(rows)
            probe.after_rows(rows)
        if appearance is not None:
            self.learn(appearance, columns)
        return result

    def replayed(
        self, of: object, key: tuple[object, ...], make: Callable[[], R], numbers: tuple[float, ...] = ()
    ) -> R:
        """`Workspace.replayed` in a step by capacity. One with exact counts has new arrays each time, and a tape of it
        would never be used again."""
        if self.room is None:
            return make()
        return self.rasterizer.work.replayed(of, key, make, numbers)

    def learn(self, appearance: ViewAppearance, columns: DeviceArray) -> None:
        """Adam's step of the view's appearance."""
        appearance.update(columns, self.rasterizer.readback)

    def update(self, rows: StepRows) -> None:
        """Adam's step of some rows, with the gradient of projection where that is not known yet."""
        optimiser, readback = self.config.optimiser, self.rasterizer.readback
        if rows.gradients is not None:
            parameters, first, second = rows.model
            models = (parameters, rows.gradients, first, second)
            adam(self.device, self.step, self.rates, optimiser, *models, rows.projected.tile_counts, readback)
        else:
            view = (rows.camera_array, rows.projected, rows.slots, rows.screen, readback)
            arguments = (rows.device, self.step, self.rates, optimiser, rows.model, *view)
            fields, explore = self.fields, self.explore
            arrays = (*vars(rows.slots).values(), *vars(rows.screen).values())
            key = (*map(ref, rows.model), rows.projected, *arrays, updates_sh_rest(optimiser, self.step))
            penalised = explore is not None and explore.penalised
            self.replayed(
                rows.parameters,
                (*key, rows.device, rows.camera_array, fields, penalised),
                lambda: project_step(*arguments, fields=fields, explore=explore),
                step_numbers(optimiser, self.step, self.rates, explore),
            )
        if self.explore is not None:
            noise(self.device, self.explore, rows.parameters, rows.start, readback)


def view_gradients(work: Workspace, parameters: AnyGaussians, *, zero: bool = False) -> DeviceGaussians:
    """Room for a view's gradients of the rows that are on the device at once; zero: as `GradientStep.run` wants it."""
    rows = min(parameters.rows, parameters.count) if isinstance(parameters, HostGaussians) else parameters.count
    shapes = group_shapes(rows, parameters.coefficients)
    arrays = {group: work.array(f"view_{group}", shape) for group, shape in shapes.items()}
    for array in arrays.values() if zero else ():
        array.fill(0.0)
    return DeviceGaussians(rows, parameters.coefficients, arrays)


def slot_fields(needs: StatisticsNeeds, *, nearness: bool = False) -> SlotFields:
    """The fields of a slot that these statistics need; nearness: depths are compared."""
    return SlotFields(needs.absolute, needs.contributions, nearness)
