# SPDX-License-Identifier: Apache-2.0
"""Bundle (trouble-step-*.npz) of a training step with non-finite values that ended a training, and its replay.

    python -m clsplat.training.repro_bundle RUN/trouble-step-0001234.npz [--device DEVICE] [--json]

prints the number of non-finite values after each stage of that step. The exit status is 0 if there are any, else 1.
A bundle has the format of a checkpoint, and the inputs of one view: a photograph, a camera and a background. It has
only the Gaussians concerned if these reproduce the non-finite values on their own, otherwise all Gaussians.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import NotRequired, TypedDict

from clsplat.camera import Camera, Projection
from clsplat.config.training import TrainConfig
from clsplat.device import cl
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import ClsplatError, InputError
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import REFUSED, SPLAT
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.runs.checkpoints import Checkpoint, read_checkpoint, write_checkpoint
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
from clsplat.stages.loss import Loss
from clsplat.stages.loss_terms import DepthTerm
from clsplat.stages.project import Slots
from clsplat.training.density.choice import strategy_of
from clsplat.training.stability.health import Incident, finite_or_zero
from clsplat.training.start import region_of, region_state
from clsplat.training.step.gradient_step import GradientStep, StepProbe, slot_fields
from clsplat.training.step.inputs import StepRows, ViewInputs
from clsplat.training.supervision.image_cache import kept_pixels
from clsplat.version import package_version

if TYPE_CHECKING:
    from clsplat.training.trainer import Trainer

_MODEL_KINDS = ("parameters", "first", "second")


class RecordedCamera(TypedDict):
    """Camera of a bundle, without its pose."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    projection: Projection
    radial: tuple[float, ...]
    by_rays: bool


class StepRecord(TypedDict):
    """Training step that a bundle replays.

    view: name of its photograph.
    stage, message: the first stage with non-finite values, and the error message of the training.
    settings: text of config.toml.
    versions, device: software versions and device of the machine that trained.
    depth_factor: factor of the depth loss (`DepthTerm`), if there is one.
    region: the region of the training in the coordinates of the Gaussians' means, if it has one.
    of: (number of Gaussians in the bundle, number in the training).
    reproduced: True if the bundle reproduces the non-finite values.
    """

    step: int
    view: str
    stage: str
    message: str
    rates: dict[str, float]
    camera: RecordedCamera
    settings: str
    versions: dict[str, str]
    device: dict[str, str]
    depth_factor: NotRequired[float]
    region: NotRequired[dict[str, Any]]
    of: NotRequired[tuple[int, int]]
    reproduced: NotRequired[bool]


@dataclass(frozen=True, eq=False)
class Bundle:
    """Training step with everything that a replay needs.

    models: parameters and moments, with the keys "parameters", "first" and "second".
    region: the region of the training, in the coordinates of the means; None for everywhere.
    """

    record: StepRecord
    config: TrainConfig
    inputs: ViewInputs
    models: dict[str, HostGaussians]
    region: TrainedRegion | None = None


