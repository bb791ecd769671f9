# SPDX-License-Identifier: Apache-2.0
"""Compressed PLY, .splat and .ksplat to the bit, against files that are made here by their specifications."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calls import complaint, warned
from ksplats import ksplat
from models import random_gaussians, real_file

from clsplat.models import edit, formats
from clsplat.models.codec import values as packing
from clsplat.models.formats import compressed_ply, ply
from clsplat.spherical_harmonics import SH_C0

CHUNK = [
    *(f"{end}_{name}" for end in ("min", "max") for name in "xyz"),
    *(f"{end}_scale_{name}" for end in ("min", "max") for name in "xyz"),
    *(f"{end}_{name}" for end in ("min", "max") for name in "rgb"),
]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def compressed(
    vertices: list[tuple[int, ...]], bounds: list[float], *, colours: bool = True, sh: bytes = b"", chunks: int = 1
) -> bytes:
    names = CHUNK if colours else CHUNK[:12]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element vertex {len(vertices)}", *(f"property uint {name}" for name in PACKED)]
    if sh:
        lines += [f"element sh {len(vertices)}"]
        lines += [f"property uchar f_rest_{i}" for i in range(len(sh) // len(vertices))]
    body = struct.pack(f"<{len(names)}f", *bounds[: len(names)]) * chunks
    body += b"".join(struct.pack("<4I", *vertex) for vertex in vertices) + sh
    return "\n".join([*lines, "end_header", ""]).encode() + body


NAN = struct.pack("<f", np.nan)
BOUNDS = [-1.0, -2.0, 3.0, 1.0, 2.0, 5.0, -6.0, -5.0, -4.0, -1.0, -2.0, -3.0, 0.0, 0.25, 0.5, 1.0, 0.75, 1.5]


def test_a_compressed_ply_by_hand(tmp_path: Path) -> None:
    top = 2047 << 21 | 0 << 11 | 2047
    middle = 512  # of 1023: 0.00048 over zero in the fields of rotation
    vertices = [
        (top, 0 << 30 | middle << 20 | middle << 10 | middle, 0, 0xFF00FF80),
        (0, 3 << 30 | 1023 << 20 | 0 << 10 | middle, top, 0x00000000),
    ]
    (tmp_path / "a.ply").write_bytes(compressed(vertices, BOUNDS, sh=bytes([0, 255, 128, *range(6)] * 2)))
    read = formats.load(tmp_path / "a.ply")
    np.testing.assert_allclose(read.means, [[1, -2, 5], [-1, -2, 3]])
    np.testing.assert_allclose(read.log_scales, [[-6, -5, -4], [-1, -5, -3]])
    rgb = np.array([[1.0, 0.25, 1.5], [0.0, 0.25, 0.5]])
    np.testing.assert_allclose(read.sh[:, 0], (rgb - 0.5) / SH_C0, rtol=1e-6)
    np.testing.assert_allclose(packing.opacities(read.opacity_logits), [128 / 255, 0.25 / 255], rtol=1e-5)
    tiny = np.sqrt(2) * (512 / 1023 - 0.5)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(read.quaternions[0], [1, tiny, tiny, tiny], atol=2e-6)
    np.testing.assert_allclose(read.quaternions[1, :3], [half, -half, tiny], atol=1e-6)
    np.testing.assert_allclose(read.sh[0, 1:, 0], [-4, 4, 4 / 256], rtol=1e-6)  # red first, then green
    np.testing.assert_allclose(read.sh[0, 1:, 1], [-4, (1.5 / 256 - 0.5) * 8, (2.5 / 256 - 0.5) * 8], rtol=1e-6)


def test_a_compressed_ply_of_old_has_colours_of_0_to_1(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(compressed([(0, 0, 0, 0xFF00FFFF)], BOUNDS, colours=False))
    np.testing.assert_allclose(0.5 + SH_C0 * formats.load(path).sh[0, 0], [1, 0, 1], atol=1e-6)


def test_chunks_are_of_neighbours_and_the_last_may_be_short(tmp_path: Path) -> None:
    model = random_gaussians(3 * 256 + 10, 2)
    model.sh *= 0.5
    path = tmp_path / "a.compressed.ply"
    formats.save(path, model)
    assert b"element chunk 4\n" in path.read_bytes()
    rows = compressed_ply.order(model)
    assert sorted(rows.tolist()) == list(range(len(model)))
    read, written = formats.load(path), edit.take(model, rows)
    for start in range(0, len(model), 256):
        block = written.means[start : start + 256]
        steps = (block.max(axis=0) - block.min(axis=0)) / (2047, 1023, 2047)
        assert (np.abs(read.means[start : start + 256] - block) <= 0.501 * steps).all()
    np.testing.assert_allclose(read.sh[:, 1:], written.sh[:, 1:], atol=4 / 256 + 1e-6)
    assert np.abs(written.sh[:, 1:]).max() < 4
    extents = [np.ptp(written.means[i : i + 256], axis=0).prod() for i in range(0, 3 * 256, 256)]
    assert max(extents) < 0.75 * np.ptp(model.means, axis=0).prod()


def test_morton_order_interleaves_the_bits() -> None:
    """Against a loop over bits."""
    means = np.random.default_rng(0).integers(0, 1 << 21, (300, 3)).astype(np.float32)
    means[:2] = ((0, 0, 0), ((1 << 21) - 1,) * 3)  # a box in which a cell is 1

    def code(mean: np.ndarray) -> int:
        return sum((int(mean[axis]) >> bit & 1) << 3 * bit + axis for bit in range(21) for axis in range(3))

    codes = [code(means[row]) for row in packing.morton_order(means)]
    assert codes == sorted(codes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda data: data.replace(b"element chunk 1\n", b"element chunk 0\n"),
            "has 0 chunks of 256 Gaussians, too few for 2",
        ),
        (
            lambda data: data.replace(b"element chunk 1\n", b"element chunk 99999999999\n"),
            "but its header announces",
        ),
        (lambda data: data.replace(b"element vertex 2", b"element vertex 255"), "sh has 2 rows, expected 255"),
        (lambda data: data.replace(b"element vertex 2", b"element vertex 0"), "0 Gaussians"),
        (lambda data: data.replace(b"uint packed_scale", b"uint packed_other"), "vertex lacks packed_scale"),
        (lambda data: data.replace(b"uint packed_scale", b"float packed_scale"), "vertex lacks packed_scale"),
        (lambda data: data.replace(b"float max_b", b"float max_w"), "chunk lacks max_b"),
        (lambda data: data.replace(b"f_rest_8", b"f_rest_7"), "element sh"),
        (lambda data: data.replace(b"element sh 2", b"element sh 1"), "sh has 1 rows, expected 2"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "in ascii"),
        (lambda data: data.replace(b"element chunk", b"element lumps"), "0 elements 'chunk'"),
        (lambda data: data[:-1], "but its header announces"),
        (lambda data: data.replace(struct.pack("<f", -2.0), NAN), "2 of 2 Gaussians have a value"),
    ],
)
def test_spoilt_compressed_plys_are_named(change: Callable[[bytes], bytes], message: str, tmp_path: Path) -> None:
    data = change(compressed([(0, 0, 0, 0), (1, 1, 1, 1)], BOUNDS, sh=bytes(18)))
    assert_refused(tmp_path / "a.compressed.ply", data, message)


def assert_refused(path: Path, data: bytes, message: str) -> None:
    path.write_bytes(data)
    assert re.search(message, complaint(path, formats.load, path))


TURN = (0, 0, 0, 0, 64, 192, 128, 219)
"""Colour, opacity and rotation of a .splat."""


def test_a_splat_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    record = struct.pack("<6f8B", 1, 2, 3, 0.5, 0.25, 0, 255, 0, 51, 204, 64, 192, 128, 219)
    path.write_bytes(record)
    read = formats.load(path)
    np.testing.assert_array_equal(read.means, [[1, 2, 3]])
    np.testing.assert_allclose(read.log_scales, np.log([[0.5, 0.25, packing.MIN_SCALE]]), rtol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * read.sh[0, 0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(packing.opacities(read.opacity_logits), [0.8], rtol=1e-6)
    np.testing.assert_allclose(read.quaternions, [[-0.5, 0.5, 0, 91 / 128]])
    for data, message in (
        (record[:-1], "31 bytes"),
        (b"", "0 bytes"),
        (struct.pack("<6f8B", 1, np.nan, 3, 1, 1, 1, *TURN), "a position of Gaussian 0; expected at least one"),
        (record * 100 + struct.pack("<6f8B", 1, 2, 3, 1, -1, 1, *TURN), "Gaussian 100 has the scales 1 -1 1"),
        (bytes(64), r"not a \.splat file \(rotations of length 2\.00"),
        (struct.pack("<6f8B", 1, 2, 3, 1, np.inf, 1, *TURN), "a scale of Gaussian 0; expected at least one"),
    ):
        assert_refused(path, data, message)


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_ksplat_of_every_level_and_degree(level: int, degree: int, tmp_path: Path) -> None:
    model = random_gaussians(40, degree)
    model.sh *= 0.3
    data, wanted = ksplat(model, level, (17, 23))
    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    read = formats.load(path)
    assert read.sh_degree == degree
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(read, name), getattr(wanted, name), rtol=1e-5, atol=1e-5, err_msg=name)


def test_records_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    """A record of a .splat; a bucket's middle of a .ksplat, and a bound of a chunk, which are of many Gaussians."""
    path = tmp_path / "a.splat"
    good, bad = (struct.pack("<6f8B", x, 2, 3, 1, 1, 1, *TURN) for x in (1, np.nan))
    path.write_bytes(good + bad + good + bad)
    with pytest.warns(UserWarning, match=r"2 of 4 Gaussians have .*, the first is a position of Gaussian 1; they are"):
        np.testing.assert_array_equal(formats.load(path).means, [[1, 2, 3]] * 2)
    data, wanted = ksplat(random_gaussians(40, 1), 1, (17, 23))
    spoilt = bytearray(data)
    spoilt[4112:4116] = struct.pack("<f", np.nan)  # the size of the first section's blocks
    path = tmp_path / "a.ksplat"
    path.write_bytes(spoilt)
    read = warned(r"17 of 40 Gaussians have .*, the first is a position of Gaussian 0; they are", formats.load, path)
    np.testing.assert_allclose(read.means, wanted.means[17:], atol=1e-5)  # as in the test of whole files
    path = tmp_path / "a.compressed.ply"
    both = compressed([(0, 0, 0, 0xFF00FF80), (2047 << 21, 0, 0, 0x00FF0080)], BOUNDS)
    path.write_bytes(both.replace(struct.pack("<f", 0.5), struct.pack("<f", -np.inf)))  # the least blue
    with pytest.warns(UserWarning, match=r"1 of 2 Gaussians has .*, the first is a colour of Gaussian 1; it is"):
        np.testing.assert_allclose(0.5 + SH_C0 * formats.load(path).sh[:, 0], [[1, 0.25, 1.5]], atol=1e-6)


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (0, b"\1", "version 1.1"),
        (1, b"\0", "version 0.0"),
        (20, b"\3", "compression level 3"),
        (4, b"\xff\xff\xff\xff", "but its 4294967295 sections need"),
        (16, b"\xff\xff\xff\xff", "but its header says 4294967295"),
        (4096, b"\xff\xff\xff\xff", "section 0 ends at byte"),
        (4100, b"\xff\xff\xff\xff", "section 0 ends at byte"),
        (4108, b"\xff\xff\xff\xff", "section 0 ends at byte"),
        (4116, b"\5", "buckets of 5 bytes"),
        (4128, b"\xff\xff\xff\x7f", "2147483647 full and 2 partly filled buckets"),
        (4104, b"\1", "but its buckets have fewer"),
        (4132, b"\xff\xff\xff\x7f", "section 0 ends at byte"),
        (4136, b"\4", "SH of degree 4"),
    ],
)
def test_spoilt_ksplats_are_named(at: int, value: bytes, message: str, tmp_path: Path) -> None:
    data = bytearray(ksplat(random_gaussians(40, 1), 1, (17, 23))[0])
    data[at : at + len(value)] = value
    assert_refused(tmp_path / "a.ksplat", data, message)


