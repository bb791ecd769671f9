# SPDX-License-Identifier: Apache-2.0
"""Jobs that share the frames of a sequence: claims, frames that are done meanwhile, and processes that have ended."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from calls import refuses
from test_render_job import OPTIONS, rendered, tasks_in

from clsplat.files import atomic, locks
from clsplat.files.locks import abandoned, claim, give_back
from clsplat.jobs import claims
from clsplat.sequence import frame_claims, workers
from clsplat.sequence.finished_frames import is_complete, remove_temporaries
from clsplat.sequence.frame_claims import Sharing
from clsplat.sequence.frame_renderer import RenderedFrame
from clsplat.sequence.task import Record, Task
from clsplat.sequence.workers import run_tasks

ENDED = "import sys; from pathlib import Path; from clsplat.files.locks import claim; claim(Path(sys.argv[1]))"


def test_a_claim_is_of_one(tmp_path: Path) -> None:
    target = tmp_path / "a.exr"
    held = claim(target)
    assert held is not None and claim(target) is None
    assert abandoned([target]) == [], "its process is alive"
    give_back(held)
    give_back(held)
    assert [*tmp_path.iterdir()] == []
    again = claim(target)
    assert again == held
    give_back(again)


def test_what_a_killed_process_has_claimed_is_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (first, second) = tasks_in(tmp_path, 2)
    for task in (first, second):
        subprocess.run([sys.executable, "-c", ENDED, str(task.path)], check=True)
    assert len([*tmp_path.iterdir()]) == 2
    held = claim(first.path)
    assert held is not None
    remove_temporaries([second])
    assert [*tmp_path.iterdir()] == [held]
    # of another machine, only its age tells
    for module in (atomic, locks):
        monkeypatch.setattr(module, "machine_mark", lambda: "0000")
        monkeypatch.setattr(module, "ABANDONED_FILE_SECONDS", -1.0)
    assert claim(first.path) is not None


@pytest.mark.parametrize("removes", [False, True])
@pytest.mark.parametrize("links", [True, False])
def test_a_claim_that_another_process_takes_over_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, links: bool, removes: bool
) -> None:
    """Between this process's look at an abandoned marker and its removal: the other process keeps the claim."""
    (task,) = tasks_in(tmp_path, 1)
    target, marker = task.path, tmp_path / f".{task.path.name}.clsplat-claim"
    subprocess.run([sys.executable, "-c", ENDED, str(target)], check=True)
    judge, theirs = locks._is_given_up, f"ffff{1:08x}{'0' * 8}".encode()

    def other_is_first(path: Path, content: bytes) -> bool:
        given_up = judge(path, content)
        marker.unlink()
        marker.write_bytes(theirs)
        return given_up

    def no_links(*_: object) -> None:
        raise PermissionError(errno.EPERM, "")

    with monkeypatch.context() as patches:
        patches.setattr(locks, "_is_given_up", other_is_first)
        if not links:
            patches.setattr(os, "link", no_links)
        if removes:
            remove_temporaries([task])
        else:
            assert claim(target) is None
    assert marker.read_bytes() == theirs and [*tmp_path.iterdir()] == [marker]
    assert claim(target) is None


def test_a_claim_that_was_lost_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that was stopped for long neither touches nor removes the marker of its successor."""
    monkeypatch.setattr(claims, "CLAIM_HEARTBEAT_SECONDS", 0.01)
    held, target = claims.HeldClaims(), tmp_path / "a"
    assert held.take(target)
    (marker,) = tmp_path.iterdir()
    marker.write_bytes(b"ffff0000000100000000")
    os.utime(marker, (1000, 1000))
    time.sleep(0.1)  # ten updates
    assert marker.stat().st_mtime == 1000
    held.release(target)
    assert marker.exists()
    held.close()


def test_containers_with_one_host_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their process ids are told apart by their namespaces, and those of machines by the boot."""
    boot, inodes = tmp_path / "boot", iter([OSError(), 1, 1, 2])

    def namespace() -> os.stat_result:
        if isinstance(inode := next(inodes), OSError):
            raise inode
        return os.stat_result((0, inode, *[0] * 8))

    monkeypatch.setattr("socket.gethostname", lambda: "node")
    monkeypatch.setattr(atomic, "_BOOT_ID_FILE", boot)
    monkeypatch.setattr(atomic, "_PID_NAMESPACE_FILE", SimpleNamespace(stat=namespace))
    marks = [atomic.machine_mark.__wrapped__()]
    for text in ("boot", "another boot", "another boot"):
        boot.write_text(text)
        marks.append(atomic.machine_mark.__wrapped__())
    assert len({*marks}) == 4 and all(len(mark) == 4 for mark in marks)


def test_a_claim_that_nobody_touches_holds_nobody_up(tmp_path: Path) -> None:
    """Whatever its process is; one that is just being written holds."""
    target = tmp_path / "a.exr"
    held = claim(target)
    held.write_bytes(b"")
    assert claim(target) is None
    long_ago = time.time() - 2 * atomic.ABANDONED_FILE_SECONDS
    os.utime(held, (long_ago, long_ago))
    assert abandoned([target]) == [held]
    assert claim(target) == held


