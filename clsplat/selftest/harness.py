# SPDX-License-Identifier: Apache-2.0
"""Harness of the self-test's stages: a frozen scene on a device, errors and digests."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.layout import SPLAT
from clsplat.reference import blend as reference_blend
from clsplat.reference import project as reference_project
from clsplat.selftest.scenes import Frozen
from clsplat.stages.blend import Blended
from clsplat.stages.device_camera import pack_camera, tiles_of
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.duplicate import Band, Counted, Pairs
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists

T = TypeVar("T")
Array = NDArray[Any]

WHITEN = np.sqrt(0.5 * np.log2(np.e))
MARGIN = 1e-4
"""Pixels where alpha, or what is left of the light, is relatively nearer than this to a threshold are not compared:
there a rounding decides. It is a hundred times what rounding moves them by."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one stage on one scene: arrays that the digest is of, errors by the name of what was compared,
    absolute and in ulp; trouble in words; otherwise: operations that round in another way than IEEE 754's."""

    arrays: list[Array] = field(default_factory=list)
    errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ms: float = 0.0
    trouble: str = ""
    otherwise: tuple[str, ...] = ()

    def compared(self, parts: Mapping[str, tuple[Array, Array]], **wrong: int) -> Outcome:
        """The same with `error_of` what was got and what is wanted, by name. wrong: how many whole numbers are."""
        errors = {name: error_of(got, wanted) for name, (got, wanted) in parts.items()}
        counts = ", ".join(f"{count} {name.replace('_', ' ')} wrong" for name, count in wrong.items() if count)
        return replace(self, errors=errors, trouble=self.trouble or counts)


def joined(outcomes: Sequence[Outcome]) -> Outcome:
    """The outcome of a stage that is run in several ways: every array, the worst errors, the first trouble."""
    every = [item for outcome in outcomes for item in outcome.errors.items()]
    return Outcome(
        [array for outcome in outcomes for array in outcome.arrays],
        {name: max(error for other, error in every if other == name) for name, _ in every},
        sum(outcome.ms for outcome in outcomes),
        next((outcome.trouble for outcome in outcomes if outcome.trouble), ""),
    )


def error_of(got: Array, wanted: Array) -> tuple[float, float]:
    """(worst absolute error, worst in ulp): ulp of the wanted value, or where that is smaller of the array's root mean
    square, as what is left of a sum that cancels has no digits of its own. Infinite where a value is not finite."""
    if wanted.size == 0:
        return 0.0, 0.0
    with np.errstate(all="ignore"):
        error = np.abs(np.asarray(got, np.float64) - wanted)
        size = np.maximum(np.abs(wanted), np.sqrt(np.mean(np.square(wanted))))
        ulp = error / np.spacing(np.maximum(size, 1e-30).astype(np.float32)).astype(np.float64)
    if not np.isfinite(error).all():
        return float("inf"), float("inf")
    return float(error.max()), float(ulp.max())


def digest_of(arrays: Sequence[Array]) -> str:
    """CRC-32 of the bytes one after the other."""
    total = 0
    for array in arrays:
        total = zlib.crc32(np.ascontiguousarray(array).tobytes(), total)
    return f"{total:08x}"


def cropped(planes: Array, camera: Camera) -> Array:
    """(H, W) or (H, W, fields) of planes with their padding."""
    inside = planes[..., : camera.height, : camera.width]
    return inside.transpose(1, 2, 0) if inside.ndim == 3 else inside


class Bench:
    """One frozen scene on one device, with what the stages have made so far."""

    def __init__(self, device: Device, frozen: Frozen) -> None:
        self.device, self.frozen = device, frozen
        self.work = Workspace(device)
        self.model = upload_gaussians(device, frozen.gaussians)
        self.camera = frozen.camera
        self.camera_array = upload(device, pack_camera(frozen.camera))
        self.background = upload(device, frozen.background)
        self.tiles = tiles_of(frozen.camera)
        self.band = Band(0, self.tiles[0] * self.tiles[1])
        self.projected: Projected
        self.counted: Counted
        self.pairs: Pairs
        self.lists: TileLists
        self.blended: Blended
        self.features: DeviceArray

    def twice(self, launch: Callable[[], T], take: Callable[[T], list[Array]]) -> tuple[T, Outcome]:
        """The stage's value, and its arrays on the host and ms, of a second run; trouble where that differs from the
        first, which had the kernels to build."""
        first = take(launch())
        value, ms = self.device.timed(launch)
        arrays = take(value)
        same = digest_of(first) == digest_of(arrays)
        trouble = "" if same else "two runs on the same input gave different bits"
        return value, Outcome(arrays, ms=ms, trouble=trouble)

    @property
    def visible(self) -> NDArray[np.bool_]:
        shown: NDArray[np.bool_] = self.projected.tile_counts.get() > 0
        return shown

    def splats(self) -> reference_project.Projected:
        """The splats that the device made, in the reference's form."""
        visible = self.visible
        raw = self.projected.splats.get()
        raw[~visible] = 1.0  # memory that was never written
        splats = raw.astype(np.float64)
        field = {name: splats[:, index] for index, name in enumerate(SPLAT)}
        means = np.stack([field["PIXEL_X"] + field["SUB_X"], field["PIXEL_Y"] + field["SUB_Y"]], axis=1)
        l11, l12, l22 = (field[name] / WHITEN for name in ("L11", "L12", "L22"))
        conics = np.stack([l11 * l11, l11 * l12, l12 * l12 + l22 * l22], axis=1)
        det = (l11 * l22) ** 2
        return reference_project.Projected(
            means2d=means,
            covariances=np.stack([conics[:, 2] / det, -conics[:, 1] / det, conics[:, 0] / det], axis=1),
            conics=conics,
            whitening=np.stack([l11, l12, l22], axis=1),
            half_extents=np.stack([field["HALF_W"], field["HALF_H"]], axis=1),
            depths=field["DEPTH"],
            opacities=np.exp2(field["LOG2O"]),
            colors=np.stack([field["RED"], field["GREEN"], field["BLUE"]], axis=1),
            visible=visible,
        )

    def blend_reference(self) -> tuple[reference_blend.Blended, NDArray[np.bool_]]:
        """The frame of the splats that the device made, and the pixels that are compared (MARGIN)."""
        splats = self.splats()
        camera, background = self.camera, self.frozen.background.astype(np.float64)
        frame = reference_blend.blend(splats, camera.width, camera.height, background)
        return frame, frame.margin > MARGIN
