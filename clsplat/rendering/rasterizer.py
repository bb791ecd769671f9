# SPDX-License-Identifier: Apache-2.0
"""The forward pass and its gradient, each on one screen, and the renderer that callers use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate
from clsplat.device.context import Device
from clsplat.device.layout import PLAIN_SLOTS, WIDEST_SLOTS, SlotFields
from clsplat.errors import InputError
from clsplat.rendering.build_flags import kernel_defines
from clsplat.rendering.memory_plan import Plan
from clsplat.stages.adam import REFUSED
from clsplat.stages.blend import Blended, blend, blend_grad
from clsplat.stages.channels import Channels, Features, channels, features
from clsplat.stages.deep import deep
from clsplat.stages.device_camera import pack_camera, tiles_of
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
)
from clsplat.stages.duplicate import (
    MAX_PAIRS,
    Band,
    Counted,
    Pairs,
    count,
    count_band,
    duplicate,
    duplicate_and_sort,
    plan_bands,
)
from clsplat.stages.project import Projected, Screen, Slots, add_slots, project, project_grad
from clsplat.stages.ranges import TileLists, tile_lists

PROJECTION_DEFINES: dict[str, dict[str, object]] = {
    "orthographic": {"ORTHOGRAPHIC": True},
    "equirectangular": {"RAYS": 1},
    "fisheye": {"RAYS": 2},
}
"""Defines of the kernels for a camera that is no pinhole."""


@dataclass(frozen=True, eq=False)
class Part:
    """The unit of listing and blending: a band of tiles and its pairs."""

    band: Band
    counted: Counted
    pairs: Pairs
    lists: TileLists


@dataclass(frozen=True, eq=False)
class Frame:
    """One forward pass: every stage's arrays, valid until the rasterizer's next forward pass.

    bands: one of all tiles, unless memory is short; then `part` is the last one's; refused: what `adam` had counted in
    `Rasterizer.found` by then.
    """

    camera: Camera
    camera_array: DeviceArray
    background: DeviceArray
    projected: Projected
    bands: tuple[Band, ...]
    part: Part
    blended: Blended
    refused: tuple[int, ...] = ()

    @property
    def pairs(self) -> Pairs:
        """Pairs of all tiles, if there is one band."""
        return self.part.pairs

    @property
    def lists(self) -> TileLists:
        """Lists of all tiles, if there is one band."""
        return self.part.lists


class Rasterizer:
    """The pipeline on one device, with the memory that it works in, which can be another's.

    capacity: most (tile, Gaussian) pairs that are worked on together; the rasterizer's owner plans it; found (8,)
    uint32: values that a pass reads back, and in the last four the counts of `adam`.
    """

    def __init__(self, device: Device, config: RasterizerConfig | None = None, work: Workspace | None = None) -> None:
        self.config = config or RasterizerConfig()
        self._switches = self.config.switches()
        switches = {**device.switches, **kernel_defines(self.config)}
        self.device = device.with_switches(switches)
        self._by_projection = {
            name: device.with_switches({**switches, **defines}) for name, defines in PROJECTION_DEFINES.items()
        }
        self.work = work or Workspace(device)
        # What `count` reads each time, with room for what training counts beside it: one copy for both.
        self.found = allocate(device, (4 + len(REFUSED),), np.uint32)
        self.found.fill(0)
        self._all_bits = self._switches.key_bits == "all"
        self.capacity = min(device.max_allocation // (4 * WIDEST_SLOTS.floats), MAX_PAIRS)

    def follow(self, plan: Plan) -> None:
        """Work in as much memory as the plan has for it. Where that is tight, what an earlier plan left goes."""
        self.work.tight = self.device.memory.limit is not None or plan.tight
        if self.work.tight:
            self.work.clear()
        self.capacity = plan.pairs

    def forward(
        self, gaussians: AnyGaussians, camera: Camera, background: DeviceArray, *, backward: bool = True
    ) -> Frame:
        """Project, sort by depth, duplicate, sort by tile, blend (Kerbl et al. 2023, algorithm 2).

        backward: whether the gradient will be asked for; what only that needs is left out else.
        """
        device, work = self.device_of(camera), self.work
        camera_array = work.array("camera", (len(pack := pack_camera(camera)),))
        camera_array.set(pack)
        projected = project(device, work, gaussians, camera, camera_array)
        of = (projected.splats, projected.tile_counts, projected.shown)
        counted = count(device, work, *of, all_bits=self._all_bits, found=self.found)
        bands = self._plan(device, projected, counted, tiles_of(camera))
        part = None
        for band in bands:
            del part  # its arrays may have to make room for larger ones
            part = self._part(device, projected, band, tiles_of(camera), counted if len(bands) == 1 else None)
            size = (camera.width, camera.height)
            record = backward and len(bands) == 1 and self._switches.record_cells
            blended = blend(
                device,
                work,
                part.lists,
                projected.splats,
                background,
                *size,
                band,
                record=record,
                camera_array=camera_array,
            )
        assert part is not None, "an image has a tile"
        return Frame(camera, camera_array, background, projected, bands, part, blended, counted.beside)

    def part(self, frame: Frame, band: Band) -> Part:
        """The band with its pairs and lists; where there are several bands it takes the memory of the one before."""
        if len(frame.bands) == 1:
            return frame.part
        return self._part(self.device_of(frame.camera), frame.projected, band, tiles_of(frame.camera))

    def channels(self, gaussians: AnyGaussians, frame: Frame, wanted: Features, after: DeviceArray) -> Channels:
        """The frame's channels beside colour; after: the packed camera that motion goes to."""
        device, work, projected = self.device_of(frame.camera), self.work, frame.projected
        rows = features(device, work, wanted, gaussians, frame.camera_array, after, projected)
        found = None
        for band in frame.bands:
            part = self.part(frame, band)
            found = channels(
                device,
                work,
                wanted,
                rows,
                part.lists,
                projected,
                frame.blended,
                frame.camera.height,
                band,
                frame.camera_array,
            )
            del part  # as in `forward`
        assert found is not None, "an image has a tile"
        return found

    def deep(self, frame: Frame, bounds: DeviceArray) -> DeviceArray:
        """The frame in slices by depth, as `stages.deep` has them."""
        device, found = self.device_of(frame.camera), None
        for band in frame.bands:
            part = self.part(frame, band)
            of = (part.lists, frame.projected.splats, frame.blended, frame.camera.height, band, frame.camera_array)
            found = deep(device, self.work, bounds, *of)
            del part  # as in `forward`
        assert found is not None, "an image has a tile"
        return found

    def device_of(self, camera: Camera) -> Device:
        """The device with the switches that the camera's projection wants of the kernels."""
        return self._by_projection.get(camera.projection, self.device)

    def _plan(self, device: Device, projected: Projected, counted: Counted, tiles: tuple[int, int]) -> tuple[Band, ...]:
        if counted.pairs <= self.capacity:
            return (Band(0, tiles[0] * tiles[1]),)
        return plan_bands(device, self.work, projected, tiles, self.capacity)

    def _part(
        self,
        device: Device,
        projected: Projected,
        band: Band,
        tiles: tuple[int, int],
        counted: Counted | None = None,
    ) -> Part:
        work = self.work
        counted = counted or count_band(device, work, projected, tiles, band, all_bits=self._all_bits)
        listing = duplicate_and_sort if self._switches.depth_sort == "pairs" else duplicate
        pairs = listing(device, work, projected.splats, counted, tiles, band)
        return Part(band, counted, pairs, tile_lists(device, work, pairs, band.tiles, all_bits=self._all_bits))

    def backward(
        self,
        gaussians: DeviceGaussians,
        frame: Frame,
        image_gradient: DeviceArray,
        gradients: DeviceGaussians,
        *,
        fields: SlotFields = PLAIN_SLOTS,
    ) -> Screen:
        """Fill the visible rows of `gradients`; returns what density control has of the view, as `fields` wants it."""
        slots = self.pair_gradients(frame, image_gradient, fields=fields)
        return self.row_gradients(gaussians, frame, frame.projected, slots, gradients, fields=fields)

    def row_gradients(
        self,
        gaussians: DeviceGaussians,
        frame: Frame,
        projected: Projected,
        slots: Slots,
        gradients: DeviceGaussians,
        *,
        fields: SlotFields = PLAIN_SLOTS,
        sh_rest: bool = True,
    ) -> Screen:
        """The gradient of projection, for some rows or all: as `backward`, from what blending's gradient is; that of
        the higher SH bands if asked for."""
        device, n, work = self.device, gaussians.count, self.work
        contributions = work.array("contributions", (n,)) if fields.contributions else None
        screen = Screen(work.array("screen", (n, 2)), contributions)
        of = (gaussians, frame.camera_array, projected, slots, gradients, screen)
        project_grad(device, *of, fields=fields, sh_rest=sh_rest)
        return screen

    def pair_gradients(
        self,
        frame: Frame,
        image_gradient: DeviceArray,
        *,
        fields: SlotFields = PLAIN_SLOTS,
        contributions_alone: bool = False,
    ) -> Slots:
        """The gradient of blending: of every pair, or with several bands their sums by Gaussian. Raises InputError for
        another projection than perspective, which has none; contributions_alone: nothing but them is taken from it, and
        an orthographic camera's splats have them too."""
        known = ("perspective", "orthographic") if contributions_alone else ("perspective",)
        if (kind := frame.camera.projection) not in known:
            raise InputError(f"a gradient is asked for of a camera that is {kind}, expected a perspective one")
        device, work, projected = self.device, self.work, frame.projected
        sums = None
        for band in frame.bands:
            part = self.part(frame, band)
            values = blend_grad(
                device,
                work,
                part.lists,
                projected.splats,
                frame.background,
                frame.blended,
                image_gradient,
                band,
                fields=fields,
            )
            slots = Slots(values, part.counted.first_slots)
            if len(frame.bands) == 1:
                return slots
            sums = add_slots(device, work, part.counted.tile_counts, slots, sums, fields=fields)
            del part, values, slots  # as in `forward`
        assert sums is not None
        return Slots(sums)
