# SPDX-License-Identifier: Apache-2.0
"""SPZ, Niantic's compressed models: versions 2, 3 (gzip) and 4 (a Zstandard stream for each attribute).

Specification: https://github.com/nianticlabs/spz (README.md and src/cc/load-spz.cc). Attributes are stored one after
another, each for all Gaussians: positions, alphas, colours, scales, rotations, spherical harmonics.

- Axes: x right, y up, z backward (RUB), half a turn about x from clsplat's. An extension by Adobe may set other axes;
  other extensions are ignored.
- Positions: 24-bit fixed point with `fractional_bits` after the point.
- Alphas: opacity in steps of 1/255.
- Colours: SH coefficient 0 in steps of 1/38.25, within +-3.33.
- Scales: natural logs in steps of 1/16, -10 to 5.94.
- Rotations: x y z w. Version 2 stores x y z in steps of 1/127.5, with w positive. Later versions leave out the largest
  component and store its index in 2 bits. The others take 10 bits each: a sign, and steps of 1/723.
- SH: the basis functions, their order and signs are clsplat's, in the file's axes. Red, green and blue of a
  coefficient are adjacent. Values are in steps of 1/128 within +-1. Writers round to fewer bits for better compression.
"""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.errors import InputError, warn
from clsplat.files.atomic import atomic_writer
from clsplat.files.documents import open_input
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.models.codec import values
from clsplat.models.codec.axes import RUB_SIGNS, Signs, flip, quaternion_signs, sh_signs

SPZ_MAGIC, GZIP_MAGIC = b"NGSP", b"\x1f\x8b"
Bytes = NDArray[np.uint8]
Stream = Any
"""A file, or a gzip or Zstandard reader."""
SPZ_VERSIONS = (2, 3, 4)
DEFAULT_SPZ_VERSION = 3
"""Version that most web readers accept (docs/formats.md). Niantic's library and splat-transform write 4."""
DEFAULT_SH_BITS = (6, 6)
"""Numbers of bits to which SH coefficients are quantised: in band 1, and in the higher bands. Files do not record them.

Niantic's library keeps 5 and 4 bits. Its files are a fifth smaller, but renders of a trained model with strong view
dependence are 11 dB worse, at 36 dB (docs/formats.md).
"""
ANTIALIASED_FLAG, EXTENSIONS_FLAG = 1, 2
COORDINATE_SYSTEM_EXTENSION = 0xADBE0003
COORDINATE_SYSTEM_SIGNS: tuple[Signs, ...] = (
    *(RUB_SIGNS, (-1, 1, -1), (1, 1, -1), (-1, -1, -1), RUB_SIGNS),  # file's axes: unspecified, LDB, RDB, LUB, RUB
    *((-1, 1, 1), (1, 1, 1), (-1, -1, 1), (1, -1, 1)),  # LDF, RDF, LUF, RUF
)
"""Factors of x, y and z that convert between clsplat's axes and a file's. The index is the value of the file's
coordinate system extension. Larger values have z up, which clsplat does not read."""
MAX_EXTENSION_BYTES = 1 << 20
MAX_ZSTD_WINDOW_BYTES = 1 << 27
"""Largest window in bytes that a Zstandard frame may require: the default limit of the Zstandard library."""
COLOUR_STEPS_PER_UNIT = 0.15 * 255
SQRT_HALF = 0.5**0.5


@dataclass(frozen=True)
class SpzHeader:
    """Header of an SPZ file.

    degree: SH degree.
    fractional_bits: number of bits after the binary point of a position.
    flags: ANTIALIASED_FLAG and EXTENSIONS_FLAG, as bits.
    streams, table: number of Zstandard streams, and byte offset of their table; 0 before version 4.
    """

    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    streams: int = 0
    table: int = 0

    @property
    def widths(self) -> dict[str, int]:
        """Number of bytes of each attribute of a Gaussian, by name and in the file's order."""
        rest = 3 * (self.degree * (self.degree + 2))
        rotations = 3 if self.version == 2 else 4
        widths = {"positions": 9, "alphas": 1, "colours": 3, "scales": 3, "rotations": rotations}
        return widths | ({"sh": rest} if rest else {})


