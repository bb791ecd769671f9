# SPDX-License-Identifier: Apache-2.0
"""Harness of the self-test: frozen scenes on a device, errors in ulp, and digests of results."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SPLAT
from clsplat.reference import blend as reference_blend
from clsplat.reference import project as reference_project
from clsplat.selftest.scenes import Frozen
from clsplat.stages.blend import Blended, ImageInputs
from clsplat.stages.device_camera import pack_camera, padded_size, tiles_of
from clsplat.stages.device_gaussians import upload_gaussians
from clsplat.stages.duplicate import Band, Counted, Pairs
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists

T = TypeVar("T")
Array = NDArray[Any]

WHITENING_FACTOR = np.sqrt(0.5 * np.log2(np.e))
MIN_DECISION_MARGIN = 1e-4
"""Margin: least relative distance of alpha and transmittance from their thresholds for a pixel to be compared. Nearer
pixels depend on rounding. The distance is a hundred times the rounding error."""


@dataclass(frozen=True)
class StageOutcome:
    """The outcome of a stage on a scene.

    arrays: the results that the digest covers.
    errors: the largest absolute error and the largest error in ulp, by the name of the compared quantity.
    trouble: description of a fault, or empty.
    otherwise: names of the operations that do not round as IEEE 754 demands.
    """

    arrays: list[Array] = field(default_factory=list)
    errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ms: float = 0.0
    trouble: str = ""
    otherwise: tuple[str, ...] = ()

    def compared(self, parts: Mapping[str, tuple[Array, Array]], **wrong: int) -> StageOutcome:
        """Return a copy of this outcome that has the errors of the stage's results.

        parts: for each float result, by name, the device's values and the wanted values.
        wrong: for each integer result, by name, the number of wrong elements.
        """
        errors = {name: error_of(got, wanted) for name, (got, wanted) in parts.items()}
        counts = ", ".join(f"{count} {name.replace('_', ' ')} wrong" for name, count in wrong.items() if count)
        return replace(self, errors=errors, trouble=self.trouble or counts)


def joined(outcomes: Sequence[StageOutcome]) -> StageOutcome:
    """Join the outcomes of a stage on several inputs: all arrays, the largest errors, and the first fault."""
    every = [item for outcome in outcomes for item in outcome.errors.items()]
    return StageOutcome(
        [array for outcome in outcomes for array in outcome.arrays],
        {name: max(error for other, error in every if other == name) for name, _ in every},
        sum(outcome.ms for outcome in outcomes),
        next((outcome.trouble for outcome in outcomes if outcome.trouble), ""),
    )


def error_of(got: Array, wanted: Array) -> tuple[float, float]:
    """Return the largest absolute error of the values `got`, and their largest error in ulp.

    Both are infinite if a value is not finite.

    The ulp is that of the wanted value or of the array's root mean square, whichever is larger, because a sum that
    cancels has no accurate digits.
    """
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
    """The CRC-32 of the arrays' bytes in order, as eight hexadecimal digits."""
    total = 0
    for array in arrays:
        total = zlib.crc32(np.ascontiguousarray(array).tobytes(), total)
    return f"{total:08x}"


def cropped(planes: Array, size: Camera | tuple[int, int]) -> Array:
    """Crop padded planes (rows, stride) or (C, rows, stride) to an image (H, W) or (H, W, C).

    size: the image's (width, height), or a camera of that size.
    """
    width, height = (size.width, size.height) if isinstance(size, Camera) else size
    inside = planes[..., :height, :width]
    return inside.transpose(1, 2, 0) if inside.ndim == 3 else inside


def planes_of(image: Array, beside: float = 0.0) -> Float32:
    """Convert an image (H, W, C) to planes (C, rows, stride), padded to whole tiles.

    beside: the value of the padding.
    """
    height, width, channels = image.shape
    planes = np.full((channels, *padded_size(width, height)), beside, np.float32)
    planes[:, :height, :width] = image.transpose(2, 0, 1)
    return planes


class CaseBench:
    """A frozen scene on a device, with the results of the stages that have run."""

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
        self.slices: DeviceArray

    def twice(self, launch: Callable[[], T], take: Callable[[T], list[Array]]) -> tuple[T, StageOutcome]:
        """Run a stage twice. Returns the result of the second run, and an outcome with its arrays and milliseconds.

        The first run includes the kernel builds. It is a fault if the bits of the two runs differ.

        launch: function that runs the stage on the device.
        take: function that reads the arrays of the digest from the stage's result.
        """
        first = take(launch())
        value, ms = self.device.timed(launch)
        arrays = take(value)
        same = digest_of(first) == digest_of(arrays)
        trouble = "" if same else "two runs on the same input gave different bits"
        return value, StageOutcome(arrays, ms=ms, trouble=trouble)

    @property
    def inputs(self) -> ImageInputs:
        """The inputs of the stages that process pixels."""
        return ImageInputs(self.projected.splats, self.background, self.camera.width, self.camera.height)

    @property
    def visible(self) -> NDArray[np.bool_]:
        shown: NDArray[np.bool_] = self.projected.tile_counts.get() > 0
        return shown

    def splats(self) -> reference_project.ProjectedTwin:
        """Return the device's splats as the float64 reference stores projected Gaussians."""
        visible = self.visible
        raw = self.projected.splats.get()
        raw[~visible] = 1.0  # invisible Gaussians' splats are uninitialised memory
        splats = raw.astype(np.float64)
        field = {name: splats[:, index] for index, name in enumerate(SPLAT)}
        means = np.stack([field["PIXEL_X"] + field["SUB_X"], field["PIXEL_Y"] + field["SUB_Y"]], axis=1)
        l11, l12, l22 = (field[name] / WHITENING_FACTOR for name in ("L11", "L12", "L22"))
        conics = np.stack([l11 * l11, l11 * l12, l12 * l12 + l22 * l22], axis=1)
        det = (l11 * l22) ** 2
        return reference_project.ProjectedTwin(
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

    def blend_reference(self) -> tuple[reference_blend.BlendedTwin, NDArray[np.bool_]]:
        """The reference's frame, blended from the device's splats, and the mask of the pixels to compare
        (MIN_DECISION_MARGIN)."""
        splats = self.splats()
        camera, background = self.camera, self.frozen.background.astype(np.float64)
        frame = reference_blend.blend(splats, camera.width, camera.height, background)
        return frame, frame.margin > MIN_DECISION_MARGIN
