# SPDX-License-Identifier: Apache-2.0
"""Write a made-up survey of many images and points, and measure how it is read.

    tools/stress/run survey [--images 20000] [--points 20e6] [--observations 100e6] [--frames 60000]
        [--kinds binary,text,transforms] [--folder FOLDER] [--json]
    tools/stress/run survey --read FOLDER

Each kind is written (`survey.py`), read and removed in turn. With the default numbers a kind takes up to 8 GB of the
disk. Photographs are small files, of which only headers are read. Prints for each step the processor time of all
threads, the wall time, and the peak of the process's resident memory:

    read     cameras, images and points of a model (`colmap.read_model`)
    load     the whole scene with its checks (`load_scene`)
    unit     the scene's length unit, which needs observations (`length_unit_of`)

--folder: where the survey is written; a temporary folder by default. It must not exist.
--read: read the scene in this folder, whatever wrote it, and print the numbers as JSON.
Each kind is read in a process of its own. The exit status is 1 if binary and text differ in an image or a point.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from measuring import number, plain_parser, require, tool
from stress_sizes import answer
from survey import Survey, write_binary, write_pictures, write_text, write_transforms

from clsplat.progress import aligned
from clsplat.scenes.dataset import DataSet
from clsplat.scenes.depth_sources import length_unit_of
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers import colmap

KINDS = ("binary", "text", "transforms")
T = TypeVar("T")


def reading(folder: Path) -> dict[str, Any]:
    """Read the scene in a folder. Returns the times and peaks of the steps, and the scene's counts and warnings."""
    rows: dict[str, Any] = {}
    if (model := colmap.find_model(folder)) is not None:
        rows["digest"] = digest_of(measured(rows, "read", lambda: colmap.read_model(model)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = measured(rows, "load", lambda: load_scene(folder))
        rows["length_unit"] = measured(rows, "unit", lambda: length_unit_of(scene))
    rows["images"], rows["points"], rows["warnings"] = len(scene.views), len(scene.points), scene.warnings
    return rows


def measured(rows: dict[str, Any], step: str, work: Callable[[], T]) -> T:
    """The result of a step, whose times and peak are added to `rows`."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    begin, processor = time.perf_counter(), time.process_time()
    result = work()
    seconds, busy = time.perf_counter() - begin, time.process_time() - processor
    rows[step] = {"processor_s": busy, "seconds": seconds, "peak_mib": peak_mib()}
    return result


def peak_mib() -> int:
    """The peak of this process's resident memory in MiB."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) >> 10


def digest_of(data: DataSet) -> str:
    """A digest of all images and points of a data set."""
    state = hashlib.sha256()
    for image in data.images:
        state.update(repr((image.name, image.lens, image.rotation.tolist(), image.translation.tolist())).encode())
    for array in (data.points, data.colors):
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()[:16]


def write(kind: str, folder: Path, options: Any) -> int:
    """Write a survey. Returns the bytes of its cameras, images and points."""
    folder.mkdir()
    images = options.frames if kind == "transforms" else options.images
    own = max(options.points // options.images, 1)
    survey = Survey(images, own, max(round(options.observations / options.points), 1))
    write_pictures(survey, folder / "images")
    if kind == "transforms":
        write_transforms(survey, folder / "transforms.json")
        return (folder / "transforms.json").stat().st_size
    model = folder / "sparse" / "0"
    (write_binary if kind == "binary" else write_text)(survey, model)
    return sum(file.stat().st_size for file in model.iterdir())


@tool("stress_survey")
def main(arguments: Sequence[str]) -> int:
    """Write and read surveys, and print the table. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("--images", type=number, default=20_000)
    parser.add_argument("--points", type=number, default=20_000_000)
    parser.add_argument("--observations", type=number, default=100_000_000)
    parser.add_argument("--frames", type=number, default=60_000)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--read", type=Path)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    if options.read is not None:
        print(json.dumps(reading(options.read)))
        return 0
    kinds = options.kinds.split(",")
    unknown = [kind for kind in kinds if kind not in KINDS]
    require(not unknown, f"--kinds {options.kinds}: expected some of {', '.join(KINDS)}, separated by commas")
    require(options.folder is None or not options.folder.exists(), f"--folder {options.folder}: exists, expected none")
    here, found = Path(__file__).resolve().parent, {}
    for kind in kinds:
        folder = options.folder or Path(tempfile.mkdtemp()) / "survey"
        try:
            size = write(kind, folder, options)
            found[kind] = {
                "bytes": size,
                **answer([str(here / "run"), "survey", "--read", str(folder)], here.parents[1]),
            }
        finally:
            shutil.rmtree(folder if options.folder else folder.parent, ignore_errors=True)
        print(json.dumps({kind: found[kind]}), file=sys.stderr, flush=True)
    print(json.dumps(found) if options.json else "\n".join(table(found)))
    return int(len({rows["digest"] for rows in found.values() if "digest" in rows}) > 1)


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """The lines of the table."""
    cells: list[tuple[str, ...]] = [("kind", "size", "step", "processor time", "time", "peak")]
    for kind, rows in found.items():
        for step in ("read", "load", "unit"):
            if step in rows:
                row = rows[step]
                times = f"{row['processor_s']:.1f} s", f"{row['seconds']:.1f} s", f"{row['peak_mib']:,} MiB"
                cells.append((kind, f"{rows['bytes'] / 1e6:,.0f} MB", step, *times))
    return aligned(cells)
