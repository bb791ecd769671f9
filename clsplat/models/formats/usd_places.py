# SPDX-License-Identifier: Apache-2.0
"""Placements of the prims with Gaussians in a USD stage, including instances of PointInstancers.

The rules are those of USD's own renderers:

- Prims below an instancer are drawn only as its instances. A prototype elsewhere in the stage is also drawn where it
  is.
- An instance includes the local transform of its prototype's prim. It is visible if the instancer and all prims from
  the prototype down to the Gaussians are visible.
- An instance is identified by its id, or by its number if the instancer has no ids.
- Between time samples USD interpolates, or extrapolates by the velocities.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError

MAX_PLACED_PRIMS = 1_000_000
"""Largest number of placements in a stage. More are a mistake or an attempt to exhaust memory."""
_MAX_CACHED_TIMES = 16
"""Largest number of time codes for which an instancer's transforms are cached."""
_TRANSFORM_ATTRIBUTES = ("positions", "orientations", "orientationsf", "scales")
_VELOCITY_ATTRIBUTES = ("velocities", "angularVelocities")
_MEMBERSHIP_ATTRIBUTES = ("protoIndices", "ids", "invisibleIds")

Key = tuple[int, int]
"""Key of an instance in its instancer: its id or number, and the index of its prototype."""


@dataclass(frozen=True, eq=False)
class UsdPlacement:
    """One placement of a prim with Gaussians in a stage.

    name: the prim's path; in an instance, INSTANCER[ID] and the path below the prototype.
    instance: the instance that contains the prim; None outside of instancers.
    """

    prim: Any
    name: str
    instance: PointInstance | None = None

    def at(self, code: Any) -> tuple[Float64, bool]:
        """World-from-prim matrix (4, 4) and visibility at a time code. Raises InputError."""
        matrix, shown = _world_from_prim(self.prim, self.instance, code)
        # USD multiplies row vectors: its matrices are transposes of clsplat's
        return np.array(matrix, np.float64).T, shown

    @property
    def is_drawn(self) -> bool:
        """True unless the purpose of the prim, or of an instancer that contains it, is proxy or guide."""
        instance, drawn = self.instance, _for_render(self.prim)
        while instance is not None and drawn:
            instancer = instance.instancer
            instance, drawn = instancer.outer, _for_render(instancer.prim)
        return drawn

    @property
    def moves(self) -> bool:
        """True if the prim's transform or visibility may change over time."""
        if self.instance is None:
            return any(map(_varies, _above(self.prim, None)))
        return self.instance.instancer.moves or any(map(_varies, _above(self.prim, self.instance.root)))

    @property
    def reach(self) -> tuple[float, float] | None:
        """First and last time sample of the transforms of the prim and its ancestors; None without time samples.

        The result is (-inf, inf) if an instancer that contains the prim has velocities, which apply at any time.
        """
        times = [time for prim in _above(self.prim, self.instance and self.instance.root) for time in _samples_of(prim)]
        instance = self.instance
        while instance is not None:
            times += instance.instancer.reach
            instance = instance.instancer.outer
        return (min(times), max(times)) if times else None


@dataclass(frozen=True, eq=False)
class PointInstance:
    """An instance of a prototype in a PointInstancer.

    key: identifies the instance in its instancer.
    root: the prototype's prim.
    """

    instancer: Instancer
    key: Key
    root: Any


