# SPDX-License-Identifier: Apache-2.0
"""The bundle that a training leaves when it gives up on numbers that are not finite, and the one step that it repeats.

    python -m clsplat.training.repro RUN/trouble-step-0001234.npz [--device DEVICE] [--json]

prints how many numbers are not finite after each stage of that step. Exit status 0 where some are, 1 where all is well.
A bundle has a photograph, a camera, settings, versions and the Gaussians concerned; all of them only where those alone
do not show it.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import clsplat
from clsplat.camera import PROJECTIONS, Camera
from clsplat.config.training import TrainConfig
from clsplat.device import cl
from clsplat.device.context import Device, open_device
from clsplat.device.layout import REFUSED, SPLAT
from clsplat.errors import ClsplatError, InputError
from clsplat.files import atomic_writer, parse_json
from clsplat.gaussians import GROUPS
from clsplat.rendering.rasterizer import Frame, Rasterizer
from clsplat.runs.checkpoints import read_arrays
from clsplat.runs.settings import config_text, parse_config
from clsplat.stages.device_camera import padded_size
from clsplat.stages.device_gaussians import (
    DeviceGaussians,
    HostArray,
    HostGaussians,
    allocate_gaussians,
    host_model,
    to_device,
    to_host,
)
from clsplat.stages.loss import DepthAims, Loss
from clsplat.stages.project import Slots
from clsplat.training.density.choice import strategy_of
from clsplat.training.health import Incident, finite_or_zero
from clsplat.training.photographs import kept_pixels
from clsplat.training.step import GradientStep, StepProbe, StepRows, slot_fields

if TYPE_CHECKING:
    from clsplat.training.trainer import Trainer

RECORD = "bundle.json"
"""The member of a bundle with everything that is no array."""
_LENS = ("width", "height", "fx", "fy", "cx", "cy", "near", "projection", "radial", "by_rays")
_KINDS = ("parameters", "first", "second")


@dataclass(frozen=True, eq=False)
class Bundle:
    """One training step. record: step, stage, name of the view, rates, size, versions, device; config: the settings;
    camera: at the size of photograph (H, W, 3 to 5); background (3,); models: parameters and moments by group; depth:
    the view's known depths."""

    record: dict[str, Any]
    config: TrainConfig
    camera: Camera
    photograph: NDArray[Any]
    background: NDArray[np.float32]
    models: dict[str, HostGaussians]
    depth: DepthAims | None = None


