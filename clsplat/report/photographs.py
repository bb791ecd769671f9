# SPDX-License-Identifier: Apache-2.0
"""Parts of a run's report about its photographs: pictures of their masks, and a chart of their learnt exposures."""

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
"""Longer side of a report's small pictures, in pixels."""


@dataclass(frozen=True)
class MaskedPhotograph:
    """A photograph as a data URI, with masked areas drawn over it.

    picture: the data URI.
    left_out: fraction of the photograph's pixels that are masked.
    """

    name: str
    width: int
    height: int
    picture: str
    left_out: float


def masked_photographs(scene: Scene, *, only_files: bool) -> tuple[list[MaskedPhotograph], int]:
    """Draw masks over a few of the photographs that have masks. Also returns the number of all photographs with masks.

    only_files: ignore masks that are alpha channels.
    Unreadable files are skipped.
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
    """Draw a chart of the gains learnt for each photograph, in the order of names; "" if there are none."""
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
    note = "log2 of the factors of the model's colours; +1 is twice as bright as the model" + corners
    return chart(
        "Exposure of the photographs", series, "training photographs in the order of names", "gain, stops", note=note
    )


def _corners(photographs: Mapping[str, Any]) -> str:
    """Describe how dark the learnt vignettes make the corners of pictures; "" if there are no vignettes."""
    vignettes = {tuple(_three(row["vignette"])) for row in photographs.values() if "vignette" in row}
    octaves = sorted(min(sum(vignette), 16.0) for vignette in vignettes if any(vignette))
    left = dict.fromkeys(f"{2.0**value:.0%}" for value in octaves)
    return f". Corners get {examples(left)} of the light in the middle" if left else ""


def _gains(record: Any) -> Sequence[float]:
    """Return the three gains, in stops, of a photograph's record in appearance.json.

    Raises ValueError, KeyError or TypeError if the record does not contain them.
    """
    return _three(record["log2_gains"])


def _three(values: Any) -> list[float]:
    """Return `values` as three numbers. Raises ValueError or TypeError if they are anything else."""
    numbers = [number(value) for value in values]
    if len(numbers) != 3 or None in numbers:
        raise ValueError("not three numbers")
    return [float(value) for value in numbers if value is not None]
