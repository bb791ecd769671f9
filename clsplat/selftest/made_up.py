# SPDX-License-Identifier: Apache-2.0
"""Slots of pairs that are made up, and what they say of the image: so no error of blending's gradient is counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.device.buffers import upload
from clsplat.device.layout import SLOT, SLOT_PLAIN
from clsplat.reference import project as reference_project
from clsplat.reference.render import parameters
from clsplat.selftest.harness import WHITEN, Array, Bench
from clsplat.selftest.scenes import evenly
from clsplat.stages.project import Slots

MOMENTS = slice(SLOT.index("G"), SLOT.index("GVV") + 1)
COLOUR = slice(SLOT.index("RED"), SLOT.index("BLUE") + 1)


def slot_sums(bench: Bench, slots: Array) -> Float64:
    """(n, 9) sums of each Gaussian's slots in float64."""
    sums = np.zeros((bench.model.count, SLOT_PLAIN))
    np.add.at(
        sums, bench.lists.gaussian_from_sorted.get(), slots[bench.lists.slot_from_sorted.get()].astype(np.float64)
    )
    return sums


@dataclass(frozen=True, eq=False)
class MadeUpSlots:
    """Slots, and their sums (n, 9) by Gaussian in float64."""

    slots: Slots
    sums: Float64

    @classmethod
    def of(cls, bench: Bench) -> MadeUpSlots:
        """Slots of the scene's pairs."""
        values = evenly(33, (bench.counted.pairs, SLOT_PLAIN), -1.0, 1.0).astype(np.float32)
        return cls(Slots(upload(bench.device, values), bench.counted.first_slots), slot_sums(bench, values))

    def d_means(self, bench: Bench) -> Float64:
        """Gradients (n, 2) by the means on the image, per pixel: docs/gradients.md (50)."""
        l11, l12, l22 = (WHITEN * bench.splats().whitening).T
        _, u, v, *_ = self.sums[:, MOMENTS].T
        found: Float64 = -np.stack([l11 * u, l12 * u + l22 * v], axis=1) / WHITEN**2
        return found

    def on_image(self, bench: Bench) -> dict[str, Any]:
        """The scene as its camera projects it, and the gradients by means, covariances and opacities, as the twins of
        projection take them by name."""
        l11, l12, l22 = (WHITEN * bench.splats().whitening).T
        *_, uu, uv, vv = self.sums[:, MOMENTS].T
        entries = [l11 * l11 * uu, l11 * (l12 * uu + l22 * uv), l12 * l12 * uu + 2 * l12 * l22 * uv + l22 * l22 * vv]
        gaussians = bench.frozen.gaussians
        model, degree = parameters(gaussians), gaussians.sh_degree
        true = reference_project.project(**model, camera=bench.camera, sh_degree=degree, antialiased=False)
        by_opacity = self.sums[:, SLOT.index("G")] / np.where(bench.visible, true.opacities, 1.0)
        by_covariance = 0.5 / WHITEN**4 * np.stack(entries, axis=1)
        by = {"d_means2d": self.d_means(bench), "d_covariances": by_covariance, "d_opacities": by_opacity}
        return {"projected": true, **by}
