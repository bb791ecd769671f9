# SPDX-License-Identifier: Apache-2.0
"""Case of the pose stage and self-test of the lens stage: the gradients with respect to a camera's pose and lens."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import group_shapes
from clsplat.layouts.columns import POSE_ROWS
from clsplat.reference.pose import pose_gradient as reference
from clsplat.reference.project import lens_grad
from clsplat.reference.render import parameters, project_model
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read
from clsplat.selftest.cases.steps import random_scene
from clsplat.selftest.harness import Array, CaseBench, StageOutcome
from clsplat.selftest.scenes import evenly
from clsplat.selftest.synthetic_slots import MadeUpSlots
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, upload_gaussians
from clsplat.stages.pose import LENS_NUMBERS, lens_rows, pose_rows, sum_of, sums_of
from clsplat.stages.project import Screen, project_grad

SYNTHETIC_GRADIENT_GROUPS = ("means", "quaternions", "sh_dc")


def _random(rng: Generator, count: int) -> Inputs:
    """Random gradients of any magnitude. The gradients of invisible Gaussians are NaN."""
    scene, seen = random_scene(rng, count), np.arange(count) % 3 != 1
    size, by = 10 ** rng.uniform(-6, 3), {}
    for group in SYNTHETIC_GRADIENT_GROUPS:
        shape = group_shapes(count, 4)[group]
        values = rng.standard_normal(shape) * size
        by[group] = np.where(seen.reshape(-1, *[1] * (len(shape) - 1)), values, np.nan).astype(np.float32)
    return Inputs(gaussians=scene.gaussians, camera=scene.camera, by=by, seen=seen)


def _frozen(bench: CaseBench) -> list[Inputs]:
    by = {
        group: evenly(51 + index, bench.model[group].shape, -0.25, 0.5).astype(np.float32)
        for index, group in enumerate(SYNTHETIC_GRADIENT_GROUPS)
    }
    return [Inputs(gaussians=bench.frozen.gaussians, camera=bench.camera, by=by, seen=bench.visible)]


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    model, seen = upload_gaussians(device, given.gaussians), upload(device, given.seen.astype(np.uint32))
    by = {group: upload(device, values) for group, values in given.by.items()}
    sums = sums_of(work, model.count)
    sums.fill(np.nan)
    camera_array = upload(device, pack_camera(given.camera))
    pose_rows(device, model, camera_array, seen, DeviceGaussians(model.count, model.coefficients, by), sums)
    total = sum_of(device, work, sums)
    return lambda: {"sums": total.get()[0]}


def _twin(given: Inputs, got: Arrays) -> dict[str, Expected]:
    seen, arrays = given.seen, given.gaussians.arrays()
    means, quaternions, sh = (arrays[name][seen].astype(np.float64) for name in ("means", "quaternions", "sh"))
    by = {group: values[seen].astype(np.float64) for group, values in given.by.items()}
    by["sh"] = by.pop("sh_dc")[:, None]
    degree = given.gaussians.sh_degree
    wanted = reference(means, quaternions, sh, given.camera, degree, by)
    got |= {"by rotation": got["sums"][:3], "by translation": got["sums"][3:]}
    # The bounds cover the roundings of partial sums.
    # Terms have both signs, so that a sum of 4000 terms is only about 60 times as large as a term.
    return {"by rotation": Expected(wanted[:3], 2e-6), "by translation": Expected(wanted[3:], 2e-6)}


POSE_CASE = Case(
    sizes=(1, POSE_ROWS, POSE_ROWS + 1, POSE_ROWS**2 + 1),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("sums",),
)


def of_lens(bench: CaseBench) -> StageOutcome:
    """Test the gradient with respect to the lens, from synthetic slots."""
    device, model, made = bench.device, bench.model, MadeUpSlots.of(bench)

    def launch() -> DeviceArray:
        gradients = allocate_gaussians(device, model.count, model.coefficients)
        screen, by_lens = (
            bench.work.array(name, (model.count, width)) for name, width in (("screen", 2), ("lens", LENS_NUMBERS))
        )
        project_grad(device, model, made.view, gradients, Screen(screen), by_lens=by_lens)
        sums = sums_of(bench.work, model.count, LENS_NUMBERS)
        lens_rows(device, bench.projected.tile_counts, by_lens, sums)
        return sum_of(device, bench.work, sums)

    def take(sums: DeviceArray) -> list[Array]:
        return [sums.get()[0]]

    _, outcome = bench.twice(launch, take)
    given = parameters(bench.frozen.gaussians)
    projected = project_model(bench.frozen.gaussians, bench.camera, bench.frozen.gaussians.sh_degree)
    geometry = (given["means"], given["quaternions"], given["log_scales"], bench.camera, projected)
    wanted = lens_grad(*geometry, made.on_image(bench))
    (got,) = outcome.arrays
    return outcome.compared({"focal lengths": (got[:2], wanted[:2]), "principal point": (got[2:], wanted[2:])})
