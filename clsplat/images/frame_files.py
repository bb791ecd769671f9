# SPDX-License-Identifier: Apache-2.0
"""Files of rendered frames: channels in EXR, one part or several, or a plain picture.

Alpha is associated in EXR, TIFF and DPX, unassociated in PNG. Matrices in the header are those of row
vectors, p_camera = p_world M, in the spaces that OpenEXR defines for its standard attributes (ImfStandardAttributes.h).
"""

from __future__ import annotations

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
from clsplat.config.channels import DEEP, WRITTEN
from clsplat.config.pictures import Encoding
from clsplat.errors import InputError, examples
from clsplat.images.alpha import unassociate
from clsplat.images.reading import decodes, image_size, opened
from clsplat.images.records import PLACES, attribute_of, record_text
from clsplat.images.writing import steps_of, write_spec

HALF_MAX = np.float32(65504)
_PNG_LEVEL, _PNG_FILTER = 1, 0x40
"""Each pixel from the mean of the two beside it, rather than the best of five filters for each row. A fifth of the time
of level 6, which can be more than a CPU device takes for the frame, for a file that is a tenth larger at most."""
_EXR_LEVEL = 1
"""Level of zip and zips: two thirds of the time of the usual 4, for 2 to 7 % more bytes."""
_LARGEST_FLOAT_INDEX = 2**24
_BLOCK = 1 << 12
"""Bytes of a disk's block."""

EXTENSIONS = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".dpx")
VIDEOS = (".mp4", ".mov")


@dataclass(frozen=True, eq=False)
class Header:
    """Contents of a file beside pixels; window: None where the picture is the display window; chromaticities: x and y
    of red, green, blue and white, none where they are not known; is_srgb: True if the colours are sRGB's; typed:
    attributes of EXR, with OpenImageIO's names of their types; view: left or right of a stereo pair."""

    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    matrices: Mapping[str, Float64] = field(default_factory=dict)
    window: Window | None = None
    chromaticities: Sequence[float] = ()
    is_srgb: bool = True
    typed: Mapping[str, tuple[str, Any]] = field(default_factory=dict)
    view: str = ""


def camera_matrices(camera: Camera) -> dict[str, Float64]:
    """worldToCamera and worldToNDC of row vectors, as OpenEXR defines them, for a camera that has an image plane; none
    for others.

    In the camera's space x is right, y up and z along the view, a left-handed frame. In NDC (0, 0) is the upper left
    corner of the display window, and (1, 1) the lower right one. OpenEXR says nothing of z: here it is 0 at the near
    plane and 1 at infinity. Of an orthographic camera it is 1 at the far plane, or without one grows by 1 a world unit.
    """
    if not camera.kind.flat:
        return {}
    to_camera = np.eye(4)
    flip = np.diag([1.0, -1.0, 1.0])
    to_camera[:3, :3] = (flip @ camera.rotation).T
    to_camera[3, :3] = flip @ camera.translation
    display = camera.window or camera
    centre = camera.cx / display.width, camera.cy / display.height
    projection = np.zeros((4, 4))
    projection[0, 0] = camera.fx / display.width
    projection[1, 1] = -camera.fy / display.height
    if camera.projection == "perspective":  # w = z
        projection[2] = [*centre, 1.0, 1.0]
        projection[3, 2] = -camera.near
    else:
        along = 1 / (camera.far - camera.near) if np.isfinite(camera.far) else 1.0
        projection[2, 2] = along
        projection[3] = [*centre, -along * camera.near, 1.0]
    return {"worldToCamera": to_camera, "worldToNDC": to_camera @ projection}


def is_whole_panorama(camera: Camera) -> bool:
    """True if the picture shows all directions once, the middle of it straight ahead, as EXR's envmap wants it."""
    if camera.projection != "equirectangular" or camera.window is not None:
        return False
    whole = (camera.fx * 2 * np.pi, camera.fy * np.pi, 2 * camera.cx, 2 * camera.cy)
    return bool(np.allclose(whole, (camera.width, camera.height) * 2, rtol=1e-9))


def parse_channels(text: str) -> tuple[str, ...]:
    """The names in `text`, comma-separated, in the order of WRITTEN. Raises InputError."""
    asked = [word.strip() for word in text.split(",") if word.strip()]
    unknown = [word for word in asked if word not in WRITTEN]
    if unknown or not asked:
        problem = f"has {examples(map(repr, unknown))}" if unknown else "is empty"
        raise InputError(f"--channels {text}: {problem}, expected some of {', '.join(WRITTEN)}")
    return tuple(name for name in WRITTEN if name in asked)


