# SPDX-License-Identifier: Apache-2.0
"""Appearance of a run's photographs for renders: reads gains, channel mixes and vignettes from appearance.json."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.config.colour_models import COLOUR_MODELS, ColourModel
from clsplat.errors import InputError, examples
from clsplat.files.documents import parse_json, read_document
from clsplat.images.alpha import Image
from clsplat.layouts.columns import GRID_SHAPE
from clsplat.runs.run import APPEARANCE_FILE, Run, run_of

MAX_APPEARANCE_BYTES = 1 << 28
"""Maximum size of appearance.json in bytes."""
MAX_LOG2_GAIN = 16.0
"""Largest magnitude of a gain's base-2 logarithm, of a vignette's coefficients, and of the base-2 logarithm of the
fraction of light that a vignette leaves."""
MAX_CHANNEL_MIX = 0.25
"""Largest magnitude of a channel mix. The matrix of any six mixes up to this size can be inverted."""
KINDS_WITH_GAINS = ("exposure", "ppisp")
"""Values of --appearance whose files have gains, which a render can apply."""
EXPECTED_APPEARANCE_FILE = "a file that clsplat train --appearance writes"

MAX_CENTRE_PICTURE_SIZES = 100.0
"""Limit of the magnitude of a vignette centre's coordinates, in picture widths and heights."""

Row = Mapping[str, Any]
"""Entry of one photograph in appearance.json, parsed by `_row`."""
Look = Callable[[str, Image], Image]
"""Function that takes a held-out photograph's name and a render (H, W, 3), and returns the render with the photograph's
appearance."""


def gains_of(model: Path, photograph: str) -> tuple[float, ...]:
    """Return the gains, or a colour matrix, that give a run's model the appearance of one photograph.

    model: the run's folder, or a file in it.
    photograph: its name in the data set, with or without leading folders and extension.
    Returns three gains, or the nine entries of a 3 x 3 matrix by rows if channels mix. The gains of a held-out
    photograph follow from its EXIF exposure, or are the mean; its channels do not mix. Raises InputError.
    """
    run = run_of(model)
    path = run.appearance_path if run is not None else None
    if run is None or path is None or not path.exists():
        raise InputError(
            f"--appearance {photograph}: {model} has learnt no appearances (no appearance.json), expected a run of "
            f"clsplat train --appearance {' or '.join(KINDS_WITH_GAINS)}"
        )
    record = _document(path)
    kind = record.get("kind") if isinstance(record, dict) else None
    if isinstance(kind, str) and kind not in KINDS_WITH_GAINS:
        raise InputError(
            f"--appearance {photograph}: {path} is of --appearance {kind}, which is only for training; expected a run "
            f"of clsplat train --appearance {' or '.join(KINDS_WITH_GAINS)}"
        )
    rows = _read(path, record, "photographs") | _read(path, record, "held_out")
    found = [name for name in rows if photograph in (name, *_ends(name))]
    if len(found) > 1 and photograph not in found:
        raise InputError(f"--appearance {photograph}: fits {len(found)} photographs, {examples(found)}; name one")
    if not found:
        near = get_close_matches(photograph, rows, 3, 0.0)
        raise InputError(
            f"--appearance {photograph}: is not a photograph in {path}, expected one of its {len(rows)}, such as "
            f"{examples(near)}"
        )
    row = rows[photograph if photograph in found else found[0]]
    if "mixes" not in row:
        return tuple(row["gains"].tolist())
    return tuple((row["gains"][:, None] * inverse(unmixing(row["mixes"]))).ravel().tolist())


def looks_of_run(run: Run | None) -> Look:
    """Return a function that gives renders the appearance of held-out photographs, from the run's appearance.json.

    Without a run or without this file, the function returns renders unchanged. Raises InputError.
    """
    path = run.appearance_path if run is not None else None
    return _looks({} if path is None or not path.exists() else _read(path, _document(path), "held_out"))


def held_out_looks(record: Mapping[str, Any] | None) -> Look:
    """Return a function that gives renders the appearance of held-out photographs.

    record: content of appearance.json; None if nothing was learnt. The function leaves a render unchanged if `record`
    does not list the photograph.
    """
    return _looks(_rows_in(record, "held_out") if record is not None else {})


def entries_of(folder: Path, names: Sequence[str], model: ColourModel) -> tuple[Float64, Float64]:
    """Return the appearance that the run in `folder` has learnt: the entries of photographs and of lenses.

    names: the photographs' names.
    Returns arrays (photographs, model.entries) and (photographs, model.lens_entries). Raises InputError.
    """
    path, record = folder / APPEARANCE_FILE, learnt_of(folder, model.stem, names)
    try:
        rows = [record["photographs"][name] for name in names]
        tables = [
            np.array([[number for part in parts for number in row[part]] for row in rows], np.float64)
            for parts in (model.of_photograph, model.of_lens)
        ]
        for table, columns in zip(tables, (model.entries, model.lens_entries), strict=True):
            if table.shape != (len(names), columns) or not (np.abs(table) <= MAX_LOG2_GAIN).all():
                raise ValueError(
                    f"expected {columns} numbers a photograph from {-MAX_LOG2_GAIN:g} to {MAX_LOG2_GAIN:g}"
                )
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise _misread(path, error) from None
    return tables[0], tables[1]


