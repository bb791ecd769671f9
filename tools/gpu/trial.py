#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Measure everything that the model of a GPU's step needs, in a call of a few minutes on a machine with a GPU.

    python tools/gpu/trial.py [--minutes 6] [--peers FOLDER] [--twins FOLDER] [--out trial.json]
    python tools/gpu/trial.py --complete trial.json
    python tools/gpu/trial.py --write-twins FOLDER [--target sm_90]
    python tools/gpu/trial.py --dry-run

On that machine it needs neither a package index nor a compiler other than the driver's. Its parts, in order, are:

- limits of the device, by small kernels (`trial_limits.py`);
- stages and steps of the synthetic scene and of a scene like fox, in the shapes of a GPU;
- variants of the kernels, and comparisons of their bits (`trial_variants.py`);
- hardware counters, by Nsight Compute (`trial_counters.py`);
- gsplat and Faster-GS on the same Gaussians, imported or built from the sources in FOLDER (`trial_peers.py`).

Parts that are not possible, or no longer fit into the minutes, are listed as left out. After each result, trial.json
and trial.txt, which has the table, are written.

The other calls need no GPU. --complete counts the variants' instructions with GPUs' compilers (`trial_counts.py`), and
adds predictions to the table and a row to docs/gpus/calibration.json, in a checkout of the code that was measured.
--write-twins writes kernels for the --twins of a later trial. --dry-run runs every part on a CPU with tiny scenes.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import trial_counters
import trial_limits
import trial_peers
from gpu_scenes import FOX_LIKE, fox_like
from measuring import plain_parser, require, tool
from trial_limits import FULL, TINY, Limits
from trial_table import table
from trial_variants import DRY, USUAL, USUAL_SHAPE, VARIANTS, TrialScene, VariedDevice

from clsplat.bench.stages import bench, trainer_of
from clsplat.bench.workload import Subject, synthetic
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device, all_devices
from clsplat.device.drivers.shapes import default_shape, most_items
from clsplat.device.drivers.worker_process import TRUST_DRIVER_VARIABLE
from clsplat.device.selection import list_devices, select
from clsplat.device.source import kernel_root
from clsplat.errors import ClsplatError
from clsplat.files.atomic import atomic_write
from clsplat.rendering.renderer import Renderer
from clsplat.stages.peak import Limits as Peaks

ROOT = Path(__file__).resolve().parents[2]
SCENES: dict[str, Callable[[], Subject]] = {
    "made up, 1 M": partial(synthetic, 1_000_000, 1600, 1060),
    "fox-like": partial(fox_like, *FOX_LIKE),
}
"""Scenes by their names in gpu_frames.json."""
TINY_SCENES: dict[str, Callable[[], Subject]] = {
    "made up, 1 M": partial(synthetic, 300, 64, 48),
    "fox-like": partial(fox_like, 300, 48, 64),
}
SHAPES = (USUAL_SHAPE, "1x32", "1x128", "1x256")
STEPS, MORE_STEPS = 15, 5
"""Numbers of timed steps in the usual shape, also for variants, and in other shapes."""
WARM_UP = 3
"""Number of frames or steps before the first that is timed."""
ENDS = {"limits": 0.15, "stages": 0.35, "variants": 0.75, "counters": 0.85, "peers": 1.0}
"""Fraction of the minutes after which each part stops. Time that a part does not need is left to the next ones."""
NO_PEAKS = Peaks(1.0, 1.0, 1.0, 1, 1)
"""Placeholders for the limits that `bench` would measure, because the trial measures more precise ones."""


