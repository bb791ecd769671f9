# SPDX-License-Identifier: Apache-2.0
"""Gaussians of a USD stage as models of a shot: each prim with its world transform and visibility over time.

The time code is the frame's number, as for cameras (`shots.readers.usd`). References and payloads are always followed.
metersPerUnit and upAxis are ignored.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import examples, warn
from clsplat.files.documents import digest
from clsplat.gaussians import Gaussians
from clsplat.models.codec.repair import repaired
from clsplat.models.formats.usd import (
    GAUSSIAN_PRIM_TYPE,
    gaussians_of,
    open_stage,
    readable,
    space_of,
    splats_of,
    survive,
)
from clsplat.models.formats.usd_places import UsdPlacement
from clsplat.models.instances import IDENTITY_ROWS, Changing, Placement, Track, checked, rows_of
from clsplat.models.series import ModelSeries

GAUSSIAN_ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
"""Attributes of a prim that hold arrays of its Gaussians. In half precision, an h is added to the name."""
GAUSSIAN_COLOUR_ATTRIBUTES = ("radiance:sphericalHarmonicsDegree", "primvars:displayColor", "primvars:displayOpacity")
"""Attributes of a prim that also determine the colours and opacities of its Gaussians."""


@dataclass(frozen=True, eq=False)
class StageTrack:
    """World transform and visibility of a USD stage's prim over time (`Track`).

    where: prefix of error messages.
    place: the prim's transforms and visibility in the stage.
    held: the stage. USD closes a stage when its last reference is gone, so the track keeps one.
    """

    where: str
    place: UsdPlacement
    held: Any

    def at(self, frame: float) -> Placement:
        """World transform and visibility at a time code. Raises InputError if the transform is not a similarity."""
        from pxr import Usd

        matrix, shown = self.place.at(Usd.TimeCode(frame))
        place = Placement(rows_of(matrix), float(shown))
        return place if place.matrix == IDENTITY_ROWS else checked(place, f"{self.where} at {frame:g}")

    @property
    def reach(self) -> tuple[float, float] | None:
        """First and last time at which the prim's placement has a value (`UsdPlacement.reach`)."""
        return self.place.reach


@dataclass(frozen=True, eq=False)
class StageModels:
    """The Gaussians of a stage in their own coordinates, one model per prim, and one per instance of an instanced prim.

    names: name of each model's prim or instance, as in `UsdPlacement`.
    tracks: placement of each model over time.
    digest: SHA-256 of the data that the models are read from.
    space: colour space of the models.
    """

    models: tuple[Gaussians | ModelSeries, ...]
    names: tuple[str, ...]
    tracks: tuple[Track, ...]
    digest: str
    space: str


def read_stage(path: Path) -> StageModels | None:
    """Read the Gaussians of a stage. Raises InputError.

    Returns None for a stage that is only a model: a single layer, in which everything is visible and static.
    """
    survive(path, "clsplat.shots.usd_models:read_here")
    return read_here(path)


def read_here(path: Path) -> StageModels | None:
    """Read a stage like `read_stage`, from a file that is known not to crash USD's library."""
    from pxr import Usd, UsdUtils

    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # captures the messages that USD would print
    stage = open_stage(path, path)
    time = Usd.TimeCode.EarliestTime()
    with readable(path):
        places, left = splats_of(path, stage)
        if left:
            warn(f"{path}: not drawn: {examples(left)}; only {GAUSSIAN_PRIM_TYPE} prims of a stage are drawn")
        drawn = [place for place in places if place.is_drawn]
        still = not any(place.moves for place in places)
        seen = all(place.at(time)[1] for place in places)
        layers = [layer for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer()]
        same = not any(_sample_times(place.prim) for place in places)
        if still and same and seen and len(layers) == 1 and len(drawn) == len(places):
            return None
        places = drawn or places
        prims = {place.prim.GetPath(): place.prim for place in places}
        space, sums = space_of(path, list(prims.values())), hashlib.sha256()
        known: dict[Any, Gaussians | ModelSeries] = {}
        for place in places:
            own = place.prim.GetPath()
            if own not in known:
                known[own] = _model_of(path, stage, place.prim, space)
                _add(sums, place.prim, time)
            elif place.instance is not None:
                sums.update(f"again {list(known).index(own)}\n".encode())
        models = tuple(known[place.prim.GetPath()] for place in places)
        if any(isinstance(model, ModelSeries) for model in models):  # their samples are read later: digest the files
            for name in sorted(str(layer.realPath) for layer in layers):
                sums.update(digest(Path(name)).encode() if name else b"")
        tracks: list[Track] = [StageTrack(f"{path}: {place.name}", place, stage) for place in places]
    del diagnostics
    tracks = [
        Changing(track) if isinstance(model, ModelSeries) else track
        for model, track in zip(models, tracks, strict=True)
    ]
    return StageModels(models, tuple(place.name for place in places), tuple(tracks), sums.hexdigest(), space)


def _model_of(path: Path, stage: Any, prim: Any, space: str) -> Gaussians | ModelSeries:
    """Return the Gaussians of a prim: a `ModelSeries` if they have time samples, otherwise a model.

    stage: the opened stage. The result keeps it open, since USD closes a stage with its last reference.
    space: as in `gaussians_of`.
    """
    from pxr import Usd

    where, times = f"{path}: {prim.GetPath()}", _sample_times(prim)

    def read(code: Any, held: Any = stage) -> Gaussians:  # noqa: ARG001
        with readable(path):
            return repaired(gaussians_of(where, prim, code, space), where)

    if not times:
        return read(Usd.TimeCode.EarliestTime())
    return ModelSeries(times, lambda index: read(Usd.TimeCode(times[index])), where, held=True)


def _attributes(prim: Any) -> list[Any]:
    names = [*GAUSSIAN_ARRAYS, *(f"{name}h" for name in GAUSSIAN_ARRAYS), *GAUSSIAN_COLOUR_ATTRIBUTES]
    attributes = (prim.GetAttribute(name) for name in names)
    return [attribute for attribute in attributes if attribute and attribute.HasValue()]


def _sample_times(prim: Any) -> list[float]:
    """Return the time codes, in increasing order, at which a prim's Gaussians have samples; empty if there are none."""
    changing = [attribute for attribute in _attributes(prim) if attribute.ValueMightBeTimeVarying()]
    return sorted({float(time) for attribute in changing for time in attribute.GetTimeSamples()})


def _add(sums: Any, prim: Any, time: Any) -> None:
    """Update the digest `sums` with the values, at a time code, of all attributes that determine a prim's Gaussians."""
    for attribute in _attributes(prim):
        values = np.ascontiguousarray(np.asarray(attribute.Get(time)))
        sums.update(f"{attribute.GetName()} {values.dtype} {values.shape}\n".encode())
        sums.update(values.tobytes())
