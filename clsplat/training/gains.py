# SPDX-License-Identifier: Apache-2.0
"""Gains of each photograph, learnt with the model: what a step applies, and what a checkpoint holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.images.colour import SRGB, photos_space
from clsplat.images.exif import exposure_of
from clsplat.scenes.looked import Looked
from clsplat.stages.appearance import PIXEL_BYTES, Gains, gain_gradient, remove_gains, rows_on, step_gains
from clsplat.training.learnt import loaded, rate_at, saved
from clsplat.training.neighbours import common

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

CODED = 1 / 2.2
"""Octaves of a coded value for one of light, about: where gains begin that EXIF tells of photographs that are not
linear, and points nothing."""

STEP = 2.0**-10
"""Octaves to which what points tell is rounded: processors add in other orders, and begin alike."""

PULL, COMMON = 0.02, 0.7
"""Parts of the distance, in octaves, from where points say that gains begin, in the loss's gradient: of each
photograph's, and of what it has in common with its neighbours. Neighbouring views may all be brighter by a little if
what they alone show is darker; there the points are better. Gains that points do not tell have neither, as it would
hold them at the mean."""

ENDS = 0.001
"""Part of itself that the rate ends with. Adam's steps are of the rate's size wherever a gain is: those that end with
ten times this are of 0.25 % for a photograph of 127."""

KEPT = ("logs", "start", "first", "second", "gains")
"""Arrays of `Gains` in a checkpoint, where `told` has 1 for photographs that points tell, else 0."""


@dataclass(frozen=True, eq=False)
class ViewGains:
    """The gains of one view in one step. place: the view's in a batch."""

    device: Device
    gains: Gains
    view: int
    step: int
    rate: float
    place: int = 0

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewGains:
        """The same on another device, by `values`, to share colours and to find its gradient."""
        gains = upload(device, values)
        return replace(self, device=device, gains=Gains(*[gains] * len(fields(Gains))), view=0)

    def values(self) -> NDArray[np.float32]:
        """The photograph's gains, as `on` takes them."""
        return self.gains.gains.get_rows(self.view, self.view + 1)

    def share_colours(
        self,
        work: Workspace,  # noqa: ARG002
        image: DeviceArray,
        target: DeviceArray,
        width: int,  # noqa: ARG002
        height: int,  # noqa: ARG002
    ) -> DeviceArray:
        """The image; the photograph is exposed as the model is."""
        remove_gains(self.device, self.gains, self.view, target)
        return image

    def gradient(
        self,
        work: Workspace,
        image: DeviceArray,
        gradient: DeviceArray,
        width: int,  # noqa: ARG002
        height: int,
    ) -> DeviceArray:
        """Sums for `update`, which is tried here, before anything changes."""
        columns = gain_gradient(self.device, work, image, gradient, height, self.place)
        if self.step == 1:
            with only_tried(self.device):
                self.update(columns, columns)
        return columns

    def update(self, columns: DeviceArray, readback: DeviceArray) -> None:
        """Adam's step."""
        step_gains(self.device, self.gains, self.view, columns, self.step, self.rate, readback)


def _from_mean(told: Sequence[float | None], of: Sequence[float | None]) -> NDArray[np.float64]:
    """Exposures from the mean of those that are told `of` photographs, NaN where none is."""
    known = [value for value in of if value is not None]
    return np.array([np.nan if value is None or not known else value - np.mean(known) for value in told], np.float64)


def _rows(names: Sequence[str], logs: NDArray[np.float64]) -> dict[str, Any]:
    return {name: {"log2_gains": row} for name, row in zip(names, logs.tolist(), strict=True)}


class GainsOfAll:
    """The gains of all training views."""

    entries = 3

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        self._config, self._device, self._scene = config, device, scene
        self._told = [exposure_of(view.path) for view in scene.train_views]

    @cached_property
    def _gains(self) -> Gains:
        """Where training begins, unless a checkpoint has been loaded: glances at the photographs take their time."""
        scene = self._scene
        curve = CODED if photos_space(view.path for view in scene.views) == SRGB else 1.0
        by_exif = curve * np.nan_to_num(_from_mean(self._told, self._told))
        by_points = {name: np.round(told / STEP) * STEP for name, told in Looked(scene).exposures.items()}
        views = zip(scene.train_views, by_exif, strict=True)
        start = np.zeros((len(scene.train_views), self.entries))
        start[:, :3] = [by_points.get(view.name, np.full(3, told)) for view, told in views]
        self._by_points = np.array([view.name in by_points for view in scene.train_views])
        return Gains.on(self._device, (start - start.mean(axis=0)).astype(np.float32), self._pull)

    @property
    def _pull(self) -> csr_array:
        told, cameras = self._by_points, [view.camera for view in self._scene.train_views]
        return csr_array(PULL * diags_array(told.astype(np.float64)) + COMMON * common(cameras, told))

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel on the device."""
        return PIXEL_BYTES

    def of_views(self, views: Sequence[int], step: int) -> list[ViewGains]:
        """The gains of the views of a step, the last of which is number `step`."""
        device, gains = self._device, self._gains
        numbers, count = range(step - len(views) + 1, step + 1), gains.logs.shape[0]
        rates = [rate_at(self._config, number, count, ends=ENDS) for number in numbers]
        each = enumerate(zip(views, numbers, rates, strict=True))
        return [ViewGains(device, gains, *values, place) for place, values in each]

    def record(self) -> dict[str, Any]:
        """The content of appearance.json, by the names of the views.

        Nothing is learnt of held-out photographs. Where EXIF tells their exposure, they get the gains that go with it
        on average over the training's.
        """
        logs, scene = self._gains.logs.get()[:, :3].astype(np.float64), self._scene
        told = _from_mean(self._told, self._told)
        known = ~np.isnan(told)
        spread = np.square(told[known]).sum()
        slopes = told[known] @ logs[known] / spread if spread > 0 else np.zeros(3)
        held_out = _from_mean([exposure_of(view.path) for view in scene.test_views], self._told)
        expected = np.nan_to_num(held_out)[:, None] * slopes
        return {
            "kind": self._config.appearance,
            "photographs": _rows([view.name for view in scene.train_views], logs),
            "held_out": _rows([view.name for view in scene.test_views], expected),
        }

    def tables(self) -> dict[str, NDArray[Any]]:
        """Arrays of appearance.npz: none."""
        return {}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        held = saved({name: getattr(self._gains, name) for name in KEPT})
        told = np.repeat(self._by_points[:, None], self.entries, axis=1)
        return {**held, "appearance/told": told.astype(np.float32)}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of a checkpoint. Raises ValueError where one is missing, or of other photographs."""
        shape = (len(self._scene.train_views), self.entries)
        values = loaded(self._device, arrays, (*KEPT, "told"), shape)
        self._by_points = values.pop("told").get()[:, 0] > 0
        moved = allocate(self._device, shape, np.float32)
        self._gains = Gains(**values, moved=moved, **rows_on(self._device, shape[0], self._pull))
