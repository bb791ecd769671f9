# SPDX-License-Identifier: Apache-2.0
"""Checksums of frames and gradients of a few tiny scenes: `golden/frames.json`."""

from __future__ import annotations

import zlib

import numpy as np
import scenes
from numpy.typing import NDArray
from pipeline import Pipeline, shaped

from clsplat.device.context import Device

LANES, ITEMS = 8, 1
"""The shape of the gradients: their sums, unlike a frame, depend on it."""

SCENES = {
    "overlap": scenes.NAMED["overlap"],
    "saturating": scenes.NAMED["saturating"],
    "cloud": lambda: scenes.random_cloud(2000, 8, 150, 100),
}


def checksums(device: Device) -> dict[str, dict[str, str]]:
    """By scene and array."""
    return {name: _of(Pipeline.run(shaped(device, LANES, ITEMS), make())) for name, make in SCENES.items()}


def _of(run: Pipeline) -> dict[str, str]:
    camera = run.camera
    d_image = np.random.default_rng(1).random((camera.height, camera.width, 3)) - 0.5
    gradients, screen = run.backward(d_image)
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    arrays = {
        "image": [run.frame.blended.image.get()],
        "transmittance": [run.frame.blended.transmittance.get()],
        "gradients": [getattr(gradients, name) for name in names],
        "screen": [screen[run.visible]],
    }
    return {name: _checksum(parts) for name, parts in arrays.items()}


def _checksum(parts: list[NDArray[np.float32]]) -> str:
    return f"{zlib.crc32(b''.join(part.tobytes() for part in parts)):08x}"
