# SPDX-License-Identifier: Apache-2.0
"""Functions that several verbs share: `Services`, which tests replace, loading of a scene, and choice of devices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clsplat.config.orientation import AS_IN_FILES, FrameUse
from clsplat.errors import warn
from clsplat.progress import StageProgress

if TYPE_CHECKING:
    from clsplat.config.masks import MaskUse
    from clsplat.config.training import TrainConfig
    from clsplat.device.context import Device
    from clsplat.device.selection import DeviceInfo
    from clsplat.evaluation.held_out import Evaluation
    from clsplat.gaussians import Gaussians
    from clsplat.rendering.renderer import Renderer
    from clsplat.scenes.analysis.photo_findings import Finding
    from clsplat.scenes.dataset import SceneFrame
    from clsplat.scenes.scene import Scene


def imported(name: str) -> Callable[..., Any]:
    """Return a function that imports and calls the function `name`, such as "clsplat.api.train".

    As the import waits for the first call, --help is fast.
    """
    module, _, member = name.rpartition(".")

    def call(*arguments: Any, **named: Any) -> Any:
        return getattr(import_module(module), member)(*arguments, **named)

    call.__name__ = name
    return call


@dataclass(frozen=True)
class Services:
    """Functions of the package that do the verbs' work. Tests replace them."""

    load_scene: Callable[..., Scene] = imported("clsplat.scenes.loading.load_scene_of")
    findings: Callable[..., list[Finding]] = imported("clsplat.scenes.analysis.photo_findings.findings")
    open_device: Callable[..., Device] = imported("clsplat.device.selection.open_device")
    open_devices: Callable[..., list[Device]] = imported("clsplat.device.selection.open_devices")
    require: Callable[..., Device] = imported("clsplat.selftest.driver_check.require")
    reconstruct: Callable[..., Path] = imported("clsplat.scenes.sfm.reconstruct.reconstruct")
    train: Callable[..., Gaussians] = imported("clsplat.api.train")
    renderer: Callable[..., Renderer] = imported("clsplat.rendering.renderer.Renderer")
    open_frame_renderer: Callable[..., Any] = imported("clsplat.sequence.frame_renderer.open_frame_renderer")
    run_capture: Callable[..., Evaluation | None] = imported("clsplat.capture.run.run_capture")
    run_demo: Callable[..., Evaluation | None] = imported("clsplat.demo.run.run_demo")
    write_town: Callable[..., dict[str, Any]] = imported("clsplat.demo.town.writing.write_town")


def load_scene(
    services: Services,
    path: Path,
    config: TrainConfig,
    *,
    masks: MaskUse | None = None,
    frame: FrameUse | SceneFrame = AS_IN_FILES,
    frames: int | None = None,
) -> Scene:
    """Load the scene in the folder `path`, print its warnings, and return it. Arguments as for `load_scene_of`."""
    scene = services.load_scene(config, path, masks=masks, frame=frame, frames=frames, progress=StageProgress())
    for text in scene.warnings:
        warn(text)
    return scene


def chosen_devices(selector: str | None) -> list[DeviceInfo]:
    """Find the device that `selector` names, or list all devices for None. Raises DeviceError if there is none."""
    from clsplat.device.drivers.quirks import no_device
    from clsplat.device.selection import find_device, list_devices

    devices = list_devices() if selector is None else [find_device(selector)]
    if not devices:
        raise no_device()
    return devices
