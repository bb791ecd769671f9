# SPDX-License-Identifier: Apache-2.0
"""Tasks in processes of this machine: their order, repeated attempts, claims, kills, and what is said of failures."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import dispatching
import pytest
from calls import refuses
from counting import counted, counting_task
from systems import alive, posix

from clsplat.errors import ClsplatError
from clsplat.files.locks import WRITTEN_BY, claim
from clsplat.jobs import attempt, dispatcher
from clsplat.jobs.dispatcher import JobProgress, run_tasks
from clsplat.jobs.local_engine import LocalEngine
from clsplat.jobs.task import Attempt, JobTask, check_tasks, last_line, mark_of


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RETRY_SECONDS", "CLAIM_CHECK_SECONDS", "PROGRESS_SECONDS"):
        monkeypatch.setattr(dispatcher, name, 0.05)


def test_tasks_run_in_their_order(tmp_path: Path) -> None:
    """Those that can run at once do; done ones are not begun; progress counts the steps of all."""
    tasks = [
        counting_task(tmp_path, "merge", 1, after=("0_0", "0_1")),
        counting_task(tmp_path, "0_0", 5, after=("plan",)),
        counting_task(tmp_path, "0_1", 5, after=("plan",)),
        counting_task(tmp_path, "plan", 2),
    ]
    seen: list[JobProgress] = []
    run_tasks(tasks, LocalEngine(2), tmp_path / "jobs", seen.append)
    assert [counted(tmp_path, task.name) for task in tasks] == [1, 5, 5, 2]
    ends = {task.name: (tmp_path / f"{task.name}.done").stat().st_mtime for task in tasks}
    assert ends["plan"] <= min(ends["0_0"], ends["0_1"]) and max(ends["0_0"], ends["0_1"]) <= ends["merge"]
    assert seen[-1] == JobProgress(4, 4, 13, 13)
    assert [one.steps for one in seen] == sorted(one.steps for one in seen)
    assert sorted(path.name for path in (tmp_path / "jobs").iterdir()) == [
        "0_0.log",
        "0_1.log",
        "mark",
        "merge.log",
        "plan.log",
    ]
    logs = {path: path.stat().st_size for path in (tmp_path / "jobs").glob("*.log")}
    run_tasks(tasks, LocalEngine(2), tmp_path / "jobs")
    assert logs == {path: path.stat().st_size for path in logs}, "nothing was begun again"


def test_three_tries_without_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then one line with the log's end; tasks after it are not begun, others are."""
    told: list[str] = []
    monkeypatch.setattr(dispatcher, "warn", told.append)
    bad = JobTask("bad", (sys.executable, "-c", "import sys; print('no good'); print(); sys.exit(4)"), lambda: False)
    tasks = [bad, counting_task(tmp_path, "after", 1, after=("bad",)), counting_task(tmp_path, "other", 2)]
    refuses(
        "1 of 3 tasks failed: bad, and 1 that depend on them were not begun; see ",
        run_tasks,
        tasks,
        LocalEngine(1),
        tmp_path / "jobs",
        error=ClsplatError,
    )
    log = tmp_path / "jobs" / "bad.log"
    assert told == [
        f"task bad failed 3 times without progress; the command ended with status 4; {log} ends with: no good"
    ]
    assert log.read_text().count("--- ") == 3
    assert counted(tmp_path, "other") == 2 and counted(tmp_path, "after") == 0


def test_progress_makes_tries_count_anew(tmp_path: Path) -> None:
    """A command that does a step and fails, three times, ends well."""
    task = counting_task(tmp_path, "a", 4, at_once=1)
    run_tasks([task], LocalEngine(1), tmp_path / "jobs")
    assert counted(tmp_path, "a") == 4
    assert (tmp_path / "jobs" / "a.log").read_text().count("--- ") == 4


def test_a_command_that_is_not_there(tmp_path: Path) -> None:
    task = JobTask("a", ("/no/such/command",), lambda: False)
    with pytest.warns(UserWarning, match="ends with: /no/such/command: no such command"):
        refuses("1 of 1 tasks failed", run_tasks, [task], LocalEngine(1), tmp_path / "jobs", error=ClsplatError)


@posix
def test_a_killed_command_and_a_killed_attempt(tmp_path: Path) -> None:
    """With SIGKILL: the task goes on where it was, and at no time do two processes count."""
    task = counting_task(tmp_path, "a", 40, seconds=0.02)
    kills: list[int] = []

    def kill(progress: JobProgress) -> None:
        if progress.steps > 10 * (len(kills) + 1) and len(kills) < 2:
            pid = int((tmp_path / "a.pid").read_text())
            if kills:  # the attempt's process, whose command ends with it
                pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
            kills.append(pid)
            os.kill(pid, signal.SIGKILL)

    if not Path("/proc/self/stat").exists():
        pytest.skip("finds the parent in /proc")
    run_tasks([task], LocalEngine(1), tmp_path / "jobs", kill)
    assert len(kills) == 2 and counted(tmp_path, "a") == 40


