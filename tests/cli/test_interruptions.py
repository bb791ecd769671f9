# SPDX-License-Identifier: Apache-2.0
"""Signals in the middle of a training, and two processes in one run folder."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from calls import Capture, error_line, printed, python, raising, refuses, rejected
from quick import quick
from tiny import short, write_scene

from clsplat import process
from clsplat.api import train
from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.runs import locks
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
posix = pytest.mark.skipif(os.name != "posix", reason="sends signals as POSIX has them")

HOLDER = """
import sys, time
from pathlib import Path
from clsplat.runs.locks import locked
with locked(Path(sys.argv[1]), "train"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("tiny") / "scene"))


@contextmanager
def holder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the folder locked."""
    other = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        yield other
    finally:
        other.kill()
        other.wait()
        other.stdout.close()


# Signals


def signalled(views: Scene, device: Device, folder: Path, *numbers: int) -> tuple[Run, BaseException]:
    """A run to which these signals come before its fifth step, and how it ended."""
    config = short(iterations=9, report=False, density={"every": 0})
    run = Run.create(folder, config)

    def ask(trainer: Trainer, _interrupted: object) -> None:
        for number in numbers if trainer.step == 4 else ():
            signal.raise_signal(number)

    with process.terminable(), pytest.raises(KeyboardInterrupt) as caught:
        train(views, config, device=device, run=run, between=ask)
    return run, caught.value


@posix
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_writes_a_checkpoint_first(
    number: signal.Signals, views: Scene, default_device: Device, tmp_path: Path
) -> None:
    before = signal.getsignal(number)
    run, end = signalled(views, default_device, tmp_path / "run", number)
    assert process.status_of(end) == 128 + number
    assert signal.getsignal(number) == before
    assert [step for step, _ in run.checkpoints()] == [5], "the step that was begun is finished"
    assert not (run.path / locks.LOCK_FILE_NAME).exists()


@posix
def test_a_second_signal_does_not_wait(views: Scene, default_device: Device, tmp_path: Path) -> None:
    run, end = signalled(views, default_device, tmp_path / "run", signal.SIGTERM, signal.SIGTERM)
    assert isinstance(end, process.Interrupted)
    assert not run.checkpoints()


@posix
def test_what_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with process.terminable():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=posix)])
def test_every_verb_ends_with_the_signals_number(number: int, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr("clsplat.cli.devices.run", lambda *_: signal.raise_signal(number))
    assert printed(capsys, ["devices"], status=128 + number).err == "clsplat: interrupted\n"


@posix
def test_a_signal_waits_where_nobody_may_be_disturbed() -> None:
    done = []
    with process.terminable(), pytest.raises(process.Interrupted) as caught:
        with process.undisturbed():
            signal.raise_signal(signal.SIGTERM)  # to this thread: another one would not have it blocked
            signal.signal(signal.SIGTERM, lambda *_: done.append("the library's"))
            done.append("the work")
        done.append("what follows")
    assert caught.value.number == signal.SIGTERM
    assert done == ["the work"]


def assert_interrupted(number: int, before: str) -> None:
    """A signal in the command line, which it comes to by the code before."""
    code = f"import os, sys\n{before}from clsplat.__main__ import main\nsys.exit(main())\n"
    done = python("-c", code, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", "clsplat: interrupted\n")


@pytest.mark.slow
@posix
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_pyopencl_is_imported(number: signal.Signals) -> None:
    """An exception that is raised in the import of its binary part aborts the process."""
    assert_interrupted(
        number,
        "def hook(event, arguments):\n"
        "    inside = event == 'object.__setattr__' and arguments[0].__module__ == 'pyopencl._cl'\n"
        "    if inside and 'sent' not in sys.__dict__:\n"
        "        sys.sent = True\n"
        f"        os.kill(os.getpid(), {int(number)})\n"
        "sys.addaudithook(hook)\n"
        "sys.argv = ['clsplat', 'devices']\n",
    )


@pytest.mark.slow
@posix
@pytest.mark.parametrize("number", quick(SIGNALS, signal.SIGINT))
def test_a_signal_while_pycolmap_is_imported(number: signal.Signals) -> None:
    """pycolmap takes a Ctrl-C for a sign that it is not installed."""
    assert_interrupted(
        number,
        "import types, importlib.abc, importlib.util\n"
        "class Slow(importlib.abc.MetaPathFinder, importlib.abc.Loader):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        return importlib.util.spec_from_loader(name, self) if name == 'pycolmap' else None\n"
        "    def create_module(self, spec): return types.ModuleType(spec.name)\n"
        "    def exec_module(self, module):\n"
        "        try:\n"
        f"            os.kill(os.getpid(), {int(number)})\n"
        "            [None for _ in range(1000)]\n"
        "        except BaseException as error: raise RuntimeError('not installed') from error\n"
        "sys.meta_path.insert(0, Slow())\n"
        "sys.argv = ['clsplat', 'train', '.', '-o', 'nowhere']\n"
        "from clsplat.cli import train\n"
        "def work(*_):\n"
        "    import clsplat.scenes.dataset\n"
        "train.run = work\n",
    )


# Two processes


def test_the_second_process_is_told_of_the_first(tmp_path: Path) -> None:
    with holder(tmp_path) as other, pytest.raises(InputError) as caught, locks.locked(tmp_path, "eval"):
        pass
    assert str(caught.value) == (
        f"{tmp_path}: is being written by clsplat train (process {other.pid}); wait until that process has ended, or "
        "choose another folder"
    )


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    with holder(tmp_path):
        pass
    assert (tmp_path / locks.LOCK_FILE_NAME).exists(), "its file is there, and nobody has it locked"
    with locks.locked(tmp_path, "eval"), locks.locked(tmp_path, "report"):
        assert json.loads((tmp_path / locks.LOCK_FILE_NAME).read_text())["verb"] == "eval"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flag", ["", "--resume", "--overwrite", "new"])
def test_a_second_training_changes_nothing(flag: str, tmp_path: Path, capsys: Capture) -> None:
    run = tmp_path / "run"
    run.mkdir()
    if flag != "new":
        Run.create(run, TrainConfig())
    files = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with holder(run) as other:
        assert main(["train", str(tmp_path), "-o", str(run), *([flag] if flag.startswith("--") else [])]) == 2
        assert f"is being written by clsplat train (process {other.pid})" in error_line(capsys)
        left = {
            path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != locks.LOCK_FILE_NAME
        }
    assert left == files


@pytest.mark.parametrize("verb", ["eval", "report"])
def test_verbs_that_write_into_a_run_are_kept_out(verb: str, tmp_path: Path, capsys: Capture) -> None:
    run = Run.create(tmp_path / "run", TrainConfig(), scene=tmp_path)
    with holder(run.path):
        assert "is being written by clsplat train" in rejected(capsys, [verb, run.path])
        refuses("is being written", Run.create, run.path, TrainConfig(), overwrite=True)
        assert main(["report", str(run.path), "-o", str(tmp_path / "a.html")]) == 0, "readers come in"


def test_a_file_system_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import errno

    monkeypatch.setattr(locks, "try_lock", raising(OSError(errno.ENOLCK, "No locks available")))
    with pytest.warns(UserWarning, match="on a file system without locks"), locks.locked(tmp_path, "train"):
        pass


@pytest.mark.slow
@posix
def test_the_tool_makes_tables() -> None:
    tool = Path(__file__).parents[2] / "tools" / "stress" / "interruptions.py"
    calls = ["--verbs", "train,info", "--events", "SIGTERM,second process"]
    done = python(tool, "--markdown", *calls, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "| `info` | 143 | `clsplat: interrupted` | - |" in done.stdout
    assert "| `train` | 2 | `clsplat: error: OUT/run: is being written by clsplat train (process 123)" in done.stdout


def test_threads_have_no_say_in_signals() -> None:
    done = []

    def work() -> None:
        with process.terminable():
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done
