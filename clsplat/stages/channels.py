# SPDX-License-Identifier: Apache-2.0
"""Launches features.cl and channels.cl: a frame's channels other than colour and alpha (docs/channels.md)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.channels import floats_of
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.layouts.columns import TILE
from clsplat.stages.blend import Blended, ImageInputs, launch_tiles
from clsplat.stages.device_gaussians import AnyGaussians, parts
from clsplat.stages.holdout import Held
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists

FEATURE_WIDTHS = floats_of("features")
"""Number of floats of each feature, by its name. Features are values of a Gaussian that are blended into a channel."""
DEPTH_PLANES, WHOLE_NUMBER_PLANES = tuple(floats_of("depths")), tuple(floats_of("whole"))
"""Names of the depth planes, which follow the blended features, and of the integer planes, in channels.cl's order."""


@dataclass(frozen=True)
class Features:
    """The features that a frame blends, in the order of FEATURE_WIDTHS. Depth is always one of them, as it costs almost
    nothing."""

    names: tuple[str, ...] = ("depth",)

    @classmethod
    def of(cls, wanted: Iterable[str]) -> Features:
        """Make `Features` of depth and of the features named in `wanted`. Raises ValueError for an unknown name."""
        kept = {"depth", *wanted}
        if unknown := kept - FEATURE_WIDTHS.keys():
            raise ValueError(f"no such features: {', '.join(sorted(unknown))}; expected {', '.join(FEATURE_WIDTHS)}")
        return cls(tuple(name for name in FEATURE_WIDTHS if name in kept))

    @property
    def offsets(self) -> dict[str, int]:
        """Offset in floats of each feature in a Gaussian's row."""
        ends = accumulate(FEATURE_WIDTHS[name] for name in self.names)
        return {name: end - FEATURE_WIDTHS[name] for name, end in zip(self.names, ends, strict=True)}

    @property
    def floats(self) -> int:
        """Number of floats in a Gaussian's row of features."""
        return sum(FEATURE_WIDTHS[name] for name in self.names)

    @property
    def defines(self) -> dict[str, object]:
        """Macros that features.cl and channels.cl are compiled with: the size of a row and the features' offsets."""
        return {"FEATURES": self.floats, **{f"FEATURE_{name.upper()}": at for name, at in self.offsets.items()}}

    def named(self, means: NDArray[Any], whole: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return channels by name, (H, W) or (H, W, floats).

        means, whole: the arrays of `Channels`, copied to the host and transposed to (H, W, planes).
        """
        planes = {name: means[:, :, at : at + FEATURE_WIDTHS[name]] for name, at in self.offsets.items()}
        planes = {name: plane if plane.shape[2] > 1 else plane[:, :, 0] for name, plane in planes.items()}
        planes |= {name: means[:, :, at] for at, name in enumerate(DEPTH_PLANES, self.floats)}
        return planes | {name: whole[:, :, at] for at, name in enumerate(WHOLE_NUMBER_PLANES)}


@dataclass(frozen=True)
class Floats:
    """Arbitrary values that are blended like features: each Gaussian has a row of `floats` numbers."""

    floats: int

    @property
    def defines(self) -> dict[str, object]:
        """Macros that channels.cl is compiled with: the size of a Gaussian's row."""
        return {"FEATURES": self.floats}


@dataclass(frozen=True, eq=False)
class Channels:
    """Channels of a frame, as planes padded to whole tiles. `Features.named` splits them into channels by name.

    means: (floats + 2, rows, stride), the blended features, then the planes of DEPTH_PLANES.
    whole: (2, rows, stride) int32, the planes of WHOLE_NUMBER_PLANES.
    """

    means: DeviceArray
    whole: DeviceArray


@dataclass(frozen=True, eq=False)
class Motion:
    """Cameras and means at the end of forward motion and of backward motion.

    after: the packed camera at the end of forward motion.
    before: the packed camera at the end of backward motion; None means `after`.
    moved, earlier: the Gaussians at the times of `after` and `before`, on the device or host like the model; None if
    they do not move.
    """

    after: DeviceArray
    before: DeviceArray | None = None
    moved: AnyGaussians | None = None
    earlier: AnyGaussians | None = None


@stage("features")
def features(
    device: Device,
    work: Workspace,
    wanted: Features,
    gaussians: AnyGaussians,
    camera_array: DeviceArray,
    projected: Projected,
    motion: Motion,
) -> DeviceArray:
    """Compute the features (n, wanted.floats) of each visible Gaussian. Other rows are left unwritten."""
    rows = work.array("features", (gaussians.count, wanted.floats))
    after, before = motion.after, motion.after if motion.before is None else motion.before
    moments = (motion.moved, motion.earlier)
    others = [other for other in moments if other is not None]
    for start, stop, (part, *there) in parts(work, gaussians, *others):
        splats, means = projected.rows(start, stop), iter(there)
        means_after, means_before = (part if other is None else next(means) for other in moments)
        launch_items(
            device,
            device.kernels("features", {"LANES": 1, **wanted.defines}).features,
            part.count,
            part.count,
            camera_array,
            after,
            before,
            splats.tile_counts,
            part["means"],
            part["quaternions"],
            part["log_scales"],
            means_after["means"],
            means_before["means"],
            splats.splats,
            rows.rows(start, stop),
        )
    return rows


@stage("channels")
def channels(
    device: Device,
    work: Workspace,
    wanted: Features | Floats,
    rows: DeviceArray,
    lists: TileLists,
    inputs: ImageInputs,
    blended: Blended,
    held: Held | None = None,
) -> Channels:
    """Blend a row of values of each Gaussian into channels, with the same weights as the image in `blended`.

    lists: the tile lists from which the image was blended.
    wanted: the features, or other values, in a row.
    rows: (n, wanted.floats), the values of each Gaussian, such as the result of `features`.
    held: surfaces of the holdout; None without a holdout.
    """
    plane_rows, stride = blended.stops.shape
    means = work.array("channel_means", (wanted.floats + len(DEPTH_PLANES), plane_rows, stride))
    whole = work.array("channel_whole", (len(WHOLE_NUMBER_PLANES), plane_rows, stride), np.int32)
    arrays = (lists.ranges, lists.gaussian_from_sorted, inputs.splats, rows, blended.stops, means, whole)
    further = (*(held.arguments if held else ()), *((inputs.camera_array,) if device.switched("RAYS") else ()))
    defines = {**wanted.defines, **({"HOLDOUT": True} if held else {})}
    launch_tiles(device, "channels", defines, lists, stride // TILE, inputs.height, *arrays, *further)
    return Channels(means, whole)
