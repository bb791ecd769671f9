# SPDX-License-Identifier: Apache-2.0
"""OpenUSD's ParticleField3DGaussianSplat, through usd-core (an optional extra): .usd, .usda, .usdc and .usdz.

Specification: https://openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html, in OpenUSD since
26.03. A release without the schema writes the same prim with the same attributes.

- Coordinates: the stage's world is the model's, as for cameras (clsplat/shots/readers/usd.py); upAxis and metersPerUnit
  do not change it. The reader applies the prims' transforms. An `origin` becomes the translation of the parent prim.
- Values are float32 (the reader accepts half): linear scales, opacities in [0, 1], unit quaternions. SH coefficients
  are stored by Gaussian, in clsplat's order and signs.
- The writer sets the hints for other renderers to what clsplat does: perspective projection, and sorting by depth along
  the camera's axis.
- Colour space: as named by the attribute of the SH coefficients, their prim, or its nearest ancestor. The default is
  sRGB, as in 3DGS.
- A prim without SH has primvars:displayColor, linear by default, and displayOpacity if it lacks opacities.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clsplat.arrays import Float32
from clsplat.errors import InputError, examples, warn
from clsplat.files.atomic import atomic_writer, scratch_folder
from clsplat.files.documents import open_input
from clsplat.files.names import native_name
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.images.colour import COLOR_INTEROP_IDS, LINEAR, SRGB, linear_to_srgb, srgb_to_linear
from clsplat.models.codec import axes
from clsplat.models.codec import values as packing
from clsplat.models.edit import merge
from clsplat.models.formats.usd_places import UsdPlacement, find_places

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""File name extensions of USD stages."""
GAUSSIAN_PRIM_TYPE = "ParticleField3DGaussianSplat"
GAUSSIAN_PRIM_TYPES = (GAUSSIAN_PRIM_TYPE, "ParticleField_3DGaussianSplat")
"""Type names of prims with Gaussians. The second is that of a draft of the schema, which Nuke 17.0 uses."""
SH_COEFFICIENTS_ATTRIBUTE, SH_DEGREE_ATTRIBUTE = (
    "radiance:sphericalHarmonicsCoefficients",
    "radiance:sphericalHarmonicsDegree",
)
MAX_TEXT_BRACES = 5000
"""Largest number of opening braces in a text file that is read without a trial in another process. USD's stack of 8 MiB
overflows below 20,000 levels of prims."""
WORLD_PRIM_PATH, GAUSSIANS_PRIM_PATH = "/World", "/World/Gaussians"


def _require_pxr(path: Path) -> None:
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        raise InputError(f"{path}: USD needs usd-core, which is not installed: pip install 'clsplat[usd]'") from None


def recognises(head: bytes) -> bool:
    """True if a file begins like USD text, USD binary, or a zip archive, as .usdz."""
    return head.startswith((b"#usda", b"PXR-USDC", b"PK\x03\x04"))


def survive(path: Path, call: str = "clsplat.models.formats.usd:read_here", **arguments: Any) -> None:
    """Test in another process that USD's library does not crash on a file.

    A damaged file can crash the library, by invalid offsets or a stack overflow. Text files that cannot crash it are
    not tested. Raises InputError if the process crashes, or if usd-core or the file is missing.

    call: MODULE:FUNCTION that the process calls with the path and `arguments`.
    """
    _require_pxr(path)
    with open_input(path, "a USD stage") as file:
        safe, status = _is_safe_text(file), os.fstat(file.fileno())
    words = json.dumps(arguments)
    if not (safe or _lives(call, words, os.path.realpath(path), status.st_mtime_ns, status.st_size)):
        raise InputError(f"{path}: crashes USD's library; is it damaged, or a file that it refers to?")


def _is_safe_text(file: BinaryIO) -> bool:
    """True if a file is USD text that refers to no other file and nests few prims, so that it cannot crash USD."""
    if file.read(5) != b"#usda":
        return False
    levels = 0
    while block := file.read(1 << 20):
        levels += block.count(b"{")
        if b"@" in block or levels > MAX_TEXT_BRACES:
            return False
    return True


@lru_cache(maxsize=32)
def _lives(call: str, arguments: str, path: str, *_: int) -> bool:
    module, function = call.split(":")
    code = (
        f"import json, sys; sys.path[:] = {sys.path!r}; from pathlib import Path; from {module} import {function}; "
        f"{function}(Path(sys.argv[1]), **json.loads(sys.argv[2]))"
    )
    words = [sys.executable, "-c", code, path, arguments]
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    return done.returncode in (0, 1)  # 1 is a Python exception, which the caller will raise too


