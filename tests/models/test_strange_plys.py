# SPDX-License-Identifier: Apache-2.0
"""3DGS PLYs as other programs write them: without a third scale, with plain colours, with long headers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calls import no_warnings, peak_of, refuses, warned
from models import assert_equal, random_gaussians

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models import formats
from clsplat.models.codec import ply_file, values
from clsplat.models.info import model_info
from clsplat.spherical_harmonics import SH_C0

KINDS = {"uchar": "u1", "ushort": "u2", "uint": "u4", "int": "i4", "float": "f4", "double": "f8"}


def columns(model: Gaussians) -> dict[str, np.ndarray]:
    """The properties of a model of degree 0."""
    found = {f"f_dc_{channel}": model.sh[:, 0, channel] for channel in range(3)} | {"opacity": model.opacity_logits}
    found |= {axis: model.means[:, index] for index, axis in enumerate("xyz")}
    found |= {f"scale_{index}": model.log_scales[:, index] for index in range(3)}
    return found | {f"rot_{index}": model.quaternions[:, index] for index in range(4)}


def write(path: Path, table: dict[str, np.ndarray], kinds: dict[str, str], order: str = "<") -> Path:
    """A PLY; kinds: types of the properties that are no floats; order: ascii, < or >."""
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "ascii": "ascii"}[order]
    count = len(table["x"])
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}"]
    lines += [f"property {kinds.get(name, 'float')} {name}" for name in table]
    row = np.dtype([(name, (order if order != "ascii" else "<") + KINDS[kinds.get(name, "float")]) for name in table])
    rows = np.empty(count, row)
    for name, column in table.items():
        rows[name] = column
    body = rows.tobytes()
    if order == "ascii":
        body = "\n".join(" ".join(map(repr, each.tolist())) for each in rows).encode() + b"\n"
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
    return path


@pytest.mark.brings("2DGS", "PLY without `scale_2`", "flat Gaussians")
@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_two_scales_are_those_of_a_flat_gaussian(tmp_path: Path, order: str) -> None:
    model = random_gaussians(40, 0)
    table = columns(model)
    del table["scale_2"]
    path = write(tmp_path / "model.ply", table, {}, order)
    with no_warnings():
        read = Gaussians.load(path)
        assert model_info(path)["scale"]["p0"] == pytest.approx(values.MIN_SCALE)
    model.log_scales[:, 2] = np.log(values.MIN_SCALE)
    assert_equal(read, model)
    del table["scale_1"]
    refuses("PLY lacks the property scale_1", Gaussians.load, write(path, table, {}))


@pytest.mark.brings("nerfstudio", "`red green blue` in place of `f_dc`", "their coefficients")
@pytest.mark.parametrize(
    "names",
    [
        ("red", "green", "blue"),
        ("r", "g", "b"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("R", "G", "B"),
        ("Red", "Green", "BLUE"),
    ],
)
@pytest.mark.parametrize(
    ("kind", "levels", "white"),
    [
        ("uchar", [0, 128, 255], 255),
        ("uchar", [0, 1, 1], 255),  # almost black
        ("ushort", [0, 32768, 65535], 65535),
        ("ushort", [0, 100, 255], 255),
        ("int", [1, 2, 3], 255),
        ("float", [0, 0.25, 1], 1),
        ("double", [0, 12.5, 255], 255),
        ("float", [0.5, 1.5, 0.25], 1),  # brighter than white
    ],
)
def test_colours_stand_in_for_coefficients(
    tmp_path: Path,
    names: tuple[str, ...],
    kind: str,
    levels: list[float],
    white: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their range is that of all rows, of which a block may have the dark ones alone."""
    monkeypatch.setattr(ply_file, "IO_BLOCK_ROWS", 8)
    model = random_gaussians(50, 0)
    table = {name: column for name, column in columns(model).items() if not name.startswith("f_dc")}
    colours = np.full((50, 3), min(levels))
    colours[[10, 49]] = levels
    for order in ("<", ">", "ascii"):
        path = write(
            tmp_path / "model.ply", table | dict(zip(names, colours.T, strict=True)), dict.fromkeys(names, kind), order
        )
        read = Gaussians.load(path)
        np.testing.assert_allclose(0.5 + SH_C0 * read.sh[:, 0], colours / white, atol=1e-6)  # float32's rounding
        model.sh = read.sh
        assert_equal(read, model)
    assert model_info(path)["ignored"] == []


def test_coefficients_go_before_colours(tmp_path: Path) -> None:
    model = random_gaussians(10, 0)
    table = columns(model) | dict.fromkeys(("red", "green", "blue"), np.full(10, 7))
    path = write(tmp_path / "model.ply", table, dict.fromkeys(("red", "green", "blue"), "uchar"))
    assert_equal(Gaussians.load(path), model)
    assert model_info(path)["ignored"] == ["red", "green", "blue"]
    del table["green"], table["f_dc_1"]
    refuses(r"PLY lacks the property f_dc_1, expected a 3DGS model$", Gaussians.load, write(path, table, {}))
    del table["f_dc_0"], table["f_dc_2"]
    with pytest.raises(InputError, match=r"f_dc_2, expected a 3DGS model with f_dc_0 to 2, or red green blue$"):
        Gaussians.load(write(path, table, {}))


