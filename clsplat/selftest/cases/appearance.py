# SPDX-License-Identifier: Apache-2.0
"""Self-test of the appearance stage: gains of photographs, their gradient and Adam's step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from clsplat.device.buffers import DeviceArray, upload
from clsplat.layouts.columns import READBACK
from clsplat.reference import appearance as reference
from clsplat.selftest.harness import Array, CaseBench, StageOutcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import Gains, gain_gradient, remove_gains, step_gains

GAINS_PHOTOGRAPH, GAINS_STEP, GAINS_RATE = 1, 5, 0.03125


def of_appearance(bench: CaseBench) -> StageOutcome:
    """Test one of three photographs, with the scene's blended image as the render."""
    device, camera, image = bench.device, bench.camera, bench.blended.image
    logs = evenly(41, (3, 3), -1.0, 1.0).astype(np.float32)
    start, pull = evenly(43, (3, 3), -1.0, 1.0).astype(np.float32), evenly(44, (3, 3), 0.0, 0.5).astype(np.float32)
    pull[2] = pull[:, 2] = 0  # a photograph without pull
    photograph = evenly(45, tuple(image.shape), 0.0, 1.0).astype(np.float32)
    by_image = evenly(42, tuple(image.shape), -0.25, 1.0).astype(np.float32)
    by_image[:, :, camera.width :] = 0  # like the gradient of the loss
    readback = upload(device, np.zeros(len(READBACK), np.uint32))

    def launch() -> tuple[Gains, DeviceArray, DeviceArray]:
        gains = replace(Gains.on(device, logs, csr_array(pull)), start=upload(device, start))
        target, gradient = upload(device, photograph), upload(device, by_image)
        remove_gains(device, gains, GAINS_PHOTOGRAPH, target)
        columns = gain_gradient(device, bench.work, image, gradient, camera.height)
        step_gains(device, gains, GAINS_PHOTOGRAPH, columns, GAINS_STEP, GAINS_RATE, readback)
        return gains, target, columns

    def take(results: tuple[Gains, DeviceArray, DeviceArray]) -> list[Array]:
        gains, target, columns = results
        made = (gains.logs, gains.first, gains.second, gains.gains, columns)
        return [*(array.get() for array in made), cropped(target.get(), camera)]

    _, outcome = bench.twice(launch, take)
    got = dict(zip(("logs", "first", "second", "gains", "columns", "target"), outcome.arrays, strict=True))
    shown, wide = (cropped(array, camera).astype(np.float64) for array in (image.get(), by_image))
    by_logs = reference.gradient(shown, wide)
    gradients, zeros = np.zeros((3, 3)), np.zeros((3, 3))
    gradients[GAINS_PHOTOGRAPH] = (
        by_logs + reference.pull(*(array.astype(np.float64) for array in (logs, start, pull)))[GAINS_PHOTOGRAPH]
    )
    after = reference.step(logs.astype(np.float64), zeros, zeros, gradients, GAINS_STEP, GAINS_RATE)
    parts = dict(zip(("logs", "first", "second"), after, strict=True)) | {"gains": np.exp2(after[0])}
    parts["target"] = reference.removed(
        cropped(photograph, camera).astype(np.float64), logs[GAINS_PHOTOGRAPH].astype(np.float64)
    )
    return outcome.compared({name: (got[name], wanted) for name, wanted in parts.items()})
