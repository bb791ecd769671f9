# SPDX-License-Identifier: Apache-2.0
"""Gaussians that a USD stage places: its prims, each with its world transform and visibility over time.

The frame's number is the time code, as it is for cameras (`shots.usd`). References and payloads are followed wherever
they lead. Neither metersPerUnit nor upAxis changes anything.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import examples, warn
from clsplat.gaussians import Gaussians
from clsplat.models.codec.soundness import sound
from clsplat.models.formats.usd import TYPE, gaussians_of, open_stage, readable, space_of, splats_of, survive
from clsplat.models.formats.usd_places import Place
from clsplat.models.placed import IDENTITY, Placement, checked, rows_of

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

    models: tuple[Gaussians, ...]
    names: tuple[str, ...]
    tracks: tuple[StageTrack, ...]
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
        if still and seen and len(layers) == 1 and len(drawn) == len(places):
            return None
        places = drawn or places
        prims = {place.prim.GetPath(): place.prim for place in places}
        if animated := [f"{name} of {own}" for own, prim in prims.items() for name in _animated(prim)]:
            warn(f"{path}: not applied: the animation of {examples(animated)}; they are those of the first time")
        space, sums = space_of(path, list(prims.values())), hashlib.sha256()
        known: dict[Any, Gaussians] = {}
        for place in places:
            own = place.prim.GetPath()
            if own not in known:
                where = f"{path}: {own}"
                known[own] = sound(gaussians_of(where, place.prim, time, space), where)
                _add(sums, place.prim, time)
            elif place.seat is not None:
                sums.update(f"again {list(known).index(own)}\n".encode())
        tracks = [StageTrack(f"{path}: {place.name}", place, stage) for place in places]
    del diagnostics
    models, names = tuple(known[place.prim.GetPath()] for place in places), tuple(place.name for place in places)
    return StageModels(models, names, tuple(tracks), sums.hexdigest(), space)


def _attributes(prim: Any) -> list[Any]:
    names = [*ARRAYS, *(f"{name}h" for name in ARRAYS), *COLOURS]
    attributes = (prim.GetAttribute(name) for name in names)
    return [attribute for attribute in attributes if attribute and attribute.HasValue()]


def _animated(prim: Any) -> Sequence[str]:
    return [attribute.GetName() for attribute in _attributes(prim) if attribute.ValueMightBeTimeVarying()]


def _add(sums: Any, prim: Any, time: Any) -> None:
    """Add what the prim's Gaussians are read from."""
    for attribute in _attributes(prim):
        values = np.ascontiguousarray(np.asarray(attribute.Get(time)))
        sums.update(f"{attribute.GetName()} {values.dtype} {values.shape}\n".encode())
        sums.update(values.tobytes())