def recognises(head: bytes) -> bool:
    """True if a file begins like an SPZ file."""
    if head[:2] != GZIP_MAGIC:
        return head.startswith(SPZ_MAGIC)
    try:
        return zlib.decompressobj(31).decompress(head, 4) == SPZ_MAGIC
    except zlib.error:
        return False


def describe(path: Path) -> dict[str, Any]:
    """Details of a file for `clsplat info`: version, fractional bits and antialiasing."""
    with open_input(path, "an SPZ file") as file:
        header, _ = _open(file, os.fstat(file.fileno()).st_size, path)
    antialiased = bool(header.flags & ANTIALIASED_FLAG)
    return {"version": header.version, "fractional_bits": header.fractional_bits, "antialiased": antialiased}


def read(path: Path) -> Gaussians:
    """Read an SPZ file. SH coefficients of degree 4 are left out. Raises InputError."""
    with open_input(path, "an SPZ file") as file:
        return read_from(file, os.fstat(file.fileno()).st_size, path)


def read_from(file: BinaryIO, size: int, path: Path) -> Gaussians:
    """Read an SPZ file of `size` bytes from the start of `file`. path: for messages."""
    header, stream = _open(file, size, path)
    values.require_count(path, header.count, size)
    if header.degree > MAX_SH_DEGREE:
        warn(f"{path}: has SH of degree {header.degree}; coefficients above degree {MAX_SH_DEGREE} are left out")
    result = values.empty(header.count, min(header.degree, MAX_SH_DEGREE))
    result.antialiased = bool(header.flags & ANTIALIASED_FLAG)
    if header.version == 4:
        signs = _axis_signs(file.read(header.table - 32), path) if header.flags & EXTENSIONS_FLAG else RUB_SIGNS
        _unpack(_zstd_streams(file, header, size, path), header, signs, result, path)
        return result
    assert stream is not None
    _unpack(((name, stream) for name in header.widths), header, RUB_SIGNS, result, path)
    behind = _rest(stream, path)
    if len(behind) > MAX_EXTENSION_BYTES and isinstance(stream, gzip.GzipFile):
        raise InputError(
            f"{path}: unpacks to more than {header.count} Gaussians: over {MAX_EXTENSION_BYTES} bytes follow, expected "
            "only extensions; is it damaged?"
        )
    if header.flags & EXTENSIONS_FLAG and (signs := _axis_signs(behind, path)) != RUB_SIGNS:
        flip(result, (signs[0] * RUB_SIGNS[0], signs[1] * RUB_SIGNS[1], signs[2] * RUB_SIGNS[2]))
    elif behind and not header.flags & EXTENSIONS_FLAG:
        warn(f"{path}: bytes after the last Gaussian are ignored")
    return result


def _open(file: BinaryIO, size: int, path: Path) -> tuple[SpzHeader, Any]:
    """Read the header of a file of `size` bytes. Returns the header, and the stream with the attributes.

    The stream is None in version 4, which has a stream for each attribute (`_zstd_streams`).
    """
    head = file.read(32)
    if head[:4] == SPZ_MAGIC and head[4:8] == struct.pack("<I", 4):
        if len(head) < 32:
            raise InputError(f"{path}: truncated: has {len(head)} bytes, expected a header of 32")
        header = SpzHeader(4, *struct.unpack("<IBBBBI", head[8:20]))
        _check(header, path)
        expected = len(header.widths)
        if header.streams != expected:
            raise InputError(f"{path}: SPZ has {header.streams} streams, expected {expected}")
        if not 32 <= header.table <= min(32 + MAX_EXTENSION_BYTES, size - 16 * expected):
            raise InputError(f"{path}: SPZ's table of streams is at byte {header.table} of {size}; is it damaged?")
        return header, None
    if head[:2] != GZIP_MAGIC and head[:4] != SPZ_MAGIC:
        raise InputError(f"{path}: not an SPZ file (it begins with neither gzip's signature nor NGSP)")
    file.seek(0)
    stream = gzip.GzipFile(fileobj=file, mode="rb") if head[:2] == GZIP_MAGIC else file
    start = _next(stream, 16, path, "the header")
    if start[:4] != SPZ_MAGIC:
        raise InputError(f"{path}: not an SPZ file (its gzip stream does not begin with NGSP)")
    header = SpzHeader(*struct.unpack("<IIBBB", start[4:15]))
    _check(header, path)
    return header, stream


