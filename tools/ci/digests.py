#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Compare drivers and kernel shapes by digests of frames, of gradients, of a trained model, and of pictures with every
channel and camera model.

    .venv/bin/python tools/ci/digests.py [--short]

Prints the tables of docs/bit-identity.md: drivers with the same digests share a row, and every channel has a digest.
The first line names the processor.

Every driver found is run in every shape, in a process of its own: PoCL also with its other methods for work-groups, and
Rusticl if CLSPLAT_RUSTICL names its libRusticlOpenCL.so. The exit status is 1 if

- a frame or a channel of a picture has other bits anywhere,
- gradients differ in a bit within a shape or between the shapes SAME_ORDER,
- gradients of other shapes differ by more than GRADIENT_BOUND,
- two trainings in one shape differ in a bit, on one driver or on two,
- trainings in two shapes differ by more than PSNR_BOUND,
- a combination that is expected to fail works, or another fails.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / part) for part in ("tests/support", ".")]

import numpy as np  # noqa: E402
from compare import relative_error  # noqa: E402
from processor import processor  # noqa: E402

SUBGROUPED = ("1x32s", "1x64s", "1x128s", "1x256s")
"""Shapes with sub-groups, for drivers that have them. Their gradients equal those of the shapes without sub-groups."""
SHAPES = ("8x1", "16x1", "1x1", "1x32", "1x64", "1x128", "1x256", "1x32g", "1x64g", *SUBGROUPED)
"""Lanes x items; `g`: an item computes the gradient of a Gaussian. Other shapes are compared with the first."""
SAME_ORDER = ("1x32", "1x64", "1x128", "1x256")
"""Shapes with one order of sums: their gradients are the same (decision 0023)."""
TRAINED = ("8x1", "16x1", "1x1", "1x64")
"""Shapes in which a model is trained, twice. Other work-groups differ from 1x64 only where gradients show it."""
IN_SHORT = ("8x1", "16x1", "1x1", "1x64", "1x64g", "1x64s")
"""Shapes of every driver with --short, as in CI: one for each kernel of the gradient. The default driver has all, so
that each shape is compared with the others there."""
METHODS = {"loops": ("8x1", "1x64"), "cbs": ("1x64",)}
"""Values of POCL_WORK_GROUP_METHOD in addition to PoCL's default, which is loopvec, with the shapes to run."""
UNKNOWN_METHOD = "Unknown work group generation method"
"""PoCL's error message for an unknown method, at the first kernel that it builds."""
LIMIT = 600
"""Time limit in seconds for one driver and shape. The longest takes 95 s of a core, and the machine may be busy."""
EXPECTED_LIMIT = 20
"""Time limit in seconds for a combination that is known to hang: if it worked, it would take 5 s."""
EXPECTED = {
    ("PoCL 3.0, cbs", "1x64"): UNKNOWN_METHOD,
    ("PoCL 3.1, cbs", "1x64"): UNKNOWN_METHOD,
    ("Rusticl", "8x1"): "llvmpipe's compiler does not come back from vectors of 8",
}
"""Combinations that do not work, with the reason. They are run nevertheless."""
GRADIENT_BOUND = 1e-6
"""Largest relative difference, in norm, of the gradient of a parameter group. Two orders of summing 256 numbers differ
by about sqrt(256) half ulps of the terms, 5e-7, unless they cancel."""
PSNR_BOUND = 0.2
"""Largest difference in dB between models of 60 steps from one seed in two shapes. The largest observed is 0.05."""


@dataclass
class Row:
    """One driver in one shape: digests of frame, gradient and model (None if not trained).

    repeats: True if a second training gave the same bytes; None if not trained. psnr: of the held-out views, in dB.
    gaussians: number of the model's Gaussians.
    difference: relative difference in norm of the gradient from that of the first row without trouble.
    trouble: what went wrong, as text.
    pictures: digests, keyed by camera model and channel."""

    driver: str
    shape: str
    frame: str = ""
    gradient: str = ""
    model: str | None = None
    repeats: bool | None = None
    psnr: float = 0.0
    gaussians: int = 0
    difference: float = 0.0
    trouble: str = ""
    seconds: float = 0.0
    pictures: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def channels(self) -> str:
        """Digest of all pictures' digests."""
        return f"{zlib.crc32(json.dumps(self.pictures, sort_keys=True).encode()):08x}"


