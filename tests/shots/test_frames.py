# SPDX-License-Identifier: Apache-2.0
"""Frame ranges and names of files."""

from __future__ import annotations

from pathlib import Path

import pytest
from calls import complaint, refuses
from hypothesis import given
from hypothesis import strategies as st

from clsplat.errors import InputError
from clsplat.shots.frame_numbers import has_number, numbered_files, output_paths, parse_frames, path_of, ranges


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", [7]),
        ("1-5", [1, 2, 3, 4, 5]),
        ("1-10:3", [1, 4, 7, 10]),
        ("1-9:3", [1, 4, 7]),
        ("1-10x2", [1, 3, 5, 7, 9]),
        ("10-1", [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]),
        ("10-1x4", [2, 6, 10]),
        ("3,-1--5:2", [-5, -3, -1, 3]),
        ("5-5", [5]),
        ("7,12,30-32", [7, 12, 30, 31, 32]),
        ("30-32, 7 ,12", [7, 12, 30, 31, 32]),
        ("1-5,3-7", [1, 2, 3, 4, 5, 6, 7]),
        ("-2-1", [-2, -1, 0, 1]),
        ("-5--1:2", [-5, -3, -1]),
        ("-3", [-3]),
        ("0001-0003", [1, 2, 3]),
    ],
)
def test_frames(text: str, frames: list[int]) -> None:
    assert parse_frames(text) == frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' is not a frame or a range"),
        ("1,,2", "'' is not a frame or a range"),
        ("1-", "'1-' is not a frame or a range"),
        ("a-b", "'a-b' is not a frame or a range"),
        ("1:2", "'1:2' is not a frame or a range"),
        ("1.5", "'1.5' is not a frame or a range"),
        ("1-10:-1", "'1-10:-1' is not a frame or a range"),
        ("1-10:0", "the step 0, expected at least 1"),
        ("1-10x-1", "'1-10x-1' is not a frame or a range"),
        ("1-99999999", "lists more than 10,000,000 frames"),
        ("99999999-1", "lists more than 10,000,000 frames"),
    ],
)
def test_frames_that_are_none(text: str, message: str) -> None:
    assert message in complaint(f"--frames {text}", parse_frames, text)


@given(st.sets(st.integers(-50, 50), min_size=1, max_size=16))
def test_ranges_are_read_again(frames: set[int]) -> None:
    short = ranges(sorted(frames))
    if short.endswith("..."):
        assert set(parse_frames(short.removesuffix(",..."))) < frames
    else:
        assert parse_frames(short) == sorted(frames)


@pytest.mark.parametrize(
    ("pattern", "path"),
    [
        ("shot/beauty.####.exr", "shot/beauty.0042.exr"),
        ("shot/beauty.#.exr", "shot/beauty.42.exr"),
        ("shot/beauty.######.exr", "shot/beauty.000042.exr"),
        ("shot/beauty.%04d.exr", "shot/beauty.0042.exr"),
        ("beauty.%d.exr", "beauty.42.exr"),
        ("{frame}.png", "42.png"),
        ("{frame:05}.png", "00042.png"),
        ("{frame:05d}.png", "00042.png"),
        ("{name}.png", "cam#1/%04d.v2.png"),
        ("{frame}/{name}_##.png", "42/cam#1/%04d.v2_42.png"),
        ("shot/beauty.@@@@.exr", "shot/beauty.0042.exr"),
        ("shot/beauty.$F4.exr", "shot/beauty.0042.exr"),
        ("shot/beauty.$F.exr", "shot/beauty.42.exr"),
        ("shot/beauty.<F4>.exr", "shot/beauty.0042.exr"),
        ("<F>_<F6>.exr", "42_000042.exr"),
        ("me@home/$FINAL/$4/x_##.png", "me@home/$FINAL/$4/x_42.png"),
        ("100%/50%%/x.png", "100%/50%%/x.png"),
    ],
)
def test_patterns(pattern: str, path: str) -> None:
    assert path_of(pattern, 42, "cam#1/%04d.v2.jpg") == Path(path)


