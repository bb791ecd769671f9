# SPDX-License-Identifier: Apache-2.0
"""Gaussians that a USD stage places: its prims, each with its world transform and visibility over time.

The frame's number is the time code, as it is for cameras (`shots.usd`). References and payloads are followed wherever
they lead. Neither metersPerUnit nor upAxis changes anything.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import examples, warn
from clsplat.files import digest
from clsplat.gaussians import Gaussians
from clsplat.models.codec.soundness import sound
from clsplat.models.formats.usd import TYPE, gaussians_of, open_stage, readable, space_of, splats_of, survive
from clsplat.models.formats.usd_places import Place
from clsplat.models.placed import IDENTITY, Changing, Placement, Track, checked, rows_of
from clsplat.models.series import Series

ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
COLOURS = ("radiance:sphericalHarmonicsDegree", "primvars:displayColor", "primvars:displayOpacity")
"""Attributes that Gaussians are read from; of ARRAYS there are some with halves, h at the end."""


@dataclass(frozen=True, eq=False)
class StageTrack:
    """The `Track` of a prim. where: begins errors; held: the stage, which USD closes with its last reference."""

    where: str
    place: Place
    held: Any

    def at(self, frame: float) -> Placement:
        """World transform and visibility at a time code. Raises InputError for a transform that Gaussians cannot
        follow."""
        from pxr import Usd

        matrix, shown = self.place.at(Usd.TimeCode(frame))
        place = Placement(rows_of(matrix), float(shown))
        return place if place.matrix == IDENTITY else checked(place, f"{self.where} at {frame:g}")

    @property
    def reach(self) -> tuple[float, float] | None:
        """The first and the last time that says where it is (`Place.reach`)."""
        return self.place.reach


@dataclass(frozen=True, eq=False)
class StageModels:
    """The Gaussians of a stage, prim by prim, in their own coordinates, those of an instanced prim once for each
    instance. names: of their places; digest: SHA-256 of what they are read from; space: of their colours."""

    models: tuple[Gaussians | Series, ...]
    names: tuple[str, ...]
    tracks: tuple[Track, ...]
    digest: str
    space: str


def read_stage(path: Path) -> StageModels | None:
    """The Gaussians of a stage; None for one that is no more than a model, of one layer, in which everything is seen
    and stands still. Raises InputError."""
    survive(path, "clsplat.shots.stage:read_here")
    return read_here(path)


def read_here(path: Path) -> StageModels | None:
    """`read_stage` of a file that is known not to end the process."""
    from pxr import Usd, UsdUtils

    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # takes what USD would print
    stage = open_stage(path, path)
    time = Usd.TimeCode.EarliestTime()
    with readable(path):
        places, left = splats_of(path, stage)
        if left:
            warn(f"{path}: not drawn: {examples(left)}; of a stage only {TYPE} prims are drawn")
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
        known: dict[Any, Gaussians | Series] = {}
        for place in places:
            own = place.prim.GetPath()
            if own not in known:
                known[own] = _model_of(path, stage, place.prim, space)
                _add(sums, place.prim, time)
            elif place.seat is not None:
                sums.update(f"again {list(known).index(own)}\n".encode())
        models = tuple(known[place.prim.GetPath()] for place in places)
        if any(isinstance(model, Series) for model in models):  # samples are read when they are drawn
            for name in sorted(str(layer.realPath) for layer in layers):
                sums.update(digest(Path(name)).encode() if name else b"")
        tracks: list[Track] = [StageTrack(f"{path}: {place.name}", place, stage) for place in places]
    del diagnostics
    tracks = [
        Changing(track) if isinstance(model, Series) else track for model, track in zip(models, tracks, strict=True)
    ]
    return StageModels(models, tuple(place.name for place in places), tuple(tracks), sums.hexdigest(), space)


def _model_of(path: Path, stage: Any, prim: Any, space: str) -> Gaussians | Series:
    """The Gaussians of a prim, at its time samples if it has any. stage: is held by these, as USD closes it with its
    last reference."""
    from pxr import Usd

    where, times = f"{path}: {prim.GetPath()}", _sample_times(prim)

    def read(code: Any, held: Any = stage) -> Gaussians:  # noqa: ARG001
        with readable(path):
            return sound(gaussians_of(where, prim, code, space), where)

    if not times:
        return read(Usd.TimeCode.EarliestTime())
    return Series(times, lambda index: read(Usd.TimeCode(times[index])), where, held=True)


def _attributes(prim: Any) -> list[Any]:
    names = [*ARRAYS, *(f"{name}h" for name in ARRAYS), *COLOURS]
    attributes = (prim.GetAttribute(name) for name in names)
    return [attribute for attribute in attributes if attribute and attribute.HasValue()]


def _sample_times(prim: Any) -> list[float]:
    """The time codes at which the prim's arrays have samples, rising; none for arrays that do not change."""
    changing = [attribute for attribute in _attributes(prim) if attribute.ValueMightBeTimeVarying()]
    return sorted({float(time) for attribute in changing for time in attribute.GetTimeSamples()})


def _add(sums: Any, prim: Any, time: Any) -> None:
    """Add what the prim's Gaussians are read from."""
    for attribute in _attributes(prim):
        values = np.ascontiguousarray(np.asarray(attribute.Get(time)))
        sums.update(f"{attribute.GetName()} {values.dtype} {values.shape}\n".encode())
        sums.update(values.tobytes())
