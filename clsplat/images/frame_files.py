# SPDX-License-Identifier: Apache-2.0
"""Writing of rendered frames: channels in an EXR of one part or several, or a plain image.

Alpha is premultiplied in EXR, TIFF and DPX, straight in PNG. Matrices in EXR headers are for row vectors, p_camera =
p_world M, in the coordinate systems of OpenEXR's standard attributes (ImfStandardAttributes.h).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera, Window
from clsplat.config.channels import DEEP_CHANNELS, WRITABLE_CHANNELS
from clsplat.config.pictures import VIDEO_SUFFIXES, Encoding
from clsplat.errors import InputError, examples
from clsplat.images.alpha import unassociate
from clsplat.images.reading import decodes, image_size, opened
from clsplat.images.writing import steps_of, write_spec

MAX_HALF_FLOAT = np.float32(65504)
"""Largest finite half float."""
_PNG_LEVEL, _PNG_FILTER = 1, 0x40
"""PNG compression level, and the filter that predicts each pixel from the mean of its left and upper neighbours.

Compared with level 6 and the best of five filters for each row, writing takes a fifth of the time, and files are at
most a tenth larger. Level 6 can take longer than rendering the frame on a CPU.
"""
_EXR_ZIP_LEVEL = 1
"""Level of zip and zips compression. It takes two thirds of the time of the default, 4, and 2 to 7 % more bytes."""
_MAX_EXACT_FLOAT_INDEX = 2**24
"""Integers up to this are exact in a 32-bit float."""
_DISK_BLOCK_BYTES = 1 << 12
"""Bytes in a disk block."""

FRAME_SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".dpx")
"""Lower-case extensions of the image files that frames are written to."""
MODEL_DIGEST_ATTRIBUTE, SETTINGS_DIGEST_ATTRIBUTE = "clsplat:model", "clsplat:settings"
"""EXR attributes with a frame's provenance: SHA-256 of the model file, and a digest of all other settings."""
RECORD_TAGS = {
    **dict.fromkeys((".tif", ".tiff", ".jpg", ".jpeg"), "ImageDescription"),
    ".dpx": "DocumentName",
}
"""OpenImageIO's name of the header field that holds a frame's provenance, by file extension. In a DPX this is the
project name, which has room for 200 characters."""
_RECORD_PATTERN = re.compile(r"clsplat model ([0-9a-z]+) settings ([0-9a-z]+)", re.ASCII)


@dataclass(frozen=True, eq=False)
class FrameFileHeader:
    """Contents of a frame file other than pixels.

    attributes: header attributes by name.
    matrices: EXR attributes (4, 4) by name, for row vectors.
    window: the image's position in the display window, and the window's size; None if the image fills it.
    chromaticities: x and y of red, green, blue and white; empty if unknown.
    is_srgb: True if the colours are in sRGB.
    typed: EXR attributes by name, each with OpenImageIO's name of its type and its value.
    view: "left" or "right" in a stereo pair, otherwise "".
    """

    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    matrices: Mapping[str, Float64] = field(default_factory=dict)
    window: Window | None = None
    chromaticities: Sequence[float] = ()
    is_srgb: bool = True
    typed: Mapping[str, tuple[str, Any]] = field(default_factory=dict)
    view: str = ""


def camera_matrices(camera: Camera) -> dict[str, Float64]:
    """Return OpenEXR's attributes worldToCamera and worldToNDC, for row vectors; {} for a camera without image plane.

    Camera space has x right, y up and z along the view, so it is left-handed. In NDC, (0, 0) is the upper left corner
    of the display window and (1, 1) the lower right. OpenEXR does not define z in NDC. Here z is 0 at the near plane
    and 1 at infinity. For an orthographic camera, z is 1 at the far plane; without a far plane, z grows by 1 per world
    unit.
    """
    display = camera.window or camera
    projection = camera.model.ndc_from_cam(camera, display.width, display.height)
    if projection is None:
        return {}
    to_camera = np.eye(4)
    flip = np.diag([1.0, -1.0, 1.0])
    to_camera[:3, :3] = (flip @ camera.rotation).T
    to_camera[3, :3] = flip @ camera.translation
    return {"worldToCamera": to_camera, "worldToNDC": to_camera @ projection}


def is_whole_panorama(camera: Camera) -> bool:
    """Return True for a full panorama with the camera's axis in the middle, as EXR's attribute envmap requires."""
    return camera.window is None and camera.model.is_whole(camera)


