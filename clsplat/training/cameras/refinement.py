# SPDX-License-Identifier: Apache-2.0
"""Camera refinement: gradients with respect to poses and lenses, and validation of cameras on held-out views.

The step after which cameras are refined: `first_step` in `training/cameras/poses.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.errors import InputError, warn
from clsplat.evaluation import metrics
from clsplat.images.alpha import background_colour, composite
from clsplat.runs.appearance import Look
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene, View, spread
from clsplat.stages.pose import LENS_NUMBERS, POSE_NUMBERS, lens_rows, pose_rows, sum_of, sums_of
from clsplat.training.cameras.export import keep_cameras
from clsplat.training.cameras.intrinsics import RefinedLenses
from clsplat.training.cameras.poses import Poses
from clsplat.training.cameras.validation_gate import MAX_GATE_VIEWS, CameraGate, Drift, drift
from clsplat.training.step.component import Component, Named
from clsplat.training.step.inputs import StepRows, ViewInputs, ViewPart
from clsplat.training.supervision.decoding import Decoder
from clsplat.training.supervision.host_photographs import HostPhotographs
from clsplat.training.supervision.image_cache import ImageCache

REFINEMENT_ARRAYS_PER_PARAMETER = 4
"""Number of arrays on the device for each parameter of the model: the parameter, two moments, and a view's gradient."""


def check_refinable(config: TrainConfig, views: Sequence[View]) -> None:
    """Raise InputError if the settings refine cameras of too few views, or lenses other than pinholes."""
    if config.refine_poses and len(views) < 3:
        raise InputError(f"--refine-poses: {len(views)} training views, expected 3 or more, as two poses stay fixed")
    for view in views if config.refine_lenses else ():
        if not view.lens.is_pinhole or not view.camera.model.flat:
            raise InputError(
                f"--refine-lenses: the lens of {view.name} is {view.lens.model}, with distortion; expected "
                "photographs without distortion, as `clsplat sfm` and COLMAP's image_undistorter write them"
            )


@dataclass(eq=False)
class CameraSums(ViewPart):
    """Gradients with respect to the pose and the lens of a view, summed over the `count` Gaussians of the model.

    The step calls `add_rows` for all rows of the model, in order.
    pose, lens: True to sum the gradient with respect to the pose, and to the lens.
    move: function that changes the camera after Adam has changed the Gaussians. Its argument is this object.
    """

    wants_gradients = True

    work: Workspace
    count: int
    pose: bool = True
    lens: bool = False
    move: Callable[[CameraSums], None] | None = None
    _device: Device | None = field(default=None, init=False)
    _sums: dict[int, DeviceArray] = field(default_factory=dict, init=False)

    def lens_gradients(self, rows: int) -> DeviceArray | None:
        """Array (rows, 4) for each Gaussian's gradient with respect to the lens; None if lenses are not refined."""
        return self.work.array("by_lens", (rows, LENS_NUMBERS)) if self.lens else None

    def add_rows(self, rows: StepRows) -> None:
        """Add the gradients of these rows to the sums. At the first rows of a view, the sandbox tries the kernels that
        read the sums, before the model changes."""
        assert rows.gradients is not None, "asked for where cameras are refined"
        counts = rows.projected.tile_counts
        if self._device is None:
            self._device = rows.device
            self._sums = {
                numbers: sums_of(self.work, self.count, numbers)
                for numbers in (POSE_NUMBERS,) * self.pose + (LENS_NUMBERS,) * self.lens
            }
            for sums in self._sums.values():
                with only_tried(rows.device):
                    sum_of(rows.device, self.work, sums)
        if self.pose:
            of_view = (rows.camera_array, counts, rows.gradients)
            pose_rows(rows.device, rows.parameters, *of_view, self._sums[POSE_NUMBERS], rows.start)
        if rows.by_lens is not None:
            lens_rows(rows.device, counts, rows.by_lens, self._sums[LENS_NUMBERS], rows.start)

    def update(self, own: DeviceArray | None, readback: DeviceArray) -> None:  # noqa: ARG002
        """Take the optimiser's step for the camera (`move`). Waits for the device."""
        if self.move is not None:
            self.move(self)

    def _gradient(self, numbers: int) -> Float64:
        assert self._device is not None, "a model has rows"
        found: Float64 = sum_of(self._device, self.work, self._sums[numbers]).get()[0].astype(np.float64)
        return found

    def by_pose(self) -> Float64:
        """Gradient (6,) with respect to the rotation and translation of `Camera.moved`; waits for the device."""
        return self._gradient(POSE_NUMBERS)

    def by_lens(self) -> Float64:
        """Gradient (4,) with respect to ln fx, ln fy, cx and cy; waits for the device."""
        return self._gradient(LENS_NUMBERS)


Draw = Callable[[Camera], NDArray[Any]]
"""Function that renders an image (H, W, 3), over the background of evaluations, with a camera in world coordinates."""