class Instancer:
    """A PointInstancer with its instances.

    outer: the instance of another instancer that contains this instancer; None if there is none.
    """

    def __init__(self, prim: Any, name: str, where: str, outer: PointInstance | None) -> None:
        """Read the prototypes of an instancer.

        name: the instancer's path; if it is in an instance, its name as in `UsdPlacement`.
        where: prefix of errors.
        Raises InputError for missing prototypes.
        """
        from pxr import UsdGeom

        self.prim, self.name, self.where, self.outer = prim, name, f"{where}: {name}", outer
        self._instancer = UsdGeom.PointInstancer(prim)
        stage = prim.GetStage()
        targets = self._instancer.GetPrototypesRel().GetForwardedTargets()
        self.roots = [stage.GetPrimAtPath(path) for path in targets]
        if lost := [str(path) for path, root in zip(targets, self.roots, strict=True) if not root]:
            raise InputError(f"{self.where}: has the prototype {lost[0]}, expected an existing prim")
        chosen = [self._instancer.GetProtoIndicesAttr(), self._instancer.GetIdsAttr()]
        self._times = sorted({float(time) for attribute in chosen for time in attribute.GetTimeSamples()})
        self._there = [self._keys(time) for time in self._times or [self._first()]]
        self._known: dict[float, tuple[dict[Key, Any], frozenset[Key]]] = {}

    @property
    def keys(self) -> list[Key]:
        """Keys of all instances that exist at any time, in order of first appearance."""
        return list(dict.fromkeys(key for keys in self._there for key in keys))

    @property
    def reach(self) -> list[float]:
        """Time samples of the transforms of the instancer and its instances.

        If the instances have velocities, which move them at any time, -inf and inf are added.
        """
        moved = [time for name in _TRANSFORM_ATTRIBUTES for time in self._samples(name)]
        own = moved + [time for prim in _above(self.prim, self.outer and self.outer.root) for time in _samples_of(prim)]
        return [-math.inf, math.inf, *own] if moved and any(map(self._has, _VELOCITY_ATTRIBUTES)) else own

    @property
    def moves(self) -> bool:
        """True if an instance may move, appear or vanish."""
        if any(
            self._samples(name) for name in (*_TRANSFORM_ATTRIBUTES, *_VELOCITY_ATTRIBUTES, *_MEMBERSHIP_ATTRIBUTES)
        ):
            return True
        above = _above(self.prim, self.outer and self.outer.root)
        return any(map(_varies, above)) or (self.outer is not None and self.outer.instancer.moves)

    def of(self, key: Key, code: Any) -> tuple[Any, bool]:
        """Return an instance's USD matrix, from its prototype's own axes to the world, and True if it is visible.

        An instance that does not exist at this time is invisible. Its matrix is that of the last earlier time at which
        it exists, or if there is none, of the first later time. Raises InputError.

        key: the instance's key. code: USD's time code.
        """
        places, hidden = self._at(code)
        if key in places:
            return places[key], key not in hidden
        now = max(bisect_right(self._times, code.GetValue()) - 1, 0)
        near = sorted(range(len(self._there)), key=lambda at: (at > now, abs(at - now)))
        there = next(at for at in near if key in self._there[at])
        return self._at(_code(self._times[there]))[0][key], False

    def _at(self, code: Any) -> tuple[dict[Key, Any], frozenset[Key]]:
        """Matrices of the instances by key, as in `of`, and the keys of hidden instances, at a time code. Cached."""
        time = code.GetValue()
        if time not in self._known:
            if len(self._known) >= _MAX_CACHED_TIMES:
                self._known.clear()
            self._known[time] = self._made(code)
        return self._known[time]

    def _made(self, code: Any) -> tuple[dict[Key, Any], frozenset[Key]]:
        here = _code(self._first()) if code.IsEarliestTime() else code
        keys, own = list(self._keys(here.GetValue())), self._own(here)
        if len(own) != len(keys):
            raise InputError(
                f"{self.where} at {here.GetValue():g}: has {len(keys)} protoIndices, expected as many positions, and "
                "as many orientations and scales or none"
            )
        outer, shown = _world_from_prim(self.prim, self.outer, code)
        roots = [_local(root, code) for root in self.roots]
        mask = list(self._instancer.ComputeMaskAtTime(here)) or [True] * len(keys)
        hidden = (key for key, seen in zip(keys, mask, strict=True) if not (seen and shown))
        places = {key: roots[key[1]] * (matrix * outer) for key, matrix in zip(keys, own, strict=True)}
        return places, frozenset(hidden)

    def _own(self, code: Any) -> list[Any]:
        """USD's matrices of the instances relative to the instancer, at a time code.

        The result is empty if the instancer's arrays differ in length.

        Rotations come from the quaternions, as for xformOp:orient. USD's ComputeInstanceTransformsAtTime shears if a
        quaternion's length is not exactly 1, as with half floats.
        """
        from pxr import Gf, UsdGeom

        kind = UsdGeom.PointInstancer
        theirs = kind.ComputeInstanceTransformsAtTime(
            self._instancer, code, code, kind.ExcludeProtoXform, kind.IgnoreMask
        )
        turns = self._get("orientationsf", code) or self._get("orientations", code)
        scales = self._get("scales", code) or [Gf.Vec3f(1)] * len(theirs)
        matrices = []
        for index, matrix in enumerate(theirs):
            turn = Gf.Matrix4d(1)
            if self._has("angularVelocities"):
                turn = _turn_of(matrix, scales[index])
            elif turns:
                turn = Gf.Matrix4d(1).SetRotate(Gf.Rotation(Gf.Quatd(turns[index])))
            own = Gf.Matrix4d(1).SetScale(Gf.Vec3d(scales[index])) * turn
            matrices.append(own.SetTranslateOnly(matrix.ExtractTranslation()))
        return matrices

    def _get(self, name: str, code: Any) -> Any:
        attribute = self.prim.GetAttribute(name)
        return attribute.Get(code) if attribute else None

    def _keys(self, time: float) -> dict[Key, None]:
        """Keys of the instances that exist at a time, in the stage's order."""
        code = _code(time)
        indices = [int(index) for index in self._instancer.GetProtoIndicesAttr().Get(code) or ()]
        if wrong := [index for index in indices if not 0 <= index < len(self.roots)]:
            raise InputError(
                f"{self.where}: has the protoIndex {wrong[0]}, expected 0 to {len(self.roots) - 1}, as it has "
                f"{len(self.roots)} prototypes"
            )
        ids = [int(number) for number in self._instancer.GetIdsAttr().Get(code) or ()]
        if len(ids) != len(indices) or len(set(ids)) != len(ids):  # as USD does, ignore ids that are not unique
            ids = list(range(len(indices)))
        return dict.fromkeys(zip(ids, indices, strict=True))

    def _samples(self, name: str) -> list[float]:
        attribute = self.prim.GetAttribute(name)
        return list(attribute.GetTimeSamples()) if attribute else []

    def _has(self, name: str) -> bool:
        attribute = self.prim.GetAttribute(name)
        return bool(attribute and attribute.HasAuthoredValue())

    def _first(self) -> float:
        """First time sample of the instances; 0 if they do not depend on time."""
        return min(
            (time for name in (*_TRANSFORM_ATTRIBUTES, *_MEMBERSHIP_ATTRIBUTES) for time in self._samples(name)),
            default=0.0,
        )