def test_a_ply_with_sh_of_degree_4_is_read_up_to_3(tmp_path: Path) -> None:
    model = random_gaussians(5)
    ply.write(tmp_path / "a.ply", model)
    head, mark, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.splitlines() if line.startswith(b"property")]
    first, last = names.index(b"f_rest_0"), names.index(b"f_rest_44")
    rows = np.frombuffer(body, "<f4").reshape(5, -1)
    rest = rows[:, first : last + 1].reshape(5, 3, 15)
    wide = np.concatenate([rest, np.full((5, 3, 9), 7.0, "<f4")], axis=2).reshape(5, 72)
    table = np.concatenate([rows[:, :first], wide, rows[:, last + 1 :]], axis=1)
    more = b"".join(b"property float f_rest_%d\n" % i for i in range(45, 72))
    head = head.replace(b"property float f_rest_44\n", b"property float f_rest_44\n" + more)
    (tmp_path / "b.ply").write_bytes(head + mark + table.astype("<f4").tobytes())
    read = warned(r"b\.ply: has SH of degree 4; coefficients above degree 3", formats.load, tmp_path / "b.ply")
    np.testing.assert_array_equal(read.sh, model.sh)


def test_the_same_four_gaussians_in_splat_and_ksplat() -> None:
    a, b = (formats.load(real_file(f"samples/splat-transform_minimal.{kind}")) for kind in ("splat", "ksplat"))
    for name in ("means", "sh", "opacity_logits", "log_scales"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    np.testing.assert_allclose(a.quaternions, b.quaternions, atol=1 / 128)
