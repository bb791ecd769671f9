# SPDX-License-Identifier: Apache-2.0
"""Held-out views of a training, as its refined cameras are validated with them."""

from __future__ import annotations

from collections.abc import Sequence

from clsplat.camera import Camera
from clsplat.runs.appearance import held_out_looks
from clsplat.training.trainer import Trainer


def psnr_of(trainer: Trainer, cameras: Sequence[Camera]) -> float:
    """Mean PSNR of the held-out views through these cameras."""
    look = held_out_looks(trainer.appearance.record())
    return trainer.validation_views.psnr(lambda camera: trainer.draw(camera).image, look, cameras)
