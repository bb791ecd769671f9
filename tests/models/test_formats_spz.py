# SPDX-License-Identifier: Apache-2.0
"""SPZ: what comes back, what others read and write, and damage."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import peak_of, refuses, warned
from models import random_gaussians, real_file
from node import splat_transform
from splats import assert_within, lopsided, losses, read_plainly, refused_of, with_origin

from clsplat.models.formats import spz

BOUNDS = {
    "means": 0.5 / 4096 * 1.001,  # half a step, and float32's rounding
    "log_scales": 0.5 / 16 * 1.001,
    "opacities": 0.5 / 255 * 1.001,
    "sh0": 0.5 / 38.25 * 1.001,
    "sh": 2 / 128 + 0.5 / 128,  # half a bucket of 4 steps, and the rounding to a step before it
}
ROTATION = {2: 0.25, 3: 0.005, 4: 0.005}
"""Version 2's w comes from x y z, which are off by sqrt(3) / 255 together: where w is near 0 that leaves it open by
sqrt(2 sqrt(3) / 255) = 0.117, and the angle by twice that. From version 3 each of three is off by 1/1446 at most, and
the largest by no more."""
SAME = dict.fromkeys(BOUNDS, 2e-6) | {"rotations": 2e-6, "opacities": 0.0011}
"""float32's rounding; bytes of opacity 0 and 255 count as a quarter of a step from the end here, as the end there."""
SAMPLES = ["biker", "amaebi-dm_pod", *(f"splat-transform_minimal-{each}" for each in ("v2", "v3", "v4"))]


@pytest.mark.parametrize("version", spz.SPZ_VERSIONS)
@pytest.mark.parametrize("degree", range(4))
def test_it_comes_back_with_the_stated_loss(tmp_path: Path, version: int, degree: int) -> None:
    model, path = lopsided(degree=degree), tmp_path / "model.spz"
    spz.write(path, model, version=version)
    back = spz.read(path)
    assert spz.describe(path) == {"version": version, "fractional_bits": 13, "antialiased": False}
    assert_within(back, model, **BOUNDS, rotations=ROTATION[version])
    spz.write(path, back, version=version)
    assert_within(spz.read(path), back, means=0, log_scales=0, opacities=1e-7, sh0=0, sh=0, rotations=ROTATION[version])


def test_more_bits_lose_less_of_the_harmonics(tmp_path: Path) -> None:
    model, path = lopsided(), tmp_path / "model.spz"
    spz.write(path, model, sh_bits=(8, 8))
    assert losses(spz.read(path), model)["sh"] <= 0.5 / 128 * 1.001


def test_the_default_is_a_version_that_readers_of_the_web_read(tmp_path: Path) -> None:
    """Version 3 begins with gzip's signature. Spark, Babylon.js and older three.js refuse 4 (docs/formats.md)."""
    model, path = lopsided(), tmp_path / "model.spz"
    spz.write(path, model)
    assert path.read_bytes()[:2] == b"\x1f\x8b"
    assert gzip.decompress(path.read_bytes())[:8] == b"NGSP\3\0\0\0"
    spz.write(tmp_path / "3.spz", model, version=3)
    assert path.read_bytes() == (tmp_path / "3.spz").read_bytes()


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_are_what_another_reader_has(tmp_path: Path, name: str) -> None:
    path = real_file(f"samples/{name}.spz")
    splat_transform(path, tmp_path / "other.ply")
    # of opacities 0 and 1 the logits are infinite there
    assert_within(spz.read(path), read_plainly(tmp_path / "other.ply"), **SAME)


def test_a_file_without_gzip_is_read_too() -> None:
    raw, packed = (spz.read(real_file(f"samples/splat-transform_minimal-{each}.spz")) for each in ("raw", "v2"))
    assert_within(raw, packed, **dict.fromkeys(BOUNDS, 0))


def test_biker_is_the_compressed_ply_of_the_same_model() -> None:
    from clsplat.models import formats

    if not hasattr(formats, "load"):
        pytest.skip("no reader of compressed PLY")
    model = spz.read(real_file("samples/biker.spz"))
    other = formats.load(real_file("samples/biker.compressed.ply"))
    assert np.median(np.linalg.norm(model.means - other.means, axis=1)) < 2e-4  # half a step of SPZ's, in three axes
    assert np.median(np.abs(model.log_scales - other.log_scales)) < 1 / 32
    assert np.median(losses(model, other)["opacities"]) < 0.02