def parse_channels(text: str) -> tuple[str, ...]:
    """Return the channel names in a comma-separated text, in the order of WRITABLE_CHANNELS.

    Raises InputError for an unknown name or an empty text.
    """
    asked = [word.strip() for word in text.split(",") if word.strip()]
    unknown = [word for word in asked if word not in WRITABLE_CHANNELS]
    if unknown or not asked:
        problem = f"has {examples(map(repr, unknown))}" if unknown else "is empty"
        raise InputError(f"--channels {text}: {problem}, expected some of {', '.join(WRITABLE_CHANNELS)}")
    return tuple(name for name in WRITABLE_CHANNELS if name in asked)


def check_format(path: str, channels: Iterable[str], *, video: bool = False) -> None:
    """Raise InputError if a file with this name cannot hold the channels. video: True allows videos too."""
    extension, known = Path(path).suffix.lower(), (*FRAME_SUFFIXES, *VIDEO_SUFFIXES) if video else FRAME_SUFFIXES
    if extension not in known:
        raise InputError(f"{path}: has the extension {extension or 'none'!r}, expected one of {', '.join(known)}")
    if extension == ".exr":
        return
    holds = ("rgb",) if extension in (".jpg", ".jpeg", ".mp4") else ("rgb", "alpha")
    over = [name for name in channels if name not in holds]
    if over or "rgb" not in channels:
        lacking = f"cannot hold {', '.join(over)}" if over else "needs rgb"
        article = "an" if extension == ".mp4" else "a"
        raise InputError(f"{path}: {article} {extension[1:].upper()} {lacking}; write .exr, or other --channels")


def check_target(path: Path, channels: Iterable[str]) -> None:
    """Raise InputError if the file's folder does not exist, or a file with this name cannot hold the channels."""
    check_format(str(path), channels)
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder to write {path.name} to")


def write_channels(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    encoding: Encoding | None = None,
    header: FrameFileHeader | None = None,
) -> None:
    """Write a frame, atomically.

    channels: arrays (H, W) or (H, W, C) by channel name. rgb is over black, so it is premultiplied by alpha. In an EXR
      part of integers, the id -1, for no Gaussian, becomes 4294967295.
    encoding: pixel types and compression of the file; None for the defaults.
    header: header attributes of the file; None for the defaults.
    Raises InputError and ClsplatError like `writing.write_image`.
    """
    write_views(path, [(channels, header or FrameFileHeader())], encoding)


def write_views(
    path: Path, views: Sequence[tuple[Mapping[str, NDArray[Any]], FrameFileHeader]], encoding: Encoding | None = None
) -> None:
    """Write several views, such as a stereo pair, to one EXR file. Each view has parts of its own, named after it.

    views: for each view its channels, as in `write_channels`, and its header.
    """
    encoding = encoding or Encoding()
    check_target(path, views[0][0])
    extension = path.suffix.lower()
    several = len(views) > 1
    pairs = [part for planes, header in views for part in encoded(extension, planes, encoding, header, several=several)]
    write_spec(path, [pixels for pixels, _ in pairs], [spec for _, spec in pairs], extension[1:])


def encoded(
    extension: str,
    channels: Mapping[str, NDArray[Any]],
    encoding: Encoding,
    header: FrameFileHeader,
    *,
    several: bool = False,
) -> list[tuple[NDArray[Any], Any]]:
    """Encode one view of a frame: return the pixels and OpenImageIO's specification of each part of the file.

    extension: of the file, with the dot. A file that is not an EXR has only one part.
    several: True if the file has several views. Then the name of each part includes the view's name.
    """
    channels = {name: channels[name] for name in WRITABLE_CHANNELS if name in channels}
    if extension != ".exr":
        return [_picture(extension, channels, encoding, header)]
    groups = _parts(tuple(channels)) if encoding.parts == "several" else [tuple(channels)]
    view = header.view if several else ""
    names = [WRITABLE_CHANNELS[group[0]].part if len(groups) > 1 else "" for group in groups]
    named = [".".join(filter(None, (name, view))) for name in names]
    return [_exr_part(group, channels, encoding, header, name) for group, name in zip(groups, named, strict=True)]


