# SPDX-License-Identifier: Apache-2.0
"""Scratch files in other folders, of other runs, of killed trainings, and on network disks."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from scratch_runs import DENSE, SPARE, STEADY, Train, files_of
from wide import start_training

from clsplat.chunks.manifest import Manifest
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.files import mounts
from clsplat.runs import checkpoints
from clsplat.runs.run import Run, owned_files
from clsplat.runs.scratch import ScratchFiles, owner_of

pytestmark = pytest.mark.usefixtures("starts_wide")  # each training begins with a model of chunks


@pytest.mark.slow
def test_scratch_may_be_elsewhere(go: Train, whole: Callable[[TrainConfig], bytes], tmp_path: Path) -> None:
    """A resume with another folder takes the file's content there."""
    wanted = whole(STEADY)
    folders = [tmp_path / name for name in ("one", "two")]
    for folder in folders:
        (folder / "sub").mkdir(parents=True)
        (folder / "theirs.txt").write_text("")
    go(until=10, scratch=folders[0])
    (first,) = folders[0].glob("*.chunks")
    go(until=11, scratch=folders[1])
    assert first.exists(), "its checkpoint is the latest"
    run = go(scratch=folders[1])
    assert run.model_path.read_bytes() == wanted
    assert not first.exists(), "no checkpoint names it"
    assert len(list(folders[1].glob("*.chunks"))) == 1
    assert all((folder / "theirs.txt").exists() for folder in folders)


def test_a_run_that_has_been_moved(go: Train, whole: Callable[[TrainConfig], bytes], tmp_path: Path) -> None:
    wanted = whole(STEADY)
    go(until=10, name="old").path.rename(tmp_path / "run")
    assert go().model_path.read_bytes() == wanted


@pytest.mark.slow
def test_the_file_of_another_run_is_only_read(go: Train, whole: Callable[[TrainConfig], bytes], tmp_path: Path) -> None:
    """As after a copy of a run whose files are elsewhere."""
    wanted, scratch = whole(STEADY), tmp_path / "scratch"
    run = go(until=10, name="first", scratch=scratch)
    (theirs,) = scratch.glob("*.chunks")
    before = theirs.read_bytes()
    shutil.copytree(run.path, tmp_path / "run")
    assert go(scratch=scratch).model_path.read_bytes() == wanted
    assert theirs.read_bytes() == before
    assert len(list(scratch.glob("*.chunks"))) == 2
    assert go(name="first", scratch=scratch).model_path.read_bytes() == wanted


def test_a_new_run_where_a_renamed_one_was(go: Train, whole: Callable[[TrainConfig], bytes], tmp_path: Path) -> None:
    """It leaves the other's file alone, although both runs have had one path."""
    wanted, scratch = whole(STEADY), tmp_path / "scratch"
    go(until=10, scratch=scratch).path.rename(tmp_path / "earlier")
    go(until=5, scratch=scratch)
    assert go(name="earlier", scratch=scratch).model_path.read_bytes() == wanted


def test_what_a_killed_training_left_is_removed(go: Train, tmp_path: Path) -> None:
    run = go(until=10)
    (named,) = files_of(run)
    owner, theirs = owner_of(run), run.scratch_path / ("0" * 12 + "-00000000.chunks")
    left = run.scratch_path / f"{owner}-ffffffff.chunks"
    for path in (left, theirs):
        path.write_bytes(b"x")
    run = go(until=14)
    assert set(files_of(run)) == {named, theirs}
    assert set(owned_files(run.path)) >= {named, theirs}
    Run.create(run.path, STEADY, overwrite=True)
    assert not files_of(run)


def test_a_checkpoint_that_cannot_be_read_now_keeps_its_file(
    go: Train, whole: Callable[[TrainConfig], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with too many open files. It is no damaged checkpoint, which would need no file."""
    wanted, run = whole(STEADY), go(until=10)
    (named,) = files_of(run)

    def fails(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "_part", fails)
        ScratchFiles(run.scratch_path, owner_of(run), run).remove_unnamed()
    assert named.exists()
    assert go().model_path.read_bytes() == wanted


def test_a_checkpoint_that_names_another_file(go: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hostile one must not have any file written that it names."""
    precious = tmp_path / "precious"
    real = Manifest.state

    def state(manifest: Manifest) -> dict[str, Any]:
        return real(replace(manifest, path=precious))

    monkeypatch.setattr(Manifest, "state", state)
    (path,) = files_of(go(until=10))
    path.rename(precious)
    before = precious.read_bytes()
    with (
        pytest.warns(UserWarning, match="precious, expected a file "),
        pytest.raises(InputError, match="no intact checkpoint"),
    ):
        go()
    assert precious.read_bytes() == before


def test_a_network_disk_is_told_once(go: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "mounts"
    table.write_text(f"disk / ext4 rw 0 0\nserver:/a {str(tmp_path).replace(' ', chr(92) + '040')} nfs4 rw 0 0\n")
    monkeypatch.setattr(mounts, "MOUNTS", table)
    with pytest.warns(UserWarning, match=r"is on a network disk \(nfs4\)") as caught:
        go(DENSE)
    told = [str(each.message) for each in caught if "network disk" in str(each.message)]
    assert len([text for text in told if "--scratch DIR" in text]) == 1


@pytest.mark.slow
def test_two_trainings_in_one_folder(
    folder: Path, go: Train, whole: Callable[[TrainConfig], bytes], tmp_path: Path
) -> None:
    """At once, one of them killed and resumed: each has files of its own."""
    wanted = whole(SPARE)
    processes = [start_training(folder, Run.create(tmp_path / name, SPARE).path) for name in ("one", "two")]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        print(file=process.stdin, flush=True)
    while not list((tmp_path / "one" / "checkpoints").glob("step-*.npz")) and processes[0].poll() is None:
        pass
    processes[0].kill()
    for process in processes:
        process.communicate()
    assert processes[1].returncode == 0
    again = start_training(folder, tmp_path / "one")
    again.communicate("\n")
    assert again.returncode == 0
    for name in ("one", "two"):
        assert (tmp_path / name / "model.ply").read_bytes() == wanted
