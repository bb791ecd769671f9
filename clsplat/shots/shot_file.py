# SPDX-License-Identifier: Apache-2.0
"""Shot files, clsplat's own JSON format for several moving models (docs/shot.md), and the parser of `--transform`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.errors import InputError
from clsplat.files.documents import is_file, load_document, parse_json, read_document
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.models.codec.axes import NODE_SIMILARITY_TOLERANCE
from clsplat.models.instances import IDENTITY_ROWS, Placement, Track, checked, grade, rows_of
from clsplat.models.mesh import Mesh, read_mesh
from clsplat.scenes.camera_json import Keys, objects, short

SHOT_VERSION_KEY, SHOT_VERSION = "clsplat_shot", 1
EXPECTED_SHOT_FILE = f"a shot of several models (.json, with '{SHOT_VERSION_KEY}')"
VECTOR_PROPERTIES = {
    "translate": (0.0, 0.0, 0.0),
    "rotate": (0.0, 0.0, 0.0),
    "gain": (1.0, 1.0, 1.0),
    "offset": (0.0, 0.0, 0.0),
}
SCALAR_PROPERTIES = {"scale": 1.0, "opacity": 1.0, "saturation": 1.0}
ANIMATED_PROPERTIES = ("matrix", *VECTOR_PROPERTIES, *SCALAR_PROPERTIES, "visible")
"""Properties of a model that may change over time."""
TRANSFORM_PROPERTIES = ("matrix", "translate", "rotate", "scale")
"""Properties that set a model's position, orientation and size."""
MODEL_PROPERTIES = ("name", "path", "mattes", "keys", "matrices", "first_frame", "interpolation", *ANIMATED_PROPERTIES)
PROPERTY_BOUNDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "scale": (lambda value: edit.TRANSFORM_SCALE_LIMITS[0] < value < edit.TRANSFORM_SCALE_LIMITS[1], "a number over 0"),
    "opacity": (lambda value: 0 <= value <= 1, "0 to 1"),
    "saturation": (lambda value: value >= 0, "at least 0"),
    "gain": (lambda value: min(value) >= 0, "three numbers of at least 0"),
}
MAX_TRANSFORM_BYTES = 64 << 20
_TRANSFORM_STEPS: dict[str, tuple[int, Callable[[list[float]], Float64]]] = {
    "translate": (3, edit.shifting),
    "rotate": (3, edit.turning),
    "scale": (1, lambda values: edit.scaling(values[0])),
}
"""Steps of --transform, each with its number of values and the function that makes a matrix from them."""


@dataclass(frozen=True, eq=False)
class AnimatedProperty:
    """An animated property: frames (k,) of its keys in increasing order, and its values (k, d) at the keys."""

    frames: Float64
    values: Float64

    def at(self, frame: float, *, held: bool) -> Float64:
        """Value (d,) at a frame, interpolated linearly between keys.

        held: True to take the value of the latest key instead; before the first key, the first key's value.
        """
        if held:
            return np.asarray(self.values[max(int(np.searchsorted(self.frames, frame, side="right")) - 1, 0)])
        return np.array([np.interp(frame, self.frames, column) for column in self.values.T])


@dataclass(frozen=True, eq=False)
class KeyedTrack:
    """Placement of a model over time (`Track`), from key frames.

    where: prefix of error messages.
    channels: the model's animated properties by name; properties that are missing have their defaults.
    held: True if values stay the same from key to key. Otherwise they are interpolated linearly, and matrices by scale,
      rotation and translation.
    """

    where: str
    channels: dict[str, AnimatedProperty] = field(default_factory=dict)
    held: bool = False

    def at(self, frame: float) -> Placement:
        """Return the placement at a frame; before the first key and after the last, the nearest key's placement."""

        def value(name: str, *default: float, held: bool = self.held) -> Float64:
            channel = self.channels.get(name)
            return np.array(default) if channel is None else channel.at(frame, held=held)

        visible = float(value("visible", 1.0, held=True)[0])
        opacity = visible * float(value("opacity", 1.0)[0])
        colour = grade(value("gain", 1, 1, 1), value("offset", 0, 0, 0), float(value("saturation", 1.0)[0]))
        return Placement(self._matrix(frame, value), opacity, colour)

    @property
    def reach(self) -> tuple[float, float] | None:
        """Frames of the first and the last key that move the model; None if nothing moves it.

        If `held` is True, these are minus and plus infinity, because the model is never extrapolated.
        """
        if self.held:
            return -math.inf, math.inf
        moving = [
            channel for name in TRANSFORM_PROPERTIES if (channel := self.channels.get(name)) and len(channel.frames) > 1
        ]
        frames = [float(frame) for channel in moving for frame in channel.frames[[0, -1]]]
        return (min(frames), max(frames)) if frames else None

    def _matrix(self, frame: float, value: Callable[..., Float64]) -> tuple[float, ...]:
        if (channel := self.channels.get("matrix")) is not None:
            return rows_of(_between(channel, frame, held=self.held))
        if not set(TRANSFORM_PROPERTIES) & self.channels.keys():
            return IDENTITY_ROWS
        scale = float(value("scale", 1.0)[0])
        turned = edit.turning(value("rotate", 0, 0, 0).tolist())
        return rows_of(edit.shifting(value("translate", 0, 0, 0).tolist()) @ turned @ edit.scaling(scale))


