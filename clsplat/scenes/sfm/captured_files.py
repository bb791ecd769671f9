# SPDX-License-Identifier: Apache-2.0
"""Search for the files of a capture below a folder (`captured_files`), without folders that clsplat made there."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from clsplat.errors import InputError
from clsplat.files.documents import is_file, is_settings_of_run, load_document
from clsplat.images.reading import cannot_be_searched
from clsplat.scenes.video.frames import frame_sequences

SFM_RECORD_FILE = "sfm.json"
"""File in a result of structure from motion that records its photographs and settings, the photographs without a pose,
and its quality."""
CAPTURE_RECORD_FILE = "capture.json"
"""File in the output folder of a capture that records the call, and the input from which each stage's results were
made."""
RECORD_KEYS = {SFM_RECORD_FILE: "fingerprint", CAPTURE_RECORD_FILE: "made"}
"""For each record, a key that another program's file of the same name does not have."""


@dataclass(frozen=True)
class CapturedFiles:
    """Files below a folder.

    folders: the folder and its sub-folders, each with the names of its files, in the order of the search.
    made: sub-folders that are left out, because clsplat made them.
    """

    folders: list[tuple[Path, list[str]]] = field(default_factory=list)
    made: list[Path] = field(default_factory=list)


def captured_files(folder: Path, excluded: Collection[Path] = ()) -> CapturedFiles:
    """Find the files below a folder.

    Hidden files and folders, and the folders `excluded`, are skipped. Sub-folders that clsplat made are left out with
    all that is in them: frames of videos, results of structure from motion, runs and captures. Raises InputError for a
    folder that cannot be read.
    """
    skip = {path.resolve() for path in excluded}
    found = CapturedFiles()
    for parent, folders, files in os.walk(folder, onerror=cannot_be_searched):
        here = Path(parent)
        if here != folder and is_made_by_clsplat(here):
            found.made.append(here)
            folders.clear()
            continue
        folders[:] = [name for name in folders if not name.startswith(".") and (here / name).resolve() not in skip]
        found.folders.append((here, [name for name in files if not name.startswith(".")]))
    return found


def is_made_by_clsplat(folder: Path) -> bool:
    """Return True for frames of videos, a result of structure from motion, a run and a capture, by their records."""
    if frame_sequences(folder) or is_settings_of_run(folder / "config.toml"):
        return True
    return any(_has_key(folder / name, key) for name, key in RECORD_KEYS.items() if is_file(folder / name))


def _has_key(record: Path, key: str) -> bool:
    try:
        return key in load_document(record, "a record of clsplat", key)
    except InputError:
        return False
