# SPDX-License-Identifier: Apache-2.0
"""A write that fails, for whatever reason, leaves the previous file whole and nothing beside it."""

import errno
import os
from pathlib import Path

import pytest
from systems import posix

from clsplat.files import atomic_write, atomic_writer


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
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "model.ply"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        atomic_write(path, b"new")
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
        with pytest.raises(OSError, match="No space left"):
            atomic_write(path, bytes(size))
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
    with pytest.raises(FileNotFoundError):
        atomic_write(tmp_path / "no" / "file", b"")
