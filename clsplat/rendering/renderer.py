# SPDX-License-Identifier: Apache-2.0
"""The renderer that callers use: a model and a camera to arrays on the host."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.checks import parse_bytes
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device, open_device
from clsplat.device.layout import DEEP
from clsplat.errors import InputError, of_argument
from clsplat.gaussians import Gaussians
from clsplat.images.holdouts import Surfaces
from clsplat.rendering.memory_needs import plan_frame
from clsplat.rendering.rasterizer import Frame, Rasterizer
from clsplat.rendering.sh_storage import check_half, coefficients_in_use, needed_degrees
from clsplat.stages.channels import DEPTHS, Features
from clsplat.stages.deep import DEEP_FLOATS
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import (
    AnyGaussians,
    DeviceGaussians,
    HostArray,
    HostGaussians,
    ShStorage,
    host_gaussians,
    upload_gaussians,
)
from clsplat.stages.holdout import Held, held_bytes, upload_held


@dataclass(frozen=True, eq=False)
class RenderResult:
    """image (H, W, 3) float32, composited over the background; alpha (H, W) float32."""

    image: Float32
    alpha: Float32


SHARES = 8
"""Objects whose shares are blended at a time."""
ChannelResult = dict[str, NDArray[Any]]
"""Channels beside colour by their names in the kernels. depth, median, first (H, W) float32, along the camera's axis;
count, index (H, W) int32, index -1 for nothing. normal and position (H, W, 3), in the world, and motion (H, W, 2), in
pixels, are there if they were asked for."""


def held_sh(gaussians: Gaussians, config: RasterizerConfig) -> ShStorage:
    """The part of the SH that the settings keep of a model that is held to be rendered. Raises InputError where a
    coefficient is more than a half holds."""
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
        self._sh: tuple[Gaussians, ShStorage] | None = None
        self._held: AnyGaussians | None = None
        self._planned: tuple[object, ...] | None = None

    def render(
        self,
        gaussians: Gaussians | AnyGaussians,
        camera: Camera,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        contiguous: bool = True,
        holdout: Surfaces | None = None,
    ) -> RenderResult:
        """Render one view. A Gaussians object is taken to be unchanged for as long as it is the same object; of what is
        on the device the camera has to count from where the means do.

        contiguous: as arrays in memory. Else they are views of planes, which costs the device less waiting; holdout:
        surfaces of other elements in the picture, behind which the model is not seen, at the depths of the
        kernels. Raises ValueError for arrays that are not as `Gaussians` says, InputError for a camera that is none.
        """
        camera.check()
        on_device, camera = self._placed(gaussians, camera, planes=held_bytes(holdout))
        frame = self._forward(on_device, camera, background)
        self._hold_out(frame, holdout)
        return self._result(frame, contiguous=contiguous)

    def render_channels(
        self,
        gaussians: Gaussians | AnyGaussians,
        camera: Camera,
        wanted: Collection[str] = (),
        *,
        after: Camera | None = None,
        before: Camera | None = None,
        moved: Gaussians | None = None,
        earlier: Gaussians | None = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        contiguous: bool = True,
        holdout: Surfaces | None = None,
    ) -> tuple[RenderResult, ChannelResult]:
        """Render a view with channels beside colour (docs/channels.md).

        wanted: of "normal", "position", "motion" and "backward"; after, before: the cameras that motion and backward
        motion go to, the view's own if None; moved, earlier: the same Gaussians where these go to, of which the means
        count, None if they stand still. The rest is like `render`. Raises InputError for motion from one projection to
        another, ValueError for another number of Gaussians that move.
        """
        features = Features.of(wanted)
        camera.check()
        others = {"motion": after or camera, "backward": before or camera}
        for name, other in others.items():
            other.check()
            if name in wanted and any(camera.radial):
                raise InputError(
                    f"{name} is not defined for a fisheye with coefficients, expected one without or a pinhole"
                )
            if name in wanted and other.projection != camera.projection:
                raise InputError(
                    f"{name} goes from a camera to one that is {other.projection}, expected {camera.projection}"
                )
        origin = gaussians.origin if isinstance(gaussians, Gaussians) else np.zeros(3)
        moved, earlier = (moved if "motion" in wanted else None), (earlier if "backward" in wanted else None)
        size = (features.floats, held_bytes(holdout))
        on_device, camera = self._placed(
            gaussians, camera, *size, moved=sum(one is not None for one in (moved, earlier))
        )
        frame = self._forward(on_device, camera, background)
        goes_to = []
        for other, then in zip(others.values(), (moved, earlier), strict=True):
            counted = gaussians if then is None else then
            local = counted.local(other) if isinstance(counted, Gaussians) else other
            goes_to.append(upload(self.device, pack_camera(local)))
        held = self._hold_out(frame, holdout)
        there = [None if then is None else self._moved(on_device, then) for then in (moved, earlier)]
        cameras = (goes_to[0], goes_to[1])
        planes = self._rasterizer.channels(on_device, frame, features, *cameras, held, *there)
        height, width = camera.height, camera.width
        means, whole = (array.get()[:, :height, :width].transpose(1, 2, 0) for array in (planes.means, planes.whole))
        if contiguous:
            means, whole = np.ascontiguousarray(means), np.ascontiguousarray(whole)
        named = features.named(means, whole)
        if (of_distances := camera.depths_of_distances()) is not None:
            named |= {name: named[name] * of_distances for name in ("depth", *DEPTHS)}
        if "position" in named and origin.any():  # in the world: float32 keeps what it can of that
            shown = named["count"][:, :, None] > 0
            named["position"] = np.where(shown, named["position"] + origin, 0).astype(np.float32)
        return self._result(frame, contiguous=contiguous), named

    def render_shares(
        self,
        gaussians: Gaussians,
        camera: Camera,
        owners: NDArray[np.int32],
        count: int,
        holdout: Surfaces | None = None,
    ) -> Float32:
        """(H, W, count): what each of `count` objects covers of each pixel, the sum of the weights of its Gaussians;
        owners (n,): the object of each; holdout: as of `render`. Raises as `render`."""
        camera.check()
        shares = np.zeros((camera.height, camera.width, count), np.float32)
        on_device, local = self._placed(gaussians, camera, SHARES, held_bytes(holdout))
        frame = self._forward(on_device, local, (0.0, 0.0, 0.0))
        held = self._hold_out(frame, holdout)
        alpha = self._result(frame, contiguous=False).alpha[:, :, None]
        for first in range(0, count, SHARES):
            rows = np.equal.outer(owners, np.arange(first, first + SHARES)).astype(np.float32)
            planes = self._rasterizer.shares(frame, upload(self.device, rows), held)
            means = planes.get()[:SHARES, : camera.height, : camera.width].transpose(1, 2, 0)
            shares[:, :, first : first + SHARES] = (means * alpha)[:, :, : count - first]
        return shares

    def render_deep(self, gaussians: Gaussians, camera: Camera, bins: int) -> Float32:
        """(bins, H, W, 5): the view in slices by depth, each pixel's front to back, where its light is taken: red,
        green, blue, associated with alpha; alpha; the slice's depth. All 0 behind a pixel's last slice; a view of
        planes."""
        camera.check()
        on_device, camera = self._placed(gaussians, camera, planes=4 * DEEP_FLOATS * bins)
        frame = self._forward(on_device, camera, (0.0, 0.0, 0.0))
        planes = self._rasterizer.deep(frame, bins).get()[:, :, : camera.height, : camera.width]
        if (of_distances := camera.depths_of_distances()) is not None:
            planes[:, DEEP.index("DEPTH")] *= of_distances
        return np.asarray(planes.transpose(0, 2, 3, 1), np.float32)

    def _forward(self, gaussians: AnyGaussians, camera: Camera, background: Sequence[float]) -> Frame:
        with np.errstate(over="ignore"):
            colour = np.asarray(background, np.float32)
        if colour.shape != (3,) or not np.isfinite(colour).all():
            raise InputError(f"background {background}: expected three finite numbers")
        return self._rasterizer.forward(gaussians, camera, colour, backward=False)

    def _hold_out(self, frame: Frame, holdout: Surfaces | None) -> Held | None:
        if holdout is None or len(holdout.rows) == 0:
            return None
        held = upload_held(self.device, holdout)
        self._rasterizer.hold_out(frame, held)
        return held

    def _result(self, frame: Frame, *, contiguous: bool) -> RenderResult:
        height, width = frame.camera.height, frame.camera.width
        image = frame.blended.image.get()[:, :height, :width].transpose(1, 2, 0)
        alpha: Float32 = np.float32(1) - frame.blended.transmittance.get()[:height, :width]
        return RenderResult(np.ascontiguousarray(image) if contiguous else image, alpha)

    def _moved(self, gaussians: AnyGaussians, moved: Gaussians) -> AnyGaussians:
        """The means of `moved`, where the Gaussians are. Raises ValueError for another number of them."""
        if len(moved) != gaussians.count:
            raise ValueError(f"{len(moved)} Gaussians to move to, expected {gaussians.count}")
        if isinstance(gaussians, HostGaussians):
            return HostGaussians(len(moved), gaussians.coefficients, {"means": HostArray(moved.means)}, gaussians.rows)
        return DeviceGaussians(len(moved), gaussians.coefficients, {"means": upload(self.device, moved.means)})

    def _placed(
        self,
        gaussians: Gaussians | AnyGaussians,
        camera: Camera,
        features: int = 0,
        planes: int = 0,
        *,
        moved: int = 0,
    ) -> tuple[AnyGaussians, Camera]:
        """The model on the device, or on the host if a frame of this size leaves too little room for it; and the camera
        that counts from where it does. planes: bytes of a pixel beside the picture's; moved: how many further
        means there are."""
        if not isinstance(gaussians, Gaussians):
            return gaussians, camera
        if self._sh is None or self._sh[0] is not gaussians:
            gaussians.check()
            self._sh = self._held = None
            self._sh = (gaussians, held_sh(gaussians, self._rasterizer.config))
        self._rasterizer.antialias(on=gaussians.antialiased)
        sh = self._sh[1]
        asked = (len(gaussians), sh.floats, camera.width, camera.height, features, planes, moved)
        if self._planned != asked:
            config = self._rasterizer.config
            plan = plan_frame(self.device, len(gaussians), sh.floats, camera, config, features, planes, moved)
            self._rasterizer.follow(plan)
            if plan.streamed or isinstance(self._held, HostGaussians):
                self._held = None
            self._planned, self._rows = asked, plan.rows if plan.streamed else 0
        if self._held is None:
            rows = self._rows
            self._held = host_gaussians(gaussians, rows, sh) if rows else upload_gaussians(self.device, gaussians, sh)
        return self._held, gaussians.local(camera)


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    device: str | None = None,
    max_device_mem: str | int | None = None,
) -> RenderResult:
    """Render one view.

    camera: in the world; its near plane is the model's unless it has its own. background: red, green, blue, any finite
    numbers. device: as `clsplat devices` lists it. max_device_mem: the most of its memory to use, in bytes or such as
    "256MiB". Each call opens the device and uploads the model; `Renderer` keeps both.

    Raises ValueError for arrays that are not as `Gaussians` says, InputError for a camera or a background that is none,
    DeviceError for a device that is not there, CapacityError where a picture does not fit into its memory.
    """
    with of_argument():
        opened = open_device(device, parse_bytes(max_device_mem))
    return Renderer(opened).render(gaussians, camera, background)
