# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a training whose Gaussians are in a scratch file: manifests, resumed trainings, damaged files."""

from __future__ import annotations

import errno
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quick import quick
from scratch_runs import DENSE, LIMIT, SETTINGS, SPARE, STEADY, KilledError, Train, files_of, steps_of
from tiny import run_steps
from wide import flip, full

from clsplat.api import train
from clsplat.chunks import gathering, slot_file
from clsplat.chunks.manifest import manifest_of
from clsplat.chunks.slots import MAX_TENTHS, SlotTable
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import CapacityError, InputError, WriteError
from clsplat.files import atomic
from clsplat.gaussians import GaussiansOfFile
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.runs.checkpoints import Checkpoint, read_manifest
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.stages import chunk_records
from clsplat.training.memory import HostMemory
from clsplat.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("starts_wide")  # each training begins with a model of chunks


@pytest.mark.parametrize("name", quick(SETTINGS, next(iter(SETTINGS))))
def test_killed_and_resumed(
    go: Train, whole: Callable[[TrainConfig], bytes], recwarn: pytest.WarningsRecorder, name: str
) -> None:
    """In the same file, again and again; every checkpoint but the first writes only what has changed."""
    config = SETTINGS[name]
    wanted = whole(config)
    for step in (5, 9, 14, 19, 23):
        run = go(config, until=step)
        assert steps_of(run)[-1] == step - step % 4
        assert all(read_manifest(path) is not None for _, path in run.checkpoints())
    run = go(config)
    assert run.model_path.read_bytes() == wanted
    assert not [each for each in recwarn if "not finite" in str(each.message)], "of rows behind the model's last one"


@pytest.mark.parametrize(
    "limits", quick([(LIMIT, None), (None, LIMIT), (LIMIT, 5 << 20), (LIMIT, 64 << 20)], (LIMIT, 5 << 20))
)
def test_resumed_under_another_limit(
    go: Train, whole: Callable[[TrainConfig], bytes], limits: tuple[int | None, int | None]
) -> None:
    wanted = whole(DENSE)
    first, second = limits
    assert bool(files_of(go(DENSE, until=14, limit=first))) == (first is not None)
    run = go(DENSE, limit=second)
    assert run.model_path.read_bytes() == wanted
    manifests = [manifest.path for _, manifest in run.manifests()]
    assert set(files_of(run)) == set(manifests), "files that no checkpoint names any longer are removed"
    assert bool(manifests) == (second in (LIMIT, 5 << 20))


@pytest.mark.parametrize("scratch", ["same", "other"])
def test_statistics_that_the_settings_did_not_need_before(
    scene: Scene, default_device: Device, tmp_path: Path, scratch: str
) -> None:
    """They stay unknown, and the others go on. The chunks then have other fields, so they take a new file."""
    run = Run.create(tmp_path / "run", STEADY)
    more = replace(STEADY, density=replace(STEADY.density, every=100, min_contribution=1e-3))
    memory = HostMemory.chosen(LIMIT, "none", run)
    trainer = Trainer(scene, STEADY, default_device, memory=memory)
    run_steps(5, trainer)
    arrays, state = trainer.checkpoint()
    checkpoint = Checkpoint(trainer.step, arrays, state, manifest_of(arrays, state))
    if scratch == "other":
        memory = replace(memory, scratch=tmp_path / "other")
    other = Trainer(scene, more, default_device, memory=memory)
    other.restore(checkpoint)
    named = other.statistics.named()
    assert len(named) == 7
    for name, array in named.items():
        if name in trainer.statistics.named():
            assert np.array_equal(array.get(), trainer.statistics.named()[name].get())
        else:
            assert np.isinf(array.get()).all()
    assert other.model.store is not None
    for each in (other, trainer):
        each.close()


def test_a_finished_training_can_go_on(go: Train, whole: Callable[[TrainConfig], bytes]) -> None:
    more = replace(STEADY, iterations=33)
    wanted = whole(more)
    assert len(files_of(go(STEADY))) == 1
    assert go(more).model_path.read_bytes() == wanted


