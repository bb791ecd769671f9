# SPDX-License-Identifier: Apache-2.0
"""Launches splats.cl and splats_grad.cl: splats from arrays of projected Gaussians, and the gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import SLOT, SPLAT, TILE
from clsplat.stages.project import Projected, Slots

SPLAT_VALUES = 3
"""Number of values of a splat that blend.cl blends: its columns RED to BLUE."""
SLOT_MOMENT_FIELDS = SLOT.index("RED")
"""Number of fields in a slot before the fields of the gradient with respect to values."""


@dataclass(frozen=True, eq=False)
class ScreenGaussians:
    """Projected Gaussians as an array for each property, like the results of gsplat's projection.

    radii: (n, 2) int32 in pixels; a Gaussian with a radius of 0 is culled.
    means2d: (n, 2) in pixels.
    conics: (n, 3), a, b and c of the inverse covariance.
    opacities: (n,) in [0, 1].
    depths: (n,).
    values: (n, width); the first three are the splat's colour.
    """

    radii: DeviceArray
    means2d: DeviceArray
    conics: DeviceArray
    opacities: DeviceArray
    depths: DeviceArray
    values: DeviceArray

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self.means2d.shape[0]

    @property
    def width(self) -> int:
        """Number of values per Gaussian."""
        return self.values.shape[1]


@dataclass(frozen=True, eq=False)
class ScreenGradients:
    """Gradients with respect to means2d (n, 2), conics (n, 3), opacities (n,) and values (n, width).

    absolute: (n, 2), sums over pixels of the absolute gradient with respect to means2d; None if not requested.
    """

    means2d: DeviceArray
    conics: DeviceArray
    opacities: DeviceArray
    values: DeviceArray
    absolute: DeviceArray | None = None


@stage("splats")
def splats(
    device: Device, work: Workspace, gaussians: ScreenGaussians, width: int, height: int, *, listed: bool = False
) -> Projected:
    """Compute splats and tile counts for an image of width x height pixels.

    listed: make splats of culled Gaussians too, because the caller's tile lists may contain them.
    """
    n = gaussians.count
    projected = Projected(work.array("splats", (n, len(SPLAT))), work.array("tile_counts", (n,), np.uint32))
    launch_items(
        device,
        device.kernels("splats", {"LISTED": True} if listed else {}).splats,
        -(-n // device.shape.lanes),
        n,
        -(-width // TILE),
        -(-height // TILE),
        gaussians.width,
        gaussians.radii,
        gaussians.means2d,
        gaussians.conics,
        gaussians.opacities,
        gaussians.depths,
        gaussians.values,
        projected.splats,
        projected.tile_counts,
    )
    return projected


@stage("splats_grad")
def splats_grad(
    device: Device,
    projected: Projected,
    slots: Slots,
    gradients: ScreenGradients,
    *,
    kept: int = SPLAT_VALUES,
) -> None:
    """Fill every row of `gradients` from the slots of the pairs.

    slots: filled by blend_grad.cl or values_grad.cl, with or without absolute gradients.
    kept: number of values, from the first on, whose gradients the slots hold.
    """
    assert slots.first_slots is not None, "expected slots of pairs, not their sums over bands"
    n, width = gradients.values.shape
    defines: dict[str, object] = {"LANES": 1, "VALUES": kept, **slots.fields.defines}
    launch_items(
        device,
        device.kernels("splats_grad", defines).splats_grad,
        n,
        n,
        width,
        0,
        projected.tile_counts,
        slots.first_slots,
        slots.values,
        projected.splats,
        gradients.means2d,
        gradients.conics,
        gradients.opacities,
        gradients.values,
        *([gradients.absolute] if slots.fields.absolute else []),
    )


@stage("splats_grad")
def add_values(
    device: Device, projected: Projected, slots: Slots, d_values: DeviceArray, first: int, count: int
) -> None:
    """Write the sums of each Gaussian's slots to columns of d_values (n, width).

    slots: (pairs, count), gradients with respect to `count` values.
    first: the first of the `count` columns.
    """
    n, width = d_values.shape
    kernel = device.kernels("splats_grad", {"LANES": 1, "VALUES": count}).add_values
    counts = (projected.tile_counts, slots.first_slots)
    launch_items(device, kernel, n, n, width, first, *counts, slots.values, d_values)
