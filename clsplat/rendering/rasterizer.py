# SPDX-License-Identifier: Apache-2.0
"""The rasterizer: the forward pass of a frame and its gradient, as sequences of the stages.

A frame with more than MAX_PAIRS_PER_BAND pairs (`stages.duplicate`), or more than memory allows, is rendered in bands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import CAMERA_MODELS, Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, pinned
from clsplat.device.context import Device
from clsplat.layouts.columns import CAMERA, PLAIN_SLOTS, READBACK, WIDEST_SLOTS, SlotFields
from clsplat.optimisation.dropout import Thinning
from clsplat.rendering.build_flags import kernel_defines
from clsplat.rendering.memory_plan import Plan
from clsplat.stages.append import MAX_MEAN_PAIRS, append, appends
from clsplat.stages.blend import Blended, ImageInputs, blend, blend_grad, tile_items
from clsplat.stages.channels import Channels, Features, Floats, Motion, channels, features
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers, send_chunks
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.stages.deep import deep
from clsplat.stages.device_camera import pack_camera, tiles_of
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostGaussians
from clsplat.stages.duplicate import (
    MAX_PAIRS_PER_BAND,
    Band,
    Counted,
    Pairs,
    Totals,
    count,
    count_band,
    count_by_capacity,
    duplicate,
    duplicate_and_sort,
    plan_bands,
)
from clsplat.stages.holdout import Held, holdout
from clsplat.stages.project import (
    Projected,
    Screen,
    Slots,
    ViewSlots,
    add_slots,
    project,
    project_grad,
    thinning_numbers,
)
from clsplat.stages.ranges import TileLists, tile_lists

R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class ListedBand:
    """A band of tiles with the pairs and lists of its Gaussians.

    pairs: the pairs before their sort by tile; None if the lists were made by append.
    """

    counted: Totals
    pairs: Pairs | None
    lists: TileLists


MAX_COUNTED_PASSES = 3
"""Number of passes by capacity whose counts are kept on the host: the current, the previous and a repeated pass."""


@dataclass
class PairCapacity:
    """Capacity of a pass that is launched before its number of pairs is known: "a pass by capacity".

    pairs: number of pairs that fit in the pass's arrays.
    turn: index of the host array that gets the pass's counts, below MAX_COUNTED_PASSES.
    appends: True if the lists may be made by append (`stages.append`). Only some devices support append.
    """

    pairs: int
    turn: int
    appends: bool = True


@dataclass(eq=False)
class ForwardPass:
    """One forward pass: the arrays of all stages, which are valid until the rasterizer's next forward pass.

    bands: one band of all tiles, unless memory is short.
    listed: the lists of the last band.
    refused: how many elements Adam has refused to update, by reason (`REFUSED`), when this pass read the counts back.
    """

    camera: Camera
    camera_array: DeviceArray
    background: DeviceArray
    projected: Projected
    bands: tuple[Band, ...]
    listed: ListedBand
    blended: Blended
    refused: tuple[int, ...] = ()

    def for_camera(self, camera: Camera, camera_array: DeviceArray) -> ForwardPass:
        """A copy of this pass, with the same arrays, for another camera of the same model and size.

        camera_array: the packed camera on the device.
        """
        lists = (self.projected, self.bands, self.listed, self.blended)
        return self if camera is self.camera else ForwardPass(camera, camera_array, self.background, *lists)

    @property
    def inputs(self) -> ImageInputs:
        """Input of the stages that compute channels or the gradient from this pass."""
        camera = self.camera
        return ImageInputs(self.projected.splats, self.background, camera.width, camera.height, self.camera_array)


class Rasterizer:
    """The rendering pipeline on one device, with its workspace, which may be shared.

    capacity: largest number of (tile, Gaussian) pairs in one band; `follow` sets it from a memory plan.
    readback: (len(READBACK),) uint32, the numbers that the host reads after each pass (`columns.READBACK`).
    """

    def __init__(
        self,
        device: Device,
        config: RasterizerConfig | None = None,
        work: Workspace | None = None,
        *,
        antialiased: bool = False,
    ) -> None:
        self.config, self._bare = config or RasterizerConfig(), device
        self._switches = self.config.switches()
        self._antialiased: bool | None = None
        self.antialias(on=antialiased)
        self.work = work or Workspace(device)
        self._sent: WeakKeyDictionary[Camera, NDArray[np.float32]] = WeakKeyDictionary()
        """Each camera's packed fields and last background, as `send` sends them. The device may still read them."""
        aligned = -(-len(CAMERA) // device.row_alignment) * device.row_alignment
        self._view = allocate(device, (aligned + 3,), np.float32)
        self._camera, self._background = self._view.reshaped(len(CAMERA)), self._view.rows(aligned, aligned + 3)
        self._kept: WeakKeyDictionary[Camera, DeviceArray] = WeakKeyDictionary()
        self._kept_background = allocate(device, (3,), np.float32)
        self._colours: NDArray[np.float32] | None = None
        """The host array from which `_kept_background` was sent."""
        self.readback = allocate(device, (len(READBACK),), np.uint32)
        self.readback.fill(0)
        self._arriving: NDArray[np.uint32] | None = None
        self._all_bits = self._switches.key_bits == "all"
        self.capacity = min(device.max_allocation // (4 * WIDEST_SLOTS.floats), MAX_PAIRS_PER_BAND)

    def antialias(self, *, on: bool) -> None:
        """Use the kernels for antialiased models (`Gaussians.antialiased`) if `on`, otherwise those for models that are
        not."""
        if on == self._antialiased:
            return
        defines = kernel_defines(self.config, antialiased=on)
        self._antialiased, self.device = on, self._bare.with_switches(defines)
        self._by_model = {
            model: self.device.with_switches(model.defines) if model.defines else self.device for model in CAMERA_MODELS
        }

    def follow(self, plan: Plan) -> None:
        """Use at most as much memory as the plan allows. If memory is tight, the arrays of an earlier plan are
        freed."""
        self.work.tight = self.device.memory.limit is not None or plan.tight
        if self.work.tight:
            self.work.clear()
        self.capacity = plan.pairs

    @property
    def takes_room(self) -> bool:
        """True if a pass may run by capacity: memory is not tight, and Gaussians, not pairs, are sorted by depth."""
        return not self.work.tight and self._switches.depth_sort != "pairs"

    def send(self, camera: Camera, background: NDArray[np.float32] | DeviceArray) -> tuple[DeviceArray, DeviceArray]:
        """Send camera and background to the device, in one copy, and return their arrays. A background that is on the
        device already is returned as it is."""
        sent = self._sent.get(camera)
        if sent is None:
            sent = self._sent[camera] = np.zeros(self._view.shape, np.float32)
            sent[: len(CAMERA)] = pack_camera(camera)
        if isinstance(background, DeviceArray):
            self._camera.send(sent[: len(CAMERA)])
            return self._camera, background
        if sent[-3:].tobytes() != background.tobytes():
            sent = self._sent[camera] = sent.copy()
            sent[-3:] = background
        self._view.send(sent)
        return self._camera, self._background

    def keep(self, camera: Camera, background: NDArray[np.float32]) -> tuple[DeviceArray, DeviceArray]:
        """Upload camera and background, and keep them on the device for passes by capacity. Returns both arrays.

        A camera's array exists as long as the camera object, so that a training sends each of its cameras once. The
        background's array is always the same, and is sent again if `background` is not the object of the last call.
        """
        array = self._kept.get(camera)
        if array is None:
            array = self._kept[camera] = allocate(self.device, (len(CAMERA),), np.float32)
            array.send(pack_camera(camera))
        if background is not self._colours:
            self._kept_background.send(background)
            self._colours = background
        return array, self._kept_background

    def forward(
        self,
        gaussians: AnyGaussians,
        camera: Camera,
        background: NDArray[np.float32] | DeviceArray | tuple[DeviceArray, DeviceArray],
        *,
        backward: bool = True,
        room: PairCapacity | None = None,
        thinning: Thinning | None = None,
        nearness: bool = False,
        chunks: ChunkList | ChunkNumbers | None = None,
    ) -> ForwardPass:
        """Render a frame (Kerbl et al. 2023, algorithm 2): project the Gaussians, list them by tile and depth, blend.

        background: (3,) float32, on the host or the device; or the two arrays that `send` or `keep` returned.
        backward: True if a gradient will follow.
        room: capacity with which to run without waiting for the number of pairs. A pass with more pairs has no effect
        (docs/decisions/0025-launch-by-capacity.md). None counts the pairs first.
        thinning: random dropout of the model's Gaussians in this pass.
        nearness: also blend 1 / depth (see `blend`).
        chunks: the only chunks of the model that may be in view. None means all, or those that the pool of a streamed
            model finds in view. ChunkNumbers cannot be given together with `room`.
        """
        device, work = self.device_of(camera), self.work
        if chunks is None and isinstance(gaussians, HostGaussians) and gaussians.pool is not None and gaussians.culls:
            gaussians, chunks = self._in_view(gaussians, gaussians.pool, camera)
        camera_array, colours = background if isinstance(background, tuple) else self.send(camera, background)
        by_append = room is not None and self._appends(device, room, tiles_of(camera))
        records = backward and (self._switches.record_cells or tile_items(device) > 1)

        def make() -> tuple[Projected, tuple[Band, ...], ListedBand, Blended, tuple[int, ...]]:
            projected = project(device, work, gaussians, camera, camera_array, thinning, chunks, counts_lists=by_append)
            inputs = ImageInputs(projected.splats, colours, camera.width, camera.height, camera_array)
            if by_append:
                assert room is not None
                numbers = (self.readback, room.pairs, self._host(room.turn))
                totals, lists = append(device, work, projected, tiles_of(camera), *numbers)
                blended = blend(device, work, lists, inputs, record=records, nearness=nearness)
                return projected, (lists.band,), ListedBand(totals, None, lists), blended, ()
            if room is None:
                counted = count(device, work, projected, all_bits=self._all_bits, readback=self.readback)
            else:
                counted = count_by_capacity(device, work, projected, self.readback, room.pairs, self._host(room.turn))
            bands = plan_bands(device, work, projected, counted, tiles_of(camera), self.capacity)
            listed, one = None, len(bands) == 1
            for band in bands:
                del listed  # frees the last band's memory, which this band may need
                listed = self._list(device, projected, band, tiles_of(camera), counted if one else None)
                blended = blend(device, work, listed.lists, inputs, record=records and one, nearness=nearness)
            assert listed is not None, "an image has at least one tile"
            return projected, bands, listed, blended, counted.refused

        if room is None:
            return ForwardPass(camera, camera_array, colours, *make())
        size, how = (camera.width, camera.height), (backward, thinning is not None, nearness)
        assert not isinstance(chunks, ChunkNumbers), "no pass by capacity: the host moves chunks in the middle of it"
        rows = chunks and chunks.key
        key = (self.readback, device, colours, *size, *how, room.pairs, room.turn, by_append, rows)
        made = work.replayed(gaussians, key, make, thinning_numbers(thinning), (camera_array,))
        return ForwardPass(camera, camera_array, colours, *made)

    def _in_view(
        self, gaussians: HostGaussians, pool: ChunkPool, camera: Camera
    ) -> tuple[AnyGaussians, ChunkList | ChunkNumbers | None]:
        """Find the chunks of a streamed model that the camera may show. Returns the model and the chunks to project.

        If the pool has slots for all these chunks, the model is the pool's rows, and the chunks are given by slot.
        Otherwise it is the whole model, and the chunks are given by number. Without culling (`pool.cull` is None) it is
        the whole model, and the chunks are None.
        """
        if pool.cull is None:
            return gaussians, None
        numbers = pool.cull(camera)
        if len(numbers) > pool.slots:
            return gaussians, ChunkNumbers(numbers)
        slots = send_chunks(self.work, "chunk_slots", pool.place(numbers, changes=False), pool.rows)
        return gaussians.in_pool, slots

    def _appends(self, device: Device, room: PairCapacity, tiles: tuple[int, int]) -> bool:
        """True if the lists of a pass by capacity are made by append."""
        return room.appends and room.pairs <= MAX_MEAN_PAIRS * tiles[0] * tiles[1] and appends(device)

    def _host(self, turn: int) -> NDArray[np.uint32]:
        """Host memory for the counts of a pass by capacity. turn: `PairCapacity.turn`."""
        if self._arriving is None:
            self._arriving = pinned(self.device, (MAX_COUNTED_PASSES, len(READBACK)), np.uint32)
        row: NDArray[np.uint32] = self._arriving[turn]
        return row

    def listed(self, frame: ForwardPass, band: Band) -> ListedBand:
        """Return a band of the frame with its pairs and lists.

        If there are several bands, each reuses the memory of the band before.
        """
        if len(frame.bands) == 1:
            return frame.listed
        return self._list(self.device_of(frame.camera), frame.projected, band, tiles_of(frame.camera))

    def by_band(self, frame: ForwardPass, work_on: Callable[[ListedBand], R]) -> list[R]:
        """Call `work_on` with the lists of each band of the frame, in order. Returns the results.

        The lists of a band are not kept, as the next band may need the memory for larger lists.
        """
        return [work_on(self.listed(frame, band)) for band in frame.bands]

    def hold_out(self, frame: ForwardPass, held: Held) -> None:
        """Remove from the frame's image and transmittance everything behind the holdout's surfaces."""
        device = self.device_of(frame.camera)
        self.by_band(frame, lambda listed: holdout(device, held, listed.lists, frame.inputs, frame.blended))

    def channels(
        self,
        gaussians: AnyGaussians,
        frame: ForwardPass,
        wanted: Features,
        motion: Motion,
        held: Held | None = None,
    ) -> Channels:
        """Blend the frame's extra channels.

        wanted: the features to blend.
        motion: cameras and means to which the vectors of the channels motion and backward lead.
        held: the holdout, as for `hold_out`.
        """
        device, work = self.device_of(frame.camera), self.work
        rows = features(device, work, wanted, gaussians, frame.camera_array, frame.projected, motion)
        pixels = (frame.inputs, frame.blended, held)
        return self.by_band(frame, lambda listed: channels(device, work, wanted, rows, listed.lists, *pixels))[-1]

    def shares(self, frame: ForwardPass, rows: DeviceArray, held: Held | None = None) -> DeviceArray:
        """Blend any values of the Gaussians. Returns planes (floats + 2, height, stride): the weighted means of the
        values, then median depth and first depth.

        rows: (n, floats), the values of each Gaussian.
        held: the holdout, as for `hold_out`.
        """
        device, work = self.device_of(frame.camera), self.work
        wanted = Floats(rows.shape[1])
        pixels = (frame.inputs, frame.blended, held)
        return self.by_band(frame, lambda listed: channels(device, work, wanted, rows, listed.lists, *pixels))[-1].means

    def deep(self, frame: ForwardPass, bins: int) -> DeviceArray:
        """Blend the frame in slices by depth, for a deep picture. Returns the array of `stages.deep`.

        bins: maximum number of slices per pixel.
        """
        device = self.device_of(frame.camera)
        pixels = (frame.inputs, frame.blended)
        return self.by_band(frame, lambda listed: deep(device, self.work, bins, listed.lists, *pixels))[-1]

    def device_of(self, camera: Camera) -> Device:
        """The device with the kernel defines of the camera model."""
        return self._by_model[camera.model]

    def _list(
        self,
        device: Device,
        projected: Projected,
        band: Band,
        tiles: tuple[int, int],
        counted: Counted | None = None,
    ) -> ListedBand:
        work = self.work
        counted = counted or count_band(device, work, projected, tiles, band, all_bits=self._all_bits)
        listing = duplicate_and_sort if self._switches.depth_sort == "pairs" else duplicate
        pairs = listing(device, work, projected.splats, counted, tiles, band)
        return ListedBand(counted, pairs, tile_lists(device, work, pairs, band, all_bits=self._all_bits))

    def backward(
        self,
        gaussians: DeviceGaussians,
        frame: ForwardPass,
        image_gradient: DeviceArray,
        gradients: DeviceGaussians,
        *,
        fields: SlotFields = PLAIN_SLOTS,
        by_lens: DeviceArray | None = None,
    ) -> Screen:
        """Compute the gradients of a view: fill the visible Gaussians' rows of `gradients`, and `by_lens` (see
        `project_grad`).

        Returns the view's screen-space gradients for density control, with the columns of `fields`.
        """
        slots = self.pair_gradients(frame, image_gradient, fields=fields)
        screen = self.screen(gaussians.count, fields)
        view = ViewSlots(frame.camera_array, frame.projected, slots)
        project_grad(self.device_of(frame.camera), gaussians, view, gradients, screen, by_lens=by_lens)
        return screen

    def screen(self, count: int, fields: SlotFields) -> Screen:
        """Arrays for the screen-space gradients of `count` Gaussians, with the columns of `fields`."""
        contributions = self.work.array("contributions", (count,)) if fields.contributions else None
        return Screen(self.work.array("screen", (count, 2)), contributions)

    def pair_gradients(
        self,
        frame: ForwardPass,
        image_gradient: DeviceArray,
        *,
        fields: SlotFields = PLAIN_SLOTS,
    ) -> Slots:
        """Compute the gradient of blending: a row for each pair or, with several bands, a sum for each Gaussian."""
        device, work = self.device_of(frame.camera), self.work
        pixels = (frame.inputs, frame.blended, image_gradient)

        def slots(listed: ListedBand) -> Slots:
            values = blend_grad(device, work, listed.lists, *pixels, fields=fields)
            return Slots(values, listed.counted.first_slots, fields)

        if len(frame.bands) == 1:
            return slots(frame.listed)
        sums: DeviceArray | None = None

        def add(listed: ListedBand) -> None:
            nonlocal sums
            sums = add_slots(device, work, listed.counted.tile_counts, slots(listed), sums)

        self.by_band(frame, add)
        assert sums is not None, "an image has at least one tile"
        return Slots(sums, fields=fields)
