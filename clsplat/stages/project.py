# SPDX-License-Identifier: Apache-2.0
"""Launches project.cl and project_grad.cl: Gaussians to ellipses on the image, and the gradient back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import PLAIN_SLOTS, SPLAT, SlotFields
from clsplat.device.profile import stage
from clsplat.gaussians import GROUPS
from clsplat.stages.device_camera import tiles_of
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, parts

SCREEN_BYTES = 8
"""Bytes of each Gaussian's gradient on the image; 4 more where contributions are kept."""


def gaussian_bytes(*, keeps_culled: bool) -> int:
    """Bytes of each Gaussian: splat and count of tiles; where culling is switched off also `shown`."""
    return 4 * (len(SPLAT) + 1 + keeps_culled)


@dataclass(frozen=True, eq=False)
class Projected:
    """splats (n, SPLAT), tile_counts (n): 0 where culled; shown (n): 0 where there is no splat, if that is another
    thing because culling is switched off."""

    splats: DeviceArray
    tile_counts: DeviceArray
    shown: DeviceArray | None = None

    def rows(self, start: int, stop: int) -> Projected:
        """The projected Gaussians from start to before stop."""
        shown = None if self.shown is None else self.shown.rows(start, stop)
        return Projected(self.splats.rows(start, stop), self.tile_counts.rows(start, stop), shown)


@stage("project")
def project(
    device: Device, work: Workspace, gaussians: AnyGaussians, camera: Camera, camera_array: DeviceArray
) -> Projected:
    """Project all Gaussians (Kerbl et al. 2023, section 4) and count the tiles that each reaches."""
    n = gaussians.count
    splats = work.array("splats", (n, len(SPLAT)))
    tile_counts = work.array("tile_counts", (n,), np.uint32)
    rays = device.switched("RAYS")
    keeps_culled = not rays and device.switched("NO_FRUSTUM_CULL", "NO_OPACITY_CULL")
    projected = Projected(splats, tile_counts, work.array("shown", (n,), np.uint32) if keeps_culled else None)
    for start, stop, (part,) in parts(work, gaussians):
        out = projected.rows(start, stop)
        defines: dict[str, object] = {"SH_DEGREES": True} if "sh_degrees" in part.arrays else {}
        if part["sh_rest"].dtype == np.float16:
            defines["SH_HALF"] = True
        if rays:
            kernel, lanes = device.kernels("project_rays", LANES=1, **defines).project_rays, 1
        else:
            kernel, lanes = device.kernels("project", **defines).project, device.shape.lanes
        launch_items(
            device,
            kernel,
            -(-part.count // lanes),
            part.count,
            part.coefficients,
            *((camera.width, camera.height) if rays else tiles_of(camera)),
            camera_array,
            *(part[group] for group in GROUPS),
            out.splats,
            out.tile_counts,
            *(() if out.shown is None else (out.shown,)),
            *([part["sh_degrees"]] if "sh_degrees" in part.arrays else []),
        )
    return projected


@dataclass(frozen=True, eq=False)
class Slots:
    """values (pairs, SlotFields.floats), where those of Gaussian i begin at first_slots[i]; without first_slots they
    are added up already: (n, SlotFields.floats)."""

    values: DeviceArray
    first_slots: DeviceArray | None = None

    def rows(self, start: int, stop: int) -> Slots:
        """The slots of the Gaussians from start to before stop."""
        if self.first_slots is None:
            return Slots(self.values.rows(start, stop))
        return Slots(self.values, self.first_slots.rows(start, stop))


@dataclass(frozen=True, eq=False)
class Screen:
    """Results on the image of one view, in rows of the visible: gradients (n, 2) of the means on the image, in pixels;
    contributions (n,), the sums of blending weights over the image's pixels, or None."""

    gradients: DeviceArray
    contributions: DeviceArray | None = None


@stage("project_grad")
def add_slots(
    device: Device,
    work: Workspace,
    tile_counts: DeviceArray,
    slots: Slots,
    sums: DeviceArray | None,
    *,
    fields: SlotFields = PLAIN_SLOTS,
) -> DeviceArray:
    """Add one band's slots to the sums by Gaussian (n, floats), which begin as None; bands have to come in order."""
    (n,) = tile_counts.shape
    if sums is None:
        sums = work.array("slot_sums", (n, slots.values.shape[1]))
        sums.fill(0.0)
    kernel, items = device.kernels("project_grad", **fields.defines).add_slots, n if slots.values.shape[0] else 0
    launch_items(device, kernel, items, n, tile_counts, slots.first_slots, slots.values, sums)
    return sums


@stage("project_grad")
def project_grad(
    device: Device,
    gaussians: DeviceGaussians,
    camera_array: DeviceArray,
    projected: Projected,
    slots: Slots,
    gradients: DeviceGaussians,
    screen: Screen,
    *,
    fields: SlotFields = PLAIN_SLOTS,
    sh_rest: bool = True,
) -> None:
    """Fill the visible Gaussians' rows of `gradients` (of sh_rest if asked for) and `screen` from the pairs' slots,
    which have `fields`."""
    wanted = {"ADDED_UP": slots.first_slots is None, "NO_SH_REST": not sh_rest and gaussians.coefficients > 1}
    defines = {**fields.defines, **{name: True for name, needed in wanted.items() if needed}}
    n = gaussians.count
    first_slots = slots.first_slots or projected.tile_counts  # not looked at where they are added up
    launch_items(
        device,
        device.kernels("project_grad", **defines).project_grad,
        -(-n // device.shape.lanes) if slots.values.shape[0] else 0,
        n,
        gaussians.coefficients,
        camera_array,
        projected.tile_counts,
        first_slots,
        slots.values,
        projected.splats,
        *(model[group] for model in (gaussians, gradients) for group in GROUPS),
        screen.gradients,
        *([screen.contributions] if fields.contributions else []),
    )
