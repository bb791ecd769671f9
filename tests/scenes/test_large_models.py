# SPDX-License-Identifier: Apache-2.0
"""COLMAP models and transforms.json of any size: blocks of every size give the same arrays and errors, and what is not
needed is not read."""

from __future__ import annotations

import json
import os
import random
import struct
from pathlib import Path

import calls
import numpy as np
import pytest
from calls import refuses

from clsplat.errors import InputError
from clsplat.files import documents
from clsplat.files.documents import parse_json, parsed_bytes
from clsplat.scenes.dataset import DataSet
from clsplat.scenes.readers import colmap, colmap_files
from clsplat.scenes.readers.colmap import Tracks, read_images, read_model, read_tracks
from clsplat.scenes.readers.colmap_files import _number_of_words
from clsplat.scenes.readers.transforms import MAX_TRANSFORMS_BYTES, read_transforms
from clsplat.scenes.readers.transforms import read_images as read_frames

LENGTHS = (0, 1, 3, 0, 2, 40, 1, 0, 5, 0)
"""Observations of each point: none, few, and more than a small block holds."""
IDS = (3, 70_000, 11, 12)
"""Ids of the images, not in order. Tracks also name image 5, which the model lacks."""
HEAD, ITEM = 51, 8
"""Bytes of the fixed part of a point in points3D.bin, and of an observation in its track."""


def write_model(folder: Path, kind: str) -> Path:
    """Write a model of four images and len(LENGTHS) points, as binary files or as text."""
    folder.mkdir()
    rng = np.random.default_rng(4)
    points = [(*rng.normal(size=3), *rng.integers(0, 256, 3), rng.random()) for _ in LENGTHS]
    tracks = [[(int(rng.choice([*IDS, 5])), place) for place in range(length)] for length in LENGTHS]
    seen = rng.random((7, 2))
    if kind == "txt":
        (folder / "cameras.txt").write_text("1 PINHOLE 8 6 5 5 4 3\n")
        line = " ".join(f"{x!r} {y!r} -1" for x, y in seen.tolist())
        images = [f"{key} 1 0 0 0 {index} 0 0 1 {index}.png\n{line}\n" for index, key in enumerate(IDS)]
        (folder / "images.txt").write_text("# a comment\n" + "".join(images))
        numbers = [
            " ".join(map(repr, map(float, point[:3]))) + " " + " ".join(map(str, point[3:6])) for point in points
        ]
        ends = [" ".join(f"{a} {b}" for a, b in track) for track in tracks]
        lines = [f"{i} {text} {points[i][6]} {ends[i]}" for i, text in enumerate(numbers)]
        (folder / "points3D.txt").write_text(
            "# Number of points: 10\n" + "\n".join([*lines[:4], "", *lines[4:]]) + "\n"
        )
        return folder
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 5, 5, 4, 3))
    observations = b"".join(struct.pack("<2dq", x, y, -1) for x, y in seen)
    images = [
        struct.pack("<I7dI", key, 1, 0, 0, 0, index, 0, 0, 1) + f"{index}.png\0".encode() + struct.pack("<Q", 7)
        for index, key in enumerate(IDS)
    ]
    (folder / "images.bin").write_bytes(struct.pack("<Q", 4) + observations.join([*images, b""]))
    records = [
        struct.pack("<Q3d3BdQ", index, *point, len(track)) + b"".join(struct.pack("<2I", *one) for one in track)
        for index, (point, track) in enumerate(zip(points, tracks, strict=True))
    ]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(LENGTHS)) + b"".join(records))
    return folder