def check_format(path: str, channels: Iterable[str], *, video: bool = False) -> None:
    """Raise InputError where a file of that name cannot hold the channels. video: it may be one, too."""
    extension, known = Path(path).suffix.lower(), (*EXTENSIONS, *VIDEOS) if video else EXTENSIONS
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
    """Raise InputError as `check_format`, and for a folder that does not exist."""
    check_format(str(path), channels)
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder to write {path.name} to")


def write_channels(
    path: Path, channels: Mapping[str, NDArray[Any]], encoding: Encoding | None = None, header: Header | None = None
) -> None:
    """Write a frame, atomically.

    channels: by name, (H, W) or (H, W, channels); rgb as it is over black, so associated with alpha. In a part of whole
    numbers the id -1, where no Gaussian is, is 4294967295. Raises InputError and ClsplatError as `writing.write_image`.
    """
    write_views(path, [(channels, header or Header())], encoding)


def write_views(
    path: Path, views: Sequence[tuple[Mapping[str, NDArray[Any]], Header]], encoding: Encoding | None = None
) -> None:
    """`write_channels` of several views in one file: EXR, of which each has parts of its own, named after it."""
    encoding = encoding or Encoding()
    check_target(path, views[0][0])
    extension = path.suffix.lower()
    several = len(views) > 1
    pairs = [part for planes, header in views for part in encoded(extension, planes, encoding, header, several=several)]
    write_spec(path, [pixels for pixels, _ in pairs], [spec for _, spec in pairs], extension[1:])


def encoded(
    extension: str, channels: Mapping[str, NDArray[Any]], encoding: Encoding, header: Header, *, several: bool = False
) -> list[tuple[NDArray[Any], Any]]:
    """(pixels, OpenImageIO's specification) of each part of a file. several: the file has other views too, so that
    parts are named after theirs."""
    channels = {name: channels[name] for name in WRITTEN if name in channels}
    if extension != ".exr":
        return [_picture(extension, channels, encoding, header)]
    groups = _parts(tuple(channels)) if encoding.parts == "several" else [tuple(channels)]
    view = header.view if several else ""
    names = [WRITTEN[group[0]].part if len(groups) > 1 else "" for group in groups]
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
    """True if the file holds these channels as `write_channels` writes them, and is whole.

    It has to have that size and no other values of these attributes, and to decode to its last row; with a block of
    zeros in it every row is decoded. A file that was cut short fails. deep: expect a deep picture, whose channels are
    DEEP; views: of a stereo pair, each with these channels.
    """
    channels = [name for name in WRITTEN if name in set(channels)]
    exr = path.suffix.lower() == ".exr"
    groups = _parts(channels) if exr and encoding.parts == "several" else [tuple(channels)]
    if not path.is_file():
        return False
    try:
        image_size(path)  # finds a PNG that is cut short, of which libpng would print
    except InputError:
        return False
    holed = _has_hole(path)
    with opened(path) as source:
        if source is None:
            return False
        groups = groups * views
        for part, group in enumerate(groups):
            if not source.seek_subimage(part, 0):
                return False
            spec = source.spec()
            names = DEEP if deep else tuple(channel for name in group for channel in WRITTEN[name].names)
            if (spec.width, spec.height, spec.deep) != (width, height, deep):
                return False
            if sorted(spec.channelnames) != sorted(names):  # OpenImageIO has its own order of an EXR's
                return False
            if any(attribute_of(spec, key) not in (None, value) for key, value in (attributes or {}).items()):
                return False
            if not decodes(source, part, spec.height - 1) or (holed and not decodes(source, part, 0)):
                return False
        return not source.seek_subimage(len(groups), 0)


def _has_hole(path: Path) -> bool:
    """True if a block of the disk in the file is all zeros, as where a machine stopped before it was written."""
    empty = bytes(_BLOCK)
    with open(path, "rb") as file:
        return any(empty in block for block in iter(lambda: file.read(_BLOCK << 8), b""))


def is_foreign(path: Path) -> bool:
    """True if a file is a picture that clsplat has not made."""
    with opened(path) as source:
        return source is not None and "clsplat" not in str(source.spec().getattribute("Software"))


def attribute(path: Path, name: str) -> Any:
    """The value of an attribute of a file's first part, None where it has none or is no picture."""
    with opened(path) as source:
        return None if source is None else attribute_of(source.spec(), name)


def _parts(names: Sequence[str]) -> list[tuple[str, ...]]:
    """The channels of each part. Those of one part stand together in the table."""
    return [tuple(group) for _, group in groupby(names, lambda name: WRITTEN[name].part)]


