# SPDX-License-Identifier: Apache-2.0
"""Experiment with choices of `clsplat sfm`: seconds of each stage, reprojection error, and PSNR of trained models."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from typing import Any

from quality.trainings import Rows, trained

from clsplat.errors import InputError
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE
from clsplat.scenes.sfm.reconstruct import SfmSettings, reconstruct

COLUMNS = {
    "features": ("features", "learned features"),
    "matching": ("pairs", "matches", "learned matches", "more pairs", "more matches", "more learned matches"),
    "mapping": ("cameras", "cameras again", "cameras at once", "points"),
    "undistorting": ("undistorting",),
}
"""Stages of `worker.Worker.seconds` that a column of the table adds up."""


def settings_of(choice: str, seed: int) -> SfmSettings:
    """Return the settings of a choice such as "matching=exhaustive,mapper=global"; "auto" has the defaults."""
    changes: dict[str, Any] = {}
    for entry in [] if choice == "auto" else choice.split(","):
        name, _, value = entry.partition("=")
        if name not in ("matching", "mapper", "features", "weights", "camera_model", "max_features"):
            raise InputError(f"--choices {choice}: {name!r} is no setting, expected one such as matching=exhaustive")
        if name == "max_features" and not value.isdecimal():
            raise InputError(f"--choices {choice}: expected a number of features, such as max_features=8192")
        changes[name] = int(value) if name == "max_features" else value
    settings = SfmSettings(seed=seed, **changes)
    settings.check()
    return settings


def cameras(given: Namespace) -> Rows:
    """Seconds of each stage of `clsplat sfm` (processor time / wall time), photographs placed, reprojection error.

    Each folder of photographs is reconstructed with every choice. Scenes that exist in FOLDER are not made again. With
    --psnr each is trained too, and its held-out PSNR is in the last column.
    """
    scored = ("PSNR, dB",) if given.psnr else ()
    yield "photographs", "choice", "matching; pairs", *COLUMNS, "sum", "placed", "error, px", "points", *scored
    for photos in given.scenes:
        images = photos / "images" if (photos / "images").is_dir() else photos
        for choice in given.choices.split(";"):
            name = f"{photos.name} {choice.replace('=', ' ').replace(',', ' ')}"
            scene = given.folder / name.replace(" ", "-")
            reconstruct(images, scene, settings_of(choice, given.seed), threads=given.threads)
            record = json.loads((scene / SFM_RECORD_FILE).read_text("utf-8"))
            psnr = (f"{psnr_of_scene(given, name, scene):.2f}",) if given.psnr else ()
            yield photos.name, choice, *cells_of(record), *psnr
    return 0


def cells_of(record: dict[str, Any]) -> list[str]:
    """Return the cells of a reconstruction's row, from its record."""
    seconds = record["seconds"]
    cells = [f"{record['matching']}; {record['pairs']:,}"]
    for stages in (*COLUMNS.values(), tuple(seconds)):
        spent = [seconds[stage] for stage in stages if stage in seconds]
        cells.append(f"{sum(each['processor'] for each in spent):.0f} / {sum(each['wall'] for each in spent):.0f}")
    placed = f"{len(record['registered'])} of {record['photos']}"
    return [*cells, placed, f"{record['mean_reprojection_error']:.3f}", f"{record['points']:,}"]


def psnr_of_scene(given: Namespace, name: str, scene: Path) -> float:
    """Train a scene, and return its mean held-out PSNR in dB."""
    return float(trained(given, name, scene).last["mean"]["psnr"])
