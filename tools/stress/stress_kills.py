# SPDX-License-Identifier: Apache-2.0
"""Kill trainings with SIGKILL at random times, resume them until they are finished, and compare the models' bytes.

    tools/stress/run kills [--kills 100] [--seed 0] [--scratch] [--device DEVICE] [--json]

The scene is the small one of the tests: 40 points, 8 pictures of 48x40, and two held out. A training writes a
checkpoint every second step, so that many kills interrupt the writing. A process is killed after a random time, between
its start (imports, building of kernels, reading the checkpoint) and its end. A finished training is compared with an
undisturbed one: the bytes of model.ply, and the steps in metrics.jsonl. The exit status is 1 if these differ, or if a
process fails.

--scratch: the model begins with 11,364 Gaussians, counts as a large one, and is kept in a scratch file because of
--max-host-mem 4MiB. It is compared with one that was trained without a limit.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from measuring import plain_parser, tool
from tiny import write_scene

from clsplat.errors import ClsplatError
from clsplat.runs.run import Run

ITERATIONS, CHECKPOINT_EVERY = 240, 2
SETTINGS = (
    *("--iterations", str(ITERATIONS), "--checkpoint-every", str(CHECKPOINT_EVERY)),
    *("--sh-degree", "2", "--sh-degree-every", "60", "--warmup", "20,40"),
    *("--density.start", "30", "--density.every", "20", "--density.stop", "200", "--density.max-gaussians", "300"),
    *("--density.gradient-threshold", "1e-3", "--density.opacity-reset-every", "90"),
)
LIMITED = ("--max-host-mem", "4MiB")
SCRATCH_SETTINGS = (
    *("--iterations", "60", "--checkpoint-every", str(CHECKPOINT_EVERY), "--no-report"),
    *("--sh-degree", "2", "--sh-degree-every", "1", "--warmup", "", "--density.max-gaussians", "16000"),
    *("--density.start", "10", "--density.every", "15", "--density.stop", "50", "--density.gradient-threshold", "4e-3"),
)
WIDE_TRAINING = """
import sys
sys.path[:0] = sys.argv.pop(1).split(":")
import pytest
import wide
patch = pytest.MonkeyPatch()
wide.let_small_models_have_chunks(patch)
wide.start_wide(patch, around=False)
from clsplat.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
WHILE_WRITING = 0.4
"""Fraction of the kills that wait until the next checkpoint is being written. Writing takes little of the time."""
DEADLINE = 1200.0
"""Maximum seconds of a process, even on a busy machine."""


@dataclass
class Figures:
    """Figures of all kills.

    kills: number of killed processes.
    writing: number of those that left a half-written file.
    before: number of those that were killed before the run had a checkpoint.
    compared: number of finished trainings.
    seconds: duration of the whole test.
    """

    kills: int = 0
    writing: int = 0
    before: int = 0
    compared: int = 0
    seconds: float = 0.0


def half_written(run: Path) -> set[str]:
    """Names of the run's half-written checkpoints."""
    folder = run / "checkpoints"
    return {entry.name for entry in os.scandir(folder) if entry.name.startswith(".")} if folder.is_dir() else set()


def end_of(process: subprocess.Popen[str]) -> str:
    """Wait until the training is finished. Returns what it printed on standard error. Raises ClsplatError if the
    training fails or hangs."""
    try:
        _, said = process.communicate(timeout=DEADLINE)
    except subprocess.TimeoutExpired as error:
        raise ClsplatError(str(error)) from None
    if process.returncode != 0:
        raise ClsplatError(f"a training ended with status {process.returncode}: {tail(said)}")
    return said


def tail(said: str) -> str:
    """The end of what a process printed, in one line."""
    return " ".join(said.split())[-400:]


