# SPDX-License-Identifier: Apache-2.0
"""Self-test of the pose and lens stages: the gradients by a camera's pose and by its lens."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.reference.pose import pose_gradient as reference
from clsplat.reference.project import lens_grad
from clsplat.reference.render import parameters, project_model
from clsplat.selftest.harness import Array, CaseBench, StageOutcome
from clsplat.selftest.scenes import evenly
from clsplat.selftest.synthetic_slots import MadeUpSlots
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians
from clsplat.stages.pose import LENS_NUMBERS, lens_rows, pose_rows, sum_of, sums_of
from clsplat.stages.project import Screen, project_grad

SYNTHETIC_GRADIENT_GROUPS = ("means", "quaternions", "sh_dc")


def of_pose(bench: CaseBench) -> StageOutcome:
    """Test synthetic gradients of the Gaussians that the scene's view shows."""
    device, model, frozen = bench.device, bench.model, bench.frozen
    arrays = {
        group: evenly(51 + index, model[group].shape, -0.25, 0.5).astype(np.float32)
        for index, group in enumerate(SYNTHETIC_GRADIENT_GROUPS)
    }
    gradients = DeviceGaussians(
        model.count, model.coefficients, {group: upload(device, values) for group, values in arrays.items()}
    )

    def launch() -> DeviceArray:
        sums = sums_of(bench.work, model.count)
        pose_rows(device, model, bench.camera_array, bench.projected.tile_counts, gradients, sums)
        return sum_of(device, bench.work, sums)

    def take(sums: DeviceArray) -> list[Array]:
        return [sums.get()[0]]

    _, outcome = bench.twice(launch, take)
    seen = bench.visible
    wide = {group: values[seen].astype(np.float64) for group, values in arrays.items()}
    by = {"means": wide["means"], "quaternions": wide["quaternions"], "sh": wide["sh_dc"][:, None]}
    given = {name: np.asarray(values, np.float64)[seen] for name, values in frozen.gaussians.arrays().items()}
    degree = frozen.gaussians.sh_degree
    wanted = reference(given["means"], given["quaternions"], given["sh"], bench.camera, degree, by)
    (got,) = outcome.arrays
    return outcome.compared({"turn": (got[:3], wanted[:3]), "shift": (got[3:], wanted[3:])})


def of_lens(bench: CaseBench) -> StageOutcome:
    """Test the lens gradient from synthetic slots."""
    device, model, made = bench.device, bench.model, MadeUpSlots.of(bench)

    def launch() -> DeviceArray:
        gradients = allocate_gaussians(device, model.count, model.coefficients)
        screen, by_lens = (
            bench.work.array(name, (model.count, width)) for name, width in (("screen", 2), ("lens", LENS_NUMBERS))
        )
        view = (bench.camera_array, bench.projected, made.slots, gradients, Screen(screen))
        project_grad(device, model, *view, by_lens=by_lens)
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