def recorded_camera(camera: Camera) -> RecordedCamera:
    """Return a camera's fields as a bundle records them, without its pose."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "near": camera.near,
        "projection": camera.projection,
        "radial": camera.radial,
        "by_rays": camera.by_rays,
    }


def write_bundle(folder: Path, trainer: Trainer, incident: Incident) -> Path:
    """Write the bundle `folder`/trouble-step-STEP.npz for the incident, and return its path."""
    photograph = trainer.photographs.load(incident.view, trainer.sizes.factor(incident.step))
    camera = trainer.loader.camera(incident.view, photograph.shape[1], photograph.shape[0])
    device = trainer.device
    record: StepRecord = {
        "step": incident.step,
        "view": incident.name,
        "stage": incident.stage,
        "message": str(incident),
        "rates": trainer.rates(),
        "camera": recorded_camera(camera),
        "settings": config_text(trainer.config, None),
        "versions": {
            "clsplat": package_version(),
            "numpy": np.__version__,
            "pyopencl": cl.VERSION_TEXT,
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "device": {"name": device.name, "driver": device.driver, "shape": str(device.shape)},
        **region_state(trainer.region),  # type: ignore[typeddict-item]  # "region" or nothing
    }
    pixels = {"photograph": photograph, "background": incident.background}
    aims = trainer.depths.aims(incident.view, camera, incident.step, photograph)
    if aims is not None:
        record["depth_factor"], pixels["depth"] = aims.factor, aims.planes
    pose = {"rotation": camera.rotation, "translation": camera.translation}
    inputs = ViewInputs(0, photograph, camera, incident.background, kept=kept_pixels(photograph), depth=aims)

    def reproduced(models: dict[str, HostGaussians]) -> bool:
        return bool(first_trouble(replay(Bundle(record, trainer.config, inputs, models, trainer.region), device)))

    trainer.catch_up_exactly()
    models, alone = {}, False
    if len(incident.gaussians.get("parameters/means", ())):
        models = _unmarked({kind: host_model(incident.gaussians, kind) for kind in _MODEL_KINDS})
        alone = reproduced(models)
    if not alone:
        models = _unmarked({kind: to_host(model) for kind, model in trainer.model.kinds().items()})
    record["of"] = models["parameters"].count, trainer.parameters.count
    record["reproduced"] = alone or reproduced(models)
    arrays = {f"{kind}/{g}": array.get() for kind, model in models.items() for g, array in model.arrays.items()}
    path = folder / f"trouble-step-{incident.step:07d}.npz"
    write_checkpoint(path, incident.step, {**pixels, **pose, **arrays}, record)
    return path


def _unmarked(models: dict[str, HostGaussians]) -> dict[str, HostGaussians]:
    """Return the models with zeros in place of moments that are not finite. `adam` writes such moments to mark a step
    that it refused."""
    for kind in ("first", "second"):
        arrays = {g: HostArray(finite_or_zero(array.get())) for g, array in models[kind].arrays.items()}
        models[kind] = replace(models[kind], arrays=arrays)
    return models


def read_bundle(path: Path) -> Bundle:
    """Read a bundle. Raises InputError for a file that is not an intact bundle."""
    try:
        return _bundle_of(read_checkpoint(path), path)
    except Exception as error:  # zipfile may raise nearly any exception for a damaged file
        if isinstance(error, InputError) and str(path) in str(error):
            raise
        why = f"{type(error).__name__}: {error}"[:300]
        raise InputError(f"{path}: is not a bundle ({why}), expected a file trouble-step-*.npz of a run") from None


def _bundle_of(saved: Checkpoint, path: Path) -> Bundle:
    """Make a bundle from the content of its file. May raise any exception if the content does not describe a step.

    All sizes in the file must match the photograph's.
    """
    record, arrays = cast("StepRecord", {**saved.state, "step": saved.step}), saved.arrays
    record["rates"] = {group: float(record["rates"][group]) for group in PARAMETER_GROUPS}
    config, _ = parse_config(record["settings"], path)
    photograph = arrays["photograph"]
    height, width, channels = photograph.shape
    lens, pose = record["camera"], (arrays["rotation"].reshape(3, 3), arrays["translation"].reshape(3))
    fx, fy, cx, cy, near = map(float, (lens["fx"], lens["fy"], lens["cx"], lens["cy"], lens["near"]))
    k1, k2, k3, k4 = map(float, lens["radial"])
    camera = Camera(
        *(width, height, fx, fy, cx, cy, *pose, near),
        projection=lens["projection"],
        radial=(k1, k2, k3, k4),
        by_rays=bool(lens["by_rays"]),
    )
    if photograph.dtype not in (np.uint8, np.float32) or channels not in (3, 4, 5):
        raise ValueError(
            f"photograph is {photograph.dtype} of shape {photograph.shape}, expected uint8 or float32 of (H, W, 3 to 5)"
        )
    camera.check()
    aims = None
    if "depth" in arrays:
        planes = arrays["depth"].astype(np.float32).reshape(2, *padded_size(width, height))
        aims = DepthTerm(planes, float(record["depth_factor"]))
    background = arrays["background"].astype(np.float32).reshape(3)
    inputs = ViewInputs(0, photograph, camera, background, kept=kept_pixels(photograph), depth=aims)
    models = {kind: host_model(arrays, kind) for kind in _MODEL_KINDS}
    return Bundle(record, config, inputs, models, region_of(record.get("region")))


class _Counts(StepProbe):
    """`StepProbe` that counts the non-finite values after each stage of a step."""

    def __init__(self, camera: Camera) -> None:
        self.seen = (slice(None), slice(camera.height), slice(camera.width))
        self.counts: dict[str, int] = {}

    def forward(self, frame: ForwardPass) -> None:
        """Count non-finite values of the drawn splats, and of the image."""
        drawn = frame.projected.tile_counts.get() > 0
        written = [column for column, name in enumerate(SPLAT) if name != "UNUSED"]
        self.counts["project"] = _wrong(frame.projected.splats.get()[drawn][:, written])
        self.counts["blend"] = _wrong(frame.blended.image.get()[self.seen])

    def loss(self, result: Loss) -> None:
        """Count non-finite values of the loss's gradient."""
        self.counts["loss"] = _wrong(result.gradient.get()[self.seen])

    def pair_gradients(self, slots: Slots) -> None:
        """Count non-finite gradients of pairs."""
        self.counts["blend_grad"] = _wrong(slots.values.get())

    def before_rows(self, rows: StepRows) -> None:
        """Count non-finite gradients of Gaussians."""
        assert rows.gradients is not None, "replay asks for them"
        self.counts["project_grad"] = _wrong_in(rows.gradients)


