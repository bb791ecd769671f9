# SPDX-License-Identifier: Apache-2.0
"""Changed photographs for a training, and the PSNR of its held-out views, for tests of refined cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.runs.appearance import held_out_looks
from clsplat.training.supervision.image_cache import ImageCache
from clsplat.training.trainer import Trainer


def change_photographs(monkeypatch: pytest.MonkeyPatch, change: Callable[[int, NDArray[Any]], object]) -> None:
    """Replace each photograph by the result of `change`, which gets its index and its pixels as floats."""
    plain = ImageCache.load

    def load(self: ImageCache, index: int, factor: float) -> Float32:
        image = plain(self, index, factor)
        values = image / np.float32(255) if image.dtype == np.uint8 else image
        return np.ascontiguousarray(change(index, values), np.float32)

    monkeypatch.setattr(ImageCache, "load", load)


def psnr_of(trainer: Trainer, cameras: Sequence[Camera]) -> float:
    """Mean PSNR of the held-out views with these cameras in place of their own."""
    look = held_out_looks(trainer.appearance.record())
    return trainer.validation_views.psnr(lambda camera: trainer.draw(camera).image, look, cameras)
