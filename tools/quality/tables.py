# SPDX-License-Identifier: Apache-2.0
"""Make all tables of docs/quality.md with one command, which may be interrupted, over several days and machines.

    tools/quality/run.py tables SCENES -o FOLDER [--only growth,antialiasing] [--rows 'fox *,bonsai mcmc*']
        [--seeds 2] [--iterations 7000] [--resolution 0] [--kept docs/quality-rows.json] [--list]
    tools/quality/run.py tables --same-as DIGEST --why WORDS [--kept docs/quality-rows.json]

SCENES has fox, banana, sceaux_castle, snowmiku, bonsai and lego_blender_400. Rows of a missing scene are skipped with a
message. Each training has a folder in FOLDER/DIGEST-ITERATIONS-RESOLUTION, in which it continues where it stopped;
quality.md there has the finished rows of all tables.

Finished rows are written to the file --kept, which is to be committed. They are reused if the digest of the code is
equal: of kernels/ and clsplat/config, device, rendering, stages and training, without comments and docstrings, and
without mcmc's module for rows of other growths. Everything else that affects results (scenes, their loading, the
comparison of pictures) is assumed unchanged, and rows of any device are reused. --same-as states that the current code
gives the same bytes as that of DIGEST; WORDS say how this was verified, and are stored.
"""

from __future__ import annotations

import argparse
import fnmatch
import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from statistics import mean

from quality.kept_rows import Finished, Kept, Same, code_digest, device_of

from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write
from clsplat.scenes.analysis.recommendations import SETTINGS_BY_FINDING

ROOT = Path(__file__).resolve().parents[2]
RUN = Path(__file__).with_name("run.py")
SCENES = ("fox", "banana", "sceaux_castle", "snowmiku", "bonsai")
SIZES = (400, 200, 100, 50)
"""Picture sizes at which the antialiased model is measured. It is trained at the first."""


@dataclass(frozen=True)
class Row:
    """A training: its scene's folder and settings.

    settings: {stop} in them is the step at which the short schedule's growth ends.
    half_of: names of rows of this scene; the maximum number of Gaussians is half that of the better row.
    sizes: picture sizes at which the model is also measured.
    """

    name: str
    scene: str
    settings: tuple[str, ...] = ()
    half_of: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()


SHORT, HIGH = ("--schedule", "short"), ("--schedule", "high-rates")
WHOLES = {"default": (), "short": SHORT, "high rates": HIGH}
"""Rows of the growth table with the paper's growth. The first two determine the number that other rows get half of."""
HALVES = {
    "budget": (*SHORT, "--density.growth", "budget"),
    "long axis": (*SHORT, "--density.growth", "budget", "--density.long-axis"),
    "mcmc": (*SHORT, "--density.growth", "mcmc"),
    "high rates long axis": (*HIGH, "--density.growth", "budget", "--density.long-axis"),
    "high rates mcmc": (*HIGH, "--density.growth", "mcmc"),
}
"""Rows of the growth table that get half of the Gaussians."""
FEWEST = ("bonsai", 290_000)
"""A scene, and a number of Gaussians with which mcmc is also measured: a third of the short schedule's number."""
BY_PAPER, FLAT = ("banana", "sceaux_castle"), ("--sh-degree", "0")
"""Scenes with few photographs, also measured at the paper's rates, and with one colour in all directions. From nine
photographs, the dependence on direction is learnt wrongly, and the more so the higher its rate."""