def test_two_dispatchers_share_the_tasks(tmp_path: Path) -> None:
    """No step is taken twice; both end when all are done. A command that has just ended may be called again."""
    tasks = [counting_task(tmp_path, str(number), 3, seconds=0.01) for number in range(6)]
    ended: list[bool] = []

    def run() -> None:
        run_tasks(tasks, LocalEngine(1), tmp_path / "jobs")
        ended.append(all(task.is_done() for task in tasks))

    both = [threading.Thread(target=run) for _ in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join(60)
    assert ended == [True, True]
    assert all(counted(tmp_path, task.name) == 3 for task in tasks)


def test_a_task_of_another_process_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until it has done it, which is told once."""
    told: list[str] = []
    monkeypatch.setattr(dispatcher, "warn", told.append)
    monkeypatch.setattr(dispatcher, "CLAIMED_WARNING_SECONDS", 0.1)
    (tmp_path / "jobs").mkdir()
    task = counting_task(tmp_path, "a", 1)
    code = (
        "import sys; from pathlib import Path; from clsplat.files.locks import claim; claim(Path(sys.argv[1])); input()"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "jobs" / "a")], stdin=subprocess.PIPE)
    while not (tmp_path / "jobs" / ".a.clsplat-claim").exists():
        time.sleep(0.01)
    threading.Timer(0.6, lambda: (other.kill(), other.wait())).start()
    run_tasks([task], LocalEngine(1), tmp_path / "jobs")
    assert other.stdin is not None
    other.stdin.close()
    assert len(told) == 1 and told[0].startswith("task a is claimed by another process; waiting until that process")
    assert counted(tmp_path, "a") == 1


class NoWorkers(LocalEngine):
    """Engine of a cluster without workers."""

    def free(self) -> int:
        return 0


def test_tasks_that_are_done_need_no_worker(tmp_path: Path) -> None:
    """Those that were done before, also one after another, and those that other processes do meanwhile."""

    def task(name: str, *after: str) -> JobTask:
        return JobTask(name, ("x",), (tmp_path / f"{name}.done").exists, after)

    tasks = [task("a"), task("b", "a"), task("c", "b")]
    for name in "ab":
        (tmp_path / f"{name}.done").touch()
    seen: list[JobProgress] = []

    def do_the_last(progress: JobProgress) -> None:
        seen.append(progress)
        (tmp_path / "c.done").touch()

    run_tasks(tasks, NoWorkers(), tmp_path / "jobs", do_the_last)
    assert seen[0] == JobProgress(2, 3, 2, 3) and seen[-1] == JobProgress(3, 3, 3, 3)
    assert not list((tmp_path / "jobs").glob("*.log"))


def test_a_result_that_a_process_without_a_claim_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a command that a user or Slurm has started: it is waited for, and the attempts do not count."""
    told: list[str] = []
    monkeypatch.setattr(dispatcher, "warn", told.append)
    monkeypatch.setattr(dispatcher, "MAX_TRIES", 2)
    monkeypatch.setattr(dispatcher, "CLAIMED_WARNING_SECONDS", 0.01)  # less than an attempt takes
    message = (
        f"clsplat: error: /city/blocks/0_0{WRITTEN_BY}clsplat blocks (process 7); wait until that process has ended"
    )
    code = "import sys; from pathlib import Path; begun = Path(sys.argv[1]); done = Path(sys.argv[2])\n"
    code += "with begun.open('a') as file: file.write('x')\n"
    code += "if begun.stat().st_size < 4: sys.exit(print(sys.argv[3]) or 2)\n"
    code += "done.touch()"
    begun, done = tmp_path / "begun", tmp_path / "done"
    task = JobTask("a", (sys.executable, "-c", code, str(begun), str(done), message), done.exists)
    run_tasks([task], LocalEngine(1), tmp_path / "jobs")
    assert begun.read_text() == "xxxx"
    assert len(told) == 1 and told[0].startswith("task a is claimed by another process; waiting until that process")
    other = JobTask("b", (sys.executable, "-c", f"import sys; print({message!r}); sys.exit(1)"), lambda: False)
    refuses("1 of 1 tasks failed", run_tasks, [other], LocalEngine(1), tmp_path / "jobs", error=ClsplatError)
    assert told[1].startswith("task b failed 2 times without progress; the command ended with status 1")


@posix
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGKILL]
)
def test_the_end_of_the_dispatcher_ends_the_commands(tmp_path: Path, number: signal.Signals) -> None:
    """With Ctrl-C it waits for them; after SIGKILL they end by themselves. The same tasks then go on."""
    process = subprocess.Popen(
        [sys.executable, dispatching.__file__, str(tmp_path), "--steps", "200"], stdout=subprocess.PIPE, text=True
    )
    while not all((tmp_path / f"{name}.pid").exists() and counted(tmp_path, name) > 3 for name in "01"):
        time.sleep(0.01)
    process.send_signal(number)
    out, _ = process.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert out == "interrupted after 0 of 3 tasks; the same command goes on\n"
    pids = [int((tmp_path / f"{name}.pid").read_text()) for name in "01"]
    until = time.monotonic() + (0 if number != signal.SIGKILL else 30)
    while any(alive(pid) for pid in pids) and time.monotonic() < until:
        time.sleep(0.01)
    assert not any(alive(pid) for pid in pids)
    before = [counted(tmp_path, name) for name in "01"]
    tasks = [counting_task(tmp_path, name, before[int(name)] + 2) for name in "01"]
    run_tasks(tasks, LocalEngine(2), tmp_path / "jobs")
    assert [counted(tmp_path, name) for name in "01"] == [count + 2 for count in before]