def _between(channel: AnimatedProperty, frame: float, *, held: bool) -> Float64:
    """Return the matrix (4, 4) at a frame, interpolated between keys; at a key, it is the key's matrix.

    Translation and the logarithm of the scale are interpolated linearly, rotation along the shorter arc.

    channel: the animated property "matrix". held: True takes the matrix of the latest key instead.
    """
    frames, matrices = channel.frames, channel.values.reshape(-1, 4, 4)
    after = int(np.searchsorted(frames, frame, side="right"))
    if held or after in (0, len(frames)) or frames[after - 1] == frame:
        return np.asarray(matrices[max(after - 1, 0)])
    from scipy.spatial.transform import Rotation

    share = (frame - frames[after - 1]) / (frames[after] - frames[after - 1])
    (scale, turn, shift), (scale_after, turn_after, shift_after) = (
        edit.decompose(matrices[index], NODE_SIMILARITY_TOLERANCE) for index in (after - 1, after)
    )
    # turn_after turn^T is a rotation, even if both factors mirror
    way = Rotation.from_matrix(turn_after @ turn.T).as_rotvec()
    matrix = np.eye(4)
    size = scale ** (1 - share) * scale_after**share
    matrix[:3, :3] = size * Rotation.from_rotvec(share * way).as_matrix() @ turn
    matrix[:3, 3] = (1 - share) * shift + share * shift_after
    return matrix


@dataclass(frozen=True, eq=False)
class Within:
    """Placement over time (`Track`) of a model in a group.

    inner: the model's placement in the group. outer: the group's placement.
    """

    inner: Track
    outer: Track

    def at(self, frame: float) -> Placement:
        """Return the placement by the track `inner`, transformed by the placement by `outer`."""
        return self.inner.at(frame).within(self.outer.at(frame))

    @property
    def reach(self) -> tuple[float, float] | None:
        """First and last frame for which the source of either track has data; None if both placements are static."""
        ends = [reach for track in (self.inner, self.outer) if (reach := track.reach)]
        return (min(first for first, _ in ends), max(last for _, last in ends)) if ends else None


VOLUME_KINDS = ("box", "sphere", "mesh")
"""Kinds of a volume, which are also the names of the properties that define it."""


@dataclass(frozen=True)
class Volume:
    """A region of a model with its own matte, in the model's world: a box, a sphere, or the inside of a mesh.

    numbers: corners with the least and the largest coordinates of a box (6), or centre and radius of a sphere (4).
      Empty for a mesh.
    """

    name: str
    numbers: tuple[float, ...] = ()
    mesh: Mesh | None = None

    def holds(self, gaussians: Gaussians) -> NDArray[np.bool_]:
        """Mask (n,), True for Gaussians whose mean is inside the region."""
        if self.mesh is not None:
            return self.mesh.holds(gaussians.means + gaussians.origin)
        if len(self.numbers) == 6:
            return edit.in_box(gaussians, self.numbers[:3], self.numbers[3:])
        return edit.in_sphere(gaussians, self.numbers[:3], self.numbers[3])


@dataclass(frozen=True, eq=False)
class PlacedModel:
    """A model of a shot.

    path: model file or run folder.
    volumes: regions with their own mattes; a Gaussian in several of them belongs to the first.
    """

    name: str
    path: Path
    track: KeyedTrack
    volumes: tuple[Volume, ...] = ()


def is_layout(path: Path) -> bool:
    """Return True if a path has the name of a shot file: any .json except meta.json, which is a model file."""
    return path.suffix.lower() == ".json" and path.name.lower() != "meta.json"


