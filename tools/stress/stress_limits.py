# SPDX-License-Identifier: Apache-2.0
"""Train one scene at many limits of memory, on parts of a device, with a viewer and kills, and compare models' bytes.

    tools/stress/run limits [--gaussians 3e5] [--steps 90] [--views 24] [--kills 20] [--seed 0] [--only WORD,...]
        [--devices DEVICE,...]

The scene is the plain of `run large`, with a point for each Gaussian to begin with. The trainings include density
control, new SH degrees, opacity resets, warm-up sizes and checkpoints. Prints a table: the limit, the peak of anonymous
and shared memory, steps a second, and a digest of model.ply and of the losses in metrics.jsonl. Trainings on one device
with as many views a step must have the digest of the one without a limit. The exit status is 1 if a digest differs, or
if a training fails.

--devices: devices as listed by `clsplat devices`. The first one trains all rows that name no device, the others train
without a limit and at two limits. If not given: one of each driver. --only: rows of the table whose names have one of
the words, and those that they are compared with.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from measuring import number, plain_parser, tool
from plain import CELL_ROWS, SeededArray, write_scene
from stress_kills import DEADLINE, Killer, end_of, tail
from stress_large import MemoryPeak

from clsplat.config.training import TrainConfig
from clsplat.device.selection import list_devices
from clsplat.errors import ClsplatError
from clsplat.gaussians import floats_of
from clsplat.rendering.memory_needs import MODELS
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.viewer.pose import Pose
from clsplat.viewer.training_view import TrainingView

SH_DEGREE = 3
CAMERA_HEIGHT = 3.0
"""World units above the plain. A camera sees some 20 chunks, so that a view has more than the least room of a pool."""
GROWTH_PERCENT = 20
"""Most growth of the number of Gaussians, per cent."""
TOO_LITTLE = "1KiB"
"""A limit that no training keeps, so that it is told the least."""
WATCHED_TRAINING = """
import os, sys
sys.path[:0] = sys.argv.pop(1).split(os.pathsep)
import stress_limits
from clsplat.cli import view
view.training_view = stress_limits.visited(view.training_view)
from clsplat.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


@dataclass(frozen=True)
class Case:
    """A row of the table.

    like: name of the row whose bytes this one must have; its own name for a row that others are compared with.
    flags: flags of `clsplat train`.
    least: True to train with the least --max-host-mem that is enough. The error of a training with less tells it.
    watched: True to train with a viewer.
    killed: True to kill and resume the training.
    """

    name: str
    like: str
    flags: tuple[str, ...] = ()
    least: bool = False
    watched: bool = False
    killed: bool = False


@dataclass(frozen=True)
class Result:
    """Result of a row.

    digests: of the model, or of the models of several trainings; none if a training failed.
    said: further text for the table.
    """

    digests: set[str]
    said: str
    peak: str = ""
    rate: str = ""


def cases(model: int, first: str, others: Sequence[str]) -> list[Case]:
    """All rows. model: bytes of parameters and moments. first, others: devices."""
    half, quarter, eighth = (f"{model // parts >> 20}MiB" for parts in (2, 4, 8))
    whole, pair, on = "no limit", "two views a step", ("--device", first)
    parts = ("--device", f"{first}/0,{first}/1", "--batch", "2")
    found = [
        Case(whole, whole, on),
        Case("half the device's memory", whole, (*on, "--max-device-mem", half)),
        Case("a quarter of the device's memory", whole, (*on, "--max-device-mem", quarter)),
        Case("an eighth of the device's memory", whole, (*on, "--max-device-mem", eighth)),
        Case("half the main memory", whole, (*on, "--max-host-mem", half)),
        Case("a quarter of main memory", whole, (*on, "--max-host-mem", quarter)),
        Case("the least main memory", whole, on, least=True),
        Case("killed at a quarter", whole, (*on, "--max-host-mem", quarter), killed=True),
        Case("watched", whole, on, watched=True),
        Case("watched at a quarter", whole, (*on, "--max-host-mem", quarter), watched=True),
        Case(pair, pair, (*on, "--batch", "2")),
        Case("two parts", pair, parts),
        Case("two parts at half their memory", pair, (*parts, "--max-device-mem", half)),
        Case("two parts at the least", pair, parts, least=True),
        Case("two parts killed", pair, parts, killed=True),
    ]
    for device in others:
        whole, on = f"device {device}", ("--device", device)
        found += [
            Case(whole, whole, on),
            Case(f"{whole} at a quarter of its memory", whole, (*on, "--max-device-mem", quarter)),
            Case(f"{whole} at a quarter of main memory", whole, (*on, "--max-host-mem", quarter)),
        ]
    return found


