# SPDX-License-Identifier: Apache-2.0
"""Held-out photographs that validate a training's refined cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import warn
from clsplat.evaluation import metrics
from clsplat.images.alpha import background_colour, composite
from clsplat.runs.appearance import Look
from clsplat.scenes.scene import Scene, spread
from clsplat.training.cameras.refinement import Cameras
from clsplat.training.cameras.validation_gate import MAX_GATE_VIEWS
from clsplat.training.supervision.decoding import Decoder
from clsplat.training.supervision.host_photographs import HostPhotographs
from clsplat.training.supervision.image_cache import ImageCache

Draw = Callable[[Camera], NDArray[Any]]
"""Function that renders an image (H, W, 3), over the background of evaluations, with a camera in world coordinates."""


class ValidationViews:
    """Held-out views for the gate, at most `validation_gate.MAX_GATE_VIEWS`. Their pixels are decoded once."""

    def __init__(self, scene: Scene, device: Device, config: TrainConfig) -> None:
        self.views = spread(scene.test_views, MAX_GATE_VIEWS)
        self._photographs = ImageCache(device, HostPhotographs(Decoder(self.views)))
        self._background = background_colour(config.background)
        self._measure = metrics.psnr if config.appearance == "none" else metrics.psnr_corrected

    def psnr(self, draw: Draw, look: Look, cameras: Sequence[Camera]) -> float:
        """Mean PSNR in dB of the views, rendered from these cameras; 0 if no photograph counts.

        A photograph counts if its mask keeps a pixel. If appearance is learnt, colours are fitted before the
        comparison.

        look: function that gives a render the appearance of a view, if that is known.
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


def validate(cameras: Cameras, validation_views: ValidationViews, step: int, draw: Draw, look: Look) -> None:
    """Measure the held-out views with the refined cameras. If the gate rejects the cameras, warn and go back to earlier
    cameras.

    Held-out views are measured twice, with their given poses, and with these poses moved by the drift of the refined
    poses. The better result counts. The given poses are right if only some training poses were wrong, and the moved
    ones if the whole world has drifted.
    """
    seen = [cameras.lenses.seen(view.lens, view.camera) for view in validation_views.views]
    psnr = validation_views.psnr(draw, look, seen)
    if (drift := cameras.drift()) is not None:
        psnr = max(psnr, validation_views.psnr(draw, look, [drift.taken_along(camera) for camera in seen]))
    best, warning = cameras.gate.validate(step, psnr, cameras.refined_arrays())
    if best is not None:
        cameras.go_back(best)
    if warning:
        warn(warning)
