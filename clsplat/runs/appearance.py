# SPDX-License-Identifier: Apache-2.0
"""Appearance of a run's photographs as it was learnt: appearance.json, by a photograph's name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError, examples
from clsplat.files import parse_json, read_document
from clsplat.images.alpha import Image
from clsplat.runs.run import Run, run_of

MAX_BYTES = 1 << 28
MOST_LOG = 16.0
MOST_MIX = 0.25
"""Under which any six mixes can be undone."""
EXPECTED = "what clsplat train --appearance writes"

MOST_PART = 100.0
"""Pictures that a principal point is beside its own, at most."""

Row = Mapping[str, Any]
"""A photograph's entry of appearance.json."""
Look = Callable[[str, Image], Image]
"""Makes a render (H, W, 3) what the camera of a held-out photograph, by its name, shows of it."""


def gains_of(model: Path, photograph: str) -> tuple[float, ...]:
    """The three gains by which colours of a run's model become the photograph's, or the nine numbers of a matrix, by
    rows, where channels mix; of a held-out one the gains that EXIF tells, or 1, and no mixes. model: the run's folder,
    or a file there; photograph: its name in the data set, or the end of that from a folder on, with or without
    extension. Raises InputError."""
    run = run_of(model)
    path = run.appearance_path if run is not None else None
    if run is None or path is None or not path.exists():
        raise InputError(
            f"--appearance {photograph}: {model} has learnt no appearances (no appearance.json), expected a run of "
            "clsplat train --appearance exposure or ppisp"
        )
    if _kind(path) == "grid":
        raise InputError(
            f"--appearance {photograph}: {path} is of bilateral grids, which are for training alone; expected a run of "
            "clsplat train --appearance exposure or ppisp"
        )
    rows = _read(path, "photographs") | _read(path, "held_out")
    found = [name for name in rows if photograph in (name, *_ends(name))]
    if len(found) > 1 and photograph not in found:
        raise InputError(f"--appearance {photograph}: is {len(found)} photographs, {examples(found)}; name one of them")
    if not found:
        near = get_close_matches(photograph, rows, 3, 0.0)
        raise InputError(
            f"--appearance {photograph}: is no photograph of {path}, expected one of its {len(rows)}, such as "
            f"{examples(near)}"
        )
    row = rows[photograph if photograph in found else found[0]]
    if "mixes" not in row:
        return tuple(row["gains"].tolist())
    return tuple((row["gains"][:, None] * inverse(unmixing(row["mixes"]))).ravel().tolist())


def looks_of_run(run: Run | None) -> Look:
    """`held_out_looks` of a run, where it has an appearance.json. Raises InputError."""
    return _looks(_read(run.appearance_path, "held_out") if run is not None and run.appearance_path.exists() else {})


def held_out_looks(record: Mapping[str, Any] | None) -> Look:
    """The looks of held-out photographs, as far as the content of an appearance.json tells."""
    return _looks(_rows_in(record, "held_out") if record is not None else {})


def _looks(rows: Mapping[str, Row]) -> Look:
    def seen(name: str, image: Image) -> Image:
        row = rows.get(name)
        if row is None:
            return image
        factors = row["gains"].astype(np.float32)
        if "vignette" in row:
            height, width = image.shape[:2]
            factors = (factors * _light(row["vignette"], row["centre"], width, height)[:, :, None]).astype(np.float32)
        exposed: Image = image * factors
        return exposed

    return seen


def unmixing(mixes: Float64) -> Float64:
    """The matrix (3, 3) that takes the mixes (6,) from colours (docs/gradients.md, "Colours and vignettes")."""
    matrix = np.eye(3)
    for c, (next_share, last_share) in enumerate(mixes.reshape(3, 2)):
        matrix[c, c] += next_share + last_share
        matrix[c, (c + 1) % 3] -= next_share
        matrix[c, (c + 2) % 3] -= last_share
    return matrix


def inverse(matrix: Float64) -> Float64:
    """The inverse of a matrix (3, 3), with the same bits on every processor, as frames are known by them."""
    columns = np.stack([np.cross(matrix[(row + 1) % 3], matrix[(row + 2) % 3]) for row in range(3)], axis=1)
    first, second, third = (matrix[0] * columns[:, 0]).tolist()
    result: Float64 = columns / (first + second + third)
    return result


def _light(vignette: Float64, centre: Float64, width: int, height: int) -> Float64:
    """The share of light (H, W) that a lens leaves, by its vignette (3,) and its centre in parts of the picture."""
    across, down = np.arange(width) + 0.5 - centre[0] * width, np.arange(height) + 0.5 - centre[1] * height
    s = 4 * (across**2 + down[:, None] ** 2) / (width**2 + height**2)
    light: Float64 = np.exp2(np.clip(s * (vignette[0] + s * (vignette[1] + s * vignette[2])), -MOST_LOG, MOST_LOG))
    return light


def _kind(path: Path) -> Any:
    try:
        return parse_json(read_document(path, EXPECTED, MAX_BYTES)).get("kind")
    except (ValueError, AttributeError):
        return None


def _read(path: Path, key: str) -> dict[str, Row]:
    try:
        return _rows_in(parse_json(read_document(path, EXPECTED, MAX_BYTES)), key)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: {type(error).__name__}: {error}; expected {EXPECTED}") from None


def _rows_in(record: Any, key: str) -> dict[str, Row]:
    return {str(name): _row(row) for name, row in record[key].items()}


def _ends(name: str) -> list[str]:
    """Shorter names that mean a photograph: without extension, and without folders."""
    parts = name.split("/")
    whole = ["/".join(parts[start:]) for start in range(len(parts))]
    return whole + [end.rpartition(".")[0] for end in whole if "." in end]


def _row(record: Any) -> Row:
    """Gains (3,), mixes (6,) where there are any, and a vignette (3,) with its centre (2,). Raises ValueError,
    TypeError, KeyError or OverflowError."""
    logs = _numbers("log2_gains", record["log2_gains"], 3, MOST_LOG).tolist()
    row = {"gains": np.array([2.0**log for log in logs])}  # which NumPy's processors round in several ways
    if "mixes" in record:
        row["mixes"] = _numbers("mixes", record["mixes"], 6, MOST_MIX)
    if "vignette" in record:
        row |= {
            "vignette": _numbers("vignette", record["vignette"], 3, MOST_LOG),
            "centre": _numbers("centre", record["centre"], 2, MOST_PART),
        }
    return row


def _numbers(name: str, values: Any, count: int, most: float) -> Float64:
    numbers = [float(value) for value in values] if isinstance(values, list) else []
    if len(numbers) != count or not all(math.isfinite(value) and abs(value) <= most for value in numbers):
        raise ValueError(f"{name} of {values}")
    return np.array(numbers)
