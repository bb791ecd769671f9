# SPDX-License-Identifier: Apache-2.0
"""Contributions of a model in training to the edges of its photographs."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.layout import SLOT
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.scenes.scene import View
from clsplat.stages.device_camera import padded_size
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.stages.project import add_slots
from clsplat.training.photographs import Photographs
from clsplat.training.resolution import Sizes


class InTraining(Protocol):
    """A model in training, as far as this goes: a `Trainer`."""

    rasterizer: Rasterizer
    views: list[View]
    photographs: Photographs
    sizes: Sizes
    parameters: AnyGaussians
    rng: np.random.Generator
    step: int

    def camera(self, view: int, width: int, height: int) -> Camera:
        """A training view's camera at a size."""


def pixel_bytes(config: TrainConfig) -> int:
    """Bytes of a pixel on the device: three planes of weights, where they are asked for."""
    return 12 if config.density.edge_views > 0 else 0


def edge_contributions(trainer: InTraining, count: int) -> Float32:
    """Sum (n,) over `count` views drawn at random, or all if there are fewer, of each Gaussian's alpha times
    transmittance times `edge_strength`, over pixels.

    That is the gradient by its colour of the picture weighed so, which blending's gradient has.
    """
    rasterizer, work = trainer.rasterizer, trainer.rasterizer.work
    total = np.zeros(trainer.parameters.count, np.float32)
    factor = trainer.sizes.factor(trainer.step + 1)
    for view in trainer.rng.permutation(len(trainer.views))[:count].tolist():
        photograph = trainer.photographs.load(view, factor)
        height, width = photograph.shape[:2]
        frame = rasterizer.forward(trainer.parameters, trainer.camera(view, width, height), np.zeros(3, np.float32))
        rows, stride = padded_size(width, height)
        weights = np.zeros((3, rows, stride), np.float32)
        weights[0, :height, :width] = edge_strength(photograph)
        gradient = work.array("edge_weights", weights.shape)
        gradient.set(weights)
        slots = rasterizer.pair_gradients(frame, gradient)
        sums, tile_counts = slots.values, frame.projected.tile_counts
        if slots.first_slots is not None:
            sums = add_slots(rasterizer.device, work, tile_counts, slots, None)
        total += np.where(tile_counts.get() > 0, sums.get()[:, SLOT.index("RED")], np.float32(0))
    return np.where(total > 0, total, np.float32(0))


def edge_strength(photograph: NDArray[Any]) -> Float32:
    """Length of the gradient of grey (H, W), 1 where it is largest; 0 under a mask and beside one, whose outline is no
    edge. photograph (H, W, 3 to 5)."""
    grey = photograph[:, :, :3].astype(np.float32).sum(axis=2)
    strength = np.hypot(*np.gradient(grey)) if min(grey.shape) > 1 else np.zeros_like(grey)
    if photograph.shape[2] == 5:
        strength *= binary_erosion(photograph[:, :, 4] > 0, border_value=1)
    return np.asarray(strength / max(float(strength.max()), 1e-12), np.float32)
