# SPDX-License-Identifier: Apache-2.0
"""Search for the files of a capture below a folder (`captured_files`), without folders that clsplat made there."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from clsplat.errors import InputError
from clsplat.files.documents import is_file
from clsplat.images.reading import cannot_be_searched
from clsplat.scenes.camera_json import load_document
from clsplat.scenes.video.frames import frame_sequences

SFM_RECORD_FILE = "sfm.json"
"""File in a result of structure from motion that records its photographs and settings, the photographs without a pose,
and its quality."""


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

    Hidden files and folders, and the folders `excluded`, are skipped. Sub-folders with frames that clsplat took from
    videos, or with a result of structure from motion, are left out with all that is in them: NAME_frames and
    NAME_colmap. Raises InputError for a folder that cannot be read.
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
    """Return True for a folder of frames from videos, and for a result of structure from motion, by their records."""
    if frame_sequences(folder):
        return True
    record = folder / SFM_RECORD_FILE
    if not is_file(record):
        return False
    try:
        return "fingerprint" in load_document(record, "the record of a result of sfm", "its fingerprint")
    except InputError:
        return False
