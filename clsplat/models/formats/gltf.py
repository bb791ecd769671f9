# SPDX-License-Identifier: Apache-2.0
"""glTF 2.0 with KHR_gaussian_splatting: .glb, or .gltf with a .bin file.

Specifications: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, and for Gaussians
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting (ratified).

- Axes: x left, y up, z forward, as the base specification says; half a turn about z from clsplat's. The writer rotates
  the values and not a node, since not every viewer rotates spherical harmonics with their node. An `origin` becomes the
  node's translation. The reader applies the nodes' transforms.
- Values are float32: linear scales, opacities in [0, 1], unit quaternions x y z w. Each SH coefficient has an
  attribute, in clsplat's order and signs. The reader accepts normalised integers too. COLOR_0, linear as glTF requires,
  is for viewers that draw points.
- Colour space: srgb_rec709_display by default, or lin_rec709_display for a model trained in linear light.
- Compression: the draft KHR_gaussian_splatting_compression_spz_2 stores an SPZ file, version 2, in a buffer view. When
  unpacked, its values are in glTF's axes. Such files are read, and written on request.

clsplat parses the container itself, a JSON object and arrays at offsets: glTF libraries load whole files and trust
their contents.
"""

from __future__ import annotations

import io
import json
import re
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import NotRequired, TypedDict

from clsplat.errors import InputError, warn
from clsplat.files.atomic import atomic_write, atomic_writer
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.images.colour import srgb_to_linear
from clsplat.models.codec import axes, values
from clsplat.models.codec.axes import LUF_SIGNS
from clsplat.models.codec.gltf_asset import (
    ACCESSOR_WIDTHS,
    GAUSSIAN_EXTENSION,
    GLB_BIN_CHUNK,
    GLB_JSON_CHUNK,
    GLTF_COLOR_SPACES,
    SPZ_EXTENSION,
    SPZ_EXTENSIONS,
    Array,
    Asset,
    as_object,
    real,
    sh_attributes,
)
from clsplat.models.edit import merge
from clsplat.models.formats import spz
from clsplat.spherical_harmonics import SH_C0

GLB_MAGIC = 0x46546C67
FLOAT32_COMPONENT, UINT16_COMPONENT = 5126, 5123
MAX_GLB_BYTES = (1 << 32) - 1
LOG_SCALE_WRITER, LOG_SCALE_WRITER_FIXED_VERSION = re.compile(r"splat-transform v?(\d+)\.(\d+)(?:\..*)?"), (2, 7)
"""Pattern of splat-transform's name and version, and its first version that writes linear scales. Earlier versions
write logs of scales."""
Rows = Callable[[slice], Array]
"""Function that returns the values of an attribute for a slice of Gaussians."""


def recognises(head: bytes) -> bool:
    """True if a file begins like a .glb, or like JSON, as a .gltf does."""
    return head[:4] == b"glTF" or head.lstrip()[:1] == b"{"


def describe(path: Path) -> dict[str, Any]:
    """Details of a file for `clsplat info`: colour space and compression of the first primitive with Gaussians."""
    asset = Asset.open(path)
    for _, _, primitive in asset.primitives():
        said = as_object(primitive["extensions"][GAUSSIAN_EXTENSION])
        compression = next((name for name in SPZ_EXTENSIONS if name in as_object(said.get("extensions"))), "none")
        return {"color_space": str(said.get("colorSpace", "")), "compression": compression}
    return {}


def side_files(path: Path) -> list[Path]:
    """The path of the .bin file of a .gltf, in a list; empty for a .glb."""
    return [path.with_suffix(".bin")] if path.suffix.lower() == ".gltf" else []


