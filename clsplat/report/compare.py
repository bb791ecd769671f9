# SPDX-License-Identifier: Apache-2.0
"""Comparison of runs: scores, numbers of Gaussians, times, settings that differ, curves, and PSNR against time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from markupsafe import Markup

from clsplat.errors import InputError, examples, plain
from clsplat.progress import aligned
from clsplat.report.charts import SERIES_COLOUR_COUNT, ChartSeries, chart
from clsplat.report.page import SCORE_TITLES, duration, render_page, score, setting_text
from clsplat.report.run_numbers import SCORE_NAMES, RunNumbers, read_run_numbers, settings_of, smooth
from clsplat.runs.run import Run

MAX_COMPARED_RUNS = 24
MAX_COMPARED_VIEWS = 100
"""Maximum number of views in the table of the comparison page."""


@dataclass
class Comparison:
    """A comparison of runs. The keys of `runs` are unique labels.

    notes: reasons why the numbers are hard to compare.
    """

    runs: dict[str, RunNumbers]
    notes: list[str] = field(default_factory=list)

    @property
    def scores(self) -> list[str]:
        """Names of the scores for which at least one run has a mean."""
        return [name for name in SCORE_NAMES if any(_mean(numbers, name) is not None for numbers in self.runs.values())]

    @property
    def differing(self) -> dict[str, list[Any]]:
        """Settings that differ between the runs: for each flag, the values of all runs."""
        settings = [dict(settings_of(numbers.run.config)) for numbers in self.runs.values()]
        values = {name: [setting[name] for setting in settings] for name in settings[0]}
        return {name: listed for name, listed in values.items() if any(value != listed[0] for value in listed)}

    def document(self) -> dict[str, Any]:
        """Return the comparison as a JSON object, for --json and to embed in the page."""
        runs = [
            {
                "run": label,
                "step": numbers.step,
                "iterations": numbers.run.config.iterations,
                "gaussians": numbers.gaussians,
                "seconds": numbers.seconds,
                "elapsed": numbers.elapsed,
                "mean": numbers.evaluation["mean"] if numbers.evaluation else None,
                "views": numbers.evaluation["views"] if numbers.evaluation else [],
                "evaluations": numbers.evaluations,
                "device": numbers.sessions[-1].get("device") if numbers.sessions else None,
                "notes": numbers.notes,
            }
            for label, numbers in self.runs.items()
        ]
        return {"runs": runs, "settings": self.differing, "notes": self.notes}


def compare_runs(runs: Sequence[Run]) -> Comparison:
    """Read the numbers of runs, with notes on differences that make them hard to compare.

    Raises InputError like `read_run_numbers`, and for more than MAX_COMPARED_RUNS runs.
    """
    if len(runs) > MAX_COMPARED_RUNS:
        raise InputError(f"{len(runs)} runs: expected at most {MAX_COMPARED_RUNS} to compare")
    all_numbers = [read_run_numbers(run, describe=False) for run in runs]
    comparison = Comparison(dict(zip(_labels([run.path for run in runs]), all_numbers, strict=True)))
    notes = comparison.notes
    for label, numbers in comparison.runs.items():
        notes += [f"{label}: {note}" for note in numbers.notes if note.startswith(("Not finished", "eval.json"))]
    scenes = {numbers.run.scene.name for numbers in all_numbers if numbers.run.scene is not None}
    if len(scenes) > 1:
        notes.append(f"The runs have different scenes: {examples(sorted(scenes))}.")
    held_out = {
        frozenset(view["name"] for view in numbers.evaluation["views"]) for numbers in all_numbers if numbers.evaluation
    }
    if len(held_out) > 1:
        notes.append("The runs do not hold out the same views: their scores are for different pictures.")
    for name in ("resolution", "background"):
        if len({getattr(numbers.run.config, name) for numbers in all_numbers}) > 1:
            notes.append(f"--{name} differs: scores are for different pictures.")
    if len({numbers.sessions[-1].get("device") for numbers in all_numbers if numbers.sessions}) > 1:
        notes.append("The runs used different devices: their times are hard to compare.")
    return comparison


def comparison_page(comparison: Comparison) -> str:
    """Build the HTML of the comparison page."""
    columns, runs = comparison.scores, comparison.runs
    views = view_rows(comparison)
    return render_page(
        "compare.html",
        labels=list(runs),
        notes=comparison.notes,
        columns=[(name, SCORE_TITLES[name]) for name in columns],
        rows=[
            (index % SERIES_COLOUR_COUNT, label, numbers, [_mean(numbers, name) for name in columns])
            for index, (label, numbers) in enumerate(runs.items())
        ],
        best=[_best([_mean(numbers, name) for numbers in runs.values()], name) for name in columns],
        charts=[figure for figure in charts(comparison) if figure],
        settings=[(name, list(map(setting_text, values))) for name, values in comparison.differing.items()],
        views=views[:MAX_COMPARED_VIEWS],
        views_left_out=max(len(views) - MAX_COMPARED_VIEWS, 0),
        runs=runs,
        data=comparison.document(),
    )


def charts(comparison: Comparison) -> list[Markup]:
    """Draw held-out PSNR against time and step, then loss, PSNR, number of Gaussians and time against the step."""
    drawn = []
    for x, title, x_label in (
        ("seconds", "Time against error", "seconds of training"),
        ("step", "Held-out PSNR", "step"),
    ):
        series = [
            ChartSeries(label, numbers.held_out(x), "dots", index)
            for index, (label, numbers) in enumerate(comparison.runs.items())
        ]
        drawn.append(chart(title, series, x_label, "PSNR of the held-out views, dB"))
    curves = (
        ("Loss", "loss", "loss", True),
        ("PSNR of training views", "psnr", "PSNR, dB", False),
        ("Number of Gaussians", "gaussians", "Gaussians", False),
        ("Time", "seconds", "seconds of training", False),
    )
    for title, name, y_label, log_y in curves:
        is_noisy = name in ("loss", "psnr")
        series = []
        for index, (label, numbers) in enumerate(comparison.runs.items()):
            steps, values = numbers.curves["step"], numbers.curves[name]
            if is_noisy and len(steps) > 20:
                values = smooth(values, max(len(steps) // 50, 5))
            series.append(ChartSeries(label, list(zip(steps, values, strict=True)), "line", index))
        note = "means of neighbouring records" if is_noisy else ""
        drawn.append(chart(title, series, "step", y_label, log_y=log_y, from_zero=not is_noisy, note=note))
    return drawn


def view_rows(comparison: Comparison) -> list[tuple[str, list[float | None], float | None]]:
    """Rows of the views that at least two runs share: name, PSNR of each run, best PSNR."""
    views = [numbers.evaluation["views"] if numbers.evaluation else [] for numbers in comparison.runs.values()]
    scores = [{view["name"]: view.get("psnr") for view in listed} for listed in views]
    rows = []
    for name in dict.fromkeys(name for by_name in scores for name in by_name):
        values = [by_name.get(name) for by_name in scores]
        if sum(value is not None for value in values) > 1:
            rows.append((name, values, _best(values, "psnr")))
    return rows


def comparison_table(comparison: Comparison) -> str:
    """Format the comparison as a text table for the terminal, with the settings that differ."""
    columns = comparison.scores
    rows = [["run", "steps", *(name.upper() for name in columns), "Gaussians", "training"]]
    for label, numbers in comparison.runs.items():
        means = {name: _mean(numbers, name) for name in columns}
        scores = ["-" if value is None else score(value, name) for name, value in means.items()]
        gaussians = "-" if numbers.gaussians is None else f"{numbers.gaussians:,}"
        rows.append([plain(label), f"{numbers.step:,}", *scores, gaussians, duration(numbers.seconds)])
    lines = aligned(rows)
    if comparison.differing:
        settings = [[name, *map(setting_text, values)] for name, values in comparison.differing.items()]
        lines += ["", *aligned([["setting", *map(plain, comparison.runs)], *settings])]
    return "\n".join(lines)


def _labels(paths: Sequence[Path]) -> list[str]:
    """Folder names as labels, with parent folders where the names are not unique."""
    parts = [path.resolve().parts for path in paths]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{number} {path.resolve().name}" for number, path in enumerate(paths, 1)]


def _mean(numbers: RunNumbers, name: str) -> float | None:
    return numbers.evaluation["mean"].get(name) if numbers.evaluation else None


def _best(values: Sequence[float | None], name: str) -> float | None:
    known = [value for value in values if value is not None]
    if len(known) < 2:
        return None
    return min(known) if name == "lpips" else max(known)