@dataclass(frozen=True)
class Job:
    """The work of a child process, and its environment variables."""

    driver: str
    index: int
    shape: str
    train: bool
    environment: dict[str, str]


def main(arguments: list[str]) -> int:
    """Print the tables, and problems on standard error."""
    if arguments[:1] == ["child"]:
        child(int(arguments[1]), arguments[2], Path(arguments[3]), Path(arguments[4]) if arguments[4:] else None)
        return 0
    short = arguments == ["--short"]
    if arguments and not short:
        print(__doc__, file=sys.stderr)
        return 2
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="clsplat-digests-") as folder:
        rows = run_all(jobs(Path(folder), short=short), Path(folder))
    print(f"{processor()}\n")
    print(table(rows))
    slowest = max(rows, key=lambda row: row.seconds)
    print(f"slowest: {slowest.driver}, {slowest.shape}, {slowest.seconds:.0f} s", file=sys.stderr)
    found = problems(rows)
    for text in found:
        print(f"digests: {text}", file=sys.stderr)
    print(f"{len(rows)} rows, {len(found)} problems, {time.monotonic() - start:.0f} s", file=sys.stderr)
    return 1 if found else 0


def jobs(folder: Path, *, short: bool = False) -> list[Job]:
    """Jobs of every driver in every shape. folder: gets caches and .icd files of drivers.

    short: drivers other than the default one (CLSPLAT_DEVICE, or the first) run only in the shapes IN_SHORT, and
        Rusticl not in the shape in which it hangs.
    """
    from opencl_drivers import use_every_driver

    use_every_driver()
    from clsplat.device.context import all_devices
    from clsplat.device.drivers.quirks import subgroup_ways
    from clsplat.device.selection import select

    listed: list[Job] = []
    names = _names()
    default = all_devices().index(select(None)) if names else 0
    for index, name in enumerate(names):
        asked = IN_SHORT if short and index != default else SHAPES
        able = [shape for shape in asked if shape not in SUBGROUPED or subgroup_ways(all_devices()[index])]
        listed += [Job(name, index, shape, train=shape in TRAINED, environment={}) for shape in able]
    for index, name in enumerate(names):
        if name.startswith("PoCL"):
            for method, shapes in METHODS.items():
                own = {"POCL_WORK_GROUP_METHOD": method, "POCL_CACHE_DIR": str(folder / f"pocl-{index}-{method}")}
                listed += [Job(f"{name}, {method}", index, shape, False, own) for shape in shapes]
    library = os.environ.get("CLSPLAT_RUSTICL")
    if library:
        own = rusticl(Path(library), folder / "rusticl")
        hangs = () if short else ("8x1",)  # until EXPECTED_LIMIT
        listed += [Job("Rusticl", -1, shape, False, own) for shape in ("1x64", *hangs)]
    return listed


def _names() -> list[str]:
    """Names of the devices found, in order: PoCL with its version, or the platform's name."""
    from clsplat.device.context import all_devices

    names = []
    for device in all_devices():
        words = device.platform.version.replace("+", " ").replace("-", " ").split()
        name = device.platform.name.split("(")[0].strip()
        names.append(f"PoCL {words[words.index('PoCL') + 1]}" if "PoCL" in words else f"{name} CPU runtime")
    return names


def rusticl(library: Path, folder: Path) -> dict[str, str]:
    """Environment variables that make this library an OpenCL driver."""
    folder.mkdir()
    (folder / "rusticl.icd").write_text(f"{library}\n")
    return {"OCL_ICD_VENDORS": str(folder), "RUSTICL_ENABLE": "llvmpipe", "LP_NUM_THREADS": "2"}


