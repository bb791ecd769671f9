# SPDX-License-Identifier: Apache-2.0
"""Frames on a Dask cluster of this machine, with workers that are killed; and the templates in docs/farm."""

from __future__ import annotations

import ast
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from calls import Capture, error_line, left_behind
from needs import openjd_path, require
from rendered import camera_file, contents
from systems import posix
from tiny import HEIGHT, WIDTH, cameras, hidden_model

from clsplat.cli.main import main
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.errors import InputError
from clsplat.files.documents import digest
from clsplat.jobs import dask_cluster
from clsplat.sequence import farm
from clsplat.sequence.finished_frames import stamp
from clsplat.sequence.shot_tasks import make_tasks
from clsplat.sequence.task import RenderOptions
from clsplat.shots.shot import Shot, numbered

ROOT = Path(__file__).resolve().parents[2]
TEMPLATE = ROOT / "docs" / "farm" / "clsplat-render.openjd.yaml"
COUNT = 60


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A model and cameras that move, as arguments of render: COUNT frames."""
    folder = tmp_path_factory.mktemp("shot")
    hidden_model().save(folder / "model.ply")
    return [str(folder / "model.ply"), "--cameras", str(camera_file(folder / "cameras.json", {1: -1, COUNT: 1}))]


@pytest.fixture(scope="module")
def whole(shot: list[str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The shot as one process renders it."""
    folder = tmp_path_factory.mktemp("whole")
    assert render(shot, folder) == 0
    return contents(folder)


def render(shot: list[str], folder: Path, *more: str) -> int:
    flags = ["--channels", "rgb,alpha,depth", "--exr", "half"]
    return main(["render", *shot, "-o", str(folder / "a.####.exr"), *flags, *more])


class Killer(threading.Thread):
    """Kills a worker of the local cluster when half of the frames are there."""

    def __init__(self, folder: Path) -> None:
        super().__init__(daemon=True)
        self.folder, self.victim, self.ended = folder, 0, threading.Event()

    def run(self) -> None:
        while not self.ended.wait(0.005):
            if self.folder.is_dir() and sum(path.suffix == ".exr" for path in self.folder.iterdir()) >= COUNT // 2:
                self.victim = max(workers())
                os.kill(self.victim, signal.SIGKILL)
                return