def is_whole(
    path: Path,
    width: int,
    height: int,
    channels: Iterable[str],
    encoding: Encoding,
    attributes: Mapping[str, str | int | float] | None = None,
    *,
    deep: bool = False,
    views: int = 1,
) -> bool:
    """Return True if the file is complete and holds these channels as `write_channels` writes them.

    The image must have this size and a last row that decodes. If the file contains a disk block of zeros, every row
    must decode. Attributes of the file's header must have the values given in `attributes`, but may be absent.

    deep: expect a deep image, whose channels are DEEP_CHANNELS.
    views: number of views; each must have these channels.
    """
    channels = [name for name in WRITABLE_CHANNELS if name in set(channels)]
    exr = path.suffix.lower() == ".exr"
    groups = _parts(channels) if exr and encoding.parts == "several" else [tuple(channels)]
    if not path.is_file():
        return False
    try:
        image_size(path)  # rejects a truncated PNG before libpng prints a message about it
    except InputError:
        return False
    every_row = _has_zero_block(path)
    with opened(path) as source:
        if source is None:
            return False
        groups = groups * views
        for part, group in enumerate(groups):
            if not source.seek_subimage(part, 0):
                return False
            spec = source.spec()
            names = (
                DEEP_CHANNELS if deep else tuple(channel for name in group for channel in WRITABLE_CHANNELS[name].names)
            )
            if (spec.width, spec.height, spec.deep) != (width, height, deep):
                return False
            if sorted(spec.channelnames) != sorted(names):  # sorted, as OpenImageIO reorders channels
                return False
            if any(attribute_of(spec, key) not in (None, value) for key, value in (attributes or {}).items()):
                return False
            if not decodes(source, part, spec.height - 1) or (every_row and not decodes(source, part, 0)):
                return False
        return not source.seek_subimage(len(groups), 0)


def _has_zero_block(path: Path) -> bool:
    """Return True if a disk block of the file has only zeros, as after a crash before the block was written."""
    empty = bytes(_DISK_BLOCK_BYTES)
    with open(path, "rb") as file:
        return any(empty in block for block in iter(lambda: file.read(_DISK_BLOCK_BYTES << 8), b""))


def is_foreign(path: Path) -> bool:
    """Return True if a file is an image that another program than clsplat wrote."""
    with opened(path) as source:
        return source is not None and "clsplat" not in str(source.spec().getattribute("Software"))


def attribute(path: Path, name: str) -> Any:
    """Return the attribute `name` of a file's first part; None if the file lacks it or is not an image."""
    with opened(path) as source:
        return None if source is None else attribute_of(source.spec(), name)


def _parts(names: Sequence[str]) -> list[tuple[str, ...]]:
    """Group channel names, in the order of WRITABLE_CHANNELS, by the EXR part that holds them."""
    return [tuple(group) for _, group in groupby(names, lambda name: WRITABLE_CHANNELS[name].part)]


def _exr_part(
    names: Sequence[str], channels: Mapping[str, NDArray[Any]], encoding: Encoding, header: FrameFileHeader, part: str
) -> tuple[NDArray[Any], Any]:
    kinds = [WRITABLE_CHANNELS[name].kind for name in names for _ in WRITABLE_CHANNELS[name].names]
    planes = [np.atleast_3d(channels[name]) for name in names]
    if set(kinds) == {"whole"}:
        pixels = np.concatenate(planes, axis=2).astype(np.int64).astype(np.uint32)  # -1 becomes 2^32 - 1
        formats = [oiio.UINT32]
    else:
        formats = [oiio.HALF if kind == "colour" and encoding.depth == "half" else oiio.FLOAT for kind in kinds]
        pixels = np.empty((*planes[0].shape[:2], len(kinds)), np.float32)
        at = 0
        for name, plane in zip(names, planes, strict=True):
            _check_floats(name, plane)
            for channel in range(plane.shape[2]):
                if formats[at] == oiio.HALF:  # clipped, because larger values would become infinite
                    np.clip(plane[:, :, channel], -MAX_HALF_FLOAT, MAX_HALF_FLOAT, out=pixels[:, :, at])
                else:
                    pixels[:, :, at] = plane[:, :, channel]
                at += 1
    spec = _exr_spec(
        pixels.shape, [channel for name in names for channel in WRITABLE_CHANNELS[name].names], formats, header
    )
    deflated = encoding.compression.startswith("zip")
    spec.attribute("compression", f"{encoding.compression}:{_EXR_ZIP_LEVEL}" if deflated else encoding.compression)
    if part:
        spec.attribute("oiio:subimagename", part)
    return np.ascontiguousarray(pixels), spec


def _check_floats(name: str, plane: NDArray[Any]) -> None:
    if WRITABLE_CHANNELS[name].kind == "whole" and plane.max(initial=0) > _MAX_EXACT_FLOAT_INDEX:
        raise InputError(
            f"--channels {name}: the largest value is {plane.max():,}, which a float cannot hold exactly; use --parts "
            "several, which stores integers"
        )