def growth_rows() -> list[Row]:
    """Rows with the paper's growth, and others with half as many Gaussians as the better of default and short."""
    rows = []
    for scene in SCENES:
        rows += [Row(f"{scene} {name}", scene, settings) for name, settings in WHOLES.items()]
        ends = (f"{scene} default", f"{scene} short")
        rows += [Row(f"{scene} {name}", scene, settings, half_of=ends) for name, settings in HALVES.items()]
    until = ("--density.stop", "{stop}")
    by_paper = ("--density.growth", "mcmc", *until)
    for scene in BY_PAPER:
        ends = (f"{scene} default", f"{scene} short")
        more = {
            "long axis paper": ("--density.growth", "budget", "--density.long-axis", *until),
            "mcmc paper": by_paper,
            "mcmc paper thinned": (*by_paper, "--thinning", "0.2"),
            "mcmc paper SH 0": (*by_paper, *FLAT),
            "high rates mcmc SH 0": (*HALVES["high rates mcmc"], *FLAT),
        }
        rows += [Row(f"{scene} {name}", scene, settings, half_of=ends) for name, settings in more.items()]
    scene, most = FEWEST
    for name in ("mcmc", "high rates mcmc"):
        settings = (*HALVES[name], "--density.max-gaussians", str(most))
        rows.append(Row(f"{scene} {name} {most // 1000}k", scene, settings))
    return rows


def antialiasing_rows() -> list[Row]:
    """lego with and without antialiasing, measured at smaller and smaller sizes."""
    usual = (*SHORT, "--background", "white", "--resolution", str(SIZES[0]))
    return [
        Row("lego", "lego_blender_400", usual, sizes=SIZES),
        Row("lego antialiased", "lego_blender_400", (*usual, "--antialiased"), sizes=SIZES),
    ]


TRAININGS: dict[str, Callable[[], list[Row]]] = {"growth": growth_rows, "antialiasing": antialiasing_rows}
SIZED = ("--iterations", "{iterations}", "--resolution", "{resolution}")
AUTO = ("--try", "auto:" + ",".join(f"{name}={value}" for name, value in SETTINGS_BY_FINDING["few views"][0].items()))
"""Settings that --auto takes for few photographs."""
FEW = ("--views", "3,6,9,12", "--seeds", "0,1")
EXPOSED = ("--with", "schedule=high-rates,density.growth=mcmc,density.max_gaussians=290000")
"""Settings of bonsai's trainings with and without gains."""
CAMERAS = ("--appearance", "ppisp", "--mixes", "0.15", "--corners", "0.8")
"""Arguments for photographs with mixed channels, and a lens that darkens the corners."""
EXPERIMENTS: dict[str, tuple[str, ...]] = {
    "masks": ("masks", "{work}", "{scenes}/fox", *SIZED),
    "exposure": ("exposure", "{work}", "{scenes}/bonsai", *SIZED, *EXPOSED),
    "cameras": ("exposure", "{work}", "{scenes}/fox", "--iterations", "{iterations}", *CAMERAS),
    "fisheye": ("fisheye", "{work}", "--iterations", "{iterations}"),
    "poses": ("poses", "{work}", "--width", "320", "--iterations", "{iterations}"),
    "lenses": ("poses", "{work}", "--width", "320", "--lens", "2", "--iterations", "{iterations}"),
    "points": ("points", "{work}", "--iterations", "{iterations}"),
    "real points": ("points", "{work}", "{scenes}/rgbd_7scenes", "--iterations", "{iterations}"),
    "few views of fox": ("views", "{work}", "{scenes}/fox", *SIZED, *FEW, *AUTO),
    "few views of bonsai": ("views", "{work}", "{scenes}/bonsai", *SIZED, *FEW, *AUTO),
}
"""Commands of the experiments' tables, with placeholders. They run once per seed, except those that take several
seeds."""


