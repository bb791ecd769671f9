# SPDX-License-Identifier: Apache-2.0
"""The cache of decoded photographs: the same pixels or none, whatever happens to its files."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from same_bytes import model_bytes
from tiny import short

from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.files import mounts
from clsplat.files.atomic import machine_mark, temporary_name
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.memory import HostMemory
from clsplat.training.memory import model_bytes as bytes_of_a_gaussian
from clsplat.training.supervision import decoded_store
from clsplat.training.supervision.decoded_store import SUFFIX, DecodedStore, key_of, remove_decoded

KEY, OTHER = key_of(["a"]), key_of(["b"])
PIXELS = np.random.default_rng(1).integers(0, 256, (6, 5, 4), np.uint8)

CONFIG = short(iterations=24, warmup=(4, 10), report=False, density={"every": 0})
"""A short training at three sizes."""
ONE_TRAINING = """
import io, sys, time
from pathlib import Path
from clsplat.api import train
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.training.supervision import decoded_store

class Slow(io.FileIO):
    def write(self, data):
        data = memoryview(data).cast("B")
        for start in range(0, len(data), 1000):
            time.sleep(0.001)
            super().write(data[start : start + 1000])
        return len(data)

decoded_store.open = lambda path, mode, **options: (open if "r" in mode else Slow)(path, mode, **options)
scene, run, cache, limit = sys.argv[1:]
scene, run = load_scene(Path(scene)), Run.open(Path(run))
print("ready", flush=True)
sys.stdin.readline()
train(scene, run.config, run=run, cache=cache, max_host_mem=int(limit))
"""
"""A training that begins when it is told to. It writes a file of the cache in pieces, a millisecond apart."""


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


def little_memory(scene: Scene) -> int:
    """A limit in bytes with which most photographs are read again and again."""
    return HostMemory().photographs(scene, CONFIG).least + len(scene.points) * bytes_of_a_gaussian(CONFIG)


@pytest.mark.slow
def test_a_training_whose_disk_is_full(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line, and the same bytes."""
    alone = model_bytes(scene, CONFIG, default_device, tmp_path / "alone")

    def full(path: Path, mode: str, **options: Any) -> Any:
        if "x" in mode:
            raise OSError(errno.ENOSPC, "full")
        return open(path, mode, **options)

    monkeypatch.setattr(decoded_store, "open", full, raising=False)
    limit = little_memory(scene)
    with pytest.warns(UserWarning, match="no decoded photographs can be written there") as told:
        assert model_bytes(scene, CONFIG, default_device, tmp_path / "run", max_host_mem=limit) == alone
    assert len([each for each in told if "can be written there" in str(each.message)]) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "other",
    [
        CONFIG,
        pytest.param(replace(CONFIG, seed=5, warmup=(6,)), marks=pytest.mark.slow),
        pytest.param(replace(CONFIG, photos="8bit"), marks=pytest.mark.slow),
    ],
    ids=["same settings", "other order and sizes", "other precision"],
)
def test_two_trainings_at_once(
    scene: Scene, folder: Path, default_device: Device, tmp_path: Path, other: TrainConfig
) -> None:
    """Both have the bytes of a training alone, and neither reads a file that is not whole."""
    configs = {"one": CONFIG, "other": other}
    trainings = []
    for name, config in configs.items():
        Run.create(tmp_path / name, config)
        words = [ONE_TRAINING, folder, tmp_path / name, tmp_path / "cache", little_memory(scene)]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        trainings.append(subprocess.Popen([sys.executable, "-c", *map(str, words)], text=True, **pipes))
    for training in trainings:
        assert training.stdout.readline() == "ready\n", training.communicate()[1]
    for training in trainings:
        training.stdin.write("begin\n")
        training.stdin.flush()
    for training in trainings:
        _, errors = training.communicate(timeout=120)
        assert training.returncode == 0, errors
        assert "decoded" not in errors, errors
    for name, config in configs.items():
        alone = model_bytes(scene, config, default_device, tmp_path / f"{name} alone")
        assert (tmp_path / name / "model.ply").read_bytes() == alone
    store, paths = DecodedStore(tmp_path / "cache"), list((tmp_path / "cache").iterdir())
    assert len(paths) >= 2 * len(scene.train_views)
    assert {path.suffix for path in paths} == {SUFFIX}, "no temporary files are left"
    assert all(store.read(bytes.fromhex(path.stem)) is not None for path in paths)


def test_what_a_killed_process_left_is_removed(store: DecodedStore) -> None:
    mark = decoded_store.TEMPORARY_NAME
    with ThreadPoolExecutor(1) as pool:
        pool.submit(store.write, KEY, PIXELS).result()
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


def test_a_file_that_another_process_is_writing_stays(store: DecodedStore) -> None:
    """As where a training begins on the same cache, or ends whose own cache this process was told to use."""
    store.write(KEY, PIXELS)
    being_written = temporary_name(store.path(OTHER))
    being_written.write_bytes(b"half")
    DecodedStore(store.folder)
    assert being_written.exists()
    remove_decoded(store.folder)
    assert [path.name for path in store.folder.iterdir()] == [being_written.name]
    store.write(KEY, PIXELS)
    assert (store.read(KEY) == PIXELS).all()
    being_written.unlink()
    remove_decoded(store.folder)
    assert not store.folder.exists()
    store.write(KEY, PIXELS)
    (note,) = store.notes()
    assert f"there is no folder {store.folder}" in note


@pytest.mark.parametrize("named", ["the run's", "the run's in other words", "another", "none", None])
def test_a_run_removes_its_own_cache_at_its_end_unless_it_was_named(tmp_path: Path, named: str | None) -> None:
    run = Run.create(tmp_path / "run", CONFIG)
    words = {"the run's": run.cache_path, "the run's in other words": tmp_path / "run" / ".." / "run" / "cache"}
    cache = words.get(named, tmp_path / "another") if named not in {"none", None} else named
    memory = HostMemory.chosen("1GiB", cache, run)
    stores = {DecodedStore(folder) for folder in (run.cache_path, memory.cache) if folder is not None}
    for store in stores:
        store.write(KEY, PIXELS)
    memory.end(run)
    assert run.cache_path.exists() == (named in words)
    assert (tmp_path / "another").exists() == (named == "another")


def test_a_network_disk_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "mounts"
    here = str(tmp_path).replace(" ", "\\040")
    table.write_text(
        f"disk / ext4 rw 0 0\nserver:/a {here}/far\\040away nfs4 rw 0 0\nx {here}/far\\040away/near tmpfs rw 0 0\n"
    )
    monkeypatch.setattr(mounts, "MOUNTS", table)
    monkeypatch.setattr(mounts, "NETWORK_SAMPLE_BYTES", 2 * PIXELS.nbytes)
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