@dataclass
class _StageFindings:
    """Results of a traversal of a USD stage: placements of prims with Gaussians, and prims that are not drawn.

    where: prefix of errors.
    kinds: type names of prims with Gaussians.
    places: the placements in the stage's order.
    unused: descriptions, by path, of prims with Gaussians that no instance draws.
    shapes: descriptions, by path, of prims without Gaussians, which clsplat does not draw.
    """

    where: str
    kinds: Collection[str]
    places: list[UsdPlacement] = field(default_factory=list)
    unused: dict[str, str] = field(default_factory=dict)
    shapes: dict[str, str] = field(default_factory=dict)

    def walk(self, prims: Any, root: Any, instance: PointInstance | None, name: str, chain: tuple[Any, ...]) -> None:
        """Collect the prims with Gaussians among `prims`. Raises InputError.

        root: prim of the prototype that contains the prims; None outside of instancers.
        instance, name: the instance that contains the prims, and its name; None and "" outside of instancers.
        chain: paths of the instancers that contain the prims.
        """
        from pxr import UsdGeom

        for prim in prims:
            path = prim.GetPath()
            own = str(path) if instance is None else name + str(path)[len(str(root.GetPath())) :]
            if prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()
                self._walk_instances(Instancer(prim, own, self.where, instance), chain)
            elif prim.GetTypeName() in self.kinds:
                self.places.append(UsdPlacement(prim, own, instance))
                if len(self.places) > MAX_PLACED_PRIMS:
                    raise InputError(
                        f"{self.where}: has more than {MAX_PLACED_PRIMS:,} placed prims of Gaussians, expected at most "
                        "that many"
                    )
            elif _is_visible_shape(prim):
                self.shapes[str(path)] = f"{path} ({prim.GetTypeName()})"

    def _walk_instances(self, instancer: Instancer, chain: tuple[Any, ...]) -> None:
        from pxr import Usd

        path = instancer.prim.GetPath()
        if path in chain:
            raise InputError(f"{instancer.where}: is inside its own prototype, expected an instancer outside it")
        used, empty = set(), set()
        for number, index in instancer.keys:
            root, count = instancer.roots[index], len(self.places)
            used.add(root.GetPath())
            if index in empty:
                continue
            prims = iter(Usd.PrimRange(root, _of_prototypes()))
            instance = PointInstance(instancer, (number, index), root)
            self.walk(prims, root, instance, f"{instancer.name}[{number}]", (*chain, path))
            if len(self.places) == count:
                empty.add(index)  # this prototype has no Gaussians
        for prim in (prim for top in (instancer.prim, *instancer.roots) for prim in Usd.PrimRange(top, _of_classes())):
            own = prim.GetPath()
            if prim.GetTypeName() in self.kinds and (prim.IsAbstract() or not any(map(own.HasPrefix, used))):
                self.unused[str(own)] = f"{own} (which no instance of {path} draws)"


