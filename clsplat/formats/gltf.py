# SPDX-License-Identifier: Apache-2.0
"""glTF 2.0 with KHR_gaussian_splatting: .glb, or .gltf with a .bin beside it.

Specifications: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, and for Gaussians
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting (ratified).

- Frame: x left, y up, z forward, as the base specification says; ours is half a turn about z away. What is written has
  that turn in its values, not in a node, as not every viewer turns spherical harmonics with their node; an `origin` is
  the node's translation. What is read goes through the nodes' transforms.
- Values are float32: linear scales, opacities in [0, 1], unit quaternions x y z w; SH coefficients in an attribute each,
  order and signs as ours. Normalised integers are read too. COLOR_0 is there for viewers that draw points, in linear
  light as glTF wants it.
- Colour space: srgb_rec709_display, unless told that the model was trained in linear light (lin_rec709_display).
- Compression: KHR_gaussian_splatting_compression_spz_2, a draft, has an SPZ file in a buffer view, by its text in version
  2 and to be unpacked into glTF's frame. It is read, and written when asked for.

The container is a JSON object and arrays at offsets, which are read here as they lie in the file: libraries for it load
files whole, and trust what they say.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import os
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from clsplat.colour import srgb_to_linear
from clsplat.errors import InputError, plain
from clsplat.files import MAX_DOCUMENT, atomic_writer, open_input, parse_json, read_document
from clsplat.formats import conventions, spz
from clsplat.formats.conventions import LEFT_UP
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.reference.sh import C0

NAME = "glTF"
SUFFIXES = (".gltf", ".glb")
LOSES = "nothing but the quaternions' lengths and the logits of opacities next to 0 and 1"
FLOAT = True

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
SPZ_EXTENSIONS = (SPZ_EXTENSION, "KHR_gaussian_splatting_compression_spz")
"""The second is what the draft's own example calls it."""
UNDERSTOOD = {EXTENSION, *SPZ_EXTENSIONS, "KHR_mesh_quantization", "KHR_materials_unlit"}
COLOR_SPACES = ("srgb_rec709_display", "lin_rec709_display")

GLB_MAGIC, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
FLOAT32, UINT16 = 5126, 5123
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAX_NODES = 100_000
BLOCK_ROWS = 1 << 15
LARGEST_GLB = (1 << 32) - 1

Array = NDArray[Any]


def recognises(head: bytes) -> bool:
    """Whether a file begins as a .glb; a .gltf has JSON's beginning and nothing else."""
    return head[:4] == b"glTF" or head.lstrip()[:1] == b"{"


def describe(path: Path) -> dict[str, Any]:
    """What the extension says of the first primitive that has it."""
    asset = _Asset.open(path)
    for _, _, primitive in asset.primitives():
        said = asset.extension(primitive)
        compression = next((name for name in SPZ_EXTENSIONS if name in _object(said.get("extensions", {}))), "none")
        return {"color_space": str(said.get("colorSpace", "")), "compression": compression}
    return {}


def read(path: Path) -> Gaussians:
    """Read every primitive of Gaussians in the scene, as one model. Raises InputError."""
    asset = _Asset.open(path)
    parts = []
    for name, matrix, primitive in asset.primitives():
        part = asset.gaussians(name, primitive)
        # the node's matrix is in glTF's frame, the Gaussians are in ours already
        turn = np.diag([*LEFT_UP, 1.0])
        conventions.place(part, turn @ matrix @ turn, f"{path}: {name}")
        parts.append(part)
    if not parts:
        raise InputError(f"{path}: has no primitive with {EXTENSION} in its scene, expected at least one")
    model = conventions.concatenated(parts)
    conventions.require_finite(path, model)
    return model


