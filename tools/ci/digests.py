#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Table of drivers and kernel shapes: digests of frames, of pictures with every channel by every kind of camera, of
gradients and of a trained model, or how far they differ.

    .venv/bin/python tools/ci/digests.py

Prints the tables of docs/bit-identity.md: drivers with the same digests in one row, and each channel's own digest. The
first line is the processor that they were made on.

Every driver that is found is run in every shape, each in a process of its own, PoCL also with its other ways to make
work-groups, and Rusticl where CLSPLAT_RUSTICL names its libRusticlOpenCL.so. Exit status 1 where

- a frame or a channel of a picture has other bits anywhere,
- gradients differ within a shape, or between shapes by more than GRADIENT_BOUND,
- two trainings on one driver differ in a bit, or those of two drivers in one shape,
- trainings in two shapes differ by more than PSNR_BOUND,
- what is expected to fail does not, or something else does.
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
from processor import processor  # noqa: E402

SUBGROUPED = ("1x32s", "1x64s", "1x128s", "1x256s")
"""Shapes with sub-groups, of drivers that have them; they have the gradients of the shapes without."""
SHAPES = ("8x1", "16x1", "1x1", "1x32", "1x64", "1x128", "1x256", "1x32g", "1x64g", *SUBGROUPED)
"""Lanes x items, `g` for a gradient by Gaussian; the first is what the others are compared with."""
TRAINED = ("8x1", "16x1", "1x1", "1x64")
"""Shapes in which a model is trained, twice: kernels of other groups differ from 1x64 in what gradients show."""
METHODS = {"loops": ("8x1", "1x64"), "loopvec": ("1x64",), "cbs": ("1x64",)}
"""POCL_WORK_GROUP_METHOD, beside the one that PoCL takes by itself, and shapes."""
UNKNOWN_METHOD = "Unknown work group generation method"
"""PoCL's words, at the first kernel that it builds."""
LIMIT = 600
"""Seconds for one driver and shape: the longest takes 95 of a core, and the machine may be busy."""
EXPECTED_LIMIT = 20
"""Seconds for one that is known not to come back: alone it is done in 5."""
EXPECTED = {
    ("PoCL 3.0, cbs", "1x64"): UNKNOWN_METHOD,
    ("PoCL 3.1, cbs", "1x64"): UNKNOWN_METHOD,
    ("Rusticl", "8x1"): "llvmpipe's compiler does not come back from vectors of 8",
}
"""Combinations that do not work, with the reason. They are tried all the same."""
GRADIENT_BOUND = 1e-6
"""Relative, in norm, of each parameter group of each scene. Two orders of adding up 256 numbers differ by some
sqrt(256) half ulp of what is added, 5e-7, where that does not cancel."""
PSNR_BOUND = 0.2
"""dB between models of 60 steps from one seed that two shapes have trained; 0.05 was the most that was found."""


@dataclass
class Row:
    """One driver in one shape: digests of frame, gradient and model (None: not trained); of pictures by kind of camera
    and channel; whether a second training gave the same bytes; PSNR on the held-out views; how far the gradient is from
    the first row's, relative in norm; trouble in words."""

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
    """Work of a child, and the variables in its environment."""

    driver: str
    index: int
    shape: str
    train: bool
    environment: dict[str, str]


def main(arguments: list[str]) -> int:
    """Print the table, and on standard error what is wrong."""
    if arguments[:1] == ["child"]:
        child(int(arguments[1]), arguments[2], Path(arguments[3]), Path(arguments[4]) if arguments[4:] else None)
        return 0
    if arguments:
        print(__doc__, file=sys.stderr)
        return 2
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="clsplat-digests-") as folder:
        rows = run_all(jobs(Path(folder)), Path(folder))
    print(f"{processor()}\n")
    print(table(rows))
    slowest = max(rows, key=lambda row: row.seconds)
    print(f"slowest: {slowest.driver}, {slowest.shape}, {slowest.seconds:.0f} s", file=sys.stderr)
    found = problems(rows)
    for text in found:
        print(f"digests: {text}", file=sys.stderr)
    print(f"{len(rows)} rows, {len(found)} problems, {time.monotonic() - start:.0f} s", file=sys.stderr)
    return 1 if found else 0