class ValidationViews:
    """At most MAX_GATE_VIEWS held-out views, by which the gate judges refined cameras. Their pixels are decoded
    once."""

    def __init__(self, scene: Scene, device: Device, config: TrainConfig) -> None:
        self.views = spread(scene.test_views, MAX_GATE_VIEWS)
        self._photographs = ImageCache(device, HostPhotographs(Decoder(self.views)))
        self._background = background_colour(config.background)
        self._measure = metrics.psnr if config.appearance == "none" else metrics.psnr_corrected

    def psnr(self, draw: Draw, look: Look, cameras: Sequence[Camera]) -> float:
        """Mean PSNR in dB of the views; 0 if no photograph counts. A photograph counts if its mask keeps a pixel.

        If appearance is learnt, the render's colours are fitted to the photograph before the comparison.

        draw: function that renders with a camera (`Draw`).
        look: function of a view's name and a render. It gives the render the view's appearance, if that is known.
        cameras: a camera for each view, to render with.
        """
        found = []
        for index, camera in enumerate(cameras):
            pixels, counts = self._photographs.load(index, 1.0), None
            if pixels.shape[2] == 5:
                pixels, counts = pixels[:, :, :4], pixels[:, :, 4] > 0
                if not counts.any():
                    continue
            image = look(self.views[index].name, np.nan_to_num(draw(camera)))
            found.append(self._measure(image, composite(pixels, self._background), counts))
        return float(np.mean(found)) if found else 0.0


class Cameras(Component):
    """Cameras of the training views. Refined poses and lenses change until the validation gate ends the refinement.

    work: scratch arrays, for sums over the model's rows.
    """

    def __init__(self, config: TrainConfig, scene: Scene, work: Workspace) -> None:
        views, length_unit = scene.train_views, scene.length_unit
        check_refinable(config, views)
        self.poses, self.lenses = Poses(config, views, length_unit), RefinedLenses(config, views)
        self.gate = CameraGate(config, len(scene.test_views))
        self._config, self._scene, self._views, self._work = config, scene, views, work

    @property
    def on(self) -> bool:
        """True if cameras are refined."""
        return self._config.refines

    @property
    def models(self) -> int:
        """Number of arrays on the device for each parameter if cameras are refined, else 0 (see `Component.models`)."""
        return REFINEMENT_ARRAYS_PER_PARAMETER if self._config.refines else 0

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian on the device, for gradients with respect to the lens."""
        return 4 * LENS_NUMBERS * self._config.refine_lenses

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:
        """Return the views. Each view whose pose or lens this step refines has a `CameraSums` among its parts.

        step, count: number of the step's last view, and number of Gaussians.
        """
        if self.gate.ended is not None or not self._config.refines:
            return inputs
        return [self._joined(each, step, count) for each in inputs]

    def _joined(self, inputs: ViewInputs, step: int, count: int) -> ViewInputs:
        pose, lens = self.poses.moves(inputs.view, step), self.lenses.moves(step)
        if not (pose or lens):
            return inputs
        sums = CameraSums(self._work, count, pose, lens, partial(self._move, inputs, step))
        return replace(inputs, parts=(*inputs.parts, sums))

    def _move(self, inputs: ViewInputs, step: int, sums: CameraSums) -> None:
        """Take the optimiser's step for the view's pose and lens. Waits for the device."""
        if sums.pose:
            self.poses.move(inputs.view, step, sums.by_pose())
        if sums.lens:
            self.lenses.move(inputs.view, step, inputs.camera, sums.by_lens())

    def of(self, view: int) -> Camera:
        """Refined camera of training view `view`; the same object while neither its pose nor its lens changes."""
        camera = self.poses.cameras[view]
        return self.lenses.seen(self._views[view].lens, camera) if self._config.refine_lenses else camera

    def drift(self) -> Drift | None:
        """Drift of the refined poses from the given ones; None if poses are not refined."""
        given = [view.camera for view in self._views]
        return drift(given, self.poses.cameras, self._scene.length_unit) if self.poses.on else None

    def validate(self, views: ValidationViews, step: int, draw: Draw, look: Look) -> None:
        """Measure the PSNR of held-out views with the refined cameras. If the gate rejects the cameras, warn and go
        back to earlier cameras.

        Held-out views are measured twice, with their given poses, and with these poses moved by the drift of the
        refined poses. The better result counts. The given poses are right if only some training poses were wrong, and
        the moved poses are right if the whole world has drifted.

        draw: function that renders with a camera (`Draw`).
        look: function of a view's name and a render, which gives the render the view's appearance if that is known.
        """
        seen = [self.lenses.seen(view.lens, view.camera) for view in views.views]
        psnr = views.psnr(draw, look, seen)
        if (moved := self.drift()) is not None:
            psnr = max(psnr, views.psnr(draw, look, [moved.taken_along(camera) for camera in seen]))
        best, warning = self.gate.validate(step, psnr, self.refined_arrays())
        if best is not None:
            self.go_back(best)
        if warning:
            warn(warning)

    def refined_arrays(self) -> dict[str, NDArray[Any]]:
        """Refined poses and lenses, keyed by their names in a checkpoint."""
        return self.poses.arrays() | self.lenses.arrays()

    def go_back(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore poses and lenses from arrays of `refined_arrays`. Raises ValueError for arrays of other views."""
        for part, name in ((self.poses, "poses/"), (self.lenses, "lenses/")):
            part.load({key.removeprefix(name): array for key, array in arrays.items() if key.startswith(name)})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Refined cameras and the gate's measurements, keyed by their names in a checkpoint."""
        return self.refined_arrays() | self.gate.arrays()

    def load(self, named: Named, step: int, count: int) -> None:  # noqa: ARG002
        """Load refined cameras and the gate's measurements. Raises ValueError for a checkpoint of other views.

        named: function from a prefix to the checkpoint's arrays whose names have this prefix.
        step, count: step and number of Gaussians of the checkpoint; not used.
        """
        self.poses.load(named("poses/"))
        self.lenses.load(named("lenses/"))
        self.gate.load(named("gate/"), self.refined_arrays())

    def write(self, run: Run) -> None:
        """Write the refined cameras into the run's folder, if cameras are refined."""
        if self._config.refines:
            keep_cameras(run, self._scene, self.poses, self.lenses, self.drift())
