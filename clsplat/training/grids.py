# SPDX-License-Identifier: Apache-2.0
"""Bilateral grids of each photograph, learnt with the model: what a step applies, and what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.stages.grid import SHAPE, Grids, apply_grid, centre_grids, device_bytes, grid_gradient, step_grid
from clsplat.training.learnt import loaded, rate_at, saved

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

VARIATION = 10.0
"""Weight of a grid's variation beside the loss."""

ENDS = 0.01
"""Part of itself that the rate ends with."""


@dataclass(frozen=True, eq=False)
class ViewGrid:
    """The grid of one view in one step. visit: how often the view has been trained, with this step; ends: True if a
    pass through all views ends with it; place: the view's in a batch."""

    device: Device
    grids: Grids
    view: int
    visit: int
    rate: float
    ends: bool
    place: int = 0

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewGrid:
        """The same on another device, by `values`, to share colours and to find its gradient."""
        grids = upload(device, values)
        return replace(self, device=device, grids=Grids(grids, grids, grids), view=0)

    def values(self) -> NDArray[np.float32]:
        """The photograph's grid, as `on` takes it."""
        return self.grids.grids.get_rows(self.view, self.view + 1)

    def share_colours(
        self,
        work: Workspace,
        image: DeviceArray,
        target: DeviceArray,  # noqa: ARG002
        width: int,
        height: int,
    ) -> DeviceArray:
        """The image with the photograph's colours."""
        return apply_grid(self.device, work, self.grids, self.view, image, width, height)

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, width: int, height: int
    ) -> DeviceArray:
        """Make the gradient that by the image; that by the grid for `update`, which is tried here, before anything
        changes."""
        of_view, size = (self.grids, self.view, image, gradient), (width, height)
        by_grid = grid_gradient(self.device, work, *of_view, *size, VARIATION, self.place)
        if self.visit == 1:
            with only_tried(self.device):
                replace(self, ends=True).update(by_grid, by_grid)
        return by_grid

    def update(self, columns: DeviceArray, readback: DeviceArray) -> None:
        """Adam's step. After a pass the mean of all grids is made the identity: what they share is the model's."""
        step_grid(self.device, self.grids, self.view, columns, self.visit, self.rate, readback)
        if self.ends:
            centre_grids(self.device, self.grids, readback)


class GridsOfAll:
    """The grids of all training views."""

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        self._config, self._device, self._scene = config, device, scene
        self._count = len(scene.train_views)
        start = np.broadcast_to(np.eye(3, 4, dtype=np.float32), (self._count, *SHAPE))
        self._grids = Grids.on(device, np.ascontiguousarray(start))

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel on the device, with its share of the grids in the largest picture."""
        return device_bytes(self._count, [(view.camera.width, view.camera.height) for view in self._scene.views])

    def of_views(self, views: Sequence[int], step: int) -> list[ViewGrid]:
        """The grids of the views of a step, the last of which is number `step`. Each pass has all views once."""
        count = self._count
        numbers = range(step - len(views) + 1, step + 1)
        return [
            ViewGrid(
                self._device,
                self._grids,
                view,
                (number - 1) // count + 1,
                rate_at(self._config, number, count, ends=ENDS, hastens=False),
                number % count == 0,
                place,
            )
            for place, (view, number) in enumerate(zip(views, numbers, strict=True))
        ]

    def record(self) -> dict[str, Any]:
        """The content of appearance.json: the places of the photographs' grids in appearance.npz. Nothing is known of
        held-out photographs."""
        places = {view.name: {"grid": place} for place, view in enumerate(self._scene.train_views)}
        return {"kind": self._config.appearance, "photographs": places, "held_out": {}}

    def tables(self) -> dict[str, NDArray[Any]]:
        """Arrays of appearance.npz."""
        return {"grids": self._grids.grids.get()}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        held = {"grids": self._grids.grids, "first": self._grids.first, "second": self._grids.second}
        return saved(held)

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of a checkpoint. Raises ValueError where that is of other photographs."""
        values = loaded(self._device, arrays, ("grids", "first", "second"), self._grids.grids.shape)
        self._grids = Grids(**values)