def test_more_digits_than_the_pattern_has_and_negative_ones() -> None:
    assert path_of("a.###.exr", 12345, "x") == Path("a.12345.exr")
    assert path_of("a.####.exr", -5, "x") == Path("a.-005.exr")


@pytest.mark.parametrize(
    "pattern",
    [
        *("{nmae}.png", "{}.png", "{name:04}.png", "{frames}.png", "a.%x.png", "a.%4d.png"),
        *("{frame:4d}.png", "{a b}.png", "a.$FF.png", "a.<f4>.png", "a.<UDIM>.png"),
    ],
)
def test_fields_that_are_not_known(pattern: str) -> None:
    refuses(r"is not known, expected \{name\}, \{frame\}, ####, @@@@, %04d, ", output_paths, pattern, [(1, "a")])


def test_what_is_no_field() -> None:
    assert path_of("{8f-2c}/100%/50%.png", 1, "a") == Path("{8f-2c}/100%/50%.png")


def test_every_frame_has_a_file_of_its_own() -> None:
    assert output_paths("one.png", [(1, "a.jpg")]) == [Path("one.png")]
    assert output_paths("o/{name}.png", [(1, "a.jpg"), (2, "s/b.jpg")]) == [Path("o/a.png"), Path("o/s/b.png")]
    assert output_paths("o/##.png", [(1, "a.jpg"), (2, "a.png")]) == [Path("o/01.png"), Path("o/02.png")]
    refuses(r"would be the file of both a\.jpg and a\.png", output_paths, "o/{name}.png", [(1, "a.jpg"), (2, "a.png")])
    with pytest.raises(InputError, match="names a single file for 2 frames, expected"):
        output_paths("one.png", [(1, "a"), (2, "b")])


@pytest.mark.parametrize("name", ["../a.jpg", "a/../../b.jpg", "/etc/a.jpg"])
def test_names_stay_in_the_folder(name: str) -> None:
    refuses("leads out of the output folder", output_paths, "out/{name}.png", [(1, name)])
    assert output_paths("out/####.png", [(1, name)]) == [Path("out/0001.png")]


def test_a_name_that_is_none() -> None:
    refuses("is empty", output_paths, "out/{name}.png", [(1, "")])


@pytest.mark.parametrize(
    ("pattern", "numbers"),
    [
        ("a.####.ply", [1, 2, 10000]),
        ("a.%04d.ply", [1, 2, 10000]),
        ("a.<F4>.ply", [1, 2, 10000]),
        ("a.{frame}.ply", [7, 10000]),
        ("a.#.ply", [7, 10000]),
        ("b.##.ply", [-1]),
        ("f_##/m_##.ply", [3]),
        ("[x]*_{frame:02}.ply", [5]),
        ("c.####.ply", []),
    ],
)
def test_files_by_their_numbers(pattern: str, numbers: list[int], tmp_path: Path) -> None:
    files = ["a.0001.ply", "a.0002.ply", "a.10000.ply", "a.7.ply", "a.00003.ply", "a.x.ply", "b.-1.ply", "[x]*_05.ply"]
    for name in [*files, "x_05.ply", "f_03/m_03.ply", "f_04/m_03.ply"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = numbered_files(f"{tmp_path}/{pattern}")
    assert list(found) == numbers
    assert all(path == path_of(f"{tmp_path}/{pattern}", number, "") for number, path in found.items())


def test_which_names_have_a_number() -> None:
    assert all(map(has_number, ("a.####.ply", "f_##/a.ply", "a_%d.ply", "a.@@.ply", "a.$F.ply", "a{frame}.ply")))
    assert not any(map(has_number, ("a.ply", "a_{name}.ply", "a@b.ply", "50%.ply")))
