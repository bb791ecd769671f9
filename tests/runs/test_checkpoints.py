# SPDX-License-Identifier: Apache-2.0
"""Checkpoints that are cut short, that a bit has flipped in, that cannot be written: told, and the one before used."""

from __future__ import annotations

import errno
import os
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import stress_kills
from calls import Capture, train
from quick import quick
from tiny import CONFIG, short

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.files import atomic
from clsplat.files.atomic import TEMPORARY_SUFFIX
from clsplat.runs.checkpoints import STATE_KEY, Checkpoint
from clsplat.runs.run import Run

STATE = {"rng": {"state": 2**100}, "seconds": 0.25}


def arrays(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {"parameters/means": rng.standard_normal((3, 3)).astype(np.float32), "none": np.zeros((3, 0, 3), np.float32)}


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """With checkpoints of steps 1 and 2."""
    made = Run.create(tmp_path / "run", CONFIG)
    for step in (1, 2):
        made.save_checkpoint(step, arrays(step), STATE)
    return made


def latest(run: Run) -> tuple[Checkpoint, list[str]]:
    """The checkpoint that is taken, and what is told."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checkpoint = run.load_latest_checkpoint()
    assert checkpoint is not None
    return checkpoint, [str(each.message) for each in caught]


def assert_whole(checkpoint: Checkpoint) -> None:
    """What was written at its step, to the last bit."""
    wanted = arrays(checkpoint.step)
    assert checkpoint.state == STATE
    assert checkpoint.arrays.keys() == wanted.keys()
    for name, array in wanted.items():
        assert checkpoint.arrays[name].dtype == array.dtype
        assert checkpoint.arrays[name].shape == array.shape
        assert checkpoint.arrays[name].tobytes() == array.tobytes()


def test_no_flipped_bit_goes_unnoticed(run: Run) -> None:
    """One in every byte of the file: the checkpoint is passed over, or it is what it was (a date of the archive's)."""
    path = run.checkpoints()[-1][1]
    data, rng = path.read_bytes(), np.random.default_rng(0)
    passed = 0
    for index in range(len(data)):
        flipped = bytearray(data)
        flipped[index] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        checkpoint, told = latest(run)
        assert_whole(checkpoint)
        assert len(told) == (checkpoint.step == 1), told
        if told:
            passed += 1
            assert told[0].startswith(f"{path}: is a damaged checkpoint and is skipped (")
    assert passed > 0.8 * len(data)


def test_no_cut_goes_unnoticed(run: Run) -> None:
    path = run.checkpoints()[-1][1]
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        checkpoint, told = latest(run)
        assert checkpoint.step == 1
        assert_whole(checkpoint)
        assert len(told) == 1


@pytest.mark.parametrize("change", ["value", "dtype", "shape", "missing", "more"])
def test_arrays_that_are_not_those_written_are_noticed(run: Run, change: str) -> None:
    """By somebody who writes a sound archive."""
    path, name = run.checkpoints()[-1][1], "parameters/means"
    with np.load(path) as archive:
        members = {key: archive[key] for key in archive.files}
    if change == "value":
        members[name][1, 1] = np.nextafter(members[name][1, 1], np.float32(9))
    elif change == "missing":
        del members[name]
    elif change == "more":
        members["another"] = np.zeros(3)
    else:
        members[name] = members[name].view(np.int32) if change == "dtype" else members[name].reshape(9)
    np.savez(path, **members)
    checkpoint, (told,) = latest(run)
    assert checkpoint.step == 1
    assert f"{'another' if change == 'more' else name}" in told


def test_checkpoints_without_digests_are_read(run: Run) -> None:
    path = run.checkpoints()[-1][1]
    with np.load(path) as archive:
        members = {key: archive[key] for key in archive.files}
    text = re.sub(r'"sha256": \{[^}]*\}, ', "", members[STATE_KEY].tobytes().decode())
    assert "sha256" not in text
    np.savez(path, **{**members, STATE_KEY: np.frombuffer(text.encode(), np.uint8)})
    checkpoint, told = latest(run)
    assert (checkpoint.step, told) == (2, [])


def test_two_are_kept_and_resuming_removes_what_a_kill_left(run: Run) -> None:
    for step in range(3, 8):
        run.save_checkpoint(step, arrays(step), STATE)
        assert [each for each, _ in run.checkpoints()] == [step - 1, step]
    half = run.checkpoints_path / f".step-0000008.npz.12ab{TEMPORARY_SUFFIX}"
    half.write_bytes(b"PK")
    assert run.load_latest_checkpoint() is not None
    assert half.exists(), "only looking changes nothing"
    Run.create(run.path, CONFIG, resume=True).load_latest_checkpoint()
    assert not half.exists()


def test_a_checkpoint_that_lacks_a_group_is_named(run: Run, scene: Path, capfd: Capture) -> None:
    assert main(["train", str(scene), "-o", str(run.path), "--resume"]) == 2
    assert "checkpoint of step 2: has no parameters/quaternions" in capfd.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_training_goes_on_from_the_checkpoint_before(
    damage: str, scene: Path, trained: Path, tmp_path: Path, capfd: Capture
) -> None:
    folder = tmp_path / "run"
    assert train(scene, folder, short(iterations=25, checkpoint_every=10)) == 0
    path = Run.open(folder).checkpoints()[-1][1]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 64
    path.write_bytes(data if damage == "flipped" else data[:-40])
    capfd.readouterr()
    assert main(["train", "-o", str(folder), "--resume", "--iterations", "40"]) == 0
    told = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
    assert len(told) == 1
    assert told[0].startswith(f"clsplat: warning: {path}: is a damaged checkpoint and is skipped (")
    assert (folder / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()
    assert [record["step"] for record in Run.open(folder).read_metrics()] == [10, 20, 30, 40]


def test_with_none_left_it_says_what_to_do(run: Run) -> None:
    for _, path in run.checkpoints():
        path.write_bytes(b"")
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(InputError, match="use --overwrite to start again"):
        run.load_latest_checkpoint()


@pytest.mark.parametrize("number", quick([errno.EROFS, errno.EACCES, errno.ENOSPC, errno.EDQUOT], errno.ENOSPC))
def test_a_checkpoint_that_cannot_be_written_is_named(
    number: int, scene: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    """A folder that is read-only by now, or a disk that is full: the checkpoint before stays, and serves."""
    folder = tmp_path / "run"
    real = open

    def refusing(path: Path, *arguments: object, **options: object) -> object:
        if "step-0000020" in str(path):
            raise OSError(number, os.strerror(number), str(path))
        return real(path, *arguments, **options)  # type: ignore[call-overload]

    with monkeypatch.context() as patch:
        patch.setattr(atomic, "open", refusing, raising=False)
        assert train(scene, folder, short(checkpoint_every=10)) == 1
    said = capfd.readouterr().err.splitlines()[-1]
    path = folder / "checkpoints" / "step-0000020.npz"
    why = {
        errno.EROFS: "read-only",
        errno.EACCES: "permission is denied",
        errno.ENOSPC: "full: ",
        errno.EDQUOT: "quota",
    }
    assert said.startswith(f"clsplat: error: {path}: cannot be written: ")
    assert why[number] in said
    assert [step for step, _ in Run.open(folder).checkpoints()] == [10]
    assert main(["train", "-o", str(folder), "--resume"]) == 0
    assert (folder / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()


def test_a_folder_that_is_read_only_is_named(scene: Path, tmp_path: Path, capfd: Capture) -> None:
    if not hasattr(os, "geteuid") or os.geteuid() == 0:
        pytest.skip("nothing is read-only for root")
    tmp_path.chmod(0o500)
    try:
        assert train(scene, tmp_path / "run", CONFIG) == 1
    finally:
        tmp_path.chmod(0o700)
    assert f"Permission denied: '{tmp_path / 'run'}'" in capfd.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_a_few_kills(capfd: Capture, default_device: object) -> None:
    """`tools/stress/run kills --kills 100` is the long form."""
    assert stress_kills.main(["--kills", "2", "--seed", "5"]) == 0
    out = capfd.readouterr().out
    assert re.match(r"2 kills survived in \d+ s: .* each with the bytes of an undisturbed one", out)
