# SPDX-License-Identifier: Apache-2.0
"""SOG, PlayCanvas' models as images: meta.json with lossless WebP files, or a .sog archive (zip) of these.

Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/ (version 2). Version 1,
whose meta.json has no version, is read as in https://github.com/playcanvas/splat-transform.

- Axes are clsplat's. Each pixel is a Gaussian, row by row from the top.
- means_l, means_u: low and high byte of sign(x) ln(1 + |x|) as 16 bits, between the smallest and largest value on the
  axis.
- quats: w x y z without the largest component, whose index plus 252 is in alpha; the others in steps of 1/180.
- scales: indices into a codebook of 256 natural logs.
- sh0: indices into a codebook of 256 values of SH coefficient 0. Alpha is the opacity in steps of 1/255. Gaussians of
  opacity 0 lose their colours.
- shN: a palette of up to 65,536 sets of coefficients, as indices into a third codebook; order and signs are clsplat's.
- Version 1 has ranges in 255 steps instead of codebooks, and opacities as logits.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64, numbers
from clsplat.errors import InputError, plain, warn
from clsplat.files.atomic import atomic_write, atomic_writer, scratch_folder, write_error
from clsplat.files.documents import MAX_DOCUMENT_BYTES, is_file, open_input, parse_json, read_document
from clsplat.files.names import native_name
from clsplat.gaussians import MAX_SH_DEGREE, Gaussians
from clsplat.images.reading import error_of, one_line, open_image
from clsplat.models.codec import antialias
from clsplat.models.codec import values as packing
from clsplat.models.codec.palette import codebook, nearest, palette
from clsplat.progress import Progress, no_progress

Bytes = NDArray[np.uint8]
PictureFile = Callable[[str, int], Path]
"""Function that returns the file of an image, given the image's name and its largest size in bytes in an archive."""

SOG_META_FILE = "meta.json"
SOG_IMAGE_PREFIXES = ("means", "quats", "scales", "sh0", "shN")
"""Prefixes of the images' names."""
SH_IMAGE_FILES = ("shN_centroids.webp", "shN_labels.webp")
MAX_PALETTE_ENTRIES = 1 << 16
"""Maximum number of entries of the palette of SH coefficients, which k-means makes (`models.codec.palette`)."""
PALETTE_COLUMNS = 64
QUATERNION_TAG_BASE = 252
MAX_UNCHECKED_IMAGE_BYTES = 16 << 20
"""Largest size in bytes of an image in an archive, not counting 8 bytes (two raw pixels) for each Gaussian."""


def recognises(head: bytes) -> bool:
    """True if a file begins like a zip archive or like JSON."""
    return head.startswith(b"PK\x03\x04") or head.lstrip()[:1] == b"{"


def describe(path: Path) -> dict[str, Any]:
    """Details of a file for `clsplat info`: version and antialiasing."""
    with _opened(path) as (file, meta, _):
        return {"version": meta.get("version", 1), "antialiased": _is_antialiased(file, meta)}


def _is_antialiased(path: Path, meta: dict[str, Any]) -> bool:
    """True if a key of meta.json, such as `antialias`, says that the model is antialiased. Warns if this is unclear."""
    said = antialias.of_object(meta)
    if said.warning:
        warn(f"{path}: {SOG_META_FILE} {said.warning}")
    return said.antialiased


def side_files(path: Path) -> list[Path]:
    """Paths of the images of a meta.json; empty for a .sog."""
    pictures = sorted(path.parent.glob("*.webp")) if path.name == SOG_META_FILE else []
    return [picture for picture in pictures if picture.stem.partition("_")[0] in SOG_IMAGE_PREFIXES]


