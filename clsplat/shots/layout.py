# SPDX-License-Identifier: Apache-2.0
"""Several models in a shot, and how a model moves: clsplat's own JSON, described in docs/shot.md, and `--transform`."""

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
from clsplat.files import is_file, parse_json, read_document
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.models.mesh import Mesh, read_mesh
from clsplat.models.placed import IDENTITY, Placement, Track, checked, grade, rows_of
from clsplat.scenes.camera_json import Keys, load_document, objects, short

VERSION_KEY, VERSION = "clsplat_shot", 1
EXPECTED = f"a shot of several models (.json, with '{VERSION_KEY}')"
VECTORS = {"translate": (0.0, 0.0, 0.0), "rotate": (0.0, 0.0, 0.0), "gain": (1.0, 1.0, 1.0), "offset": (0.0, 0.0, 0.0)}
NUMBERS = {"scale": 1.0, "opacity": 1.0, "saturation": 1.0}
OVER_TIME = ("matrix", *VECTORS, *NUMBERS, "visible")
"""Properties of a model that may change over time."""
MOVING = ("matrix", "translate", "rotate", "scale")
"""Those of them that say where it is."""
MODEL = ("name", "path", "mattes", "keys", "matrices", "first_frame", "interpolation", *OVER_TIME)
BOUNDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "scale": (lambda value: edit.SCALES[0] < value < edit.SCALES[1], "a number over 0"),
    "opacity": (lambda value: 0 <= value <= 1, "0 to 1"),
    "saturation": (lambda value: value >= 0, "at least 0"),
    "gain": (lambda value: min(value) >= 0, "three numbers of at least 0"),
}
MOST_BYTES = 64 << 20
_STEPS: dict[str, tuple[int, Callable[[list[float]], Float64]]] = {
    "translate": (3, edit.shifting),
    "rotate": (3, edit.turning),
    "scale": (1, lambda values: edit.scaling(values[0])),
}
"""Words of --transform: how many numbers each takes, and the matrix of these."""


@dataclass(frozen=True, eq=False)
class Channel:
    """A property over time: frames (k,), which rise, and values (k, d)."""

    frames: Float64
    values: Float64

    def at(self, frame: float, *, held: bool) -> Float64:
        """(d,): on the straight line between the keys around the frame; held: of the last key, which also goes before
        the first one."""
        if held:
            return np.asarray(self.values[max(int(np.searchsorted(self.frames, frame, side="right")) - 1, 0)])
        return np.array([np.interp(frame, self.frames, column) for column in self.values.T])


@dataclass(frozen=True, eq=False)
class KeyedTrack:
    """A `Track` by keys. channels: the properties that are given, by name; held: from key to key, else in straight
    lines, matrices by scale, rotation and translation."""

    where: str
    channels: dict[str, Channel] = field(default_factory=dict)
    held: bool = False

    def at(self, frame: float) -> Placement:
        """The placement at a frame, before the first and after the last key that key's."""

        def value(name: str, *default: float, held: bool = self.held) -> Float64:
            channel = self.channels.get(name)
            return np.array(default) if channel is None else channel.at(frame, held=held)

        visible = float(value("visible", 1.0, held=True)[0])
        opacity = visible * float(value("opacity", 1.0)[0])
        colour = grade(value("gain", 1, 1, 1), value("offset", 0, 0, 0), float(value("saturation", 1.0)[0]))
        return Placement(self._matrix(frame, value), opacity, colour)

    @property
    def reach(self) -> tuple[float, float] | None:
        """The first and the last key of where it is; a model that is held from key to key goes on nowhere by itself."""
        if self.held:
            return -math.inf, math.inf
        moving = [channel for name in MOVING if (channel := self.channels.get(name)) and len(channel.frames) > 1]
        frames = [float(frame) for channel in moving for frame in channel.frames[[0, -1]]]
        return (min(frames), max(frames)) if frames else None

    def _matrix(self, frame: float, value: Callable[..., Float64]) -> tuple[float, ...]:
        if (channel := self.channels.get("matrix")) is not None:
            return rows_of(_between(channel, frame, held=self.held))
        if not set(MOVING) & self.channels.keys():
            return IDENTITY
        scale = float(value("scale", 1.0)[0])
        turned = edit.turning(value("rotate", 0, 0, 0).tolist())
        return rows_of(edit.shifting(value("translate", 0, 0, 0).tolist()) @ turned @ edit.scaling(scale))