def run_all(listed: list[Job], folder: Path) -> list[Row]:
    """Run jobs, two at a time, each in a process. Gradients are compared with the first row's that has no trouble."""
    from tiny import write_scene

    scene = write_scene(folder / "scene")
    numbers = in_turn(listed)
    with ThreadPoolExecutor(max_workers=2) as pool:
        done = pool.map(lambda number: _in_a_process(listed[number], folder / f"{number}.npz", scene), numbers)
        by_number = dict(zip(numbers, done, strict=True))
    rows = [by_number[number] for number in range(len(listed))]
    first = next((number for number, row in enumerate(rows) if not row.trouble), None)
    if first is not None:
        wanted = np.load(folder / f"{first}.npz")
        for number, row in enumerate(rows):
            if not row.trouble:
                row.difference = _difference(np.load(folder / f"{number}.npz"), wanted)
    return rows


def in_turn(listed: Sequence[Job]) -> list[int]:
    """Indices of the jobs in the order in which they begin: Rusticl's first, whose builds take longest. Then one job of
    each driver in turn: jobs of one driver share kernels, and two at a time would both build them."""
    before: Counter[str] = Counter()
    keys = []
    for number, job in enumerate(listed):
        keys.append((job.driver != "Rusticl", before[job.driver], number))
        before[job.driver] += 1
    return [number for _, _, number in sorted(keys)]


def _in_a_process(job: Job, arrays: Path, scene: Path) -> Row:
    row = Row(job.driver, job.shape)
    start = time.monotonic()
    expected = EXPECTED.get((job.driver, job.shape))
    limit = EXPECTED_LIMIT if expected else LIMIT
    more = [str(scene)] if job.train else []
    if expected == UNKNOWN_METHOD:
        more = ["open"]
    command = [sys.executable, __file__, "child", str(job.index), job.shape, str(arrays), *more]
    # no sandbox, as a crash ends only this child process
    environment = {**os.environ, "CLSPLAT_TRUST_DRIVER": "1", **job.environment}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=limit, check=False, env=environment
        )
    except subprocess.TimeoutExpired:
        row.trouble = f"not done within {limit} s"
    else:
        if UNKNOWN_METHOD in done.stderr + done.stdout:
            row.trouble = UNKNOWN_METHOD
        elif more == ["open"]:
            pass
        elif done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["no word"])[-1]
            row.trouble = f"ended with status {done.returncode}: {last}"
        else:
            row = Row(job.driver, job.shape, **json.loads(done.stdout.splitlines()[-1]))
    row.seconds = time.monotonic() - start
    return row


def child(index: int, shape: str, arrays: Path, scene: Path | None) -> None:
    """Run on the device of this index, -1 for Rusticl's. Prints the digests, and writes the gradients to `arrays`.

    scene: scene to train on; None if no model is trained. With "open", only the device is opened and a probe launched.
    """
    from golden_frames import arrays_of, checksum, pictures_of, trained

    from clsplat.device.context import Device, all_devices

    found = next(d for d in all_devices() if d.platform.name == "rusticl") if index < 0 else all_devices()[index]
    device = Device(found).with_shape(shape)
    if scene == Path("open"):
        Device(found).kernels("probe")  # the driver's default shape has vectors, which the device probes by a launch
        return
    made = arrays_of(device)
    frame = [part for each in made.values() for name in ("image", "transmittance") for part in each[name]]
    gradient = {f"{scene}/{k}": part for scene, each in made.items() for k, part in enumerate(each["gradients"])}
    gradient.update({f"{scene}/screen": each["screen"][0] for scene, each in made.items()})
    np.savez(arrays, **gradient)  # type: ignore[arg-type]
    unsigned = [part + np.float32(0) for part in gradient.values()]  # adding 0 removes the sign of zeros
    told: dict[str, Any] = {"frame": checksum(frame), "gradient": checksum(unsigned)}
    told["pictures"] = pictures_of(device)
    if scene is not None:
        models = [trained(device, scene) for _ in range(2)]
        names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
        digests = [checksum([getattr(model, name) for name in names]) for model, _ in models]
        told.update(model=digests[0], repeats=digests[0] == digests[1], psnr=models[0][1], gaussians=len(models[0][0]))
    print(json.dumps(told))