def find_places(stage: Any, where: object, kinds: Collection[str]) -> tuple[list[UsdPlacement], list[str]]:
    """Placements of all prims of the types `kinds`, in the stage's order, and descriptions of prims that are not drawn.

    Descriptions are of prims that clsplat does not draw but other USD renderers do, of Gaussians that no instance
    draws, and of prims whose file cannot be opened. Raises InputError, prefixed with `where`.
    """
    from pxr import Usd

    found = _StageFindings(str(where), kinds)
    found.walk(iter(stage.Traverse(Usd.TraverseInstanceProxies())), None, None, "", ())
    drawn = {str(place.prim.GetPath()) for place in found.places}
    unused = [text for path, text in found.unused.items() if path not in drawn]
    return found.places, [*_lost(stage), *unused, *found.shapes.values()]


def _lost(stage: Any) -> list[str]:
    """Descriptions of prims that refer to a file that cannot be opened."""
    lines = []
    for error in stage.GetCompositionErrors():
        if type(error).__name__ in ("ErrorInvalidAssetPath", "ErrorInvalidSublayerPath"):
            file = re.search("@([^@]*)@", str(error))
            lines.append(f"{error.rootSite.path} (its {file[1] if file else 'file'} cannot be opened)")
    return lines


def _of_prototypes() -> Any:
    """USD predicate that selects the prims of a prototype that are drawn. Prims that are only overs are drawn too."""
    from pxr import Usd

    return Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded & ~Usd.PrimIsAbstract)


def _of_classes() -> Any:
    """USD predicate like `_of_prototypes` that also selects the prims of classes, which are never drawn."""
    from pxr import Usd

    return Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)


def _code(time: float) -> Any:
    from pxr import Usd

    return Usd.TimeCode(time)


def _above(prim: Any, root: Any) -> Iterator[Any]:
    """Yield the prim and its ancestors, up to and including `root`. If `root` is None, yield all ancestors."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        if root and prim == root:
            return
        prim = prim.GetParent()


def _world_from_prim(prim: Any, instance: PointInstance | None, code: Any) -> tuple[Any, bool]:
    """USD's matrix from a prim to the world at a time code, and True if the prim is visible.

    instance: the instance that contains the prim; None outside of instancers.
    """
    from pxr import UsdGeom

    cache = UsdGeom.XformCache(code)
    if instance is None:
        shown = not prim.IsA(UsdGeom.Imageable) or (
            UsdGeom.Imageable(prim).ComputeVisibility(code) != UsdGeom.Tokens.invisible
        )
        return cache.GetLocalToWorldTransform(prim), shown
    outer, shown = instance.instancer.of(instance.key, code)
    if prim == instance.root:
        return outer, shown and not _hides(prim, code)
    inner = cache.ComputeRelativeTransform(prim, instance.root)[0]
    return inner * outer, shown and not any(_hides(own, code) for own in _above(prim, instance.root))


def _local(prim: Any, code: Any) -> Any:
    from pxr import Gf, UsdGeom

    return UsdGeom.Xformable(prim).GetLocalTransformation(code) if prim.IsA(UsdGeom.Xformable) else Gf.Matrix4d(1)


def _turn_of(matrix: Any, scales: Any) -> Any:
    """Return the rotation in USD's matrix of an instance that has these three scales.

    Without the scales, the matrix may still be sheared a bit. The result is the nearest rotation.
    """
    from pxr import Gf

    rows = np.array(matrix)[:3, :3] / np.array(scales, np.float64)[:, None]
    u, _, vt = np.linalg.svd(rows) if np.isfinite(rows).all() else (rows, rows, np.eye(3))
    return Gf.Matrix4d(1).SetRotate(Gf.Matrix3d(*(u @ vt).ravel().tolist()))


def _hides(prim: Any, code: Any) -> bool:
    from pxr import UsdGeom

    if not prim.IsA(UsdGeom.Imageable):
        return False
    return bool(UsdGeom.Imageable(prim).GetVisibilityAttr().Get(code) == UsdGeom.Tokens.invisible)


def _for_render(prim: Any) -> bool:
    from pxr import UsdGeom

    return UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


def _is_visible_shape(prim: Any) -> bool:
    """True for a visible mesh, curve, point set, volume or particle field with the purpose default or render."""
    from pxr import Usd, UsdGeom

    if not (prim.IsA(UsdGeom.Gprim) or str(prim.GetTypeName()).startswith("ParticleField")):
        return False
    first = Usd.TimeCode.EarliestTime()
    return _for_render(prim) and UsdGeom.Imageable(prim).ComputeVisibility(first) != UsdGeom.Tokens.invisible


def _varies(prim: Any) -> bool:
    """True if a prim's own transform or visibility may change over time."""
    from pxr import UsdGeom

    if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
        return True
    return bool(prim.IsA(UsdGeom.Imageable) and UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying())


def _samples_of(prim: Any) -> list[float]:
    from pxr import UsdGeom

    return list(UsdGeom.Xformable(prim).GetTimeSamples()) if prim.IsA(UsdGeom.Xformable) else []
