# SPDX-License-Identifier: Apache-2.0
"""A write that fails, for whatever reason, leaves the previous file whole and nothing beside it."""

import errno
import os
import pickle
from pathlib import Path

import pytest
from calls import raising, refuses
from systems import posix

from clsplat.cli.main import one_line
from clsplat.errors import InputError, WriteError
from clsplat.files.atomic import atomic_write, atomic_writer
from clsplat.files.documents import open_input


def test_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    atomic_write(path, b"old")
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")])
def test_failure_in_the_middle_leaves_the_previous_file(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "model.ply"
    path.write_bytes(b"old")
    with pytest.raises(type(error) if isinstance(error, OSError) else error):  # noqa: SIM117
        with atomic_writer(path) as file:
            file.write(b"half of the n")
            raise error
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_disk_full_while_flushing_leaves_the_previous_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model.ply"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", raising(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    refuses("the disk is full", atomic_write, path, b"new", error=OSError)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_disk_full_for_real(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel's own ENOSPC, from a write and from the flush of a buffer."""
    import builtins

    real_open = builtins.open
    path = tmp_path / "model.ply"
    path.write_bytes(b"old")
    monkeypatch.setattr(builtins, "open", lambda *_: real_open("/dev/full", "wb"))
    for size in (10, 1 << 20):
        refuses("the disk is full", atomic_write, path, bytes(size), error=OSError)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@posix
def test_link_is_followed_and_permissions_are_the_umasks(tmp_path: Path) -> None:
    target, link, plain = tmp_path / "target", tmp_path / "link", tmp_path / "plain"
    target.write_bytes(b"old")
    link.symlink_to(target)
    atomic_write(link, b"new")
    plain.write_bytes(b"")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert target.stat().st_mode == plain.stat().st_mode


def test_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match=r"file: cannot be written: there is no folder .*no$") as caught:
        atomic_write(tmp_path / "no" / "file", b"")
    assert caught.value.exit_status == 2
    assert caught.value.errno == errno.ENOENT


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "model.ply").mkdir()
    with pytest.raises(WriteError, match=r"model\.ply: cannot be written: it is a folder, expected the name of a file"):
        atomic_write(tmp_path / "model.ply", b"")
    assert list(tmp_path.iterdir()) == [tmp_path / "model.ply"]


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="no /proc on this system")
def test_a_place_that_takes_no_files() -> None:
    said = refuses(".", atomic_write, "/proc/x.ply", b"", error=WriteError)
    assert said == "/proc/x.ply: cannot be written: no file can be made in /proc"


def test_a_full_disk_says_how_much_is_needed(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    said = r"model.ply: cannot be written: the disk is full: {} needed and [\d,.]+ \w+ are free; make room"
    with pytest.raises(WriteError, match=said.format("293 KiB are")), atomic_writer(tmp_path / "model.ply", 300_000):
        raise full
    with pytest.raises(WriteError, match=said.format("more than 5,000 bytes are")):  # noqa: SIM117
        with atomic_writer(tmp_path / "model.ply") as file:
            file.write(bytes(5000))
            raise full
    assert not list(tmp_path.iterdir())


def test_an_error_of_writing_survives_another_process() -> None:
    error = WriteError(errno.ENOSPC, "the disk is full", "a.exr")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.exit_status) == ("a.exr: cannot be written: the disk is full", 1)


def test_errors_of_the_system_are_plain_sentences() -> None:
    error = OSError(errno.EACCES, "Permission denied", "/a/b")
    assert one_line(error) == "/a/b: permission is denied"
    assert one_line(OSError(errno.ENOSPC, "No space left on device")) == "the disk is full"
    assert one_line(MemoryError()) == "there is not enough main memory: the system has no more"


@pytest.mark.brings("GitHub's archives", "Git LFS's notes in place of files", "named, with `git lfs pull`")
@pytest.mark.parametrize("name", ["model.ply", "cameras.json", "photo.png", "cloud.las"])
def test_a_file_that_git_lfs_did_not_fetch_is_told(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'ab' * 32}\nsize 123456\n")
    with pytest.raises(InputError, match=r"is a Git LFS pointer, .*; run git lfs pull"), open_input(path, "a file"):
        pass
    path.write_bytes(b"version 1" + bytes(20))
    with open_input(path, "a file") as file:
        assert file.read(9) == b"version 1"
