# SPDX-License-Identifier: Apache-2.0
"""report.html: the report of a run on one page, which needs neither other files nor a network."""

from __future__ import annotations

import base64
import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from clsplat.config.masks import NO_MASKS, MaskUse
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError, amount
from clsplat.evaluation import depths
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import read_document
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import background_colour
from clsplat.report import PLAN_PICTURE_FILE, REPORT_FILE_NAME, thumbnails
from clsplat.report.charts import ChartSeries, chart, short, templates
from clsplat.report.photographs import SMALL_PICTURE_SIDE_PX, MaskedPhotograph, exposure_chart, masked_photographs
from clsplat.report.run_numbers import (
    CURVE_KEYS,
    MAX_STAGES,
    SCORE_NAMES,
    RunNumbers,
    read_run_numbers,
    settings_of,
    smooth,
)
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.version import package_version

MAX_PICTURED_VIEWS = 8
"""Default number of held-out views with pictures."""
MAX_EMBEDDED_RECORDS = 2000
"""Maximum number of records of metrics.jsonl whose numbers are embedded in the page."""
MAX_TABLE_VIEWS = 200
"""Maximum number of views in the table of held-out views."""
MAX_COLOURED_STAGES = 7
"""Maximum number of stages with a colour of their own in the chart. Smaller stages are drawn together."""
MAX_PLAN_PICTURE_BYTES = 8 << 20
"""Size in bytes up to which the picture of a plan is embedded: enough for 80,000 cameras."""
SCORE_TITLES = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS (VGG)"}
"""Title of each score in the tables."""


def write_report(
    run: Run,
    path: Path | None = None,
    *,
    scene: Scene | str | None = None,
    model: Gaussians | None = None,
    views: int = MAX_PICTURED_VIEWS,
) -> RunNumbers:
    """Write the report of a run atomically to `path`, or into the run folder. Returns the numbers of the run.

    scene: the run's scene, or the reason why there is none. None loads the scene if it is needed.
    model: contents of model.ply, if already loaded.
    views: maximum number of held-out views with pictures.
    Raises InputError if metrics cannot be read, and OSError if the page cannot be written.
    """
    numbers = read_run_numbers(run, model)
    page = report_page(numbers, scene, views)
    atomic_write(path or run.path / REPORT_FILE_NAME, page.encode("utf-8", "replace"))
    return numbers


def write_last(run: Run, scene: Scene, model: Gaussians) -> None:
    """Write the report of a finished training. A failure only causes a warning, so that the training does not fail."""
    try:
        write_report(run, scene=scene, model=model)
    except Exception as error:  # noqa: BLE001
        why = " ".join(str(error).split()) or type(error).__name__
        again = f"try again with: clsplat report {run.path}"
        warnings.warn(f"{REPORT_FILE_NAME} was not written ({why}); {again}", stacklevel=2)


