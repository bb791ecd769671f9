# SPDX-License-Identifier: Apache-2.0
"""Model files: a module for each format, chosen by the file's ending, or by its first bytes where these say otherwise.

`FORMATS` is the table of the formats, a row each, and the only place that lists them. A format's module cites the
specification in its docstring, and says there what the format has in place of our conventions (docs/conventions.md).
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

from clsplat.camera import NEAR, NEARS
from clsplat.errors import InputError, warn
from clsplat.files import is_file, open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.images.colour import recorded_space
from clsplat.models.codec import soundness
from clsplat.models.codec.gltf_asset import EXTENSION
from clsplat.models.codec.ply_file import MAX_HEADER_BYTES
from clsplat.models.codec.soundness import Activated
from clsplat.models.formats import compressed_ply, gltf, ksplat, ply, sog, splat, spz, usd, zipped

HEAD_BYTES = 1 << 16
SAMPLED = 10_000
"""Means that tell how large a model is."""
SMALL = 10.0
"""Near planes in the size of a model that the usual one does not suit."""


@dataclass(frozen=True)
class Format:
    """A row of the table.

    name: for messages; suffixes: endings of its files in lower case, one without a dot is a whole name; read(path):
    the Gaussians, raises InputError, one line with the path, for a file that is damaged; write(path, gaussians,
    **options): atomic, None for a format that is only read; recognises(head): True if the first bytes, HEAD_BYTES at
    most, are of the format, None where it has no beginning of its own.

    loses: what the format does not keep, in a few words; floats: True if it keeps floats; sh_degree: the highest that
    it holds; describe(path): the format's part of `clsplat info`; order(gaussians): (n,), the Gaussian of each row of
    a written file, None for their own order; blocks(path): the Gaussians in the world some rows at a time, for a format
    that need not be held whole; side_files(path): the other files of a model of this name; space(path): of its colours;
    marks: bytes of which a file with Gaussians has one in its beginning, none where a file of the format always has.
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


ZIP = ".zip"
UNIT_QUATERNIONS = "nothing but the quaternions' lengths and the logits of opacities next to 0 and 1"

_IN_ZIP = zipped.Inside(
    lambda path: is_model_name(path) and path.suffix.lower() != ZIP,
    lambda path, head: _has_mark(path, head),  # noqa: PLW0108
    lambda path: resolve(path),  # noqa: PLW0108  # which goes by the table
)

FORMATS: tuple[Format, ...] = (
    Format("compressed PLY", (".compressed.ply",), compressed_ply.read, compressed_ply.write, compressed_ply.recognises,
           loses="position and scale to 10 or 11 bits of a chunk's range, rotation to 10, colour and opacity to 8, SH "
                 "to 1/32", describe=compressed_ply.describe, order=compressed_ply.order),
    Format("glTF", (".gltf", ".glb"), gltf.read, gltf.write, gltf.recognises,
           loses=UNIT_QUATERNIONS, floats=True, describe=gltf.describe, side_files=gltf.side_files,
           marks=(EXTENSION.encode(),)),
    Format("ksplat", (".ksplat",), ksplat.read, loses="not written here", describe=ksplat.describe),
    Format("3DGS PLY", (".ply",), ply.read, ply.write, ply.recognises,
           loses="nothing", floats=True, describe=ply.describe, blocks=ply.blocks,
           marks=(ply.SCALE[0].encode(), b"packed_position")),
    Format("SOG", ("meta.json", ".sog"), sog.read, sog.write, sog.recognises,
           loses="positions to 16 bits, the rest to 8, spherical harmonics to a palette",
           describe=sog.describe, side_files=sog.side_files, marks=(b'"means"', b"PK")),
    Format("splat", (".splat",), splat.read, splat.write,
           loses="SH beyond degree 0; colour, opacity and rotation to 8 bits, colour beyond 0 to 1", sh_degree=0),
    Format("SPZ", (".spz",), spz.read, spz.write, spz.recognises,
           loses="positions to 24 bits fixed point, the rest to 8 or 10 bits, spherical harmonics to 6",
           describe=spz.describe),
    Format("OpenUSD", (".usda", ".usdc", ".usdz", ".usd"), usd.read, usd.write, usd.recognises,
           loses=UNIT_QUATERNIONS, floats=True, describe=usd.describe, space=usd.recorded_space),
    Format("zipped model", (ZIP,), _IN_ZIP.read, recognises=zipped.recognises, loses="not written here",
           describe=_IN_ZIP.describe, space=_IN_ZIP.space),
)  # fmt: skip
"""All formats. Of two that recognise the same first bytes the earlier counts."""


def suffixes(*, writable: bool = False) -> list[str]:
    """The endings that are known, or those of formats that can be written."""
    return sorted(suffix for row in FORMATS if row.write or not writable for suffix in row.suffixes)


def _named(path: Path) -> Format | None:
    """The format of the longest ending that fits."""
    name = path.name.lower()
    fits = [
        (len(suffix), row)
        for row in FORMATS
        for suffix in row.suffixes
        if (name.endswith(suffix) if suffix.startswith(".") else name == suffix)
    ]
    return max(fits, key=lambda fit: fit[0])[1] if fits else None