def _picture(
    extension: str, channels: Mapping[str, NDArray[Any]], encoding: Encoding, header: FrameFileHeader
) -> tuple[NDArray[Any], Any]:
    planes = [np.atleast_3d(plane) for plane in channels.values()]
    if extension == ".png" and "alpha" in channels:
        planes = [unassociate(np.concatenate(planes, axis=2))]
    bits = 8 if extension in (".jpg", ".jpeg") else encoding.bits
    whole = steps_of(planes, bits)
    if bits == 10:  # OpenImageIO truncates 16 bits to 10, so this expands 10 to 16
        whole = (whole << 6) | (whole >> 4)
    spec = _spec(whole.shape, "RGBA", oiio.UINT8 if bits == 8 else oiio.UINT16, header)
    if extension in RECORD_TAGS and (text := record_text(header.attributes)):
        spec.attribute(RECORD_TAGS[extension], text)
    if extension == ".dpx":
        spec.attribute("oiio:BitsPerSample", bits)
        spec.attribute("oiio:Endian", "big")
    if extension == ".png":
        if not header.is_srgb:  # keeps OpenImageIO from writing the chunks sRGB, gAMA and cHRM
            spec.attribute("oiio:ColorSpace", "unknown")
        spec.attribute("oiio:UnassociatedAlpha", 1)
        spec.attribute("png:compressionLevel", _PNG_LEVEL)
        spec.attribute("png:filter", _PNG_FILTER)
    if extension in (".jpg", ".jpeg"):
        spec.attribute("Compression", f"jpeg:{encoding.quality}")
    return whole, spec


def deep_spec(width: int, height: int, encoding: Encoding, header: FrameFileHeader) -> Any:
    """Return OpenImageIO's specification of a deep EXR: colours in `encoding.depth`, half or float; depths in float."""
    spec = _exr_spec((height, width, len(DEEP_CHANNELS)), DEEP_CHANNELS, [oiio.FLOAT], header)
    spec.deep = True
    spec.channelformats = (oiio.TypeDesc(encoding.depth),) * 4 + (oiio.TypeDesc("float"),) * 2
    spec.z_channel = DEEP_CHANNELS.index("Z")
    spec.attribute("compression", encoding.compression if encoding.compression in ("none", "rle", "zips") else "zips")
    return spec


def _exr_spec(shape: tuple[int, ...], names: Sequence[str], formats: Sequence[Any], header: FrameFileHeader) -> Any:
    """Return OpenImageIO's specification of an EXR part.

    shape: height, width and number of channels.
    names: names of the channels.
    formats: pixel formats of the channels, or a single format for all.
    """
    several = len(set(formats)) > 1
    spec = _spec(shape, names, oiio.FLOAT if several else formats[0], header)
    if several:
        spec.channelformats = tuple(oiio.TypeDesc(one) for one in formats)
    if "A" in names:
        spec.alpha_channel = names.index("A")
    if header.view:
        spec.attribute("view", header.view)
    for name, matrix in header.matrices.items():
        spec.attribute(name, oiio.TypeMatrix, tuple(float(value) for value in matrix.ravel()))
    for name, (kind, value) in header.typed.items():
        spec.attribute(name, oiio.TypeDesc(kind), value)
    return spec


def _spec(shape: tuple[int, ...], names: Sequence[str], kind: Any, header: FrameFileHeader) -> Any:
    height, width, channels = shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.channelnames = tuple(names[:channels])
    if header.window is not None:
        spec.x, spec.y = header.window.x, header.window.y
        spec.full_x = spec.full_y = 0
        spec.full_width, spec.full_height = header.window.width, header.window.height
    if header.chromaticities:
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), tuple(header.chromaticities))
    spec.attribute("DateTime", "")  # OpenImageIO would write the current time, but equal frames need equal bytes
    for name, value in header.attributes.items():
        spec.attribute(name, value)
    return spec


def record_text(attributes: Mapping[str, Any]) -> str:
    """Return the provenance record for file formats without custom attributes: a text with the digests of model and
    settings. The text is '' if one of the digests is missing.

    attributes: header attributes of the frame.
    """
    model, settings = attributes.get(MODEL_DIGEST_ATTRIBUTE), attributes.get(SETTINGS_DIGEST_ATTRIBUTE)
    return f"clsplat model {model} settings {settings}" if model and settings else ""


def parse_record(text: object) -> dict[str, str]:
    """Return the digests in a provenance record from `record_text`, as attributes by name; {} for any other text."""
    match = _RECORD_PATTERN.search(str(text or ""))
    return {MODEL_DIGEST_ATTRIBUTE: match[1], SETTINGS_DIGEST_ATTRIBUTE: match[2]} if match else {}


def attribute_of(spec: Any, name: str) -> Any:
    """Return an attribute from OpenImageIO's specification of a file.

    If it is missing, it is taken from the file's provenance record; None if that lacks it too."""
    value = spec.getattribute(name)
    for place in dict.fromkeys(RECORD_TAGS.values()) if value is None else ():
        value = parse_record(spec.getattribute(place)).get(name) if value is None else value
    return value
