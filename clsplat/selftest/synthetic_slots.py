# SPDX-License-Identifier: Apache-2.0
"""Synthetic slots of pairs and the gradients that follow from them. They replace the output of the gradient of blending
in tests of later stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.device.buffers import upload
from clsplat.layouts.columns import SLOT, SLOT_PLAIN
from clsplat.reference import project as reference_project
from clsplat.reference.render import project_model
from clsplat.selftest.harness import WHITENING_FACTOR, Array, CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.project import Slots, ViewSlots

SLOT_MOMENTS = slice(SLOT.index("G"), SLOT.index("GVV") + 1)
"""Columns of a slot: the sum of g (docs/gradients.md), then the first and second moments of g."""
SLOT_COLOURS = slice(SLOT.index("RED"), SLOT.index("BLUE") + 1)
"""Columns of a slot: the gradient with respect to red, green and blue."""


def slot_sums(bench: CaseBench, slots: Array) -> Float64:
    """Sum the slots (pairs, SLOT_PLAIN) of each Gaussian in float64. Returns (n, SLOT_PLAIN)."""
    sums = np.zeros((bench.model.count, SLOT_PLAIN))
    np.add.at(
        sums, bench.lists.gaussian_from_sorted.get(), slots[bench.lists.slot_from_sorted.get()].astype(np.float64)
    )
    return sums


@dataclass(frozen=True, eq=False)
class MadeUpSlots:
    """Synthetic slots, one for each pair of the scene, and their float64 sums (n, SLOT_PLAIN) for each Gaussian."""

    view: ViewSlots
    sums: Float64

    @classmethod
    def of(cls, bench: CaseBench) -> MadeUpSlots:
        """Make synthetic slots for the pairs of the bench's scene."""
        values = evenly(33, (bench.counted.pairs, SLOT_PLAIN), -1.0, 1.0).astype(np.float32)
        slots = Slots(upload(bench.device, values), bench.counted.first_slots)
        return cls(ViewSlots(bench.camera_array, bench.projected, slots), slot_sums(bench, values))

    def d_means(self, bench: CaseBench) -> Float64:
        """Return gradients (n, 2) per pixel with respect to the means on the image, by (50) of docs/gradients.md."""
        l11, l12, l22 = (WHITENING_FACTOR * bench.splats().whitening).T
        _, u, v, *_ = self.sums[:, SLOT_MOMENTS].T
        found: Float64 = -np.stack([l11 * u, l12 * u + l22 * v], axis=1) / WHITENING_FACTOR**2
        return found

    def on_image(self, bench: CaseBench) -> reference_project.ProjectedGradients:
        """Return gradients with respect to the scene's projected Gaussians, as the float64 reference stores them."""
        l11, l12, l22 = (WHITENING_FACTOR * bench.splats().whitening).T
        *_, uu, uv, vv = self.sums[:, SLOT_MOMENTS].T
        entries = [l11 * l11 * uu, l11 * (l12 * uu + l22 * uv), l12 * l12 * uu + 2 * l12 * l22 * uv + l22 * l22 * vv]
        gaussians = bench.frozen.gaussians
        true = project_model(gaussians, bench.camera, gaussians.sh_degree)
        by_opacity = self.sums[:, SLOT.index("G")] / np.where(bench.visible, true.opacities, 1.0)
        by_covariance = 0.5 / WHITENING_FACTOR**4 * np.stack(entries, axis=1)
        by_colour = self.sums[:, SLOT_COLOURS]
        return reference_project.ProjectedGradients(self.d_means(bench), by_covariance, by_opacity, by_colour)
