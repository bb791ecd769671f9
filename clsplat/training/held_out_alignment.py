# SPDX-License-Identifier: Apache-2.0
"""Alignment of held-out poses to a model that has drifted with its refined cameras (psnr_aligned in eval.json)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clsplat.camera import Camera
from clsplat.images.alpha import background_colour
from clsplat.layouts.columns import PLAIN_SLOTS
from clsplat.runs.appearance import Look
from clsplat.scenes.scene import View
from clsplat.training.cameras.poses import descend, fallen
from clsplat.training.cameras.refinement import CameraSums
from clsplat.training.step.gradient_step import GradientStep, StepProbe, view_gradients
from clsplat.training.step.inputs import StepRows, ViewInputs
from clsplat.training.supervision.image_cache import kept_pixels
from clsplat.training.trainer import Trainer

ALIGNMENT_STEPS, ALIGNMENT_REACH_DEGREES = 40, 1.0
"""Number of steps of Adam that align a held-out pose, and the approximate limit of its rotation in degrees."""


@dataclass(eq=False)
class _FixedModel(GradientStep):
    """Step of one view that changes only the view's parts, not the model."""

    def update(self, rows: StepRows, inputs: ViewInputs) -> None:
        """Leave the rows unchanged."""


def aligned(trainer: Trainer, view: View, look: Look) -> Camera:
    """Camera of a held-out view, moved so that the model fits the view's photograph best. The model does not change.

    look: function of a view's name and a render. It gives the render the view's appearance, by which the photograph is
        divided here, so that it can be compared with the model's own colours.
    """
    config, rasterizer, model = replace(trainer.config, thinning=0.0), trainer.rasterizer, trainer.parameters
    photograph = np.ascontiguousarray(view.load_masked())
    white = np.ones((*photograph.shape[:2], 3), np.float32)
    if (factors := look(view.name, white)) is not white:
        photograph = np.concatenate([photograph[:, :, :3] / factors, photograph[:, :, 3:]], axis=2, dtype=np.float32)
    kept, background = kept_pixels(photograph), np.array(background_colour(config.background), np.float32)
    room, scale = view_gradients(rasterizer.work, model), np.repeat([1.0, trainer.scene.length_unit], 3)
    first, second = np.zeros(6), np.zeros((6, 6))
    camera = best = view.camera
    least = np.inf
    step_of_view = _FixedModel(trainer.device, rasterizer, config, 1, trainer.rates(), PLAIN_SLOTS)
    for step in range(1, ALIGNMENT_STEPS + 1):
        sums = CameraSums(rasterizer.work, model.count)
        inputs = ViewInputs(0, photograph, trainer.local(camera), background, kept=kept, parts=(sums,))
        loss, _ = step_of_view.run((model,), inputs, StepProbe(), room, reads_loss=True).read()
        if loss < least:
            best, least = camera, loss
        by = sums.by_pose() * scale
        rate = fallen(np.radians(ALIGNMENT_REACH_DEGREES), step / ALIGNMENT_STEPS, ALIGNMENT_STEPS)
        camera = camera.moved(rate * scale * descend(first, second, by, step))
    return best
