# SPDX-License-Identifier: Apache-2.0
"""Launches features.cl and channels.cl: what a frame has beside colour and alpha (docs/channels.md)."""

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
from clsplat.device.layout import TILE
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended, launch_tiles
from clsplat.stages.device_gaussians import AnyGaussians, parts
from clsplat.stages.holdout import Held
from clsplat.stages.project import Projected
from clsplat.stages.ranges import TileLists

WIDTHS = floats_of("features")
"""Floats of each feature."""
DEPTHS, WHOLE = tuple(floats_of("depths")), tuple(floats_of("whole"))
"""Planes behind the blended features, and those of whole numbers, in the order of channels.cl."""


@dataclass(frozen=True)
class Features:
    """The features that are blended, in the order of WIDTHS; depth always is, as it costs next to nothing."""

    names: tuple[str, ...] = ("depth",)

    @classmethod
    def of(cls, wanted: Iterable[str]) -> Features:
        """Depth and those of `wanted`."""
        kept = {"depth", *wanted}
        if unknown := kept - WIDTHS.keys():
            raise ValueError(f"no such features: {', '.join(sorted(unknown))}")
        return cls(tuple(name for name in WIDTHS if name in kept))

    @property
    def offsets(self) -> dict[str, int]:
        """Offset of each feature in a row."""
        ends = accumulate(WIDTHS[name] for name in self.names)
        return {name: end - WIDTHS[name] for name, end in zip(self.names, ends, strict=True)}

    @property
    def floats(self) -> int:
        """Floats of a row."""
        return sum(WIDTHS[name] for name in self.names)

    @property
    def defines(self) -> dict[str, object]:
        """Defines for both kernels."""
        return {"FEATURES": self.floats, **{f"FEATURE_{name.upper()}": at for name, at in self.offsets.items()}}

    def named(self, means: NDArray[Any], whole: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """The channels of `Channels`' planes on the host, which are last here: (H, W), or (H, W, floats) of several."""
        planes = {name: means[:, :, at : at + WIDTHS[name]] for name, at in self.offsets.items()}
        planes = {name: plane if plane.shape[2] > 1 else plane[:, :, 0] for name, plane in planes.items()}
        planes |= {name: means[:, :, at] for at, name in enumerate(DEPTHS, self.floats)}
        return planes | {name: whole[:, :, at] for at, name in enumerate(WHOLE)}


@dataclass(frozen=True)
class Floats:
    """Rows of any values that are blended as features are."""

    floats: int

    @property
    def defines(self) -> dict[str, object]:
        """Defines for channels.cl."""
        return {"FEATURES": self.floats}


@dataclass(frozen=True, eq=False)
class Channels:
    """Planes padded to whole tiles: means (floats + 2, rows, stride) of the features and, behind them, DEPTHS; whole
    (2, rows, stride): WHOLE. `Features.named` takes them apart."""

    means: DeviceArray
    whole: DeviceArray


@stage("features")
def features(
    device: Device,
    work: Workspace,
    wanted: Features,
    gaussians: AnyGaussians,
    camera_array: DeviceArray,
    after: DeviceArray,
    projected: Projected,
    before: DeviceArray | None = None,
    moved: AnyGaussians | None = None,
    earlier: AnyGaussians | None = None,
) -> DeviceArray:
    """Features of each visible Gaussian, (n, wanted.floats). after: the packed camera that motion goes to; before: the
    one of backward motion, the same if None; moved, earlier: the Gaussians with the means that these go to, on the
    device or the host as the others; None where they stand still."""
    rows = work.array("features", (gaussians.count, wanted.floats))
    others = [other for other in (moved, earlier) if other is not None]
    for start, stop, (part, *there) in parts(work, gaussians, *others):
        splats, means = projected.rows(start, stop), iter(there)
        means_after, means_before = (part if other is None else next(means) for other in (moved, earlier))
        launch_items(
            device,
            device.kernels("features", LANES=1, **wanted.defines).features,
            part.count,
            part.count,
            camera_array,
            after,
            after if before is None else before,
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
    projected: Projected,
    blended: Blended,
    height: int,
    camera_array: DeviceArray | None = None,
    held: Held | None = None,
) -> Channels:
    """Blend the features with the weights of `blended`, which is of the same lists. camera_array: for pixels that are
    rays; held: surfaces that hold them out."""
    plane_rows, stride = blended.stops.shape
    means = work.array("channel_means", (wanted.floats + len(DEPTHS), plane_rows, stride))
    whole = work.array("channel_whole", (len(WHOLE), plane_rows, stride), np.int32)
    arrays = (lists.ranges, lists.gaussian_from_sorted, projected.splats, rows, blended.stops, means, whole)
    further = (*(held.arguments if held else ()), *((camera_array,) if device.switched("RAYS") else ()))
    defines = {**wanted.defines, **({"HOLDOUT": True} if held else {})}
    launch_tiles(device, "channels", defines, lists, stride // TILE, height, *arrays, *further)
    return Channels(means, whole)
