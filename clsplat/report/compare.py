# SPDX-License-Identifier: Apache-2.0
"""Runs side by side: scores, Gaussians, times, settings that differ, curves overlaid, and time against error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from markupsafe import Markup

from clsplat.errors import InputError, examples, plain
from clsplat.files import atomic_write
from clsplat.report.figures import SCORES, Figures, read_figures, settings_of, smooth
from clsplat.report.page import TITLES, duration, render_page, score, setting_text
from clsplat.report.svg import COLORS, Series, chart
from clsplat.runs.run import Run

MAX_RUNS = 24
MAX_ROWS = 100
"""Views in the table."""


@dataclass
class Comparison:
    """runs; labels: a name of each that no other has; notes: what makes figures hard to compare."""

    runs: list[Figures]
    labels: list[str]
    notes: list[str] = field(default_factory=list)

    @property
    def differing(self) -> dict[str, list[Any]]:
        """Values of each run by flag, where they are not all the same."""
        settings = [dict(settings_of(each.run.config)) for each in self.runs]
        return {name: [each[name] for each in settings] for name in settings[0]
                if any(each[name] != settings[0][name] for each in settings)}  # fmt: skip

    def document(self) -> dict[str, Any]:
        """The comparison for --json and for the page's data."""
        runs = [
            {
                "run": label,
                "step": each.step,
                "iterations": each.run.config.iterations,
                "gaussians": each.gaussians,
                "seconds": each.seconds,
                "elapsed": each.elapsed,
                "mean": each.evaluation["mean"] if each.evaluation else None,
                "views": each.evaluation["views"] if each.evaluation else [],
                "evaluations": each.evaluations,
                "device": each.sessions[-1].get("device") if each.sessions else None,
                "notes": each.notes,
            }
            for label, each in zip(self.labels, self.runs, strict=True)
        ]
        return {"runs": runs, "settings": self.differing, "notes": self.notes}


def compare_runs(runs: Sequence[Run]) -> Comparison:
    """Read them. Raises InputError as `read_figures`, and for too many."""
    if len(runs) > MAX_RUNS:
        raise InputError(f"{len(runs)} runs: expected at most {MAX_RUNS} to compare")
    figures = [read_figures(run, describe=False) for run in runs]
    found = Comparison(figures, _labels([run.path for run in runs]))
    for label, each in zip(found.labels, figures, strict=True):
        found.notes += [f"{label}: {note}" for note in each.notes if note.startswith(("Not finished", "eval.json"))]
    scenes = {each.run.scene.name for each in figures if each.run.scene is not None}
    if len(scenes) > 1:
        found.notes.append(f"The runs are of different scenes: {examples(sorted(scenes))}.")
    held_out = {frozenset(view["name"] for view in each.evaluation["views"]) for each in figures if each.evaluation}
    if len(held_out) > 1:
        found.notes.append("The runs do not hold out the same views: their scores are not of the same pictures.")
    for name in ("resolution", "background"):
        if len({getattr(each.run.config, name) for each in figures}) > 1:
            found.notes.append(f"--{name} differs: scores are not of the same pictures.")
    if len({each.sessions[-1].get("device") for each in figures if each.sessions}) > 1:
        found.notes.append("The runs are of different devices: their times are not of one machine.")
    return found


def write_comparison(found: Comparison, path: Path) -> None:
    """Write the page, atomically. Raises OSError as writing does."""
    atomic_write(path, comparison_page(found).encode("utf-8", "replace"))


def comparison_page(found: Comparison) -> str:
    """The page's HTML."""
    columns = [
        name for name in SCORES if any(each.evaluation and name in each.evaluation["mean"] for each in found.runs)
    ]
    views = view_rows(found)
    return render_page(
        "compare.html",
        labels=found.labels,
        notes=found.notes,
        columns=[(name, TITLES[name]) for name in columns],
        rows=[
            (index % COLORS, label, each, [_mean(each, name) for name in columns])
            for index, (label, each) in enumerate(zip(found.labels, found.runs, strict=True))
        ],
        best=[_best([_mean(each, name) for each in found.runs], name) for name in columns],
        charts=[each for each in charts(found) if each],
        settings=[(name, list(map(setting_text, values))) for name, values in found.differing.items()],
        views=views[:MAX_ROWS],
        views_left_out=max(len(views) - MAX_ROWS, 0),
        machine=[(label, _machine(each)) for label, each in zip(found.labels, found.runs, strict=True)],
        data=found.document(),
    )


