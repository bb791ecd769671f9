# SPDX-License-Identifier: Apache-2.0
"""The renderer that callers use: it renders a model, and returns image, alpha and channels on the host."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.checks import parse_bytes
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import InputError, of_argument
from clsplat.gaussians import Gaussians
from clsplat.images.holdouts import Surfaces
from clsplat.layouts.columns import DEEP_SLICE
from clsplat.rendering.memory_needs import plan_frame
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.rendering.sh_storage import check_half, coefficients_in_use, needed_degrees
from clsplat.stages.channels import DEPTH_PLANES, Channels, Features, Motion
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
    """A rendered image.

    Attributes
    ----------
    image : (H, W, 3) float32
        Red, green, blue, composited over the background.
    alpha : (H, W) float32
        0 to 1.
    """

    image: Float32
    alpha: Float32


OBJECTS_PER_COVERAGE_PASS = 8
"""Number of objects that `render_shares` blends in one pass."""
ChannelResult = dict[str, NDArray[Any]]
"""Extra channels by their names in the kernels.

depth, median, first: (H, W) float32, along the camera's axis.
count, index: (H, W) int32; index is -1 for empty pixels.
Other channels, if requested: (H, W) or (H, W, floats) float32, as docs/channels.md defines them.
"""


def held_sh(gaussians: Gaussians, config: RasterizerConfig) -> ShStorage:
    """Choose which SH coefficients of a model are kept for rendering, by the settings, and how they are stored.

    Raises InputError if a coefficient is too large for float16.
    """
    half = config.sh_storage == "half"
    if half:
        check_half(gaussians.sh)
    degrees = needed_degrees(gaussians.sh, config.sh_tolerance)
    coefficients, differ = coefficients_in_use(degrees)
    return ShStorage(coefficients, degrees if differ else None, half)


class Renderer:
    """Renderer of models. It keeps the last model on the device, and may share another owner's rasterizer.

    Parameters
    ----------
    device : Device, optional
        An open device. None opens the default device (docs/drivers.md).
    rasterizer : Rasterizer, optional
        A rasterizer to share. None makes one.
    config : RasterizerConfig, optional
        Settings of a new rasterizer.
    """

    def __init__(
        self,
        device: Device | None = None,
        rasterizer: Rasterizer | None = None,
        *,
        config: RasterizerConfig | None = None,
    ) -> None:
        self.device = device or open_device()
        self._rasterizer = rasterizer or Rasterizer(self.device, config)
        self.config = self._rasterizer.config
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
        """Render one view.

        Parameters
        ----------
        gaussians : Gaussians
            The model. If it is the object of the last call, it is assumed to be unchanged. It may also be on the
            device; the camera must then be relative to the origin of its means.
        camera : Camera
            In world coordinates.
        background : sequence of 3 float
            Red, green, blue.
        contiguous : bool
            Return contiguous arrays. False returns views of planes, which is faster.
        holdout : Surfaces, optional
            Surfaces of CG elements, which hide the part of the model behind them. Their depths are measured as the
            kernels measure depths: z, or distances for cameras that draw along rays.

        Returns
        -------
        RenderResult
            Image and alpha.

        Raises
        ------
        ValueError
            If arrays are not as `Gaussians` requires.
        InputError
            If the camera or the background is not valid.
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
        """Render a view with extra channels (docs/channels.md).

        Parameters
        ----------
        gaussians : Gaussians
            The model, as for `render`.
        camera : Camera
            In world coordinates.
        wanted : collection of str
            Features, by their names in `clsplat.config.channels`.
        after, before : Camera, optional
            Cameras for motion and backward motion. None means the view's own camera.
        moved, earlier : Gaussians, optional
            The Gaussians at the time of `after` and of `before`. None means that they do not move.
        background, contiguous, holdout
            As for `render`.

        Returns
        -------
        result : RenderResult
            Image and alpha.
        channels : dict
            depth, median and first (H, W) float32, along the camera's axis, world units; count and index (H, W) int32,
            index -1 for empty pixels. Also the features asked for, (H, W) or (H, W, floats) float32.

        Raises
        ------
        InputError
            For motion or backward, if the other camera has another projection or `camera` is a fisheye with
            coefficients.
        ValueError
            If the number of moved Gaussians differs.
        """
        features = Features.of(wanted)
        camera.check()
        ahead = _motion_end("motion", camera, after, moved, asked="motion" in wanted)
        back = _motion_end("backward", camera, before, earlier, asked="backward" in wanted)
        sets = sum(end.gaussians is not None for end in (ahead, back))
        on_device, camera = self._placed(gaussians, camera, features.floats, held_bytes(holdout), moved=sets)
        frame = self._forward(on_device, camera, background)
        motion = self._motion(gaussians, on_device, ahead, back)
        held = self._hold_out(frame, holdout)
        planes = self._rasterizer.channels(on_device, frame, features, motion, held)
        pixels = _pixels_of(planes, camera, contiguous=contiguous)
        named = _in_the_world(features.named(*pixels), camera, gaussians)
        return self._result(frame, contiguous=contiguous), named

    def render_shares(
        self,
        gaussians: Gaussians,
        camera: Camera,
        owners: NDArray[np.int32],
        count: int,
        holdout: Surfaces | None = None,
    ) -> Float32:
        """Render the coverage (H, W, count) of each pixel by each of `count` objects. It is the sum of the blending
        weights of an object's Gaussians.

        owners: (n,), the index of each Gaussian's object.
        holdout: as for `render`.
        Raises errors like `render`.
        """
        camera.check()
        shares = np.zeros((camera.height, camera.width, count), np.float32)
        on_device, local = self._placed(gaussians, camera, OBJECTS_PER_COVERAGE_PASS, held_bytes(holdout))
        frame = self._forward(on_device, local, (0.0, 0.0, 0.0))
        held = self._hold_out(frame, holdout)
        alpha = self._result(frame, contiguous=False).alpha[:, :, None]
        for first in range(0, count, OBJECTS_PER_COVERAGE_PASS):
            rows = np.equal.outer(owners, np.arange(first, first + OBJECTS_PER_COVERAGE_PASS)).astype(np.float32)
            planes = self._rasterizer.shares(frame, upload(self.device, rows), held)
            means = planes.get()[:OBJECTS_PER_COVERAGE_PASS, : camera.height, : camera.width].transpose(1, 2, 0)
            shares[:, :, first : first + OBJECTS_PER_COVERAGE_PASS] = (means * alpha)[:, :, : count - first]
        return shares

    def render_deep(self, gaussians: Gaussians, camera: Camera, bins: int) -> Float32:
        """Render the view in at most `bins` slices by depth in each pixel: (bins, H, W, 5), front to back.

        The last axis is red, green, blue (premultiplied), alpha, and the slice's depth. All are 0 behind a pixel's last
        slice. The result is a view of planes.
        """
        camera.check()
        on_device, camera = self._placed(gaussians, camera, planes=4 * DEEP_FLOATS * bins)
        frame = self._forward(on_device, camera, (0.0, 0.0, 0.0))
        planes = self._rasterizer.deep(frame, bins).get()[:, :, : camera.height, : camera.width]
        if (of_distances := camera.depths_of_distances()) is not None:
            planes[:, DEEP_SLICE.index("DEPTH")] *= of_distances
        return np.asarray(planes.transpose(0, 2, 3, 1), np.float32)

    def _forward(self, gaussians: AnyGaussians, camera: Camera, background: Sequence[float]) -> ForwardPass:
        with np.errstate(over="ignore"):
            colour = np.asarray(background, np.float32)
        if colour.shape != (3,) or not np.isfinite(colour).all():
            raise InputError(f"background {background}: expected three finite numbers")
        return self._rasterizer.forward(gaussians, camera, colour, backward=False)

    def _hold_out(self, frame: ForwardPass, holdout: Surfaces | None) -> Held | None:
        if holdout is None or len(holdout.rows) == 0:
            return None
        held = upload_held(self.device, holdout)
        self._rasterizer.hold_out(frame, held)
        return held

    def _result(self, frame: ForwardPass, *, contiguous: bool) -> RenderResult:
        height, width = frame.camera.height, frame.camera.width
        image = frame.blended.image.get()[:, :height, :width].transpose(1, 2, 0)
        alpha: Float32 = np.float32(1) - frame.blended.transmittance.get()[:height, :width]
        return RenderResult(np.ascontiguousarray(image) if contiguous else image, alpha)

    def _motion(
        self, gaussians: Gaussians | AnyGaussians, on_device: AnyGaussians, ahead: _MotionEnd, back: _MotionEnd
    ) -> Motion:
        """The cameras and means to which the vectors of the channels motion and backward lead. The means are on the
        device or the host, like the model."""
        cameras = self._sent(ahead, gaussians), self._sent(back, gaussians)
        return Motion(*cameras, self._moved(on_device, ahead), self._moved(on_device, back))

    def _sent(self, end: _MotionEnd, gaussians: Gaussians | AnyGaussians) -> DeviceArray:
        """Upload the packed camera of `end` (`_MotionEnd`), relative to the origin of the means of `end`."""
        counted = gaussians if end.gaussians is None else end.gaussians
        local = counted.local(end.camera) if isinstance(counted, Gaussians) else end.camera
        return upload(self.device, pack_camera(local))

    def _moved(self, gaussians: AnyGaussians, end: _MotionEnd) -> AnyGaussians | None:
        """The means of `end` (`_MotionEnd`), on the device or the host like `gaussians`; None if they do not move.
        Raises ValueError if their number is not that of the model."""
        moved = end.gaussians
        if moved is None:
            return None
        if len(moved) != gaussians.count:
            raise ValueError(f"{len(moved)} moved Gaussians, expected {gaussians.count} as in the model")
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
        """The model on the device, and the camera relative to the model's origin. The model is on the host if the
        device has no room for it and a frame of this size.

        features: floats of each Gaussian that are blended to extra channels.
        planes: bytes per pixel in addition to the picture's.
        moved: number of sets of means at other frames, for the channels of motion.
        """
        if isinstance(gaussians, HostGaussians) and features:
            return replace(gaussians, culls=False), camera
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