def _between(channel: Channel, frame: float, *, held: bool) -> Float64:
    """(4, 4) from matrices: at a key its own, between two the translation and the logarithm of the scale in a straight
    line, and the rotation the shorter way around."""
    frames, matrices = channel.frames, channel.values.reshape(-1, 4, 4)
    after = int(np.searchsorted(frames, frame, side="right"))
    if held or after in (0, len(frames)) or frames[after - 1] == frame:
        return np.asarray(matrices[max(after - 1, 0)])
    from scipy.spatial.transform import Rotation

    share = (frame - frames[after - 1]) / (frames[after] - frames[after - 1])
    (scale, turn, shift), (scale_after, turn_after, shift_after) = (
        edit.decompose(matrices[index], SLACK) for index in (after - 1, after)
    )
    # of two mirrors, too, one goes into the other by a rotation
    way = Rotation.from_matrix(turn_after @ turn.T).as_rotvec()
    matrix = np.eye(4)
    size = scale ** (1 - share) * scale_after**share
    matrix[:3, :3] = size * Rotation.from_rotvec(share * way).as_matrix() @ turn
    matrix[:3, 3] = (1 - share) * shift + share * shift_after
    return matrix


SLACK = 1e-4
"""Most that axes may be off right angles or equal lengths, as of a node."""


@dataclass(frozen=True, eq=False)
class Within:
    """A `Track` that is in another, which is placed as well."""

    inner: Track
    outer: Track

    def at(self, frame: float) -> Placement:
        """The placement of the inner in the outer."""
        return self.inner.at(frame).within(self.outer.at(frame))

    @property
    def reach(self) -> tuple[float, float] | None:
        """The first and the last frame at which one of both says where it is."""
        ends = [reach for track in (self.inner, self.outer) if (reach := track.reach)]
        return (min(first for first, _ in ends), max(last for _, last in ends)) if ends else None


VOLUMES = ("box", "sphere", "mesh")
"""Kinds of a volume, the properties that say it."""


@dataclass(frozen=True)
class Volume:
    """A part of a model that has a matte of its own, in the model's world: a box, two corners, or a sphere, its centre
    and its radius; or what is in a mesh."""

    name: str
    numbers: tuple[float, ...] = ()
    mesh: Mesh | None = None

    def holds(self, gaussians: Gaussians) -> NDArray[np.bool_]:
        """Mask (n,) of the Gaussians whose mean is in it."""
        if self.mesh is not None:
            return self.mesh.holds(gaussians.means + gaussians.origin)
        if len(self.numbers) == 6:
            return edit.in_box(gaussians, self.numbers[:3], self.numbers[3:])
        return edit.in_sphere(gaussians, self.numbers[:3], self.numbers[3])


@dataclass(frozen=True, eq=False)
class PlacedModel:
    """A model of a shot. path: of its file or run; volumes: those of its Gaussians that have mattes of their own, of
    several the first."""

    name: str
    path: Path
    track: KeyedTrack
    volumes: tuple[Volume, ...] = ()


def is_layout(path: Path) -> bool:
    """True for the name of a shot of several models, which JSON is but for a model's own."""
    return path.suffix.lower() == ".json" and path.name.lower() != "meta.json"


def read_layout(path: Path) -> tuple[PlacedModel, ...]:
    """The models of a shot, in the order of the file; paths are taken from its folder.

    Raises InputError, with the file and the model, for another version, no models, names that are there twice or not
    known, and values that are missing or cannot be.
    """
    document = load_document(path, EXPECTED, f"'{VERSION_KEY}'")
    if document.get(VERSION_KEY) != VERSION:
        raise InputError(
            f"{path}: '{VERSION_KEY}' is {short(document.get(VERSION_KEY))}, expected {VERSION}: {EXPECTED}"
        )
    _known(str(path), document, (VERSION_KEY, "models"))
    if not (entries := objects(document, "models")):
        raise InputError(f"{path}: has no models, expected 'models' to be a list of at least one object")
    models: list[PlacedModel] = []
    taken: list[str] = []
    for index, entry in enumerate(entries):
        reader = Keys(path, f"model {index}", entry, {})
        name = _text(reader, "name")
        reader.where = f"{path}: model '{name}'"
        if name in taken:
            raise InputError(f"{reader.where}: is there twice, expected names of their own")
        _known(reader.where, entry, MODEL)
        volumes = tuple(_volumes(reader))
        taken += [name, *(volume.name for volume in volumes)]
        if twice := next((each for each in taken if taken.count(each) > 1), None):
            raise InputError(f"{reader.where}: has the matte '{twice}', of a name that is there twice")
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
        _known(volume.where, entry, ("name", *VOLUMES))
        name = _text(volume, "name")
        kinds = [kind for kind in VOLUMES if kind in entry]
        if len(kinds) != 1:
            raise InputError(f"{volume.where}: expected a 'box', a 'sphere' or a 'mesh', and one of them only")
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
    """--transform: 16 numbers, a file of them, a JSON file with keys or matrices, or steps such as
    'rotate=0,90,0 scale=2 translate=1,0,0', which are made in their order. Raises InputError."""
    where = f"--transform {text[:80]}"
    if is_file(Path(text)):
        words = read_document(Path(text), "16 numbers, or JSON with keys or matrices", MOST_BYTES)
        if words.lstrip()[:1] == "{":
            reader = Keys(Path(text), None, _object(Path(text), words), {})
            names = tuple(name for name in MODEL if name not in ("name", "path", "mattes"))
            _known(reader.where, reader.frame, names)
            return _track(reader)
        where = f"--transform {text}"
    elif "=" in text:
        matrix = np.eye(4)
        for word in text.replace(";", " ").split():
            name, _, values = word.partition("=")
            if name not in _STEPS:
                raise InputError(f"{where}: '{name}' is not known, expected steps of {', '.join(_STEPS)}")
            count, step = _STEPS[name]
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
    track = KeyedTrack(where, {"matrix": Channel(np.zeros(1), matrix.reshape(1, 16))})
    checked(track.at(0), where)
    return track