@dataclass
class _Asset:
    """A file: its JSON, and what its buffers are, as far as they were needed."""

    path: Path
    document: dict[str, Any]
    binary: tuple[int, int] | None = None
    """Where the .glb's own buffer begins, and how long it is."""
    size: int = 0
    buffers: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    total: int = 0

    @classmethod
    def open(cls, path: Path) -> _Asset:
        with open_input(path, "a glTF file") as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(4) == b"glTF":
                text, binary = _chunks(file, size, path)
            else:
                text, binary = read_document(path, "a glTF file").encode(), None
        try:
            document = parse_json(text)
        except ValueError as error:
            raise InputError(f"{path}: its JSON does not parse ({error}); is it a glTF file?") from None
        if not isinstance(document, dict):
            raise InputError(f"{path}: its JSON is no object, expected a glTF file")
        asset = cls(path, document, binary, size)
        version = _object(document.get("asset")).get("version")
        if not str(version).startswith("2."):
            raise InputError(f"{path}: glTF version {version!r}, expected 2.0")
        required = document.get("extensionsRequired", [])
        if unknown := [name for name in required if name not in UNDERSTOOD] if isinstance(required, list) else [required]:
            raise InputError(f"{path}: requires {str(unknown[0])[:80]}, which is not supported; save it without")
        return asset

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """An object of one of the document's lists."""
        items = self.document.get(kind)
        if not isinstance(items, list) or not _is_index(index) or not index < len(items):
            raise InputError(f"{self.path}: {kind} has no {index!r}; is it damaged?")
        if not isinstance(items[index], dict):
            raise InputError(f"{self.path}: {kind} {index} is no object; is it damaged?")
        found: dict[str, Any] = items[index]
        return found

    def integer(self, holder: dict[str, Any], key: str, default: int | None = None) -> int:
        value = holder.get(key, default)
        if not _is_index(value):
            raise InputError(f"{self.path}: {key} is {str(value)[:40]!r}, expected a number from 0 on")
        return int(value)

    def primitives(self) -> Iterator[tuple[str, NDArray[np.float64], dict[str, Any]]]:
        """Those of Gaussians in the default scene: what to call them, the node's matrix in the world, and they."""
        nodes = self.document.get("nodes", [])
        if "scenes" in self.document:
            roots = self.item("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            roots = list(range(len(nodes))) if isinstance(nodes, list) else []
        todo: list[tuple[object, NDArray[np.float64]]] = [(root, np.eye(4)) for root in _list(roots)]
        seen: set[int] = set()
        while todo:
            index, parent = todo.pop(0)
            node = self.item("nodes", index)
            assert isinstance(index, int)
            if index in seen or len(seen) >= MAX_NODES:
                raise InputError(f"{self.path}: node {index} is there twice, expected a tree of up to {MAX_NODES} nodes")
            seen.add(index)
            matrix = parent @ self.matrix(node, index)
            todo += [(child, matrix) for child in _list(node.get("children", []))]
            if "mesh" not in node:
                continue
            for place, primitive in enumerate(_list(self.item("meshes", node["mesh"]).get("primitives", []))):
                if isinstance(primitive, dict) and EXTENSION in _object(primitive.get("extensions")):
                    yield f"primitive {place} of node {index}", matrix, primitive

    def matrix(self, node: dict[str, Any], index: int) -> NDArray[np.float64]:
        from scipy.spatial.transform import Rotation

        def numbers(key: str, default: list[float]) -> NDArray[np.float64]:
            value = node.get(key, default)
            try:
                found = np.array(value, np.float64)
            except (TypeError, ValueError, OverflowError):
                found = np.empty(0)
            if found.shape != (len(default),) or not np.isfinite(found).all():
                raise InputError(f"{self.path}: {key} of node {index} is no list of {len(default)} numbers")
            return found

        if "matrix" in node:
            return numbers("matrix", list(np.eye(4).ravel())).reshape(4, 4).T
        result = np.eye(4)
        rotation = numbers("rotation", [0, 0, 0, 1])
        if not rotation.any():
            raise InputError(f"{self.path}: rotation of node {index} is 0, expected a quaternion")
        result[:3, :3] = Rotation.from_quat(rotation).as_matrix() * numbers("scale", [1, 1, 1])
        result[:3, 3] = numbers("translation", [0, 0, 0])
        return result

    def extension(self, primitive: dict[str, Any]) -> dict[str, Any]:
        return _object(primitive["extensions"][EXTENSION])

    def gaussians(self, name: str, primitive: dict[str, Any]) -> Gaussians:
        """In our frame."""
        said = self.extension(primitive)
        kernel, space = said.get("kernel", "ellipse"), said.get("colorSpace", COLOR_SPACES[0])
        if kernel != "ellipse":
            raise InputError(f"{self.path}: {name} has the kernel {str(kernel)[:40]!r}, expected ellipse")
        if space != COLOR_SPACES[0]:
            warnings.warn(plain(f"{self.path}: the colours are in {str(space)[:40]}, kept as they are"), stacklevel=3)
        nested = _object(said.get("extensions", {}))
        for extension in SPZ_EXTENSIONS:
            if extension in nested:
                blob = self.view(_object(nested[extension]).get("bufferView"))
                return spz.read_from(io.BytesIO(blob), len(blob), self.path)
        return self.attributes(name, _object(primitive.get("attributes")))

    def attributes(self, name: str, indices: dict[str, Any]) -> Gaussians:
        def array(semantic: str, width: int) -> Array:
            if semantic not in indices:
                raise InputError(f"{self.path}: {name} lacks the attribute {semantic}")
            return self.accessor(indices[semantic], width, semantic)

        position = array("POSITION", 3)
        count = len(position)
        self.total += count
        size = self.size + sum(len(buffer) for buffer in self.buffers.values())
        conventions.require_count(self.path, self.total if count else 0, size)
        names = [
            [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}" for index in range(2 * degree + 1)]
            for degree in range(MAX_SH_DEGREE + 1)
        ]
        degree = max((degree for degree in range(4) if any(each in indices for each in names[degree])), default=0)
        sources = {
            "means": position,
            "quaternions": array(f"{EXTENSION}:ROTATION", 4),
            "log_scales": array(f"{EXTENSION}:SCALE", 3),
            "opacities": array(f"{EXTENSION}:OPACITY", 1),
        }
        coefficients = [array(each, 3) for band in names[: degree + 1] for each in band]
        for each in (*sources.values(), *coefficients):
            if len(each) != count:
                raise InputError(f"{self.path}: {name} has {len(each)} values of an attribute, expected {count}")
        result = Gaussians(
            np.empty((count, 3), np.float32),
            np.empty((count, 4), np.float32),
            np.empty((count, 3), np.float32),
            np.empty(count, np.float32),
            np.empty((count, len(coefficients), 3), np.float32),
        )
        for first in range(0, count, BLOCK_ROWS):
            rows = slice(first, min(first + BLOCK_ROWS, count))
            result.means[rows] = _real(position[rows])
            result.quaternions[rows] = _real(sources["quaternions"][rows])[:, [3, 0, 1, 2]]
            scales = _real(sources["log_scales"][rows])
            if not (scales >= 0).all():
                raise InputError(f"{self.path}: {name} has a scale below 0 or that is no number")
            result.log_scales[rows] = np.log(np.maximum(scales, 2.0**-149))
            opacity = _real(sources["opacities"][rows])[:, 0]
            if not ((opacity >= 0) & (opacity <= 1)).all():
                raise InputError(f"{self.path}: {name} has an opacity outside [0, 1]")
            result.opacity_logits[rows] = conventions.logits(opacity)
            for index, coefficient in enumerate(coefficients):
                result.sh[rows, index] = _real(coefficient[rows])
        conventions.flip(result, LEFT_UP)
        return result

    def accessor(self, index: object, width: int, semantic: str) -> Array:
        """(count, width), as it lies in the file."""
        said = self.item("accessors", index)
        kind = COMPONENTS.get(self.integer(said, "componentType"))
        count, offset = self.integer(said, "count"), self.integer(said, "byteOffset", 0)
        if kind is None or WIDTHS.get(str(said.get("type"))) != width:
            raise InputError(f"{self.path}: {semantic} is of the type {str(said.get('type'))[:20]}, expected {width} numbers")
        if "sparse" in said or "bufferView" not in said:
            raise InputError(f"{self.path}: {semantic} is sparse or has no values of its own, which is not supported")
        view = self.item("bufferViews", said["bufferView"])
        data = self.view(said["bufferView"])
        item = np.dtype(kind)
        stride = self.integer(view, "byteStride", width * item.itemsize)
        need = offset + stride * (count - 1) + width * item.itemsize if count else offset
        if need > len(data) or stride < width * item.itemsize:
            raise InputError(f"{self.path}: {semantic} needs {need} bytes, its buffer view has {len(data)}")
        found = np.ndarray((count, width), item, data.data, offset, (stride, item.itemsize))
        return found.view(_Normalised) if said.get("normalized") is True and item.kind != "f" else found

    def view(self, index: object) -> NDArray[np.uint8]:
        """The bytes of a buffer view."""
        said = self.item("bufferViews", index)
        if "EXT_meshopt_compression" in _object(said.get("extensions", {})):
            raise InputError(f"{self.path}: is compressed with EXT_meshopt_compression, which is not supported")
        offset, length = self.integer(said, "byteOffset", 0), self.integer(said, "byteLength")
        data = self.buffer(self.integer(said, "buffer"))
        if length > len(data) - offset:
            raise InputError(
                f"{self.path}: truncated: a buffer view ends at byte {offset + length}, its buffer has {len(data)}"
            )
        return data[offset : offset + length]

    def buffer(self, index: int) -> NDArray[np.uint8]:
        if index not in self.buffers:
            said = self.item("buffers", index)
            length = self.integer(said, "byteLength")
            if "uri" not in said:
                if self.binary is None or index != 0:
                    raise InputError(f"{self.path}: buffer {index} has no place, expected a uri or the .glb's own")
                start, have = self.binary
                data = _map(self.path, start, have)
            else:
                data = self.outside(str(said["uri"]))
            if len(data) < length:
                raise InputError(
                    f"{self.path}: truncated: buffer {index} needs {length} bytes, {len(data)} are there"
                )
            self.buffers[index] = data
        return self.buffers[index]

    def outside(self, uri: str) -> NDArray[np.uint8]:
        """A data: URI, or a file in the same folder or below it."""
        if uri.startswith("data:"):
            try:
                return np.frombuffer(base64.b64decode(uri.partition(";base64,")[2], validate=True), np.uint8)
            except (binascii.Error, ValueError):
                raise InputError(f"{self.path}: has a data URI that is not in base64") from None
        try:
            parts = urlsplit(uri)
            name = unquote(parts.path)
            folder = Path(os.path.realpath(self.path)).parent
            file = Path(os.path.realpath(folder / name))
            inside = not parts.scheme and not parts.netloc and name and file.is_relative_to(folder)
        except ValueError:  # a zero byte in the name, or brackets that are no address
            inside = False
        if not inside:
            raise InputError(f"{self.path}: has its buffer in {uri[:80]!r}, expected a file beside it")
        with open_input(file, f"the buffer of {self.path.name}") as opened:
            size = os.fstat(opened.fileno()).st_size
        return _map(file, 0, size)


class _Normalised(np.ndarray[Any, Any]):
    """Integers that stand for fractions of their largest."""


def _real(values: Array) -> NDArray[np.float32]:
    floats = np.asarray(values).astype(np.float32)
    if isinstance(values, _Normalised):
        floats = np.maximum(floats / np.float32(np.iinfo(values.dtype).max), np.float32(-1))
    return floats


def _map(path: Path, start: int, size: int) -> NDArray[np.uint8]:
    if size == 0:
        return np.empty(0, np.uint8)
    return np.memmap(path, np.uint8, "r", start, (size,))


def _chunks(file: BinaryIO, size: int, path: Path) -> tuple[bytes, tuple[int, int] | None]:
    """The JSON of a .glb, and where its buffer is."""
    head = file.read(16)
    if len(head) < 16:
        raise InputError(f"{path}: truncated: {size} bytes, expected a .glb")
    version, _, length, kind = struct.unpack("<IIII", head)
    if version != 2 or kind != JSON_CHUNK:
        raise InputError(f"{path}: .glb of version {version} with a first chunk {kind:#x}, expected version 2 and JSON")
    if length > min(MAX_DOCUMENT, size - 20):
        raise InputError(f"{path}: truncated: its JSON has {length} bytes, {size - 20} are there")
    text = file.read(length)
    head = file.read(8)
    if len(head) < 8:
        return text, None
    have, kind = struct.unpack("<II", head)
    start = 20 + length + 8
    if kind != BIN_CHUNK:
        return text, None
    if have > size - start:
        raise InputError(f"{path}: truncated: its buffer has {have} bytes, {size - start} are there")
    return text, (start, have)


def _is_index(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def _object(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def write(
    path: Path, gaussians: Gaussians, *, spz_compression: bool = False, color_space: str = COLOR_SPACES[0]
) -> None:
    """Write a .glb, or a .gltf and the .bin with its buffer, which is there before the .gltf is; atomically, each.

    spz_compression: by the draft KHR_gaussian_splatting_compression_spz_2, which few viewers read. Raises InputError for
    values that are not finite, and a .glb of more than 4 GiB.
    """
    if color_space not in COLOR_SPACES:
        raise ValueError(f"color_space {color_space!r}: expected {' or '.join(COLOR_SPACES)}")
    gaussians.check()
    conventions.require_finite(path, gaussians, writing=True)
    if not len(gaussians):
        raise InputError(f"{path}: cannot be written: the model has no Gaussians")
    document, buffer = _document(path, gaussians, spz_compression, color_space)
    if path.suffix.lower() == ".gltf":
        binary = path.with_suffix(".bin")
        with atomic_writer(binary) as file:
            length = buffer.write(file)
        document["buffers"] = [{"byteLength": length, "uri": binary.name}]
        with atomic_writer(path) as file:
            file.write(json.dumps(document, indent=1).encode())
        return
    length = buffer.length
    document["buffers"] = [{"byteLength": length}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    padded = length + -length % 4
    total = 28 + len(text) + padded
    if total > LARGEST_GLB:
        raise InputError(f"{path}: a .glb holds 4 GiB at most, {total} bytes would be needed; write a .gltf")
    with atomic_writer(path) as file:
        file.write(struct.pack("<IIIII", GLB_MAGIC, 2, total, len(text), JSON_CHUNK) + text)
        file.write(struct.pack("<II", padded, BIN_CHUNK))
        buffer.write(file)
        file.write(bytes(padded - length))


@dataclass
class _Buffer:
    """What the buffer will hold: arrays by the block of rows, or an SPZ file."""

    gaussians: Gaussians
    attributes: list[str]
    color_space: str
    blob: bytes | None = None

    @property
    def length(self) -> int:
        if self.blob is not None:
            return len(self.blob)
        return sum(_layout(name)[2] for name in self.attributes) * len(self.gaussians)

    def write(self, file: BinaryIO) -> int:
        if self.blob is not None:
            file.write(self.blob)
            return self.length
        for name in self.attributes:
            for first in range(0, len(self.gaussians), BLOCK_ROWS):
                block = _block(name, self.gaussians, slice(first, first + BLOCK_ROWS), self.color_space)
                file.write(np.ascontiguousarray(block).data)
        return self.length


def _layout(name: str) -> tuple[str, int, int]:
    """Type, component type, and bytes of one Gaussian."""
    if name == "COLOR_0":
        return "VEC4", UINT16, 8
    width = {"ROTATION": 4, "OPACITY": 1}.get(name.partition(":")[2], 3)
    return {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width], FLOAT32, 4 * width


def _block(name: str, gaussians: Gaussians, rows: slice, color_space: str) -> Array:
    """Some rows of an attribute, in glTF's frame."""
    match name.partition(":")[2] or name:
        case "POSITION":
            return (gaussians.means[rows] * np.array(LEFT_UP, np.float32)).astype("<f4")
        case "ROTATION":
            unit = conventions.unit_quaternions(gaussians.quaternions[rows])
            return (unit * conventions.quaternion_signs(LEFT_UP))[:, [1, 2, 3, 0]].astype("<f4")
        case "SCALE":
            return np.exp(np.clip(gaussians.log_scales[rows], -103.0, 88.0)).astype("<f4")
        case "OPACITY":
            return conventions.opacities(gaussians.opacity_logits[rows]).astype("<f4")
        case "COLOR_0":
            colors = np.clip(gaussians.sh[rows, 0] * np.float32(C0) + np.float32(0.5), 0, 1)
            if color_space == COLOR_SPACES[0]:
                colors = srgb_to_linear(colors)
            opacity = conventions.opacities(gaussians.opacity_logits[rows])
            return np.rint(np.column_stack([colors, opacity]) * 65535).astype("<u2")
        case coefficient:
            _, _, degree, _, index = coefficient.split("_")
            k = int(degree) ** 2 + int(index)
            return (gaussians.sh[rows, k] * conventions.sh_signs(LEFT_UP)[k]).astype("<f4")


def _document(
    path: Path, gaussians: Gaussians, spz_compression: bool, color_space: str
) -> tuple[dict[str, Any], _Buffer]:
    count = len(gaussians)
    attributes = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))]
    degrees = range(gaussians.sh_degree + 1)
    attributes += [
        f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}" for degree in degrees for index in range(2 * degree + 1)
    ]
    attributes.append("COLOR_0")
    corners = [gaussians.means.min(axis=0) * LEFT_UP, gaussians.means.max(axis=0) * LEFT_UP]
    bounds = {"min": np.minimum(*corners).tolist(), "max": np.maximum(*corners).tolist()}
    accessors: list[dict[str, Any]] = []
    for index, name in enumerate(attributes):
        kind, component, _ = _layout(name)
        accessor: dict[str, Any] = {"componentType": component, "count": count, "type": kind}
        accessor |= {} if spz_compression else {"bufferView": index}
        accessor |= bounds if name == "POSITION" else {}
        accessor |= {"normalized": True} if component == UINT16 else {}
        accessors.append(accessor)
    said: dict[str, Any] = {"kernel": "ellipse", "colorSpace": color_space}
    used = [EXTENSION]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "clsplat"},
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [],
        "accessors": accessors,
    }
    buffer = _Buffer(gaussians, attributes, color_space)
    if spz_compression:
        buffer.blob = _spz_blob(path, gaussians)
        used.append(SPZ_EXTENSION)
        document["extensionsRequired"] = used
        said["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
        document["bufferViews"] = [{"buffer": 0, "byteLength": buffer.length}]
    else:
        sizes = [_layout(name)[2] * count for name in attributes]
        offsets = np.cumsum([0, *sizes]).tolist()
        views = zip(offsets, sizes, strict=False)
        target = 34962  # ARRAY_BUFFER
        document["bufferViews"] = [
            {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target} for offset, size in views
        ]
    places = {name: index for index, name in enumerate(attributes)}
    primitive = {"attributes": places, "mode": 0, "extensions": {EXTENSION: said}}
    document["meshes"] = [{"primitives": [primitive]}]
    if gaussians.origin.any():
        document["nodes"][0]["translation"] = [float(value) for value in gaussians.origin * LEFT_UP]
    return document, buffer


def _spz_blob(path: Path, gaussians: Gaussians) -> bytes:
    """Its means count from the node."""
    local = Gaussians(
        gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.opacity_logits, gaussians.sh
    )
    blob = io.BytesIO()
    spz.write_to(blob, local, spz.header_for(path, local, 2))
    return blob.getvalue()