def test_what_makes_a_worker_unfit(tmp_path: Path) -> None:
    mark = mark_of(tmp_path)
    one = Attempt("a", ("clsplat",), str(tmp_path), (str(tmp_path),), mark)
    assert attempt.unfit_reason(one) == ""
    for change, reason in (
        ({"version": "0.0"}, "expected 0.0 like the dispatcher"),
        ({"needs": ("/no/scene",)}, "does not see /no/scene, expected the same paths"),
        ({"folder": "/no/jobs"}, "does not see /no/jobs, expected the same paths"),
        ({"mark": "0" * 32}, "sees another folder as "),
    ):
        assert reason in attempt.unfit_reason(Attempt(**{**one.document(), **change}))


def test_a_full_disk_ends_the_job_in_one_line(tmp_path: Path) -> None:
    """As this machine is the only worker; a disk that is full may be that of a worker."""
    code = "import errno; from clsplat.errors import WriteError, reason_of; "
    code += "error = WriteError(errno.ENOSPC, reason_of(OSError(errno.ENOSPC, '')), '/x'); "
    code += "print(f'clsplat: error: {error}'); exit(1)"
    task = JobTask("a", (sys.executable, "-c", code), lambda: False)
    message = "/x: cannot be written: the disk is full; no worker is left for a; the same command goes on when that"
    refuses(message, run_tasks, [task], LocalEngine(1), tmp_path / "jobs", error=ClsplatError)
    assert (tmp_path / "jobs" / "a.log").read_text().count("--- ") == 1


def test_wrong_tasks_are_refused(tmp_path: Path) -> None:
    def task(name: str, *after: str) -> JobTask:
        return JobTask(name, ("x",), lambda: False, after)

    for tasks, message in (
        ([task("a"), task("a")], "two have the same name"),
        ([task("a/b")], "expected a name of letters"),
        ([task("mark")], "expected a name of letters"),
        ([task("a", "b")], "is after b, which is not a task"),
        (
            [task("a", "b"), task("b", "a")],
            "task a: waits for a task that waits for itself, expected tasks in an order",
        ),
        ([task("a", "b"), task("b", "c"), task("c", "b")], "task a: waits for a task that waits for itself"),
    ):
        refuses(message, check_tasks, tasks, error=ValueError)
    refuses("workers 0", LocalEngine, 0, error=ValueError)


def test_the_last_line_of_a_log(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    assert last_line(log) == ""
    log.write_bytes(b"")
    assert last_line(log) == ""
    log.write_bytes(b"x" * 9000 + b"\nclsplat: error: it is \xff so\n\n  \n")
    assert last_line(log) == "it is \ufffd so"


@pytest.mark.parametrize("ahead", [3600, -3600])
def test_claims_by_the_clock_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ahead: int) -> None:
    """A machine whose clock is an hour off takes over what another machine left, and not what it has just claimed."""
    from clsplat.files import atomic, locks

    for module in (atomic, locks):
        monkeypatch.setattr(module, "machine_mark", lambda: "0000")
    assert claim(tmp_path / "a") is not None
    for module in (atomic, locks):
        monkeypatch.setattr(module, "machine_mark", lambda: "ffff")
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + ahead)
    assert claim(tmp_path / "a") is None
    assert [path.name for path in tmp_path.iterdir()] == [".a.clsplat-claim"]
    os.utime(tmp_path / ".a.clsplat-claim", (now() - 700,) * 2)
    assert claim(tmp_path / "a") is not None


def test_a_mark_is_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two dispatchers that write it at the same time, the second reads what the first has written."""
    link = os.link

    def other_is_first(source: Path, path: Path) -> None:
        path.write_text("other")
        link(source, path)

    monkeypatch.setattr(os, "link", other_is_first)
    assert mark_of(tmp_path) == mark_of(tmp_path) == "other"
    (tmp_path / "mark").unlink()

    def no_links(*_: object) -> None:
        raise PermissionError(errno.EPERM, "")

    monkeypatch.setattr(os, "link", no_links)
    assert len(mark_of(tmp_path)) == 32 and mark_of(tmp_path) == mark_of(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mark"]


def test_the_attempt_speaks_json(tmp_path: Path) -> None:
    from clsplat.process import module_command

    one = Attempt("a", (sys.executable, "-c", "print(1)"), str(tmp_path), (), mark_of(tmp_path))
    done = subprocess.run(
        module_command("clsplat.jobs.attempt"),
        input=json.dumps(one.document()) + "\n",
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout)["kind"] in ("ended", "lost")