class Book:
    """The trainings in a folder, and the file of finished trainings."""

    def __init__(self, scenes: Path, folder: Path, seeds: int, iterations: int, resolution: int, kept: Kept) -> None:
        self.scenes, self.folder, self.seeds, self.kept = scenes, folder, seeds, kept
        self.iterations, self.resolution = iterations, resolution
        folder.mkdir(parents=True, exist_ok=True)

    def results(self, table: str, row: Row, rows: Sequence[Row]) -> list[Finished]:
        """The row's training for each seed; unfinished ones are trained. rows: those that `half_of` may name."""
        most = self._most(table, row, rows)
        return [self._result(table, row, seed, most[seed]) for seed in range(self.seeds)]

    def _most(self, table: str, row: Row, rows: Sequence[Row]) -> list[tuple[str, ...]]:
        """Settings per seed: half of the Gaussians of the better row of `half_of`, trained with the same seed, so that
        seeds are independent."""
        if not row.half_of:
            return [()] * self.seeds
        others = [self.results(table, other, rows) for other in rows if other.name in row.half_of]
        better = max(others, key=lambda found: mean(result.psnr for result in found))
        return [("--density.max-gaussians", str(result.gaussians // 2)) for result in better]

    def _result(self, table: str, row: Row, seed: int, most: Sequence[str]) -> Finished:
        settings = (*(each.format(stop=5 * self.iterations // 7) for each in row.settings), *most)
        code = code_digest(ROOT, mcmc="mcmc" in settings)
        named = (table, row.name, seed, settings, self.iterations, self.resolution, code, commit())
        if known := self.kept.find(Finished(*named, "", "", 0.0, 0.0, 0, 0.0)):
            return known
        given = hashlib.blake2b(repr(settings).encode(), digest_size=4).hexdigest()
        run = self.folder / table / f"{row.name.replace(' ', '-')}-{seed}-{given}-{code}"
        run.parent.mkdir(exist_ok=True)
        print(f"{table}: {row.name}, seed {seed}", file=sys.stderr, flush=True)
        size = ("--iterations", str(self.iterations), "--resolution", str(self.resolution))
        begun = (run / "config.toml").exists()
        more = ("--resume",) if begun else (*size, *settings, "--seed", str(seed))
        _clsplat("train", str(self.scenes / row.scene), "-o", str(run), "--no-report", *more)
        found = json.loads((run / "eval.json").read_text("utf-8"))
        sizes = tuple(self._psnr_at(run, size) for size in row.sizes)
        today, psnr, ssim = datetime.now(timezone.utc).date().isoformat(), found["mean"]["psnr"], found["mean"]["ssim"]
        ends = (psnr, ssim, found["gaussians"], round(found["seconds"], 1), sizes)
        finished = Finished(*named, device_of(run), today, *ends)
        self.kept.add(finished)
        return finished

    def _psnr_at(self, run: Path, size: int) -> float:
        told = _clsplat("eval", str(run), "--resolution", str(size), "--json")
        return float(json.loads(told)["mean"]["psnr"])

    def printed(self, table: str) -> str:
        """The tables of an experiment for each seed."""
        if "--seeds" in EXPERIMENTS[table]:
            return self._said(table, table)
        parts = (
            f"Seed {seed}\n\n{self._said(table, f'{table}-{seed}', '--seed', str(seed))}" for seed in range(self.seeds)
        )
        return "\n".join(parts)

    def _said(self, table: str, name: str, *more: str) -> str:
        done = self.folder / f"{name}.md"
        if not done.exists():
            print(f"{table}: {' '.join([EXPERIMENTS[table][0], *more])}", file=sys.stderr, flush=True)
            known: dict[str, object] = {"scenes": self.scenes, "work": self.folder / name}
            known |= {"iterations": self.iterations, "resolution": self.resolution}
            words = (word.format(**known) for word in EXPERIMENTS[table])
            atomic_write(done, _run([sys.executable, str(RUN), *words, *more]).encode())
        return done.read_text("utf-8")


def _clsplat(*arguments: str) -> str:
    return _run([sys.executable, "-m", "clsplat", *arguments])


def _run(command: Sequence[str]) -> str:
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"quality tables: {' '.join(command[1:])} ended with status {done.returncode}; its rows are not done")
    return done.stdout


def line(row: Row, found: Sequence[Finished]) -> str:
    """A row in Markdown: means and ranges over the seeds."""
    psnr = [result.psnr for result in found]
    cells = [
        row.name,
        f"{mean(psnr):.2f}",
        f"{max(psnr) - min(psnr):.2f}",
        f"{mean(result.ssim for result in found):.4f}",
        f"{round(mean(result.gaussians for result in found)):,}",
        f"{mean(result.seconds for result in found):.0f}",
        " and ".join(sorted({result.device for result in found})),
        *(f"{mean(result.sizes[k] for result in found):.2f}" for k in range(len(row.sizes))),
    ]
    if row.sizes:
        cells.append(f"{mean(mean(result.sizes) for result in found):.2f}")
    return f"| {' | '.join(cells)} |"


def header(rows: Sequence[Row]) -> str:
    """The first two lines of a table."""
    sizes = rows[0].sizes
    cells = ["scene", "PSNR, dB", "seeds' range", "SSIM", "Gaussians", "seconds", "on", *map(str, sizes)]
    cells += ["mean"] if sizes else []
    return f"| {' | '.join(cells)} |\n{'|---' * len(cells)}|"


def commit() -> str:
    """Git's name of the measured commit."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=10"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return described.stdout.strip() or "unknown"


def say_same(kept: Kept, was: str, why: str) -> int:
    """Store the statement that a digest's rows hold for the current code. Raises InputError if there are no such
    rows."""
    for mcmc in (False, True):
        if kept.has(was, mcmc=mcmc):
            kept.say_same(Same(code_digest(ROOT, mcmc=mcmc), was, why))
            return 0
    raise InputError(f"--same-as {was}: no row of {kept.path} has this digest")


def run(arguments: list[str]) -> int:
    """Make the tables and print them. Raises InputError for unknown tables or rows."""
    names = [*TRAININGS, *EXPERIMENTS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="?")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--only", default=",".join(names), help=f"of {', '.join(names)}")
    parser.add_argument("--rows", default="*", help="patterns of rows' names, and what these need")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--resolution", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="print the rows, and train nothing")
    parser.add_argument("--kept", type=Path, default=ROOT / "docs" / "quality-rows.json", help="file of finished rows")
    parser.add_argument("--same-as", metavar="DIGEST", help="state that this code gives the bytes of another")
    parser.add_argument("--why", metavar="WORDS", help="how --same-as was found")
    given = parser.parse_args(arguments)
    if given.same_as:
        if not given.why:
            parser.error("--same-as: expected --why too, how it was found that no byte changes")
        return say_same(Kept(given.kept), given.same_as, given.why)
    if given.scenes is None or given.output is None:
        parser.error("expected a folder of scenes, and -o FOLDER")
    wanted = given.only.split(",")
    if unknown := [name for name in wanted if name not in names]:
        raise InputError(f"--only {unknown[0]}: no such table, expected some of {', '.join(names)}")
    patterns = given.rows.split(",")
    every = [row.name for name in wanted if name in TRAININGS for row in TRAININGS[name]()]
    if strange := [each for each in patterns if each != "*" and not fnmatch.filter(every, each)]:
        raise InputError(f"--rows {strange[0]}: no such row; --list prints them")
    text = ""
    folder = given.output / f"{code_digest(ROOT, mcmc=True)}-{given.iterations}-{given.resolution or 'full'}"
    size = (given.iterations, given.resolution)
    book = None if given.list else Book(given.scenes, folder, given.seeds, *size, Kept(given.kept))
    for table in wanted:
        lines = []
        rows = TRAININGS[table]() if table in TRAININGS else []
        there = [row for row in rows if (given.scenes / row.scene).is_dir()]
        for row in rows:
            if not any(fnmatch.fnmatchcase(row.name, pattern) for pattern in patterns):
                continue
            if row not in there:
                print(f"quality tables: {row.name} is left out: no {given.scenes / row.scene}", file=sys.stderr)
            elif book is None:
                print(f"{table}: {row.name} {' '.join(row.settings)}".rstrip())
            else:
                lines.append(line(row, book.results(table, row, there)))
        if book is None:
            if table in EXPERIMENTS:
                print(f"{table}: {' '.join(EXPERIMENTS[table])}")
            continue
        body = book.printed(table) if table in EXPERIMENTS else "\n".join([header(there), *lines, ""]) if lines else ""
        text += f"## {table}\n\n{body}\n"
        atomic_write(book.folder / "quality.md", text.encode())
    print(text, end="")
    return 0