def test_a_process_of_the_same_number_before_this_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that begins again: its claims are not this process's, though its number is."""
    target = tmp_path / "a.exr"
    with monkeypatch.context() as before:
        before.setattr(locks, "_PROCESS_TOKEN", "00000000")
        assert claim(target) is not None
    assert abandoned([target]) != []
    assert claim(target) is not None and claim(target) is None


def test_claims_are_touched_while_a_job_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "CLAIM_HEARTBEAT_SECONDS", 0.02)
    (task,) = tasks_in(tmp_path, 1)
    shared = Sharing(OPTIONS)
    assert shared.begin(task) == "ours"
    (held,) = tmp_path.iterdir()
    long_ago = time.time() - 2 * atomic.ABANDONED_FILE_SECONDS
    os.utime(held, (long_ago, long_ago))
    until = time.monotonic() + 10
    while held.stat().st_mtime < long_ago + 1 and time.monotonic() < until:
        time.sleep(0.01)
    assert claim(task.path) is None
    shared.close()
    assert [*tmp_path.iterdir()] == []


def test_a_disk_without_room_leaves_no_claim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.FileIO):
        def write(self, _: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", lambda path, mode, buffering: Full(path, "x"))
    refuses("No space left", claim, tmp_path / "a.exr", error=OSError)
    assert [*tmp_path.iterdir()] == []


def test_two_jobs_render_each_frame_once(tmp_path: Path) -> None:
    """All but at most two, as frames that are begun at one time may be; both end when all frames are there."""
    tasks, made, ends = tasks_in(tmp_path, 30), [], []
    begin = threading.Barrier(2)

    def slowly(task: Task) -> RenderedFrame:
        made.append(task.number)
        time.sleep(0.01)
        return rendered(task)

    def job() -> None:
        records: list[Record] = []
        begin.wait()
        run_tasks(tasks, [slowly], OPTIONS, records.append, shared=True)
        ends.append((records, all(is_complete(task, OPTIONS) for task in tasks)))

    jobs = [threading.Thread(target=job) for _ in range(2)]
    for one in jobs:
        one.start()
    for one in jobs:
        one.join(60)
    assert set(made) == set(range(1, 31)) and len(made) <= 32
    assert all(whole for _, whole in ends) and len(ends) == 2
    for records, _ in ends:
        assert sorted(record.frame for record in records) == list(range(1, 31))
    both = [sum(not record.skipped for record in records) for records, _ in ends]
    assert sum(both) == len(made) and min(both) > 5, "they share the work"
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".exr"]


def test_a_frame_of_another_job_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """Until its file is there, or its process has ended, which leaves it to this one."""
    monkeypatch.setattr(frame_claims, "CLAIM_POLL_SECONDS", 0.02)
    monkeypatch.setattr(frame_claims, "CLAIM_WARNING_SECONDS", 0.05)
    told: list[str] = []
    monkeypatch.setattr(frame_claims, "warn", told.append)
    tasks, made, records = tasks_in(tmp_path, 4), [], []
    theirs = {task.number: claim(task.path) for task in tasks[1:3]}

    def noting(task: Task) -> RenderedFrame:
        made.append(task.number)
        return rendered(task)

    job = threading.Thread(
        target=run_tasks, args=(tasks, [noting, noting], OPTIONS, records.append), kwargs={"shared": True}
    )
    job.start()
    time.sleep(0.4)
    assert sorted(made) == [1, 4] and job.is_alive()
    workers.encode_frame(tasks[1], rendered(tasks[1]), OPTIONS)
    for held in theirs.values():
        assert held is not None
        give_back(held)
    job.join(30)
    assert sorted(made) == [1, 3, 4]
    assert {record.frame: record.skipped for record in records} == {1: False, 2: True, 3: False, 4: False}
    assert len(told) == 1 and "waiting for another process" in told[0]
    assert len(recwarn) == 0
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".exr"]


def test_claims_are_given_back_when_a_job_breaks_off(tmp_path: Path) -> None:
    def failing(task: Task) -> RenderedFrame:
        if task.number == 3:
            raise OSError("no room")
        return rendered(task)

    with pytest.raises(OSError, match="no room"):
        run_tasks(tasks_in(tmp_path, 9), [failing], OPTIONS, lambda record: None, shared=True)
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".exr"]


def test_a_claim_in_which_nothing_stands(tmp_path: Path) -> None:
    """As a process leaves it that is killed before it has written its name."""
    target = tmp_path / "a.exr"
    empty = tmp_path / ".a.exr.clsplat-claim"
    empty.touch()
    assert claim(target) is None  # it may be about to be written
    os.utime(empty, (time.time() - 60,) * 2)
    assert claim(target) is not None
