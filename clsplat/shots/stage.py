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
from clsplat.models.formats.usd import gaussians_of, open_stage, readable, space_of, splats_of, survive
from clsplat.models.placed import IDENTITY, Placement, checked, rows_of

ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
COLOURS = ("radiance:sphericalHarmonicsDegree", "primvars:displayColor", "primvars:displayOpacity")
"""Attributes that Gaussians are read from; of ARRAYS there are some with halves, h at the end."""


@dataclass(frozen=True, eq=False)
class StageTrack:
    """The `Track` of a prim. where: begins errors; held: the stage, which USD closes with its last reference."""

    where: str
    prim: Any
    held: Any

    def at(self, frame: float) -> Placement:
        """World transform and visibility at a time code. Raises InputError for a transform that Gaussians cannot
        follow."""
        from pxr import Usd, UsdGeom

        code = Usd.TimeCode(frame)
        shown = UsdGeom.Imageable(self.prim).ComputeVisibility(code) != UsdGeom.Tokens.invisible
        # USD's vectors are rows, so its matrices are the transposes of ours
        matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(self.prim), np.float64).T
        place = Placement(rows_of(matrix), float(shown))
        return place if place.matrix == IDENTITY else checked(place, f"{self.where} at {frame:g}")

    @property
    def reach(self) -> tuple[float, float] | None:
        """The first and the last time at which its transform has a value, or that of what it is in."""
        from pxr import UsdGeom

        times, prim = [], self.prim
        while prim and not prim.IsPseudoRoot():
            if prim.IsA(UsdGeom.Xformable):
                times += UsdGeom.Xformable(prim).GetTimeSamples()
            prim = prim.GetParent()
        return (min(times), max(times)) if times else None


@dataclass(frozen=True, eq=False)
class StageModels:
    """The Gaussians of a stage, prim by prim, in their own coordinates. names: paths of the prims; digest: SHA-256 of
    what they are read from; space: of their colours."""

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
    from pxr import Usd, UsdGeom, UsdUtils

    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # takes what USD would print
    stage = open_stage(path, path)
    time = Usd.TimeCode.EarliestTime()
    with readable(path):
        prims = splats_of(path, stage)
        drawn = [prim for prim in prims if _is_drawn(prim)]
        still = all(not _moves(prim) for prim in prims)
        seen = all(UsdGeom.Imageable(prim).ComputeVisibility(time) != UsdGeom.Tokens.invisible for prim in prims)
        layers = [layer for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer()]
        if still and seen and len(layers) == 1 and len(drawn) == len(prims):
            return None
        prims = drawn or prims
        if animated := [f"{name} of {prim.GetPath()}" for prim in prims for name in _animated(prim)]:
            warn(f"{path}: not applied: the animation of {examples(animated)}; they are those of the first time")
        space, sums = space_of(path, prims), hashlib.sha256()
        models = []
        for prim in prims:
            where = f"{path}: {prim.GetPath()}"
            models.append(sound(gaussians_of(where, prim, time, space), where))
            _add(sums, prim, time)
        tracks = [StageTrack(f"{path}: {prim.GetPath()}", prim, stage) for prim in prims]
    del diagnostics
    names = tuple(str(prim.GetPath()) for prim in prims)
    return StageModels(tuple(models), names, tuple(tracks), sums.hexdigest(), space)


def _is_drawn(prim: Any) -> bool:
    """True unless its purpose is that of a proxy or a guide."""
    from pxr import UsdGeom

    return UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


def _moves(prim: Any) -> bool:
    """True if the transform or the visibility of the prim, or of what it is in, may change over time."""
    from pxr import UsdGeom

    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
            return True
        if prim.IsA(UsdGeom.Imageable) and UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying():
            return True
        prim = prim.GetParent()
    return False


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
