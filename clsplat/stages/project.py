# SPDX-License-Identifier: Apache-2.0
"""Launches project.cl and project_grad.cl: Gaussians to ellipses on the image, and the gradient back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, Window
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.layout import CAMERA, PLAIN_SLOTS, SPLAT, TILE, SlotFields
from clsplat.device.profile import stage
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians

GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
"""The parameter groups on the device: as in `Gaussians`, with SH split into its constant and the rest."""


@dataclass(frozen=True, eq=False)
class ShStorage:
    """How a model that is only rendered keeps its SH.

    coefficients: of each channel; degrees (n,) uint8: the highest of each Gaussian that is looked at, None for all;
    half: the bands above 0 as float16.
    """

    coefficients: int
    degrees: NDArray[np.uint8] | None = None
    half: bool = False

    @property
    def floats(self) -> int:
        """Of one Gaussian's parameters and what is kept beside them, in what floats take, rounded up."""
        rest = 3 * (self.coefficients - 1)
        return 14 + (-(-rest // 2) if self.half else rest) + (self.degrees is not None)


@dataclass(frozen=True, eq=False)
class DeviceGaussians:
    """Parameters, or their gradients or moments: arrays by group name, the first axis of each being `count`.

    Of a model that is held to be rendered (`ShStorage`) sh_rest may be float16, and there may be sh_degrees (count)
    uint8.
    """

    count: int
    coefficients: int
    arrays: dict[str, DeviceArray]

    def __getitem__(self, group: str) -> DeviceArray:
        return self.arrays[group]


@dataclass(frozen=True, eq=False)
class HostArray:
    """An array on the host that is used as a DeviceArray is."""

    values: NDArray[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    def get(self) -> NDArray[Any]:
        """A copy."""
        return self.values.copy()

    def set(self, values: NDArray[Any]) -> None:
        """Copy from another array."""
        self.values[...] = values

    def fill(self, value: float) -> None:
        """Set every element."""
        self.values.fill(value)


@dataclass(frozen=True, eq=False)
class HostGaussians:
    """As DeviceGaussians, but on the host: for use they go to the device `rows` at a time (`parts`)."""

    count: int
    coefficients: int
    arrays: dict[str, HostArray]
    rows: int

    def __getitem__(self, group: str) -> HostArray:
        return self.arrays[group]


AnyGaussians = DeviceGaussians | HostGaussians


def parts(
    work: Workspace, *models: AnyGaussians, keep: bool = False
) -> Iterator[tuple[int, int, tuple[DeviceGaussians, ...]]]:
    """(start, stop, the models' rows from start to before stop on the device), all at once if they are there.

    Of host models the part is valid until the next one is asked for; keep: what was done to it then goes back.
    """
    on_device = tuple(model for model in models if isinstance(model, DeviceGaussians))
    if len(on_device) == len(models):
        yield 0, models[0].count, on_device
        return
    streamed = [model for model in models if isinstance(model, HostGaussians)]
    count, rows = streamed[0].count, streamed[0].rows
    for start in range(0, count, rows):
        stop = min(start + rows, count)
        uploaded = []
        for index, model in enumerate(streamed):
            arrays = {}
            for name, whole in model.arrays.items():
                values = whole.values[start:stop]
                arrays[name] = work.array(f"part{index}_{name}", values.shape, values.dtype)
                arrays[name].set(values)
            uploaded.append(DeviceGaussians(stop - start, model.coefficients, arrays))
        yield start, stop, tuple(uploaded)
        if keep:
            for model, part in zip(streamed, uploaded, strict=True):
                for name, array in part.arrays.items():
                    array.read_into(model[name].values[start:stop])


def group_shapes(count: int, coefficients: int) -> dict[str, tuple[int, ...]]:
    """The arrays of `count` Gaussians with `coefficients` SH coefficients a channel."""
    return {
        "means": (count, 3),
        "quaternions": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count,),
        "sh_dc": (count, 3),
        "sh_rest": (count, coefficients - 1, 3),
    }


def allocate_gaussians(device: Device, count: int, coefficients: int, *, zero: bool = False) -> DeviceGaussians:
    """Arrays for `count` Gaussians."""
    arrays = {name: allocate(device, shape, np.float32) for name, shape in group_shapes(count, coefficients).items()}
    if zero:
        for array in arrays.values():
            array.fill(0.0)
    return DeviceGaussians(count, coefficients, arrays)


def _grouped(gaussians: Gaussians, sh: ShStorage) -> dict[str, NDArray[Any]]:
    host = {
        "means": gaussians.means,
        "quaternions": gaussians.quaternions,
        "log_scales": gaussians.log_scales,
        "opacity_logits": gaussians.opacity_logits,
        "sh_dc": gaussians.sh[:, 0],
        "sh_rest": gaussians.sh[:, 1 : sh.coefficients],
    }
    kinds = {"sh_rest": np.float16 if sh.half else np.float32}
    arrays = {name: np.ascontiguousarray(values, kinds.get(name, np.float32)) for name, values in host.items()}
    return arrays if sh.degrees is None else {**arrays, "sh_degrees": sh.degrees}


def upload_gaussians(device: Device, gaussians: Gaussians, sh: ShStorage | None = None) -> DeviceGaussians:
    """A copy on the device; sh: to be rendered alone."""
    sh = sh or ShStorage(gaussians.sh.shape[1])
    arrays = {name: upload(device, values) for name, values in _grouped(gaussians, sh).items()}
    return DeviceGaussians(len(gaussians), sh.coefficients, arrays)


def host_gaussians(gaussians: Gaussians, rows: int, sh: ShStorage | None = None) -> HostGaussians:
    """On the host, to go through the device `rows` at a time. Not a copy: to read, unless the caller may write.

    sh: to be rendered alone.
    """
    sh = sh or ShStorage(gaussians.sh.shape[1])
    arrays = {name: HostArray(values) for name, values in _grouped(gaussians, sh).items()}
    return HostGaussians(len(gaussians), sh.coefficients, arrays, rows)


def host_zeros(count: int, coefficients: int, rows: int) -> HostGaussians:
    """Zeros, as moments begin."""
    shapes = group_shapes(count, coefficients)
    arrays = {name: HostArray(np.zeros(shape, np.float32)) for name, shape in shapes.items()}
    return HostGaussians(count, coefficients, arrays, rows)


def to_host(gaussians: AnyGaussians) -> HostGaussians:
    """A copy of what is on the device, or what is on the host already."""
    if isinstance(gaussians, HostGaussians):
        return gaussians
    arrays = {name: HostArray(array.get()) for name, array in gaussians.arrays.items()}
    return HostGaussians(gaussians.count, gaussians.coefficients, arrays, gaussians.count)


def to_device(device: Device, gaussians: HostGaussians) -> DeviceGaussians:
    """A copy of what is on the host."""
    arrays = {name: upload(device, array.values) for name, array in gaussians.arrays.items()}
    return DeviceGaussians(gaussians.count, gaussians.coefficients, arrays)


def download_gaussians(gaussians: AnyGaussians) -> Gaussians:
    """A copy on the host."""
    host = {name: gaussians[name].get() for name in GROUPS}
    return Gaussians(
        means=host["means"],
        quaternions=host["quaternions"],
        log_scales=host["log_scales"],
        opacity_logits=host["opacity_logits"],
        sh=np.concatenate([host["sh_dc"][:, None], host["sh_rest"]], axis=1),
    )


def pack_camera(camera: Camera) -> NDArray[np.float32]:
    """A camera in the order of `layout.CAMERA`: its values rounded to float32, and as _LOW what that left of them.

    Raises InputError for a panorama of more than a whole turn.
    """
    if camera.projection == "equirectangular" and camera.width > (turn := 2 * np.pi * camera.fx) * (1 + 1e-6):
        wide = f"{camera.width} pixels wide, of which {turn:.1f} are a whole turn"
        raise InputError(f"an equirectangular camera is {wide}: expected no more")
    window = camera.window or Window(0, 0, camera.width, camera.height)
    half_w, half_h = 0.5 * window.width / camera.fx, 0.5 * window.height / camera.fy
    values = {
        "FX": camera.fx,
        "FY": camera.fy,
        "CX": camera.cx,
        "CY": camera.cy,
        "NEAR": max(camera.near, 0.0),  # what is behind has no place in the order of depth
        "HAND": float(np.copysign(1.0, np.linalg.det(camera.rotation))),
        "XMIN": -camera.cx / camera.fx - window.clamp * half_w,
        "XMAX": (window.width - camera.cx) / camera.fx + window.clamp * half_w,
        "YMIN": -camera.cy / camera.fy - window.clamp * half_h,
        "YMAX": (window.height - camera.cy) / camera.fy + window.clamp * half_h,
        "WINDOW_X": window.x,
        "WINDOW_Y": window.y,
    }
    for row in range(3):
        values[f"T{row}"] = float(camera.translation[row])
        values["P" + "XYZ"[row]] = float(camera.position[row])
        for column in range(3):
            values[f"R{row}{column}"] = float(camera.rotation[row, column])
    rounded = {name: np.float32(value) for name, value in values.items()}
    rounded.update({f"{name}_LOW": np.float32(value - float(rounded[name])) for name, value in values.items()})
    return np.array([rounded[name] for name in CAMERA], np.float32)


def tiles_of(camera: Camera) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


@dataclass(frozen=True, eq=False)
class Projected:
    """splats (n, SPLAT), tile_counts (n): 0 where culled; shown (n): 0 where there is no splat, if that is another
    thing because culling is switched off."""

    splats: DeviceArray
    tile_counts: DeviceArray
    shown: DeviceArray | None = None

    def rows(self, start: int, stop: int) -> Projected:
        """Of the Gaussians from start to before stop."""
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
    tiles_x, tiles_y = tiles_of(camera)
    keeps_culled = device.switched("NO_FRUSTUM_CULL", "NO_OPACITY_CULL")
    rays = device.switched("RAYS")
    if rays:
        keeps_culled = False  # project_rays has no such switches
    projected = Projected(splats, tile_counts, work.array("shown", (n,), np.uint32) if keeps_culled else None)
    for start, stop, (part,) in parts(work, gaussians):
        out = projected.rows(start, stop)
        if rays:
            _project_rays(device, part, camera, camera_array, out)
            continue
        extras = ["sh_degrees"] if "sh_degrees" in part.arrays else []
        defines = {name.upper(): True for name in extras}
        if part["sh_rest"].dtype == np.float16:
            defines["SH_HALF"] = True
        launch_items(
            device,
            device.kernels("project", **defines).project,
            -(-part.count // device.shape.lanes),
            part.count,
            part.coefficients,
            tiles_x,
            tiles_y,
            camera_array,
            *(part[group] for group in GROUPS),
            out.splats,
            out.tile_counts,
            *(() if out.shown is None else (out.shown,)),
            *(part[name] for name in extras),
        )
    return projected


def _project_rays(
    device: Device, part: DeviceGaussians, camera: Camera, camera_array: DeviceArray, out: Projected
) -> None:
    defines: dict[str, object] = {"SH_DEGREES": True} if "sh_degrees" in part.arrays else {}
    if part["sh_rest"].dtype == np.float16:
        defines["SH_HALF"] = True
    launch_items(
        device,
        device.kernels("project_rays", LANES=1, **defines).project_rays,
        part.count,
        part.count,
        part.coefficients,
        camera.width,
        camera.height,
        camera_array,
        *(part[group] for group in GROUPS),
        out.splats,
        out.tile_counts,
        *([part["sh_degrees"]] if "sh_degrees" in part.arrays else []),
    )


@dataclass(frozen=True, eq=False)
class Slots:
    """values (pairs, SlotFields.floats), where those of Gaussian i begin at first_slots[i]; without first_slots they
    are added up already: (n, SlotFields.floats)."""

    values: DeviceArray
    first_slots: DeviceArray | None = None

    def rows(self, start: int, stop: int) -> Slots:
        """For the Gaussians from start to before stop."""
        if self.first_slots is None:
            return Slots(self.values.rows(start, stop))
        return Slots(self.values, self.first_slots.rows(start, stop))


@dataclass(frozen=True, eq=False)
class Screen:
    """Of one view, in rows of the visible: gradients (n, 2) of the means on the image, in pixels; contributions (n,),
    the sums of blending weights over the image's pixels, or None."""

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
    launch_items(
        device,
        device.kernels("project_grad", **fields.defines).add_slots,
        n if slots.values.shape[0] else 0,
        n,
        tile_counts,
        slots.first_slots,
        slots.values,
        sums,
    )
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
    launch_items(
        device,
        device.kernels("project_grad", **defines).project_grad,
        -(-n // device.shape.lanes) if slots.values.shape[0] else 0,
        n,
        gaussians.coefficients,
        camera_array,
        projected.tile_counts,
        slots.first_slots or projected.tile_counts,  # not looked at where they are added up
        slots.values,
        projected.splats,
        *(gaussians[group] for group in GROUPS),
        *(gradients[group] for group in GROUPS),
        screen.gradients,
        *([screen.contributions] if fields.contributions else []),
    )
