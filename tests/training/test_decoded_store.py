# SPDX-License-Identifier: Apache-2.0
"""The cache of decoded photographs: the same pixels or none, whatever happens to its files."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.files import mounts
from clsplat.training.supervision import decoded_store
from clsplat.training.supervision.decoded_store import SUFFIX, DecodedStore, key_of, remove_decoded

KEY, OTHER = key_of(["a"]), key_of(["b"])
PIXELS = np.random.default_rng(1).integers(0, 256, (6, 5, 4), np.uint8)


@pytest.fixture
def store(tmp_path: Path) -> DecodedStore:
    return DecodedStore(tmp_path / "cache")


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_pixels_come_back(store: DecodedStore, dtype: type) -> None:
    pixels = PIXELS.astype(dtype) * dtype(3)
    assert store.read(KEY) is None
    store.write(KEY, pixels)
    found = DecodedStore(store.folder).read(KEY)
    assert found is not None
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, pixels)
    assert store.read(OTHER) is None
    assert store.notes() == []


def test_keys_depend_on_every_part() -> None:
    assert len({key_of(parts) for parts in ([1], [1.0], ["1"], [[1]], [1, 1], [(0.1, True)], [(0.1, False)])}) == 7


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "short": lambda data: data[:-1],
    "cut in the header": lambda data: data[:20],
    "long": lambda data: data + b"\0",
    "a changed pixel": lambda data: data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
    "another shape": lambda data: data[:16] + data[20:24] + data[16:20] + data[24:],
    "another version": lambda data: data[:8] + b"\x63" + data[9:],
    "another key": lambda data: data.replace(KEY, OTHER),
    "another program's": lambda data: b"\x89PNG" + data[4:],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_none_and_is_told_once(store: DecodedStore, name: str) -> None:
    store.write(KEY, PIXELS)
    whole = store.path(KEY).read_bytes()
    store.path(KEY).write_bytes(DAMAGE[name](whole))
    assert store.read(KEY) is None
    assert store.read(KEY) is None
    (note,) = store.notes()
    assert "the photograph is decoded again" in note
    assert store.notes() == []
    store.write(KEY, PIXELS)
    assert store.path(KEY).read_bytes() == whole


def test_a_folder_in_place_of_a_file(store: DecodedStore) -> None:
    store.path(KEY).mkdir()
    assert store.read(KEY) is None
    store.write(KEY, PIXELS)
    assert not store.writable
    assert len(store.notes()) == 2


@pytest.mark.parametrize(
    ("number", "said"), [(errno.ENOSPC, "the disk is full"), (errno.EROFS, "the disk is read-only")]
)
def test_a_full_or_read_only_folder_is_told_once(
    store: DecodedStore, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    store.write(OTHER, PIXELS)

    def refuse(*_: object, **__: object) -> Any:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(decoded_store, "open", refuse, raising=False)
    for _ in range(3):
        store.write(KEY, PIXELS)
    monkeypatch.undo()
    (note,) = store.notes()
    assert said in note
    assert "decoded each time" in note
    assert not store.writable
    assert store.read(OTHER) is not None
    assert [path.name for path in store.folder.iterdir()] == [store.path(OTHER).name], "no temporary files are left"


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    store = DecodedStore(tmp_path / "file" / "cache")
    store.write(KEY, PIXELS)
    assert store.read(KEY) is None
    (note, *_) = store.notes()
    assert "no decoded photographs can be written there" in note


def test_several_writers_and_readers(store: DecodedStore) -> None:
    other = DecodedStore(store.folder)

    def work(index: int) -> bool:
        each = (store, other)[index % 2]
        if index % 3 == 0:
            each.write(KEY, PIXELS)
        found = each.read(KEY)
        return found is None or np.array_equal(found, PIXELS)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(60)))
    assert store.notes() == other.notes() == []


def test_what_a_killed_process_left_is_removed(store: DecodedStore) -> None:
    mark = decoded_store.TEMPORARY_NAME
    with ThreadPoolExecutor(1) as pool:
        pool.submit(store.write, KEY, PIXELS).result()
    from clsplat.files.atomic import machine_mark

    gone = store.folder / f".{store.path(OTHER).name}.{machine_mark()}{2**31 - 2:08x}{'0' * 8}.clsplat-tmp"
    assert mark.fullmatch(gone.name)
    gone.write_bytes(b"half")
    DecodedStore(store.folder)
    assert os.name != "posix" or not gone.exists()
    assert store.path(KEY).exists()


def test_only_its_own_files_are_removed(store: DecodedStore) -> None:
    store.write(KEY, PIXELS)
    (store.folder / "mine.txt").write_text("")
    remove_decoded(store.folder)
    assert [path.name for path in store.folder.iterdir()] == ["mine.txt"]
    (store.folder / "mine.txt").unlink()
    (store.folder / f"x{SUFFIX}").write_bytes(b"")
    remove_decoded(store.folder)
    assert not store.folder.exists()
    remove_decoded(store.folder)


def test_a_network_disk_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "mounts"
    here = str(tmp_path).replace(" ", "\\040")
    table.write_text(
        f"disk / ext4 rw 0 0\nserver:/a {here}/far\\040away nfs4 rw 0 0\nx {here}/far\\040away/near tmpfs rw 0 0\n"
    )
    monkeypatch.setattr(mounts, "MOUNTS", table)
    monkeypatch.setattr(decoded_store, "NETWORK_SAMPLE_BYTES", 2 * PIXELS.nbytes)
    assert mounts.network_type(tmp_path) == ""
    assert mounts.network_type(tmp_path / "far away") == "nfs4"
    assert mounts.network_type(tmp_path / "far away" / "near") == ""
    assert mounts.network_type(tmp_path / "far") == ""
    store = DecodedStore(tmp_path / "far away" / "cache")
    store.write(KEY, PIXELS)
    assert store.notes() == []
    for _ in range(4):
        store.read(KEY)
    (note,) = store.notes()
    assert "is on a network disk (nfs4), which moves " in note
    assert " a second" in note
    monkeypatch.setattr(mounts, "MOUNTS", tmp_path / "nothing")
    assert mounts.network_type(tmp_path / "far away") == ""
