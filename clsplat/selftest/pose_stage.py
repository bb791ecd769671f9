# SPDX-License-Identifier: Apache-2.0
"""The self-test's stage of poses: the gradient by a camera's pose."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.reference.pose import pose_gradient as reference
from clsplat.selftest.harness import Array, Bench, Outcome
from clsplat.selftest.scenes import evenly
from clsplat.stages.device_gaussians import DeviceGaussians
from clsplat.stages.pose import pose_gradient, pose_rows, sums_of

MADE_UP = ("means", "quaternions", "sh_dc")


def of_pose(bench: Bench) -> Outcome:
    """Gradients that are made up, of the Gaussians that the scene's view shows."""
    device, model, frozen = bench.device, bench.model, bench.frozen
    arrays = {
        group: evenly(51 + index, model[group].shape, -0.25, 0.5).astype(np.float32)
        for index, group in enumerate(MADE_UP)
    }
    gradients = DeviceGaussians(
        model.count, model.coefficients, {group: upload(device, values) for group, values in arrays.items()}
    )

    def launch() -> DeviceArray:
        sums = sums_of(bench.work, model.count)
        pose_rows(device, model, bench.camera_array, bench.projected.tile_counts, gradients, sums)
        return pose_gradient(device, bench.work, sums)

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
