# SPDX-License-Identifier: Apache-2.0
"""Measurement of the places that photographs show, and of the cells' loads, by rendering the coarse model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from clsplat.arrays import Bool, Float32, Float64
from clsplat.blocks.plan import MARGIN, SHARE, Rectangle
from clsplat.blocks.planning.ground import Ground, on_ground
from clsplat.blocks.planning.loads import CellBins, belonging, places_seen
from clsplat.blocks.planning.split import Tree, bounds_of, cells, widened
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


@dataclass(frozen=True, eq=False)
class CellLoads:
    """Loads of the cells of a tree.

    names, cells: of each cell.
    widened: each cell with its margin.
    belongs: (P, B), True if a photograph belongs to a cell.
    inside, around: (B,), numbers of the coarse model's Gaussians in each cell, and in each widened cell.
    """

    names: tuple[str, ...]
    cells: tuple[Rectangle, ...]
    widened: tuple[Rectangle, ...]
    belongs: Bool
    inside: Float64
    around: Float64


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
    def places(self) -> Float64:
        """Place (P, 2) that each photograph shows; the camera's place for a photograph that shows no Gaussian."""
        contributions = self._contributions("finding what photographs show")
        return places_seen(self.coordinates, contributions, self.camera_places)

    def of(self, tree: Tree) -> CellLoads:
        """Measure the loads of the cells of a tree. The loads of the last tree are remembered."""
        if self._last is None or self._last[0] != tree:
            names, rectangles = zip(*cells(tree), strict=True)
            bounds = bounds_of(self.places)
            wide = tuple(widened(cell, bounds, MARGIN) for cell in rectangles)
            bins = CellBins.of(self.coordinates, rectangles)
            filled = np.stack([bins.sums(weights) for weights in self._contributions("measuring loads of blocks")])
            around = CellBins.of(self.coordinates, wide).sums()
            self._last = tree, CellLoads(names, rectangles, wide, belonging(filled, SHARE), bins.sums(), around)
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
            StepMemory(SlotFields(contributions=density.min_contribution > 0)),
        )
        return need.total

    def _contributions(self, text: str) -> Iterator[Float32]:
        """Yield the contributions (N,) of all Gaussians to each photograph. text: stage of the work for `progress`."""
        found = contributions_by_camera(self.model, self.cameras, self.device, self.config.rasterizer)
        for done, contributions in enumerate(found, 1):
            self.progress(text, CountedFraction(done, len(self.cameras), "photographs"))
            yield contributions
