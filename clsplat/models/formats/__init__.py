# SPDX-License-Identifier: Apache-2.0
"""Model formats, a module for each. The file's suffix selects the format, unless its first bytes say otherwise.

`models.codec.repair` repairs or drops Gaussians with NaN, infinities or zero quaternions when a file is read.

MODEL_FORMATS is the only place that lists the formats, one row each. The docstring of a format's module cites the
specification and lists the conventions that differ from clsplat's (docs/conventions.md).
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import DEFAULT_NEAR_PLANE, MIN_SIZE_IN_NEAR_PLANES
from clsplat.errors import InputError, warn
from clsplat.files.documents import is_file, open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.images.colour import recorded_space
from clsplat.models.codec import repair
from clsplat.models.codec.gltf_asset import GAUSSIAN_EXTENSION
from clsplat.models.codec.ply_file import MAX_PLY_HEADER_BYTES
from clsplat.models.codec.repair import Activated
from clsplat.models.formats import compressed_ply, gltf, ksplat, ply, sog, splat, spz, usd, zipped

FORMAT_HEAD_BYTES = 1 << 16
"""Number of bytes at a file's beginning by which its format is recognised."""
MODEL_SIZE_SAMPLES = 10_000
"""Number of means that are sampled to estimate a model's size."""
SMALL_MODEL_NEAR_PLANES = 10.0
"""Size of a model, in multiples of the default near plane, below which the default would clip too much of the model."""