def charts(found: Comparison) -> list[Markup]:
    """Time against error first, then what a run's own page has, by step."""
    made = []
    for x, title in (("seconds", "Time against error"), ("step", "Held-out PSNR")):
        series = [
            Series(label, _points(each.evaluations, x), "dots", index)
            for index, (label, each) in enumerate(zip(found.labels, found.runs, strict=True))
        ]
        label = {"seconds": "seconds of training", "step": "step"}[x]
        made.append(chart(title, series, label, "PSNR of the held-out views, dB"))
    wanted = (
        ("Loss", "loss", "loss", True),
        ("PSNR of training views", "psnr", "PSNR, dB", False),
        ("Number of Gaussians", "gaussians", "Gaussians", False),
        ("Time", "seconds", "seconds of training", False),
    )
    for title, name, label, log_y in wanted:
        series = []
        for index, (run, each) in enumerate(zip(found.labels, found.runs, strict=True)):
            steps, values = each.curves["step"], each.curves[name]
            around = max(len(steps) // 50, 5)
            if name in ("loss", "psnr") and len(steps) > 20:
                values = smooth(values, around)
            series.append(Series(run, list(zip(steps, values, strict=True)), "line", index))
        note = "means of neighbouring records" if name in ("loss", "psnr") else ""
        zero = name in ("gaussians", "seconds")
        made.append(chart(title, series, "step", label, log_y=log_y, from_zero=zero, note=note))
    return made


def view_rows(found: Comparison) -> list[tuple[str, list[float | None], float | None]]:
    """Rows of the views that two runs or more have: name, PSNR in each, and the best of them."""
    of = [
        {v["name"]: v.get("psnr") for v in each.evaluation["views"]} if each.evaluation else {} for each in found.runs
    ]
    names = dict.fromkeys(name for each in of for name in each)
    rows = []
    for name in names:
        values = [each.get(name) for each in of]
        if sum(value is not None for value in values) > 1:
            rows.append((name, values, _best(values, "psnr")))
    return rows


def comparison_table(found: Comparison) -> str:
    """Text table for the terminal."""
    columns = [
        name for name in SCORES if any(each.evaluation and name in each.evaluation["mean"] for each in found.runs)
    ]
    header = ["run", "steps", *(name.upper() for name in columns), "Gaussians", "training"]
    rows = [header]
    for label, each in zip(found.labels, found.runs, strict=True):
        values = [_mean(each, name) for name in columns]
        scores = ["-" if value is None else score(value, name) for value, name in zip(values, columns, strict=True)]
        gaussians = "-" if each.gaussians is None else f"{each.gaussians:,}"
        rows.append([plain(label), f"{each.step:,}", *scores, gaussians, duration(each.seconds)])
    lines = _aligned(rows)
    if found.differing:
        named = [["setting", *map(plain, found.labels)]]
        named += [[name, *map(setting_text, values)] for name, values in found.differing.items()]
        lines += ["", *_aligned(named)]
    return "\n".join(lines)


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            cell.ljust(width) if index == 0 else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _labels(paths: Sequence[Path]) -> list[str]:
    """The folders' names, with those above them as far as it takes to tell them apart."""
    parts = [path.resolve().parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{number} {path.resolve().name}" for number, path in enumerate(paths, 1)]


def _mean(figures: Figures, name: str) -> float | None:
    return figures.evaluation["mean"].get(name) if figures.evaluation else None


def _best(values: Sequence[float | None], name: str) -> float | None:
    known = [value for value in values if value is not None]
    if len(known) < 2:
        return None
    return min(known) if name == "lpips" else max(known)


def _points(evaluations: Sequence[dict[str, Any]], x: str) -> list[tuple[float, float]]:
    found = [(each.get(x), each.get("psnr")) for each in evaluations]
    return [(float(a), b) for a, b in found if a is not None and b is not None]


def _machine(figures: Figures) -> str:
    if not figures.sessions:
        return "not known"
    last = figures.sessions[-1]
    versions = last.get("versions", {})
    words = [last.get("device"), (last.get("driver") or "").split("  ")[0], last.get("shape"), last.get("system")]
    clsplat = f"clsplat {versions['clsplat']}" if "clsplat" in versions else None
    return "; ".join(word for word in [*words, clsplat] if word) or "not known"