def read_layout(path: Path) -> tuple[PlacedModel, ...]:
    """Read the models of a shot file, in file order. Paths are relative to the file's folder.

    Raises InputError, naming the file and the model, for another version, no models, duplicate or unknown names, and
    missing or invalid values.
    """
    document = load_document(path, EXPECTED_SHOT_FILE, f"'{SHOT_VERSION_KEY}'")
    if document.get(SHOT_VERSION_KEY) != SHOT_VERSION:
        raise InputError(
            f"{path}: '{SHOT_VERSION_KEY}' is {short(document.get(SHOT_VERSION_KEY))}, expected {SHOT_VERSION}: "
            f"{EXPECTED_SHOT_FILE}"
        )
    _known(str(path), document, (SHOT_VERSION_KEY, "models"))
    if not (entries := objects(document, "models")):
        raise InputError(f"{path}: has no models, expected 'models' to be a list of at least one object")
    models: list[PlacedModel] = []
    taken: list[str] = []
    for index, entry in enumerate(entries):
        reader = Keys(path, f"model {index}", entry, {})
        name = _text(reader, "name")
        reader.where = f"{path}: model '{name}'"
        if name in taken:
            raise InputError(f"{reader.where}: has a name that is used twice, expected unique names")
        _known(reader.where, entry, MODEL_PROPERTIES)
        volumes = tuple(_volumes(reader))
        taken += [name, *(volume.name for volume in volumes)]
        if twice := next((each for each in taken if taken.count(each) > 1), None):
            raise InputError(f"{reader.where}: has the matte '{twice}', a name that is used twice")
        models.append(PlacedModel(name, path.parent / _text(reader, "path"), _track(reader), volumes))
    return tuple(models)


def _volumes(reader: Keys) -> Iterator[Volume]:
    given = reader.frame.get("mattes")
    entries = objects(reader.frame, "mattes")
    if given is not None and not entries:
        raise reader.wrong("mattes", "a list of at least one object with a name and a box, a sphere or a mesh")
    for index, entry in enumerate(entries):
        volume = Keys(reader.path, None, entry, {})
        volume.where = f"{reader.where}: matte {index}"
        _known(volume.where, entry, ("name", *VOLUME_KINDS))
        name = _text(volume, "name")
        kinds = [kind for kind in VOLUME_KINDS if kind in entry]
        if len(kinds) != 1:
            found = " and ".join(kinds) or "no region"
            raise InputError(f"{volume.where}: has {found}, expected exactly one of 'box', 'sphere' and 'mesh'")
        (kind,) = kinds
        if kind == "mesh":
            yield Volume(name, mesh=read_mesh(reader.path.parent / _text(volume, "mesh")))
            continue
        count = 6 if kind == "box" else 4
        numbers = volume.vector(kind, count).tolist()
        if kind == "box" and any(low > high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
            raise volume.wrong(kind, "the least x, y and z, then the largest")
        if kind == "sphere" and numbers[3] < 0:
            raise volume.wrong(kind, "x, y, z and a radius of at least 0")
        yield Volume(name, tuple(numbers))


def parse_transform(text: str) -> KeyedTrack:
    """Parse --transform: 16 numbers, a file of them, a JSON file with keys or matrices, or steps.

    Steps, such as 'rotate=0,90,0 scale=2 translate=1,0,0', are applied in their order. Raises InputError.
    """
    where = f"--transform {text[:80]}"
    if is_file(Path(text)):
        words = read_document(Path(text), "16 numbers, or JSON with keys or matrices", MAX_TRANSFORM_BYTES)
        if words.lstrip()[:1] == "{":
            reader = Keys(Path(text), None, _object(Path(text), words), {})
            names = tuple(name for name in MODEL_PROPERTIES if name not in ("name", "path", "mattes"))
            _known(reader.where, reader.frame, names)
            return _track(reader)
        where = f"--transform {text}"
    elif "=" in text:
        matrix = np.eye(4)
        for word in text.replace(";", " ").split():
            name, _, values = word.partition("=")
            if name not in _TRANSFORM_STEPS:
                raise InputError(f"{where}: '{name}' is not known, expected steps of {', '.join(_TRANSFORM_STEPS)}")
            count, step = _TRANSFORM_STEPS[name]
            matrix = step(_numbers(where, values, count)) @ matrix
        return _constant(where, matrix)
    elif Path(text).suffix.lower() in (".json", ".txt"):
        raise InputError(f"{where}: no such file, expected a matrix, or JSON with keys or matrices")
    else:
        words = text
    return _constant(where, np.array(_numbers(where, words, 16)).reshape(4, 4))


def _object(path: Path, text: str) -> dict[str, Any]:
    try:
        document = parse_json(text, once=True)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}; expected keys or matrices of a transform") from None
    assert isinstance(document, dict)
    return document


def _constant(where: str, matrix: Float64) -> KeyedTrack:
    track = KeyedTrack(where, {"matrix": AnimatedProperty(np.zeros(1), matrix.reshape(1, 16))})
    checked(track.at(0), where)
    return track


def _numbers(where: str, text: str, count: int) -> list[float]:
    words = text.translate(str.maketrans("[],;", "    ")).split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        expected = f"{count} numbers with commas" if count > 1 else "one number, the same scale in all directions"
        raise InputError(f"{where}: expected {expected}, found {short(text.strip())}")
    return values