def _check(header: SpzHeader, path: Path) -> None:
    if header.version not in SPZ_VERSIONS:
        raise InputError(f"{path}: has SPZ version {header.version}, expected 2, 3 or 4")
    if header.degree > 4:
        raise InputError(f"{path}: SPZ has SH of degree {header.degree}, expected 0 to 4")
    if header.fractional_bits > 31:
        raise InputError(f"{path}: SPZ has {header.fractional_bits} fractional bits, expected at most 31")


def _axis_signs(extensions: bytes, path: Path) -> Signs:
    """Factors of x, y and z between clsplat's axes and the file's, from the bytes of all extensions.

    An extension consists of its type, its length in bytes (32 bits each) and its contents.
    """
    at, system = 0, b""
    while len(extensions) - at >= 8:
        kind, length = struct.unpack_from("<II", extensions, at)
        if length > len(extensions) - at - 8:
            raise InputError(f"{path}: truncated: SPZ extension {kind:#x} lacks some of its {length} bytes")
        at += 8 + length
        if kind == COORDINATE_SYSTEM_EXTENSION:
            system = extensions[at - length : at]
    if len(system) != 4:
        return RUB_SIGNS
    (value,) = struct.unpack("<I", system)
    if value >= len(COORDINATE_SYSTEM_SIGNS):
        raise InputError(f"{path}: SPZ has the coordinate system {value}, expected one with y up or down (0 to 8)")
    return COORDINATE_SYSTEM_SIGNS[value]


@dataclass
class _Slice:
    """Stream that ends after the next `left` bytes of a file."""

    file: BinaryIO
    left: int

    def read(self, size: int) -> bytes:
        data = self.file.read(min(size, self.left))
        self.left -= len(data)
        return data


def _zstd_streams(file: BinaryIO, header: SpzHeader, size: int, path: Path) -> Iterator[tuple[str, Stream]]:
    import zstandard

    file.seek(header.table)
    table = file.read(16 * header.streams)
    at = header.table + len(table)
    for name, (packed, unpacked) in zip(header.widths, struct.iter_unpack("<QQ", table), strict=True):
        wanted = header.count * header.widths[name]
        if packed > size - at:
            raise InputError(f"{path}: truncated: has {size - at} bytes of {name}, expected {packed}")
        if unpacked != wanted:
            raise InputError(f"{path}: {name} have {unpacked} bytes unpacked, expected {wanted}")
        file.seek(at)
        at += packed
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_ZSTD_WINDOW_BYTES)
        source: Any = _Slice(file, packed)
        with decompressor.stream_reader(source, read_size=1 << 18) as stream:
            yield name, stream
            if _rest(stream, path):
                raise InputError(f"{path}: {name} have more than {wanted} bytes unpacked")
    if at != size:
        warn(f"{path}: {size - at} bytes after the last Gaussian are ignored")


def _next(stream: Stream, count: int, path: Path, what: str) -> bytes:
    with _decompressing(path, f"within {what}"):
        data: bytes = stream.read(count)
        if len(data) < count:
            raise EOFError
    return data