@pytest.mark.parametrize("version", [2, 3, 4])
def test_another_reader_has_the_same_values(tmp_path: Path, version: int) -> None:
    path = tmp_path / "model.spz"
    spz.write(path, lopsided(), version=version)
    splat_transform(path, tmp_path / "other.ply")
    assert_within(spz.read(path), read_plainly(tmp_path / "other.ply"), **SAME)


@pytest.mark.parametrize("version", [3, 4])
def test_what_another_writes_is_what_we_write(tmp_path: Path, version: int) -> None:
    model = lopsided()
    model.save(tmp_path / "model.ply")
    splat_transform(tmp_path / "model.ply", tmp_path / "theirs.spz", "--spz-version", str(version))
    spz.write(tmp_path / "ours.spz", model, version=version, fractional_bits=12, sh_bits=(5, 4))
    theirs, ours = spz.read(tmp_path / "theirs.spz"), spz.read(tmp_path / "ours.spz")
    one_step = {"means": 1 / 4096, "log_scales": 1 / 16, "opacities": 1 / 255, "sh0": 1 / 38, "sh": 1 / 8}
    assert_within(theirs, ours, **one_step, rotations=0.005)  # a tie may be rounded either way
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        assert np.mean(getattr(theirs, name) != getattr(ours, name)) < 1e-3, name


def test_positions_take_the_bits_that_the_model_needs(tmp_path: Path) -> None:
    model, path = lopsided(), tmp_path / "model.spz"
    model.means *= np.float32(1e-3)
    spz.write(path, model)
    assert losses(spz.read(path), model)["means"] < 1e-6
    far = with_origin(model, 5e5, -3e5, 10)
    spz.write(path, far)
    assert spz.describe(path)["fractional_bits"] == 4
    assert losses(spz.read(path), far)["means"] <= 1 / 32 * 1.01
    refuses(r"model\.spz: cannot be written: positions of up to 9e\+06", spz.write, path, with_origin(model, 9e6, 0, 0))
    refuses("with 12 after the point", spz.write, path, far, fractional_bits=12)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_an_antialiased_model_says_so(version: int, tmp_path: Path) -> None:
    for antialiased in (False, True):
        model, path = replace(lopsided(5), antialiased=antialiased), tmp_path / f"{antialiased}.spz"
        spz.write(path, model, version=version)
        assert spz.read(path).antialiased == antialiased
        assert spz.describe(path)["antialiased"] == antialiased


def with_extensions(data: bytes, *records: tuple[int, bytes]) -> bytes:
    """A version 4 file with records between its header and its table."""
    packed = b"".join(struct.pack("<II", kind, len(value)) + value for kind, value in records)
    (table,) = struct.unpack_from("<I", data, 16)
    flags = data[14] | spz.EXTENSIONS_FLAG
    return (
        data[:14] + bytes([flags, data[15]]) + struct.pack("<I", table + len(packed)) + data[20:32] + packed + data[32:]
    )


def test_extensions_are_passed_over_and_a_frame_is_honoured(tmp_path: Path) -> None:
    path = tmp_path / "model.spz"
    spz.write(path, lopsided(50), version=4)
    plain, data = spz.read(path), path.read_bytes()
    path.write_bytes(with_extensions(data, (0xADBE0002, bytes(12)), (0x12345678, b"more")))
    assert_within(spz.read(path), plain, **dict.fromkeys(BOUNDS, 0))
    path.write_bytes(
        with_extensions(data, (spz.COORDINATE_SYSTEM_EXTENSION, struct.pack("<I", 6)))
    )  # RDF, which is ours
    ours = spz.read(path)
    np.testing.assert_array_equal(ours.means, plain.means * [1, -1, -1])
    np.testing.assert_array_equal(ours.sh[:, 1], -plain.sh[:, 1])  # -y
    path.write_bytes(with_extensions(data, (spz.COORDINATE_SYSTEM_EXTENSION, struct.pack("<I", 12))))
    refuses("coordinate system 12", spz.read, path)