class Killer:
    """Kills trainings at random times.

    start: function that starts a training in a folder, or resumes the one there.
    compare: function that raises ClsplatError if a finished training is not as expected.
    lifetime: seconds of a training that is not killed.
    """

    def __init__(
        self,
        start: Callable[[Path], subprocess.Popen[str]],
        compare: Callable[[Path], None],
        lifetime: float,
        seed: int,
    ) -> None:
        self._start, self._compare, self._lifetime = start, compare, lifetime
        self._random, self.figures = random.Random(seed), Figures()

    def kill_once(self, run: Path) -> bool:
        """Start or resume the run's training, and kill it at a random time. Returns False if it finished before."""
        before = half_written(run)
        process = self._start(run)
        try:
            # Most kills come at any time; a fifth come in the first quarter, in which the process starts.
            wait = self._lifetime * self._random.uniform(0.0, 0.25 if self._random.random() < 0.2 else 0.9)
            process.wait(timeout=wait)
        except subprocess.TimeoutExpired:
            end = time.monotonic() + 10.0
            if self._random.random() < WHILE_WRITING:
                while time.monotonic() < end and process.poll() is None and not half_written(run) - before:
                    pass
                time.sleep(self._random.uniform(0, 1e-3))
            process.kill()
            process.communicate(timeout=DEADLINE)
            if process.returncode == 0:  # it finished while this process waited for a checkpoint
                return False
            self.figures.kills += 1
            self.figures.writing += bool(half_written(run) - before)
            self.figures.before += not list(run.glob("checkpoints/step-*.npz"))
            return True
        end_of(process)
        return False

    def survive(self, run: Path, count: int) -> Figures:
        """Kill `count` times. Every finished training is compared; the last one is finished at the end."""
        start = time.monotonic()
        while self.figures.kills < count:
            if not self.kill_once(run):
                self._finished(run)
                shutil.rmtree(run)
            print(f"{self.figures.kills} kills, {self.figures.compared} trainings", file=sys.stderr, flush=True)
        if run.exists():
            end_of(self._start(run))
            self._finished(run)
        self.figures.seconds = time.monotonic() - start
        return self.figures

    def _finished(self, run: Path) -> None:
        try:
            self._compare(run)
        except ClsplatError as error:
            raise ClsplatError(f"after {self.figures.kills} kills: {error}") from None
        self.figures.compared += 1


class Kills:
    """Trainings of one scene in one folder."""

    def __init__(self, folder: Path, device: str | None, *, scratch: bool) -> None:
        self.folder, self.scratch = folder, scratch
        self.more = ("--device", device) if device else ()
        self.scene = write_scene(folder / "scene")
        self.whole = folder / "whole"
        end_of(self.start(folder / "first"))  # builds the kernels
        start = time.monotonic()
        end_of(self.start(self.whole))
        self.lifetime = time.monotonic() - start
        self.model = (self.whole / "model.ply").read_bytes()
        self.steps = self.steps_of(self.whole)

    def start(self, run: Path) -> subprocess.Popen[str]:
        """Start a training, or resume it if the run exists."""
        child = ["-c", WIDE_TRAINING, ":".join(sys.path[:4])] if self.scratch else ["-m", "clsplat"]
        command = [sys.executable, *child, "train", "-o", str(run), *self.more]
        command += LIMITED if self.scratch and run != self.whole else ()
        settings = SCRATCH_SETTINGS if self.scratch else SETTINGS
        command += ["--resume"] if (run / "config.toml").exists() else [str(self.scene), *settings]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    @staticmethod
    def steps_of(run: Path) -> list[int]:
        """The steps in metrics.jsonl."""
        return [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()]

    def compare(self, run: Path) -> None:
        """Raise ClsplatError if a finished run differs from the undisturbed one."""
        if (run / "model.ply").read_bytes() != self.model:
            raise ClsplatError(f"{run}/model.ply: has other bytes than that of the undisturbed run, expected the same")
        if (steps := self.steps_of(run)) != self.steps:
            raise ClsplatError(f"{run}/metrics.jsonl: has the steps {steps}, expected {self.steps}")
        if left := list(run.rglob(".*.clsplat-tmp")):
            raise ClsplatError(f"{left[0]}: is a half-written file, expected none after the training's end")
        named = {manifest.path for _, manifest in Run.open(run).manifests()}
        if named != set(run.absolute().glob("scratch/*")) or bool(named) != (self.scratch and run != self.whole):
            raise ClsplatError(f"{run}/scratch: expected only the files that checkpoints name, {named}")

    def survive(self, count: int, seed: int) -> Figures:
        """Kill `count` times (`Killer.survive`)."""
        return Killer(self.start, self.compare, self.lifetime, seed).survive(self.folder / "run", count)


@tool("stress_kills")
def main(arguments: Sequence[str]) -> int:
    """Run the test and print its figures."""
    parser = plain_parser(__doc__)
    parser.add_argument("--kills", metavar="N", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scratch", action="store_true")
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    if options.kills < 1:
        parser.error(f"--kills {options.kills}: expected at least 1")
    with tempfile.TemporaryDirectory(prefix="clsplat-kills-") as folder:
        kills = Kills(Path(folder), options.device, scratch=options.scratch)
        figures = kills.survive(options.kills, options.seed)
    if options.json:
        print(json.dumps(asdict(figures), indent=2))
        return 0
    print(
        f"{figures.kills} kills survived in {figures.seconds:.0f} s: {figures.writing} while a file was being written, "
        f"{figures.before} before the first checkpoint; {figures.compared} trainings finished, each with the bytes "
        "of an undisturbed one"
    )
    return 0