def digest_of_code() -> str:
    """Digest of the kernels and the package, which identifies the code that a trial has measured."""
    found = hashlib.sha256()
    for path in sorted([*kernel_root().rglob("*.[ch]*"), *(ROOT / "clsplat").rglob("*.py")]):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def told(command: Sequence[str]) -> str:
    """The output of a command; "" if it is missing or fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


class Trial:
    """A running trial: its results, which are written to the disk after each one, and the time that is left."""

    def __init__(self, options: Namespace, device: Device, builds: Path) -> None:
        self.options, self.device = options, device
        self.scenes = {name: make() for name, make in (TINY_SCENES if options.dry_run else SCENES).items()}
        self.builds = trial_peers.Builds(options.peers, builds)
        self.begin, self.seconds = time.monotonic(), 60 * options.minutes
        self.end = self.begin + self.seconds
        self.record: dict[str, Any] = {
            "device": device.name,
            "driver": f"{device.cl_device.driver_version.strip()}, {device.driver.split('  ')[0].strip()}",
            "date": datetime.now(tz=timezone.utc).date().isoformat(),
            "commit": told(["git", "rev-parse", "--short=8", "HEAD"]),
            "code": digest_of_code(),
            "shape": USUAL_SHAPE,
            "dry_run": options.dry_run,
            "limits": {},
            "scenes": [],
            "variants": [],
            "counters": [],
            "peers": [],
            "left_out": [],
        }

    @property
    def left(self) -> float:
        """Seconds until the present part has to stop."""
        left: float = self.end - time.monotonic()
        return left

    def say(self, text: str) -> None:
        """Print progress."""
        print(f"{time.monotonic() - self.begin:5.0f} s  {text}", file=sys.stderr, flush=True)

    def add(self, part: str, *rows: Any) -> None:
        """Add rows to a part of the results, and write them."""
        self.record[part] += rows
        self.save()

    def leave_out(self, what: str, why: str) -> None:
        """Note that something is not measured."""
        self.say(f"left out: {what}: {why}")
        self.add("left_out", {"what": what, "why": why})

    def attempt(self, what: str, work: Callable[[], None]) -> None:
        """Do a piece of work. If no time is left or it fails, note why it is left out."""
        if self.left <= 0:
            self.leave_out(what, "no time was left")
            return
        self.say(what)
        try:
            work()
        except Exception as error:  # noqa: BLE001  # a driver may raise any error, and the other parts must still run
            self.leave_out(what, trial_peers.last_line(str(error), type(error).__name__))

    def save(self) -> None:
        """Write the results and their table."""
        path: Path = self.options.out
        atomic_write(path, (json.dumps(self.record, indent=1) + "\n").encode())
        atomic_write(path.with_suffix(".txt"), ("\n".join(table(self.record)) + "\n").encode())


def measure_limits(trial: Trial) -> None:
    """Measure the device's limits, and note its clocks."""
    query = "name,driver_version,clocks.sm,clocks.max.sm,clocks.mem,clocks.max.mem,power.limit"
    if clocks := told(["nvidia-smi", f"--query-gpu={query}", "--format=csv"]):
        trial.record["nvidia_smi"] = clocks.splitlines()
    else:
        trial.leave_out("present clocks", "nvidia-smi is not there")
    on = Limits(trial.device, TINY if trial.options.dry_run else FULL)
    for measured in trial_limits.MEASURED:
        trial.attempt(f"limits: {measured.__name__}", lambda each=measured: trial.record["limits"].update(each(on)))  # type: ignore[misc]
        on.free()
        trial.save()


def measure_stages(trial: Trial) -> None:
    """Measure frames and steps of each scene in each shape."""
    for name, subject in trial.scenes.items():
        for shape in SHAPES[:1] if trial.options.dry_run else SHAPES:
            items = trial.device.shape.relabelled(shape).items
            if items > most_items(trial.device.cl_device):
                trial.leave_out(f"{name}, {shape}", f"groups of {items} items do not fit")
                continue
            trial.attempt(f"stages: {name}, {shape}", partial(_measure_stages, trial, name, subject, shape))


def plain_times(subject: Subject, device: Device, repeat: int) -> dict[str, float]:
    """Milliseconds of a frame, of a step, and of a step among `repeat` steps without waits between them."""
    trainer = trainer_of(subject, device, RasterizerConfig())

    def draw() -> None:
        trainer.rasterizer.forward(trainer.parameters, subject.camera, trainer.background, backward=False)

    def steps() -> None:
        for _ in range(repeat):
            trainer.train_step()

    found = {}
    for name, work in (("frame_ms", draw), ("step_ms", trainer.train_step)):
        for _ in range(WARM_UP):
            work()
        found[name] = statistics.median(device.timed(work)[1] for _ in range(repeat))
    return {name: round(ms, 4) for name, ms in (found | {"step_in_a_row_ms": device.timed(steps)[1] / repeat}).items()}