@dataclass(frozen=True)
class Format:
    """A model format: a row of MODEL_FORMATS.

    name: its name in messages.
    suffixes: lower-case suffixes of its files; a suffix without a dot is a whole file name.
    read(path): reads the Gaussians. Raises InputError, one line with the path, for a damaged file.
    write(path, gaussians, **options): writes a file atomically; None for a read-only format.
    recognises(head): True if the first bytes of a file, up to FORMAT_HEAD_BYTES, show the format; None if it has no
        signature.
    loses: short description of the information that the format does not keep.
    floats: True if it stores values as floats.
    sh_degree: the highest SH degree that it stores.
    describe(path): details of a file for `clsplat info`, by name.
    order(gaussians): index (n,) of the Gaussian in each row of a written file; None if the order is kept.
    blocks(path): yields the Gaussians in world coordinates in blocks of rows; None if the file is read at once.
    side_files(path): the other files of the model at this path.
    space(path): the model's colour space.
    marks: byte strings. A file with Gaussians has at least one of them near its beginning. Empty if every file of the
        format has Gaussians.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path], Gaussians]
    write: Callable[..., None] | None = None
    recognises: Callable[[bytes], bool] | None = None
    _: KW_ONLY
    loses: str
    floats: bool = False
    sh_degree: int = MAX_SH_DEGREE
    describe: Callable[[Path], dict[str, Any]] = lambda _: {}
    order: Callable[[Gaussians], NDArray[np.int64]] | None = None
    blocks: Callable[[Path], Iterator[Gaussians]] | None = None
    side_files: Callable[[Path], list[Path]] = lambda _: []
    space: Callable[[Path], str] = recorded_space
    marks: tuple[bytes, ...] = ()


ZIP_SUFFIX = ".zip"
UNIT_QUATERNION_LOSS = "nothing but the quaternions' lengths and the logits of opacities next to 0 and 1"

_ZIPPED_MODEL = zipped.ZipReader(
    lambda path: is_model_name(path) and path.suffix.lower() != ZIP_SUFFIX,
    lambda path, head: _has_mark(path, head),  # noqa: PLW0108
    lambda path: resolve(path),  # noqa: PLW0108  # `resolve` is defined below
)

MODEL_FORMATS: tuple[Format, ...] = (
    Format("compressed PLY", (".compressed.ply",), compressed_ply.read, compressed_ply.write, compressed_ply.recognises,
           loses="position and scale to 10 or 11 bits of a chunk's range, rotation to 10, colour and opacity to 8, SH "
                 "to 1/32", describe=compressed_ply.describe, order=compressed_ply.order),
    Format("glTF", (".gltf", ".glb"), gltf.read, gltf.write, gltf.recognises,
           loses=UNIT_QUATERNION_LOSS, floats=True, describe=gltf.describe, side_files=gltf.side_files,
           marks=(GAUSSIAN_EXTENSION.encode(),)),
    Format("ksplat", (".ksplat",), ksplat.read, loses="clsplat does not write this format", describe=ksplat.describe),
    Format("3DGS PLY", (".ply",), ply.read, ply.write, ply.recognises,
           loses="nothing", floats=True, describe=ply.describe, blocks=ply.blocks,
           marks=(ply.SCALE_PROPERTIES[0].encode(), b"packed_position")),
    Format("SOG", ("meta.json", ".sog"), sog.read, sog.write, sog.recognises,
           loses="positions to 16 bits, the rest to 8, spherical harmonics to a palette",
           describe=sog.describe, side_files=sog.side_files, marks=(b'"means"', b"PK")),
    Format("splat", (".splat",), splat.read, splat.write,
           loses="SH beyond degree 0; colour, opacity and rotation to 8 bits, colour beyond 0 to 1", sh_degree=0),
    Format("SPZ", (".spz",), spz.read, spz.write, spz.recognises,
           loses="positions to 24 bits fixed point, the rest to 8 or 10 bits, spherical harmonics to 6",
           describe=spz.describe),
    Format("OpenUSD", (".usda", ".usdc", ".usdz", ".usd"), usd.read, usd.write, usd.recognises,
           loses=UNIT_QUATERNION_LOSS, floats=True, describe=usd.describe, space=usd.recorded_space),
    Format("zipped model", (ZIP_SUFFIX,), _ZIPPED_MODEL.read, recognises=zipped.recognises,
           loses="clsplat does not write this format", describe=_ZIPPED_MODEL.describe, space=_ZIPPED_MODEL.space),
)  # fmt: skip
"""All formats. A file has the format of its suffix, unless its first bytes belong to other formats (`recognises`). Then
it has the first of these formats."""


def suffixes(*, writable: bool = False) -> list[str]:
    """Suffixes of all formats, sorted. writable: only of formats that can be written."""
    return sorted(suffix for row in MODEL_FORMATS if row.write or not writable for suffix in row.suffixes)


def _named(path: Path) -> Format | None:
    """Format with the longest suffix that the file's name ends with; None if it ends with no format's suffix."""
    name = path.name.lower()
    fits = [
        (len(suffix), row)
        for row in MODEL_FORMATS
        for suffix in row.suffixes
        if (name.endswith(suffix) if suffix.startswith(".") else name == suffix)
    ]
    return max(fits, key=lambda fit: fit[0])[1] if fits else None


def format_of_name(path: str | os.PathLike[str], *, writable: bool = False) -> Format:
    """Format that the suffix of a file's name belongs to.

    Raises InputError for an unknown suffix and, if `writable`, for a read-only format.
    """
    named = _named(Path(path))
    known = " ".join(suffixes(writable=writable))
    if named is None:
        raise InputError(f"{path}: does not have the suffix of a model file, expected one of {known}")
    if writable and named.write is None:
        raise InputError(f"{path}: {named.name} files cannot be written, expected one of {known}")
    return named


def format_of(path: Path) -> Format:
    """Format of a file: the format of its name, unless the first bytes belong to another. Raises InputError."""
    named = _named(path)
    if named is not None and path.is_dir():  # the format's reader checks the folder's contents
        return named
    with open_input(path, f"a model file with one of the suffixes {' '.join(suffixes())}") as file:
        head = file.read(FORMAT_HEAD_BYTES)
        if head.startswith(b"ply") and b"end_header" not in head:  # long comments: read on, to the header's end
            head += file.read(MAX_PLY_HEADER_BYTES)
    # A format without a signature is recognised by the file's name, unless the file begins with another's signature.
    # The "{" with which JSON begins is no such signature: the first byte of any file may be a "{" by chance.
    fits = named and (named.recognises(head) if named.recognises else head.lstrip()[:1] == b"{")
    if head.startswith(zipped.ZIP_FILE_MAGIC) and (not fits or named is _row("SOG")):
        return _archive(path, named)
    others = () if fits else (row for row in MODEL_FORMATS if row.recognises and row.recognises(head))
    return next(iter(others), named) or format_of_name(path)


def _archive(path: Path, named: Format | None) -> Format:
    """Format of a zip archive whose name is not that of a .zip or OpenUSD file.

    The format is SOG if the archive contains SOG's meta.json, or has SOG's suffix and contains no other model.
    Otherwise it is a zipped model. named: the format of the archive's name; None if the suffix is unknown.
    """
    names = _ZIPPED_MODEL.names(path)
    is_sog = sog.SOG_META_FILE in names or (named is _row("SOG") and not names)
    return _row("SOG" if is_sog else "zipped model")


def _row(name: str) -> Format:
    return next(row for row in MODEL_FORMATS if row.name == name)


def _has_mark(path: Path, head: bytes) -> bool:
    """True if a file has a model format's suffix, and its first bytes, `head`, contain one of the format's `marks`.

    The suffix is enough if the format has no marks.
    """
    named = _named(path)
    return named is not None and (not named.marks or any(mark in head for mark in named.marks))


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, Format]]:
    """Context manager that yields a model's file and its format.

    A zipped model is unpacked, and the unpacked file is removed at the end. Raises InputError like `resolve` and
    `zipped.unpacked`.
    """
    file, row = path, format_of(path)
    with _ZIPPED_MODEL.model(path) if row is _row("zipped model") else nullcontext((file, row)) as found:
        yield found


def resolve(path: Path) -> tuple[Path, Format]:
    """Return the path of the model file and its format. path: the file, or the folder of a model.

    Raises InputError like `format_of`. Warns if the file's name has the suffix of another format.
    """
    path = model_path(path)
    row = format_of(path)
    if path.suffix.lower() not in {Path(f"x{suffix}").suffix for suffix in row.suffixes}:
        warn(f"{path}: is {row.name} by its content, in spite of its name, and is read as such")
    return path, row


def is_model_name(path: Path) -> bool:
    """True if a path has the suffix of a model file."""
    return _named(path) is not None


def model_path(path: Path) -> Path:
    """The model file in a folder, for formats with a fixed file name; otherwise the path itself."""
    names = (suffix for suffix in suffixes() if not suffix.startswith("."))
    return next((path / name for name in names if is_file(path / name)), path)


def load(path: str | os.PathLike[str], *, activated: Activated | None = None, check_encoding: bool = True) -> Gaussians:
    """Read a model file of any format, and repair its values (`repair.repaired`).

    activated: the values that the file stores as opacities or scales; they are converted to logits or logs of scales.
        None means that the file stores logits and logs.
    check_encoding: warn if the values look like opacities or scales, although they are read as logits or logs.
    Raises InputError.
    """
    path, row = resolve(Path(path))
    gaussians = repair.repaired(row.read(path), path, activated)
    for text in repair.encoding_warnings(gaussians.opacity_logits, gaussians.log_scales) if check_encoding else ():
        warn(f"{path}: {text}")
    if gaussians.near == DEFAULT_NEAR_PLANE:
        gaussians.near = _near_of(gaussians)
    return gaussians


def colour_space(path: str | os.PathLike[str]) -> str:
    """Colour space of a model file; sRGB if the file records none. Raises InputError."""
    path = model_path(Path(path))
    return format_of(path).space(path)


def _near_of(gaussians: Gaussians) -> float:
    """Near plane for a model whose file has none: DEFAULT_NEAR_PLANE of `camera`, or less for a tiny model."""
    some = gaussians.means[:: max(len(gaussians) // MODEL_SIZE_SAMPLES, 1)].astype(np.float64)
    size = float(np.median(np.linalg.norm(some - np.median(some, axis=0), axis=1)))
    return (
        size / MIN_SIZE_IN_NEAR_PLANES
        if 0 < size < SMALL_MODEL_NEAR_PLANES * DEFAULT_NEAR_PLANE
        else DEFAULT_NEAR_PLANE
    )


def save(path: str | os.PathLike[str], gaussians: Gaussians, **options: Any) -> None:
    """Write a model file atomically, in the format of its suffix.

    options: keyword arguments for the format's `write`; arguments that it does not have are ignored.
    Raises InputError for an unknown suffix or a read-only format.
    """
    write = format_of_name(path, writable=True).write
    assert write is not None
    known = inspect.signature(write).parameters
    write(Path(path), gaussians, **{name: value for name, value in options.items() if name in known})