def format_of_name(path: str | os.PathLike[str], *, writable: bool = False) -> Format:
    """The format by the name alone. Raises InputError for an ending that is not known, or not written if it should
    be."""
    named = _named(Path(path))
    known = " ".join(suffixes(writable=writable))
    if named is None:
        raise InputError(f"{path}: the ending is none of a model file, expected one of {known}")
    if writable and named.write is None:
        raise InputError(f"{path}: {named.name} is read only, expected one of {known}")
    return named


def format_of(path: Path) -> Format:
    """The format by the name, unless the first bytes are another format's. Raises InputError, also where there is no
    such file."""
    named = _named(path)
    if named is not None and path.is_dir():  # the reader knows whether it may be one
        return named
    with open_input(path, f"a model file, its ending one of {' '.join(suffixes())}") as file:
        head = file.read(HEAD_BYTES)
        if head.startswith(b"ply") and b"end_header" not in head:  # long comments: the properties are further on
            head += file.read(MAX_HEADER_BYTES)
    # of a format without a beginning of its own another's counts, but for JSON's, which says too little
    fits = named and (named.recognises(head) if named.recognises else head.lstrip()[:1] == b"{")
    if head.startswith(zipped.FILE) and (not fits or named is _row("SOG")):
        return _archive(path, named)
    others = () if fits else (row for row in FORMATS if row.recognises and row.recognises(head))
    return next(iter(others), named) or format_of_name(path)


def _archive(path: Path, named: Format | None) -> Format:
    """The format of an archive that is none of OpenUSD or .zip by its name: SOG if one of its files is SOG's, or it is
    named so and has no model of another format."""
    names = _IN_ZIP.names(path)
    is_sog = sog.META in names or (named is _row("SOG") and not names)
    return _row("SOG" if is_sog else "zipped model")


def _row(name: str) -> Format:
    return next(row for row in FORMATS if row.name == name)


def _has_mark(path: Path, head: bytes) -> bool:
    """False for a file of a model's name whose beginning has none of its format's marks."""
    named = _named(path)
    return named is not None and (not named.marks or any(mark in head for mark in named.marks))


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, Format]]:
    """The model's file and its format, of a zipped model those in the archive; the file is there for as long. Raises
    InputError as `resolve`, and as `zipped.unpacked`."""
    file, row = path, format_of(path)
    with _IN_ZIP.model(path) if row is _row("zipped model") else nullcontext((file, row)) as found:
        yield found


def resolve(path: Path) -> tuple[Path, Format]:
    """The model's file, where `path` may be the folder of one, and its format. Raises InputError as `format_of`. Warns
    where the name says that the file is of another format."""
    path = model_path(path)
    row = format_of(path)
    if path.suffix.lower() not in {Path(f"x{suffix}").suffix for suffix in row.suffixes}:
        warn(f"{path}: is {row.name} by its content, whatever its name says")
    return path, row


def is_model_name(path: Path) -> bool:
    """True if the ending is one of a model file."""
    return _named(path) is not None


def model_path(path: Path) -> Path:
    """The file in a folder that is a model, for the formats that have a name for it; else the path itself."""
    names = (suffix for suffix in suffixes() if not suffix.startswith("."))
    return next((path / name for name in names if is_file(path / name)), path)


def load(path: str | os.PathLike[str], *, activated: Activated | None = None, doubts: bool = True) -> Gaussians:
    """Read a model file of any format; `soundness.sound` of it. activated: what the file has in place of its logits or
    logs, which are taken of it; else a warning says where this seems to be needed, unless doubts is False. Raises
    InputError naming the file and the trouble."""
    path, row = resolve(Path(path))
    gaussians = soundness.sound(row.read(path), path, activated)
    for text in soundness.doubts(gaussians.opacity_logits, gaussians.log_scales) if doubts else ():
        warn(f"{path}: {text}")
    if gaussians.near == NEAR:
        gaussians.near = _near_of(gaussians)
    return gaussians


def colour_space(path: str | os.PathLike[str]) -> str:
    """The space of a model file's colours, sRGB where it does not say. Raises InputError."""
    path = model_path(Path(path))
    return format_of(path).space(path)


def _near_of(gaussians: Gaussians) -> float:
    """The near plane of a model that comes without one: the usual, unless the model would be lost behind it."""
    some = gaussians.means[:: max(len(gaussians) // SAMPLED, 1)].astype(np.float64)
    size = float(np.median(np.linalg.norm(some - np.median(some, axis=0), axis=1)))
    return size / NEARS if 0 < size < SMALL * NEAR else NEAR


def save(path: str | os.PathLike[str], gaussians: Gaussians, **options: Any) -> None:
    """Write a model file, atomically, in the format of the name. options: of the format's `write`; those that it has
    not are passed over. Raises InputError for an ending that is not written."""
    write = format_of_name(path, writable=True).write
    assert write is not None
    known = inspect.signature(write).parameters
    write(Path(path), gaussians, **{name: value for name, value in options.items() if name in known})