def _measure_stages(trial: Trial, name: str, subject: Subject, shape: str) -> None:
    device = Device(trial.device.cl_device, trial.device.shape.relabelled(shape), profile=True)
    repeat = 1 if trial.options.dry_run else STEPS if shape == USUAL_SHAPE else MORE_STEPS
    found = bench(subject, device, repeat=repeat, limits=NO_PEAKS)
    kernels = [(stage, kernel, ms) for stage, row in found["stages"].items() for kernel, ms in row["kernels"].items()]
    twice = {kernel for _, kernel, _ in kernels if sum(kernel == other for _, other, _ in kernels) > 1}
    row = {
        "scene": f"{subject.name}, {found['gaussians']:,} Gaussians, {found['width']}x{found['height']}",
        "frame": name,
        "shape": shape,
        **{key: found[key] for key in ("gaussians", "visible", "pairs")},
        **plain_times(subject, Device(trial.device.cl_device, device.shape), repeat),
        "host_ms": round(found["iteration_host_ms"], 4),
        "kernels_ms": {
            f"{stage}: {kernel}" if kernel in twice or kernel in ("write", "read", "fill") else kernel: round(ms, 5)
            for stage, kernel, ms in kernels
        },
    }
    trial.add("scenes", row)


def measure_variants(trial: Trial) -> None:
    """Measure variants of the kernels, scene by scene, and the usual form first."""
    device = VariedDevice(trial.device.cl_device, trial.device.shape.relabelled(USUAL_SHAPE))
    for name, subject in trial.scenes.items():
        held: list[TrialScene] = []
        for variant in VARIANTS:
            what = f"{name}: {variant.title}"
            if trial.options.dry_run and variant.name not in DRY:
                trial.leave_out(what, "a dry run")
            elif lacking := variant.lacking(device):
                trial.leave_out(what, lacking)
            elif variant is not USUAL and not held:
                trial.leave_out(what, "there is no usual form to compare with")
            else:
                trial.attempt(what, partial(_measure_variant, trial, name, subject, device, variant, held))


def _measure_variant(
    trial: Trial, name: str, subject: Subject, device: VariedDevice, variant: Any, held: list[TrialScene]
) -> None:
    scene = held[0] if held else TrialScene(subject, device)
    rows = scene.measure(variant, 1 if trial.options.dry_run else STEPS)
    held[:] = [scene]
    trial.add("variants", *({"scene": name, **row, "ms": round(row["ms"], 5)} for row in rows))


def count_hardware(trial: Trial) -> None:
    """Read hardware counters of kernels, if Nsight Compute and the kernels for CUDA are available."""
    ncu, twins = shutil.which("ncu"), trial.options.twins
    if why := trial_peers.no_cuda() or ("" if ncu else "ncu is not there"):
        trial.leave_out("hardware counters", why)
    elif twins is None:
        trial.leave_out("hardware counters", "ncu sees no OpenCL; --twins FOLDER has the kernels for CUDA")
    else:
        trial.attempt("hardware counters", partial(_count_hardware, trial, twins))


def _count_hardware(trial: Trial, twins: Path) -> None:
    name, subject = next(iter(trial.scenes.items()))
    device = VariedDevice(trial.device.cl_device, trial.device.shape)
    for row in trial_counters.measure(subject, device, twins, trial.left):
        trial.add("counters", {"scene": name, **row})


def measure_peers(trial: Trial) -> None:
    """Time other programs on the same Gaussians."""
    if why := trial_peers.no_cuda():
        trial.leave_out(" and ".join(trial_peers.TIMED), why)
        return
    trial.builds.finish(trial.left / 2)
    for peer, why in trial.builds.failed.items():
        trial.leave_out(f"{peer}, built from source", why)
    with tempfile.TemporaryDirectory(prefix="clsplat-trial-") as folder:
        for name, subject in trial.scenes.items():
            path = Path(folder) / "subject.npz"
            image = Renderer(trial.device, config=RasterizerConfig()).render(subject.gaussians, subject.camera).image
            trial_peers.save(subject, np.clip(image[:, ::-1], 0, 1), path)
            for peer in trial_peers.TIMED:
                trial.attempt(f"{peer}: {name}", partial(_measure_peer, trial, name, peer, path))


