# SPDX-License-Identifier: Apache-2.0
"""frame.json, the record of a scene's coordinate frame: the similarity to it from the cameras' original frame.

The file lies beside the cameras of a COLMAP model that `clsplat sfm` made, and in the folder of a run.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write
from clsplat.files.documents import is_file, parse_json, read_document
from clsplat.models.edit import decompose

FRAME_RECORD_FILE = "frame.json"
"""Name of the record's file in the folder of a COLMAP model and in that of a run."""
MAX_FRAME_RECORD_BYTES = 1 << 20
"""Size limit of frame.json in bytes."""
_EXPECTED_FRAME_RECORD = "the record of a scene's frame"


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """The coordinate frame of a scene, relative to the source's: the frame that its cameras had first, as from COLMAP.

    world_from_source: (4, 4), similarity from the source's frame to the world.
    upright: True if the world's up is -y.
    metres: True if world units are metres.
    origin: latitude and longitude in degrees and altitude in metres of the world's origin; () if unknown. If known,
        the world's x axis points east, and z north.
    measured: the coordinates of two points that gave the scale, and the scale of world_from_source when they were
        measured; () if no points gave it.
    up_note, scale_note: what the up direction and the unit come from, for the user; "" if neither was set.
    """

    world_from_source: Float64 = field(default_factory=lambda: np.eye(4))
    upright: bool = False
    metres: bool = False
    origin: tuple[float, ...] = ()
    measured: tuple[float, ...] = ()
    up_note: str = ""
    scale_note: str = ""

    @property
    def notes(self) -> list[str]:
        """Sources of the axes and the unit, one line each."""
        return [note for note in (self.up_note, self.scale_note) if note]

    @property
    def is_source(self) -> bool:
        """True if the frame is the source's."""
        return np.array_equal(self.world_from_source, np.eye(4))

    def change_from(self, other: SceneFrame) -> Float64 | None:
        """Return the similarity (4, 4) from another frame of the same source to this one; None if they are equal."""
        if np.array_equal(self.world_from_source, other.world_from_source):
            return None
        return np.asarray(self.world_from_source @ np.linalg.inv(other.world_from_source))

    def document(self) -> dict[str, Any]:
        """Return the content of frame.json."""
        return {
            "clsplat_frame": 1,
            "world_from_source": self.world_from_source.tolist(),
            "upright": self.upright,
            "metres": self.metres,
            "origin": list(self.origin),
            "measured": list(self.measured),
            "up_note": self.up_note,
            "scale_note": self.scale_note,
        }


SOURCE_FRAME = SceneFrame()
"""Frame of a scene that was neither turned nor scaled."""


def write_frame(folder: Path, frame: SceneFrame) -> None:
    """Write frame.json into a folder."""
    atomic_write(folder / FRAME_RECORD_FILE, (json.dumps(frame.document(), indent=2) + "\n").encode())


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
        assert len(measured) in (0, 7)
        assert all(abs(value) < np.inf for value in measured)
        assert all(value > 0 for value in measured[6:])
        assert all(isinstance(note, str) for note in notes)
        frame = SceneFrame(matrix, upright, metres, tuple(float(value) for value in origin), measured, *notes)
    except (ValueError, KeyError, TypeError, AssertionError, InputError) as error:
        raise InputError(
            f"{path}: is damaged ({str(error) or 'its form is wrong'}), expected {_EXPECTED_FRAME_RECORD}; make the "
            "scene or the run again, or remove the file if nothing needs the earlier frame"
        ) from None
    return frame
