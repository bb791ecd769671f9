# SPDX-License-Identifier: Apache-2.0
"""Reading of a glTF file: its JSON, the nodes of its scene, and the arrays of its buffers as stored.

All values are checked before use. A buffer is in the .glb itself, in a file in the same folder or a sub-folder, or in a
data: URI.
"""

from __future__ import annotations

import base64
import binascii
import os
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote, urlsplit

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import numbers
from clsplat.errors import InputError
from clsplat.files.documents import MAX_DOCUMENT_BYTES, open_input, parse_json, read_document

GAUSSIAN_EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
SPZ_EXTENSIONS = (SPZ_EXTENSION, "KHR_gaussian_splatting_compression_spz")
"""Names of the SPZ extension. The example in the draft of the specification uses the second."""
SUPPORTED_EXTENSIONS = (GAUSSIAN_EXTENSION, *SPZ_EXTENSIONS, "KHR_mesh_quantization", "KHR_materials_unlit")
GLTF_COLOR_SPACES = ("srgb_rec709_display", "lin_rec709_display")

GLB_JSON_CHUNK, GLB_BIN_CHUNK = 0x4E4F534A, 0x004E4942
COMPONENT_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
ACCESSOR_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAX_SCENE_NODES, MAX_GAUSSIAN_PRIMITIVES = 100_000, 4096
"""Largest number of nodes, and of primitives with Gaussians, in a scene. A malicious file may repeat a mesh in many
nodes."""

Array = NDArray[Any]


