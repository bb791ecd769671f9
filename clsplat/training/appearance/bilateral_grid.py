# SPDX-License-Identifier: Apache-2.0
"""Bilateral grids, one for each training photograph, learnt with the model: gradient, Adam's step, and checkpoints.

The size of a grid: `stages/grid.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.layouts.columns import GRID_SHAPE
from clsplat.runs.appearance import grids_of
from clsplat.stages.grid import Grids, apply_grid, centre_grids, device_bytes, grid_gradient, step_grid
from clsplat.training.appearance.base import Appearance
from clsplat.training.appearance.schedule import loaded, rate_at, saved
from clsplat.training.step.inputs import ViewPart

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

VARIATION_WEIGHT = 10.0
"""Weight of a grid's total variation in the loss."""

GRID_RATE_END_FRACTION = 0.01
"""Fraction of the grids' learning rate that is left at the last step."""


@dataclass(frozen=True, eq=False)
class ViewGrid(ViewPart):
    """Bilateral grid of one view's photograph, as a part of one training step.

    grids, view: the grids of all photographs with their moments, and the row of this view's grid.
    visit: number of steps that have shown this view, including this step.
    rate: learning rate of the grid in this step.
    ends: True if a pass through all training views, or the training, ends with this view.
    place: the view's position in the batch.
    """

    device: Device
    grids: Grids
    view: int
    visit: int
    rate: float
    ends: bool
    place: int = 0

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewGrid:
        """Return this part with its grid on another device, to apply the grid there and to compute its gradient.

        values: the grid on the host, as the method `values` returns it.
        """
        grids = upload(device, values)
        return replace(self, device=device, grids=Grids(grids, grids, grids, grids), view=0)

    def values(self) -> NDArray[np.float32]:
        """Return the photograph's grid on the host, for `on` to upload to another device."""
        return self.grids.grids.get_rows(self.view, self.view + 1)

    def compare(self, work: Workspace, image: DeviceArray, target: DeviceArray, size: tuple[int, int]) -> DeviceArray:  # noqa: ARG002
        """Return the render `image`, of width and height `size`, with the colour changes of the photograph's grid. The
        photograph `target` is not changed."""
        return apply_grid(self.device, work, self.grids, self.view, image, size)

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, size: tuple[int, int]
    ) -> DeviceArray:
        """Return the loss's gradient with respect to the grid.

        image: the render before `compare`. size: its width and height.
        gradient: the loss's gradient with respect to the result of `compare`. It is replaced, in place, by the gradient
            with respect to `image`.
        At the grid's first step, the sandbox also tries the kernels of `update` here, before anything changes.
        """
        of_view = (self.grids, self.view, image, gradient)
        by_grid = grid_gradient(self.device, work, *of_view, size, VARIATION_WEIGHT, self.place)
        if self.visit == 1:
            with only_tried(self.device):
                replace(self, ends=True).update(by_grid, by_grid)
        return by_grid

    def update(self, own: DeviceArray | None, readback: DeviceArray) -> None:
        """Take Adam's step for the grid. After a pass through all views, also shift all grids so that their mean stays
        that of the initial ones: a colour change that all photographs share belongs to the model.

        own: gradient with respect to the grid, as the method `gradient` returned it. None causes no step.
        readback: counts of the step's pass on the device. If they say that the pass has stopped, nothing changes.
        """
        if own is None:
            return
        step_grid(self.device, self.grids, self.view, own, self.visit, self.rate, readback)
        if self.ends:
            centre_grids(self.device, self.grids, readback)


class GridsOfAll(Appearance):
    """Appearance model that learns a bilateral grid for each training photograph."""

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        self._config, self._device, self._scene = config, device, scene
        self._count = len(scene.train_views)
        start = np.broadcast_to(np.eye(3, 4, dtype=np.float32), (self._count, *GRID_SHAPE))
        self._grids = Grids.on(device, np.ascontiguousarray(start))

    def begin_from(self, folder: Path, *, keeps_lenses: bool) -> None:
        """Begin with the grids that the files in `folder` have for the photographs of the same names. Their mean stays.

        keeps_lenses: not used, as lenses have no grids.
        Raises InputError if the files do not have grids of this size for all training photographs.
        """
        del keeps_lenses
        names = [view.name for view in self._scene.train_views]
        self._grids = Grids.on(self._device, grids_of(folder, names))

    @property
    def pixel_bytes(self) -> int:
        """Bytes on the device per pixel of the largest picture, for the transformed image and arrays of all grids."""
        return device_bytes(self._count, [(view.camera.width, view.camera.height) for view in self._scene.views])

    def of_views(self, views: Sequence[int], step: int) -> list[ViewGrid]:
        """Return, for each view of a step, the part that learns and applies the view's grid.

        Each pass shows every view once, so the number of a step gives the number of visits to its view.

        views: indices of the step's views among the training views.
        step: number of views that training has used, including the views of this step.
        """
        count = self._count
        numbers = range(step - len(views) + 1, step + 1)
        return [
            ViewGrid(
                self._device,
                self._grids,
                view,
                (number - 1) // count + 1,
                rate_at(self._config, number, count, ends=GRID_RATE_END_FRACTION, hastens=False),
                number % count == 0 or number == self._config.iterations,
                place,
            )
            for place, (view, number) in enumerate(zip(views, numbers, strict=True))
        ]

    def record(self) -> dict[str, Any]:
        """Return the content of appearance.json: for each training photograph, the index of its grid in appearance.npz.
        Held-out photographs have no grid."""
        places = {view.name: {"grid": place} for place, view in enumerate(self._scene.train_views)}
        return {"kind": self._config.appearance, "photographs": places, "held_out": {}}

    def tables(self) -> dict[str, NDArray[Any]]:
        """Arrays of appearance.npz, by name: the grids of all training photographs."""
        return {"grids": self._grids.grids.get()}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Grids and Adam's moments, keyed by their names in a checkpoint."""
        held = {"grids": self._grids.grids, "first": self._grids.first, "second": self._grids.second}
        return saved(held)

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load grids and moments from a checkpoint's arrays, by name without "appearance/". Raises ValueError for other
        photographs."""
        values = loaded(self._device, arrays, ("grids", "first", "second"), self._grids.grids.shape)
        self._grids = replace(self._grids, **values)