@pytest.mark.parametrize("name", ["rows that stay", "chunks that stay"])
def test_bytes_on_the_disk(go: Train, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """At most 2.2 times the state. Only chunks that have changed are written, and hidden ones have not, without
    moments."""
    sizes: list[float] = []

    def measure(trainer: Trainer) -> None:
        if (store := trainer.model.store) is not None:
            assert store.path is not None
            sizes.append(store.path.stat().st_size / store.nbytes)

    written: list[int] = []
    real = slot_file.SlotFile.write_at

    def write(file: slot_file.SlotFile, slot: int, offset: int, values: Any) -> None:
        written.append(values.nbytes)
        real(file, slot, offset, values)

    monkeypatch.setattr(slot_file.SlotFile, "write_at", write)
    config = SETTINGS[name]
    run = go(config, each=measure)
    assert len(sizes) > config.iterations - 4, "from the second step on, when the model has all SH bands"
    assert 1 < max(sizes) <= MAX_TENTHS / 10
    if name == "chunks that stay":
        assert len(steps_of(run)) == 2
        state = 12 * CHUNK_ROWS * 3 * 4 * 38
        assert sum(written) < state * config.iterations / 4, "a view shows two of the twelve chunks"


def test_chunks_are_on_the_disk_before_the_manifest_names_them(
    go: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    scratch = tmp_path / "run" / "scratch"
    flush, rename, write = os.fsync, atomic.replace, slot_file.SlotFile.write_at

    def fsync(descriptor: int) -> None:
        if any(os.path.samestat(os.fstat(descriptor), path.stat()) for path in scratch.glob("*.chunks")):
            order.append("flushed")
        flush(descriptor)

    def replace_file(source: Path, target: Path) -> None:
        order.extend(["named"] * (target.suffix == ".npz"))
        rename(source, target)

    def write_at(file: slot_file.SlotFile, *arguments: Any) -> None:
        order.append("written")
        write(file, *arguments)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(atomic, "replace", replace_file)
    monkeypatch.setattr(slot_file.SlotFile, "write_at", write_at)
    go(STEADY)
    assert order.count("named") == 7
    for place in (place for place, event in enumerate(order) if event == "named"):
        assert order[place - 1] == "flushed", "nothing is written between"


def test_rows_move_in_the_same_file(go: Train) -> None:
    """By density control, and by a higher SH degree. It has room for what the checkpoints name and for what changes."""
    seen: list[set[str]] = []

    def look(trainer: Trainer) -> None:
        if (store := trainer.model.store) is not None:
            assert store.path is not None
            seen.append({path.name for path in store.path.parent.iterdir()})
            counts.add(store.count)
            shares.append(store.path.stat().st_size / store.nbytes)

    counts: set[int] = set()
    shares: list[float] = []
    run = go(DENSE, each=look)
    assert len(counts) > 2
    assert len(set().union(*seen)) == 1
    assert {path.name for path in files_of(run)} == {manifest.path.name for _, manifest in run.manifests()}
    # all chunks change here, in steps and in density control: the latest checkpoint's, today's, and tomorrow's
    assert max(shares) <= 3.0


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut": (lambda path: os.truncate(path, 4000), "has been cut"),
    "missing": (lambda path: path.unlink(), "cannot be opened: there is no such file"),
    "another's": (lambda path: path.write_bytes(os.urandom(path.stat().st_size)), "has changed since it was written"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_without_an_intact_file_nothing_is_trained(go: Train, name: str) -> None:
    run = go(until=14)
    (path,) = files_of(run)
    damage, message = DAMAGE[name]
    damage(path)
    with pytest.warns(UserWarning, match=message), pytest.raises(InputError, match=message) as caught:
        go()
    assert str(path) in str(caught.value)
    assert caught.value.exit_status == 2
    assert "--overwrite" in str(caught.value)


def test_a_damaged_chunk_leaves_the_checkpoint_before(go: Train, whole: Callable[[TrainConfig], bytes]) -> None:
    wanted = whole(SPARE)
    run = go(SPARE, until=14)
    (_, before), (_, last) = run.manifests()
    assert before.path == last.path
    only = set(last.slots.tolist()) - set(before.slots.tolist())
    assert only, "chunks have changed between the checkpoints"
    assert set(last.slots.tolist()) & set(before.slots.tolist()), "others have not"
    flip(last.path, last.path.stat().st_size // (int(last.slots.max()) + 1) * min(only) + 77)
    with pytest.warns(UserWarning, match=r"step-0000012\.npz: is a damaged checkpoint and is skipped"):
        resumed = go(SPARE, until=9 + 4)
    assert steps_of(resumed) == [8, 12]
    assert go(SPARE).model_path.read_bytes() == wanted


@pytest.mark.parametrize("name", ["cut", "changed"])
def test_a_file_that_is_damaged_while_it_is_trained_in(go: Train, tmp_path: Path, name: str) -> None:
    """No checkpoint is written of what was read. The ones before are verified by the resume."""

    def damage(trainer: Trainer) -> None:
        if trainer.step == 10:
            store = trainer.model.store
            assert store is not None
            assert store.path is not None
            at = store.record.itemsize
            if name == "cut":
                os.truncate(store.path, 2 * at)
            else:
                for slot in range(store.slots.size):
                    flip(store.path, slot * at + 5)

    with pytest.raises(InputError, match=r"has been cut|has changed since") as caught:
        go(each=damage)
    assert "continues from the last checkpoint" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert steps_of(Run.open(tmp_path / "run"))[-1] == 8


def test_a_file_that_is_removed_while_it_is_trained_in(go: Train, whole: Callable[[TrainConfig], bytes]) -> None:
    """As by a program that clears temporary folders: the next checkpoint has the Gaussians in a new file."""
    wanted = whole(STEADY)

    def remove(trainer: Trainer) -> None:
        if trainer.step in (6, 10) and (store := trainer.model.store) is not None and store.path is not None:
            store.path.unlink()

    with pytest.warns(UserWarning, match="has been removed while it was in use") as caught:
        run = go(until=14, each=remove)
    told = [each for each in caught if "removed while" in str(each.message)]  # a killed training leaves files open
    assert len(told) == 2
    assert len(files_of(run)) == 1
    assert go().model_path.read_bytes() == wanted


def test_the_model_of_a_file_stays_usable(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`train` of a run with a relative path returns it: in another working folder, and copied, without the run."""
    monkeypatch.chdir(tmp_path)
    run = Run.create("relative", STEADY)
    model = train(scene, STEADY, device=default_device, run=run, max_host_mem=LIMIT)
    assert isinstance(model, GaussiansOfFile)
    monkeypatch.chdir(tmp_path.parent)
    copied = pickle.loads(pickle.dumps(model))
    shutil.rmtree(tmp_path / "relative")
    assert copied.arrays().keys() == model.arrays().keys()
    for name, array in model.arrays().items():
        assert np.array_equal(copied.arrays()[name], array)


def test_a_move_that_fails_leaves_no_wrong_checkpoint(
    go: Train, whole: Callable[[TrainConfig], bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What is where on the device is still known, so that its checkpoint has every row."""
    wanted, real = whole(STEADY), chunk_records.copy_chunks

    def fail(trainer: Trainer) -> None:
        if trainer.step == 10:
            monkeypatch.setattr(chunk_records, "copy_chunks", failed)

    def failed(*arguments: Any, to_records: bool) -> None:
        if not to_records:
            monkeypatch.setattr(chunk_records, "copy_chunks", real)
            raise CapacityError("there is no memory left")
        real(*arguments, to_records=to_records)

    with pytest.raises(CapacityError, match=r"no memory left; a checkpoint of step 1\d is written"):
        go(each=fail)
    assert steps_of(Run.open(tmp_path / "run"))[-1] >= 10
    assert go().model_path.read_bytes() == wanted


def test_a_full_disk(go: Train, whole: Callable[[TrainConfig], bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, and the training goes on once there is room."""
    wanted = whole(STEADY)

    def fill(trainer: Trainer) -> None:
        if trainer.step == 5:
            monkeypatch.setattr(os, "posix_fallocate", full, raising=False)

    real = getattr(os, "posix_fallocate", None)
    with pytest.raises(WriteError, match=r"\.chunks: cannot be written: the disk is full"):
        go(each=fill)
    monkeypatch.setattr(os, "posix_fallocate", real, raising=False)
    assert go().model_path.read_bytes() == wanted


@pytest.mark.parametrize("ends", ["full", "killed"])
def test_density_control_that_does_not_end(
    go: Train, whole: Callable[[TrainConfig], bytes], monkeypatch: pytest.MonkeyPatch, ends: str
) -> None:
    """The disk is full, or the process is killed, when some of the new chunks are written: the checkpoint before is as
    it was."""
    wanted, taken = whole(DENSE), 0
    real = SlotTable.take

    def take(slots: SlotTable, count: int) -> Any:
        nonlocal taken
        taken += 1
        if ends == "killed" and taken == 2:
            raise KilledError
        if ends == "full" and taken == 1:
            monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
        return real(slots, count)

    def begin(trainer: Trainer) -> None:
        if trainer.step == 14:
            monkeypatch.setattr(SlotTable, "take", take)
            monkeypatch.setattr(gathering, "BLOCK_CHUNKS", 2)
            if ends == "killed":
                monkeypatch.setattr(trainer.model, "close", lambda: None)

    allocate = getattr(os, "posix_fallocate", None)
    if ends == "full":
        with pytest.raises(WriteError, match=r"\.chunks: cannot be written: the disk is full"):
            go(DENSE, each=begin)
    else:
        go(DENSE, until=20, each=begin)
    assert taken == (1 if ends == "full" else 2)
    monkeypatch.setattr(SlotTable, "take", real)
    monkeypatch.setattr(os, "posix_fallocate", allocate, raising=False)
    assert go(DENSE).model_path.read_bytes() == wanted


def test_a_disk_that_is_full_at_the_start(go: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(WriteError, match=r"the disk is full.*are needed"):
        go(scratch=tmp_path / "scratch")
    assert not list((tmp_path / "scratch").iterdir())


def test_a_read_only_folder(go: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(slot_file, "FileIO", refused)
    with pytest.raises(WriteError, match=r"\.chunks: cannot be written: the disk is read-only"):
        go(scratch=tmp_path / "scratch")


def test_the_least_limit_is_told(go: Train, whole: Callable[[TrainConfig], bytes]) -> None:
    wanted = whole(STEADY)
    with pytest.raises(
        InputError, match=r"--max-host-mem 100 KiB is too little: .*; expected at least \d+MiB$"
    ) as caught:
        go(limit=100 << 10, name="little")
    least = int(str(caught.value).split("at least ")[-1].removesuffix("MiB"))
    run = go(limit=least << 20)
    assert run.model_path.read_bytes() == wanted
    assert least == 1, "a tenth of the state"
    assert files_of(run)