def describe(path: Path) -> dict[str, Any]:
    """Details of a file for `clsplat info`: the stage's up axis and unit, which do not change the model."""
    survive(path)
    stage = _open(path)
    from pxr import UsdGeom

    with readable(path):
        return {"up_axis": str(UsdGeom.GetStageUpAxis(stage)), "meters_per_unit": UsdGeom.GetStageMetersPerUnit(stage)}


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Context manager: turn errors that USD's bindings raise for damaged names and values into InputError."""
    from pxr import Tf

    try:
        yield
    except (Tf.ErrorException, UnicodeDecodeError, TypeError, ValueError, RuntimeError):
        raise InputError(f"{path}: has values that USD cannot read; is it damaged?") from None


def open_stage(path: Path, name: str | Path, *load: Any) -> Any:
    """Open the file `name` as a USD stage. Raises InputError, prefixed with `path`.

    load: further arguments of `Usd.Stage.Open`, such as whether to load payloads.
    """
    from pxr import Tf, Usd

    with suppress(Tf.ErrorException):
        if stage := Usd.Stage.Open(native_name(name), *load):
            return stage
    raise InputError(f"{path}: cannot be opened as a USD stage; run usdchecker to find out why")


def _open(path: Path) -> Any:
    """Open a stage, but do not load its payloads.

    Raises InputError unless all layers of the stage are in the file's folder or below it.
    """
    from pxr import Ar, Usd, UsdUtils

    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # suppresses the messages that USD would print
    stage = open_stage(path, os.path.realpath(path), Usd.Stage.LoadNone)
    folder = Path(os.path.realpath(path)).parent
    for layer in stage.GetUsedLayers():
        file = Ar.SplitPackageRelativePathOuter(layer.realPath)[0]  # for a layer in a .usdz: the archive itself
        if file and not Path(os.path.realpath(file)).is_relative_to(folder):
            raise InputError(f"{path}: refers to {layer.realPath}, expected layers in the same folder or below it")
    del diagnostics
    return stage


def read(path: Path) -> Gaussians:
    """Read all prims with Gaussians of a stage at its first time code, merged into one model. Raises InputError."""
    survive(path)
    return read_here(path)


def read_here(path: Path) -> Gaussians:
    """Read a stage like `read`, but do not call `survive` first: a damaged file may crash this process."""
    stage = _open(path)
    from pxr import Usd

    time = Usd.TimeCode.EarliestTime()
    parts, read = [], {}
    with readable(path):
        places = splats_of(path, stage)[0]
        space = space_of(path, [place.prim for place in places])
        for place in places:
            where, own = f"{path}: {place.name}", place.prim.GetPath()
            matrix, shown = place.at(time)
            if place.instance is not None and not shown:
                continue
            if own not in read:
                read[own] = gaussians_of(where, place.prim, time, space)
            parts.append(axes.place(read[own], matrix, where))
    if not parts:
        raise InputError(f"{path}: shows no instance of its Gaussians at its first time code, expected at least one")
    return merge(parts)


def splats_of(path: Path, stage: Any) -> tuple[list[UsdPlacement], list[str]]:
    """Placements of all prims with Gaussians in a stage, and descriptions of the prims that clsplat does not draw.

    Raises InputError for a stage without Gaussians.
    """
    places, left = find_places(stage, path, GAUSSIAN_PRIM_TYPES)
    if not places:
        nothing = f"; not drawn: {examples(left)}" if left else ""
        raise InputError(f"{path}: has no {GAUSSIAN_PRIM_TYPE} that is drawn, expected at least one{nothing}")
    return places, left


def recorded_space(path: Path) -> str:
    """Colour space of a stage's Gaussians. Raises InputError."""
    survive(path)
    stage = _open(path)
    with readable(path):
        return space_of(path, [place.prim for place in splats_of(path, stage)[0]])


def space_of(path: Path, prims: Sequence[Any]) -> str:
    """clsplat's name for the colour space of all prims that have SH coefficients; sRGB if no prim has any.

    Raises InputError if the colour spaces of the prims differ.
    """
    spaces: dict[str, object] = {}
    for prim in prims:
        if attribute := _coefficients(prim):
            spaces.setdefault(_space(attribute, SRGB), prim.GetPath())
    if len(spaces) > 1:
        found = ", ".join(f"{name} ({place})" for name, place in spaces.items())
        raise InputError(f"{path}: has Gaussians in the colour spaces {found}, expected one: SH cannot be converted")
    return next(iter(spaces), SRGB)


def _coefficients(prim: Any) -> Any:
    """Attribute of a prim's SH coefficients; None if it has no value."""
    attributes = (prim.GetAttribute(name) for name in (SH_COEFFICIENTS_ATTRIBUTE, f"{SH_COEFFICIENTS_ATTRIBUTE}h"))
    return next((attribute for attribute in attributes if attribute and attribute.HasValue()), None)


