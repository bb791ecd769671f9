# SPDX-License-Identifier: Apache-2.0
"""Colour models (`exposure`, `ppisp`): gains and other entries of each photograph and lens, learnt with the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.colour_models import COLOUR_MODELS, GAIN_ENTRIES, ColourModel
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.images.colour import SRGB, photos_space
from clsplat.images.exif import exposure_of
from clsplat.runs.appearance import entries_of
from clsplat.scenes.analysis.visible_points import VisiblePoints
from clsplat.stages.appearance import (
    GainEntries,
    Gains,
    PhotoLens,
    develop,
    entry_gradient,
    rows_on,
    scratch_on,
    step_gains,
)
from clsplat.training.appearance.base import Appearance
from clsplat.training.appearance.schedule import loaded, rate_at, saved
from clsplat.training.appearance.view_neighbours import common
from clsplat.training.step.inputs import ViewPart

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from clsplat.scenes.scene import Scene, View

CODED_OCTAVES_PER_LIGHT_OCTAVE = 1 / 2.2
"""Octaves by which a stored colour value changes per octave of light, approximately.

Initial gains come from the colours of points. If points give none, they come from EXIF exposures in octaves, multiplied
by this number.
"""

START_GAIN_STEP_OCTAVES = 2.0**-10
"""Step, in octaves, to which initial gains from points are rounded, so that the order of summation does not change
them."""

VIEW_PULL_WEIGHT, NEIGHBOUR_PULL_WEIGHT = 0.02, 0.7
"""Weights of two terms that are added to the loss's gradient, per octave of distance. They pull the gains towards their
initial values, which are computed from the colours of the scene's points.

The first pulls the gains of each photograph. The second pulls the part that gains of neighbouring photographs have in
common. Without the second, a group of neighbouring photographs can drift too bright together, if no photograph outside
the group shows the same dark surface. A photograph whose initial gains do not come from points is not pulled, because
that would hold its gains at the mean.
"""

GAIN_RATE_END_FRACTION = 0.001
"""Fraction of the learning rate that is left at the last step.

Adam's steps are as large as the rate even at the optimum. With ten times this fraction and 127 photographs, the last
steps change a photograph's gain by 0.25 %.
"""

GAIN_CHECKPOINT_ARRAYS = ("logs", "start", "first", "second", "gains")
"""Fields of the photographs' `Gains` in a checkpoint. The checkpoint also has `told`: 1 for photographs with gains from
points, else 0."""
LENS_CHECKPOINT_ARRAYS = ("logs", "first", "second")
"""Fields of the lenses' `Gains` in a checkpoint."""

MIX_RATE_FRACTION = 0.3
"""Learning rate of the mixes of colour channels, as a fraction of the gains' rate. At the full rate, mixes absorb
colours that belong to the scene."""
_COLOUR_UPDATE = GainEntries(mix_rate=MIX_RATE_FRACTION)


