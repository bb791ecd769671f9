# SPDX-License-Identifier: Apache-2.0
"""Measurement of the places that photographs show, and of the cells' loads, by rendering the coarse model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from clsplat.arrays import Bool, Float32, Float64
from clsplat.blocks.plan import MARGIN, SHARE, Rectangle, Sky
from clsplat.blocks.planning.ground import Ground, on_ground
from clsplat.blocks.planning.loads import CellBins, belonging, places_seen
from clsplat.blocks.planning.split import Leaf, Tree, bounds_of, cells, widened
from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SlotFields
from clsplat.progress import CountedFraction, Progress, no_progress
from clsplat.rendering.contributions import contributions_by_camera
from clsplat.rendering.memory_needs import StepMemory, step_need
from clsplat.scenes.scene import Scene

ROWS_GROWTH = 4.0
"""Expected number of Gaussians of a block's model, as a multiple of the coarse model's there. Photographs of twice the
size have four times as many pixels."""


SKY_EXTENTS = 5.0
"""Distance from the middle of the cameras at which the sky begins, in extents of the scene. `--sky` places Gaussians at
SKY_RADIUS_RATIO (`config.points`) extents or more, from where they move while they are trained."""
MIN_SKY_SHARE = 0.05
"""A photograph shows the sky if the sky fills at least this fraction of the pixels that all Gaussians fill."""


MIN_CAMERA_PLACES = 2
"""Least number of different camera positions of a block."""


@dataclass(frozen=True, eq=False)
class SkyLoads:
    """The part of the coarse model that is the sky, and the photographs that show it.

    sphere: where the sky begins.
    rows: (N,), True for the coarse model's Gaussians in the sky.
    shown: (P,), True for photographs that show it.
    """

    sphere: Sky
    rows: Bool
    shown: Bool


@dataclass(frozen=True, eq=False)
class CellLoads:
    """Loads of the cells of a tree.

    names, cells: of each cell.
    widened: each cell with its margin.
    belongs: (P, B), True if a photograph belongs to a cell.
    inside, around: (B,), numbers of the coarse model's Gaussians in each cell, and in each widened cell.
    sky: the sky, which the cells do not contain; None if they do.
    """

    names: tuple[str, ...]
    cells: tuple[Rectangle, ...]
    widened: tuple[Rectangle, ...]
    belongs: Bool
    inside: Float64
    around: Float64
    sky: SkyLoads | None = None


class LoadMeasurement:
    """Measures the loads of cells of a scene.

    scene: the scene at the size of the whole.
    model: the coarse model.
    cameras: cameras of the scene's training views in the order of names, at the size of the coarse model's photographs.
    config: settings of the training of the whole.
    """

    def __init__(
        self,
        scene: Scene,
        ground: Ground,
        model: Gaussians,
        cameras: Sequence[Camera],
        device: Device,
        config: TrainConfig,
        progress: Progress = no_progress,
    ) -> None:
        self.scene, self.ground, self.model, self.cameras = scene, ground, model, cameras
        self.device, self.config, self.progress = device, config, progress
        self._last: tuple[Tree, CellLoads] | None = None

    @cached_property
    def coordinates(self) -> Float64:
        """Coordinates (N, 2) on the ground of the coarse model's means."""
        return on_ground(self.model.means.astype(np.float64) + self.model.origin, self.ground.axes)

    @cached_property
    def camera_places(self) -> Float64:
        """Coordinates (P, 2) on the ground of the cameras."""
        return on_ground(np.stack([camera.position for camera in self.cameras]), self.ground.axes)

    @cached_property
    def _shown(self) -> tuple[Float64, Float64]:
        """Places (P, 2), as `places`, and the fraction (P,) of each photograph's pixels that the sky fills."""
        rows, shares = self._sky_rows, list[float]()

        def on_the_ground() -> Iterator[Float32]:
            for weights in self._contributions("finding what photographs show"):
                shares.append(float(weights[rows].sum(dtype=np.float64) / max(weights.sum(dtype=np.float64), 1e-30)))
                yield np.where(rows, np.float32(0), weights)

        places = places_seen(self.coordinates, on_the_ground(), self.camera_places)
        return places, np.array(shares)

    @cached_property
    def _sphere(self) -> Sky:
        """Where the sky begins, if there is one."""
        x, y, z = (float(value) for value in self.scene.spread[0])
        return Sky((x, y, z), SKY_EXTENTS * self.scene.extent)

    @cached_property
    def _sky_rows(self) -> Bool:
        """Mask (N,) of the coarse model's Gaussians outside the sphere."""
        offsets = self.model.means.astype(np.float64) + (self.model.origin - np.array(self._sphere.centre))
        return np.asarray(np.linalg.norm(offsets, axis=1) >= self._sphere.radius)

    @cached_property
    def places(self) -> Float64:
        """Place (P, 2) that each photograph shows, not counting the sky; the camera's place for a photograph that shows
        no Gaussian on the ground."""
        return self._shown[0]

    @property
    def sky(self) -> SkyLoads | None:
        """The sky; None if photographs from fewer than MIN_CAMERA_PLACES places show it."""
        shown = self._shown[1] >= MIN_SKY_SHARE
        return SkyLoads(self._sphere, self._sky_rows, shown) if self.has_several_places(shown) else None

    def has_several_places(self, photographs: Bool) -> bool:
        """True if photographs, given as a mask (P,), were taken from at least MIN_CAMERA_PLACES positions."""
        return len(np.unique(self.camera_places[photographs], axis=0)) >= MIN_CAMERA_PLACES

    def of(self, tree: Tree) -> CellLoads:
        """Measure the loads of the cells of a tree. The loads of the last tree are remembered."""
        if self._last is None or self._last[0] != tree:
            names, rectangles = zip(*cells(tree), strict=True)
            bounds = bounds_of(self.places)
            wide = tuple(widened(cell, bounds, MARGIN) for cell in rectangles)
            sky = None if isinstance(tree, Leaf) else self.sky
            ground = np.ones(len(self.model), np.bool_) if sky is None else ~sky.rows
            coordinates, contributions = self.coordinates[ground], self._contributions("measuring loads of blocks")
            bins = CellBins.of(coordinates, rectangles)
            filled = np.stack([bins.sums(weights[ground]) for weights in contributions])
            around = CellBins.of(coordinates, wide).sums()
            self._last = tree, CellLoads(names, rectangles, wide, belonging(filled, SHARE), bins.sums(), around, sky)
        return self._last[1]

    def bytes_needed(self, gaussians: float) -> int:
        """Bytes of device memory that the training of a block takes, if all of it is on the device at once.

        gaussians: number of the coarse model's Gaussians in the block's widened cell. They grow in number. The other
            Gaussians of the coarse model stay as they are, but take memory too.
        """
        density, frozen = self.config.density, len(self.model) - round(gaussians)
        most = max(round(gaussians / max(len(self.model), 1) * density.max_gaussians), 1)
        rows = frozen + (most if density.fills else min(max(round(ROWS_GROWTH * gaussians), 1), most))
        need = step_need(
            self.device,
            rows,
            (self.config.sh_degree + 1) ** 2,
            [view.camera for view in self.scene.train_views],
            self.config.rasterizer,
            StepMemory(SlotFields(contributions=density.min_contribution > 0), masks=True),
        )
        return need.total

    def _contributions(self, text: str) -> Iterator[Float32]:
        """Yield the contributions (N,) of all Gaussians to each photograph. text: stage of the work for `progress`."""
        found = contributions_by_camera(self.model, self.cameras, self.device, self.config.rasterizer)
        for done, contributions in enumerate(found, 1):
            self.progress(text, CountedFraction(done, len(self.cameras), "photographs"))
            yield contributions
