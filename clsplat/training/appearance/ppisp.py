# SPDX-License-Identifier: Apache-2.0
"""Gains and colour mixes of each photograph and a vignette of each lens, learnt with the model."""

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
from clsplat.stages.appearance import GainEntries, Gains, rows_on, step_gains
from clsplat.stages.ppisp import (
    COLOUR_ENTRIES,
    PPISP_PIXEL_BYTES,
    VIGNETTE_ENTRIES,
    VIGNETTE_GAINS,
    PhotoLens,
    camera_gradient,
    develop,
)
from clsplat.training.appearance.exposure import GAIN_RATE_END_FRACTION, GainsOfAll
from clsplat.training.appearance.schedule import loaded, rate_at, saved
from clsplat.training.step.inputs import ViewPart

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene, View

MIX_RATE_FRACTION = 0.3
"""Learning rate of mixes, as a fraction of the gains' rate. At the full rate they absorb colours of the scene."""
_COLOUR_GAINS = GainEntries(mix_rate=MIX_RATE_FRACTION)

VIGNETTE_CHECKPOINT_ARRAYS = ("logs", "first", "second")
"""Arrays of the vignettes' `Gains` in a checkpoint."""


@dataclass(frozen=True, eq=False)
class ViewColours(ViewPart):
    """Gains, mixes and vignette of one view in one step.

    place: the view's place in a batch.
    """

    device: Device
    colours: Gains
    vignettes: Gains
    taken: PhotoLens
    step: int
    rate: float
    lens_rate: float
    place: int = 0

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewColours:
        """The same colours on another device, made from `values`, to apply them and to compute their gradient."""
        parts = (np.ascontiguousarray(part) for part in np.split(values, [COLOUR_ENTRIES], axis=1))
        colours, vignettes = (Gains(*[upload(device, part)] * len(fields(Gains))) for part in parts)
        taken = replace(self.taken, photograph=0, lens=0)
        return replace(self, device=device, colours=colours, vignettes=vignettes, taken=taken)

    def values(self) -> NDArray[np.float32]:
        """The photograph's gains, mixes and vignette, in the form that `on` takes."""
        row, lens = self.taken.photograph, self.taken.lens
        gains, logs = (array.get_rows(row, row + 1) for array in (self.colours.gains, self.colours.logs))
        return np.concatenate([gains[:, :3], logs[:, 3:], self.vignettes.logs.get_rows(lens, lens + 1)], axis=1)

    def compare(self, work: Workspace, image: DeviceArray, target: DeviceArray, size: tuple[int, int]) -> DeviceArray:  # noqa: ARG002
        """Remove gains, mixes and vignette from the photograph in `target`. Returns the unchanged image."""
        develop(self.device, self.colours, self.vignettes, self.taken, target, *size)
        return image

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, size: tuple[int, int]
    ) -> DeviceArray:
        """Sums that `update` needs. The kernels of `update` are tried here in the sandbox, before anything changes."""
        columns = camera_gradient(self.device, work, self.taken, image, gradient, *size, self.place)
        if self.step == 1:
            with only_tried(self.device):
                self.update(columns, columns)
        return columns

    def update(self, own: DeviceArray | None, readback: DeviceArray) -> None:
        """Take Adam's step for the entries of the photograph and of its lens."""
        assert own is not None, "made by `gradient`"
        row, lens, step = self.taken.photograph, self.taken.lens, self.step
        step_gains(self.device, self.colours, row, own, step, self.rate, readback, _COLOUR_GAINS)
        step_gains(self.device, self.vignettes, lens, own, step, self.lens_rate, readback, VIGNETTE_GAINS)


def centre(view: View) -> tuple[float, float]:
    """Principal point, as fractions of the picture's width and height."""
    camera = view.camera
    return camera.cx / camera.width, camera.cy / camera.height


def panorama(view: View) -> bool:
    """True for panoramas, which have no vignette."""
    return view.camera.model.wraps


class PpispOfAll(GainsOfAll):
    """Gains and mixes of all training views, and vignettes of their lenses. Views of one lens share its vignette.

    Gains start and are pulled as in `GainsOfAll`; mixes are pulled to 0 in the same way.
    """

    entries = COLOUR_ENTRIES

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        super().__init__(config, device, scene)
        lenses = {lens: row for row, lens in enumerate(dict.fromkeys(view.lens for view in scene.train_views))}
        self._lenses = lenses
        self._taken = [
            PhotoLens(row, lenses[view.lens], centre(view), not panorama(view))
            for row, view in enumerate(scene.train_views)
        ]
        self._vignettes = Gains.on(device, np.zeros((len(lenses), VIGNETTE_ENTRIES), np.float32))

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel on the device."""
        return PPISP_PIXEL_BYTES

    def of_views(self, views: Sequence[int], step: int) -> list[ViewColours]:  # type: ignore[override]
        """Colours of the views of a step.

        step: number of the last view.
        """
        numbers = range(step - len(views) + 1, step + 1)
        return [
            ViewColours(
                self._device,
                self._gains,
                self._vignettes,
                self._taken[view],
                number,
                rate_at(self._config, number, len(self._taken), ends=GAIN_RATE_END_FRACTION),
                rate_at(self._config, number, len(self._lenses), ends=GAIN_RATE_END_FRACTION),
                place,
            )
            for place, (view, number) in enumerate(zip(views, numbers, strict=True))
        ]

    def record(self) -> dict[str, Any]:
        """Content of appearance.json, by the names of the views.

        Held-out photographs have the vignette of their lens, or the mean of all vignettes if no training photograph has
        their lens. Centres are fractions of the picture's size.
        """
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
        held = saved({f"lenses_{name}": getattr(self._vignettes, name) for name in VIGNETTE_CHECKPOINT_ARRAYS})
        return super().arrays() | held

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the arrays of a checkpoint. Raises ValueError if one is missing, or belongs to other photographs."""
        shape = (len(self._lenses), VIGNETTE_ENTRIES)
        held = loaded(self._device, arrays, [f"lenses_{name}" for name in VIGNETTE_CHECKPOINT_ARRAYS], shape)
        super().take(arrays)
        logs, first, second = held.values()
        spare = [allocate(self._device, shape, np.float32) for _ in range(2)]
        start = upload(self._device, np.zeros(shape, np.float32))
        self._vignettes = Gains(logs, start, first, second, *spare, **rows_on(self._device, shape[0], None))
