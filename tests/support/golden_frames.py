# SPDX-License-Identifier: Apache-2.0
"""Frames and gradients of a few tiny scenes, pictures with every channel, and a trained model.

`golden/frames.json` has checksums of the frames and gradients; `tools/ci/digests.py` uses everything here.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import scenes
from numpy.typing import NDArray
from pipeline import Pipeline, shaped
from tiny import short, write_scene

from clsplat.api import train
from clsplat.camera import Camera
from clsplat.config.channels import FRAME_CHANNELS
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.sequence.frame_renderer import FrameRenderer
from clsplat.sequence.task import RenderOptions, Task

Array = NDArray[np.float32]

LANES, ITEMS = 8, 1
"""Kernel shape of the stored checksums. The sums of gradients depend on the shape, unlike frames."""

SCENES: dict[str, Callable[[], tuple[Gaussians, Camera]]] = {
    "overlap": scenes.NAMED["overlap"],
    "saturating": scenes.NAMED["saturating"],
    "cloud": lambda: scenes.random_cloud(2000, 8, 150, 100),
}


def arrays_of(device: Device) -> dict[str, dict[str, list[Array]]]:
    """Arrays by scene and name, in the device's own shape.

    They are the image, the transmittance, and gradients of the parameters and of the means on the image.
    """
    return {name: _of(Pipeline.run(device, make())) for name, make in SCENES.items()}


def checksums(device: Device) -> dict[str, dict[str, str]]:
    """Checksums by scene and name of the arrays, in the shape of the stored checksums."""
    found = arrays_of(shaped(device, LANES, ITEMS))
    return {scene: {name: checksum(parts) for name, parts in arrays.items()} for scene, arrays in found.items()}


def _of(run: Pipeline) -> dict[str, list[Array]]:
    camera = run.camera
    d_image = np.random.default_rng(1).random((camera.height, camera.width, 3)) - 0.5
    gradients, screen = run.backward(d_image)
    return {
        "image": [run.frame.blended.image.get()],
        "transmittance": [run.frame.blended.transmittance.get()],
        "gradients": [*gradients.arrays().values()],
        "screen": [screen[run.visible]],
    }


BINS = 4
FOCALS = {"perspective": None, "orthographic": 0.2, "equirectangular": 1 / (2 * np.pi), "fisheye": 0.3}
"""Focal length for each projection, relative to the picture's width; None keeps the scene's."""


def pictures_of(device: Device, kinds: Iterable[str] = FOCALS) -> dict[str, dict[str, str]]:
    """Checksums by projection and channel, also of a deep picture (`deep`), in the device's own shape."""
    gaussians, camera = SCENES["cloud"]()
    found = {}
    for kind in kinds:
        focal = (FOCALS[kind] or 0.0) * camera.width or camera.fx
        view = replace(camera, fx=focal, fy=camera.fy if FOCALS[kind] is None else focal, projection=kind)  # type: ignore[arg-type]
        step = np.array([-0.0625, 0.03125, 0.125])
        after, before = (replace(view, translation=view.translation + moved) for moved in (step, -step))
        renderer = Renderer(device)
        render_frame = FrameRenderer(renderer, gaussians, RenderOptions(channels=tuple(FRAME_CHANNELS)))
        layers = render_frame(Task(1, "1", view, Path(), after, earlier=before)).planes
        assert layers is not None
        layers["deep"] = renderer.render_deep(gaussians, view, BINS)
        found[kind] = {name: checksum([np.ascontiguousarray(values)]) for name, values in layers.items()}
    return found


def checksum(parts: list[Array]) -> str:
    return f"{zlib.crc32(b''.join(part.tobytes() for part in parts)):08x}"


TRAINING = short(iterations=60, density={"every": 10, "start": 10, "stop": 55, "opacity_reset_every": 30})
"""A training with rising resolution and SH degree, five densifications and an opacity reset."""


def trained(device: Device, folder: Path) -> tuple[Gaussians, float]:
    """A model trained on the tiny scene, and its mean PSNR on the held-out views.

    folder: the scene's folder, which is written if it is missing.
    """
    scene = load_scene(folder if folder.exists() else write_scene(folder))
    model = train(scene, TRAINING, device=device)
    renderer = Renderer(device)
    errors = [np.mean((renderer.render(model, view.camera).image - view.load()) ** 2) for view in scene.test_views]
    return model, float(np.mean(-10 * np.log10(errors)))