def workers() -> list[int]:
    """Processes that this one's cluster has as workers."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command = (folder / "cmdline").read_bytes()
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
        if parent == os.getpid() and b"spawn_main" in command:
            found.append(int(folder.name))
    return found


@pytest.mark.slow
@pytest.mark.needs("distributed")
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="finds the workers in /proc")
def test_a_worker_is_killed_half_way(shot: list[str], whole: dict[str, bytes], tmp_path: Path, capsys: Capture) -> None:
    killer = Killer(tmp_path)
    killer.start()
    capsys.readouterr()
    assert render(shot, tmp_path, "--workers", "2", "--json", "--progress", "json") == 0
    killer.ended.set()
    killer.join()
    assert killer.victim, "all was done before a worker could be killed"
    captured = capsys.readouterr()
    records = json.loads(captured.out)
    assert [record["frame"] for record in records] == list(range(1, COUNT + 1))
    lines = [json.loads(line) for line in captured.err.splitlines()]
    assert sorted(line["frame"] for line in lines) == list(range(1, COUNT + 1))
    assert contents(tmp_path) == whole


@pytest.mark.slow
@pytest.mark.needs("distributed")
@posix
def test_ctrl_c_of_a_terminal(shot: list[str], tmp_path: Path) -> None:
    line = [sys.executable, "-m", "clsplat", "render", *shot, "-o", str(tmp_path / "a.####.exr"), "--workers", "2"]
    line += ["--progress", "json", "--width", "1600"]  # large enough that there are frames left
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    process.stdout.readline()
    os.killpg(process.pid, signal.SIGINT)  # to the workers as well
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.splitlines()[-1].startswith("clsplat: interrupted after ")
    assert "Traceback" not in err  # a compiler of kernels that is stopped may say so
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".exr"]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    require("distributed")
    import distributed

    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, host="127.0.0.1", protocol="tcp://"
    ) as made:
        yield made


def test_an_existing_cluster(shot: list[str], whole: dict[str, bytes], cluster: Any, tmp_path: Path) -> None:
    left_behind(tmp_path / "a.0005.exr")
    assert render(shot, tmp_path, "--scheduler", cluster.scheduler_address, "--frames", "1-9") == 0
    (tmp_path / "a.0004.exr").unlink()
    assert render(shot, tmp_path, "--scheduler", cluster.scheduler_address, "--frames", "1-9", "--skip-existing") == 0
    assert contents(tmp_path) == {name: data for name, data in whole.items() if name < "a.0010"}


def test_a_frame_that_fails_ends_the_job(
    shot: list[str], cluster: Any, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = ["--scheduler", cluster.scheduler_address, "--max-device-mem", "10KiB", "--frames", "1-3"]
    assert render(shot, tmp_path, *line) == 1
    assert "40 Gaussians at this size of image need at least about" in error_line(capsys)
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".exr"]


@pytest.mark.needs("distributed")
def test_no_scheduler(shot: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_cluster, "SCHEDULER_TIMEOUT_SECONDS", 1)
    assert render(shot, tmp_path, "--scheduler", "tcp://127.0.0.1:9") == 2
    assert "--scheduler tcp://127.0.0.1:9: no scheduler answers there" in error_line(capsys)
    assert render(shot, tmp_path, "--scheduler", "nonsense://x") == 2
    assert "--scheduler nonsense://x: no scheduler answers there" in error_line(capsys)


@pytest.mark.needs("distributed")
@pytest.mark.slow
def test_a_scheduler_without_workers(
    shot: list[str], whole: dict[str, bytes], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is said at once and again, until a worker comes, who does the work."""
    import distributed

    monkeypatch.setattr(dask_cluster, "NO_WORKERS_WARNING_SECONDS", 1.0)
    with distributed.LocalCluster(n_workers=0, processes=True, dashboard_address=None) as empty:
        come = threading.Timer(4.0, lambda: empty.scale(1))
        come.start()
        try:
            assert render(shot, tmp_path, "--scheduler", empty.scheduler_address, "--frames", "1-3") == 0
        finally:
            come.cancel()
    lines = [line for line in capsys.readouterr().err.splitlines() if "has no workers" in line]
    assert len(lines) >= 2
    assert f"--scheduler {empty.scheduler_address}: has no workers; frames wait until one connects" in lines[0]
    assert all("for " in line for line in lines[1:])
    assert contents(tmp_path) == {name: data for name, data in whole.items() if name < "a.0004"}


