# SPDX-License-Identifier: Apache-2.0
"""Tasks on a Dask cluster of processes: workers and schedulers that are killed, and workers that are left out."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import dispatching
import pytest
from calls import refuses
from counting import counted, counting_task
from dask_processes import DaskProcesses, dask_processes
from needs import require
from systems import alive, posix

from clsplat.errors import ClsplatError
from clsplat.jobs import attempt, dask_engine, dispatcher
from clsplat.jobs.attempt_process import AttemptProcess
from clsplat.jobs.dispatcher import JobProgress, run_tasks
from clsplat.jobs.task import Attempt, JobTask, Outcome, mark_of

pytestmark = [pytest.mark.slow, pytest.mark.needs("distributed"), posix]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RETRY_SECONDS", "CLAIM_CHECK_SECONDS", "PROGRESS_SECONDS"):
        monkeypatch.setattr(dispatcher, name, 0.05)
    monkeypatch.setattr(dask_engine, "WORKERS_SECONDS", 0.05)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr(dispatcher, "warn", lines.append)
    return lines


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[DaskProcesses]:
    require("distributed")
    (tmp_path / "dask").mkdir()
    with dask_processes(tmp_path / "dask", "a", "b") as processes:
        yield processes


def wait_for_workers(cluster: DaskProcesses, count: int) -> None:
    with dask_engine.dask_client(cluster.address) as client:
        client.wait_for_workers(count, timeout=60)


def test_workers_that_are_killed(tmp_path: Path, cluster: DaskProcesses, told: list[str]) -> None:
    """With SIGKILL: the command ends with its worker, the task goes on elsewhere, and nothing counts twice."""
    tasks = [counting_task(tmp_path, str(number), 60, seconds=0.02) for number in range(4)]
    pids: list[int] = []

    def kill(progress: JobProgress) -> None:
        if progress.steps > 30 and not pids:
            pids.extend(int((tmp_path / f"{name}.pid").read_text()) for name in progress.running)
            cluster.kill("a")

    wait_for_workers(cluster, 2)
    with dask_engine.dask_engine(cluster.address) as engine:
        run_tasks(tasks, engine, tmp_path / "jobs", kill)
    assert pids and [counted(tmp_path, task.name) for task in tasks] == [60] * 4
    assert told == []
    begun = [path.read_text().count("--- ") for path in (tmp_path / "jobs").glob("*.log")]
    assert sum(begun) == 5, "one task was begun again"


def test_a_scheduler_that_is_killed(tmp_path: Path, cluster: DaskProcesses, capfd: pytest.CaptureFixture[str]) -> None:
    """One line; the commands end with their workers; the same tasks go on with a new scheduler."""
    tasks = [counting_task(tmp_path, str(number), 100, seconds=0.02) for number in range(2)]
    kills: list[str] = []

    def kill(progress: JobProgress) -> None:
        if progress.steps > 30 and not kills:
            kills.append("scheduler")
            cluster.kill("scheduler")

    def run() -> None:
        with dask_engine.dask_engine(cluster.address) as engine:
            run_tasks(tasks, engine, tmp_path / "jobs", kill)

    message = "the scheduler was lost; what is done stays, and the same command goes on when a scheduler runs again"
    refuses(f"--scheduler {cluster.address}: {message}", run, error=ClsplatError)
    assert "Traceback" not in capfd.readouterr().err
    pids = [int((tmp_path / f"{task.name}.pid").read_text()) for task in tasks]
    until = time.monotonic() + 60
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.05)
    before = [counted(tmp_path, task.name) for task in tasks]
    assert sum(before) > 30
    cluster.start_scheduler()
    cluster.start_worker("c")
    run()
    assert [counted(tmp_path, task.name) for task in tasks] == [100] * 2


def test_workers_that_are_left_out(
    tmp_path: Path, cluster: DaskProcesses, told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker whose disk is full, or that has another version: one line each, and the others do its tasks."""
    code = "import sys; from clsplat.errors import WriteError; "
    code += "error = WriteError(28, 'the disk is full', '/scratch/x'); print(f'clsplat: error: {error}'); sys.exit(1)"
    words = tuple(counting_task(tmp_path, "0", 3).command)
    script = tmp_path / "task.py"
    script.write_text(f"import os, subprocess, sys\nif os.environ.get('DISK_IS_FULL'):\n    {code}\n")
    with script.open("a") as file:
        file.write("sys.exit(subprocess.call([sys.executable, *sys.argv[1:]]))\n")
    cluster.start_worker("full", environment={"DISK_IS_FULL": "1"})
    wait_for_workers(cluster, 3)

    def task(number: int) -> JobTask:
        one = counting_task(tmp_path, str(number), 3)
        return JobTask(one.name, (words[0], str(script), *one.command[1:]), one.is_done, (), one.progress, 3)

    tasks = [task(number) for number in range(4)]
    with dask_engine.dask_engine(cluster.address) as engine:
        run_tasks(tasks, engine, tmp_path / "jobs")
    assert all(task.is_done() for task in tasks)
    assert len(told) == 1
    assert "/scratch/x: cannot be written: the disk is full; it is left out, and " in told[0]
    assert told[0].startswith("worker tcp://127.0.0.1:")