def grids_of(folder: Path, names: Sequence[str]) -> Float32:
    """Return the bilateral grids (photographs, *GRID_SHAPE) that the run in `folder` has learnt of photographs.

    names: the photographs' names. Raises InputError.
    """
    path, record = folder / APPEARANCE_FILE, learnt_of(folder, "grid", names)
    try:
        rows = np.array([record["photographs"][name]["grid"] for name in names], np.uint32)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise _misread(path, error) from None
    arrays = path.with_suffix(".npz")
    try:
        with np.load(arrays, allow_pickle=False) as file:
            grids = file["grids"]
        if grids.shape[1:] != GRID_SHAPE or grids.dtype != np.float32 or not np.isfinite(grids).all():
            raise ValueError(f"grids have shape {grids.shape}, expected finite float32 of (photographs, *{GRID_SHAPE})")
        return np.ascontiguousarray(grids[rows])
    except (ValueError, TypeError, KeyError, IndexError, OSError, BadZipFile, OverflowError) as error:
        raise _misread(arrays, error) from None


def check_appearance(folder: Path, kind: str, names: Sequence[str]) -> None:
    """Raise InputError unless the files in `folder` have a readable appearance of these photographs.

    kind: the setting `appearance` of the run that wrote the files. names: the photographs' names.
    """
    if kind in COLOUR_MODELS:
        entries_of(folder, names, COLOUR_MODELS[kind])
    else:
        grids_of(folder, names)


def learnt_of(folder: Path, kind: str, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return the content of appearance.json in `folder`, which has a dictionary "photographs".

    kind: the setting `appearance` of the run that wrote the file. names: photographs that the file must have.
    Raises InputError if the file is missing, of another kind, or lacks photographs.
    """
    path = folder / APPEARANCE_FILE
    if not path.exists():
        raise InputError(f"{path}: no such file, expected a finished run of clsplat train --appearance {kind}")
    record = _document(path)
    if not isinstance(record, dict) or record.get("kind") != kind or not isinstance(record.get("photographs"), dict):
        was = record.get("kind") if isinstance(record, dict) else None
        raise InputError(f"{path}: is of --appearance {was}, expected --appearance {kind}")
    if missing := [name for name in names if name not in record["photographs"]]:
        raise InputError(f"{path}: lacks {len(missing)} of {len(names)} photographs ({examples(missing)})")
    return record


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
    """Return the matrix (3, 3) that undoes the channel mixes (6,) (docs/gradients.md, "Colours and vignettes")."""
    matrix = np.eye(3)
    for c, (next_share, last_share) in enumerate(mixes.reshape(3, 2)):
        matrix[c, c] += next_share + last_share
        matrix[c, (c + 1) % 3] -= next_share
        matrix[c, (c + 2) % 3] -= last_share
    return matrix


def inverse(matrix: Float64) -> Float64:
    """Return the inverse of a matrix (3, 3) by cofactors. Unlike LAPACK's, it has the same bits on every processor."""
    columns = np.stack([np.cross(matrix[(row + 1) % 3], matrix[(row + 2) % 3]) for row in range(3)], axis=1)
    first, second, third = (matrix[0] * columns[:, 0]).tolist()
    result: Float64 = columns / (first + second + third)
    return result


def _light(vignette: Float64, centre: Float64, width: int, height: int) -> Float64:
    """Return the fraction of light that a lens with a vignette transmits, for each pixel (H, W).

    vignette: (3,), coefficients of the falloff from the centre.
    centre: (2,), the vignette's centre, as fractions of the picture's width and height.
    """
    across, down = np.arange(width) + 0.5 - centre[0] * width, np.arange(height) + 0.5 - centre[1] * height
    s = 4 * (across**2 + down[:, None] ** 2) / (width**2 + height**2)
    light: Float64 = np.exp2(
        np.clip(s * (vignette[0] + s * (vignette[1] + s * vignette[2])), -MAX_LOG2_GAIN, MAX_LOG2_GAIN)
    )
    return light


def _document(path: Path) -> Any:
    try:
        return parse_json(read_document(path, EXPECTED_APPEARANCE_FILE, MAX_APPEARANCE_BYTES))
    except ValueError as error:
        raise _misread(path, error) from None


def _read(path: Path, record: Any, key: str) -> dict[str, Row]:
    try:
        return _rows_in(record, key)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise _misread(path, error) from None


def _misread(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: {type(error).__name__}: {error}; expected {EXPECTED_APPEARANCE_FILE}")


def _rows_in(record: Any, key: str) -> dict[str, Row]:
    return {str(name): _row(row) for name, row in record[key].items()}


def _ends(name: str) -> list[str]:
    """Return the short names of a photograph. For a/b.png: a/b.png, b.png, a/b and b."""
    parts = name.split("/")
    whole = ["/".join(parts[start:]) for start in range(len(parts))]
    return whole + [end.rpartition(".")[0] for end in whole if "." in end]


def _row(record: Any) -> Row:
    """Parse the entry of a photograph: gains (3,), optional mixes (6,), optional vignette (3,) with its centre (2,).

    Raises ValueError, TypeError, KeyError or OverflowError.
    """
    logs = _numbers("log2_gains", record["log2_gains"], 3, MAX_LOG2_GAIN).tolist()
    # Python floats, because NumPy's powers are rounded differently from processor to processor
    row = {"gains": np.array([2.0**log for log in logs])}
    if "mixes" in record:
        row["mixes"] = _numbers("mixes", record["mixes"], 6, MAX_CHANNEL_MIX)
    if "vignette" in record:
        row |= {
            "vignette": _numbers("vignette", record["vignette"], 3, MAX_LOG2_GAIN),
            "centre": _numbers("centre", record["centre"], 2, MAX_CENTRE_PICTURE_SIZES),
        }
    return row


def _numbers(name: str, values: Any, count: int, most: float) -> Float64:
    numbers = [float(value) for value in values] if isinstance(values, list) else []
    if len(numbers) != count or not all(math.isfinite(value) and abs(value) <= most for value in numbers):
        raise ValueError(f"{name} is {values}, expected {count} numbers from {-most:g} to {most:g}")
    return np.array(numbers)
