# SPDX-License-Identifier: Apache-2.0
"""Frame of a scene's files: the record beside its COLMAP model."""

from __future__ import annotations

from pathlib import Path

from clsplat.scenes.orientation.frame_record import SOURCE_FRAME, SceneFrame, read_frame
from clsplat.scenes.readers.colmap import find_model


def frame_of_files(folder: Path) -> SceneFrame:
    """Return the frame of a scene's files, recorded beside its COLMAP model. Raises InputError for a damaged record.

    folder: as for `find_model`. Without a COLMAP model or a record, it is the frame that the cameras had first.
    """
    model = find_model(folder)
    return SOURCE_FRAME if model is None else read_frame(model)