def test_a_worker_without_this_package(tmp_path: Path, cluster: DaskProcesses, told: list[str]) -> None:
    """As of an earlier version: it is left out, with what it says."""
    earlier = tmp_path / "earlier" / "clsplat"
    earlier.mkdir(parents=True)
    (earlier / "__init__.py").touch()
    cluster.start_worker("earlier", environment={"PYTHONPATH": str(earlier.parent)})
    wait_for_workers(cluster, 3)
    tasks = [counting_task(tmp_path, str(number), 3) for number in range(4)]
    with dask_engine.dask_engine(cluster.address) as engine:
        run_tasks(tasks, engine, tmp_path / "jobs")
    assert all(task.is_done() for task in tasks)
    assert len(told) == 1 and "has no clsplat of this version: " in told[0]


def test_no_worker_sees_the_scene(tmp_path: Path, cluster: DaskProcesses, told: list[str]) -> None:
    """One line for each worker, and the end."""
    wait_for_workers(cluster, 2)
    tasks = [counting_task(tmp_path, str(number), 3) for number in range(2)]

    def run() -> None:
        with dask_engine.dask_engine(cluster.address) as engine:
            run_tasks(tasks, engine, tmp_path / "jobs", needs=[Path("/no/scene")])

    refuses(
        "does not see /no/scene, expected the same paths as on the dispatcher's machine; no worker is left for ",
        run,
        error=ClsplatError,
    )
    assert len(told) == 1 and "does not see /no/scene" in told[0]


def test_workers_with_gpus(tmp_path: Path, cluster: DaskProcesses) -> None:
    """If some workers declare the resource, only they get tasks."""
    cluster.start_worker("gpu", "--resources", "GPU=1")
    wait_for_workers(cluster, 3)
    tasks = [counting_task(tmp_path, str(number), 2, seconds=0.05) for number in range(4)]
    most = 0
    with dask_engine.dask_engine(cluster.address) as engine:

        def note(progress: JobProgress) -> None:
            nonlocal most
            most = max(most, len(progress.running))

        run_tasks(tasks, engine, tmp_path / "jobs", note)
    assert most == 1 and all(task.is_done() for task in tasks)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_the_end_of_the_dispatcher(tmp_path: Path, cluster: DaskProcesses, number: signal.Signals) -> None:
    """Ctrl-C ends the commands on all workers. After SIGKILL they go on, and the next dispatcher waits for them."""
    wait_for_workers(cluster, 2)
    words = [sys.executable, dispatching.__file__, str(tmp_path), "--scheduler", cluster.address]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    while not all((tmp_path / f"{name}.pid").exists() and counted(tmp_path, name) > 3 for name in "01"):
        time.sleep(0.01)
    process.send_signal(number)
    out, _ = process.communicate(timeout=60)
    if number == signal.SIGINT:
        assert out == "interrupted after 0 of 3 tasks; the same command goes on\n"
        assert not any(alive(int((tmp_path / f"{name}.pid").read_text())) for name in "01")
        assert not any(counted(tmp_path, name) == 100 for name in "01")
    tasks = [counting_task(tmp_path, name, 100, seconds=0.02) for name in "01"]
    with dask_engine.dask_engine(cluster.address) as engine:
        run_tasks(tasks, engine, tmp_path / "jobs")
    assert [counted(tmp_path, name) for name in "01"] == [100] * 2


def test_what_a_worker_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To an attempt of a later version with another field, and to one that it may not run."""
    one: dict[str, Any] = Attempt("a", ("clsplat",), str(tmp_path), (), mark_of(tmp_path), "9.9").document()
    assert "another version of clsplat than 9.9" in dask_engine.run_on_worker("k", {**one, "new": 1})["reason"]
    found = Outcome(**dask_engine.run_on_worker("k", one))
    assert found.kind == "unfit" and "expected 9.9 like the dispatcher" in found.reason
    assert dask_engine._attempts_here == {}
    dask_engine.end_on_worker(["unknown"])


def test_the_last_good_worker_leaves() -> None:
    """The workers that stay are left out, so that nothing would ever go on."""
    workers: dict[str, dict[str, Any]] = {"tcp://a": {}, "tcp://b": {}}
    client = SimpleNamespace(status="running", scheduler_info=lambda: {"workers": workers})
    engine = dask_engine.DaskEngine(client, "tcp://s")
    assert engine.free() == 2
    assert engine.leave_out("tcp://a") and engine.free() == 1
    del workers["tcp://b"]
    engine._looked_at = float("-inf")
    refuses("--scheduler tcp://s: has no workers but those that are left out", engine.free, error=ClsplatError)


def test_a_command_that_does_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempt, "END_SECONDS", 0.2)
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('on', flush=True); time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True)
    assert process.stdout is not None
    process.stdout.readline()
    attempt.end_command(process)
    assert process.returncode == -signal.SIGKILL
    process.stdout.close()
    running = AttemptProcess(Attempt("a", ("sleep", "60"), str(tmp_path), (), mark_of(tmp_path)))
    while not (tmp_path / ".a.clsplat-claim").exists():
        time.sleep(0.01)
    running.kill()
    assert running.wait().kind == "lost"