@dataclass(frozen=True, eq=False)
class ViewColours(ViewPart):
    """The colour model's part in one view of a training step: which photograph's and lens's entries it reads and
    updates, and at which learning rates.

    colours, lenses: entries of all photographs, and of all lenses; `lenses` is None if lenses have no entries in the
        colour model.
    taken: the photograph's row in `colours`, and its lens's row in `lenses`.
    rate, lens_rate: learning rates of the photograph's entries, and of the lens's entries.
    place: the view's position in the batch.
    """

    device: Device
    model: ColourModel
    colours: Gains
    lenses: Gains | None
    taken: PhotoLens
    step: int
    rate: float
    lens_rate: float
    place: int = 0
    changes_target = True

    def on(self, device: Device, values: NDArray[np.float32]) -> ViewColours:
        """Return this part with its entries on another device, to apply them there and to compute their gradient.

        values: the entries on the host, as the method `values` returns them.
        """
        parts = (np.ascontiguousarray(part) for part in np.split(values, [self.model.entries], axis=1))
        colours, lenses = (Gains(*[upload(device, part)] * len(fields(Gains))) if part.size else None for part in parts)
        assert colours is not None, "each model has gains"
        taken = replace(self.taken, photograph=0, lens=0)
        return replace(self, device=device, colours=colours, lenses=lenses, taken=taken)

    def values(self) -> NDArray[np.float32]:
        """Return the entries of the photograph and its lens (1, entries) on the host, for `on`. Gains are factors."""
        row, lens = self.taken.photograph, self.taken.lens
        gains, logs = (array.get_rows(row, row + 1) for array in (self.colours.gains, self.colours.logs))
        of_lens = [] if self.lenses is None else [self.lenses.logs.get_rows(lens, lens + 1)]
        return np.concatenate([gains[:, :GAIN_ENTRIES], logs[:, GAIN_ENTRIES:], *of_lens], axis=1)

    def compare(self, work: Workspace, image: DeviceArray, target: DeviceArray, size: tuple[int, int]) -> DeviceArray:  # noqa: ARG002
        """Remove the photograph's own colours from its pixels `target`, in place, by the entries of the photograph and
        of its lens. Returns the render `image` unchanged. size: width and height of both."""
        develop(self.device, self.model, self.colours, self.lenses, self.taken, target, size)
        return image

    def gradient(
        self, work: Workspace, image: DeviceArray, gradient: DeviceArray, size: tuple[int, int]
    ) -> DeviceArray:
        """Return the loss's gradient with respect to the entries, as column sums (`entry_gradient`), for `update`.

        image: the render, of width and height `size`. gradient: the loss's gradient with respect to it.
        At the first step, the sandbox also tries the kernels of `update` here, before anything changes.
        """
        columns = entry_gradient(self.device, work, self.model, self.taken, image, gradient, size, self.place)
        if self.step == 1:
            with only_tried(self.device):
                self.update(columns, columns)
        return columns

    def update(self, own: DeviceArray | None, readback: DeviceArray) -> None:
        """Take Adam's step for the entries of the photograph and of its lens.

        own: gradient with respect to the entries, as the method `gradient` returned it. None causes no step.
        readback: counts of the step's pass on the device. If they say that the pass has stopped, nothing changes.
        """
        if own is None:
            return
        row, lens, step = self.taken.photograph, self.taken.lens, self.step
        step_gains(self.device, self.colours, row, own, step, self.rate, readback, _COLOUR_UPDATE)
        if self.lenses is not None:
            update = GainEntries.of_lens(self.model)
            step_gains(self.device, self.lenses, lens, own, step, self.lens_rate, readback, update)


def centre(view: View) -> tuple[float, float]:
    """Principal point, as fractions of the picture's width and height."""
    camera = view.camera
    return camera.cx / camera.width, camera.cy / camera.height


def panorama(view: View) -> bool:
    """True for panoramas, which have no vignette."""
    return view.camera.model.wraps


def _from_mean(exposures: Sequence[float | None], reference: Sequence[float | None]) -> NDArray[np.float64]:
    """Subtract the mean of the known exposures in `reference` from `exposures`. Unknown exposures become NaN.

    exposures, reference: exposures from EXIF in octaves (`exposure_of`); None if unknown.
    """
    known = [value for value in reference if value is not None]
    return np.array(
        [np.nan if value is None or not known else value - np.mean(known) for value in exposures], np.float64
    )


def _named(sizes: Mapping[str, int], entries: NDArray[np.float64]) -> dict[str, list[float]]:
    """Split a row of entries by name. sizes: the number of entries of each name, in order."""
    parts = np.split(entries, np.cumsum(list(sizes.values()))[:-1])
    return {name: part.tolist() for name, part in zip(sizes, parts, strict=True)}