def set_blocks(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr(colmap_files, "RECORD_BLOCK_BYTES", size)
    monkeypatch.setattr(colmap_files, "TEXT_BLOCK_BYTES", size)
    monkeypatch.setattr(colmap, "OBSERVATION_ROWS", size)
    monkeypatch.setattr(colmap, "COLOUR_ROWS", size)


def same(read: tuple[DataSet, Tracks], other: tuple[DataSet, Tracks]) -> None:
    (data, tracks), (other_data, other_tracks) = read, other
    np.testing.assert_array_equal(data.points, other_data.points)
    np.testing.assert_array_equal(data.colors, other_data.colors)
    assert [(image.name, image.lens) for image in data.images] == [(i.name, i.lens) for i in other_data.images]
    np.testing.assert_array_equal(tracks.points, other_tracks.points)
    np.testing.assert_array_equal(tracks.errors, other_tracks.errors)
    assert rows(tracks.by_image) == rows(other_tracks.by_image)


def rows(by_image: dict[str, np.ndarray]) -> dict[str, list[int]]:
    return {name: found.tolist() for name, found in sorted(by_image.items())}


def test_binary_and_text_are_the_same_and_tracks_those_that_were_written(tmp_path: Path) -> None:
    folders = [write_model(tmp_path / kind, kind) for kind in ("bin", "txt")]
    read = [(read_model(folder), read_tracks(folder)) for folder in folders]
    same(*read)
    data, tracks = read[0]
    assert len(data.points) == len(LENGTHS)
    raw = (tmp_path / "txt" / "points3D.txt").read_text().splitlines()
    lines = [line.split() for line in raw if line and line[0] != "#"]
    for index, name in enumerate(f"{number}.png" for number in range(4)):
        wanted = [place for place, line in enumerate(lines) if str(IDS[index]) in line[8::2]]
        assert tracks.by_image.get(name, np.empty(0)).tolist() == wanted
    some = ["2.png", "0.png", "sub/none.png"]
    assert rows(tracks.shown_in(some)) == {name: rows(tracks.by_image)[name] for name in ("0.png", "2.png")}


SEAMS = (
    1,
    HEAD - 1,
    HEAD,
    HEAD + 1,
    HEAD + ITEM,
    2 * HEAD + ITEM - 1,
    2 * HEAD + ITEM,
    2 * HEAD + ITEM + 1,
    300,
    1 << 20,
)


@pytest.mark.parametrize("size", SEAMS)
@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_blocks_of_any_size_read_the_same(
    kind: str, size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_model(tmp_path / kind, kind)
    whole = read_model(folder), read_tracks(folder)
    set_blocks(monkeypatch, size)
    same((read_model(folder), read_tracks(folder)), whole)


@pytest.mark.parametrize("change", ["\r\n", "\r", "utf-16", "\ufeff", "no end"])
@pytest.mark.parametrize("size", [1, 2, 3, 64])
def test_text_of_any_line_ends_and_encoding_in_blocks(
    change: str, size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_model(tmp_path / "txt", "txt")
    whole = read_model(folder), read_tracks(folder)
    for path in folder.iterdir():
        text = path.read_text()
        if change in ("\r\n", "\r"):
            path.write_bytes(text.replace("\n", change).encode())
        elif change == "no end":
            path.write_text(text.rstrip("\n"))
        else:
            path.write_text(
                ("\ufeff" if change == "\ufeff" else "") + text, "utf-16" if change == "utf-16" else "utf-8"
            )
    set_blocks(monkeypatch, size)
    same((read_model(folder), read_tracks(folder)), whole)


@pytest.mark.parametrize("size", [1, 100])
def test_points_cut_at_each_byte_name_the_point(size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_model(tmp_path / "bin", "bin") / "points3D.bin"
    data = path.read_bytes()
    begins = np.cumsum([8, *(HEAD + ITEM * length for length in LENGTHS)])
    set_blocks(monkeypatch, size)
    for kept in range(len(data)):
        path.write_bytes(data[:kept])
        place = f"point {int(np.searchsorted(begins, kept, side='right'))} of 10"
        if kept < 8:
            place = "its header"
        elif kept < 10 * HEAD:
            place = "the 10 points that its header announces"
        for read in (read_model, read_tracks):
            refuses(rf"points3D\.bin: truncated or corrupt: its {kept} bytes end inside {place};", read, path.parent)
    path.write_bytes(data + b"ab")
    for read in (read_model, read_tracks):
        refuses("2 bytes follow the last of its 10 points", read, path.parent)


@pytest.mark.parametrize("size", [1, 64, 1 << 20])
def test_a_damaged_line_is_named_in_any_block(size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_model(tmp_path / "txt", "txt") / "points3D.txt"
    lines = path.read_text().splitlines()
    set_blocks(monkeypatch, size)
    for number in (2, 7, len(lines)):  # the first point, one after the empty line, the last
        words = lines[number - 1].split()
        for damaged in (words[:6], [*words[:2], "x", *words[3:]], [*words, "7"]):
            path.write_text("\n".join([*lines[: number - 1], " ".join(damaged), *lines[number:]]))
            refuses(rf"points3D\.txt: line {number} does not read as POINT3D_ID", read_model, path.parent)


def test_ids_of_any_length_in_tracks(tmp_path: Path) -> None:
    """An image whose id is too large for an array is observed by nothing. Such an id in a track is damage."""
    folder = write_model(tmp_path / "txt", "txt")
    images, points = folder / "images.txt", folder / "points3D.txt"
    images.write_text(images.read_text().replace("70000 1 0", f"{10**30} 1 0"))
    assert sorted(read_tracks(folder).by_image) == ["0.png", "2.png", "3.png"]
    lines = points.read_text().splitlines()
    points.write_text("\n".join([*lines[:2], f"{lines[2]} {10**30} 0", *lines[3:]]))
    refuses(r"points3D\.txt: line 3 does not read as POINT3D_ID", read_tracks, folder)


def test_a_line_without_an_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_model(tmp_path / "txt", "txt")
    longest = max(len(line) for path in folder.iterdir() for line in path.read_text().splitlines())
    set_blocks(monkeypatch, 16)
    for most, good in ((longest + 1, False), (longest + 2, True)):  # a line with its end must be shorter than the limit
        monkeypatch.setattr(colmap_files, "MAX_LINE_CHARACTERS", most)
        if good:
            read_model(folder)
        else:
            refuses(rf"\.txt: truncated or corrupt: line \d+ has over {most:,} characters", read_model, folder)


def test_observations_that_are_not_needed_are_skipped(tmp_path: Path) -> None:
    """Of 48 GB of observations and 8 GB of tracks, which are holes of the files, nothing is read."""
    folder = write_model(tmp_path / "bin", "bin")
    many = 1 << 30
    image = (
        struct.pack("<Q", 1)
        + struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1)
        + b"a.png\0"
        + struct.pack("<Q", 2 * many)
    )
    point = struct.pack("<Q", 1) + struct.pack("<Q3d3BdQ", 1, 1, 2, 3, 4, 5, 6, 0, many)
    for name, head, size in (("images.bin", image, 2 * many * 24), ("points3D.bin", point, many * ITEM)):
        (folder / name).write_bytes(head)
        os.truncate(folder / name, len(head) + size)
    assert calls.peak_of(lambda: read_model(folder)) < 4 * colmap_files.RECORD_BLOCK_BYTES
    assert read_model(folder).points.tolist() == [[1, 2, 3]]
    assert [image.name for image in read_images(folder)] == ["a.png"]


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_memory_of_points_is_that_of_their_arrays(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, count, block = write_model(tmp_path / kind, kind), 50_000, 1 << 16
    set_blocks(monkeypatch, block)
    record = struct.pack("<Q3d3BdQ", 1, 0.125, 2, 3, 4, 5, 6, 0.5, 4) + struct.pack("<8I", *range(8))
    if kind == "bin":
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", count) + count * record)
    else:
        (folder / "points3D.txt").write_text(count * "1 0.125 2 3 4 5 6 0.5 0 1 2 3 4 5 6 7\n")
    # positions (24 bytes, a sixteenth more while they grow), levels twice (3), colours (12), masks (10), and blocks:
    # the file's bytes, lines and their words
    assert calls.peak_of(lambda: read_model(folder)) < 60 * count + 12 * block


def test_words_are_counted_without_splitting() -> None:
    chance = random.Random(3)
    blanks = (" ", " ", " ", "  ", "\t", "\u00a0", "\x1c", "\x0b", "\u2003")
    for case in range(400):
        some = blanks[:3] if case % 2 else blanks
        line = "".join(
            f"{chance.choice(('1.5', '-1', 'x', 'ö', chr(0)))}{chance.choice(some)}" for _ in range(20)
        ).strip()
        assert _number_of_words(line) == len(line.split())
    assert _number_of_words("1") == 1


# transforms.json


def write_frames(folder: Path, frames: int, padding: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    matrix = np.eye(4).tolist()
    listed = [{"file_path": f"{index}.png", "transform_matrix": matrix} for index in range(frames)]
    text = json.dumps({"w": 8, "h": 6, "fl_x": 9.0, "frames": listed})
    (folder / "transforms.json").write_text(text + " " * padding)
    return folder / "transforms.json"


def test_a_transforms_json_beyond_32_mib_is_read(tmp_path: Path) -> None:
    path = write_frames(tmp_path, 3, 33 << 20)
    assert [image.name for image in read_frames(path)] == ["0.png", "1.png", "2.png"]
    os.truncate(path, MAX_TRANSFORMS_BYTES + 1)
    refuses(r"transforms\.json: has more than 512 MiB, expected a transforms\.json", read_transforms, path)


def test_a_large_file_that_would_take_much_memory_is_not_parsed(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_bytes(b'{"frames":[' + b"[]," * (12 << 20) + b"[]]}")
    told = r"transforms\.json: its 36 MiB may take 1,[0-9]{3} MiB of memory, expected a transforms\.json that takes"
    assert calls.peak_of(lambda: refuses(told, read_transforms, path)) < 90 << 20  # the file, and what it grows by


@pytest.mark.parametrize(
    "part",
    ["[]", "{}", "[0]", '{"":0}', "[[[[]]]]", "1.5", '"ab"', "12345678901234567890", '{"":{}}', '"\u0101"',
     '"\U0001f600"', "[0,0,0]", '{"a":0,"b":0,"c":0,"d":0,"e":0,"f":0}', "300"],
)  # fmt: skip
def test_the_estimate_of_memory_is_never_too_low(part: str) -> None:
    text = f"[{','.join([part] * 20_000)}]"
    data = text.encode()
    assert calls.peak_of(lambda: parse_json(data.decode(), once=True)) < parsed_bytes(data)


def test_the_estimate_allows_what_surveys_need(tmp_path: Path) -> None:
    data = write_frames(tmp_path, 1000).read_bytes()
    assert parsed_bytes(data) * 250 < documents.MAX_PARSED_BYTES  # 250,000 frames
    with pytest.raises(InputError):
        read_transforms(tmp_path / "transforms.json", missing="error")
