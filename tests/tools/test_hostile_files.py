# SPDX-License-Identifier: Apache-2.0
"""Files that were made to do harm: one line that names the file, in bounded memory and time. A sample of what
`tools/stress/run files` does at length, and each defect that it found, by name."""

from __future__ import annotations

import io
import json
import os
import random
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import calls
import numpy as np
import pytest
import stress_files
from calls import refusal
from hostile import (
    READERS,
    Reader,
    make_colmap_binary,
    make_colmap_text,
    make_photos,
    make_ply,
    make_run,
    make_transforms,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from quick import quick
from spoilers import SPOILERS
from stress_files import stress, verdict
from systems import links, posix

from clsplat.errors import InputError, plain
from clsplat.models.codec import ply_file
from clsplat.models.formats import ply
from clsplat.scenes import point_files
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers import colmap, transforms

# The sample


@pytest.mark.slow
def test_a_sample_of_every_reader() -> None:
    tallies = stress(list(READERS), 500, seed=7, jobs=2)
    assert {name: tally.failures for name, tally in tallies.items() if tally.failures} == {}
    assert sum(tally.cases for tally in tallies.values()) > 500 - len(READERS)  # each has as many
    refused = {name for name, tally in tallies.items() if tally.refused}
    assert refused >= {"ply", "colmap-bin", "colmap-txt", "transforms", "config"}, "nothing was spoilt"


def broken(**changes: Any) -> Reader:
    """A reader with these changes."""
    return Reader(**{"name": "x", "make": lambda _: None, "files": (), "kinds": (), **changes})


@pytest.mark.parametrize(
    ("error", "found"),
    [
        (ValueError("x"), "ValueError"),
        (MemoryError(), "MemoryError"),
        (InputError("no name"), "names no file"),
        (RecursionError("x"), "RecursionError"),
        (SystemExit(1), "SystemExit"),
    ],
)
def test_a_verdict_can_be_bad(error: BaseException, found: str, tmp_path: Path) -> None:
    def read(_: Path) -> None:
        raise error

    assert found in verdict(broken(read=read), tmp_path)[1]


def test_a_verdict_can_be_good(tmp_path: Path) -> None:
    def read(folder: Path) -> None:
        raise InputError(f"{folder / 'a.ply'}: is none")

    assert verdict(broken(read=read), tmp_path) == (True, "")
    assert verdict(broken(read=lambda _: None), tmp_path) == (False, "")


@pytest.mark.slow
def test_a_crash_and_a_loop_are_failures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = tmp_path / "hostile_fakes.py"
    module.write_text(
        "import os, time\n"
        "def make(folder): (folder / 'a').write_bytes(b'12')\n"
        "def read(folder):\n"
        "    data = (folder / 'a').read_bytes()\n"
        "    if data == b'12': return\n"
        "    if len(data) % 2: os.abort()\n"
        "    time.sleep(60)\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    # in the children `hostile` gets a reader of ours: they import it anew
    (tmp_path / "sitecustomize.py").write_text(
        f"import sys\nsys.path[:0] = {[str(Path(each.__file__).parent) for each in (stress_files, calls)]!r}\n"
        "import hostile, hostile_fakes\n"
        "kinds = ('truncate', 'append')\n"
        "fake = hostile.Reader('fake', hostile_fakes.make, hostile_fakes.read, ('a',), kinds)\n"
        "hostile.READERS['fake'] = fake\n"
    )
    monkeypatch.setitem(READERS, "fake", broken(name="fake", read=lambda _: None))
    monkeypatch.setattr(stress_files, "SPOILING", 0)
    tally = stress(["fake"], 4, seed=1, seconds=3)["fake"]  # a child that begins beside others is not late
    assert tally.cases == 4
    troubles = " ".join(trouble for _, trouble in tally.failures)
    assert "the process ended, status -6" in troubles
    assert "not done after 3 s" in troubles


def test_a_bomb_is_not_repeated_two_hundred_times() -> None:
    """It was: 12 GB, made by the tool itself."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", bytes(60_000_000))
    for seed in (11, 86):
        assert len(SPOILERS["archive"](buffer.getvalue(), random.Random(seed))) < 1 << 28


def test_a_case_can_be_repeated(tmp_path: Path) -> None:
    def files(folder: Path) -> dict[str, bytes]:
        kept = stress_files.keep(folder, "colmap-txt", 12, 3)
        return {str(path.relative_to(kept)): path.read_bytes() for path in kept.rglob("*") if path.is_file()}

    assert files(tmp_path / "a") == files(tmp_path / "b")


# Whatever is read


def test_messages_are_one_plain_line() -> None:
    assert str(InputError("a\nb\x1b[31m\u202e\udcff\0")) == r"a\nb\x1b[31m\u202e\udcff\x00"
    assert plain("Kölner Dom \U0001f4a9.png") == "Kölner Dom \U0001f4a9.png"


PLACES: dict[str, Callable[[Path], object]] = {
    "pipe": getattr(os, "mkfifo", Path.touch),
    "loop": lambda path: path.symlink_to(path.name),
    "folder": Path.mkdir,
    "zeros": lambda path: path.symlink_to("/dev/zero"),
    "huge": lambda path: (path.touch(), os.truncate(path, 1 << 33)),  # takes no room on the disk
}
NEEDED = {"pipe": posix, "loop": links, "zeros": posix}


@pytest.mark.parametrize("place", [pytest.param(place, marks=NEEDED.get(place, ())) for place in PLACES])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (make_ply, "model.ply"),
        (make_colmap_binary, "sparse/0/images.bin"),
        (make_colmap_text, "sparse/0/points3D.txt"),
        (make_transforms, "transforms.json"),
        (make_transforms, "cloud.ply"),
        (make_run, "run/config.toml"),
        (make_photos, "photos/a.png"),
    ],
    ids=["ply", "colmap", "colmap text", "transforms", "cloud", "config", "photo"],
)
def test_what_is_no_plain_file(make: Callable[[Path], None], name: str, place: str, tmp_path: Path) -> None:
    make(tmp_path)
    (tmp_path / name).unlink()
    PLACES[place](tmp_path / name)
    reader = {"model.ply": "ply", "run/config.toml": "config", "photos/a.png": "photos"}.get(name, "transforms")
    refused, trouble = verdict(READERS[reader], tmp_path)
    assert trouble == ""
    # points may be missing, which is a warning or nothing; a folder and a link that leads nowhere are no photos
    assert refused or name in ("cloud.ply", "sparse/0/points3D.txt") or place in ("folder", "loop")


# PLY


def model(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "model.ply"
    path.write_bytes(content)
    return path


def ascii_model(rows: list[str], count: int | None = None) -> bytes:
    names = [*ply.REQUIRED_PLY_PROPERTIES]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows) if count is None else count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", *rows, ""]).encode()


def test_names_in_a_ply_header_are_made_plain(tmp_path: Path) -> None:
    path = model(tmp_path, b"ply\nformat ascii 1.0\nelement ver\0\x1btex 3\nend_header\n")
    assert r"ver\x00\x1btex" in refusal(lambda: ply.read(path))


def test_one_long_word_is_no_table_of_long_words(tmp_path: Path) -> None:
    row = " ".join(["0.5"] * len(ply.REQUIRED_PLY_PROPERTIES))
    path = model(tmp_path, ascii_model([row] * 200 + [row[:-3] + "0." + "5" * 500_000]))
    assert calls.peak_of(lambda: refusal(lambda: ply.read(path))) < 20e6
    path = model(tmp_path, ascii_model([row, row + "9" * 2_000_000]))
    assert "line of more than" in refusal(lambda: ply.read(path))


def test_text_cannot_claim_more_rows_than_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply_file, "IO_BLOCK_ROWS", 4)
    row = " ".join(["0.5"] * len(ply.REQUIRED_PLY_PROPERTIES))
    path = model(tmp_path, ascii_model([row] * 9, 10**8))
    assert calls.peak_of(lambda: refusal(lambda: ply.read(path))) < 1e6


def test_wide_rows_are_read_a_few_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_ply(tmp_path)
    whole = ply.read(tmp_path / "model.ply")
    monkeypatch.setattr(ply_file, "MAX_BLOCK_BYTES", 200)
    np.testing.assert_array_equal(ply.read(tmp_path / "model.ply").sh, whole.sh)
    make_ply(tmp_path, "ascii")
    monkeypatch.setattr(ply_file, "MAX_BLOCK_WORDS", 70)
    np.testing.assert_array_equal(ply.read(tmp_path / "model.ply").sh, whole.sh)


@pytest.mark.parametrize(
    ("names", "count", "said"), [("xyzx", 1, "property x twice"), ("xyz", 10**15, "")], ids=["twice", "claim"]
)
def test_a_cloud_has_each_property_once_and_claims_at_most_what_it_has(
    names: str, count: int, said: str, tmp_path: Path
) -> None:
    properties = "".join(f"property float {name}\n" for name in names)
    for form in ("binary_little_endian", "ascii"):
        head = f"ply\nformat {form} 1.0\nelement vertex {count}\n{properties}end_header\n"
        path = model(tmp_path, f"{head}1 2 3 4 5 6 7 8\n".encode())
        assert said in refusal(lambda path=path: point_files.read_point_cloud(path))
        assert calls.peak_of(lambda path=path: refusal(lambda: point_files.read_point_cloud(path))) < 2e6


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text(max_size=12), max_size=8), st.integers(-(10**30), 10**30), st.binary(max_size=64))
def test_any_ply_header(tmp_path_factory: pytest.TempPathFactory, words: list[str], count: int, body: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.ply"
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {word}" for word in (*ply.REQUIRED_PLY_PROPERTIES, *words)]
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode("utf-8", "surrogatepass") + body)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert path.name in refusal(lambda: ply.read(path))


# COLMAP


def test_numbers_of_any_length_in_a_models_text(tmp_path: Path) -> None:
    make_colmap_text(tmp_path)
    path = tmp_path / "sparse/0/points3D.txt"
    for word in ("9" * 400, "9" * 5000, "1e999", "1e300", "nan"):
        path.write_text(f"1 {word if '9' not in word[1:] else 0} 0 0 {word if '9' in word[1:] else 0} 0 0 0\n")
        assert str(path) in refusal(lambda: colmap.read_model(path.parent))


def test_far_cameras_are_refused(tmp_path: Path) -> None:
    make_colmap_text(tmp_path)
    path = tmp_path / "sparse/0/images.txt"
    path.write_text("1 1 0 0 0 1e200 0 0 1 a.png\n\n")
    assert "has the pose" in refusal(lambda: colmap.read_model(path.parent))


LEAVING = ("..\\..\\x.png", "C:\\x.png", "C:x.png", "\\\\host\\x.png", "/x.png", "a/../../x.png", "a\nb", "")


@pytest.mark.parametrize("name", [*LEAVING, "a.png", "sub/a.png", "..a.png", "a..b/c.png", "Kölner Dom.jpg"])
def test_names_that_leave_the_images_folder(name: str) -> None:
    assert colmap.safe_name(name) == (name not in LEAVING)


# transforms.json


def change(tmp_path: Path, **values: object) -> Path:
    make_transforms(tmp_path)
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    for key, value in values.items():
        target = document if key in document else document["frames"][1]
        target[key] = value
    path.write_text(json.dumps(document))
    return path


OUTSIDE = (
    *("../../etc/passwd", "/etc/passwd", "../images/a.png", "images/../../x.png"),
    *("..\\x.png", "images\\..\\..\\x.png", ".."),
)


@pytest.mark.parametrize("listed", OUTSIDE)
@pytest.mark.parametrize("key", ["file_path", "ply_file_path"])
def test_no_file_outside_the_scenes_folder(key: str, listed: str, tmp_path: Path) -> None:
    path = change(tmp_path / "scene", **{key: listed})
    assert "inside the scene's folder" in refusal(lambda: load_scene(path.parent))


def test_a_scene_is_not_left_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = change(tmp_path / "scene", file_path="../x.png")
    monkeypatch.chdir(path.parent)
    assert "inside the scene's folder" in refusal(lambda: load_scene(Path(path.name)))


@links
def test_files_inside_by_their_absolute_name_or_by_a_link(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    assert len(load_scene(change(folder, file_path=str(folder / "images/b.png")).parent).views) == 3
    (folder / "images").rename(tmp_path / "pictures")
    (folder / "images").symlink_to(tmp_path / "pictures")
    assert len(load_scene(folder).views) == 3


@pytest.mark.parametrize("value", [10**400, [[10**400] * 4] * 4, [[1e200, 0, 0, 0]] * 4, [[None] * 4] * 4, "x", {}])
def test_poses_that_are_none(value: object, tmp_path: Path) -> None:
    path = change(tmp_path, transform_matrix=value)
    assert "frame 1" in refusal(lambda: transforms.read_transforms(path))


@pytest.mark.parametrize("key", ["fl_x", "w", "k1", "cx", "aabb_scale", "scale", "offset"])
def test_numbers_that_are_none(key: str, tmp_path: Path) -> None:
    for value in (10**400, 1e200, [10**400] * 3, "x", [[]]):
        path = change(tmp_path / "scene", **{key: value})
        assert path.name in refusal(lambda path=path: transforms.read_transforms(path))


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"a":' * 100_000, "9" * 5000, '{"frames": [' + "9" * 5000 + "]}", "\ufeff{}"]
)
def test_documents_that_are_none(text: str, tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(text, "utf-8")
    assert str(path) in refusal(lambda: transforms.read_transforms(path))


NAMES_OF_NO_FILE = {
    "long": "x" * 300,
    "path": ("y" * 200 + "/") * 25,
    "folders": "y/" * 2048,  # 4096 characters: a path of Linux may have 4095
    "ending": "images/" + "z" * 255,
}
"""Too long as a whole, as a path of possible folders, and with an ending."""


@pytest.mark.parametrize("name", quick(NAMES_OF_NO_FILE, "long", "path", "ending"))  # folders: many seconds
def test_names_that_no_file_can_have(tmp_path: Path, name: str) -> None:
    path = change(tmp_path, file_path=NAMES_OF_NO_FILE[name])
    assert "are missing" in refusal(lambda: transforms.read_transforms(path))


def test_only_the_listed_folders_are_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = change(tmp_path)
    walked: list[str] = []
    real = os.walk
    monkeypatch.setattr(os, "walk", lambda top, **kw: (walked.append(w[0]) or w for w in real(top, **kw)))
    (tmp_path / "images" / "deep" / "deeper").mkdir(parents=True)
    load_scene(path)
    assert not any("deep" in each for each in walked)


@settings(max_examples=60, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(),
        lambda each: (
            st.lists(each)
            | st.dictionaries(st.sampled_from(["frames", "file_path", "transform_matrix", "fl_x", "w", "h"]), each)
        ),
    )
)
def test_any_document(tmp_path_factory: pytest.TempPathFactory, document: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "transforms.json"
    path.write_text(json.dumps(document))
    assert str(path) in refusal(lambda: transforms.read_transforms(path))


def test_spoiling_is_a_matter_of_the_seed_alone() -> None:
    assert stress_files.numbered(0, "ply", 1).random() == random.Random("0 ply 1").random()
