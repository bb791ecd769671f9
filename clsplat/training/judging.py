# SPDX-License-Identifier: Apache-2.0
"""Held-out photographs, rendered to judge the refined cameras of a training by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import warn
from clsplat.evaluation import metrics
from clsplat.images.alpha import background_colour, composite
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.rendering.renderer import Renderer
from clsplat.runs.appearance import held_out_looks
from clsplat.scenes.scene import Scene, View
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.training.appearance import Appearance
from clsplat.training.cameras import Cameras
from clsplat.training.gate import spread
from clsplat.training.photographs import Photographs


class InTraining(Protocol):
    """A model in training, as far as this goes: a `Trainer`."""

    config: TrainConfig
    device: Device
    rasterizer: Rasterizer
    parameters: AnyGaussians
    cameras: Cameras
    appearance: Appearance
    judges: Judges
    step: int

    def settle(self) -> None:
        """Wait until all steps are known to have been made."""
        ...

    def local(self, camera: Camera) -> Camera:
        """A camera in the world as one for the model."""
        ...


class Judges:
    """The held-out views that cameras are judged by, at most `gate.VIEWS` of them; their pixels are decoded once."""

    def __init__(self, scene: Scene, device: Device) -> None:
        held_out = scene.test_views
        self.views: list[View] = [held_out[index] for index in spread(len(held_out))]
        self._photographs = Photographs(self.views, device)

    def psnr(self, trainer: InTraining, cameras: Sequence[Camera]) -> float:
        """Mean PSNR in dB of the views through these cameras, with what is known of their looks and after the fit of
        their colours where appearance is learnt. A photograph that its mask leaves nothing of does not count; 0 where
        none does."""
        config, background = trainer.config, background_colour(trainer.config.background)
        measure = metrics.psnr if config.appearance == "none" else metrics.psnr_corrected
        look = held_out_looks(trainer.appearance.record())
        renderer, found = Renderer(trainer.device, trainer.rasterizer), []
        for index, camera in enumerate(cameras):
            pixels, counts = self._photographs.load(index, 1.0), None
            if pixels.shape[2] == 5:
                pixels, counts = pixels[:, :, :4], pixels[:, :, 4] > 0
                if not counts.any():
                    continue
            image = renderer.render(trainer.parameters, trainer.local(camera), background).image
            image = look(self.views[index].name, np.nan_to_num(image))
            found.append(measure(image, composite(pixels, background), counts))
        return float(np.mean(found)) if found else 0.0


def judge(trainer: InTraining) -> bool:
    """Measure the held-out views with the refined cameras, if that is due, and go back to earlier cameras if the gate
    says so, with a warning. True if they were measured.

    Poses of held-out views are as given, and taken along by the drift of those that are refined; what fits better
    counts. The former is right where the given poses of training views alone were wrong, the latter where the frame
    drifts.
    """
    cameras, gate, judges = trainer.cameras, trainer.cameras.gate, trainer.judges
    if not gate.is_due(trainer.step):
        return False
    trainer.settle()
    seen = [cameras.lenses.seen(view.lens, view.camera) for view in judges.views]
    psnr = judges.psnr(trainer, seen)
    if (drift := cameras.drift()) is not None:
        psnr = max(psnr, judges.psnr(trainer, [drift.taken_along(camera) for camera in seen]))
    best, warning = gate.judge(trainer.step, psnr, cameras.refined_arrays())
    if best is not None:
        cameras.go_back(best)
    if warning:
        warn(warning)
    return True