def _space(attribute: Any, usual: str) -> str:
    """Return clsplat's name for an attribute's colour space, which the attribute, its prim or an ancestor states.

    usual: the result if none of these states a colour space.
    """
    name, prim = str(attribute.GetColorSpace() if attribute.HasColorSpace() else ""), attribute.GetPrim()
    while not name and prim and not prim.IsPseudoRoot():
        given = prim.GetAttribute("colorSpace:name")
        name, prim = str((given.Get() if given else None) or ""), prim.GetParent()
    ours = {theirs: known for known, theirs in COLOR_INTEROP_IDS.items()}
    return {**ours, "srgb_rec709_display": SRGB}.get(name, name or usual)


def _array(where: str, prim: Any, name: str, time: Any, width: int, count: int | None) -> Float32 | None:
    """Read the values (count, width) of a prim's attribute `name`, or of its half-float variant, whose name ends in h.

    where: prefix of errors. time: USD's time code.
    count: number of rows to return; None returns all rows.
    Returns None if neither attribute has a value. Raises InputError for too few rows, or a wrong dtype or shape.
    """
    for key in (name, f"{name}h"):
        attribute = prim.GetAttribute(key)
        value = attribute.Get(time) if attribute else None
        if value is not None:
            array = np.asarray(value)
            if array.size % width or not np.issubdtype(array.dtype, np.floating):
                expected = "numbers" if width == 1 else f"rows of {width} numbers"
                raise InputError(f"{where}: {key} are {array.dtype} {array.shape}, expected {expected}")
            rows = array.reshape(-1, width)
            if count is not None and len(rows) < count:
                raise InputError(f"{where}: has {len(rows)} {key}, expected {count}")
            return rows[:count].astype(np.float32)
    return None


def gaussians_of(where: str, prim: Any, time: Any, space: str = SRGB) -> Gaussians:
    """Gaussians of a prim at USD's time code `time`, in the prim's own coordinates.

    space: colour space to which displayColor is converted if the prim has no SH.
    Raises InputError, prefixed with `where`.
    """
    means = _array(where, prim, "positions", time, 3, None)
    if means is None or not len(means):
        raise InputError(f"{where}: has no positions, expected at least one")
    count = len(means)
    sh = _sh(where, prim, time, count) if _coefficients(prim) else _plain(where, prim, time, count, space)

    def optional(name: str, *default: float) -> Float32:
        array = _array(where, prim, name, time, len(default), count)
        return np.tile(np.array(default, np.float32), (count, 1)) if array is None else array

    # the schema's defaults: identity rotation, unit scale, opaque
    quaternions = np.ascontiguousarray(optional("orientations", 0, 0, 0, 1)[:, [3, 0, 1, 2]])
    scales = optional("scales", 1, 1, 1)
    shown = _array(where, prim, "opacities", time, 1, count)
    if shown is None and not _coefficients(prim):
        shown = _primvar(where, prim, "primvars:displayOpacity", time, 1, count)
    opacity = np.ones(count, np.float32) if shown is None else shown[:, 0]
    result = Gaussians(means, quaternions, scales, packing.logits_of(opacity, where), sh)
    packing.to_log_scales(result, where)
    return result


def _sh(where: str, prim: Any, time: Any, count: int) -> Float32:
    """SH coefficients (count, K, 3) of a prim with `count` Gaussians, at USD's time code `time`."""
    degree = prim.GetAttribute(SH_DEGREE_ATTRIBUTE).Get() if prim.GetAttribute(SH_DEGREE_ATTRIBUTE) else 3
    if not isinstance(degree, int) or not 0 <= degree <= 16:
        raise InputError(f"{where}: {SH_DEGREE_ATTRIBUTE} is {degree!r}, expected 0 to {MAX_SH_DEGREE}")
    coefficients = (degree + 1) ** 2
    sh = _array(where, prim, SH_COEFFICIENTS_ATTRIBUTE, time, 3, count * coefficients)
    if sh is None:
        raise InputError(f"{where}: lacks {SH_COEFFICIENTS_ATTRIBUTE}")
    sh = sh.reshape(count, coefficients, 3)
    if degree > MAX_SH_DEGREE:
        warn(f"{where}: has SH of degree {degree}; coefficients above degree {MAX_SH_DEGREE} are left out")
        sh = np.ascontiguousarray(sh[:, : (MAX_SH_DEGREE + 1) ** 2])
    return sh


def _plain(where: str, prim: Any, time: Any, count: int, space: str) -> Float32:
    """SH coefficients (count, 1, 3) of a prim without SH, from its displayColor; grey without displayColor.

    time: USD's time code. space: colour space to which displayColor is converted.
    Raises InputError if the colours cannot be converted to that space.
    """
    colour = _primvar(where, prim, "primvars:displayColor", time, 3, count)
    if colour is None:
        return np.zeros((count, 1, 3), np.float32)
    own = _space(prim.GetAttribute("primvars:displayColor"), LINEAR)
    if own != space:
        convert = {(LINEAR, SRGB): linear_to_srgb, (SRGB, LINEAR): srgb_to_linear}.get((own, space))
        if convert is None:
            raise InputError(f"{where}: has displayColor in {own}, expected {space} like the other Gaussians")
        colour = convert(colour)
    return np.asarray(packing.coefficients(colour)[:, None], np.float32)