def write_bundle(folder: Path, trainer: Trainer, incident: Incident) -> Path:
    """Write `folder`/trouble-step-STEP.npz of what happened; the path."""
    photograph = trainer.photographs.load(incident.view, trainer.sizes.factor(incident.step))
    camera = trainer.camera(incident.view, photograph.shape[1], photograph.shape[0])
    device = trainer.device
    record: dict[str, Any] = {
        "step": incident.step,
        "view": incident.name,
        "stage": incident.stage,
        "message": str(incident),
        "rates": trainer.rates(),
        "camera": {name: getattr(camera, name) for name in _LENS},
        "settings": config_text(trainer.config, None),
        "versions": {
            "clsplat": clsplat.__version__,
            "numpy": np.__version__,
            "pyopencl": cl.VERSION_TEXT,
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "device": {"name": device.name, "driver": device.driver, "shape": str(device.shape)},
    }
    pixels = {"photograph": photograph, "background": incident.background}
    aims = trainer.depths.aims(incident.view, camera, incident.step, photograph)
    if aims is not None:
        record["depth_factor"], pixels["depth"] = aims.factor, aims.planes
    pose = {"rotation": camera.rotation, "translation": camera.translation}

    def reproduced(models: dict[str, HostGaussians]) -> bool:
        bundle = Bundle(record, trainer.config, camera, photograph, incident.background, models, aims)
        return bool(first_trouble(replay(bundle, device)))

    trainer.settle()
    models, alone = {}, False
    if len(incident.gaussians.get("parameters/means", ())):
        models = _unmarked({kind: host_model(incident.gaussians, kind) for kind in _KINDS})
        alone = reproduced(models)
    if not alone:
        models = _unmarked({kind: to_host(model) for kind, model in trainer.models().items()})
    record["of"] = models["parameters"].count, trainer.parameters.count
    record["reproduced"] = alone or reproduced(models)
    arrays = {f"{kind}/{g}": array.values for kind, model in models.items() for g, array in model.arrays.items()}
    path = folder / f"trouble-step-{incident.step:07d}.npz"
    text = np.frombuffer(json.dumps(record).encode(), np.uint8)
    members = {RECORD: text, **pixels, **pose, **arrays}
    with atomic_writer(path, sum(array.nbytes + 512 for array in members.values())) as file:
        np.savez(file, allow_pickle=False, **members)
    return path


def _unmarked(models: dict[str, HostGaussians]) -> dict[str, HostGaussians]:
    """The models with moments as they were before `adam` refused a step, as far as they are known."""
    for kind in ("first", "second"):
        arrays = {g: HostArray(finite_or_zero(array.values)) for g, array in models[kind].arrays.items()}
        models[kind] = replace(models[kind], arrays=arrays)
    return models


def read_bundle(path: Path) -> Bundle:
    """Raises InputError for what is no bundle."""
    try:
        return _checked(_bundle_of(read_arrays(path, "a bundle"), path))
    except Exception as error:  # as of a checkpoint: zipfile raises nearly anything for a flipped bit
        if isinstance(error, InputError) and str(path) in str(error):
            raise
        why = f"{type(error).__name__}: {error}"[:300]
        raise InputError(f"{path}: not a bundle of a training that gave up ({why})") from None


def _bundle_of(arrays: dict[str, NDArray[Any]], path: Path) -> Bundle:
    record = parse_json(arrays[RECORD].tobytes())
    config, _ = parse_config(record["settings"], path)
    lens = {**record["camera"], "radial": tuple(record["camera"].get("radial", (0.0,) * 4))}
    camera = Camera(**lens, rotation=arrays["rotation"], translation=arrays["translation"])
    models = {kind: host_model(arrays, kind) for kind in _KINDS}
    aims = DepthAims(arrays["depth"], float(record["depth_factor"])) if "depth" in arrays else None
    return Bundle(record, config, camera, arrays["photograph"], arrays["background"], models, aims)


def _checked(bundle: Bundle) -> Bundle:
    """The bundle. Raises ValueError where its arrays do not belong together, or it lacks what a step needs."""
    camera, record = bundle.camera, bundle.record
    sides = camera.height, camera.width
    if not all(type(side) is int for side in sides):
        raise ValueError(f"a camera of {sides} pixels")
    if bundle.photograph.shape not in [(*sides, n) for n in (3, 4, 5)] or bundle.photograph.dtype not in (
        np.uint8,
        np.float32,
    ):
        raise ValueError(f"a photograph {bundle.photograph.shape} of {bundle.photograph.dtype} for a camera of {sides}")
    numbers = (camera.rotation, camera.translation, [camera.fx, camera.fy, camera.cx, camera.cy, camera.near])
    if not all(np.isfinite(values).all() for values in numbers) or bundle.background.shape != (3,):
        raise ValueError("a camera that is none")
    if camera.projection not in PROJECTIONS or len(camera.radial) != 4 or not np.isfinite(camera.radial).all():
        raise ValueError("a camera without a projection")
    planes = (2, *padded_size(camera.width, camera.height))
    if bundle.depth is not None and (bundle.depth.planes.shape != planes or bundle.depth.planes.dtype != np.float32):
        raise ValueError(f"depths {bundle.depth.planes.shape} for a camera of {sides}")
    if bool(bundle.config.depth_use) != (bundle.depth is not None):
        raise ValueError("settings and depths that do not belong together")
    rates = record["rates"]
    if type(record["step"]) is not int or not np.isfinite([float(rates[group]) for group in GROUPS]).all():
        raise ValueError("no step and no learning rates")
    return bundle


class _Counts(StepProbe):
    """After each stage of a step: how many numbers are not finite."""

    def __init__(self, camera: Camera) -> None:
        self.seen = (slice(None), slice(camera.height), slice(camera.width))
        self.counts: dict[str, int] = {}

    def forward(self, frame: Frame) -> None:
        """Count in the splats that are drawn, and in the image."""
        drawn = frame.projected.tile_counts.get() > 0
        written = [column for column, name in enumerate(SPLAT) if name != "UNUSED"]
        self.counts["project"] = _wrong(frame.projected.splats.get()[drawn][:, written])
        self.counts["blend"] = _wrong(frame.blended.image.get()[self.seen])

    def loss(self, result: Loss) -> None:
        """Count in the loss's gradient."""
        self.counts["loss"] = _wrong(result.gradient.get()[self.seen])

    def pair_gradients(self, slots: Slots) -> None:
        """Count in the gradients of pairs."""
        self.counts["blend_grad"] = _wrong(slots.values.get())

    def before_rows(self, rows: StepRows) -> None:
        """Count in the gradients of Gaussians."""
        assert rows.gradients is not None, "replay asks for them"
        self.counts["project_grad"] = _wrong_in(rows.gradients)


def replay(bundle: Bundle, device: Device) -> dict[str, int]:
    """Make the step once more: after each stage how many numbers are not finite, and how many steps `adam` refuses."""
    config, record = bundle.config, bundle.record
    rasterizer, probe = Rasterizer(device, config.rasterizer), _Counts(bundle.camera)
    rasterizer.antialias(on=config.antialiased)
    parameters, first, second = (to_device(device, bundle.models[kind]) for kind in _KINDS)
    gradients = allocate_gaussians(device, parameters.count, parameters.coefficients, zero=True)
    probe.counts["parameters"] = _wrong_in(parameters)
    fields = slot_fields(strategy_of(config).needs(record["step"]), nearness=bundle.depth is not None)
    step = GradientStep(device, rasterizer, config, record["step"], record["rates"], fields)
    pixels = (bundle.photograph, bundle.camera, bundle.background)
    known: dict[str, Any] = {"kept": kept_pixels(bundle.photograph), "depth": bundle.depth}
    step.run((parameters, first, second), *pixels, probe, gradients, **known)
    return {**probe.counts, "adam": int(rasterizer.readback.get()[-len(REFUSED) :].sum())}


def first_trouble(counts: dict[str, int]) -> str | None:
    """The first stage after which something is not finite."""
    return next((stage for stage, count in counts.items() if count), None)


def _wrong(values: NDArray[Any]) -> int:
    return int(np.count_nonzero(~np.isfinite(values)))


def _wrong_in(gaussians: DeviceGaussians) -> int:
    return sum(_wrong(gaussians[group].get()) for group in GROUPS)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line above."""
    parser = argparse.ArgumentParser(
        prog="python -m clsplat.training.repro", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    try:
        bundle = read_bundle(options.bundle)
        counts = replay(bundle, open_device(options.device))
    except ClsplatError as error:
        print(f"clsplat.training.repro: error: {error}", file=sys.stderr)
        return error.exit_status
    stage = first_trouble(counts)
    if options.json:
        print(json.dumps({"counts": counts, "stage": stage, **bundle.record}, indent=2))
        return 0 if stage else 1
    print(bundle.record["message"])
    kept, count = bundle.record["of"]
    print(f"{kept:,} of {count:,} Gaussians, {bundle.camera.width}x{bundle.camera.height}; not finite after")
    for name, count in counts.items():
        print(f"  {name:13}{count:>12,}")
    print(f"first in {stage}" if stage else "all is well on this device")
    return 0 if stage else 1


if __name__ == "__main__":
    sys.exit(main())