def replay(bundle: Bundle, device: Device) -> dict[str, int]:
    """Repeat the step. Returns the number of non-finite values after each stage, and for "adam" the number of array
    elements that `adam` refuses to update."""
    config, record = bundle.config, bundle.record
    rasterizer = Rasterizer(device, config.rasterizer, antialiased=config.antialiased)
    probe = _Counts(bundle.inputs.camera)
    parameters, first, second = (to_device(device, bundle.models[kind]) for kind in _MODEL_KINDS)
    gradients = allocate_gaussians(device, parameters.count, parameters.coefficients, zero=True)
    probe.counts["parameters"] = _wrong_in(parameters)
    fields = slot_fields(strategy_of(config).needs(record["step"]), nearness=bundle.inputs.depth is not None)
    of = (device, rasterizer, config, record["step"], record["rates"], fields)
    step = GradientStep(*of, region=bundle.region)
    step.run((parameters, first, second), bundle.inputs, probe, gradients)
    return {**probe.counts, "adam": int(rasterizer.readback.get()[-len(REFUSED) :].sum())}


def first_trouble(counts: dict[str, int]) -> str | None:
    """First stage after which a value is not finite; None if all values are finite."""
    return next((stage for stage, count in counts.items() if count), None)


def _wrong(values: NDArray[Any]) -> int:
    return int(np.count_nonzero(~np.isfinite(values)))


def _wrong_in(gaussians: DeviceGaussians) -> int:
    return sum(_wrong(gaussians[group].get()) for group in PARAMETER_GROUPS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `python -m clsplat.training.repro_bundle`. Returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m clsplat.training.repro_bundle", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    try:
        bundle = read_bundle(options.bundle)
        counts = replay(bundle, open_device(options.device))
    except ClsplatError as error:
        print(f"clsplat.training.repro_bundle: error: {error}", file=sys.stderr)
        return error.exit_status
    stage = first_trouble(counts)
    if options.json:
        print(json.dumps({"counts": counts, "stage": stage, **bundle.record}, indent=2))
        return 0 if stage else 1
    print(bundle.record["message"])
    (kept, count), camera = bundle.record["of"], bundle.inputs.camera
    print(f"{kept:,} of {count:,} Gaussians, {camera.width}x{camera.height} pixels")
    print("number of non-finite values after each stage:")
    for name, count in counts.items():
        print(f"  {name:13}{count:>12,}")
    print(f"first in {stage}" if stage else "all is well on this device: every value is finite")
    return 0 if stage else 1


if __name__ == "__main__":
    sys.exit(main())
