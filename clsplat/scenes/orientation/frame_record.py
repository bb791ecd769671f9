# SPDX-License-Identifier: Apache-2.0
"""frame.json, the record of a scene's coordinate frame: the similarity to it from the cameras' original frame.

The file lies beside the cameras of a COLMAP model that `clsplat sfm` made, and in the folder of a run.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.files.documents import is_file, parse_json, read_document
from clsplat.models.edit import decompose
from clsplat.scenes.dataset import SOURCE_FRAME, SceneFrame

FRAME_RECORD_FILE = "frame.json"
"""Name of the record's file in the folder of a COLMAP model and in that of a run."""
MAX_FRAME_RECORD_BYTES = 1 << 20
"""Size limit of frame.json in bytes."""
_EXPECTED_FRAME_RECORD = "the record of a scene's frame"


def read_frame(folder: Path) -> SceneFrame:
    """Read frame.json of a folder; SOURCE_FRAME if there is no such file. Raises InputError for a damaged file."""
    path = folder / FRAME_RECORD_FILE
    if not is_file(path):
        return SOURCE_FRAME
    try:
        document = parse_json(read_document(path, _EXPECTED_FRAME_RECORD, MAX_FRAME_RECORD_BYTES))
        matrix = np.array(document["world_from_source"], np.float64)
        decompose(matrix)
        upright, metres, origin = (document[key] for key in ("upright", "metres", "origin"))
        measured = tuple(float(value) for value in document.get("measured", ()))  # records may be older
        notes = document["up_note"], document["scale_note"]
        assert isinstance(upright, bool)
        assert isinstance(metres, bool)
        assert len(origin) in (0, 3)
        assert all(abs(value) < np.inf for value in origin)
        assert len(measured) in (0, 7)
        assert all(abs(value) < np.inf for value in measured)
        assert all(value > 0 for value in measured[6:])
        assert all(isinstance(note, str) for note in notes)
        frame = SceneFrame(matrix, upright, metres, tuple(float(value) for value in origin), measured, *notes)
    except (ValueError, KeyError, TypeError, OverflowError, AssertionError, InputError) as error:
        raise InputError(
            f"{path}: is damaged ({str(error) or 'its form is wrong'}), expected {_EXPECTED_FRAME_RECORD}; make the "
            "scene or the run again, or remove the file if nothing needs the earlier frame"
        ) from None
    return frame
