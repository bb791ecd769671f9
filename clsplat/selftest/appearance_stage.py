# SPDX-License-Identifier: Apache-2.0
"""The self-test's stage of appearance: gains of photographs, their gradient and Adam's step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.layout import READBACK
from clsplat.reference import appearance as reference
from clsplat.selftest.harness import Array, Bench, Outcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import Gains, apply_gains, gain_gradient, step_gains

VIEW, STEP, RATE = 1, 5, 0.03125


def of_appearance(bench: Bench) -> Outcome:
    """A photograph of three, whose picture is what the scene's blending has made."""
    device, camera, image = bench.device, bench.camera, bench.blended.image
    logs = evenly(41, (3, 3), -1.0, 1.0).astype(np.float32)
    start, pull = evenly(43, (3, 3), -1.0, 1.0).astype(np.float32), evenly(44, (3, 3), 0.0, 0.5).astype(np.float32)
    pull[2] = pull[:, 2] = 0  # a photograph that is not pulled
    by_seen = evenly(42, tuple(image.shape), -0.25, 1.0).astype(np.float32)
    by_seen[:, :, camera.width :] = 0  # like the gradient of the loss
    readback = upload(device, np.zeros(len(READBACK), np.uint32))

    def launch() -> tuple[Gains, DeviceArray, DeviceArray, DeviceArray]:
        gains, gradient = (
            replace(Gains.on(device, logs, csr_array(pull)), start=upload(device, start)),
            upload(device, by_seen),
        )
        seen = apply_gains(device, bench.work, gains, VIEW, image)
        columns = gain_gradient(device, bench.work, gains, VIEW, seen, gradient, camera.height)
        step_gains(device, gains, VIEW, columns, STEP, RATE, readback)
        return gains, seen, gradient, columns

    def take(results: tuple[Gains, DeviceArray, DeviceArray, DeviceArray]) -> list[Array]:
        gains, seen, gradient, columns = results
        made = (gains.logs, gains.first, gains.second, gains.gains, columns)
        return [*(array.get() for array in made), cropped(seen.get(), camera), cropped(gradient.get(), camera)]

    _, outcome = bench.twice(launch, take)
    got = dict(zip(("logs", "first", "second", "gains", "columns", "seen", "gradient"), outcome.arrays, strict=True))
    given = (cropped(image.get(), camera).astype(np.float64), logs[VIEW].astype(np.float64))
    by_image, by_logs = reference.gradient(*given, cropped(by_seen, camera).astype(np.float64))
    gradients, zeros = np.zeros((3, 3)), np.zeros((3, 3))
    gradients[VIEW] = by_logs + reference.pull(*(array.astype(np.float64) for array in (logs, start, pull)))[VIEW]
    after = reference.step(logs.astype(np.float64), zeros, zeros, gradients, STEP, RATE)
    parts = dict(zip(("logs", "first", "second"), after, strict=True)) | {"gains": np.exp2(after[0])}
    parts |= {"seen": reference.apply(*given), "gradient": by_image}
    return outcome.compared({name: (got[name], wanted) for name, wanted in parts.items()})