def _difference(got: Any, wanted: Any) -> float:
    """The largest relative difference in norm between arrays of the same key."""
    return max(relative_error(got[key], wanted[key]) for key in wanted)


def problems(rows: list[Row]) -> list[str]:
    """Descriptions of all rows that are not as expected."""
    found = []
    good = [row for row in rows if not row.trouble]
    for row in rows:
        expected = (row.driver, row.shape) in EXPECTED
        if row.trouble and not expected:
            found.append(f"{row.driver}, {row.shape}: {row.trouble}")
        elif expected and not row.trouble:
            found.append(f"{row.driver}, {row.shape}: works, and was expected to fail: take it from EXPECTED")
    if not good:
        return [*found, "nothing was run"]
    first = good[0]
    by_shape: dict[str, Row] = {}
    trained: dict[str, Row] = {}
    for row in good:
        at = f"{row.driver}, {row.shape}"
        if row.frame != first.frame:
            found.append(f"{at}: the frame is {row.frame}, on {first.driver}, {first.shape} it is {first.frame}")
        found += other_channels(row, first)
        if not row.difference <= GRADIENT_BOUND:
            off = f"{row.difference:.1e} from that of {first.shape}, over {GRADIENT_BOUND:g}"
            found.append(f"{at}: the gradient is {off}")
        shape = row.shape.removesuffix("s")
        same_shape = [("gradient", by_shape.setdefault(SAME_ORDER[0] if shape in SAME_ORDER else shape, row))]
        same_shape += [("model", trained.setdefault(row.shape, row))] if row.model is not None else []
        for what, other in same_shape:
            got, wanted = getattr(row, what), getattr(other, what)
            if got != wanted:
                found.append(f"{at}: the {what} is {got}, on {other.driver}, {other.shape} it is {wanted}")
        if row.model is None:
            continue
        if not row.repeats:
            found.append(f"{at}: two trainings gave two models")
        reference = next(iter(trained.values()))
        if not abs(row.psnr - reference.psnr) <= PSNR_BOUND:
            found.append(f"{at}: the model has {row.psnr:.2f} dB, that of {reference.shape} {reference.psnr:.2f} dB")
    return found


def other_channels(row: Row, first: Row) -> list[str]:
    """Descriptions of a row's channels whose digests differ from those of the first row."""
    found = []
    for kind, wanted in first.pictures.items():
        for name, digest in wanted.items():
            got = row.pictures.get(kind, {}).get(name, "missing")
            if got != digest:
                where = f"{row.driver}, {row.shape}: {name} of the {kind} camera"
                found.append(f"{where} is {got}, on {first.driver}, {first.shape} it is {digest}")
    return found


def table(rows: list[Row]) -> str:
    """Table with a row for each shape and result, which lists all drivers with this result."""
    good = [row for row in rows if not row.trouble]
    drivers: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        if row.trouble:
            reason = EXPECTED.get((row.driver, row.shape), row.trouble)
            cells: tuple[str, ...] = (row.shape, f"not run: {reason}", "", "", "")
        else:
            apart = "" if row.gradient == good[0].gradient else f", {row.difference:.0e} off"
            model = "not trained" if row.model is None else f"`{row.model}`, {row.psnr:.3f} dB"
            cells = (row.shape, f"`{row.frame}`", f"`{row.channels}`", f"`{row.gradient}`{apart}", model)
        drivers.setdefault(cells, []).append(row.driver)
    header = ("shape", "drivers", "frame", "all channels", "gradient", "trained model")
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    for (shape, *cells_of), names in sorted(drivers.items(), key=lambda pair: SHAPES.index(pair[0][0])):
        lines.append(f"| {shape} | {'; '.join(names)} | {' | '.join(cells_of)} |")
    return "\n".join([*lines, "", *(channel_table(good[0]) if good else ())])


def channel_table(row: Row) -> list[str]:
    """Table of every channel's digest for each camera model."""
    names = list(next(iter(row.pictures.values()), {}))
    lines = [f"| camera | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
    for kind, digests in row.pictures.items():
        cells = (f"`{digests[name]}`" if name in digests else "not defined" for name in names)
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