def read(path: Path) -> Gaussians:
    """Read a .sog, a meta.json with its images, or the folder that contains them. Raises InputError."""
    with _opened(path) as opened:
        meta = _Meta(*opened)
        model = meta.gaussians()
        model.antialiased = _is_antialiased(path, meta.meta)
    return model


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Path, dict[str, Any], PictureFile]]:
    """Context manager that yields the path for messages, the parsed meta.json, and a function that finds an image."""
    if path.is_dir() or path.name.lower().endswith(".json"):
        path = path / SOG_META_FILE if path.is_dir() else path
        yield path, _parsed(path, read_document(path, "SOG's meta.json")), partial(_beside, path)
        return
    with open_input(path, "a .sog archive") as file, scratch_folder(0) as folder:
        try:
            archive = zipfile.ZipFile(file)
        except (zipfile.BadZipFile, ValueError, NotImplementedError, EOFError) as error:
            raise InputError(f"{path}: is not a .sog archive ({error})") from None
        with archive:
            members = _members(archive)
            unpacked = partial(_unpacked, path, archive, members, folder / "file.webp")
            yield path, _parsed(path, unpacked(SOG_META_FILE, MAX_DOCUMENT_BYTES).read_bytes()), unpacked


def _members(archive: zipfile.ZipFile) -> dict[str, str]:
    """Names of an archive's files, keyed by their path relative to the folder of SOG_META_FILE."""
    whole = [name.replace("\\", "/") for name in archive.namelist()]
    metas = sorted(
        (name for name in whole if name.rpartition("/")[2] == SOG_META_FILE), key=lambda name: name.count("/")
    )
    folder = metas[0].removesuffix(SOG_META_FILE) if metas else ""
    names = zip(whole, archive.namelist(), strict=True)
    return {name.removeprefix(folder): stored for name, stored in names if name.startswith(folder)}


def _names(folder: Path) -> list[str]:
    return [file.name for file in folder.iterdir()]


def _match_case(name: str, names: Iterable[str]) -> str:
    """Return the entry of `names` that equals `name` if case is ignored, as on Windows and macOS.

    Returns `name` itself if it is an entry, or if no entry or more than one matches.
    """
    names = list(names)
    alike = [other for other in names if other.lower() == name.lower()] if name not in names else []
    return alike[0] if len(alike) == 1 else name


def _parsed(path: Path, text: str | bytes) -> dict[str, Any]:
    try:
        meta = parse_json(text)
    except ValueError as error:
        raise InputError(f"{path}: {SOG_META_FILE} does not parse ({error})") from None
    if not isinstance(meta, dict) or "means" not in meta:
        raise InputError(f"{path}: {SOG_META_FILE} has no key 'means', expected the {SOG_META_FILE} of a SOG model")
    return meta


def _beside(path: Path, name: str, _limit: int) -> Path:
    """Find the file of the image `name` in the folder of the meta.json `path`. Raises InputError.

    _limit: not used. It makes the function a `PictureFile`.
    """
    folder = Path(os.path.realpath(path)).parent
    try:
        picture = Path(os.path.realpath(folder / name))
    except ValueError:  # a zero byte in the name
        picture = folder
    if picture.parent != folder:
        raise InputError(f"{path}: has a picture {name[:80]!r}, expected a file in the same folder")
    if not is_file(picture) and is_file(other := folder / _match_case(picture.name, _names(folder))):
        return other
    if not is_file(picture):
        raise InputError(f"{path}: its picture {name} is missing")
    return picture


def _unpacked(
    path: Path, archive: zipfile.ZipFile, members: dict[str, str], target: Path, name: str, limit: int
) -> Path:
    """Unpack the file `name` of a .sog archive to `target`, and return `target`.

    members: names of the archive's files, by their paths relative to the folder of meta.json.
    Raises InputError if the archive lacks the file, or if the file has more than `limit` bytes.
    """
    stored = _match_case(name, members)
    try:
        with archive.open(members.get(stored, stored)) as source, target.open("wb") as file:
            left = limit
            while block := source.read(min(1 << 20, left + 1)):
                left -= len(block)
                if left < 0:
                    raise InputError(f"{path}: {plain(name)[:80]} has more than {limit} bytes unpacked")
                try:
                    file.write(block)
                    file.flush()  # a full disk raises its error here, and not in close
                except OSError as error:
                    raise write_error(target, error) from None
    except KeyError:
        raise InputError(f"{path}: does not contain {name[:80]}") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: {name[:80]} does not unpack ({error}); is it damaged?") from None
    return target


