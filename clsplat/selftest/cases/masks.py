# SPDX-License-Identifier: Apache-2.0
"""Self-test of the stage that only photographs with masks need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from clsplat.device.buffers import Workspace, upload
from clsplat.reference import loss as reference_loss
from clsplat.selftest.harness import CaseBench, StageOutcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.loss import Loss, loss
from clsplat.stages.loss_terms import AlphaTerm
from clsplat.stages.target import target

ALPHA_LOSS_WEIGHT = 0.5
"""Weight of the alpha loss."""
MIN_ALPHA_DIFFERENCE = 1e-5
"""Difference of alphas below which rounding decides the gradient's sign."""


def _masks(bench: CaseBench) -> StageOutcome:
    """Test a photograph with a mask and alpha, and the loss terms of both."""
    device, camera, made = bench.device, bench.camera, bench.blended
    height, width = camera.height, camera.width
    photograph = evenly(35, (height, width, 5), 0.0, 1.0).astype(np.float32)
    photograph[:, :, 4] = 1
    photograph[: height // 2 + 3, : width // 2 + 5, 4] = 0
    render, stops, work = made.image.get(), made.stops.get(), Workspace(device)

    def launch() -> Loss:
        # masked pixels of the render become zero, and the next stages need all of it
        blended = replace(made, image=upload(device, render), stops=upload(device, stops))
        planes = target(device, work, photograph, bench.background, blended, alpha=True)
        kept, terms = int(photograph[:, :, 4].sum()), (AlphaTerm(ALPHA_LOSS_WEIGHT),)
        return loss(device, work, blended.image, planes, width, height, 0.2, kept=kept, blended=blended, terms=terms)

    result, outcome = bench.twice(launch, lambda result: [result.gradient.get()[:, :height]])
    parts = photograph.astype(np.float64)
    alpha, counts = parts[:, :, 3], parts[:, :, 4]
    behind = (1 - alpha)[:, :, None] * bench.frozen.background.astype(np.float64)
    truth, seen = parts[:, :, :3] * alpha[:, :, None] + behind, cropped(render, camera).astype(np.float64)
    left = cropped(made.transmittance.get(), camera).astype(np.float64)
    value, gradient = reference_loss.masked_l1_dssim(seen, truth, counts)
    of_alpha, by_left = reference_loss.alpha_loss(left, alpha, counts, ALPHA_LOSS_WEIGHT)
    got, sure = cropped(outcome.arrays[0], camera), np.abs(1 - left - alpha) > MIN_ALPHA_DIFFERENCE
    compared = {
        "gradient": (got[:, :, :3][counts > 0], gradient[counts > 0]),  # blending's gradient skips the others
        "gradient by transmittance": (got[:, :, 3][sure], by_left[sure]),
        "loss": (np.array(result.read()[:1]), np.array([value + of_alpha])),
    }
    return outcome.compared(compared, masked_pixels=int(np.count_nonzero(got[:, :, 3][counts == 0])))


MASK_CASES: dict[str, Callable[[CaseBench], StageOutcome]] = {"masks": _masks}