def _numbers(where: str, text: str, count: int) -> list[float]:
    words = text.translate(str.maketrans("[],;", "    ")).split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        expected = f"{count} numbers with commas" if count > 1 else "one number: a model has the same in all directions"
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
    """The properties of an object: those that it has itself, for all frames, and those of its keys."""
    interpolation = reader.frame.get("interpolation", "linear")
    if interpolation not in ("linear", "hold"):
        raise reader.wrong("interpolation", "linear or hold")
    rows = {name: [(0.0, _value(reader, name))] for name in OVER_TIME if reader.frame.get(name) is not None}
    constant = set(rows)
    for frame, key in _keys(reader):
        for name in OVER_TIME:
            if key.get(name) is None:
                continue
            if name in constant:
                raise InputError(f"{reader.where}: has '{name}' for all frames and in keys, expected one of both")
            rows.setdefault(name, []).append((frame, _value(key, name)))
    if reader.frame.get("matrices") is not None:
        if "matrix" in rows:
            raise InputError(f"{reader.where}: has 'matrices' and 'matrix', expected one of both")
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


def _channel(keyed: list[tuple[float, Float64]]) -> Channel:
    keyed = sorted(keyed, key=lambda row: row[0])
    return Channel(np.array([frame for frame, _ in keyed]), np.stack([value for _, value in keyed]))


def _keys(reader: Keys) -> Iterator[tuple[float, Keys]]:
    given = reader.frame.get("keys")
    entries = objects(reader.frame, "keys")
    if given is not None and not entries:
        raise InputError(f"{reader.where}: has no keys, expected 'keys' to be a list of at least one object")
    frames = []
    for index, entry in enumerate(entries):
        key = Keys(reader.path, None, entry, {})
        key.where = f"{reader.where}: key {index}"
        _known(key.where, entry, ("frame", *OVER_TIME))
        frames.append(key.require("frame"))
        yield frames[-1], key
    for before, after in pairwise(sorted(frames)):
        if before == after:
            raise InputError(f"{reader.where}: has two keys at frame {after:g}, expected one")


def _matrices(reader: Keys) -> Iterator[tuple[float, Float64]]:
    """A matrix for each frame from 'first_frame' on."""
    first, given = reader.require("first_frame", 1.0), reader.frame["matrices"]
    if not isinstance(given, list) or not given:
        raise reader.wrong("matrices", "a list of matrices of 16 numbers, one a frame")
    for index, matrix in enumerate(given):
        entry = Keys(reader.path, None, {"matrix": matrix}, {})
        entry.where = f"{reader.where}: frame {first + index:g}"
        yield first + index, _matrix(entry)


def _matrix(reader: Keys) -> Float64:
    """(16,) of 16 numbers, or of four rows of four."""
    given = reader.frame["matrix"]
    if isinstance(given, list) and len(given) == 4 and all(isinstance(row, list) for row in given):
        reader.frame = {"matrix": [value for row in given for value in row]}
    return reader.vector("matrix", 16)


def _value(reader: Keys, name: str) -> Float64:
    """(d,) of a property. Raises InputError."""
    if name == "matrix":
        return _matrix(reader)
    if name == "visible":
        if not isinstance(value := reader.get(name), bool):
            raise reader.wrong(name, "true or false")
        return np.array([float(value)])
    values = reader.vector(name, 3) if name in VECTORS else np.array([reader.require(name)])
    if name in BOUNDS:
        fits, expected = BOUNDS[name]
        if not fits(values.tolist() if name in VECTORS else float(values[0])):
            raise reader.wrong(name, expected)
    return values