class _Meta:
    """Parsed meta.json, and access to the data that it refers to."""

    def __init__(self, path: Path, meta: dict[str, Any], file: PictureFile) -> None:
        self.path, self.meta, self.file = path, meta, file
        self.version = meta.get("version", 1)
        if self.version not in (1, 2):
            found = json.dumps(self.version)[:20]
            raise InputError(f"{self.path}: has SOG version {found} in {SOG_META_FILE}, expected the number 1 or 2")
        shape = self.section("means").get("shape", [0])
        count = meta.get("count") if self.version == 2 else shape[0] if isinstance(shape, list) and shape else 0
        if self.version == 2 and (not isinstance(count, int) or isinstance(count, bool)):
            found = f"the count {json.dumps(count)[:20]}" if "count" in meta else "no count"
            raise InputError(
                f"{self.path}: {SOG_META_FILE} has {found}, expected the number of Gaussians, a whole number"
            )
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count < 1 << 32:
            raise InputError(f"{self.path}: has {str(count)[:20]} Gaussians, expected 1 to {(1 << 32) - 1}")
        self.count = count

    def section(self, name: str) -> dict[str, Any]:
        value = self.meta.get(name)
        if not isinstance(value, dict):
            raise InputError(f"{self.path}: {SOG_META_FILE} has no {name}")
        return value

    def numbers(self, section: str, key: str, least: int, most: int) -> NDArray[np.float64]:
        """Numbers of the list `key` in a section of meta.json. Raises InputError unless it has `least` to `most`.

        JSON has no infinity. So null stands for -inf in the logs of scales, and for NaN elsewhere.
        """
        where = f"{self.path}: {key} of {section} in {SOG_META_FILE}"
        if key not in self.section(section):
            raise InputError(f"{self.path}: {section} in {SOG_META_FILE} has no {key}")
        value = self.section(section)[key]
        value = value if isinstance(value, list) else [value]
        count = f"{least}" if least == most else f"{least} to {most}"
        if not least <= len(value) <= most:
            raise InputError(f"{where} has {len(value)} number{'' if len(value) == 1 else 's'}, expected {count}")
        nulls = [number is None for number in value]
        if all(nulls) or (any(nulls) and section == "means"):
            found = "nothing but null" if all(nulls) else "null"
            raise InputError(f"{where} has {found} in place of numbers; was it made from a damaged model?")
        null = -np.inf if section == "scales" else np.nan
        array = numbers([null if empty else number for empty, number in zip(nulls, value, strict=True)])
        if array.shape != (len(value),) or not np.isfinite(array[~np.array(nulls)]).all():
            expected = "a finite number" if count == "1" else f"{count} finite numbers"
            raise InputError(f"{where} is not a list of numbers, expected {expected}")
        return array

    def picture(self, section: str, index: int, channels: int, *, least: int | None = None) -> Bytes:
        """Read the bytes (height, width, channels) of an image.

        section, index: a section of meta.json, and the image's index in that section's list of files.
        least: smallest allowed number of pixels; None means one for each Gaussian.
        """
        names = self.section(section).get("files")
        if not isinstance(names, list) or len(names) <= index or not isinstance(names[index], str):
            raise InputError(f"{self.path}: {section} in {SOG_META_FILE} has no file at index {index}")
        least = self.count if least is None else least
        file = self.file(names[index], MAX_UNCHECKED_IMAGE_BYTES + 8 * least)
        try:
            source = open_image(file)
            spec = source.spec()
            pixels = spec.width * spec.height
            if pixels < least or spec.nchannels < channels:
                raise InputError(
                    f"{file}: is {spec.width} x {spec.height} with {spec.nchannels} channels, expected at least "
                    f"{least} pixels with {channels} channels"
                )
            decoded = source.read_image(oiio.UINT8)
            reason = error_of(source)
            source.close()
            if decoded is None or reason:
                raise InputError(f"{file}: does not decode: {one_line(reason)}")
        except InputError as error:
            before, unpacked, after = str(error).partition(plain(str(file)))
            # the decoder's message may repeat the file's name
            named = f"{self.path}: {names[index][:80]}" + after.replace(unpacked, names[index][:80]) if unpacked else ""
            raise InputError(before + named) from None
        return np.asarray(decoded).reshape(spec.height, spec.width, -1)[:, :, :channels]

    def pixels(self, section: str, index: int, channels: int) -> Bytes:
        return self.picture(section, index, channels).reshape(-1, channels)[: self.count]

    def gaussians(self) -> Gaussians:
        means = self.means()
        quaternions = _unpacked_quaternions(self.pixels("quats", 0, 4))
        scales = self.dequantised("scales", self.pixels("scales", 0, 3))
        bytes_ = self.pixels("sh0", 0, 4)
        if self.version == 2:
            opacity_logits = packing.byte_logits()[bytes_[:, 3]]
        else:
            low, high = (self.numbers("sh0", key, 4, 4)[3] for key in ("mins", "maxs"))
            opacity_logits = (low + (high - low) * (bytes_[:, 3] / 255)).astype(np.float32)
        sh0 = self.dequantised("sh0", bytes_[:, :3])[:, None]
        sh = np.concatenate([sh0, self.rest()], axis=1) if self.meta.get("shN") is not None else sh0
        return Gaussians(means, quaternions, scales, opacity_logits, sh)

    def means(self) -> Float32:
        fine, coarse = (self.pixels("means", index, 3).astype(np.uint16) for index in (0, 1))
        low, high = (self.numbers("means", key, 3, 3) for key in ("mins", "maxs"))
        if not max(np.abs(low).max(), np.abs(high).max()) < 88:  # beyond 88, exp overflows float32
            raise InputError(f"{self.path}: mins or maxs of means in {SOG_META_FILE} are too large, expected under 88")
        folded = low + (high - low) * ((coarse << 8 | fine) / 65535)
        return (np.sign(folded) * np.expm1(np.abs(folded))).astype(np.float32)

    def dequantised(self, section: str, values: Bytes) -> Float32:
        if self.version == 2:
            entries = self.numbers(section, "codebook", 1, 256).astype(np.float32)
            if int(values.max()) >= len(entries):
                found = f"the index {values.max()}, but its codebook has {len(entries)} entries"
                raise InputError(f"{self.path}: {section} has {found}; is it damaged?")
            if section == "scales":
                self.warn_of_nulls(entries, values)
            return entries[values]
        width = {"scales": (3, 3), "sh0": (4, 4), "shN": (1, 1)}[section]
        low, high = (self.numbers(section, key, *width)[:3] for key in ("mins", "maxs"))
        part = values / 255
        with np.errstate(invalid="ignore"):  # NaN at infinite bounds
            return packing.at_ends(low + (high - low) * part, low, high, part).astype(np.float32)

    def warn_of_nulls(self, entries: Float32, indices: Bytes) -> None:
        """Warn of nulls in the codebook of scales, except at its beginning.

        The entries are in increasing order, so that nulls at the beginning stand for -inf, the log of a scale of 0.

        entries: the codebook, with -inf for null. indices: the Gaussians' indices (n, 3) into the codebook.
        """
        null = np.isinf(entries)
        if (count := int(null.sum())) and null[int((~null).argmax()) :].any():
            users = int(null[indices].any(axis=1).sum())
            warn(
                f"{self.path}: codebook of scales in {SOG_META_FILE} has null in place of {count} of {len(entries)} "
                "numbers, "
                f"which give {users:,} of {self.count:,} Gaussians a scale of 0; was it made from a damaged model?"
            )

    def rest(self) -> Float32:
        """Read the SH coefficients above degree 0, (n, K - 1, 3), from the palette and its indices."""
        labels = self.pixels("shN", 1, 2).astype(np.uint32)
        label = labels[:, 0] | labels[:, 1] << 8
        needed = int(label.max()) + 1
        table = self.picture("shN", 0, 3, least=needed)
        width = table.shape[1] // PALETTE_COLUMNS
        said = self.section("shN").get("bands") if self.version == 2 else None
        bands = next((degree for degree in range(1, MAX_SH_DEGREE + 1) if degree * (degree + 2) == width), 0)
        if table.shape[1] % PALETTE_COLUMNS or not bands or said not in (None, bands):
            found = f"{table.shape[1]} pixels wide{'' if said is None else f' for {str(said)[:20]} SH bands'}"
            widths = ", ".join(f"{PALETTE_COLUMNS * d * (d + 2)} for {d}" for d in range(1, MAX_SH_DEGREE + 1))
            raise InputError(f"{self.path}: shN's palette is {found}, expected a width of {widths} SH bands")
        colours = table.reshape(-1, width, 3)
        if needed > len(colours):
            raise InputError(f"{self.path}: shN has the index {needed - 1}, but its palette has {len(colours)} entries")
        return np.asarray(self.dequantised("shN", colours)[label])