def _measure_peer(trial: Trial, name: str, peer: str, path: Path) -> None:
    found = trial_peers.measure(peer, path, STEPS, trial.builds.into, trial.left)
    if isinstance(found, str):
        raise ClsplatError(found)
    trial.add("peers", {"scene": name, "peer": peer, **found})


PARTS = {
    "limits": measure_limits,
    "stages": measure_stages,
    "variants": measure_variants,
    "counters": count_hardware,
    "peers": measure_peers,
}


def chosen_device(options: Namespace) -> tuple[Device, list[str]]:
    """The device to measure, in the shape of a GPU, and the names of other GPUs. Raises InputError without a GPU."""
    listed = list_devices()
    gpus = [info for info in listed if info.kind == "gpu"]
    names = "; ".join(info.name for info in listed) or "none"
    require(
        bool(gpus) or options.dry_run,
        f"no GPU among the OpenCL devices ({names}), so all is left out; --dry-run runs every part on a CPU",
    )
    device = select(options.device or ("gpu" if gpus else None))
    shape = default_shape(device).relabelled(USUAL_SHAPE)
    others = [f"GPU {info.index}, {info.name}" for info in gpus if all_devices()[info.index] != device]
    return Device(device, shape, profile=True), others


@tool("trial")
def main(arguments: Sequence[str]) -> int:
    """Run the parts, and print the table."""
    parser = plain_parser(__doc__, prog="trial")
    parser.add_argument("--minutes", type=float, default=6, help="time limit, after which all else is left out")
    parser.add_argument("--device", help="a device as listed by `clsplat devices`; by default the first GPU")
    parser.add_argument("--out", type=Path, default=Path("trial.json"), metavar="FILE.json")
    parser.add_argument("--peers", type=Path, metavar="FOLDER", help="sources of gsplat and Faster-GS")
    parser.add_argument("--twins", type=Path, metavar="FOLDER", help="kernels for CUDA")
    parser.add_argument("--dry-run", action="store_true", help="run every part with tiny scenes, also on a CPU")
    parser.add_argument("--complete", type=Path, metavar="FILE.json", help="add counts and predictions to a trial")
    parser.add_argument("--write-twins", type=Path, metavar="FOLDER", help="write kernels for CUDA")
    parser.add_argument("--target", default="sm_90", help="GPU of these kernels")
    options = parser.parse_args(arguments)
    if options.complete is not None:
        return complete(options.complete)
    if options.write_twins is not None:
        print(f"{options.write_twins}: {', '.join(trial_counters.write_twins(options.write_twins, options.target))}")
        return 0
    require(options.minutes > 0, f"--minutes {options.minutes:g}: expected more than 0")
    require(options.out.suffix == ".json", f"--out {options.out}: expected a name that ends in .json")
    for name, folder in (("peers", options.peers), ("twins", options.twins)):
        require(folder is None or folder.is_dir(), f"--{name} {folder}: expected a folder")
    with patch.dict(os.environ, {TRUST_DRIVER_VARIABLE: "1"}):  # a self-test would take the trial's time
        record = run(options)
    print("\n".join(table(record)))
    return 0


def run(options: Namespace) -> dict[str, Any]:
    """The results of a trial. Raises InputError without a GPU."""
    device, others = chosen_device(options)
    with tempfile.TemporaryDirectory(prefix="clsplat-trial-") as builds:
        trial = Trial(options, device, Path(builds))
        for other in others:
            trial.leave_out(other, "a trial takes one GPU; --device chooses it")
        for name, part in PARTS.items():
            trial.end = trial.begin + ENDS[name] * trial.seconds
            part(trial)
    return trial.record


def complete(path: Path) -> int:
    """Add counts and predictions to a trial, and its row to the calibration."""
    from trial_counts import add_row, count_variants

    record = json.loads(path.read_text("utf-8"))
    require(not record.get("dry_run"), f"--complete {path}: is a dry run, which measured no GPU")
    require(
        record.get("code") == digest_of_code(),
        f"--complete {path}: measured other code, of commit {record.get('commit') or 'unknown'}; check that out first",
    )
    count_variants(record)
    add_row(record)
    atomic_write(path, (json.dumps(record, indent=1) + "\n").encode())
    atomic_write(path.with_suffix(".txt"), ("\n".join(table(record)) + "\n").encode())
    print("\n".join(table(record)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
