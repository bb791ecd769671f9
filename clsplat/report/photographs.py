# SPDX-License-Identifier: Apache-2.0
"""The part of a report that is about the photographs: their masks, and the exposures that were learnt of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from markupsafe import Markup

from clsplat.errors import InputError, examples
from clsplat.files import parse_json, read_document
from clsplat.images.colour import displayed, photos_space
from clsplat.report.figures import number
from clsplat.report.svg import Series, chart
from clsplat.report.thumbnails import data_uri
from clsplat.runs.run import Run
from clsplat.scenes.doubts import spread
from clsplat.scenes.marked import masked
from clsplat.scenes.scene import Scene, View

SHOWN = 6
"""Photographs with masks that are shown."""
SIDE = 320
"""Pixels of their longer side."""


@dataclass(frozen=True)
class MaskedPhotograph:
    """A photograph with what its masks leave out drawn over it, as a data URI; left_out: that share of its pixels."""

    name: str
    width: int
    height: int
    picture: str
    left_out: float


def masked_photographs(scene: Scene, *, only_files: bool) -> tuple[list[MaskedPhotograph], int]:
    """Some of the photographs that have masks, spread evenly, and how many have one; photographs that cannot be read
    are passed over. only_files: alpha channels are no masks."""
    views = [view for view in scene.views if view.mask is not None and (view.mask.path is not None or not only_files)]
    space = photos_space(view.path for view in scene.views)
    shown = []
    for view in spread(views, SHOWN) if views else []:
        try:
            shown.append(_shown(view, space))
        except InputError:
            continue
    return shown, len(views)


def _shown(view: View, space: str) -> MaskedPhotograph:
    scale = min(1.0, SIDE / max(view.camera.width, view.camera.height))
    width, height = max(1, round(view.camera.width * scale)), max(1, round(view.camera.height * scale))
    picture = masked(view, width, height)
    picture = replace(picture, photograph=displayed(picture.photograph, space))
    return MaskedPhotograph(view.name, width, height, data_uri(picture.drawn()), picture.left_out)


def exposure_chart(run: Run) -> Markup:
    """The gains that were learnt of the photographs, in the order of their names; "" where there are none."""
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
        Series(name, [(float(place), row[channel]) for place, row in enumerate(rows, 1)], color=color)
        for channel, (name, color) in enumerate((("red", 1), ("green", 2), ("blue", 0)))
    ]
    note = "what the model's colours are multiplied by; +1 is twice as bright as the mean" + corners
    return chart("Exposure of the photographs", series, "training photograph, by name", "gain, stops", note=note)


def _corners(photographs: Mapping[str, Any]) -> str:
    """The light that the lenses leave in the corners, by the vignettes that were learnt; "" where none were."""
    vignettes = {tuple(_three(row["vignette"])) for row in photographs.values() if "vignette" in row}
    octaves = sorted(min(sum(vignette), 16.0) for vignette in vignettes if any(vignette))
    left = dict.fromkeys(f"{2.0**value:.0%}" for value in octaves)
    return f". Corners have {examples(left)} of the light of the middle" if left else ""


def _gains(record: Any) -> Sequence[float]:
    """Three numbers. Raises ValueError, KeyError or TypeError for what is none."""
    return _three(record["log2_gains"])


def _three(values: Any) -> list[float]:
    """Three numbers. Raises ValueError or TypeError for what is none."""
    numbers = [number(value) for value in values]
    if len(numbers) != 3 or None in numbers:
        raise ValueError("not three numbers")
    return [float(value) for value in numbers if value is not None]