@pytest.mark.brings("any", "lines of a header of up to 1 MiB", "the model")
@pytest.mark.parametrize("name", ["model.ply", "model.compressed.ply"])
@pytest.mark.parametrize("length", [4096, 5000, 200_000, (1 << 20) - 20])
def test_a_long_comment(tmp_path: Path, name: str, length: int) -> None:
    """Beyond the 64 KiB that tell the format, too, by any name."""
    path, model = tmp_path / name, random_gaussians(300, 1)
    formats.save(path, model)
    wanted = Gaussians.load(path)
    data = path.read_bytes().replace(b"element vertex", b"comment " + b"a" * length + b"\nelement vertex", 1)
    if name.startswith("model.c"):
        data = data.replace(b"element chunk", b"comment " + b"b" * length + b"\nelement chunk", 1)
    for other in (path, tmp_path / "other.ply"):
        other.write_bytes(data)
        assert_equal(Gaussians.load(other), wanted)
        assert "a" * length in model_info(other)["comments"]


@pytest.mark.brings("Visual C++ of before 2015", "ascii PLY with `1.#QNAN`, `-nan(ind)`", "NaN and infinite")
@pytest.mark.parametrize("word", ["-nan(ind)", "1.#QNAN", "-1.#IND", "1.#SNAN0", "nan(snan)", "-1.#IND00"])
def test_words_for_no_number(tmp_path: Path, word: str) -> None:
    path = with_word(tmp_path, 2, word)
    with pytest.warns(UserWarning, match="1 of 6 Gaussians has a value .* a rotation of Gaussian 2; it is left out"):
        assert len(Gaussians.load(path)) == 5


@pytest.mark.parametrize(("word", "sign"), [("-1.#INF", -1), ("1.#INF", 1), ("1.#INF00", 1), ("-inf", -1)])
def test_words_for_infinite(tmp_path: Path, word: str, sign: int) -> None:
    path = with_word(tmp_path, 4, word, "opacity")
    assert Gaussians.load(path).opacity_logits[4] == values.logits(np.array([(1 + sign) / 2]))[0]


@pytest.mark.parametrize("word", ["1,5", "1.#", "nano", "12x", "é"])
def test_a_word_that_is_no_number_is_told_with_its_row(
    tmp_path: Path, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ply_file, "IO_BLOCK_ROWS", 2)
    path = with_word(tmp_path, 5, word)
    shown = word if word.isascii() else "\ufffd\ufffd"
    refuses(rf"model\.ply: Gaussian 5 has {shown!r}, expected a number$", Gaussians.load, path)


def with_word(tmp_path: Path, row: int, word: str, last: str = "rot_3") -> Path:
    """A text of 6 Gaussians, in one of which that property, the last of its line, is the word."""
    table = columns(random_gaussians(6, 0))
    table[last] = table.pop(last)
    path = write(tmp_path / "model.ply", table, {}, "ascii")
    lines = path.read_text().splitlines()
    at = lines.index("end_header") + 1 + row
    lines[at] = lines[at].rsplit(" ", 1)[0] + f" {word}"
    path.write_text("\n".join(lines))
    return path


def test_whole_colours_in_text_that_are_no_number(tmp_path: Path) -> None:
    """They warn once, and not of NumPy's cast; the others have the range that they have without it."""
    table = {name: column for name, column in columns(random_gaussians(6, 0)).items() if not name.startswith("f_dc")}
    names = ("red", "green", "blue")
    table |= dict.fromkeys(names, np.array([0, 1000, 65535, 4, 5, 6]))
    path = write(tmp_path / "model.ply", table, dict.fromkeys(names, "ushort"), "ascii")
    path.write_text(path.read_text().replace(" 4 4 4\n", " 4 nan 4\n"))
    read = warned("1 of 6 Gaussians has", Gaussians.load, path)
    # float32's rounding
    np.testing.assert_allclose(0.5 + SH_C0 * read.sh[:, 0, 0], np.array([0, 1000, 65535, 5, 6]) / 65535, atol=1e-6)


@pytest.mark.parametrize(("lines", "fits"), [(9_000, True), (10_000, False), (12_000, False)])
def test_lines_of_a_header_are_bounded(tmp_path: Path, lines: int, fits: bool) -> None:
    path = tmp_path / "model.ply"
    formats.save(path, random_gaussians(3, 0))
    many = b"".join(b"comment %d\n" % line for line in range(lines))
    path.write_bytes(path.read_bytes().replace(b"element vertex", many + b"element vertex", 1))
    if fits:
        assert len(Gaussians.load(path)) == 3
        return
    refuses(r"model\.ply: PLY header has more than 10,000 lines; is it damaged\?$", Gaussians.load, path)


def test_a_header_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    formats.save(path, random_gaussians(3, 0))
    whole = path.read_bytes()
    line = b"comment " + b"a" * 900_000 + b"\n"
    for many in (line * 30, b"comment " + b"a" * (1 << 20) + b"\n", b"\0" * (50 << 20)):
        path.write_bytes(whole.replace(b"element vertex", many + b"element vertex", 1))
        said = r"model\.ply: PLY header .*is it damaged\?"
        # the bound, as bytes, as text and as words, and the head by which the format is told
        assert peak_of(lambda: refuses(said, Gaussians.load, path)) < 6 * ply_file.MAX_PLY_HEADER_BYTES  # noqa: B023