def _exr_part(
    names: Sequence[str], channels: Mapping[str, NDArray[Any]], encoding: Encoding, header: Header, part: str
) -> tuple[NDArray[Any], Any]:
    kinds = [WRITTEN[name].kind for name in names for _ in WRITTEN[name].names]
    planes = [np.atleast_3d(channels[name]) for name in names]
    if set(kinds) == {"whole"}:
        pixels = np.concatenate(planes, axis=2).astype(np.int64).astype(np.uint32)  # -1 becomes the largest
        formats = [oiio.UINT32]
    else:
        formats = [oiio.HALF if kind == "colour" and encoding.depth == "half" else oiio.FLOAT for kind in kinds]
        pixels = np.empty((*planes[0].shape[:2], len(kinds)), np.float32)
        at = 0
        for name, plane in zip(names, planes, strict=True):
            _check_floats(name, plane)
            for channel in range(plane.shape[2]):
                if formats[at] == oiio.HALF:  # else what is over its largest would become infinite
                    np.clip(plane[:, :, channel], -HALF_MAX, HALF_MAX, out=pixels[:, :, at])
                else:
                    pixels[:, :, at] = plane[:, :, channel]
                at += 1
    spec = _exr_spec(pixels.shape, [channel for name in names for channel in WRITTEN[name].names], formats, header)
    deflated = encoding.compression.startswith("zip")
    spec.attribute("compression", f"{encoding.compression}:{_EXR_LEVEL}" if deflated else encoding.compression)
    if part:
        spec.attribute("oiio:subimagename", part)
    return np.ascontiguousarray(pixels), spec


def _check_floats(name: str, plane: NDArray[Any]) -> None:
    if WRITTEN[name].kind == "whole" and plane.max(initial=0) > _LARGEST_FLOAT_INDEX:
        raise InputError(
            f"--channels {name}: the largest is {plane.max():,}, more than a float holds exactly; use --parts several, "
            "where it is a whole number"
        )


def _picture(
    extension: str, channels: Mapping[str, NDArray[Any]], encoding: Encoding, header: Header
) -> tuple[NDArray[Any], Any]:
    planes = [np.atleast_3d(plane) for plane in channels.values()]
    if extension == ".png" and "alpha" in channels:
        planes = [unassociate(np.concatenate(planes, axis=2))]
    bits = 8 if extension in (".jpg", ".jpeg") else encoding.bits
    whole = steps_of(planes, bits)
    if bits == 10:  # OpenImageIO cuts off what 16 bits have more, so that these have to be those of the ten
        whole = (whole << 6) | (whole >> 4)
    spec = _spec(whole.shape, "RGBA", oiio.UINT8 if bits == 8 else oiio.UINT16, header)
    if extension in PLACES and (text := record_text(header.attributes)):
        spec.attribute(PLACES[extension], text)
    if extension == ".dpx":
        spec.attribute("oiio:BitsPerSample", bits)
        spec.attribute("oiio:Endian", "big")
    if extension == ".png":
        if not header.is_srgb:  # else OpenImageIO says so in the chunks sRGB, gAMA and cHRM
            spec.attribute("oiio:ColorSpace", "unknown")
        spec.attribute("oiio:UnassociatedAlpha", 1)
        spec.attribute("png:compressionLevel", _PNG_LEVEL)
        spec.attribute("png:filter", _PNG_FILTER)
    if extension in (".jpg", ".jpeg"):
        spec.attribute("Compression", f"jpeg:{encoding.quality}")
    return whole, spec


def deep_spec(width: int, height: int, encoding: Encoding, header: Header) -> Any:
    """OpenImageIO's specification of a deep EXR: colours are half or float as the encoding says, depths are float."""
    spec = _exr_spec((height, width, len(DEEP)), DEEP, [oiio.FLOAT], header)
    spec.deep = True
    spec.channelformats = (oiio.TypeDesc(encoding.depth),) * 4 + (oiio.TypeDesc("float"),) * 2
    spec.z_channel = DEEP.index("Z")
    spec.attribute("compression", encoding.compression if encoding.compression in ("none", "rle", "zips") else "zips")
    return spec


def _exr_spec(shape: tuple[int, ...], names: Sequence[str], formats: Sequence[Any], header: Header) -> Any:
    """formats: of the channels, or the one of all."""
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


def _spec(shape: tuple[int, ...], names: Sequence[str], kind: Any, header: Header) -> Any:
    height, width, channels = shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.channelnames = tuple(names[:channels])
    if header.window is not None:
        spec.x, spec.y = header.window.x, header.window.y
        spec.full_x = spec.full_y = 0
        spec.full_width, spec.full_height = header.window.width, header.window.height
    if header.chromaticities:
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), tuple(header.chromaticities))
    spec.attribute("DateTime", "")  # OpenImageIO's default is now, and the same frame is to have the same bytes
    for name, value in header.attributes.items():
        spec.attribute(name, value)
    return spec
