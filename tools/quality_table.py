#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Every table of docs/quality.md, from one command that can be interrupted: finished rows are kept by commit.

    python tools/quality_table.py SCENES -o FOLDER [--only growth,antialiasing] [--rows 'fox *,bonsai mcmc*']
        [--seeds 2] [--iterations 7000] [--resolution 0] [--list]

SCENES has fox, banana, sceaux_castle, snowmiku, bonsai and lego_blender_400; a row whose scene is missing is left out,
and said. Each training has a folder below FOLDER/COMMIT-ITERATIONS-RESOLUTION, in which it goes on where it stopped;
quality.md there has all tables as far as they are done. A tree with changes that are not committed has "-dirty" in its
name: remove that folder after a further change.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from clsplat.files import atomic_write  # noqa: E402

SCENES = ("fox", "banana", "sceaux_castle", "snowmiku", "bonsai")
SIZES = (400, 200, 100, 50)
"""Pictures' sides at which the antialiased model is measured; it is trained at the first."""


@dataclass(frozen=True)
class Row:
    """A training: its scene's folder and settings. half_of: names of rows of this scene; the most Gaussians are half
    of the better one's. sizes: pictures' sides to measure at, beside the one it was trained at."""

    name: str
    scene: str
    settings: tuple[str, ...] = ()
    half_of: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Result:
    """A finished training: PSNR in dB and SSIM of the held-out views, Gaussians, seconds; PSNR by size."""

    psnr: float
    ssim: float
    gaussians: int
    seconds: float
    sizes: tuple[float, ...] = ()


HALVES = {
    "budget": ("--density.growth", "budget"),
    "long axis": ("--density.growth", "budget", "--density.long-axis"),
    "mcmc": ("--density.growth", "mcmc"),
}
"""Rows of the growth table that get half of the Gaussians."""
FEWEST = ("bonsai", 290_000)
"""A scene whose mcmc is measured with this many Gaussians too, a third of what the short schedule ends with."""


def growth_rows() -> list[Row]:
    """The paper's growth and the short schedule, and the others with half of the better one's Gaussians."""
    rows = []
    for scene in SCENES:
        rows += [Row(f"{scene} default", scene), Row(f"{scene} short", scene, ("--schedule", "short"))]
        ends = (f"{scene} default", f"{scene} short")
        for name, more in HALVES.items():
            rows.append(Row(f"{scene} {name}", scene, ("--schedule", "short", *more), half_of=ends))
    scene, most = FEWEST
    settings = ("--schedule", "short", *HALVES["mcmc"], "--density.max-gaussians", str(most))
    return [*rows, Row(f"{scene} mcmc {most // 1000}k", scene, settings)]


def antialiasing_rows() -> list[Row]:
    """lego with and without, seen from farther and farther."""
    usual = ("--schedule", "short", "--background", "white", "--resolution", str(SIZES[0]))
    return [
        Row("lego", "lego_blender_400", usual, sizes=SIZES),
        Row("lego antialiased", "lego_blender_400", (*usual, "--antialiased"), sizes=SIZES),
    ]


TRAININGS: dict[str, Callable[[], list[Row]]] = {"growth": growth_rows, "antialiasing": antialiasing_rows}
FEW_VIEWS = ("--iterations", "{iterations}", "--seeds", "0,1", "--try", "thinning:thinning=0.2")
AUTO = ("--try", "auto:thinning=0.2,penalty=0.02,iterations=2000")
"""Settings that --auto takes for few photographs."""
TOOLS: dict[str, tuple[str, ...]] = {
    "exposure": ("quality_exposure.py", "{scenes}/bonsai", "{work}", "--iterations", "{iterations}"),
    "fisheye": ("quality_fisheye.py", "{work}", "--iterations", "{iterations}"),
    "poses": ("quality_poses.py", "{work}", "--width", "320", "--iterations", "{iterations}"),
    "lenses": ("quality_poses.py", "{work}", "--width", "320", "--lens", "2", "--iterations", "{iterations}"),
    "points": ("quality_points.py", "{work}", "--iterations", "{iterations}"),
    "real points": ("quality_points.py", "{work}", "--rgbd", "{scenes}/rgbd_7scenes", "--iterations", "{iterations}"),
    "few views of fox": ("quality_views.py", "{scenes}/fox", "{work}", *FEW_VIEWS, *AUTO),
    "few views of bonsai": ("quality_views.py", "{scenes}/bonsai", "{work}", *FEW_VIEWS, *AUTO),
}
"""Tables that tools of their own print: the commands, with the folder of scenes, one to work in, and the steps."""


