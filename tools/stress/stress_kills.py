# SPDX-License-Identifier: Apache-2.0
"""Kill trainings with SIGKILL at random times, resume them until they are finished, and compare the models' bytes.

    tools/stress/run kills [--kills 100] [--seed 0] [--scratch] [--device DEVICE] [--json]

The scene is the small one of the tests: 40 points, 8 pictures of 48x40, and two held out. A training writes a
checkpoint every second step, so that many kills interrupt the writing. A process is killed after a random time, between
its start (imports, building of kernels, reading the checkpoint) and its end. A finished training is compared with an
undisturbed one: the bytes of model.ply, and the steps in metrics.jsonl. The exit status is 1 if these differ, or if a
process fails.

--scratch: the model begins with 11,364 Gaussians, counts as a large one, and is in a scratch file under --max-host-mem
4MiB. It is compared with one that was trained without a limit.
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
from collections.abc import Sequence
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
DEADLINE = 300.0
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


class Kills:
    """Trainings of one scene in one folder."""

    def __init__(self, folder: Path, device: str | None, seed: int, *, scratch: bool) -> None:
        self.folder, self.random, self.figures, self.scratch = folder, random.Random(seed), Figures(), scratch
        self.more = ("--device", device) if device else ()
        self.scene = write_scene(folder / "scene")
        self.whole = folder / "whole"
        self.end_of(self.start(folder / "first"))  # builds the kernels
        start = time.monotonic()
        self.end_of(self.start(self.whole))
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

    def end_of(self, process: subprocess.Popen[str]) -> None:
        """Wait until the training is finished. Raises ClsplatError with its last output if it fails or hangs."""
        try:
            _, said = process.communicate(timeout=DEADLINE)
        except subprocess.TimeoutExpired as error:
            raise ClsplatError(str(error)) from None
        if process.returncode != 0:
            raise ClsplatError(f"a training ended with status {process.returncode}: {said.strip()[-400:]}")

    @staticmethod
    def steps_of(run: Path) -> list[int]:
        """The steps in metrics.jsonl."""
        return [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()]

    def kill_once(self, run: Path) -> bool:
        """Start or resume the run's training, and kill it at a random time. Returns False if it finished before."""
        before = half_written(run)
        process = self.start(run)
        try:
            # Most kills come at any time; a fifth come in the first quarter, in which the process starts.
            wait = self.lifetime * self.random.uniform(0.0, 0.25 if self.random.random() < 0.2 else 0.9)
            process.wait(timeout=wait)
        except subprocess.TimeoutExpired:
            end = time.monotonic() + 10.0
            if self.random.random() < WHILE_WRITING:
                while time.monotonic() < end and process.poll() is None and not half_written(run) - before:
                    pass
                time.sleep(self.random.uniform(0, 1e-3))
            process.kill()
            process.communicate(timeout=DEADLINE)
            if process.returncode == 0:  # it finished while this process waited for a checkpoint
                return False
            self.figures.kills += 1
            self.figures.writing += bool(half_written(run) - before)
            self.figures.before += not list(run.glob("checkpoints/step-*.npz"))
            return True
        self.end_of(process)
        return False

    def compare(self, run: Path) -> None:
        """Raise ClsplatError if a finished run differs from the undisturbed one."""
        if (run / "model.ply").read_bytes() != self.model:
            raise ClsplatError(f"after {self.figures.kills} kills model.ply differs")
        if (steps := self.steps_of(run)) != self.steps:
            raise ClsplatError(f"after {self.figures.kills} kills metrics.jsonl has the steps {steps}")
        if left := list(run.rglob(".*.clsplat-tmp")):
            raise ClsplatError(f"a half-written file has stayed: {left[0].name}")
        named = {manifest.path for _, manifest in Run.open(run).manifests()}
        if named != set(run.absolute().glob("scratch/*")) or bool(named) != (self.scratch and run != self.whole):
            raise ClsplatError(f"{run}/scratch: has not the files that checkpoints name, {named}")
        self.figures.compared += 1

    def survive(self, count: int) -> Figures:
        """Kill `count` times. Every finished training is compared; the last one is finished at the end."""
        start, run = time.monotonic(), self.folder / "run"
        while self.figures.kills < count:
            if not self.kill_once(run):
                self.compare(run)
                shutil.rmtree(run)
            print(f"{self.figures.kills} kills, {self.figures.compared} trainings", file=sys.stderr, flush=True)
        if run.exists():
            self.end_of(self.start(run))
            self.compare(run)
        self.figures.seconds = time.monotonic() - start
        return self.figures


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
        figures = Kills(Path(folder), options.device, options.seed, scratch=options.scratch).survive(options.kills)
    if options.json:
        print(json.dumps(asdict(figures), indent=2))
        return 0
    print(
        f"{figures.kills} kills survived in {figures.seconds:.0f} s: {figures.writing} while a file was being written, "
        f"{figures.before} before the first checkpoint; {figures.compared} trainings finished, each with the bytes "
        "of an undisturbed one"
    )
    return 0