def report_page(numbers: RunNumbers, scene: Scene | str | None = None, views: int = MAX_PICTURED_VIEWS) -> str:
    """Build the HTML of a run's report, with pictures of at most `views` held-out views.

    scene: the run's scene, or the reason why there is none. None loads the scene if it is needed.
    """
    evaluation = numbers.evaluation
    listed = evaluation["views"] if evaluation else []
    shown, low = list[thumbnails.Shown](), list[thumbnails.Shown]()
    notes = list(numbers.notes)
    use = numbers.run.config.mask_use
    if views > 0 and (listed or use != NO_MASKS):
        scene = scene if scene is not None else thumbnails.scene_of(numbers.run)
    masks, masked_count = list[MaskedPhotograph](), 0
    if views > 0 and use != NO_MASKS and isinstance(scene, Scene):
        masks, masked_count = masked_photographs(scene, only_files=use.alpha == "blend")
    if listed and views > 0:
        if isinstance(scene, str):
            notes.append(f"Renders are shown without photographs: {scene}.")
        names = [view["name"] for view in listed]
        wanted = thumbnails.chosen([view.get("psnr") for view in listed], views)
        background = background_colour(numbers.run.config.background)
        known = None if isinstance(scene, str) else scene
        shown = thumbnails.show(numbers.run, names, wanted, known, background)
        worst = depths.worst(listed) if isinstance(scene, Scene) else []
        low = [
            view
            for view in thumbnails.show(numbers.run, names, worst, known, background, SMALL_PICTURE_SIDE_PX)
            if view.depth
        ]
        if len(shown) < len(wanted):
            notes.append(f"{len(wanted) - len(shown)} renders of held-out views are missing in test/ or unreadable.")
    scores = {view["name"]: view for view in listed}
    defaults = dict(settings_of(TrainConfig()))
    places = {view.name: place for place, view in enumerate(shown, 1)}
    return render_page(
        "report.html",
        numbers=numbers,
        notes=notes,
        titles=SCORE_TITLES,
        charts=list(filter(None, [*charts(numbers), exposure_chart(numbers.run)])),
        plan_picture=_plan_picture(numbers.run),
        masks=masks,
        masked_count=masked_count,
        mask_words=_mask_words(use),
        histograms=list(filter(None, histograms(numbers))),
        stages=stage_rows(numbers),
        shown=[(place, view, scores[view.name]) for place, view in enumerate(shown, 1)],
        places=places,
        low=[(view, scores[view.name]) for view in low],
        left_out=len(listed) - len(shown),
        white_error=thumbnails.MAX_COLOURED_ERROR,
        columns=[(name, SCORE_TITLES[name]) for name in SCORE_NAMES if any(name in view for view in listed)],
        views=listed[:MAX_TABLE_VIEWS],
        views_left_out=max(len(listed) - MAX_TABLE_VIEWS, 0),
        settings=[
            (name, setting_text(value), setting_text(defaults[name]), value != defaults[name])
            for name, value in settings_of(numbers.run.config)
        ],
        data=_data(numbers),
    )


def _plan_picture(run: Run) -> str:
    """Return the picture of a run's plan of blocks as a data URI; empty if there is none that can be read.

    As the source of an image, an SVG file can neither run scripts nor load anything.
    """
    path = run.path / PLAN_PICTURE_FILE
    if path.is_symlink() or not path.is_file():  # a link may lead out of the run
        return ""
    try:
        text = read_document(path, "the picture of a plan", MAX_PLAN_PICTURE_BYTES)
    except InputError:
        return ""
    return f"data:image/svg+xml;base64,{base64.b64encode(text.encode()).decode()}"


def render_page(name: str, **values: Any) -> str:
    """Fill in the page template of this name. Returns HTML. Values that are not Markup are escaped."""
    pages = templates()
    pages.filters.update(short=short, duration=duration, score=score, count="{:,.0f}".format, amount=amount)
    folder = Path(__file__).parent / "templates"
    style, script = ((folder / file).read_text("utf-8") for file in ("style.css", "page.js"))
    return pages.get_template(name).render(
        style=Markup(style),  # noqa: S704  # our own files
        script=Markup(script),  # noqa: S704
        hashes=[_hash(style), _hash(script)],
        version=package_version(),
        **values,
    )