@dataclass(frozen=True, eq=False)
class _MotionEnd:
    """Camera and Gaussians of the next or previous frame, to which the vectors of a channel of motion lead.

    camera: in world coordinates.
    gaussians: the Gaussians with their means at that frame; None if they do not move, or the channel is not wanted.
    """

    camera: Camera
    gaussians: Gaussians | None


def _motion_end(
    name: str, camera: Camera, other: Camera | None, gaussians: Gaussians | None, *, asked: bool
) -> _MotionEnd:
    """Return the end of the vectors of a channel of motion. They lead from `camera` to `other`; if `other` is None, to
    `camera` itself.

    name: name of the channel, for the InputError that this may raise.
    asked: True if the channel is wanted.
    """
    other = other or camera
    other.check()
    if asked and camera.model.without_motion:
        raise InputError(f"{name} is not defined for {camera.model.without_motion}")
    if asked and other.projection != camera.projection:
        raise InputError(f"{name}: the other frame's camera is {other.projection}, expected {camera.projection}")
    return _MotionEnd(other, gaussians if asked else None)


def _pixels_of(planes: Channels, camera: Camera, *, contiguous: bool) -> tuple[NDArray[Any], NDArray[Any]]:
    """Copy the arrays `means` and `whole` of `Channels` to the host, without padding and with the plane axis last."""
    arrays = (planes.means, planes.whole)
    means, whole = (array.get()[:, : camera.height, : camera.width].transpose(1, 2, 0) for array in arrays)
    return (np.ascontiguousarray(means), np.ascontiguousarray(whole)) if contiguous else (means, whole)