def _text(reader: Keys, key: str) -> str:
    value = reader.get(key)
    if not isinstance(value, str) or not value.strip():
        raise reader.wrong(key, "text")
    return value


def _known(where: str, values: dict[str, Any], names: tuple[str, ...]) -> None:
    for name in values:
        if name not in names:
            raise InputError(f"{where}: '{name}' is not known here, expected one of {', '.join(names)}")


def _track(reader: Keys) -> KeyedTrack:
    """Read a model's properties over time from a JSON object: properties for all frames, 'keys' and 'matrices'."""
    interpolation = reader.frame.get("interpolation", "linear")
    if interpolation not in ("linear", "hold"):
        raise reader.wrong("interpolation", "linear or hold")
    rows = {name: [(0.0, _value(reader, name))] for name in ANIMATED_PROPERTIES if reader.frame.get(name) is not None}
    constant = set(rows)
    for frame, key in _keys(reader):
        for name in ANIMATED_PROPERTIES:
            if key.get(name) is None:
                continue
            if name in constant:
                raise InputError(f"{reader.where}: has '{name}' for all frames and in keys, expected only one of these")
            rows.setdefault(name, []).append((frame, _value(key, name)))
    if reader.frame.get("matrices") is not None:
        if "matrix" in rows:
            raise InputError(f"{reader.where}: has 'matrices' and 'matrix', expected only one of these")
        rows["matrix"] = list(_matrices(reader))
    elif reader.frame.get("first_frame") is not None:
        raise InputError(f"{reader.where}: has 'first_frame' without 'matrices', expected both")
    if "matrix" in rows and (others := {"translate", "rotate", "scale"} & rows.keys()):
        raise InputError(f"{reader.where}: has a matrix and '{min(others)}', expected one or the other")
    channels = {name: _channel(keyed) for name, keyed in rows.items()}
    track = KeyedTrack(reader.where, channels, interpolation == "hold")
    if "matrix" in channels:
        for frame in channels["matrix"].frames.tolist():
            checked(track.at(frame), f"{reader.where}: frame {frame:g}")
    return track


def _channel(keyed: list[tuple[float, Float64]]) -> AnimatedProperty:
    keyed = sorted(keyed, key=lambda row: row[0])
    return AnimatedProperty(np.array([frame for frame, _ in keyed]), np.stack([value for _, value in keyed]))


def _keys(reader: Keys) -> Iterator[tuple[float, Keys]]:
    given = reader.frame.get("keys")
    entries = objects(reader.frame, "keys")
    if given is not None and not entries:
        raise InputError(f"{reader.where}: has no keys, expected 'keys' to be a list of at least one object")
    frames = []
    for index, entry in enumerate(entries):
        key = Keys(reader.path, None, entry, {})
        key.where = f"{reader.where}: key {index}"
        _known(key.where, entry, ("frame", *ANIMATED_PROPERTIES))
        frames.append(key.require("frame"))
        yield frames[-1], key
    for before, after in pairwise(sorted(frames)):
        if before == after:
            raise InputError(f"{reader.where}: has two keys at frame {after:g}, expected one")


def _matrices(reader: Keys) -> Iterator[tuple[float, Float64]]:
    """Yield the frame number and matrix (16,) of each entry of 'matrices', one per frame from 'first_frame' on."""
    first, given = reader.require("first_frame", 1.0), reader.frame["matrices"]
    if not isinstance(given, list) or not given:
        raise reader.wrong("matrices", "a list of matrices of 16 numbers, one per frame")
    for index, matrix in enumerate(given):
        entry = Keys(reader.path, None, {"matrix": matrix}, {})
        entry.where = f"{reader.where}: frame {first + index:g}"
        yield first + index, _matrix(entry)


def _matrix(reader: Keys) -> Float64:
    """Read the matrix (16,) of a JSON object: 16 numbers, or four rows of four. Raises InputError."""
    given = reader.frame["matrix"]
    if isinstance(given, list) and len(given) == 4 and all(isinstance(row, list) for row in given):
        reader.frame = {"matrix": [value for row in given for value in row]}
    return reader.vector("matrix", 16)


def _value(reader: Keys, name: str) -> Float64:
    """Read the value (d,) of the animated property `name` in a JSON object. Raises InputError."""
    if name == "matrix":
        return _matrix(reader)
    if name == "visible":
        if not isinstance(value := reader.get(name), bool):
            raise reader.wrong(name, "true or false")
        return np.array([float(value)])
    values = reader.vector(name, 3) if name in VECTOR_PROPERTIES else np.array([reader.require(name)])
    if name in PROPERTY_BOUNDS:
        fits, expected = PROPERTY_BOUNDS[name]
        if not fits(values.tolist() if name in VECTOR_PROPERTIES else float(values[0])):
            raise reader.wrong(name, expected)
    return values