def charts(numbers: RunNumbers) -> list[Markup]:
    """Draw loss, PSNR, number of Gaussians, times of stages and training time against the step, and PSNR against
    time."""
    curves, steps = numbers.curves, numbers.curves["step"]
    around = max(len(steps) // 50, 5)
    note = f"every tenth step, for one view; the line is the mean of {around} records" if len(steps) > 20 else ""
    made = []
    for title, name, label in (("Loss", "loss", "loss"), ("PSNR", "psnr", "PSNR, dB")):
        series = [ChartSeries("training view", list(zip(steps, curves[name], strict=True)))]
        if len(steps) > 20:
            means = list(zip(steps, smooth(curves[name], around), strict=True))
            series = [replace(series[0], kind="faint"), ChartSeries("training views, mean", means)]
        if name == "psnr":
            series.append(ChartSeries("held-out views", numbers.held_out("step"), "dots", 1))
        made.append(chart(title, series, "step", label, log_y=name == "loss", note=note))
    grown = ChartSeries("Gaussians", list(zip(steps, curves["gaussians"], strict=True)), color=2)
    made.append(chart("Number of Gaussians", [grown], "step", "Gaussians", from_zero=True))
    made.append(stage_chart(numbers))
    trained = ChartSeries("training", [(0.0, 0.0), *zip(steps, curves["seconds"], strict=True)], color=4)
    if steps:
        made.append(chart("Time", [trained], "step", "seconds of training", from_zero=True))
    series = [ChartSeries("held-out views", numbers.held_out("seconds"), "dots", 1)]
    made.append(chart("Time against PSNR", series, "seconds of training", "PSNR, dB"))
    return made


def stage_chart(numbers: RunNumbers) -> Markup:
    """Draw a stacked chart of the milliseconds of each stage. Small stages are added together.

    The result is empty for fewer than two measurements.
    """
    if len(numbers.stages) < 2:
        return Markup("")
    names = [name for name, *_ in stage_rows(numbers)]
    named = names if len(names) <= MAX_COLOURED_STAGES + 1 else names[:MAX_COLOURED_STAGES]
    groups = [(name, [name]) for name in named]
    if rest := names[len(named) :]:
        groups.append((f"{len(rest)} smaller stages", rest))
    series = []
    for color, (label, members) in enumerate(groups):
        times = [(float(record["step"]), sum(record["ms"].get(n, 0.0) for n in members)) for record in numbers.stages]
        series.append(ChartSeries(label, times, "area", color))
    return chart("Time per stage", series, "step", "ms of a step", note="waiting for the device after each stage")


def stage_rows(numbers: RunNumbers) -> list[tuple[str, float, float, float]]:
    """Return a row for each stage, slowest first: name, median and last milliseconds, fraction of the last step."""
    if not numbers.stages:
        return []
    last = numbers.stages[-1]["ms"]
    names = sorted({name for record in numbers.stages for name in record["ms"]} - {"all"})[:MAX_STAGES]
    rows = []
    for name in names:
        values = sorted(record["ms"].get(name, 0.0) for record in numbers.stages)
        now = last.get(name, 0.0)
        rows.append((name, values[len(values) // 2], now, now / last["all"]))
    return sorted(rows, key=lambda row: -row[2])


def histograms(numbers: RunNumbers) -> list[Markup]:
    """Draw histograms of the Gaussians' scales, opacities and contributions."""
    bars = {
        name: list(zip(data["edges"], [*data["counts"], 0], strict=True)) for name, data in numbers.histograms.items()
    }
    scales = (("largest scale", 0), ("smallest scale", 1))
    series = [ChartSeries(name, bars[name], "bars", color) for name, color in scales if name in bars]
    made = [chart("Scales", series, "world units", "Gaussians", powers=True, note="standard deviations")]
    if "opacity" in bars:
        made.append(chart("Opacity", [ChartSeries("opacity", bars["opacity"], "bars", 2)], "opacity", "Gaussians"))
    if "contribution" in bars:
        record = numbers.histograms["contribution"]
        views = f"{record['views']} of {record['of']} training views"
        note = f"largest contribution to any of {views}; {record['none']:,} Gaussians contribute to none of them"
        series = [ChartSeries("contribution", bars["contribution"], "bars", 3)]
        made.append(chart("Contribution", series, "pixels", "Gaussians", powers=True, note=note))
    return made


def setting_text(value: object) -> str:
    """Format the value of a setting. Lists have spaces, so that lines can wrap."""
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def duration(seconds: float | None) -> str:
    """Format a duration: 12.3 s, 4 min 5 s, 2 h 3 min."""
    if seconds is None:
        return "not known"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def score(value: float, name: str) -> str:
    """Format a score: PSNR with two decimals, others with four."""
    return f"{value:.2f}" if name == "psnr" else f"{value:.4f}"


def _mask_words(use: MaskUse) -> list[str]:
    """Legend of the colours that mark masked areas of photographs."""
    words = {"ignore": "red is ignored", "transparent": "blue is transparent"}
    return [text for meaning, text in words.items() if meaning in (use.masks, use.alpha)]


def _data(numbers: RunNumbers) -> dict[str, Any]:
    """Return the numbers of a run that its page embeds for other programs, without rounding.

    Long curves are reduced to about MAX_EMBEDDED_RECORDS points.
    """
    length = len(numbers.curves["step"])
    every = -(-length // MAX_EMBEDDED_RECORDS) or 1
    kept: Sequence[int] = sorted({*range(0, length, every), *([length - 1] if length else [])})
    curves = {name: [numbers.curves[name][index] for index in kept] for name in CURVE_KEYS}
    return {
        "run": numbers.name,
        "records": length,
        "curves": curves,
        **{name: getattr(numbers, name) for name in ("stages", "evaluation", "evaluations", "model", "histograms")},
        "settings": dict(settings_of(numbers.run.config)),
    }


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
