# SPDX-License-Identifier: Apache-2.0
"""Gains of each photograph, learnt with the model: use in a step, and storage in a checkpoint."""

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
from clsplat.scenes.analysis.visible_points import VisiblePoints
from clsplat.stages.appearance import GAINS_PIXEL_BYTES, Gains, gain_gradient, remove_gains, rows_on, step_gains
from clsplat.training.appearance.base import Appearance
from clsplat.training.appearance.schedule import loaded, rate_at, saved
from clsplat.training.appearance.view_neighbours import common
from clsplat.training.step.inputs import ViewPart

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

CODED_OCTAVES_PER_LIGHT_OCTAVE = 1 / 2.2
"""Octaves by which a stored colour value changes per octave of light, approximately.

Initial gains come from the colours of points. If points give none, they come from EXIF exposures in octaves, multiplied
by this number.
"""

START_GAIN_STEP_OCTAVES = 2.0**-10
"""Gains from points are rounded to multiples of this, in octaves, so that they do not depend on the order of sums."""

VIEW_PULL_WEIGHT, NEIGHBOUR_PULL_WEIGHT = 0.02, 0.7
"""Weights of two terms of the loss's gradient that pull gains towards the gains from points, per octave of distance.

The first pulls the gains of each photograph. The second pulls the part that gains of neighbouring photographs have in
common. Without it neighbours may all become slightly too bright, where no other photograph shows a dark surface. Gains
without points are not pulled, because the pull would hold them at the mean.
"""

GAIN_RATE_END_FRACTION = 0.001
"""Fraction of the learning rate that is left at the last step.

Adam's steps are as large as the rate even at the optimum. With ten times this fraction and 127 photographs, the last
steps change a photograph's gain by 0.25 %.
"""

GAIN_CHECKPOINT_ARRAYS = ("logs", "start", "first", "second", "gains")
"""Arrays of `Gains` in a checkpoint. A further array, `told`, is 1 for photographs with gains from points, else 0."""


@dataclass(frozen=True, eq=False)
class ViewGains(ViewPart):
    """Gains of one view in one step.

    place: the view's place in a batch.
    """

    device: Device
    gains: Gains
    view: int
    step: int
    rate: float
    place: int = 0
    changes_target = True

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewGains:
        """The same gains on another device, made from `values`, to apply them and to compute their gradient."""
        gains = upload(device, values)
        return replace(self, device=device, gains=Gains(*[gains] * len(fields(Gains))), view=0)

    def values(self) -> NDArray[np.float32]:
        """The photograph's gains, in the form that `on` takes."""
        return self.gains.gains.get_rows(self.view, self.view + 1)

    def compare(self, work: Workspace, image: DeviceArray, target: DeviceArray, size: tuple[int, int]) -> DeviceArray:  # noqa: ARG002
        """Divide the photograph in `target` by its gains. Returns the unchanged image."""
        remove_gains(self.device, self.gains, self.view, target)
        return image

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, size: tuple[int, int]
    ) -> DeviceArray:
        """Sums that `update` needs. The kernels of `update` are tried here in the sandbox, before anything changes."""
        columns = gain_gradient(self.device, work, image, gradient, size[1], self.place)
        if self.step == 1:
            with only_tried(self.device):
                self.update(columns, columns)
        return columns

    def update(self, own: DeviceArray | None, readback: DeviceArray) -> None:
        """Take Adam's step."""
        assert own is not None, "made by `gradient`"
        step_gains(self.device, self.gains, self.view, own, self.step, self.rate, readback)


def _from_mean(told: Sequence[float | None], of: Sequence[float | None]) -> NDArray[np.float64]:
    """Exposures from EXIF (`told`), relative to the mean of the known exposures in `of`; NaN where unknown."""
    known = [value for value in of if value is not None]
    return np.array([np.nan if value is None or not known else value - np.mean(known) for value in told], np.float64)


def _rows(names: Sequence[str], logs: NDArray[np.float64]) -> dict[str, Any]:
    return {name: {"log2_gains": row} for name, row in zip(names, logs.tolist(), strict=True)}


class GainsOfAll(Appearance):
    """Gains of all training views."""

    entries = 3

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        self._config, self._device, self._scene = config, device, scene
        self._told = [exposure_of(view.path) for view in scene.train_views]

    @cached_property
    def _gains(self) -> Gains:
        """Initial gains, unless a checkpoint has been loaded. Computed on first use, because sampling the photographs
        takes time."""
        scene = self._scene
        curve = CODED_OCTAVES_PER_LIGHT_OCTAVE if photos_space(view.path for view in scene.views) == SRGB else 1.0
        by_exif = curve * np.nan_to_num(_from_mean(self._told, self._told))
        by_points = {
            name: np.round(told / START_GAIN_STEP_OCTAVES) * START_GAIN_STEP_OCTAVES
            for name, told in VisiblePoints(scene).exposures.items()
        }
        views = zip(scene.train_views, by_exif, strict=True)
        start = np.zeros((len(scene.train_views), self.entries))
        start[:, :3] = [by_points.get(view.name, np.full(3, told)) for view, told in views]
        self._by_points = np.array([view.name in by_points for view in scene.train_views])
        return Gains.on(self._device, (start - start.mean(axis=0)).astype(np.float32), self._pull)

    @property
    def _pull(self) -> csr_array:
        told, cameras = self._by_points, [view.camera for view in self._scene.train_views]
        return csr_array(
            VIEW_PULL_WEIGHT * diags_array(told.astype(np.float64)) + NEIGHBOUR_PULL_WEIGHT * common(cameras, told)
        )

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel on the device."""
        return GAINS_PIXEL_BYTES

    def of_views(self, views: Sequence[int], step: int) -> list[ViewGains]:
        """Gains of the views of a step.

        step: number of the last view.
        """
        device, gains = self._device, self._gains
        numbers, count = range(step - len(views) + 1, step + 1), gains.logs.shape[0]
        rates = [rate_at(self._config, number, count, ends=GAIN_RATE_END_FRACTION) for number in numbers]
        each = enumerate(zip(views, numbers, rates, strict=True))
        return [ViewGains(device, gains, *values, place) for place, values in each]

    def record(self) -> dict[str, Any]:
        """Content of appearance.json, by the names of the views.

        Nothing is learnt about held-out photographs. If EXIF has their exposure, their gains follow from a linear fit
        of the training photographs' gains to their exposures.
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
        held = saved({name: getattr(self._gains, name) for name in GAIN_CHECKPOINT_ARRAYS})
        told = np.repeat(self._by_points[:, None], self.entries, axis=1)
        return {**held, "appearance/told": told.astype(np.float32)}

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the arrays of a checkpoint. Raises ValueError if one is missing, or belongs to other photographs."""
        shape = (len(self._scene.train_views), self.entries)
        values = loaded(self._device, arrays, (*GAIN_CHECKPOINT_ARRAYS, "told"), shape)
        self._by_points = values.pop("told").get()[:, 0] > 0
        moved = allocate(self._device, shape, np.float32)
        self._gains = Gains(**values, moved=moved, **rows_on(self._device, shape[0], self._pull))