def test_without_the_extra(shot: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert render(shot, tmp_path, "--workers", "1") == 2
    assert "--workers: needs the package distributed, install it with: pip install 'clsplat[farm]'" in error_line(
        capsys
    )


def job_of(shot: list[str]) -> farm.WorkerJob:
    return farm.WorkerJob(shot[0], digest(shot[0]), RenderOptions(), RasterizerConfig())


def record_of(result: farm.Result | farm.Failure) -> farm.Record:
    assert not isinstance(result, farm.Failure), result.message
    record, planes = result
    assert planes is None  # no video
    return record


def test_what_a_worker_does(shot: list[str], tmp_path: Path) -> None:
    path = Shot(numbered(cameras()))
    (task,) = make_tasks(path.only("3"), path, str(tmp_path / "#.exr"), lambda camera: camera, ("rgb",))
    job = job_of(shot)
    record = record_of(farm.render_frame(task, job))
    assert record.seconds > 0
    first = stamp(task.path)
    # another worker finished the frame and was lost before it could say so
    assert record_of(farm.render_frame(task, job)) == replace(record, seconds=0.0, blank=None)
    assert stamp(task.path) == first
    # what was there before the job is rendered again
    again = record_of(farm.render_frame(replace(task, before=first), job))
    assert again.seconds > 0
    assert stamp(task.path) != first
    renderer = farm._WORKER_RENDERER.renderer
    farm.render_frame(replace(task, before=stamp(task.path)), job)
    assert farm._WORKER_RENDERER.renderer is renderer, "the model is loaded once"
    task = replace(task, before=stamp(task.path))
    for wrong, message in [
        (replace(job, digest="0" * 64), "on a worker, expected 000000000000"),
        (replace(job, version="0.0"), "a worker has clsplat "),
        (replace(job, model="/nowhere.ply"), "/nowhere.ply: no such file"),
    ]:
        found = farm.render_frame(task, wrong)
        assert isinstance(found, farm.Failure)
        assert found.wrong_input
        assert message in found.message
    with pytest.raises(ValueError, match="channels is empty"):
        farm.render_on_farm([task], replace(job, options=RenderOptions(())), print, workers=1)


def test_a_frame_whose_workers_are_always_lost(shot: list[str], tmp_path: Path, monkeypatch: Any) -> None:
    require("distributed")
    import distributed

    class Future:
        key = "clsplat-abc-7"

        def result(self) -> None:
            raise self.error

        def __init__(self, error: Exception) -> None:
            self.error = error

    class Client:
        def nthreads(self) -> dict[str, int]:
            return {"a": 1}

        def as_current(self) -> Any:
            return nullcontext()

        def submit(self, *_: Any, **__: Any) -> Any:
            return None

    path = Shot(numbered(cameras()))
    tasks = make_tasks(path, path, str(tmp_path / "#.exr"), lambda camera: camera, ("rgb",))
    killed = distributed.KilledWorker("clsplat-abc-7", None, 3)
    for error, message in (
        (killed, "frame 7: every worker that rendered it"),
        (OSError(), "scheduler was lost"),
    ):
        monkeypatch.setattr(distributed, "as_completed", lambda _, error=error: iter([Future(error)]))
        with pytest.raises(farm.ClsplatError, match=message) as caught:
            list(farm._results(Client(), tasks, job_of(shot)))
        assert not isinstance(caught.value, InputError)


@pytest.fixture
def openjd() -> str:
    require("openjd")
    return str(openjd_path())


@pytest.mark.slow
@posix
def test_the_open_job_description_runs(openjd: str, shot: list[str], whole: dict[str, bytes], tmp_path: Path) -> None:
    checked = subprocess.run([openjd, "check", str(TEMPLATE)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    command = tmp_path / "clsplat"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m clsplat "$@" --exr half\n')
    command.chmod(0o755)
    values = {
        "Model": shot[0],
        "Cameras": shot[2],
        "OutputFolder": str(tmp_path / "out"),
        "Pattern": "a.####.exr",
        "Frames": "1-5,8-12:2",
        "FramesPerTask": "3",
        "Channels": "rgb,alpha,depth",
        "Width": str(WIDTH),
        "Height": str(HEIGHT),
        "Clsplat": str(command),
    }
    line = [openjd, "run", str(TEMPLATE), "--step", "Render", "--run-dependencies"]
    line += [word for name, value in values.items() for word in ("-p", f"{name}={value}")]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    wanted = [1, 2, 3, 4, 5, 8, 10, 12]
    assert contents(tmp_path / "out") == {name: whole[name] for name in (f"a.{n:04d}.exr" for n in wanted)}
    assert done.stdout.count("openjd_progress: 100.0") == 3


def test_the_opencue_example_calls_render_as_it_is() -> None:
    from clsplat.cli.main import parse
    from clsplat.cli.render.flags import RenderVerb

    tree = ast.parse((ROOT / "docs" / "farm" / "opencue_render.py").read_text())
    values = [
        node.value for node in ast.walk(tree) if isinstance(node, ast.Assign | ast.AugAssign) and _is_command(node)
    ]
    names = {"model": "m.ply", "cameras": "c.json", "pattern": "a.####.exr"}
    words = [
        names[each.id] if isinstance(each, ast.Name) else ast.literal_eval(each) for v in values for each in v.elts
    ]  # type: ignore[attr-defined]
    assert words[0] == "clsplat"
    verb = parse([word.replace("#FRAMESPEC#", "1-3,7") for word in words[1:]])
    assert isinstance(verb, RenderVerb)
    assert (verb.frames, verb.skip_existing, verb.progress) == ("1-3,7", True, "json")


def _is_command(node: ast.Assign | ast.AugAssign) -> bool:
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    return isinstance(target, ast.Name) and target.id == "command"