def _unpacked_quaternions(pixels: Bytes) -> Float32:
    tag = pixels[:, 3].astype(np.int64) - QUATERNION_TAG_BASE
    three = (pixels[:, :3] * np.float32(2 / 255) - np.float32(1)) * np.float32(0.5**0.5)
    result = packing.restore_largest(np.maximum(tag, 0), three)
    result[tag < 0] = (1, 0, 0, 0)  # an invalid index: as splat-transform, use no rotation
    return result


def write(
    path: Path, gaussians: Gaussians, *, iterations: int = 10, sort: bool = False, progress: Progress = no_progress
) -> None:
    """Write version 2: a .sog archive, or a meta.json after its images in the same folder.

    iterations: number of k-means iterations for the palette.
    sort: sort the Gaussians by position (Morton order), so that the images compress better.
    progress: function that is called with the current task and its finished fraction.
    Means are relative to the world's origin, and lose precision far from it. Equal Gaussians give equal values. Raises
    InputError for non-finite values.
    """
    packing.check_writable(path, gaussians, least=1)
    # the WebP encoder crashes if the disk is full, so the disk must have room for the largest possible images
    room = 24 * len(gaussians) + 64 * min(len(gaussians), MAX_PALETTE_ENTRIES) + (1 << 16)
    with scratch_folder(room) as folder:
        order = packing.morton_order(gaussians.means) if sort else slice(None)
        meta = _pictures(folder, gaussians, order, iterations, progress)
        text = json.dumps(meta, separators=(",", ":")).encode()
        files = sorted(folder.iterdir())
        if path.name.lower().endswith(".json"):
            for picture in files:
                atomic_write(path.with_name(picture.name), picture.read_bytes())
            atomic_write(path, text)
            # an earlier model with higher SH degree may have left these images
            for name in {*SH_IMAGE_FILES} - {picture.name for picture in files}:
                path.with_name(name).unlink(missing_ok=True)
            return
        total = sum(picture.stat().st_size for picture in files)
        # the archive is uncompressed, since WebP files would hardly shrink
        with atomic_writer(path, total) as file, zipfile.ZipFile(file, "w") as archive:
            archive.writestr(zipfile.ZipInfo(SOG_META_FILE), text)
            for picture in files:
                archive.writestr(zipfile.ZipInfo(picture.name), picture.read_bytes())