def jobs(folder: Path) -> list[Job]:
    """Jobs of every driver in every shape."""
    from opencl_drivers import use_every_driver

    use_every_driver()
    from clsplat.device.context import all_devices
    from clsplat.device.drivers.quirks import subgroup_ways

    listed: list[Job] = []
    names = _names()
    for index, name in enumerate(names):
        able = [shape for shape in SHAPES if shape not in SUBGROUPED or subgroup_ways(all_devices()[index])]
        listed += [Job(name, index, shape, train=shape in TRAINED, environment={}) for shape in able]
    for index, name in enumerate(names):
        if name.startswith("PoCL"):
            for method, shapes in METHODS.items():
                own = {"POCL_WORK_GROUP_METHOD": method, "POCL_CACHE_DIR": str(folder / f"pocl-{index}-{method}")}
                listed += [Job(f"{name}, {method}", index, shape, False, own) for shape in shapes]
    library = os.environ.get("CLSPLAT_RUSTICL")
    if library:
        own = rusticl(Path(library), folder / "rusticl")
        listed += [Job("Rusticl", -1, shape, False, own) for shape in ("1x64", "8x1")]
    return listed


def _names() -> list[str]:
    """Names of the devices that are found, in order: PoCL and its version, or the platform's name."""
    from clsplat.device.context import all_devices

    names = []
    for device in all_devices():
        words = device.platform.version.replace("+", " ").replace("-", " ").split()
        name = device.platform.name.split("(")[0].strip()
        names.append(f"PoCL {words[words.index('PoCL') + 1]}" if "PoCL" in words else f"{name} CPU runtime")
    return names


def rusticl(library: Path, folder: Path) -> dict[str, str]:
    """An environment in which that is a driver."""
    folder.mkdir()
    (folder / "rusticl.icd").write_text(f"{library}\n")
    return {"OCL_ICD_VENDORS": str(folder), "RUSTICL_ENABLE": "llvmpipe", "LP_NUM_THREADS": "2"}


def run_all(listed: list[Job], folder: Path) -> list[Row]:
    """Two at a time, each in a process; differences to the first that has the shape to compare with."""
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
    """The numbers of the jobs in the order in which they begin: Rusticl's first, which build longest, so that nothing
    waits for them at the end; then one of each driver in turn, as rows of a driver share kernels, which two at a time
    would both build."""
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
    environment = {**os.environ, "CLSPLAT_TRUST_DRIVER": "1", **job.environment}  # this process is the trial
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
    """Run on the `index`-th device, or with -1 on Rusticl's; print the digests and write the gradients.

    scene: to train on, if any; "open" for a device that is only to be opened, which launches a kernel.
    """
    from golden_frames import arrays_of, checksum, pictures_of, trained

    from clsplat.device.context import Device, all_devices

    found = next(d for d in all_devices() if d.platform.name == "rusticl") if index < 0 else all_devices()[index]
    device = Device(found).with_shape(shape)
    if scene == Path("open"):
        Device(found).kernels("probe")  # in the driver's own shape, whose vectors are probed by a launch
        return
    made = arrays_of(device)
    frame = [part for each in made.values() for name in ("image", "transmittance") for part in each[name]]
    gradient = {f"{scene}/{k}": part for scene, each in made.items() for k, part in enumerate(each["gradients"])}
    gradient.update({f"{scene}/screen": each["screen"][0] for scene, each in made.items()})
    np.savez(arrays, **gradient)  # type: ignore[arg-type]
    unsigned = [part + np.float32(0) for part in gradient.values()]  # a sum that is zero may be so with either sign
    told: dict[str, Any] = {"frame": checksum(frame), "gradient": checksum(unsigned)}
    told["pictures"] = pictures_of(device)
    if scene is not None:
        models = [trained(device, scene) for _ in range(2)]
        names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
        digests = [checksum([getattr(model, name) for name in names]) for model, _ in models]
        told.update(model=digests[0], repeats=digests[0] == digests[1], psnr=models[0][1], gaussians=len(models[0][0]))
    print(json.dumps(told))