class ColoursOfAll(Appearance):
    """Appearance model that learns a colour model's entries for each training photograph and each lens.

    Photographs of one lens share the lens's entries. Gains are pulled towards their initial values. The mean of the
    photographs' entries stays: 0, or that of the appearance that the training began with.
    """

    def __init__(self, config: TrainConfig, device: Device, scene: Scene) -> None:
        self._config, self._device, self._scene = config, device, scene
        self._model = COLOUR_MODELS[config.appearance]
        self._told = [exposure_of(view.path) for view in scene.train_views]
        self._lens_rows = {lens: row for row, lens in enumerate(dict.fromkeys(view.lens for view in scene.train_views))}
        self._taken = [
            PhotoLens(row, self._lens_rows[view.lens], centre(view), not panorama(view))
            for row, view in enumerate(scene.train_views)
        ]
        shape = (len(self._lens_rows), self._model.lens_entries)
        self._lenses = Gains.on(device, np.zeros(shape, np.float32)) if self._model.of_lens else None
        self._earlier: NDArray[np.float32] | None = None
        self._mean = np.zeros(self._model.entries)
        self._keeps_lenses = False

    def begin_from(self, folder: Path, *, keeps_lenses: bool) -> None:
        """Begin with the entries that appearance.json in `folder` has for the photographs of the same names and for
        their lenses. The mean of the photographs' entries stays.

        keeps_lenses: True if the lenses' entries are not trained.
        Raises InputError if the file does not have this colour model of all training photographs.
        """
        views, model = self._scene.train_views, self._model
        own, of_lenses = entries_of(folder, [view.name for view in views], model)
        self._earlier, self._mean, self._keeps_lenses = own.astype(np.float32), own.mean(axis=0), keeps_lenses
        if self._lenses is not None:
            values = np.zeros((len(self._lens_rows), model.lens_entries), np.float32)
            values[[taken.lens for taken in self._taken]] = of_lenses
            self._lenses = Gains.on(self._device, values)

    @cached_property
    def _gains(self) -> Gains:
        """Entries of all training photographs. The gains among them begin at gains from points or from EXIF. The
        entries are computed on first use, because sampling the photographs takes time, and a checkpoint may replace the
        result. Entries of an earlier run replace the initial ones, but the pull is towards the initial ones."""
        scene = self._scene
        curve = CODED_OCTAVES_PER_LIGHT_OCTAVE if photos_space(view.path for view in scene.views) == SRGB else 1.0
        by_exif = curve * np.nan_to_num(_from_mean(self._told, self._told))
        by_points = {
            name: np.round(told / START_GAIN_STEP_OCTAVES) * START_GAIN_STEP_OCTAVES
            for name, told in VisiblePoints(scene).exposures.items()
        }
        views = zip(scene.train_views, by_exif, strict=True)
        start = np.zeros((len(scene.train_views), self._model.entries))
        start[:, :GAIN_ENTRIES] = [by_points.get(view.name, np.full(3, told)) for view, told in views]
        self._by_points = np.array([view.name in by_points for view in scene.train_views])
        # the training keeps the mean of `start`, and the pull does not depend on it
        begun = Gains.on(self._device, (start - start.mean(axis=0) + self._mean).astype(np.float32), self._pull)
        if self._earlier is None:
            return begun
        earlier = Gains.on(self._device, self._earlier)
        return replace(begun, logs=earlier.logs, gains=earlier.gains)

    @property
    def _pull(self) -> csr_array:
        from scipy.sparse import csr_array, diags_array  # imported here, as in `common`

        told, cameras = self._by_points, [view.camera for view in self._scene.train_views]
        return csr_array(
            VIEW_PULL_WEIGHT * diags_array(told.astype(np.float64)) + NEIGHBOUR_PULL_WEIGHT * common(cameras, told)
        )

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel that the colour model takes on the device."""
        return self._model.pixel_bytes

    def of_views(self, views: Sequence[int], step: int) -> list[ViewColours]:
        """Return, for each view of a step, the part that learns and applies the photograph's and the lens's entries.

        views: indices of the step's views among the training views.
        step: number of views that training has used, including the views of this step.
        """
        numbers = range(step - len(views) + 1, step + 1)
        return [
            ViewColours(
                self._device,
                self._model,
                self._gains,
                self._lenses,
                self._taken[view],
                number,
                rate_at(self._config, number, len(self._taken), ends=GAIN_RATE_END_FRACTION),
                0.0
                if self._keeps_lenses
                else rate_at(self._config, number, len(self._lens_rows), ends=GAIN_RATE_END_FRACTION),
                place,
            )
            for place, (view, number) in enumerate(zip(views, numbers, strict=True))
        ]

    def record(self) -> dict[str, Any]:
        """Return the content of appearance.json: the learnt entries by the names of the photographs.

        Nothing is learnt about held-out photographs. If EXIF gives the exposure of such a photograph, its gains follow
        from a linear fit of gains to exposures over the training photographs. Its lens has the learnt entries, or the
        mean of all lenses if no training photograph has this lens.
        """
        entries, scene, model = self._gains.logs.get().astype(np.float64), self._scene, self._model
        photographs = {
            view.name: _named(model.of_photograph, row) for view, row in zip(scene.train_views, entries, strict=True)
        }
        expected = zip(scene.test_views, self._expected(entries[:, :GAIN_ENTRIES]).tolist(), strict=True)
        held_out = {view.name: {"log2_gains": row} for view, row in expected}
        if self._lenses is not None:
            lenses = self._lenses.logs.get().astype(np.float64)
            for view in scene.train_views:
                photographs[view.name] |= self._of_lens(view, lenses[self._lens_rows[view.lens]])
            for view in scene.test_views:
                row = self._lens_rows.get(view.lens)
                usual = lenses.mean(axis=0) if row is None else lenses[row]
                held_out[view.name] |= self._of_lens(view, np.zeros_like(usual) if panorama(view) else usual)
        return {"kind": self._config.appearance, "photographs": photographs, "held_out": held_out}

    def _expected(self, logs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predict the log2 gains (n, 3) of the n held-out photographs from their EXIF exposures.

        logs: (training photographs, 3), learnt log2 gains.
        """
        told = _from_mean(self._told, self._told)
        known = ~np.isnan(told)
        spread = np.square(told[known]).sum()
        slopes = told[known] @ logs[known] / spread if spread > 0 else np.zeros(GAIN_ENTRIES)
        held_out = _from_mean([exposure_of(view.path) for view in self._scene.test_views], self._told)
        expected: NDArray[np.float64] = self._mean[:GAIN_ENTRIES] + np.nan_to_num(held_out)[:, None] * slopes
        return expected

    def _of_lens(self, view: View, entries: NDArray[np.float64]) -> dict[str, list[float]]:
        """Return the entries of a view's lens by name, for appearance.json, and the view's principal point
        ("centre")."""
        return _named(self._model.of_lens, entries) | {"centre": list(centre(view))}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Entries and Adam's moments of photographs and lenses, keyed by their names in a checkpoint."""
        held = saved({name: getattr(self._gains, name) for name in GAIN_CHECKPOINT_ARRAYS})
        told = np.repeat(self._by_points[:, None], self._model.entries, axis=1)
        lenses = {} if self._lenses is None else vars(self._lenses)
        of_lenses = {f"lenses_{name}": lenses[name] for name in LENS_CHECKPOINT_ARRAYS if name in lenses}
        return {**held, "appearance/told": told.astype(np.float32), **saved(of_lenses)}

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load entries and moments from a checkpoint's arrays, by name without "appearance/". Raises ValueError for
        arrays of other photographs."""
        lenses = self._lenses and self._loaded_lenses(arrays)
        shape = (len(self._scene.train_views), self._model.entries)
        values = loaded(self._device, arrays, (*GAIN_CHECKPOINT_ARRAYS, "told"), shape)
        self._by_points = values.pop("told").get()[:, 0] > 0
        self._gains = Gains(**values, **scratch_on(self._device, shape), **rows_on(self._device, shape[0], self._pull))
        self._lenses = lenses

    def _loaded_lenses(self, arrays: Mapping[str, NDArray[Any]]) -> Gains:
        shape = (len(self._lens_rows), self._model.lens_entries)
        held = loaded(self._device, arrays, [f"lenses_{name}" for name in LENS_CHECKPOINT_ARRAYS], shape)
        logs, first, second = held.values()
        start, gains = upload(self._device, np.zeros(shape, np.float32)), allocate(self._device, shape, np.float32)
        other = scratch_on(self._device, shape) | rows_on(self._device, shape[0], None)
        return Gains(logs, start, first, second, gains, **other)