def _pictures(folder: Path, gaussians: Gaussians, order: Any, iterations: int, progress: Progress) -> dict[str, Any]:
    """Write a model's images to a folder, and return the contents of meta.json.

    order: index (n,) of the Gaussian in each pixel, or a slice of all.
    iterations: number of k-means iterations for the palette of SH coefficients.
    """
    count = len(gaussians)
    width = 4 * math.ceil(math.sqrt(count) / 4)
    height = 4 * math.ceil(count / width / 4)

    def picture(name: str, columns: list[Bytes]) -> str:
        pixels = np.zeros((height * width, sum(column.shape[1] for column in columns)), np.uint8)
        pixels[:count] = np.concatenate(columns, axis=1)
        _write_webp(folder / name, pixels.reshape(height, width, -1))
        return name

    world = packing.world_means(gaussians)[order]
    folded = np.sign(world) * np.log1p(np.abs(world))
    low, high = folded.min(axis=0), folded.max(axis=0)
    steps = np.rint((folded - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    means = [
        picture(f"means_{half}.webp", [(steps >> shift & 255).astype(np.uint8)]) for half, shift in (("l", 0), ("u", 8))
    ]
    log_scales, sh0 = gaussians.log_scales[order], gaussians.sh[order, 0]
    scale_codes, colour_codes = codebook(log_scales), codebook(sh0)
    opacity = packing.to_bytes(packing.opacities(gaussians.opacity_logits[order]))
    quats = _packed_quaternions(packing.unit_quaternions(gaussians.quaternions[order]))
    scales = picture("scales.webp", [_indices(scale_codes, log_scales)])
    colours = picture("sh0.webp", [_indices(colour_codes, sh0), opacity[:, None]])
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "clsplat"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": means},
        "scales": {"codebook": scale_codes.tolist(), "files": [scales]},
        "quats": {"files": [picture("quats.webp", [quats])]},
        "sh0": {"codebook": colour_codes.tolist(), "files": [colours]},
        # the specification's key, and the key that splat-transform reads
        **({"antialias": True, "model": "antialiased"} if gaussians.antialiased else {}),
    }
    if gaussians.sh_degree:
        rest = gaussians.sh[order, 1:]
        meta["shN"] = _palette(folder, rest, picture, iterations, gaussians.sh_degree, progress)
    return meta


def _palette(
    folder: Path,
    rest: Float32,
    picture: Callable[[str, list[Bytes]], str],
    iterations: int,
    bands: int,
    progress: Progress,
) -> dict[str, Any]:
    count, width = rest.shape[:2]
    size = min(MAX_PALETTE_ENTRIES, 1 << (count.bit_length() - 1))
    stage = f"SOG: choosing {size:,} sets of SH coefficients for {count:,} Gaussians"
    progress(stage, 0.0)
    sets, labels = palette(rest.reshape(count, -1), size, iterations, lambda part: progress(stage, part))
    entries = codebook(sets)
    rows = -(-size // PALETTE_COLUMNS)
    table = np.zeros((rows * PALETTE_COLUMNS, width, 3), np.uint8)
    table[:size] = _indices(entries, sets).reshape(size, width, 3)
    centroids, marks = SH_IMAGE_FILES
    _write_webp(folder / centroids, table.reshape(rows, PALETTE_COLUMNS * width, 3))
    halves = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    files = [centroids, picture(marks, [halves])]
    return {"count": size, "bands": bands, "codebook": entries.tolist(), "files": files}


def _indices(entries: Float32, values: Float32) -> Bytes:
    return nearest(entries, values).astype(np.uint8)


def _packed_quaternions(unit: Float64) -> Bytes:
    largest, three = packing.leave_out_largest(unit)
    steps = np.rint(np.clip(three * 2**0.5 * 0.5 + 0.5, 0, 1) * 255)
    return np.column_stack([steps, largest + QUATERNION_TAG_BASE]).astype(np.uint8)


def _write_webp(path: Path, pixels: Bytes) -> None:
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("compression", "lossless")
    spec.attribute("oiio:UnassociatedAlpha", 1)  # otherwise OpenImageIO divides colours by alpha
    name = native_name(path)
    output = oiio.ImageOutput.create(name)
    if output is None or not output.open(name, spec) or not output.write_image(pixels) or not output.close():
        raise OSError(f"{path.name}: OpenImageIO cannot write it: {error_of(output or oiio)}")