def _difference(got: Any, wanted: Any) -> float:
    """The largest of all arrays, relative in norm."""
    return max(
        float(np.linalg.norm(got[key].astype(np.float64) - wanted[key]) / np.linalg.norm(wanted[key])) for key in wanted
    )


def problems(rows: list[Row]) -> list[str]:
    """Rows that are not as they should be, in words."""
    found = []
    good = [row for row in rows if not row.trouble]
    for row in rows:
        expected = (row.driver, row.shape) in EXPECTED
        if row.trouble and not expected:
            found.append(f"{row.driver}, {row.shape}: {row.trouble}")
        elif expected and not row.trouble:
            found.append(f"{row.driver}, {row.shape}: works, and was expected not to: take it from EXPECTED")
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
        other = by_shape.setdefault(row.shape.removesuffix("s"), row)
        if row.gradient != other.gradient:
            found.append(
                f"{at}: the gradient is {row.gradient}, on {other.driver} in that shape it is {other.gradient}"
            )
        if not row.difference <= GRADIENT_BOUND:
            found.append(
                f"{at}: the gradient is {row.difference:.1e} from that of {first.shape}, over {GRADIENT_BOUND:g}"
            )
        if row.model is None:
            continue
        if not row.repeats:
            found.append(f"{at}: two trainings gave two models")
        other = trained.setdefault(row.shape, row)
        if row.model != other.model:
            found.append(f"{at}: the model is {row.model}, on {other.driver} in that shape it is {other.model}")
        reference = next(iter(trained.values()))
        if not abs(row.psnr - reference.psnr) <= PSNR_BOUND:
            found.append(f"{at}: the model has {row.psnr:.2f} dB, that of {reference.shape} {reference.psnr:.2f} dB")
    return found


def other_channels(row: Row, first: Row) -> list[str]:
    """Channels of which a row has other bits than the first row."""
    found = []
    for kind, wanted in first.pictures.items():
        for name, digest in wanted.items():
            got = row.pictures.get(kind, {}).get(name, "missing")
            if got != digest:
                where = f"{row.driver}, {row.shape}: {name} of the {kind} camera"
                found.append(f"{where} is {got}, on {first.driver}, {first.shape} it is {digest}")
    return found


def table(rows: list[Row]) -> str:
    """Table with a row for each shape and result, and all drivers that have it."""
    good = [row for row in rows if not row.trouble]
    drivers: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        if row.trouble:
            reason = EXPECTED.get((row.driver, row.shape), row.trouble)
            cells: tuple[str, ...] = (row.shape, f"not run: {reason}", "", "", "")
        else:
            apart = "" if row.gradient == good[0].gradient else f", {row.difference:.0e} off"
            model = "not trained"
            if row.model is not None:
                model = f"`{row.model}`, {row.psnr:.3f} dB"
            cells = (row.shape, f"`{row.frame}`", f"`{row.channels}`", f"`{row.gradient}`{apart}", model)
        drivers.setdefault(cells, []).append(row.driver)
    header = ("shape", "drivers", "frame", "all channels", "gradient", "trained model")
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    for (shape, *cells_of), names in sorted(drivers.items(), key=lambda pair: SHAPES.index(pair[0][0])):
        lines.append(f"| {shape} | {'; '.join(names)} | {' | '.join(cells_of)} |")
    return "\n".join([*lines, "", *(channel_table(good[0]) if good else ())])


def channel_table(row: Row) -> list[str]:
    """Every channel's digest by kind of camera."""
    names = list(next(iter(row.pictures.values()), {}))
    lines = [f"| camera | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
    for kind, digests in row.pictures.items():
        cells = (f"`{digests[name]}`" if name in digests else "not defined" for name in names)
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