def settings(count: int, steps: int) -> list[str]:
    """Flags of every training. Density control, opacity resets and the like take place within these steps."""

    def at(share: float) -> str:
        return str(max(int(share * steps), 1))

    return [
        *("--iterations", str(steps), "--points-limit", str(count), "--test-every", "0", "--no-report"),
        *("--sh-degree", str(SH_DEGREE), "--sh-degree-every", at(0.2), "--warmup", f"{at(0.1)},{at(0.3)}"),
        *("--checkpoint-every", at(0.17), "--density.start", at(0.2), "--density.every", at(0.15)),
        *("--density.stop", at(0.9), "--density.opacity-reset-every", at(0.4), "--density.opacity-reset-to", "0.1"),
        *("--density.max-gaussians", str(count + count * GROWTH_PERCENT // 100)),
    ]


def write_points(path: Path, count: int) -> None:
    """Write the means of the plain as a PLY of points in random colours."""
    points = np.zeros(count, [(axis, "<f4") for axis in "xyz"] + [(each, "u1") for each in ("red", "green", "blue")])
    places = SeededArray("means", (count, 3)).get()
    colours = np.random.default_rng(2).integers(0, 256, (count, 3))
    for axis in range(3):
        points["xyz"[axis]], points[("red", "green", "blue")[axis]] = places[:, axis], colours[:, axis]
    names = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {names[points.dtype[name].str]} {name}" for name in points.dtype.names or ()]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header", ""]
    path.write_bytes("\n".join(head).encode("ascii") + points.tobytes())


class Trainings:
    """Trainings of one scene in one folder.

    options: the command line's.
    """

    def __init__(self, folder: Path, options: Any) -> None:
        self.folder, self.options, count, cloud = folder, options, options.gaussians, folder / "points.ply"
        write_scene(folder / "scene", -(-count // CELL_ROWS), options.views, near=False, height=CAMERA_HEIGHT)
        write_points(cloud, count)
        self.common = [str(folder / "scene"), "--points", str(cloud), *settings(count, options.steps)]
        self.seconds: dict[tuple[str, ...], float] = {}
        """Durations of trainings by their flags."""

    def start(self, case: Case, run: Path, *limit: str) -> subprocess.Popen[str]:
        """Start a training, or resume it if the run exists. limit: further flags."""
        child = ["-c", WATCHED_TRAINING, os.pathsep.join(sys.path)] if case.watched else ["-m", "clsplat"]
        command = [sys.executable, *child, "train", "-o", str(run), *case.flags, *limit]
        command += ["--resume"] if (run / "config.toml").exists() else self.common
        command += ["--view", "--port", "0"] if case.watched else []
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def least(self, case: Case) -> tuple[str, ...]:
        """The flags of the least limit, if the case has it; none for other cases. Raises ClsplatError."""
        if not case.least:
            return ()
        refused = self.start(case, self.folder / "refused", "--max-host-mem", TOO_LITTLE)
        _, said = refused.communicate(timeout=DEADLINE)
        found = re.search(r"expected at least (\d+MiB)", said)
        if found is None:
            raise ClsplatError(f"--max-host-mem {TOO_LITTLE}: expected an error with the least, found {tail(said)}")
        return "--max-host-mem", found[1]

    def trained(self, case: Case, limit: tuple[str, ...]) -> Result:
        """Train a case, and return its row's result. limit: from `least`."""
        run = self.folder / "run"
        shutil.rmtree(run, ignore_errors=True)
        process, begun = self.start(case, run, *limit), time.monotonic()
        with MemoryPeak(process.pid) as peak:
            said = end_of(process)
        self.seconds[case.flags] = time.monotonic() - begun
        pictures = re.search(r"(\d+) pictures", said)
        if case.watched and (pictures is None or pictures[1] == "0"):
            raise ClsplatError(f"{case.name}: expected pictures for the viewer, found {tail(said)}")
        return Result({digest(run)}, pictures[0] if pictures else "", f"{peak.bytes / 2**20:,.0f} MiB", rate(run))

    def killed(self, case: Case) -> Result:
        """Train a case with kills at random times, and return its row's result."""
        run, digests = self.folder / "run", set[str]()
        shutil.rmtree(run, ignore_errors=True)

        def keep(finished: Path) -> None:
            digests.add(digest(finished))

        lifetime = self.seconds.get(case.flags, min(self.seconds.values()))
        killer = Killer(lambda path: self.start(case, path), keep, lifetime, self.options.seed)
        figures = killer.survive(run, self.options.kills)
        return Result(digests, f"{figures.kills} kills, {figures.writing} of them while a checkpoint was written")


def metrics(run: Path) -> list[dict[str, Any]]:
    """The records of metrics.jsonl."""
    return [json.loads(line) for line in Run.open(run).metrics_path.read_text("utf-8").splitlines()]


def digest(run: Path) -> str:
    """Digest of the model, and of losses and numbers of Gaussians on the way to it."""
    hashed = hashlib.sha256((run / "model.ply").read_bytes())
    for record in metrics(run):
        hashed.update(json.dumps([record[name] for name in ("step", "loss", "gaussians")]).encode())
    return hashed.hexdigest()[:12]


def rate(run: Path) -> str:
    """Steps a second after the first report, before which kernels are built."""
    first, *_, last = metrics(run)
    return f"{(last['step'] - first['step']) / (last['seconds'] - first['seconds']):.2f}"


Page = Callable[[Scene, TrainConfig], AbstractContextManager[Any]]


class Visitor:
    """A viewer whose camera moves before each step. It counts the pictures."""

    def __init__(self, view: TrainingView, scene: Scene) -> None:
        self.view, self.camera, self.pictures = view, scene.views[0].camera, 0
        self.viewer = view.viewing.join(self)

    def __call__(self, trainer: Any, interrupted: Callable[[], bool]) -> None:
        """Move the camera, and let the training render."""
        place = self.camera.position + 0.01 * trainer.step
        self.view.viewing.moved(self.viewer, Pose(self.camera.rotation.T, place, 0.8, 320, 240))
        self.view(trainer, interrupted)

    def show(self, *_: object) -> None:
        """Count a picture."""
        self.pictures += 1

    def tell(self, message: str) -> None:
        """Raise ClsplatError, as a training tells a viewer only errors."""
        raise ClsplatError(f"the viewer was told: {message}, expected no message")


def visited(make: Callable[..., Page]) -> Callable[..., Page]:
    """A function that makes pages as `make` does, each with a `Visitor`."""

    def made(*options: Any) -> Page:
        page = make(*options)

        @contextmanager
        def opened(scene: Scene, config: TrainConfig) -> Iterator[Visitor]:
            with page(scene, config) as view:
                visitor = Visitor(view, scene)
                yield visitor
            print(f"{visitor.pictures} pictures", file=sys.stderr)

        return opened

    return made


def devices(given: str | None) -> list[str]:
    """The devices to train on: those given, or one of each driver."""
    if given:
        return given.split(",")
    by_driver = {(info.platform, info.version): str(info.index) for info in reversed(list_devices())}
    return sorted(by_driver.values(), key=int)


def chosen(rows: Sequence[Case], words: str | None) -> list[Case]:
    """The rows whose names have one of the words, and those that they are compared with. Raises ClsplatError."""
    named = [row for row in rows if words is None or any(word in row.name for word in words.split(","))]
    if not named:
        raise ClsplatError(f"--only {words}: no such row, expected a part of {', '.join(row.name for row in rows)}")
    return [row for row in rows if row in named or row.name in {each.like for each in named}]


@tool("stress_limits")
def main(arguments: Sequence[str]) -> int:
    """Train and compare, and print the table. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("--gaussians", type=number, default=300_000)
    parser.add_argument("--steps", type=int, default=90)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only")
    parser.add_argument("--devices")
    options = parser.parse_args(arguments)
    model = options.gaussians * MODELS * 4 * floats_of((SH_DEGREE + 1) ** 2)
    first, *others = devices(options.devices)
    rows, found, differ = chosen(cases(model, first, others), options.only), {}, False
    print("| training | limit | peak | steps/s | digest | |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(prefix="clsplat-limits-") as folder:
        trainings = Trainings(Path(folder), options)
        for case in rows:
            limit = trainings.least(case)
            try:
                took = trainings.killed(case) if case.killed else trainings.trained(case, limit)
            except ClsplatError as error:
                took = Result(set(), " ".join(str(error).split()))
            found[case.name] = took.digests
            same = bool(took.digests) and took.digests == found[case.like]
            differ |= not same
            words = "FAILED" if not took.digests else "DIFFERENT" if not same else "same"
            said = ", ".join(word for word in (words, took.said) if word and (case.like != case.name or not same))
            cells = [case.name, limit_of((*case.flags, *limit)), took.peak, took.rate, ", ".join(took.digests), said]
            print(f"| {' | '.join(cells)} |", flush=True)
    return 1 if differ else 0


def limit_of(flags: Sequence[str]) -> str:
    """The memory limit among these flags, with its flag; empty if there is none."""
    return next((f"{flag} {value}" for flag, value in pairwise(flags) if flag.startswith("--max")), "")