@dataclass
class Asset:
    """An opened glTF file: its JSON, and the buffers read so far."""

    path: Path
    document: dict[str, Any]
    binary: tuple[int, int] | None = None
    """Offset and length in bytes of the buffer inside a .glb; None for a .gltf."""
    size: int = 0
    buffers: dict[int, NDArray[np.uint8]] = field(default_factory=dict)
    total: int = 0

    @classmethod
    def open(cls, path: Path) -> Asset:
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
            raise InputError(f"{path}: its JSON is not an object, expected a glTF file")
        asset = cls(path, document, binary, size)
        version = as_object(document.get("asset")).get("version")
        if not str(version).startswith("2."):
            raise InputError(f"{path}: has glTF version {version!r}, expected 2.0")
        required = document.get("extensionsRequired", [])
        if (
            unknown := [name for name in required if name not in SUPPORTED_EXTENSIONS]
            if isinstance(required, list)
            else [required]
        ):
            raise InputError(f"{path}: requires {str(unknown[0])[:80]}, which is unsupported; save the file without it")
        return asset

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Object at an index of the document's list `kind`, such as "nodes"."""
        items = self.document.get(kind)
        if not isinstance(items, list) or not isinstance(index, int) or not 0 <= index < len(items):
            raise InputError(f"{self.path}: {kind} has no item {index!r}; is the file damaged?")
        item = items[index]
        if not isinstance(item, dict):
            raise InputError(f"{self.path}: item {index} of {kind} is not an object; is the file damaged?")
        return item

    def integer(self, holder: dict[str, Any], key: str, default: int | None = None) -> int:
        value = holder.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 62:
            raise InputError(f"{self.path}: {key} is {str(value)[:40]!r}, expected a number of at least 0")
        return value

    def primitives(self) -> Iterator[tuple[str, NDArray[np.float64], dict[str, Any]]]:
        """Yield name, world-from-node matrix (4, 4) and JSON object of each primitive with Gaussians in the scene."""
        nodes = self.document.get("nodes", [])
        if "scenes" in self.document:
            roots = self.item("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            roots = list(range(len(nodes))) if isinstance(nodes, list) else []
        todo: deque[tuple[object, NDArray[np.float64]]] = deque((root, np.eye(4)) for root in _list(roots))
        seen: set[int] = set()
        count = 0
        while todo:
            index, parent = todo.popleft()
            node = self.item("nodes", index)
            assert isinstance(index, int)
            if index in seen or len(seen) >= MAX_SCENE_NODES:
                raise InputError(
                    f"{self.path}: node {index} is used twice, or the scene has more than {MAX_SCENE_NODES:,} nodes; "
                    "expected a smaller tree of nodes"
                )
            seen.add(index)
            matrix = parent @ self.matrix(node, index)
            todo += [(child, matrix) for child in _list(node.get("children", []))]
            if "mesh" not in node:
                continue
            for place, primitive in enumerate(_list(self.item("meshes", node["mesh"]).get("primitives", []))):
                if isinstance(primitive, dict) and GAUSSIAN_EXTENSION in as_object(primitive.get("extensions")):
                    count += 1
                    if count > MAX_GAUSSIAN_PRIMITIVES:
                        raise InputError(
                            f"{self.path}: has more than {MAX_GAUSSIAN_PRIMITIVES} primitives of Gaussians, expected "
                            "at most that many"
                        )
                    yield f"primitive {place} of node {index}", matrix, primitive

    def matrix(self, node: dict[str, Any], index: int) -> NDArray[np.float64]:
        from scipy.spatial.transform import Rotation

        def vector(key: str, default: list[float]) -> NDArray[np.float64]:
            values = numbers(node.get(key, default))
            if values.shape != (len(default),) or not np.isfinite(values).all():
                raise InputError(f"{self.path}: {key} of node {index} is not a list of {len(default)} numbers")
            return values

        if "matrix" in node:
            return vector("matrix", list(np.eye(4).ravel())).reshape(4, 4).T
        result = np.eye(4)
        rotation = vector("rotation", [0, 0, 0, 1])
        if not rotation.any():
            raise InputError(f"{self.path}: rotation of node {index} is 0, expected a quaternion")
        result[:3, :3] = Rotation.from_quat(rotation).as_matrix() * vector("scale", [1, 1, 1])
        result[:3, 3] = vector("translation", [0, 0, 0])
        return result

    def accessor(self, index: object, width: int, semantic: str) -> Array:
        """Values (count, width) of the accessor at `index`, as stored. semantic: the attribute's name, for messages."""
        said = self.item("accessors", index)
        kind = COMPONENT_DTYPES.get(self.integer(said, "componentType"))
        count, offset = self.integer(said, "count"), self.integer(said, "byteOffset", 0)
        if kind is None:
            found = str(said["componentType"])[:20]
            raise InputError(f"{self.path}: {semantic} has the componentType {found}, expected 5120-5123, 5125 or 5126")
        if ACCESSOR_WIDTHS.get(str(said.get("type"))) != width:
            expected = next(name for name, numbers in ACCESSOR_WIDTHS.items() if numbers == width)
            raise InputError(f"{self.path}: {semantic} has the type {str(said.get('type'))[:20]}, expected {expected}")
        if "sparse" in said or "bufferView" not in said:
            raise InputError(f"{self.path}: {semantic} is sparse or has no buffer view, which is not supported")
        view = self.item("bufferViews", said["bufferView"])
        data = self.view(said["bufferView"])
        item = np.dtype(kind)
        stride = self.integer(view, "byteStride", width * item.itemsize)
        need = offset + stride * (count - 1) + width * item.itemsize if count else offset
        if need > len(data) or stride < width * item.itemsize:
            raise InputError(f"{self.path}: {semantic} needs {need} bytes, but its buffer view has {len(data)}")
        values = np.ndarray((count, width), item, data.data, offset, (stride, item.itemsize))
        return values.view(_Normalised) if said.get("normalized") is True and item.kind != "f" else values

    def view(self, index: object) -> NDArray[np.uint8]:
        """Bytes of the buffer view at an index of the document's list "bufferViews"."""
        said = self.item("bufferViews", index)
        if "EXT_meshopt_compression" in as_object(said.get("extensions", {})):
            raise InputError(f"{self.path}: is compressed with EXT_meshopt_compression, which is not supported")
        offset, length = self.integer(said, "byteOffset", 0), self.integer(said, "byteLength")
        data = self.buffer(self.integer(said, "buffer"))
        if length > len(data) - offset:
            raise InputError(
                f"{self.path}: truncated: a buffer view ends at byte {offset + length}, but its buffer has {len(data)}"
            )
        return data[offset : offset + length]

    def buffer(self, index: int) -> NDArray[np.uint8]:
        if index not in self.buffers:
            said = self.item("buffers", index)
            length = self.integer(said, "byteLength")
            if "uri" not in said:
                if self.binary is None or index != 0:
                    raise InputError(f"{self.path}: buffer {index} has no data, expected a uri or the buffer of a .glb")
                data = _map(self.path, *self.binary)
            else:
                data = self.outside(str(said["uri"]))
            if len(data) < length:
                raise InputError(f"{self.path}: truncated: buffer {index} should have {length} bytes, has {len(data)}")
            self.buffers[index] = data
        return self.buffers[index]

    def outside(self, uri: str) -> NDArray[np.uint8]:
        """Bytes of a buffer outside the .glb: of a data: URI, or of a file in the same folder or a sub-folder."""
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
        except ValueError:  # the URI has a zero byte, or an invalid address in brackets
            inside = False
        if not inside:
            raise InputError(f"{self.path}: has its buffer in {uri[:80]!r}, expected a file in its folder or below it")
        with open_input(file, f"the buffer of {self.path}") as opened:
            size = os.fstat(opened.fileno()).st_size
        return _map(file, 0, size)


def sh_attributes(degree: int) -> list[str]:
    """Attribute names of the SH coefficients of one degree, in the order of `Gaussians.sh`."""
    return [f"{GAUSSIAN_EXTENSION}:SH_DEGREE_{degree}_COEF_{index}" for index in range(2 * degree + 1)]


class _Normalised(np.ndarray[Any, Any]):
    """Values of a normalised glTF accessor: integers that encode fractions of their dtype's maximum."""


def real(values: Array) -> NDArray[np.float32]:
    """Convert an accessor's values to float32; normalised integers become fractions of their dtype's maximum."""
    floats = np.asarray(values).astype(np.float32)
    if isinstance(values, _Normalised):
        floats = np.maximum(floats / np.float32(np.iinfo(values.dtype).max), np.float32(-1))
    return floats


def _map(path: Path, start: int, size: int) -> NDArray[np.uint8]:
    if size == 0:
        return np.empty(0, np.uint8)
    try:
        return np.memmap(path, np.uint8, "r", start, (size,))
    except OSError as error:  # memmap fails if, for example, the file is larger than the address space
        raise InputError(f"{path}: {size} bytes cannot be read ({error.strerror})") from None


def _chunks(file: BinaryIO, size: int, path: Path) -> tuple[bytes, tuple[int, int] | None]:
    """JSON text of a .glb of `size` bytes, and offset and length in bytes of its buffer; None if it has no buffer."""
    head = file.read(16)
    if len(head) < 16:
        raise InputError(f"{path}: truncated: has {size} bytes, expected a .glb")
    version, _, length, kind = struct.unpack("<IIII", head)
    if version != 2 or kind != GLB_JSON_CHUNK:
        raise InputError(f"{path}: has .glb version {version}, first chunk {kind:#x}, expected version 2 and JSON")
    if length > min(MAX_DOCUMENT_BYTES, size - 20):
        raise InputError(f"{path}: truncated: its JSON should have {length} bytes, but {size - 20} are left")
    text = file.read(length)
    head = file.read(8)
    if len(head) < 8:
        return text, None
    have, kind = struct.unpack("<II", head)
    start = 20 + length + 8
    if kind != GLB_BIN_CHUNK:
        return text, None
    if have > size - start:
        raise InputError(f"{path}: truncated: its buffer should have {have} bytes, but {size - start} are left")
    return text, (start, have)


def as_object(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
