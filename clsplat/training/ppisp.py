# SPDX-License-Identifier: Apache-2.0
"""Gains and mixes of colours of each photograph and a vignette of each lens, learnt with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.stages.appearance import Gains, rows_on, step_gains
from clsplat.stages.ppisp import COLOURS, PIXEL_BYTES, VIGNETTE, Taken, camera_gradient, develop
from clsplat.training.gains import ENDS, GainsOfAll
from clsplat.training.learnt import loaded, rate_at, saved

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene, View

MIXES = 0.3
"""Part of the rate of gains that mixes have: with all of it they take what is the scene's."""

OF_LENSES = ("logs", "first", "second")
"""Arrays of the vignettes' `Gains` in a checkpoint."""


@dataclass(frozen=True, eq=False)
class ViewColours:
    """Gains, mixes and vignette of one view in one step. place: the view's in a batch."""

    device: Device
    colours: Gains
    vignettes: Gains
    taken: Taken
    step: int
    rate: float
    lens_rate: float
    place: int = 0

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewColours:
        """The same on another device, by `values`, to share colours and to find its gradient."""
        parts = (np.ascontiguousarray(part) for part in np.split(values, [COLOURS], axis=1))
        colours, vignettes = (Gains(*[upload(device, part)] * len(fields(Gains))) for part in parts)
        taken = replace(self.taken, photograph=0, lens=0)
        return replace(self, device=device, colours=colours, vignettes=vignettes, taken=taken)

    def values(self) -> NDArray[np.float32]:
        """The photograph's gains, mixes and vignette, as `on` takes them."""
        row, lens = self.taken.photograph, self.taken.lens
        gains, logs = (array.get_rows(row, row + 1) for array in (self.colours.gains, self.colours.logs))
        return np.concatenate([gains[:, :3], logs[:, 3:], self.vignettes.logs.get_rows(lens, lens + 1)], axis=1)

    def share_colours(
        self,
        work: Workspace,  # noqa: ARG002
        image: DeviceArray,
        target: DeviceArray,
        width: int,
        height: int,
    ) -> DeviceArray:
        """The image; the photograph is developed as the model is seen."""
        develop(self.device, self.colours, self.vignettes, self.taken, target, width, height)
        return image

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, width: int, height: int
    ) -> DeviceArray:
        """Sums for `update`, which is tried here, before anything changes."""
        columns = camera_gradient(self.device, work, self.taken, image, gradient, width, height, self.place)
        if self.step == 1:
            with only_tried(self.device):
                self.update(columns, columns)
        return columns

    def update(self, columns: DeviceArray, readback: DeviceArray) -> None:
        """Adam's step of the photograph's entries and of its lens's."""
        photograph, lens = self.taken.photograph, self.taken.lens
        of_step = (columns, self.step)
        step_gains(self.device, self.colours, photograph, *of_step, self.rate, readback, slow=MIXES)
        of_lens: dict[str, Any] = {"at": COLOURS, "centred": False}
        step_gains(self.device, self.vignettes, lens, *of_step, self.lens_rate, readback, **of_lens)


def centre(view: View) -> tuple[float, float]:
    """The principal point, in parts of the picture's width and height."""
    camera = view.camera
    return camera.cx / camera.width, camera.cy / camera.height


def panorama(view: View) -> bool:
    """True for pictures that have no lens's corners."""
    return view.camera.projection == "equirectangular"


class PpispOfAll(GainsOfAll):
    """Gains and mixes of all training views, and vignettes of their lenses. Views through one lens share its vignette.

    Gains begin, and are pulled, as those of `GainsOfAll` do; mixes are pulled to 0 as they are.
    """

    entries = COLOURS

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        super().__init__(config, device, scene)
        lenses = {lens: row for row, lens in enumerate(dict.fromkeys(view.lens for view in scene.train_views))}
        self._lenses = lenses
        self._taken = [
            Taken(row, lenses[view.lens], centre(view), not panorama(view))
            for row, view in enumerate(scene.train_views)
        ]
        self._vignettes = Gains.on(device, np.zeros((len(lenses), VIGNETTE), np.float32))

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel on the device."""
        return PIXEL_BYTES

    def of_views(self, views: Sequence[int], step: int) -> list[ViewColours]:  # type: ignore[override]
        """Those of the views of a step, the last of which is number `step`."""
        numbers = range(step - len(views) + 1, step + 1)
        return [
            ViewColours(
                self._device,
                self._gains,
                self._vignettes,
                self._taken[view],
                number,
                rate_at(self._config, number, len(self._taken), ends=ENDS),
                rate_at(self._config, number, len(self._lenses), ends=ENDS),
                place,
            )
            for place, (view, number) in enumerate(zip(views, numbers, strict=True))
        ]

    def record(self) -> dict[str, Any]:
        """The content of appearance.json, by the names of the views. Held-out photographs have the vignette of their
        lens, or if no training photograph has it the mean of all lenses; centres are parts of the picture."""
        record, colours = super().record(), self._gains.logs.get().astype(np.float64)
        vignettes = self._vignettes.logs.get().astype(np.float64)
        usual = vignettes.mean(axis=0)
        for view, taken in zip(self._scene.train_views, self._taken, strict=True):
            record["photographs"][view.name] |= {
                "mixes": colours[taken.photograph, 3:].tolist(),
                "vignette": vignettes[taken.lens].tolist(),
                "centre": list(taken.centre),
            }
        for view in self._scene.test_views:
            lens = self._lenses.get(view.lens)
            vignette = np.zeros(3) if panorama(view) else usual if lens is None else vignettes[lens]
            record["held_out"][view.name] |= {"vignette": vignette.tolist(), "centre": list(centre(view))}
        return record

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        held = saved({f"lenses_{name}": getattr(self._vignettes, name) for name in OF_LENSES})
        return super().arrays() | held

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of a checkpoint. Raises ValueError where one is missing, or of other photographs."""
        shape = (len(self._lenses), VIGNETTE)
        held = loaded(self._device, arrays, [f"lenses_{name}" for name in OF_LENSES], shape)
        super().load(arrays)
        logs, first, second = held.values()
        spare = [allocate(self._device, shape, np.float32) for _ in range(2)]
        start = upload(self._device, np.zeros(shape, np.float32))
        self._vignettes = Gains(logs, start, first, second, *spare, **rows_on(self._device, shape[0], None))