def _rest(stream: Any, path: Path) -> bytes:
    """Read the bytes after the Gaussians, at most MAX_EXTENSION_BYTES + 1. At the end, gzip verifies its checksum."""
    with _decompressing(path, "at its end"):
        return bytes(stream.read(MAX_EXTENSION_BYTES + 1))


@contextmanager
def _decompressing(path: Path, place: str) -> Iterator[None]:
    """Context manager: turn errors of a truncated or damaged stream into InputError.

    place: place in the stream as the message names it, such as "at its end".
    """
    import zstandard

    try:
        yield
    except EOFError:
        raise InputError(f"{path}: truncated {place}") from None
    except (zlib.error, gzip.BadGzipFile, zstandard.ZstdError) as error:
        raise InputError(f"{path}: does not decompress {place} ({error}); is it damaged?") from None


def _unpack(
    streams: Iterator[tuple[str, Stream]], header: SpzHeader, signs: Signs, result: Gaussians, path: Path
) -> None:
    alpha_logits = values.byte_logits()
    means_factor = np.array(signs, np.float32) * np.float32(0.5**header.fractional_bits)
    # repeated for the three channels: NumPy is several times slower if it broadcasts a short last axis
    sh_factor = np.repeat(sh_signs(signs)[1 : result.sh.shape[1], None] / np.float32(128), 3, axis=1)
    for name, stream in streams:
        width = header.widths[name]
        for rows in values.row_blocks(header.count):
            data = _next(stream, (rows.stop - rows.start) * width, path, f"its {name}")
            block = np.frombuffer(data, np.uint8).reshape(-1, width)
            match name:
                case "positions":
                    result.means[rows] = _fixed(block) * means_factor
                case "alphas":
                    result.opacity_logits[rows] = alpha_logits[block[:, 0]]
                case "colours":
                    result.sh[rows, 0] = (block - np.float32(127.5)) * np.float32(1 / COLOUR_STEPS_PER_UNIT)
                case "scales":
                    result.log_scales[rows] = block * np.float32(1 / 16) - np.float32(10)
                case "rotations":
                    unpack = _first_three if width == 3 else _smallest_three
                    result.quaternions[rows] = unpack(block) * quaternion_signs(signs)
                case _:
                    kept = result.sh.shape[1]
                    rest = result.sh[rows, 1:]
                    np.subtract(block.reshape(len(block), -1, 3)[:, : kept - 1], np.float32(128), out=rest)
                    rest *= sh_factor


def _fixed(block: Bytes) -> Float32:
    """Convert bytes (n, 9), low byte first, to signed 24-bit integers (n, 3), in float32."""
    wide = np.zeros((len(block), 3, 4), np.uint8)
    wide[:, :, 1:] = block.reshape(-1, 3, 3)
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.float32)


def _first_three(block: Bytes) -> Float32:
    """Convert bytes (n, 3) of x y z, as version 2 stores them, to quaternions w x y z (n, 4)."""
    result = np.empty((len(block), 4), np.float32)
    result[:, 1:] = block * np.float32(1 / 127.5) - np.float32(1)
    result[:, 0] = np.sqrt(np.maximum(0, 1 - np.square(result[:, 1:]).sum(axis=1)))
    return result


def _smallest_three(block: Bytes) -> Float32:
    """Convert bytes (n, 4), as version 3 and later store them, to quaternions w x y z (n, 4)."""
    packed = np.ascontiguousarray(block).view("<u4")[:, 0]
    fields = packed[:, None] >> np.array([20, 10, 0], np.uint32)
    three = (fields & 511).astype(np.float32) * np.float32(SQRT_HALF / 511)
    three = np.where(fields & 512, -three, three)
    return values.restore_largest(packed >> 30, three)[:, [3, 0, 1, 2]]  # the file's order is x y z w


