# SPDX-License-Identifier: Apache-2.0
"""The merge of the blocks' appearances: of each photograph, the mean over the blocks that were trained with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.colour_models import COLOUR_MODELS, ColourModel
from clsplat.runs.appearance import Row, entries_of, grids_of, learnt_of


def mean_appearance(
    whole: Path, parts: Sequence[Path], kind: str
) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """Return the mean appearance of each photograph over the parts of a scene, as appearance.json and appearance.npz.

    whole: run folder of the whole scene. A photograph that no part was trained with keeps the appearance in there.
    parts: run folders of the parts.
    kind: the setting `appearance` of all of them.
    Raises InputError if a file is missing or damaged.
    """
    photographs = learnt_of(whole, kind)["photographs"]
    if kind in COLOUR_MODELS:
        entries_of(whole, list(photographs), COLOUR_MODELS[kind])  # raises InputError for damaged rows
        rows, tables = _mean_rows(photographs, parts, COLOUR_MODELS[kind]), {}
    else:
        rows = {name: {"grid": place} for place, name in enumerate(photographs)}
        tables = {"grids": _mean_grids(whole, list(photographs), parts)}
    return {"kind": kind, "photographs": rows, "held_out": {}}, tables


def _mean_rows(photographs: dict[str, Row], parts: Sequence[Path], model: ColourModel) -> dict[str, Row]:
    """Return the rows of appearance.json with the means over the parts, for a colour model."""
    found: dict[str, list[Row]] = {name: [] for name in photographs}
    for part in parts:
        learnt = learnt_of(part, model.stem)["photographs"]
        names = [name for name in learnt if name in found]
        entries_of(part, names, model)
        for name in names:
            found[name].append(learnt[name])
    learns = [*model.of_photograph, *model.of_lens]
    return {
        name: {**photographs[name], **{key: np.mean([row[key] for row in rows], axis=0).tolist() for key in learns}}
        if rows
        else photographs[name]
        for name, rows in found.items()
    }


def _mean_grids(whole: Path, names: Sequence[str], parts: Sequence[Path]) -> NDArray[np.float32]:
    """Return the photographs' bilateral grids with the means over the parts. One part's grids are in memory at a
    time, besides the result."""
    grids, counts = grids_of(whole, names), np.zeros(len(names), np.int64)
    places = {name: place for place, name in enumerate(names)}
    for part in parts:
        some = [name for name in learnt_of(part, "grid")["photographs"] if name in places]
        at = np.array([places[name] for name in some], np.int64)
        values = grids_of(part, some)
        grids[at[counts[at] == 0]] = 0
        grids[at] += values
        counts[at] += 1
    grids /= np.maximum(counts, 1).astype(np.float32).reshape(-1, *[1] * (grids.ndim - 1))
    return grids
