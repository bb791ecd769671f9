# SPDX-License-Identifier: Apache-2.0
"""3D Gaussian Splatting on any OpenCL device.

    scene = clsplat.load_scene("photos/")
    gaussians = clsplat.train(scene, clsplat.TrainConfig(iterations=7000))
    gaussians.save("model.ply")
    image = clsplat.render(gaussians, scene.views[0].camera).image

The public names are loaded on first use, so that `import clsplat` and `clsplat --help` are quick.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # not imported from `typing`: Ctrl-C during the import would print a traceback
if TYPE_CHECKING:
    from typing import Any

    from clsplat.api import devices as devices
    from clsplat.api import train as train
    from clsplat.camera import Camera as Camera
    from clsplat.config.training import TrainConfig as TrainConfig
    from clsplat.gaussians import Gaussians as Gaussians
    from clsplat.library.rasterize import rasterize as rasterize
    from clsplat.rendering.renderer import render as render
    from clsplat.scenes.loading import load_scene as load_scene

    __version__: str

__all__ = [
    "Camera",
    "Gaussians",
    "TrainConfig",
    "__version__",
    "devices",
    "load_scene",
    "rasterize",
    "render",
    "train",
]

_MODULES = {
    "Camera": "clsplat.camera",
    "Gaussians": "clsplat.gaussians",
    "TrainConfig": "clsplat.config.training",
    "devices": "clsplat.api",
    "load_scene": "clsplat.scenes.loading",
    "rasterize": "clsplat.library.rasterize",
    "render": "clsplat.rendering.renderer",
    "train": "clsplat.api",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = import_module("clsplat.version").package_version()
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    globals()[name] = value
    return value
