#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Run the experiments of docs/quality.md, by name.

    .venv/bin/python tools/quality/run.py NAME FOLDER [SCENE...] [--iterations N] [--seed N] [--help]
    .venv/bin/python tools/quality/run.py tables SCENES -o FOLDER [--help]

NAME is masks, exposure, fisheye, points, colours, poses, views, seeds, orders, towns, blocks, borders, sfm, formats or
units; `tables` makes all tables of the page. FOLDER gets the created scenes and the runs. They are reused, so that a
call continues where an earlier one stopped. The tables are Markdown.
"""

from __future__ import annotations

import argparse
import sys
from inspect import cleandoc
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from quality import tables
from quality.experiments import EXPERIMENTS
from quality.trainings import Rows

from clsplat.errors import ClsplatError, InputError


def parser_of(name: str) -> argparse.ArgumentParser:
    """The options of an experiment."""
    experiment = EXPERIMENTS[name]
    parser = argparse.ArgumentParser(
        prog=f"run.py {name}",
        description=cleandoc(experiment.rows.__doc__ or ""),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    if experiment.scenes:
        parser.add_argument("scenes", metavar="SCENE", type=Path, nargs=experiment.scenes)
    parser.add_argument("--iterations", type=int, default=experiment.iterations)
    parser.add_argument("--seed", type=int, default=0)
    for flag, settings in experiment.options.items():
        parser.add_argument(flag, **settings)
    return parser


def show(rows: Rows) -> int:
    """Print rows as they come, with a line below the first row of each table. Returns the experiment's status."""
    before = ""
    while True:
        try:
            row = next(rows)
        except StopIteration as end:
            return end.value or 0
        kind = "text" if isinstance(row, str) else "row"
        if before not in ("", kind):
            print()
        print(row if isinstance(row, str) else f"| {' | '.join(map(str, row))} |", flush=True)
        if kind == "row" and before != "row":
            print("|---" * len(row) + "|", flush=True)
        before = kind


def main(words: list[str]) -> int:
    """Run an experiment. Returns 1 if it fails, and 2 for invalid arguments."""
    name, *words = words or ["--help"]
    if name in ("-h", "--help"):
        print(__doc__)
        return 0
    if name != "tables" and name not in EXPERIMENTS:
        print(f"quality: error: {name}: expected one of {', '.join([*EXPERIMENTS, 'tables'])}", file=sys.stderr)
        return 2
    try:
        if name == "tables":
            return tables.run(words)
        given = parser_of(name).parse_args(words)
        scenes = getattr(given, "scenes", None) or []
        given.scenes = scenes if isinstance(scenes, list) else [scenes]
        return show(EXPERIMENTS[name].rows(given))
    except (ClsplatError, OSError) as error:
        print(f"quality {name}: error: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
