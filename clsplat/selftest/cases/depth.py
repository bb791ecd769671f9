# SPDX-License-Identifier: Apache-2.0
"""Self-test of the depth stage: the blended nearness (1 / depth), the depth loss, and the gradients of both."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.layouts.columns import SLOT_PLAIN, SlotFields
from clsplat.reference import blend as reference_blend
from clsplat.reference.depth import depth_loss
from clsplat.selftest.harness import MIN_DECISION_MARGIN, Array, CaseBench, StageOutcome, cropped
from clsplat.selftest.scenes import evenly, padded
from clsplat.stages.blend import Blended, blend, blend_grad
from clsplat.stages.loss import Loss, loss
from clsplat.stages.loss_terms import DepthTerm

NEARNESS_SLOTS = SlotFields(nearness=True)
DEPTH_LOSS_FACTOR = 0.125
"""Factor of the depth loss in the tested sum of losses."""
MIN_NEARNESS_DIFFERENCE = 1e-5
"""Least difference between rendered and known nearness for a pixel's gradient to be compared. Below it, rounding may
change the gradient's sign."""


def of_depth(bench: CaseBench) -> StageOutcome:
    """Test the nearness of the scene, and the depth loss with synthetic known depths, of which a quarter is missing.

    The digest leaves out the gradients of pairs, because the order of their sums depends on the kernel shape.
    """
    device, camera = bench.device, bench.camera
    height, width = camera.height, camera.width
    planes = padded(camera, 36, 0.0, 0.5)[:2].astype(np.float32)
    planes[1][planes[1] < 0.125] = 0.0
    aims, photograph = DepthTerm(planes, DEPTH_LOSS_FACTOR), upload(device, bench.frozen.photograph)

    def launch() -> tuple[Blended, Loss]:
        blended = blend(device, bench.work, bench.lists, bench.inputs, nearness=True)
        return blended, loss(
            device, bench.work, blended.image, photograph, width, height, 0.2, blended=blended, terms=(aims,)
        )

    def take(made: tuple[Blended, Loss]) -> list[Array]:
        assert made[0].nearness is not None
        return [cropped(made[0].nearness.get(), camera), cropped(made[1].gradient.get(), camera)[:, :, 3]]

    made, outcome = bench.twice(launch, take)
    nearness, gradient = outcome.arrays
    splats = bench.splats()
    known, weights = (cropped(plane, camera).astype(np.float64) for plane in planes)
    background = bench.frozen.background.astype(np.float64)
    seen = reference_blend.blend(splats, width, height, background)
    clear = seen.margin > MIN_DECISION_MARGIN
    _, by_nearness = depth_loss(seen.nearness, known, weights, DEPTH_LOSS_FACTOR)
    sure = clear & (np.abs(seen.nearness - known) > MIN_NEARNESS_DIFFERENCE)
    by_pixel = np.where(clear, evenly(37, (height, width), -0.5, 0.5), 0.0)
    four = np.zeros((4, *planes.shape[1:]), np.float32)
    four[3, :height, :width] = by_pixel
    slots = _slots(bench, made[0], upload(device, four))
    by_near, nothing = four[3, :height, :width].astype(np.float64), np.zeros((height, width, 3))
    wanted = reference_blend.blend_grad(splats, width, height, background, nothing, d_nearness=by_near)
    shown = splats.visible
    return outcome.compared(
        {
            "nearness": (nearness[clear], seen.nearness[clear]),
            "gradient": (gradient[sure], by_nearness[sure]),
            "gradient by one over the depth": (slots[shown, SLOT_PLAIN], wanted.nearness[shown]),
            "sum of g": (slots[shown, 0], (wanted.opacities * splats.opacities)[shown]),
        }
    )


def _slots(bench: CaseBench, blended: Blended, gradient: DeviceArray) -> Array:
    """Launch the gradient of blending, and return the float64 sums (n, columns) of each Gaussian's slots."""
    lists, pixels = bench.lists, (bench.inputs, blended, gradient)
    slots = blend_grad(bench.device, bench.work, lists, *pixels, fields=NEARNESS_SLOTS).get()
    sums = np.zeros((bench.model.count, NEARNESS_SLOTS.floats))
    np.add.at(sums, lists.gaussian_from_sorted.get(), slots[lists.slot_from_sorted.get()].astype(np.float64))
    return sums
