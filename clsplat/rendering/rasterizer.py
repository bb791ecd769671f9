# SPDX-License-Identifier: Apache-2.0
"""The forward pass and its gradient, each on one screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import KINDS, Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.thinning import Thinning
from clsplat.device.buffers import DeviceArray, Workspace, allocate, pinned
from clsplat.device.context import Device
from clsplat.device.layout import CAMERA, PLAIN_SLOTS, READBACK, WIDEST_SLOTS, SlotFields
from clsplat.rendering.build_flags import kernel_defines
from clsplat.rendering.memory_plan import Plan
from clsplat.stages.blend import Blended, blend, blend_grad
from clsplat.stages.channels import Channels, Features, Floats, channels, features
from clsplat.stages.deep import deep
from clsplat.stages.device_camera import pack_camera, tiles_of
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians
from clsplat.stages.duplicate import (
    MAX_PAIRS,
    Band,
    Counted,
    Pairs,
    count,
    count_band,
    count_by_capacity,
    duplicate,
    duplicate_and_sort,
    plan_bands,
)
from clsplat.stages.holdout import Held, holdout
from clsplat.stages.project import Projected, Screen, Slots, add_slots, project, project_grad, thinning_numbers
from clsplat.stages.ranges import TileLists, tile_lists

R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Part:
    """The unit of listing and blending: the pairs of a band of tiles."""

    counted: Counted
    pairs: Pairs
    lists: TileLists


TURNS = 3
"""Passes by capacity whose counts are kept apart: that under way, the one before, and the one that is redone."""


@dataclass(frozen=True)
class Room:
    """Arrays of a pass by capacity: for so many pairs; turn: below TURNS, that of its counts."""

    pairs: int
    turn: int


@dataclass(frozen=True, eq=False)
class Frame:
    """One forward pass: every stage's arrays, valid until the rasterizer's next forward pass.

    bands: one of all tiles, unless memory is short; then `part` is the last one's; refused: what `adam` had counted in
    `Rasterizer.readback` by then.
    """

    camera: Camera
    camera_array: DeviceArray
    background: DeviceArray
    projected: Projected
    bands: tuple[Band, ...]
    part: Part
    blended: Blended
    refused: tuple[int, ...] = ()


class Rasterizer:
    """The pipeline on one device, with the memory that it works in, which can be another's.

    capacity: most (tile, Gaussian) pairs that are worked on together; the rasterizer's owner plans it; readback
    (READBACK_SIZE,) uint32: what a pass reads back each time, with the counts of `adam`.
    """

    def __init__(self, device: Device, config: RasterizerConfig | None = None, work: Workspace | None = None) -> None:
        self.config = config or RasterizerConfig()
        self._switches, self._bare = self.config.switches(), device
        self._antialiased: bool | None = None
        self.antialias(on=False)
        self.work = work or Workspace(device)
        self._packs: WeakKeyDictionary[Camera, NDArray[np.float32]] = WeakKeyDictionary()  # training has few cameras
        aligned = -(-len(CAMERA) // device.row_alignment) * device.row_alignment
        self._view = allocate(device, (aligned + 3,), np.float32)
        self._camera, self._background = self._view.reshaped(len(CAMERA)), self._view.rows(aligned, aligned + 3)
        self.readback = allocate(device, (len(READBACK),), np.uint32)
        self.readback.fill(0)
        self._arriving: NDArray[np.uint32] | None = None
        self._all_bits = self._switches.key_bits == "all"
        self.capacity = min(device.max_allocation // (4 * WIDEST_SLOTS.floats), MAX_PAIRS)

    def antialias(self, *, on: bool) -> None:
        """Draw models that are antialiased from here on, or those that are not (`Gaussians.antialiased`)."""
        if on == self._antialiased:
            return
        self._antialiased = on
        self.device = self._bare.with_switches(kernel_defines(self.config, antialiased=on))
        self._by_kind = {
            id(kind): self.device.with_switches(kind.defines) if kind.defines else self.device for kind in KINDS
        }

    def follow(self, plan: Plan) -> None:
        """Work in as much memory as the plan has for it. Where that is tight, what an earlier plan left goes."""
        self.work.tight = self.device.memory.limit is not None or plan.tight
        if self.work.tight:
            self.work.clear()
        self.capacity = plan.pairs

    @property
    def takes_room(self) -> bool:
        """True if a pass may be by capacity: there is memory to spare, and the order by depth is that of Gaussians."""
        return not self.work.tight and self._switches.depth_sort != "pairs"

    def _send(self, camera: Camera, background: NDArray[np.float32] | DeviceArray) -> tuple[DeviceArray, DeviceArray]:
        """Camera and background on the device, where a background on the host goes up with the camera, in one copy."""
        pack = self._packs.get(camera)
        if pack is None:
            pack = self._packs[camera] = pack_camera(camera)
        if isinstance(background, DeviceArray):
            self._camera.send(pack)
            return self._camera, background
        values = np.zeros(self._view.shape, np.float32)
        values[: len(pack)], values[-3:] = pack, background
        self._view.send(values)
        return self._camera, self._background

    def forward(
        self,
        gaussians: AnyGaussians,
        camera: Camera,
        background: NDArray[np.float32] | DeviceArray,
        *,
        backward: bool = True,
        room: Room | None = None,
        thinning: Thinning | None = None,
        nearness: bool = False,
    ) -> Frame:
        """Project, sort by depth, duplicate, sort by tile, blend (Kerbl et al. 2023, algorithm 2).

        background: (3,) float32, on the host or the device; backward: True if the gradient will be asked for. Without
        it, what only that needs is left out. room: do not wait for the number of pairs, and have nothing of the pass
        come to anything where there are more (docs/decisions/0025-launch-by-capacity.md); thinning: of the model, for
        this pass; nearness: of `blend`.
        """
        device, work = self.device_of(camera), self.work
        camera_array, background = self._send(camera, background)

        def make() -> tuple[Projected, tuple[Band, ...], Part, Blended, tuple[int, ...]]:
            projected = project(device, work, gaussians, camera, camera_array, thinning)
            if room is None:
                counted = count(device, work, projected, all_bits=self._all_bits, readback=self.readback)
            else:
                counted = count_by_capacity(device, work, projected, self.readback, room.pairs, self._host(room.turn))
            bands = plan_bands(device, work, projected, counted, tiles_of(camera), self.capacity)
            record = backward and len(bands) == 1 and self._switches.record_cells
            wanted: dict[str, Any] = {"record": record, "nearness": nearness, "camera_array": camera_array}
            part = None
            for band in bands:
                del part  # its arrays may have to make room for larger ones
                part = self._part(device, projected, band, tiles_of(camera), counted if len(bands) == 1 else None)
                pixels = (projected.splats, background, camera.width, camera.height)
                blended = blend(device, work, part.lists, *pixels, **wanted)
            assert part is not None, "an image has a tile"
            return projected, bands, part, blended, counted.refused

        if room is None:
            return Frame(camera, camera_array, background, *make())
        size, how = (camera.width, camera.height), (backward, thinning is not None, nearness)
        key = (self.readback, device, background, *size, *how, room.pairs, room.turn)
        return Frame(camera, camera_array, background, *work.replayed(gaussians, key, make, thinning_numbers(thinning)))

    def _host(self, turn: int) -> NDArray[np.uint32]:
        """Memory on the host for a copy of the counts."""
        if self._arriving is None:
            self._arriving = pinned(self.device, (TURNS, len(READBACK)), np.uint32)
        row: NDArray[np.uint32] = self._arriving[turn]
        return row

    def part(self, frame: Frame, band: Band) -> Part:
        """The band with its pairs and lists; where there are several bands it takes the memory of the one before."""
        if len(frame.bands) == 1:
            return frame.part
        return self._part(self.device_of(frame.camera), frame.projected, band, tiles_of(frame.camera))

    def by_band(self, frame: Frame, work_on: Callable[[Part], R]) -> list[R]:
        """Results of `work_on` for each of the frame's bands in turn. No part is kept: its arrays may have to make room
        for larger ones of the next."""
        return [work_on(self.part(frame, band)) for band in frame.bands]

    def hold_out(self, frame: Frame, held: Held) -> None:
        """Take from the frame's image and transmittance what is behind the surfaces."""
        device = self.device_of(frame.camera)
        pixels = (frame.projected.splats, frame.background, frame.blended, frame.camera.height, frame.camera_array)
        self.by_band(frame, lambda part: holdout(device, held, part.lists, *pixels))

    def channels(
        self,
        gaussians: AnyGaussians,
        frame: Frame,
        wanted: Features,
        after: DeviceArray,
        before: DeviceArray | None = None,
        held: Held | None = None,
        *moved: AnyGaussians | None,
    ) -> Channels:
        """The frame's channels beside colour; after, before: the packed cameras that motion goes to, and back to; held:
        as of `hold_out`; moved: as `moved` and `earlier` of `features`."""
        device, work, projected = self.device_of(frame.camera), self.work, frame.projected
        rows = features(device, work, wanted, gaussians, frame.camera_array, after, projected, before, *moved)
        pixels = (projected, frame.blended, frame.camera.height, frame.camera_array, held)
        return self.by_band(frame, lambda part: channels(device, work, wanted, rows, part.lists, *pixels))[-1]

    def shares(self, frame: Frame, rows: DeviceArray, held: Held | None = None) -> DeviceArray:
        """Planes (floats + 2, rows, stride), of which the first are the means of the rows (n, floats), any values of
        each Gaussian; held: as of `hold_out`."""
        device, work = self.device_of(frame.camera), self.work
        wanted = Floats(rows.shape[1])
        pixels = (frame.projected, frame.blended, frame.camera.height, frame.camera_array, held)
        return self.by_band(frame, lambda part: channels(device, work, wanted, rows, part.lists, *pixels))[-1].means

    def deep(self, frame: Frame, bins: int) -> DeviceArray:
        """The frame in slices by depth: the array of `stages.deep`."""
        device = self.device_of(frame.camera)
        pixels = (frame.projected.splats, frame.blended, frame.camera.height, frame.camera_array)
        return self.by_band(frame, lambda part: deep(device, self.work, bins, part.lists, *pixels))[-1]

    def device_of(self, camera: Camera) -> Device:
        """The device with the switches that the camera's projection wants of the kernels."""
        return self._by_kind[id(camera.kind)]

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
        return Part(counted, pairs, tile_lists(device, work, pairs, band, all_bits=self._all_bits))

    def backward(
        self,
        gaussians: DeviceGaussians,
        frame: Frame,
        image_gradient: DeviceArray,
        gradients: DeviceGaussians,
        *,
        fields: SlotFields = PLAIN_SLOTS,
        by_lens: DeviceArray | None = None,
    ) -> Screen:
        """Fill the visible rows of `gradients`, and of by_lens (`project_grad`); returns what density control has of
        the view, as `fields` wants it."""
        slots = self.pair_gradients(frame, image_gradient, fields=fields)
        screen = self.screen(gaussians.count, fields)
        arrays = (gaussians, frame.camera_array, frame.projected, slots, gradients, screen)
        project_grad(self.device_of(frame.camera), *arrays, fields=fields, by_lens=by_lens)
        return screen

    def screen(self, count: int, fields: SlotFields) -> Screen:
        """Room for what density control has of `count` Gaussians in a view, as `fields` wants it."""
        contributions = self.work.array("contributions", (count,)) if fields.contributions else None
        return Screen(self.work.array("screen", (count, 2)), contributions)

    def pair_gradients(
        self,
        frame: Frame,
        image_gradient: DeviceArray,
        *,
        fields: SlotFields = PLAIN_SLOTS,
    ) -> Slots:
        """The gradient of blending: of every pair, or with several bands their sums by Gaussian."""
        device, work = self.device_of(frame.camera), self.work
        pixels = (frame.projected.splats, frame.background, frame.blended, image_gradient)

        def slots(part: Part) -> Slots:
            values = blend_grad(device, work, part.lists, *pixels, fields=fields, camera_array=frame.camera_array)
            return Slots(values, part.counted.first_slots)

        if len(frame.bands) == 1:
            return slots(frame.part)
        sums: DeviceArray | None = None

        def add(part: Part) -> None:
            nonlocal sums
            sums = add_slots(device, work, part.counted.tile_counts, slots(part), sums, fields=fields)

        self.by_band(frame, add)
        assert sums is not None, "an image has a tile"
        return Slots(sums)