def read(path: Path) -> Gaussians:
    """Read all primitives with Gaussians in the scene, merged into one model. Raises InputError."""
    asset = Asset.open(path)
    primitives = list(asset.primitives())  # a list, so that too many are an error before any is read
    if not primitives:
        raise InputError(f"{path}: has no primitive with {GAUSSIAN_EXTENSION} in its scene, expected at least one")
    scaled: list[tuple[str, Gaussians]] = []
    parts = [_gaussians(asset, name, primitive, scaled) for name, _, primitive in primitives]
    if scaled:
        values.all_to_log_scales(scaled, _writer_of_logs(asset))
    # the nodes' matrices are in glTF's axes, the Gaussians already in clsplat's
    turn = np.diag([*LUF_SIGNS, 1.0])
    placed = zip(parts, primitives, strict=True)
    return merge([axes.place(part, turn @ matrix @ turn, f"{path}: {name}") for part, (name, matrix, _) in placed])


def _writer_of_logs(asset: Asset) -> str:
    """Name of the program that wrote the file, if it is known to write logs of scales; otherwise ""."""
    generator = str(as_object(asset.document.get("asset")).get("generator", ""))[:80]
    match = LOG_SCALE_WRITER.fullmatch(generator.strip())
    return generator if match and (int(match[1]), int(match[2])) < LOG_SCALE_WRITER_FIXED_VERSION else ""


def _gaussians(asset: Asset, name: str, primitive: dict[str, Any], scaled: list[tuple[str, Gaussians]]) -> Gaussians:
    """Read the Gaussians of a primitive, in clsplat's axes.

    Without SPZ compression a file has linear scales, which `log_scales` of the result still holds. Such Gaussians are
    appended to the list `scaled`, with a prefix for messages, and the caller replaces their scales by logs.

    name: the primitive's name, for messages.
    """
    said = as_object(primitive["extensions"][GAUSSIAN_EXTENSION])
    kernel, space = said.get("kernel", "ellipse"), said.get("colorSpace", GLTF_COLOR_SPACES[0])
    if kernel != "ellipse":
        warn(
            f"{asset.path}: {name} has the kernel {str(kernel)[:40]!r}, expected ellipse; it is drawn as an ellipse, "
            "as the extension requires for unknown kernels"
        )
    if space != GLTF_COLOR_SPACES[0]:
        warn(f"{asset.path}: the colours are in {str(space)[:40]} and are not converted")
    nested = as_object(said.get("extensions", {}))
    for extension in SPZ_EXTENSIONS:
        if extension in nested:
            blob = asset.view(as_object(nested[extension]).get("bufferView"))
            return spz.read_from(io.BytesIO(blob.data), len(blob), asset.path)
    part = _from_attributes(asset, name, as_object(primitive.get("attributes")))
    scaled.append((f"{asset.path}: {name}", part))
    return part


def _from_attributes(asset: Asset, name: str, indices: dict[str, Any]) -> Gaussians:
    """Read the Gaussians of a primitive from its attributes. Their `log_scales` still holds the file's linear scales.

    name: the primitive's name, for messages. indices: for each attribute, the index of its accessor.
    """

    def array(semantic: str, width: int) -> Array:
        if semantic not in indices:
            raise InputError(f"{asset.path}: {name} lacks the attribute {semantic}")
        return asset.accessor(indices[semantic], width, semantic)

    position = array("POSITION", 3)
    count = len(position)
    asset.total += count
    size = asset.size + sum(len(buffer) for buffer in asset.buffers.values())
    values.require_count(asset.path, asset.total if count else 0, size)
    names = [sh_attributes(degree) for degree in range(MAX_SH_DEGREE + 1)]
    degree = max((degree for degree in range(4) if indices.keys() & set(names[degree])), default=0)
    widths = {"ROTATION": 4, "SCALE": 3, "OPACITY": 1}
    rotation, scale, opacity = (array(f"{GAUSSIAN_EXTENSION}:{key}", width) for key, width in widths.items())
    coefficients = [array(semantic, 3) for band in names[: degree + 1] for semantic in band]
    for attribute in (rotation, scale, opacity, *coefficients):
        if len(attribute) != count:
            raise InputError(f"{asset.path}: {name} has {count} positions, but an attribute of {len(attribute)} values")
    result, where = values.empty(count, degree), f"{asset.path}: {name}"
    for rows in values.row_blocks(count):
        result.means[rows] = real(position[rows])
        result.quaternions[rows] = real(rotation[rows])[:, [3, 0, 1, 2]]
        result.log_scales[rows] = real(scale[rows])
        result.opacity_logits[rows] = values.logits_of(real(opacity[rows])[:, 0], where, rows.start)
        for index, coefficient in enumerate(coefficients):
            result.sh[rows, index] = real(coefficient[rows])
    axes.flip(result, LUF_SIGNS)
    return result


