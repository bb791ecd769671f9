# SPDX-License-Identifier: Apache-2.0
"""Model files: what we write is what every tool reads, what they write we read, what is broken is named."""

import errno
import re
import time
from pathlib import Path

import numpy as np
import pytest
from calls import no_warnings, peak_of, refuses, warned
from models import assert_equal, random_gaussians, real_file

from clsplat.gaussians import Gaussians
from clsplat.models import formats
from clsplat.models.codec import ply_file
from clsplat.models.formats import ply

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
NAMES += [f"rot_{i}" for i in range(4)]


def header(names: list[str], count: int, form: str = "binary_little_endian", kind: str = "float") -> bytes:
    lines = ["ply", f"format {form} 1.0", "comment by hand", f"element vertex {count}"]
    return "\n".join(lines + [f"property {kind} {name}" for name in names] + ["end_header", ""]).encode()


def write_plain(path: Path, table: np.ndarray, names: list[str] = NAMES) -> Path:
    path.write_bytes(header(names, len(table)) + table.astype("<f4").tobytes())
    return path


def plain_table(count: int = 5) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((count, len(NAMES))).astype(np.float32)


@pytest.mark.smoke
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 7])
def test_round_trip(tmp_path: Path, degree: int, count: int) -> None:
    path, gaussians = tmp_path / "model.ply", random_gaussians(count, degree)
    gaussians.save(path)
    loaded = Gaussians.load(path)
    assert loaded.sh_degree == degree
    assert_equal(gaussians, loaded)


def test_round_trip_over_block_seams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model.ply"
    monkeypatch.setattr(ply, "IO_BLOCK_ROWS", 8)
    monkeypatch.setattr(ply_file, "IO_BLOCK_ROWS", 8)
    for count in (7, 8, 9, 16, 17):
        gaussians = random_gaussians(count, 1)
        gaussians.save(path)
        assert_equal(gaussians, Gaussians.load(path))


