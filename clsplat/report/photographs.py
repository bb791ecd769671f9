# SPDX-License-Identifier: Apache-2.0
"""The parts of a report that are about photographs: their masks, and the exposures that were learnt for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from markupsafe import Markup

from clsplat.errors import InputError, examples
from clsplat.files.documents import parse_json, read_document
from clsplat.images.colour import displayed, photos_space
from clsplat.report.charts import ChartSeries, chart
from clsplat.report.run_numbers import number
from clsplat.report.thumbnails import data_uri
from clsplat.runs.run import Run
from clsplat.scenes.analysis.mask_overlay import masked
from clsplat.scenes.scene import Scene, View, spread

MAX_MASKED_PHOTOGRAPHS = 6
"""Maximum number of masked photographs in a report."""
SMALL_PICTURE_SIDE_PX = 320
"""Longer side of small pictures in pixels."""


@dataclass(frozen=True)
class MaskedPhotograph:
    """A photograph as a data URI, with masked areas drawn over it.

    left_out: fraction of its pixels that are masked.
    """

    name: str
    width: int
    height: int
    picture: str
    left_out: float


def masked_photographs(scene: Scene, *, only_files: bool) -> tuple[list[MaskedPhotograph], int]:
    """Evenly spaced photographs with masks, and the number of all photographs with masks. Unreadable files are skipped.

    only_files: do not count alpha channels as masks.
    """
    views = [view for view in scene.views if view.mask is not None and (view.mask.path is not None or not only_files)]
    space = photos_space(view.path for view in scene.views)
    shown = []
    for view in spread(views, MAX_MASKED_PHOTOGRAPHS):
        try:
            shown.append(_shown(view, space))
        except InputError:
            continue
    return shown, len(views)


def _shown(view: View, space: str) -> MaskedPhotograph:
    scale = min(1.0, SMALL_PICTURE_SIDE_PX / max(view.camera.width, view.camera.height))
    width, height = max(1, round(view.camera.width * scale)), max(1, round(view.camera.height * scale))
    picture = masked(view, width, height)
    picture = replace(picture, photograph=displayed(picture.photograph, space))
    return MaskedPhotograph(view.name, width, height, data_uri(picture.drawn()), picture.left_out)


def exposure_chart(run: Run) -> Markup:
    """Chart of the photographs' learnt gains, in the order of names; "" if there are none."""
    path = run.appearance_path
    if not path.exists():
        return Markup("")
    try:
        photographs = parse_json(read_document(path, "the appearance of a run's photographs"))["photographs"]
        rows = [_gains(photographs[name]) for name in sorted(photographs)]
        corners = _corners(photographs)
    except (InputError, ValueError, KeyError, TypeError, AttributeError):
        return Markup("")
    series = [
        ChartSeries(name, [(float(place), row[channel]) for place, row in enumerate(rows, 1)], color=color)
        for channel, (name, color) in enumerate((("red", 1), ("green", 2), ("blue", 0)))
    ]
    note = "log2 of the factors of the model's colours; +1 is twice as bright as the mean" + corners
    return chart(
        "Exposure of the photographs", series, "training photographs in the order of names", "gain, stops", note=note
    )


def _corners(photographs: Mapping[str, Any]) -> str:
    """Text on the light in the corners of the picture, from the learnt vignettes; "" if there are none."""
    vignettes = {tuple(_three(row["vignette"])) for row in photographs.values() if "vignette" in row}
    octaves = sorted(min(sum(vignette), 16.0) for vignette in vignettes if any(vignette))
    left = dict.fromkeys(f"{2.0**value:.0%}" for value in octaves)
    return f". Corners get {examples(left)} of the light in the middle" if left else ""


def _gains(record: Any) -> Sequence[float]:
    """Three gains in stops. Raises ValueError, KeyError or TypeError if the record does not contain them."""
    return _three(record["log2_gains"])


def _three(values: Any) -> list[float]:
    """Three numbers. Raises ValueError or TypeError for anything else."""
    numbers = [number(value) for value in values]
    if len(numbers) != 3 or None in numbers:
        raise ValueError("not three numbers")
    return [float(value) for value in numbers if value is not None]