def write(
    path: Path,
    gaussians: Gaussians,
    *,
    version: int = DEFAULT_SPZ_VERSION,
    fractional_bits: int | None = None,
    sh_bits: tuple[int, int] = DEFAULT_SH_BITS,
) -> None:
    """Write an SPZ file, atomically; equal Gaussians give equal bytes.

    fractional_bits: number of fractional bits of positions; None lets `header_for` choose it.
    sh_bits: numbers of bits, 1 to 8, to which SH coefficients are rounded: in band 1, and in the higher bands.
    Means are relative to the world's origin, and lose precision far from it. Raises InputError for non-finite values,
    and for positions that are too large. Raises ValueError for settings out of range.
    """
    if version not in SPZ_VERSIONS or not all(1 <= bits <= 8 for bits in sh_bits):
        raise ValueError(f"version is {version}, sh_bits {sh_bits}, expected version 2, 3 or 4, bits from 1 to 8")
    values.check_writable(path, gaussians, least=1)
    header = header_for(path, gaussians, version, fractional_bits)
    with atomic_writer(path) as file:
        write_to(file, gaussians, header, sh_bits)


def header_for(path: Path, gaussians: Gaussians, version: int, fractional_bits: int | None = None) -> SpzHeader:
    """Return the header with which `write_to` writes a model of at least one Gaussian. path: for messages.

    fractional_bits: None chooses 12, as Niantic's library does, but fewer if the positions would not fit, and more for
      a small model. The model's size is measured without its farthest 1 % of Gaussians.
    Raises InputError if the positions do not fit.
    """
    low, high = (
        values.world_means(gaussians, rows) for rows in (gaussians.means.argmin(axis=0), gaussians.means.argmax(axis=0))
    )
    largest = max(float(np.abs(low).max()), float(np.abs(high).max()))
    fits = 23 - max(0, int(np.ceil(np.log2(largest + 1e-30)))) if largest > 1 else 23
    while fits >= 0 and round(largest * 2**fits) >= 1 << 23:
        fits -= 1
    bits = fractional_bits
    if fits < 0 or (bits is not None and bits > fits):
        raise InputError(
            f"{path}: cannot be written: positions of up to {largest:g} do not fit into 24 bits"
            + (f" with {bits} after the point" if bits is not None else "")
        )
    if bits is None:
        spread = np.quantile(np.abs(gaussians.means - np.median(gaussians.means, axis=0)).max(axis=1), 0.99)
        # steps of 2^-12 for a model of 16 units, proportionally finer steps for a smaller model
        bits = min(fits, max(12, 16 - int(np.ceil(np.log2(max(float(spread), 1e-6))))))
    elif bits < 0:
        raise ValueError(f"fractional_bits is {bits}, expected 0 to 23")
    flags = ANTIALIASED_FLAG if gaussians.antialiased else 0
    return SpzHeader(version, len(gaussians), gaussians.sh_degree, bits, flags)


def write_to(
    file: BinaryIO, gaussians: Gaussians, header: SpzHeader, sh_bits: tuple[int, int] = DEFAULT_SH_BITS
) -> None:
    """Write an SPZ file at the current position of a seekable file. header: as `header_for` returns it."""
    if header.version < 4:
        fields = (header.version, header.count, header.degree, header.fractional_bits, header.flags, 0)
        with gzip.GzipFile(filename="", fileobj=file, mode="wb", compresslevel=6, mtime=0) as stream:
            stream.write(SPZ_MAGIC + struct.pack("<IIBBBB", *fields))
            for name in header.widths:
                _pack(name, gaussians, header, sh_bits, stream.write)
        return
    import zstandard

    names = list(header.widths)
    numbers = (4, header.count, header.degree, header.fractional_bits, header.flags, len(names), 32)
    file.write(SPZ_MAGIC + struct.pack("<IIBBBBI12x", *numbers))
    table = file.tell()
    file.write(bytes(16 * len(names)))
    sizes = b""
    for name in names:
        start, size = file.tell(), header.count * header.widths[name]
        compressor = zstandard.ZstdCompressor(level=9)
        with compressor.stream_writer(file, size=size, closefd=False) as stream:
            _pack(name, gaussians, header, sh_bits, stream.write)
        sizes += struct.pack("<QQ", file.tell() - start, size)
    end = file.tell()
    file.seek(table)
    file.write(sizes)
    file.seek(end)