def _in_the_world(named: ChannelResult, camera: Camera, gaussians: Gaussians | AnyGaussians) -> ChannelResult:
    """Convert depths and positions of the kernels to depths along the camera's axis and positions in the world."""
    origin = gaussians.origin if isinstance(gaussians, Gaussians) else np.zeros(3)
    if (of_distances := camera.depths_of_distances()) is not None:
        named |= {name: named[name] * of_distances for name in ("depth", *DEPTH_PLANES)}
    if "position" in named and origin.any():  # the sum is rounded to float32
        shown = named["count"][:, :, None] > 0
        named["position"] = np.where(shown, named["position"] + origin, 0).astype(np.float32)
    return named


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    device: str | None = None,
    max_device_mem: str | int | None = None,
) -> RenderResult:
    """Render one view. Each call opens the device and uploads the model; `Renderer` keeps both.

    Parameters
    ----------
    gaussians : Gaussians
        The model.
    camera : Camera
        In world coordinates. If it specifies no near plane, the model's is used.
    background : sequence of 3 float
        Red, green, blue, any finite numbers.
    device : str, optional
        A device as `clsplat devices` lists it. None means the default device (docs/drivers.md).
    max_device_mem : str or int, optional
        Largest amount of its memory to use, in bytes or as text such as "256MiB".

    Returns
    -------
    RenderResult
        Image and alpha.

    Raises
    ------
    ValueError
        If arrays are not as `Gaussians` requires.
    InputError
        If the camera or the background is not valid.
    DeviceError
        If there is no such device.
    CapacityError
        If the picture does not fit into the device's memory.

    Notes
    -----
    Kerbl et al. 2023; docs/gradients.md has the equations.
    """
    with of_argument():
        opened = open_device(device, parse_bytes(max_device_mem))
    return Renderer(opened).render(gaussians, camera, background)
