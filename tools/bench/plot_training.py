#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Plot held-out PSNR over seconds of training, with a line for each run, as SVG or PNG.

    clsplat train SCENE -o RUN --eval-at 500,1000,2000,4000,7000
    python tools/bench/plot_training.py RUN [RUN ...] -o training.svg [--title TEXT]

Reads the evaluations in each run's metrics.jsonl, and its eval.json. Needs matplotlib: pip install 'clsplat[plot]'.
"""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import suppress
from pathlib import Path

from plotting import plot_training

from clsplat.bench.plots import check_plot
from clsplat.errors import InputError
from clsplat.runs.run import Run


def curve(path: Path) -> list[tuple[float, float]]:
    """(seconds, PSNR) of every evaluation of a run. Raises InputError if there is none."""
    run = Run.open(path)
    found = [record["eval"] for record in run.read_metrics() if "eval" in record]
    with suppress(OSError):
        found.append(json.loads(run.eval_path.read_text("utf-8")))
    points = {
        (float(each["seconds"]), float(each["mean"]["psnr"]))
        for each in found
        if each.get("seconds") is not None and "psnr" in each["mean"]
    }
    if not points:
        raise InputError(f"{path}: has no evaluations, expected a run with held-out views (train --eval-at)")
    return sorted(points)


def main(arguments: list[str]) -> int:
    """Read the runs and write the plot."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path)
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=True)
    parser.add_argument("--title", default="Seconds of training against held-out PSNR")
    options = parser.parse_args(arguments)
    try:
        check_plot(options.output)
        names = [path.name for path in options.runs]
        unique = len(set(names)) == len(names)
        curves = {path.name if unique else str(path): curve(path) for path in options.runs}
    except InputError as error:
        print(f"plot_training: error: {error}", file=sys.stderr)
        return error.exit_status
    plot_training(options.output, curves, options.title)
    for name, points in curves.items():
        print(name, *(f"{seconds:.1f} s {psnr:.2f} dB" for seconds, psnr in points), sep="  ")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