class Book:
    """Finished rows of a commit, in a folder."""

    def __init__(self, scenes: Path, folder: Path, seeds: int, iterations: int, resolution: int) -> None:
        self.scenes, self.folder, self.seeds, self.iterations = scenes, folder, seeds, iterations
        self.settings = ("--iterations", str(iterations), "--resolution", str(resolution))
        folder.mkdir(parents=True, exist_ok=True)

    def results(self, table: str, row: Row, rows: Sequence[Row]) -> list[Result]:
        """One for each seed, trained where that is not done yet."""
        most = self._most(table, row, rows)
        return [self._result(table, row, seed, most) for seed in range(self.seeds)]

    def _most(self, table: str, row: Row, rows: Sequence[Row]) -> tuple[str, ...]:
        if not row.half_of:
            return ()
        others = [self.results(table, other, rows) for other in rows if other.name in row.half_of]
        better = max(others, key=lambda found: mean(result.psnr for result in found))
        return ("--density.max-gaussians", str(int(mean(result.gaussians for result in better)) // 2))

    def _result(self, table: str, row: Row, seed: int, most: Sequence[str]) -> Result:
        run = self.folder / table / f"{row.name.replace(' ', '-')}-{seed}"
        done = run.parent / f"{run.name}.json"
        if done.exists():
            return Result(**json.loads(done.read_text("utf-8")))
        run.parent.mkdir(exist_ok=True)
        print(f"{table}: {row.name}, seed {seed}", file=sys.stderr, flush=True)
        given = [*self.settings, *row.settings, *most, "--seed", str(seed), "--no-report"]
        how = ["--resume"] if (run / "config.toml").exists() else []
        _clsplat("train", str(self.scenes / row.scene), "-o", str(run), *given, *how)
        found = json.loads((run / "eval.json").read_text("utf-8"))
        sizes = tuple(self._psnr_at(run, size) for size in row.sizes)
        values: dict[str, Any] = {
            "psnr": found["mean"]["psnr"],
            "ssim": found["mean"]["ssim"],
            "gaussians": found["gaussians"],
            "seconds": found["seconds"],
            "sizes": sizes,
        }
        atomic_write(done, json.dumps(values).encode())
        return Result(**values)

    def _psnr_at(self, run: Path, size: int) -> float:
        told = _clsplat("eval", str(run), "--resolution", str(size), "--json")
        return float(json.loads(told)["mean"]["psnr"])

    def printed(self, table: str) -> str:
        """The words of a tool with a table of its own."""
        done = self.folder / f"{table}.md"
        if not done.exists():
            print(f"{table}: {TOOLS[table][0]}", file=sys.stderr, flush=True)
            known = {"scenes": self.scenes, "work": self.folder / table, "iterations": self.iterations}
            name, *more = (word.format(**known) for word in TOOLS[table])
            words = _run([sys.executable, str(ROOT / "tools" / name), *more])
            atomic_write(done, words.encode())
        return done.read_text("utf-8")


def _clsplat(*arguments: str) -> str:
    return _run([sys.executable, "-m", "clsplat", *arguments])


def _run(command: Sequence[str]) -> str:
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"quality_table: {' '.join(command[1:])} ended with status {done.returncode}; its rows are not done")
    return done.stdout


def line(row: Row, found: Sequence[Result]) -> str:
    """A row in Markdown: means of the seeds, and how far apart they are."""
    psnr = [result.psnr for result in found]
    cells = [
        row.name,
        f"{mean(psnr):.2f}",
        f"{max(psnr) - min(psnr):.2f}",
        f"{mean(result.ssim for result in found):.4f}",
        f"{round(mean(result.gaussians for result in found)):,}",
        f"{mean(result.seconds for result in found):.0f}",
        *(f"{mean(result.sizes[k] for result in found):.2f}" for k in range(len(row.sizes))),
    ]
    if row.sizes:
        cells.append(f"{mean(mean(result.sizes) for result in found):.2f}")
    return f"| {' | '.join(cells)} |"


def header(rows: Sequence[Row]) -> str:
    """The two first lines of a table."""
    sizes = rows[0].sizes
    cells = ["scene", "PSNR, dB", "seeds' range", "SSIM", "Gaussians", "seconds", *map(str, sizes)]
    cells += ["mean"] if sizes else []
    return f"| {' | '.join(cells)} |\n{'|---' * len(cells)}|"


def commit() -> str:
    """The name of the tree that is measured."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=10"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return described.stdout.strip() or "unknown"


def main(arguments: list[str]) -> int:
    """Make the tables and print them; 2 for a table that is not known or scenes that are not there."""
    names = [*TRAININGS, *TOOLS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--only", default=",".join(names), help=f"of {', '.join(names)}")
    parser.add_argument("--rows", default="*", help="patterns of rows' names, and what these need")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--resolution", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="print the rows, and train nothing")
    given = parser.parse_args(arguments)
    wanted = given.only.split(",")
    if unknown := [name for name in wanted if name not in names]:
        known = ", ".join(names)
        print(f"quality_table: --only {unknown[0]}: no such table, expected some of {known}", file=sys.stderr)
        return 2
    patterns = given.rows.split(",")
    every = [row.name for name in wanted if name in TRAININGS for row in TRAININGS[name]()]
    if strange := [each for each in patterns if each != "*" and not fnmatch.filter(every, each)]:
        print(f"quality_table: --rows {strange[0]}: no such row; --list prints them", file=sys.stderr)
        return 2
    text = ""
    folder = given.output / f"{commit()}-{given.iterations}-{given.resolution or 'full'}"
    book = None if given.list else Book(given.scenes, folder, given.seeds, given.iterations, given.resolution)
    for table in wanted:
        lines = []
        rows = TRAININGS[table]() if table in TRAININGS else []
        there = [row for row in rows if (given.scenes / row.scene).is_dir()]
        for row in rows:
            if not any(fnmatch.fnmatchcase(row.name, pattern) for pattern in patterns):
                continue
            if row not in there:
                print(f"quality_table: {row.name} is left out: no {given.scenes / row.scene}", file=sys.stderr)
            elif book is None:
                print(f"{table}: {row.name} {' '.join(row.settings)}".rstrip())
            else:
                lines.append(line(row, book.results(table, row, there)))
        if book is None:
            if table in TOOLS:
                print(f"{table}: {' '.join(TOOLS[table])}")
            continue
        body = book.printed(table) if table in TOOLS else "\n".join([header(there), *lines, ""]) if lines else ""
        text += f"## {table}\n\n{body}\n"
        atomic_write(book.folder / "quality.md", text.encode())
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