def test_a_fourth_band_is_left_out(tmp_path: Path) -> None:
    model, path = lopsided(20), tmp_path / "model.spz"
    spz.write(path, model, version=2)
    payload = gzip.decompress(path.read_bytes())
    sh = np.frombuffer(payload[-20 * 45 :], np.uint8).reshape(20, 45)
    wider = np.concatenate([sh, np.full((20, 27), 77, np.uint8)], axis=1)
    with gzip.open(tmp_path / "fourth.spz", "wb") as file:
        file.write(payload[:12] + b"\4" + payload[13 : -20 * 45] + wider.tobytes())
    found = warned("degree 4", spz.read, tmp_path / "fourth.spz")
    assert_within(found, spz.read(path), **dict.fromkeys(BOUNDS, 0))


@pytest.mark.parametrize("version", spz.SPZ_VERSIONS)
def test_damaged_files(tmp_path: Path, version: int) -> None:
    path = tmp_path / "model.spz"
    spz.write(path, lopsided(20), version=version)
    assert (
        refused_of(spz.read, path, step=7) > 100
    )  # every cut, and most changes: gzip has a sum, Zstandard's streams here have none


def header(version: int, count: int, degree: int = 0, bits: int = 12) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, 0, 0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not an SPZ file"),
        (gzip.compress(b"something else, long enough"), "not an SPZ file"),
        (gzip.compress(header(2, 0)), "0 Gaussians"),
        (gzip.compress(header(5, 10)), "version 5"),
        (gzip.compress(header(2, 10, degree=9)), "degree 9"),
        (gzip.compress(header(2, 10, bits=99)), "99 fractional bits"),
        (gzip.compress(header(3, 10) + bytes(100)), "truncated within its colours"),
        (header(3, 1 << 31), "2147483648 Gaussians in 16 bytes"),
        (b"NGSP" + struct.pack("<IIBBBBI12x", 4, 1 << 31, 0, 12, 0, 5, 32) + bytes(80), "2147483648 Gaussians"),
        (
            b"NGSP" + struct.pack("<IIBBBBI12x", 4, 10, 0, 12, 0, 5, 32) + struct.pack("<QQ", 1 << 60, 90) * 5,
            "truncated",
        ),
        (b"NGSP" + struct.pack("<IIBBBBI12x", 4, 10, 0, 12, 0, 5, 1 << 30) + bytes(80), "table of streams"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_that_is_none(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "model.spz"
    path.write_bytes(data)
    refuses(message, spz.read, path)


@pytest.mark.parametrize(("version", "degree", "count"), [(3, 0, 100), (2, 3, 31), (2, 0, 1), (3, 2, 4000)])
def test_bombs_are_refused_and_take_no_memory(version: int, degree: int, count: int, tmp_path: Path) -> None:
    """A kilobyte of gzip may become a megabyte behind the last Gaussian."""
    path = tmp_path / "model.spz"
    payload = count * sum(spz.SpzHeader(version, count, degree, 12, 0).widths.values())
    with gzip.open(path, "wb") as file:
        file.write(header(version, count, degree) + bytes(payload))
        for _ in range(64):
            file.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 17
    said = rf"model\.spz: unpacks to more than {count} Gaussians: over 1048576 bytes "
    assert peak_of(lambda: refuses(said, spz.read, path)) < 12 << 20  # the 64 MiB behind the Gaussians are not unpacked


@pytest.mark.parametrize("behind", [1, 1 << 20])
def test_a_little_behind_the_gaussians_is_passed_over(behind: int, tmp_path: Path) -> None:
    path = tmp_path / "model.spz"
    spz.write(path, lopsided(20), version=2)
    plain = spz.read(path)
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + bytes(behind)))
    with pytest.warns(UserWarning, match="bytes after the last Gaussian are ignored"):
        assert_within(spz.read(path), plain, **dict.fromkeys(BOUNDS, 0))


def test_reading_keeps_no_second_copy(tmp_path: Path) -> None:
    path, model = tmp_path / "model.spz", random_gaussians(100_000)
    spz.write(path, model)
    # blocks of 2^15 rows of 45 bytes and what is made of the widest attribute, not the 6.4 MB that the file unpacks to
    assert peak_of(lambda: spz.read(path)) - sum(array.nbytes for array in model.arrays().values()) < 5 << 20
