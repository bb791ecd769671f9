# SPDX-License-Identifier: Apache-2.0
"""Cameras of training views as they are refined with the model, and of held-out views, found for a model as it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.device.layout import PLAIN_SLOTS
from clsplat.images.alpha import background_colour
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.runs.appearance import Look
from clsplat.scenes.scene import Scene, View
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.stages.pose import LENS, POSE, lens_rows, pose_rows, sum_of, sums_of
from clsplat.training.gate import CameraGate, Drift, drift
from clsplat.training.lenses import RefinedLenses
from clsplat.training.photographs import kept_pixels
from clsplat.training.poses import Poses, descend, fallen
from clsplat.training.step import GradientStep, Sample, StepProbe, StepRows, view_gradients

MODELS = 4
"""Arrays for each parameter on the device: parameters, two moments, a view's gradients."""
ALIGNING, ALIGNED = 40, 1.0
"""Steps in which the pose of a held-out view is found, and degrees by which it can turn in them, about."""


@dataclass(eq=False)
class CameraSums:
    """The gradients by the pose and by the lens of a step's view, as far as they are wanted, of a model of `count`
    rows; `add` is given all of them, in order."""

    work: Workspace
    count: int
    pose: bool = True
    lens: bool = False
    _device: Device | None = field(default=None, init=False)
    _sums: dict[int, DeviceArray] = field(default_factory=dict, init=False)

    def room(self, rows: int) -> DeviceArray | None:
        """Room for what so many rows say of the lens, where that is wanted."""
        return self.work.array("by_lens", (rows, LENS)) if self.lens else None

    def add(self, rows: StepRows) -> None:
        """Add up the rows' parts. Kernels that come later are tried here, before anything changes."""
        assert rows.gradients is not None, "asked for where cameras are refined"
        counts = rows.projected.tile_counts
        if self._device is None:
            self._device = rows.device
            self._sums = {
                numbers: sums_of(self.work, self.count, numbers)
                for numbers in (POSE,) * self.pose + (LENS,) * self.lens
            }
            for sums in self._sums.values():
                with only_tried(rows.device):
                    sum_of(rows.device, self.work, sums)
        if self.pose:
            of_view = (rows.camera_array, counts, rows.gradients)
            pose_rows(rows.device, rows.parameters, *of_view, self._sums[POSE], rows.start)
        if rows.by_lens is not None:
            lens_rows(rows.device, counts, rows.by_lens, self._sums[LENS], rows.start)

    def _gradient(self, numbers: int) -> Float64:
        assert self._device is not None, "a model has rows"
        found: Float64 = sum_of(self._device, self.work, self._sums[numbers]).get()[0].astype(np.float64)
        return found

    def by_pose(self) -> Float64:
        """The gradient (6,) by the motion of `Camera.moved`; waits for the device."""
        return self._gradient(POSE)

    def by_lens(self) -> Float64:
        """The gradient (4,) by ln fx, ln fy, cx and cy; waits for the device."""
        return self._gradient(LENS)


class Cameras:
    """The cameras of the training views, whose poses and lenses change where they are refined, until their gate ends
    that. held_out: number of views that the gate goes by."""

    def __init__(self, config: TrainConfig, views: Sequence[View], extent: float, held_out: int = 0) -> None:
        self.poses, self.lenses = Poses(config, views, extent), RefinedLenses(config, views)
        self.gate = CameraGate(config, held_out)
        self._views, self._extent = views, extent

    def sums(self, work: Workspace, count: int, view: int, step: int) -> CameraSums | None:
        """Takes the gradients by what is refined of a view in this step, of a model of `count`; None where that is
        nothing."""
        if self.gate.ended is not None:
            return None
        pose, lens = self.poses.moves(view, step), self.lenses.moves(step)
        return CameraSums(work, count, pose, lens) if pose or lens else None

    def move(self, sample: Sample, step: int, sums: CameraSums) -> None:
        """Change the sample's camera by the gradients; waits for the device."""
        if sums.pose:
            self.poses.move(sample.view, step, sums.by_pose())
        if sums.lens:
            self.lenses.move(sample.view, step, sample.camera, sums.by_lens())

    def of(self, view: int) -> Camera:
        """A training view's camera; the same object where lenses are not refined, and its pose stays."""
        return self.lenses.seen(self._views[view].lens, self.poses.cameras[view])

    def drift(self) -> Drift | None:
        """The drift of the refined poses from those that were given; None where poses are not refined."""
        given = [view.camera for view in self._views]
        return drift(given, self.poses.cameras, self._extent) if self.poses.on else None

    def refined_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name, without the gate's."""
        return self.poses.arrays() | self.lenses.arrays()

    def go_back(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the cameras that `refined_arrays` had. Raises ValueError where they are of other views."""
        for part, name in ((self.poses, "poses/"), (self.lenses, "lenses/")):
            part.load({key.removeprefix(name): array for key, array in arrays.items() if key.startswith(name)})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        return self.refined_arrays() | self.gate.arrays()

    def load(
        self,
        poses: Mapping[str, NDArray[Any]],
        lenses: Mapping[str, NDArray[Any]],
        gate: Mapping[str, NDArray[Any]],
    ) -> None:
        """Take those arrays, by name without the part before the slash. Raises ValueError where they are of other
        views."""
        self.poses.load(poses)
        self.lenses.load(lenses)
        self.gate.load(gate, self.refined_arrays())


@dataclass(frozen=True, eq=False)
class _Look(GradientStep):
    """A step that changes nothing of the model."""

    def update(self, rows: StepRows) -> None:
        """Leave the rows as they are."""


class InTraining(Protocol):
    """A model in training, as far as this goes: a `Trainer`."""

    config: TrainConfig
    device: Device
    rasterizer: Rasterizer
    parameters: AnyGaussians
    scene: Scene

    def rates(self) -> dict[str, float]:
        """Learning rates at the step."""
        ...

    def local(self, camera: Camera) -> Camera:
        """A camera in the world as one for the model."""
        ...


def aligned(trainer: InTraining, view: View, look: Look) -> Camera:
    """The camera of a held-out view, moved from where it is to where the model fits its photograph best, whose look is
    taken from it. The model stays as it is: its world may have drifted."""
    config, rasterizer, model = replace(trainer.config, thinning=0.0), trainer.rasterizer, trainer.parameters
    photograph = np.ascontiguousarray(view.load_masked())
    white = np.ones((*photograph.shape[:2], 3), np.float32)
    if (factors := look(view.name, white)) is not white:
        photograph = np.concatenate([photograph[:, :, :3] / factors, photograph[:, :, 3:]], axis=2, dtype=np.float32)
    kept, background = kept_pixels(photograph), np.array(background_colour(config.background), np.float32)
    room, scale = view_gradients(rasterizer.work, model), np.repeat([1.0, trainer.scene.extent], 3)
    first, second = np.zeros(6), np.zeros((6, 6))
    camera = best = view.camera
    least = np.inf
    for step in range(1, ALIGNING + 1):
        sums = CameraSums(rasterizer.work, model.count)
        probe = _Look(trainer.device, rasterizer, config, 1, trainer.rates(), PLAIN_SLOTS, seen=sums)
        pixels = (photograph, trainer.local(camera), background)
        loss, _ = probe.run((model,), *pixels, StepProbe(), room, reads_loss=True, kept=kept).read()
        if loss < least:
            best, least = camera, loss
        by = sums.by_pose() * scale
        rate = fallen(np.radians(ALIGNED), step / ALIGNING, ALIGNING)
        camera = camera.moved(rate * scale * descend(first, second, by, step))
    return best