def _primvar(where: str, prim: Any, name: str, time: Any, width: int, count: int) -> Float32 | None:
    """Values (count, width) of the primvar `name` at USD's time code `time`; None if the primvar has no value.

    A single value is repeated for all Gaussians. Raises InputError if there are neither one nor `count` values.
    """
    attribute = prim.GetAttribute(name)
    value = attribute.Get(time) if attribute else None
    if value is None or not len(value):
        return None
    rows = np.asarray(value, np.float32).reshape(-1, width)
    if len(rows) not in (1, count):
        raise InputError(f"{where}: has {len(rows)} {name}, expected {count} or one")
    return np.tile(rows, (count // len(rows), 1))


def write(path: Path, gaussians: Gaussians, *, up_axis: str = "Y", meters_per_unit: float = 1.0) -> None:
    """Write a stage with one prim of Gaussians, atomically; .usd is written as binary.

    up_axis, meters_per_unit: metadata of the stage, which do not change the coordinates. The up axis is Y or Z.
    Raises InputError for non-finite values, and if usd-core is not installed.
    """
    if up_axis not in ("Y", "Z") or not meters_per_unit > 0:
        raise ValueError(f"up_axis is {up_axis!r}, meters_per_unit {meters_per_unit}, expected Y or Z, and more than 0")
    packing.check_writable(path, gaussians, least=1)
    _require_pxr(path)
    from pxr import Usd, UsdUtils

    suffix = path.suffix.lower()
    with scratch_folder(4 * sum(array.size for array in gaussians.arrays().values())) as folder:
        made = folder / ("gaussians.usdc" if suffix == ".usdz" else f"gaussians{suffix}")
        stage = Usd.Stage.CreateNew(native_name(made))
        _author(stage, gaussians, up_axis, meters_per_unit)
        stage.GetRootLayer().Save()
        del stage
        if suffix == ".usdz":
            package = folder / "gaussians.usdz"
            if not UsdUtils.CreateNewUsdzPackage(native_name(made), native_name(package)):
                raise OSError(f"{path}: USD could not make the package")
            made = package
        with atomic_writer(path, made.stat().st_size) as file, made.open("rb") as source:
            shutil.copyfileobj(source, file, 1 << 20)


def _author(stage: Any, gaussians: Gaussians, up_axis: str, meters_per_unit: float) -> None:
    from pxr import Gf, Sdf, UsdGeom, Vt

    UsdGeom.SetStageUpAxis(stage, up_axis)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    world = UsdGeom.Xform.Define(stage, WORLD_PRIM_PATH)
    stage.SetDefaultPrim(world.GetPrim())
    if gaussians.origin.any():
        world.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*gaussians.origin.tolist()))
    prim = stage.DefinePrim(GAUSSIANS_PRIM_PATH, GAUSSIAN_PRIM_TYPE)
    types = Sdf.ValueTypeNames
    scales = np.exp(np.clip(gaussians.log_scales, -103.0, 88.0))
    unit = packing.unit_quaternions(gaussians.quaternions).astype(np.float32)
    reach = 3 * scales.max(axis=1, keepdims=True)
    extent = np.stack([(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)])
    vectors, floats = Vt.Vec3fArray, Vt.FloatArray
    for name, kind, array, values in (
        ("positions", types.Point3fArray, vectors, gaussians.means),
        ("orientations", types.QuatfArray, Vt.QuatfArray, unit[:, [1, 2, 3, 0]]),
        ("scales", types.Float3Array, vectors, scales),
        ("opacities", types.FloatArray, floats, packing.opacities(gaussians.opacity_logits).astype(np.float32)),
        (SH_COEFFICIENTS_ATTRIBUTE, types.Float3Array, vectors, gaussians.sh.reshape(-1, 3)),
        ("extent", types.Float3Array, vectors, extent.astype(np.float32)),
    ):
        attribute = prim.CreateAttribute(name, kind, custom=False)
        attribute.Set(array.FromNumpy(np.ascontiguousarray(values)))
    uniform = Sdf.VariabilityUniform
    prim.CreateAttribute(SH_DEGREE_ATTRIBUTE, types.Int, False, uniform).Set(gaussians.sh_degree)
    prim.CreateAttribute("projectionModeHint", types.Token, False, uniform).Set("perspective")
    prim.CreateAttribute("sortingModeHint", types.Token, False, uniform).Set("zDepth")
