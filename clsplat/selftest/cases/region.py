# SPDX-License-Identifier: Apache-2.0
"""Case of the region of a training (kernels/shared/region.h): results outside it, and inside it those without one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import SlotFields
from clsplat.optimisation.step_noise import Exploration
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback, read_of
from clsplat.selftest.cases.steps import ADAM_RATES, random_scene
from clsplat.selftest.harness import CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.adam import AdamStep
from clsplat.stages.device_camera import pack_camera, upload_cameras
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians
from clsplat.stages.noise import noise
from clsplat.stages.project import Screen, Slots, ViewSlots, project, project_grad, project_step
from clsplat.stages.sampling import sampling_limits

FIELDS = SlotFields(contributions=True)
NOISE = Exploration(amount=1e3, dead=1.0, key=(3, 5))
ON_SCREEN = ("screen", "contributions", "screen of step")
"""Results that kernels write for visible Gaussians only."""
NO_LIMIT = np.float32(-1e30)
"""Lower limit of the log scales of a Gaussian that has no limit."""


def _random(rng: Generator, count: int) -> Inputs:
    """A random view, and a region with a Gaussian on each of its edges, and one on its sphere. slots: (n,
    FIELDS.floats), summed by Gaussian."""
    given = random_scene(rng, count)
    axes = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    means = given.gaussians.means
    at = TrainedRegion(axes, np.full(2, -np.inf), np.full(2, np.inf)).coordinates(means).astype(np.float64)
    low, high = np.sort(at, axis=0)[[count // 5, -1 - count // 5]]
    high[1] = np.inf
    squares = np.sort(TrainedRegion(axes, low, np.full(2, np.inf), middle := means.mean(axis=0)).squares(means))
    radius = float(np.sqrt(squares[count // 2].astype(np.float64)))
    nearest, farthest = ((0.0, np.inf), (radius, np.inf), (0.0, radius or 1.0))[rng.integers(3)]
    means[rng.random(count) < 0.02] = np.nan
    high = np.where(low < high, high, low + 1)
    return Inputs(
        gaussians=given.gaussians,
        camera=given.camera,
        explore=given.explore,
        region=TrainedRegion(axes, low, high, middle, nearest, farthest),
        slots=rng.normal(size=(count, FIELDS.floats)).astype(np.float32),
        sparse=bool(rng.random() < 0.3),
    )


def _frozen(bench: CaseBench) -> list[Inputs]:
    gaussians, count = bench.frozen.gaussians, bench.model.count
    axes = np.array([[0.75, 0.5, 0.0], [0.0, 0.25, 0.5]])
    region = TrainedRegion(axes, np.full(2, -np.inf), np.full(2, np.inf))
    low, high = np.quantile(region.coordinates(gaussians.means), (0.2, 0.8), axis=0)
    near = replace(region, centre=np.array([0.25, -0.5, 4.0]))
    nearest, farthest = np.sqrt(np.quantile(near.squares(gaussians.means), (0.1, 0.9)).astype(np.float64))
    return [
        Inputs(
            gaussians=gaussians,
            camera=bench.camera,
            explore=Exploration(opacity=0.3125, scale=0.6875),
            region=replace(near, low=low, high=high, nearest=float(nearest), farthest=float(farthest)),
            slots=evenly(47, (count, FIELDS.floats), -0.5, 0.5).astype(np.float32),
            sparse=False,
        )
    ]


def _results(device: Device, work: Workspace, given: Inputs, region: TrainedRegion | None) -> dict[str, DeviceArray]:
    """Launch every kernel that knows of regions, but for density_scores. Returns the results by name."""
    model, camera_array = upload_gaussians(device, given.gaussians), upload(device, pack_camera(given.camera))
    projected = project(device, work, model, given.camera, camera_array)
    count, coefficients = model.count, model.coefficients
    unwritten = [np.full(shape, np.nan, np.float32) for shape in ((count, 2), (count,), (count, 2), (count,))]
    on_screen, contributions, on_screen_of_step, further = (upload(device, array) for array in unwritten)
    view = ViewSlots(camera_array, projected, Slots(upload(device, given.slots), None, FIELDS))

    gradients = allocate_gaussians(device, count, coefficients, zero=True)
    screen = Screen(on_screen, contributions)
    project_grad(device, model, view, gradients, screen, explore=given.explore, region=region)

    stepped = upload_gaussians(device, given.gaussians)
    moments = (allocate_gaussians(device, count, coefficients, zero=True) for _ in range(2))
    step = AdamStep(OptimiserConfig(sparse=given.sparse), 1, ADAM_RATES)
    target = (Screen(on_screen_of_step, further), fresh_readback(device))
    project_step(device, step, (stepped, *moments), view, *target, explore=given.explore, region=region)

    limits, moved = allocate(device, (count,), np.float32), upload_gaussians(device, given.gaussians)
    sampling_limits(device, work, model, upload_cameras(device, [given.camera]), limits, region)
    noise(device, NOISE, moved, 0, fresh_readback(device), region)
    return {
        **{f"gradients of {group}": gradients[group] for group in PARAMETER_GROUPS},
        **{f"new {group}": stepped[group] for group in PARAMETER_GROUPS},
        "screen": on_screen,
        "contributions": contributions,
        "screen of step": on_screen_of_step,
        "limits": limits,
        "moved means": moved["means"],
        "counts": projected.tile_counts,
    }


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    """Run the kernels without a region and with one."""
    results = _results(device, work, given, None)
    inside = _results(device, work, given, given.region)
    return read_of(results | {f"in region {name}": array for name, array in inside.items()})


def _twin(given: Inputs, got: Arrays) -> dict[str, Expected]:
    """Inside the region, results are those without a region. Outside, gradients are zero, and parameters stay.

    Results without a region come from the device, because other stages test them.
    """
    inside, shown, held = given.region.contains(given.gaussians.means), got["counts"] > 0, given.gaussians
    before = {f"new {group}": getattr(held, group) for group in list(PARAMETER_GROUPS)[:4]}
    before |= {"new sh_dc": held.sh[:, 0], "new sh_rest": held.sh[:, 1:], "moved means": held.means}
    wanted: dict[str, Expected] = {}
    for name in [name for name in got if f"in region {name}" in got and name != "counts"]:
        array = got[name]
        outside = before[name] if name in before else np.full_like(array, NO_LIMIT if name == "limits" else 0)
        values = np.where(inside.reshape(-1, *[1] * (array.ndim - 1)), array, outside)
        written = shown if name in ON_SCREEN else np.ones_like(shown)
        # NaN means are equal to themselves here
        found, values = (np.where(np.isnan(each), 0, each)[written] for each in (got[f"in region {name}"], values))
        got[f"in region {name}"], wanted[f"in region {name}"] = found, exactly(values)
    return wanted


REGION_CASE = Case(
    sizes=(1, 9, 65, 203, 7, 8, 63, 64, 129),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("in region gradients of means", "in region screen", "in region limits", "in region moved means"),
)
