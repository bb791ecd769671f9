# SPDX-License-Identifier: Apache-2.0
"""A model through each format and back renders as it did, in the same place and the same way round."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from models import real_file
from needs import require
from splats import lopsided

from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.evaluation.metrics import psnr
from clsplat.gaussians import Gaussians
from clsplat.models.codec import axes
from clsplat.models.formats import gltf, sog, spz, usd
from clsplat.rendering.renderer import Renderer

FILES = {
    "model.glb": (gltf, 60.0),
    "model.gltf": (gltf, 60.0),
    "model.usdc": (usd, 60.0),
    "v2.spz": (spz, 35.0),
    "v3.spz": (spz, 35.0),
    "v4.spz": (spz, 35.0),
    "model.sog": (sog, 35.0),
}
"""Decibels that issue 6 asks for: 60 of floats, 35 of quantised formats."""


def through(name: str, model: Gaussians, folder: Path) -> Gaussians:
    module, _ = FILES[name]
    if module is usd:
        require("pxr")
    options = {"version": int(name[1])} if name.startswith("v") else {}
    module.write(folder / name, model, **options)
    read: Gaussians = module.read(folder / name)
    return read


def compare(device: Device, model: Gaussians, back: Gaussians, cameras: list[Camera]) -> float:
    """The lowest PSNR, against black; clamped as in evaluation."""
    renderer = Renderer(device)

    def frame(each: Gaussians, camera: Camera) -> np.ndarray:
        return np.clip(renderer.render(each, camera, (0.0, 0.0, 0.0)).image, 0, 1)

    return min(psnr(frame(back, camera), frame(model, camera)) for camera in cameras)


def cameras() -> list[Camera]:
    """Three that look at `lopsided` models from different sides."""
    found = []
    for turn, at in ((0.0, (0.0, 0.0, 6.0)), (0.7, (0.5, 0.3, 7.0)), (2.4, (-0.4, 0.2, 7.0))):
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        middle = np.array([1.1, 0.6, 2.5])
        found.append(Camera(160, 120, 150.0, 150.0, 80.0, 60.0, rotation, np.array(at) - rotation @ middle))
    return found


@pytest.mark.parametrize("name", FILES)
def test_a_lopsided_model(default_device: Device, tmp_path: Path, name: str) -> None:
    model = lopsided(2000, degree=0 if name == "model.sog" else 3)  # random vectors are no palette's
    model.log_scales += np.float32(0.5)
    back = through(name, model, tmp_path)
    assert compare(default_device, model, back, cameras()) >= FILES[name][1]


@pytest.mark.parametrize("signs", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, 1), (1, -1, -1)])
def test_a_mirrored_axis_would_be_seen(default_device: Device, signs: axes.Signs) -> None:
    model = lopsided(2000)
    model.log_scales += np.float32(0.5)
    mirrored = replace(model, **{name: getattr(model, name).copy() for name in ("means", "quaternions", "sh")})
    axes.flip(mirrored, signs)
    assert compare(default_device, model, mirrored, cameras()) < 25


def test_a_flip_of_the_harmonics_alone_would_be_seen(default_device: Device) -> None:
    model = lopsided(2000)
    model.log_scales += np.float32(0.5)
    flipped = replace(model, sh=model.sh * axes.sh_signs((1, -1, -1))[:, None])
    assert compare(default_device, model, flipped, cameras()) < 35


@pytest.mark.parametrize("name", FILES)
def test_a_trained_model(default_device: Device, tmp_path: Path, name: str) -> None:

    model = Gaussians.load(real_file("samples/kacytran1122_iter7000_9080.ply"))
    views = [scenes.straight_camera(240, 160, 220.0), scenes.tilted_camera(200, 150, 120.0)]
    assert compare(default_device, model, through(name, model, tmp_path), views) >= FILES[name][1]
