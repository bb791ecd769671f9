# SPDX-License-Identifier: Apache-2.0
"""Measure the time of a training step by the number of Gaussians, on the plain of `run large`.

    tools/stress/run sizes [--gaussians 2e5,6e5,2e6,6e6,20e6] [--degree 3] [--steps 60] [--dense]
        [--before CHECKOUT] [--before-gaussians 6e6] [--device DEVICE] [--json] [--plot FILE]

By default each of 60 views comes once, so that nearly all chunks of a view are fetched if the model is in a file.

Times are medians: wall time, and in brackets and in the plot the processor time of all threads, which other load
changes less. A model is trained with everything in memory. It is trained again with 0.3 of its parameters and moments
in memory, and the others in a scratch file (--max-host-mem). --before: the folder of another version, whose steps are
measured on the same scene, up to --before-gaussians. Each training has a process of its own. The exit status is 1 if
the digests of a size differ.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from measuring import number, plain_parser, require, tool
from plain import CELL_ROWS, write_scene
from plotting import Panel, plot_growth
from stress_kills import tail

from clsplat.bench.plots import check_plot
from clsplat.errors import ClsplatError
from clsplat.gaussians import floats_of
from clsplat.progress import aligned
from clsplat.rendering.memory_needs import MODELS

IN_MEMORY, IN_A_FILE, BEFORE = "all in memory", "0.3 in memory, the rest in a file", "before"
SHARE_IN_MEMORY = 0.3
LEAST_LIMIT = 32 << 20
"""Bytes of a limit that are enough for the photographs and some chunks."""
VIEWS = 60


def answer(command: Sequence[str], version: Path) -> Any:
    """The JSON that a Python process prints. Raises ClsplatError. version: folder from which it imports clsplat."""
    environment = {**os.environ, "PYTHONPATH": str(version)}
    done = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ClsplatError(f"{' '.join(command[:2])}: ended with status {done.returncode}: {tail(done.stderr)}")
    return json.loads(done.stdout)


def measured(options: Any, count: int) -> dict[str, Any]:
    """Times of a step (`plain.timed_steps`) with this number of Gaussians, keyed by where the model is, or BEFORE."""
    here, on = Path(__file__).resolve().parent, [options.device] if options.device else []
    state = count * MODELS * 4 * floats_of((options.degree + 1) ** 2)
    flags = ["--gaussians", count, "--degree", options.degree, "--steps", options.steps, "--views", VIEWS, "--json"]
    flags += ["--dense"] if options.dense else []
    flags += ["--device", *on] if on else []
    limit = ["--max-host-mem", max(int(SHARE_IN_MEMORY * state), LEAST_LIMIT)]
    found = {}
    for name, more in ((IN_MEMORY, []), (IN_A_FILE, limit)):
        found[name] = answer([str(here / "run"), "large", *map(str, [*flags, *more])], here.parents[1])
    if found[IN_MEMORY]["digest"] != found[IN_A_FILE]["digest"]:
        raise ClsplatError(f"{count:,} Gaussians: the digests differ, expected the same: {found}")
    if options.before is not None and count <= options.before_gaussians:
        with tempfile.TemporaryDirectory() as folder:
            write_scene(Path(folder), -(-count // CELL_ROWS), VIEWS, near=False)
            numbers = map(str, (count, options.degree, options.steps, int(options.dense)))
            found[BEFORE] = answer([str(here / "whole_steps.py"), folder, *numbers, *on], options.before)
    return {"gaussians": count, **found}


def both(times: dict[str, float]) -> str:
    """Text with a step's time and, in brackets, its processor time."""
    return f"{times['median_ms']:.1f} ({times['processor_ms']:.1f})"


def draw(path: Path, rows: Sequence[dict[str, Any]], ways: Sequence[str], title: str) -> None:
    """Plot the processor times."""
    lines = {way: [(row["gaussians"] / 1e6, row[way]["processor_ms"]) for row in rows if way in row] for way in ways}
    plot_growth(path, [Panel("million Gaussians", "processor ms a step, median", lines)], title)


@tool("stress_sizes")
def main(arguments: Sequence[str]) -> int:
    """Measure, and print the table. Returns the exit status."""
    parser = plain_parser(__doc__)
    parser.add_argument("--gaussians", default="2e5,6e5,2e6,6e6,20e6")
    parser.add_argument("--degree", type=int, default=3)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--dense", action="store_true")
    parser.add_argument("--before", type=Path)
    parser.add_argument("--before-gaussians", type=number, default=6_000_000)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args(arguments)
    if options.plot is not None:
        check_plot(options.plot)
    is_there = options.before is None or (options.before / "clsplat").is_dir()
    require(is_there, f"--before {options.before}: has no folder clsplat, expected that of a version")
    rows = []
    for count in map(number, options.gaussians.split(",")):
        rows.append(measured(options, count))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    ways = [way for way in (IN_MEMORY, IN_A_FILE, BEFORE) if any(way in row for row in rows)]
    cells = [(f"{row['gaussians']:,}", *(both(row[way]) if way in row else "" for way in ways)) for row in rows]
    print(json.dumps(rows) if options.json else "\n".join(aligned([("Gaussians", *ways), *cells])))
    if options.plot is not None:
        kind = "dense" if options.dense else "sparse"
        draw(options.plot, rows, ways, f"A training step, SH degree {options.degree}, {kind} Adam")
    return 0
