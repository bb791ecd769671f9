# SPDX-License-Identifier: Apache-2.0
"""The forward pass and its gradient, each on one screen, and the renderer that callers use."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import RasterizerConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device, open_device
from clsplat.device.layout import CAMERA, PLAIN_SLOTS, WIDEST_SLOTS, SlotFields
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.rendering.build_flags import kernel_defines
from clsplat.rendering.memory_needs import plan_frame
from clsplat.rendering.memory_plan import Plan, parse_bytes
from clsplat.rendering.sh_storage import check_half, coefficients_in_use, needed_degrees
from clsplat.stages.adam import REFUSED
from clsplat.stages.blend import Blended, blend, blend_grad
from clsplat.stages.channels import WIDTHS, Channels, Features, channels, features
from clsplat.stages.deep import DEEP_FLOATS, deep
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
from clsplat.stages.project import (
    AnyGaussians,
    DeviceGaussians,
    HostGaussians,
    Projected,
    Screen,
    ShStorage,
    Slots,
    add_slots,
    host_gaussians,
    pack_camera,
    project,
    project_grad,
    tiles_of,
    upload_gaussians,
)
from clsplat.stages.ranges import TileLists, tile_lists

Float32 = NDArray[np.float32]
PROJECTION_DEFINES: dict[str, dict[str, object]] = {
    "orthographic": {"ORTHOGRAPHIC": True},
    "equirectangular": {"RAYS": 1},
    "fisheye": {"RAYS": 2},
}
"""What the kernels are built with for a camera that is no pinhole."""


@dataclass(frozen=True, eq=False)
class Part:
    """What is listed and blended together: a band of tiles and its pairs."""

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
        """Of all tiles, if there is one band."""
        return self.part.pairs

    @property
    def lists(self) -> TileLists:
        """Of all tiles, if there is one band."""
        return self.part.lists


class Rasterizer:
    """The pipeline on one device, with the memory that it works in, which can be another's.

    capacity: most (tile, Gaussian) pairs that are worked on together; the plan of who owns the rasterizer; found (8,)
    uint32: what a pass reads back, and in the last four what `adam` counts.
    """

    def __init__(self, device: Device, config: RasterizerConfig | None = None, work: Workspace | None = None) -> None:
        self.config = config or RasterizerConfig()
        switches = {**device.switches, **kernel_defines(self.config)}
        self.device = device.with_switches(switches)
        self._by_projection = {
            name: device.with_switches({**switches, **defines}) for name, defines in PROJECTION_DEFINES.items()
        }
        self.work = work or Workspace(device)
        # What `count` reads each time, with room for what training counts beside it: one copy for both.
        self.found = allocate(device, (4 + len(REFUSED),), np.uint32)
        self.found.fill(0)
        self._all_bits = self.config.key_bits == "all"
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
            record = backward and len(bands) == 1 and self.config.record_cells
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
        """What the band lists; where there are several bands it takes the memory of the one before."""
        if len(frame.bands) == 1:
            return frame.part
        return self._part(self.device_of(frame.camera), frame.projected, band, tiles_of(frame.camera))

    def channels(self, gaussians: AnyGaussians, frame: Frame, wanted: Features, after: DeviceArray) -> Channels:
        """What the frame has beside colour; after: the packed camera that motion goes to."""
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
        listing = duplicate_and_sort if self.config.depth_sort == "pairs" else duplicate
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


@dataclass(frozen=True, eq=False)
class RenderResult:
    """image (H, W, 3) float32, composited over the background; alpha (H, W) float32."""

    image: Float32
    alpha: Float32


@dataclass(frozen=True, eq=False)
class ChannelResult:
    """depth, median, first (H, W) float32, along the camera's axis; count, index (H, W) int32, index -1 for nothing;
    fields: normal and position (H, W, 3), in the world, motion (H, W, 2), in pixels, those that were asked for."""

    depth: Float32
    fields: dict[str, Float32]
    median: Float32
    first: Float32
    count: NDArray[np.int32]
    index: NDArray[np.int32]


def held_sh(gaussians: Gaussians, config: RasterizerConfig) -> ShStorage:
    """What the settings keep of the SH of a model that is held to be rendered. Raises InputError where a coefficient
    is more than a half holds."""
    half = config.sh_storage == "half"
    if half:
        check_half(gaussians.sh)
    degrees = needed_degrees(gaussians.sh, config.sh_tolerance)
    coefficients, differ = coefficients_in_use(degrees)
    return ShStorage(coefficients, degrees if differ else None, half)


class Renderer:
    """Renders models; keeps the last one on the device. It can work in another's rasterizer and its memory."""

    def __init__(
        self,
        device: Device | None = None,
        rasterizer: Rasterizer | None = None,
        *,
        config: RasterizerConfig | None = None,
    ) -> None:
        self.device = device or open_device()
        self._rasterizer = rasterizer or Rasterizer(self.device, config)
        self._rows = 0
        self._background = allocate(self.device, (3,), np.float32)
        self._sh: tuple[Gaussians, ShStorage] | None = None
        self._held: AnyGaussians | None = None
        self._planned: tuple[object, ...] | None = None
        self._after: DeviceArray | None = None

    def render(
        self,
        gaussians: Gaussians | AnyGaussians,
        camera: Camera,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        contiguous: bool = True,
    ) -> RenderResult:
        """Render one view. A Gaussians object is taken to be unchanged for as long as it is the same object; of what is
        on the device the camera has to count from where the means do.

        contiguous: as arrays in memory. Else they are views of planes, which costs the device less waiting. Raises
        ValueError for arrays that are not as `Gaussians` says, InputError for a camera that is none.
        """
        camera.check()
        if isinstance(gaussians, Gaussians):
            camera = gaussians.local(camera)
        on_device = self._hold(gaussians, camera) if isinstance(gaussians, Gaussians) else gaussians
        return self._result(self._forward(on_device, camera, background), contiguous=contiguous)

    def render_channels(
        self,
        gaussians: Gaussians | AnyGaussians,
        camera: Camera,
        wanted: Collection[str] = (),
        *,
        after: Camera | None = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        contiguous: bool = True,
    ) -> tuple[RenderResult, ChannelResult]:
        """As `render`, with what the view has beside colour (docs/channels.md).

        wanted: of "normal", "position" and "motion"; after: the camera that motion goes to, the view's own if None.
        Raises InputError for motion from one projection to another.
        """
        of = Features.of(wanted)
        after = after or camera
        camera.check()
        after.check()
        if "motion" in wanted and after.projection != camera.projection:
            raise InputError(
                f"motion goes from a camera to one that is {after.projection}, expected {camera.projection}"
            )
        origin = gaussians.origin if isinstance(gaussians, Gaussians) else np.zeros(3)
        if isinstance(gaussians, Gaussians):
            camera, after = gaussians.local(camera), gaussians.local(after)
        on_device = self._hold(gaussians, camera, of.floats) if isinstance(gaussians, Gaussians) else gaussians
        frame = self._forward(on_device, camera, background)
        if self._after is None:
            self._after = allocate(self.device, (len(CAMERA),), np.float32)
        self._after.set(pack_camera(after))
        found = self._rasterizer.channels(on_device, frame, of, self._after)
        height, width = camera.height, camera.width
        means, whole = (array.get()[:, :height, :width].transpose(1, 2, 0) for array in (found.means, found.whole))
        if contiguous:
            means, whole = np.ascontiguousarray(means), np.ascontiguousarray(whole)
        fields = {name: means[:, :, at : at + WIDTHS[name]] for name, at in of.offsets.items()}
        if "position" in fields and origin.any():  # in the world: float32 keeps what it can of that
            shown = whole[:, :, :1] > 0
            fields["position"] = np.where(shown, fields["position"] + origin, 0).astype(np.float32)
        return self._result(frame, contiguous=contiguous), ChannelResult(
            depth=fields.pop("depth")[:, :, 0],
            fields=fields,
            median=means[:, :, -2],
            first=means[:, :, -1],
            count=whole[:, :, 0],
            index=whole[:, :, 1],
        )

    def render_deep(self, gaussians: Gaussians, camera: Camera, bounds: Float32) -> Float32:
        """(bins, H, W, 6): the view in slices by depth, the next of which begins at each of the bounds (bins - 1,):
        red, green, blue, associated with alpha; alpha; least and largest depth. All 0 where there is nothing."""
        camera.check()
        bins, camera = len(bounds) + 1, gaussians.local(camera)
        on_device = self._hold(gaussians, camera, planes=4 * DEEP_FLOATS * bins)
        frame = self._forward(on_device, camera, (0.0, 0.0, 0.0))
        found = self._rasterizer.deep(frame, upload(self.device, np.append(bounds, np.inf).astype(np.float32)))
        planes = found.get()[:, :, : camera.height, : camera.width]
        return np.ascontiguousarray(planes.transpose(0, 2, 3, 1))

    def _forward(self, gaussians: AnyGaussians, camera: Camera, background: Sequence[float]) -> Frame:
        with np.errstate(over="ignore"):
            colour = np.asarray(background, np.float32)
        if colour.shape != (3,) or not np.isfinite(colour).all():
            raise InputError(f"background {background}: expected three finite numbers")
        self._background.set(colour)
        return self._rasterizer.forward(gaussians, camera, self._background, backward=False)

    def _result(self, frame: Frame, *, contiguous: bool) -> RenderResult:
        height, width = frame.camera.height, frame.camera.width
        image = frame.blended.image.get()[:, :height, :width].transpose(1, 2, 0)
        alpha: Float32 = np.float32(1) - frame.blended.transmittance.get()[:height, :width]
        return RenderResult(np.ascontiguousarray(image) if contiguous else image, alpha)

    def _hold(self, gaussians: Gaussians, camera: Camera, features: int = 0, planes: int = 0) -> AnyGaussians:
        """The model on the device, or on the host if a frame of this size leaves too little room for it. planes: bytes
        of a pixel beside the picture's."""
        if self._sh is None or self._sh[0] is not gaussians:
            gaussians.check()
            self._sh = self._held = None
            self._sh = (gaussians, held_sh(gaussians, self._rasterizer.config))
        sh = self._sh[1]
        asked = (len(gaussians), sh.floats, camera.width, camera.height, features, planes)
        if self._planned != asked:
            config = self._rasterizer.config
            plan = plan_frame(self.device, len(gaussians), sh.floats, camera, config, features, planes)
            self._rasterizer.follow(plan)
            if plan.streamed or isinstance(self._held, HostGaussians):
                self._held = None
            self._planned, self._rows = asked, plan.rows if plan.streamed else 0
        if self._held is None:
            rows = self._rows
            self._held = host_gaussians(gaussians, rows, sh) if rows else upload_gaussians(self.device, gaussians, sh)
        return self._held


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    device: str | None = None,
    max_device_mem: str | int | None = None,
) -> RenderResult:
    """Render one view on the device that `device` names (see `clsplat devices`), with at most `max_device_mem` of its
    memory, such as "256MiB". Raises DeviceError, and as `Renderer.render`."""
    return Renderer(open_device(device, parse_bytes(max_device_mem))).render(gaussians, camera, background)
