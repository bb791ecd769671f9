# SPDX-License-Identifier: Apache-2.0
"""The appearance of each photograph, learnt with the model: what a step applies, and what a checkpoint holds."""

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
from clsplat.images.colour import SRGB, photos_space
from clsplat.images.exif import exposure_of
from clsplat.stages.appearance import PIXEL_BYTES, Gains, apply_gains, gain_gradient, step_gains

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

CODED = 1 / 2.2
"""Octaves of a coded value for one of light, about: where gains begin that EXIF tells of photographs that are not
linear."""
WARM_UP, LEAST = 500, 0.01
"""Steps over which the rate rises, or a tenth of all; the part of itself that it begins and ends with."""
FULL = 10_000
"""Steps under which a training is short: with the rate of the settings a gain can come 4 octaves far in so many."""


def rate_at(config: TrainConfig, step: int, views: int) -> float:
    """The learning rate of step number `step`. A photograph has a gradient in one of `views` steps, by the
    root of which Adam makes its steps smaller. In a short training gains have to come as far."""
    rise: float = LEAST ** (1 - min(step / min(WARM_UP, config.iterations / 10), 1.0))
    fall: float = LEAST ** (step / config.iterations)
    short = max(FULL / config.iterations, 1.0)
    return float(config.appearance_rate * short * views**0.5 * rise * fall)


@dataclass(frozen=True, eq=False)
class ViewAppearance:
    """The appearance of one view in one step. place: the view's in a batch."""

    device: Device
    gains: Gains
    view: int
    step: int
    rate: float
    place: int = 0

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewAppearance:
        """The same on another device, by the values of `Gains.gains`, to apply and to find its gradient."""
        gains = upload(device, values)
        return replace(self, device=device, gains=Gains(gains, gains, gains, gains, gains))

    def apply(self, work: Workspace, image: DeviceArray) -> DeviceArray:
        """The image, exposed for the photograph."""
        return apply_gains(self.device, work, self.gains, self.view, image)

    def gradient(self, work: Workspace, seen: DeviceArray, gradient: DeviceArray, height: int) -> DeviceArray:
        """Make the gradient that by the image; sums for `update`, which is tried here, before anything changes."""
        columns = gain_gradient(self.device, work, self.gains, self.view, seen, gradient, height, self.place)
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


class Appearance:
    """The gains of all training views; nothing where the settings ask for none."""

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        self._config, self._device, self._scene = config, device, scene
        self._gains: Gains | None = None
        if config.appearance != "none":
            self._told = [exposure_of(view.path) for view in scene.train_views]
            curve = CODED if photos_space(view.path for view in scene.views) == SRGB else 1.0
            start = curve * np.nan_to_num(_from_mean(self._told, self._told))
            self._gains = Gains.on(device, np.repeat(start[:, None], 3, axis=1).astype(np.float32))

    @property
    def pixel_bytes(self) -> int:
        """Bytes of a pixel on the device."""
        return PIXEL_BYTES if self._gains is not None else 0

    def of_views(self, views: Sequence[int], step: int) -> list[ViewAppearance]:
        """The appearances of the views of a step, the last of which is number `step`; none where they are the
        model's."""
        device, gains = self._device, self._gains
        if gains is None:
            return []
        numbers, count = range(step - len(views) + 1, step + 1), gains.logs.shape[0]
        rates = [rate_at(self._config, number, count) for number in numbers]
        each = enumerate(zip(views, numbers, rates, strict=True))
        return [ViewAppearance(device, gains, *values, place) for place, values in each]

    def record(self) -> dict[str, Any] | None:
        """The content of appearance.json, by the names of the views; None where there is nothing to write.

        Nothing is learnt of held-out photographs. Where EXIF tells their exposure, they get the gains that go with it
        on average over the training's.
        """
        if self._gains is None:
            return None
        logs, scene = self._gains.logs.get().astype(np.float64), self._scene
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

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        gains = self._gains
        if gains is None:
            return {}
        held = {"logs": gains.logs, "first": gains.first, "second": gains.second, "gains": gains.gains}
        return {f"appearance/{name}": array.get() for name, array in held.items()}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the arrays of a checkpoint. Raises ValueError where that is of other photographs."""
        if self._gains is None:
            return
        shape, values = self._gains.logs.shape, {}
        for name in ("logs", "first", "second", "gains"):
            value = arrays.get(name)
            if value is None or value.shape != shape or value.dtype != np.float32 or not np.isfinite(value).all():
                raise ValueError(f"has no appearance/{name} of shape {shape}")
            values[name] = upload(self._device, value)
        self._gains = Gains(**values, moved=self._gains.moved)
