# SPDX-License-Identifier: Apache-2.0
"""Appearance of a run's photographs as it was learnt: appearance.json, by a photograph's name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float32
from clsplat.errors import InputError, examples
from clsplat.files import parse_json, read_document
from clsplat.runs.run import Run, run_of

MAX_BYTES = 1 << 28
MOST_LOG = 16.0
ONES = (1.0, 1.0, 1.0)
EXPECTED = "what clsplat train --appearance exposure writes"


def gains_of(model: Path, photograph: str) -> tuple[float, float, float]:
    """The gains by which colours of a run's model become the photograph's; of a held-out one those that EXIF tells, or
    1. model: the run's folder, or a file there; photograph: its name in the data set, or the end of that from a folder
    on, with or without extension. Raises InputError."""
    run = run_of(model)
    path = run.appearance_path if run is not None else None
    if run is None or path is None or not path.exists():
        raise InputError(
            f"--appearance {photograph}: {model} has learnt no appearances (no appearance.json), expected a run of "
            "clsplat train --appearance exposure"
        )
    if _kind(path) == "grid":
        raise InputError(
            f"--appearance {photograph}: {path} is of bilateral grids, which are for training alone; expected a run of "
            "clsplat train --appearance exposure"
        )
    gains = _read(path, "photographs") | _read(path, "held_out")
    found = [name for name in gains if photograph in (name, *_ends(name))]
    if len(found) > 1 and photograph not in found:
        raise InputError(f"--appearance {photograph}: is {len(found)} photographs, {examples(found)}; name one of them")
    if not found:
        near = get_close_matches(photograph, gains, 3, 0.0)
        raise InputError(
            f"--appearance {photograph}: is no photograph of {path}, expected one of its {len(gains)}, such as "
            f"{examples(near)}"
        )
    return gains[photograph if photograph in found else found[0]]


def gains_of_run(run: Run | None) -> Callable[[str], Float32]:
    """The gains (3,) of a run's held-out photographs by name, 1 where none are known. Raises InputError."""
    known = _read(run.appearance_path, "held_out") if run is not None and run.appearance_path.exists() else {}
    return lambda name: np.array(known.get(name, ONES), np.float32)


def held_out_gains(record: Mapping[str, Any] | None) -> Callable[[str], Float32]:
    """The same of the content of an appearance.json."""
    known = _gains_in(record, "held_out") if record is not None else {}
    return lambda name: np.array(known.get(name, ONES), np.float32)


def _kind(path: Path) -> Any:
    try:
        return parse_json(read_document(path, EXPECTED, MAX_BYTES)).get("kind")
    except (ValueError, AttributeError):
        return None


def _read(path: Path, key: str) -> dict[str, tuple[float, float, float]]:
    try:
        return _gains_in(parse_json(read_document(path, EXPECTED, MAX_BYTES)), key)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: {type(error).__name__}: {error}; expected {EXPECTED}") from None


def _gains_in(record: Any, key: str) -> dict[str, tuple[float, float, float]]:
    return {str(name): _gains(row["log2_gains"]) for name, row in record[key].items()}


def _ends(name: str) -> list[str]:
    """Shorter names that mean a photograph: without extension, and without folders."""
    parts = name.split("/")
    whole = ["/".join(parts[start:]) for start in range(len(parts))]
    return whole + [end.rpartition(".")[0] for end in whole if "." in end]


def _gains(logs: Any) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in logs)
    if not all(math.isfinite(value) and abs(value) <= MOST_LOG for value in (red, green, blue)):
        raise ValueError(f"log2_gains of {logs}")
    return 2.0**red, 2.0**green, 2.0**blue