def test_layout_is_the_authors(tmp_path: Path) -> None:
    path, gaussians = tmp_path / "model.ply", random_gaussians(1, 3)
    gaussians.sh[0] = np.arange(48, dtype=np.float32).reshape(16, 3)  # coefficient k of channel c is 3 k + c
    gaussians.save(path)
    head, data = path.read_bytes().split(b"end_header\n")
    names = [line.split()[2].decode() for line in head.split(b"\n") if line.startswith(b"property float ")]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45))]
    assert names == [*expected, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    row = dict(zip(names, np.frombuffer(data, "<f4"), strict=True))
    assert [row[f"f_dc_{c}"] for c in range(3)] == [0, 1, 2]
    assert [row[f"f_rest_{i}"] for i in range(45)] == [3 * (1 + i % 15) + i // 15 for i in range(45)]
    assert (row["nx"], row["ny"], row["nz"]) == (0, 0, 0)
    assert row["rot_0"] == gaussians.quaternions[0, 0]
    assert row["opacity"] == gaussians.opacity_logits[0]


def test_same_bytes_each_time(tmp_path: Path) -> None:
    gaussians = random_gaussians(50)
    gaussians.save(tmp_path / "a.ply")
    gaussians.save(tmp_path / "b.ply")
    Gaussians.load(tmp_path / "a.ply").save(tmp_path / "c.ply")
    assert len({(tmp_path / f"{name}.ply").read_bytes() for name in "abc"}) == 1


def test_padding_to_a_degree(tmp_path: Path) -> None:
    path, gaussians = tmp_path / "model.ply", random_gaussians(4, 1)
    gaussians.save(path, sh_degree=3)
    loaded = Gaussians.load(path)
    assert loaded.sh_degree == 3
    np.testing.assert_array_equal(loaded.sh[:, :4], gaussians.sh)
    assert not loaded.sh[:, 4:].any()
    refuses("expected 1", gaussians.save, path, sh_degree=0, error=ValueError)


def test_wrong_arrays_are_named(tmp_path: Path) -> None:
    gaussians = random_gaussians(4)
    gaussians.quaternions = gaussians.quaternions[:3]
    with pytest.raises(ValueError, match=r"quaternions is float32 \(3, 4\), expected float32 \(4, 4\)"):
        gaussians.save(tmp_path / "model.ply")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_formats_orders_and_other_properties(tmp_path: Path, form: str, kind: str) -> None:
    """Any format and number type, properties shuffled, others among them, an element before and one after."""
    path, gaussians = tmp_path / "model.ply", random_gaussians(6, 1)
    gaussians.save(path)
    data = np.frombuffer(path.read_bytes().split(b"end_header\n")[1], "<f4").reshape(6, -1)
    names = [*NAMES[:3], "nx", "ny", "nz", *NAMES[3:6], *(f"f_rest_{i}" for i in range(9)), *NAMES[6:]]
    order = np.random.default_rng(3).permutation(len(names))
    shuffled = [names[i] for i in order]
    text = f"ply\r\nformat {form} 1.0\r\nobj_info x\r\nelement camera 2\r\nproperty uchar id\r\nelement vertex 6\r\n"
    text += "".join(f"property {kind} {name}\r\n" for name in [*shuffled, "red"]) + "element face 1\r\n"
    text += "property list uchar int vertex_indices\r\nend_header\r\n"
    table = np.column_stack([data[:, order], np.full(6, 255)])
    if form == "ascii":
        body = "1\n2\n" + "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in table) + "3 0 1 2\n"
        path.write_bytes(text.encode() + body.encode())
    else:
        code = (">" if "big" in form else "<") + ("f8" if kind == "double" else "f4")
        path.write_bytes(text.encode() + b"\x01\x02" + table.astype(code).tobytes() + b"\x03" + bytes(12))
    with no_warnings():
        assert_equal(gaussians, Gaussians.load(path))


def test_trailing_bytes_give_a_warning(tmp_path: Path) -> None:
    path, gaussians = tmp_path / "model.ply", random_gaussians(3)
    gaussians.save(path)
    path.write_bytes(path.read_bytes() + b"1234567")
    assert_equal(gaussians, warned(r"model\.ply: 7 bytes after the last Gaussian are ignored", Gaussians.load, path))


@pytest.mark.parametrize("name", [*(name for name in NAMES if name != "scale_2"), "f_rest_4"])
def test_missing_property_is_named(tmp_path: Path, name: str) -> None:
    names = [*NAMES, *(f"f_rest_{i}" for i in range(9))]
    if name.startswith("f_rest"):
        names[names.index(name)] = "f_rest_77"
    else:
        names.remove(name)
    path = write_plain(tmp_path / "model.ply", np.zeros((2, len(names))), names)
    refuses(rf"model\.ply: PLY lacks the property {name}\b", Gaussians.load, path)


def bad(tmp_path: Path, content: bytes) -> str:
    path = tmp_path / "model.ply"
    path.write_bytes(content)
    return refuses(rf"^{re.escape(str(path))}", Gaussians.load, path)


def test_not_a_ply(tmp_path: Path) -> None:
    for content in (b"", b"pl", b"\x1f\x8b\x08\x00 something else", b"plywood\n", b"\x00" * 200):
        assert "not a PLY" in bad(tmp_path, content)


def test_broken_headers(tmp_path: Path) -> None:
    whole = header(NAMES, 1)
    assert "no line 'end_header'" in bad(tmp_path, whole[:60])
    assert "no line 'end_header'" in bad(tmp_path, b"ply\n" + b"x" * 5000)
    assert "'element vertex many'" in bad(tmp_path, whole.replace(b"vertex 1", b"vertex many"))
    assert "'element vertex -1'" in bad(tmp_path, whole.replace(b"vertex 1", b"vertex -1"))
    assert "'property quad x'" in bad(tmp_path, whole.replace(b"float x", b"quad x"))
    assert "format 'binary_middle'" in bad(tmp_path, header(NAMES, 1, "binary_middle"))
    assert "no element 'vertex' (elements: chunk)" in bad(tmp_path, whole.replace(b"vertex", b"chunk"))
    assert "property x twice" in bad(tmp_path, header(["x", *NAMES], 1))
    assert "12 f_rest properties" in bad(tmp_path, header([*NAMES, *(f"f_rest_{i}" for i in range(12))], 1))


def test_truncated(tmp_path: Path) -> None:
    data = plain_table(5).tobytes()
    message = bad(tmp_path, header(NAMES, 5) + data[:-1])
    assert "truncated: has 4 of 5 Gaussians (279 of 280 bytes)" in message
    assert "truncated" in bad(tmp_path, header(NAMES, 10**15) + data)  # nothing of that size is allocated
    text = "\n".join(" ".join(map(str, row)) for row in plain_table(5)).encode()
    assert "truncated: has 5 Gaussians, expected 6" in bad(tmp_path, header(NAMES, 6, "ascii") + text)
    assert "Gaussian 4 has 13 values, expected 14" in bad(tmp_path, header(NAMES, 5, "ascii") + text.rsplit(b" ", 1)[0])
    wrong = text.rsplit(b" ", 1)[0] + b" red"
    assert "Gaussian 4 has 'red', expected a number" in bad(tmp_path, header(NAMES, 5, "ascii") + wrong)


def test_no_gaussians(tmp_path: Path) -> None:
    assert "0 Gaussians" in bad(tmp_path, header(NAMES, 0))


def test_values_that_are_not_finite_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply_file, "IO_BLOCK_ROWS", 2)
    table, path = plain_table(9), tmp_path / "model.ply"
    table[3, 1], table[3, 2], table[7, 0] = np.nan, np.inf, -np.inf
    write_plain(path, table)
    read = warned(r"model\.ply: 2 of 9 .* the first is a position of Gaussian 3; they are left", Gaussians.load, path)
    np.testing.assert_array_equal(read.means, table[[0, 1, 2, 4, 5, 6, 8], :3])
    for column, name in [(4, "a colour"), (6, "an opacity"), (8, "a scale"), (13, "a rotation")]:
        table = plain_table(9)
        table[5:, column] = np.nan
        write_plain(path, table)
        with pytest.warns(UserWarning, match=rf"4 of 9 .* the first is {name} of Gaussian 5; they are left out"):
            assert len(Gaussians.load(path)) == 5
    wide = plain_table(1).astype(np.float64)
    wide[0, 0] = 1e300  # finite as a double, not as a float
    assert "1 of 1 Gaussians" in bad(tmp_path, header(NAMES, 1, kind="double") + wide.tobytes())


def test_no_such_file_and_a_folder(tmp_path: Path) -> None:
    refuses(r"none\.ply: no such file", Gaussians.load, tmp_path / "none.ply")
    refuses("is a folder", Gaussians.load, tmp_path)


def test_disk_full_leaves_the_previous_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import builtins

    path, gaussians = tmp_path / "model.ply", random_gaussians(3)
    gaussians.save(path)
    before, real_open = path.read_bytes(), builtins.open

    def full_disk(name: object, mode: str = "r", **options: object) -> object:
        file = real_open(name, mode)  # type: ignore[call-overload]
        if mode != "xb":
            return file

        class Full:
            written = 0

            def write(self, data: bytes) -> int:
                Full.written += memoryview(data).nbytes
                if Full.written > 1000:
                    raise OSError(errno.ENOSPC, "No space left on device")
                return int(file.write(data))

            def tell(self) -> int:
                return Full.written

            def __enter__(self) -> "Full":  # noqa: PYI034
                return self

            def __exit__(self, *_: object) -> None:
                file.close()

        return Full()

    monkeypatch.setattr(builtins, "open", full_disk)
    refuses("the disk is full: 123 KiB are needed", random_gaussians(500, seed=1).save, path, error=OSError)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_real_trained_model() -> None:
    gaussians = Gaussians.load(real_file("samples/kacytran1122_iter7000_9080.ply"))
    assert len(gaussians) == 9080
    assert gaussians.sh_degree == 3
    norms = np.linalg.norm(gaussians.quaternions, axis=1)
    assert 0.6 < norms.min() < 0.7
    assert 1.1 < norms.max() < 1.2


def test_real_trained_model_comes_back_byte_for_byte(tmp_path: Path) -> None:
    source = real_file("samples/kacytran1122_iter7000_9080.ply")
    Gaussians.load(source).save(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == source.read_bytes()


def test_real_model_with_trailing_bytes() -> None:
    source = real_file("samples/cvlab-epfl_pc_short_100.ply")
    assert len(warned("14029 bytes after the last Gaussian are ignored", Gaussians.load, source)) == 100


def test_real_hand_made_model() -> None:
    gaussians = Gaussians.load(real_file("samples/splatapult_test.ply"))
    assert len(gaussians) == 16
    assert (gaussians.opacity_logits == 100).all()


def test_reading_makes_no_second_copy_of_the_file(tmp_path: Path) -> None:
    path, model = tmp_path / "model.ply", random_gaussians(200_000)
    model.save(path)
    own = sum(array.nbytes for array in model.arrays().values())
    # three blocks of rows, of 8 MB each: the last, the next, and what reading it has joined. The file has 50 MB.
    assert peak_of(lambda: Gaussians.load(path)) < own + 3 * ply.IO_BLOCK_ROWS * 248 + (2 << 20)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "seconds"),
    [("model.ply", {}, 1), *(("model.spz", {"version": version}, 2) for version in formats.spz.SPZ_VERSIONS)],
)
def test_seconds_of_a_million(name: str, options: dict[str, int], seconds: float, tmp_path: Path) -> None:
    formats.save(tmp_path / name, random_gaussians(1_000_000), **options)
    start = time.process_time()  # other work on the machine does not count
    formats.load(tmp_path / name)
    assert time.process_time() - start < seconds