def write(
    path: Path, gaussians: Gaussians, *, spz_compression: bool = False, color_space: str = GLTF_COLOR_SPACES[0]
) -> None:
    """Write a .glb, or a .gltf with a .bin. Each file is written atomically, the .bin first.

    spz_compression: use the draft KHR_gaussian_splatting_compression_spz_2, which few viewers read.
    color_space: the model's colour space, one of GLTF_COLOR_SPACES.
    Raises InputError for non-finite values, and for a .glb of more than 4 GiB.
    """
    if color_space not in GLTF_COLOR_SPACES:
        raise ValueError(f"color_space is {color_space!r}, expected {' or '.join(GLTF_COLOR_SPACES)}")
    values.check_writable(path, gaussians, least=1)
    document, contents = _document(path, gaussians, spz_compression, color_space)
    length = sum(view["byteLength"] for view in document["bufferViews"])
    if path.suffix.lower() == ".gltf":
        binary = path.with_suffix(".bin")
        with atomic_writer(binary, length) as file:
            file.writelines(contents)
        document["buffers"] = [{"byteLength": length, "uri": binary.name}]
        atomic_write(path, json.dumps(document, indent=1).encode())
        return
    document["buffers"] = [{"byteLength": length}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    padded = length + -length % 4
    total = 28 + len(text) + padded
    if total > MAX_GLB_BYTES:
        raise InputError(f"{path}: a .glb can have 4 GiB at most, but {total} bytes are needed; write a .gltf")
    with atomic_writer(path, total) as file:
        file.write(struct.pack("<IIIII", GLB_MAGIC, 2, total, len(text), GLB_JSON_CHUNK) + text)
        file.write(struct.pack("<II", padded, GLB_BIN_CHUNK))
        file.writelines(contents)
        file.write(bytes(padded - length))


def _attributes(gaussians: Gaussians, color_space: str) -> dict[str, Rows]:
    """Return a function for each attribute, by the attribute's name and in the buffer's order.

    Each function returns the attribute's values, in glTF's axes, for a slice of Gaussians.

    color_space: the model's colour space, one of GLTF_COLOR_SPACES.
    """

    def rotation(rows: slice) -> Array:
        unit = values.unit_quaternions(gaussians.quaternions[rows]) * axes.quaternion_signs(LUF_SIGNS)
        return unit[:, [1, 2, 3, 0]].astype(np.float32)

    def opacity(rows: slice) -> Array:
        return values.opacities(gaussians.opacity_logits[rows])

    def coefficient(index: int) -> Rows:
        return lambda rows: gaussians.sh[rows, index] * axes.sh_signs(LUF_SIGNS)[index]

    def color(rows: slice) -> Array:
        colors = np.clip(gaussians.sh[rows, 0] * np.float32(SH_C0) + np.float32(0.5), 0, 1)
        if color_space == GLTF_COLOR_SPACES[0]:
            colors = srgb_to_linear(colors)
        return np.asarray(np.rint(np.column_stack([colors, opacity(rows)]) * 65535), np.uint16)

    coefficients = [name for degree in range(gaussians.sh_degree + 1) for name in sh_attributes(degree)]
    return {
        "POSITION": lambda rows: gaussians.means[rows] * np.array(LUF_SIGNS, np.float32),
        f"{GAUSSIAN_EXTENSION}:ROTATION": rotation,
        f"{GAUSSIAN_EXTENSION}:SCALE": lambda rows: np.exp(np.clip(gaussians.log_scales[rows], -103.0, 88.0)),
        f"{GAUSSIAN_EXTENSION}:OPACITY": lambda rows: opacity(rows).astype(np.float32),
        **{name: coefficient(index) for index, name in enumerate(coefficients)},
        "COLOR_0": color,
    }


def _blocks(attributes: Iterable[Rows], count: int) -> Iterator[memoryview]:
    """Yield the bytes of all attributes, one attribute after another. count: number of Gaussians."""
    for rows_of in attributes:
        for rows in values.row_blocks(count):
            block = rows_of(rows)
            yield np.ascontiguousarray(block, block.dtype.newbyteorder("<")).data


class GaussianNode(TypedDict):
    """JSON object of a written file's only node. translation: the model's origin in glTF's axes, if it is not 0."""

    mesh: int
    translation: NotRequired[list[float]]


def _document(
    path: Path, gaussians: Gaussians, spz_compression: bool, color_space: str
) -> tuple[dict[str, Any], Iterable[bytes | memoryview]]:
    """Build the JSON object of a glTF file, except the key `buffers`, and the contents of the file's only buffer.

    spz_compression, color_space: as in `write`.
    """
    count = len(gaussians)
    attributes = _attributes(gaussians, color_space)
    samples = {name: rows_of(slice(0, 1)) for name, rows_of in attributes.items()}
    kinds = {width: kind for kind, width in ACCESSOR_WIDTHS.items()}
    corners = [gaussians.means.min(axis=0) * LUF_SIGNS, gaussians.means.max(axis=0) * LUF_SIGNS]
    bounds = {"min": np.minimum(*corners).tolist(), "max": np.maximum(*corners).tolist()}
    accessors: list[dict[str, Any]] = []
    for index, (name, sample) in enumerate(samples.items()):
        component = UINT16_COMPONENT if name == "COLOR_0" else FLOAT32_COMPONENT
        accessor: dict[str, Any] = {"componentType": component, "count": count, "type": kinds[sample.size]}
        accessor |= {} if spz_compression else {"bufferView": index}
        accessor |= bounds if name == "POSITION" else {}
        accessor |= {"normalized": True} if component == UINT16_COMPONENT else {}
        accessors.append(accessor)
    said: dict[str, Any] = {"kernel": "ellipse", "colorSpace": color_space}
    places = {name: index for index, name in enumerate(attributes)}
    node: GaussianNode = {"mesh": 0}
    if gaussians.origin.any():
        node["translation"] = (gaussians.origin * LUF_SIGNS).tolist()
    used = [GAUSSIAN_EXTENSION]
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "clsplat"},
        "extensionsUsed": used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": places, "mode": 0, "extensions": {GAUSSIAN_EXTENSION: said}}]}],
        "accessors": accessors,
    }
    contents: Iterable[bytes | memoryview]
    if spz_compression:
        contents = [_spz_blob(path, gaussians)]
        used.append(SPZ_EXTENSION)
        document["extensionsRequired"] = used
        said["extensions"] = {SPZ_EXTENSION: {"bufferView": 0}}
        document["bufferViews"] = [{"buffer": 0, "byteLength": len(contents[0])}]
    else:
        contents = _blocks(attributes.values(), count)
        sizes = [sample.nbytes * count for sample in samples.values()]
        offsets = np.cumsum([0, *sizes]).tolist()
        views = zip(offsets, sizes, strict=False)
        target = 34962  # ARRAY_BUFFER
        document["bufferViews"] = [
            {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target} for offset, size in views
        ]
    return document, contents


def _spz_blob(path: Path, gaussians: Gaussians) -> bytes:
    """Bytes of the model as an SPZ file. Its means are relative to the origin, which the node's translation adds."""
    local = replace(gaussians, origin=np.zeros(3))
    blob = io.BytesIO()
    spz.write_to(blob, local, spz.header_for(path, local, 2))
    return blob.getvalue()