def _pack(
    name: str, gaussians: Gaussians, header: SpzHeader, sh_bits: tuple[int, int], write: Callable[[bytes], object]
) -> None:
    for rows in values.row_blocks(header.count):
        match name:
            case "positions":
                data = _to_fixed(values.world_means(gaussians, rows) * RUB_SIGNS * 2.0**header.fractional_bits)
            case "alphas":
                data = values.to_bytes(values.opacities(gaussians.opacity_logits[rows]))
            case "colours":
                data = _to_byte(gaussians.sh[rows, 0] * np.float32(COLOUR_STEPS_PER_UNIT) + np.float32(127.5))
            case "scales":
                data = _to_byte((gaussians.log_scales[rows] + np.float32(10)) * np.float32(16))
            case "rotations":
                unit = values.unit_quaternions(gaussians.quaternions[rows]).astype(np.float32)
                unit *= quaternion_signs(RUB_SIGNS)
                data = _to_first_three(unit) if header.version == 2 else _to_smallest_three(unit)
            case _:
                data = _to_sh(gaussians.sh[rows, 1:], sh_bits)
        write(data.tobytes())


def _to_byte(steps: Float32) -> Bytes:
    """Round to the nearest integer from 0 to 255."""
    return np.asarray(np.clip(np.floor(steps + np.float32(0.5)), 0, 255).astype(np.uint8))


def _to_fixed(steps: Float64) -> Bytes:
    """Convert 24-bit values (n, 3) to bytes (n, 3, 3), low byte first."""
    return np.rint(steps).astype("<i4")[:, :, None].view(np.uint8)[:, :, :3]


def _to_first_three(unit: Float32) -> Bytes:
    """Convert unit quaternions w x y z (n, 4) to bytes (n, 3), as version 2 stores them."""
    unit = np.where(unit[:, :1] < 0, -unit, unit)
    return _to_byte(unit[:, 1:] * np.float32(127.5) + np.float32(127.5))


def _to_smallest_three(unit: Float32) -> Bytes:
    """Convert unit quaternions w x y z (n, 4) to bytes (4 n,), as version 3 and later store them."""
    q = unit[:, [1, 2, 3, 0]]
    largest = np.abs(q).argmax(axis=1)
    negate = np.take_along_axis(q, largest[:, None], axis=1) < 0
    magnitude = np.minimum(np.floor(np.abs(q) * np.float32(511 / SQRT_HALF) + np.float32(0.5)), 511).astype(np.uint32)
    fields = magnitude | (((q < 0) ^ negate).astype(np.uint32) << 9)
    three = np.take_along_axis(fields, values.OTHER_QUATERNION_COMPONENTS[largest], axis=1)
    packed = largest.astype(np.uint32) << 30 | three[:, 0] << 20 | three[:, 1] << 10 | three[:, 2]
    return np.asarray(packed.astype("<u4").view(np.uint8))


def _to_sh(rest: Float32, sh_bits: tuple[int, int]) -> Bytes:
    """Convert the SH coefficients above degree 0, (n, K - 1, 3) in clsplat's axes, to bytes.

    sh_bits: numbers of bits to which band 1, and the higher bands, are rounded.
    """
    coefficients = rest.shape[1]
    steps = np.array([1 << (8 - sh_bits[0 if index < 3 else 1]) for index in range(coefficients)], np.int16)[:, None]
    signs = sh_signs(RUB_SIGNS)[1 : coefficients + 1, None]
    codes = np.clip(rest * (signs * np.float32(128)) + np.float32(128.5), 0, 256).astype(np.int16)
    return np.asarray(np.minimum((codes + steps // 2) & -steps, 255).astype(np.uint8))  # steps are powers of two
