# SPDX-License-Identifier: Apache-2.0
"""Cameras as survey programs write them: OpenSfM's reconstruction.json, Metashape's XML, RealityScan's XMP."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ring
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64

UTM_OFFSET = np.array([512345.5, 5412345.25, 431.125])
"""East, north and height of a place in a UTM zone."""


def at(offset: Float64 = UTM_OFFSET) -> list[ring.Pose]:
    """The ring's poses in a world whose origin is moved to `offset`."""
    return [ring.moved(pose, ring.centre_of(pose) + offset) for pose in ring.poses()]


def write_opensfm(
    folder: Path,
    posed: Sequence[ring.Pose] | None = None,
    names: Sequence[str] = ring.NAMES,
    *,
    camera: Mapping[str, Any] | None = None,
    offset: Float64 | None = None,
    **keys: Any,
) -> Path:
    """Write a reconstruction.json with pictures in images/. Returns its path.

    posed: poses; the ring's by default.
    camera: keys that replace those of the camera.
    offset: (3,), added to the points.
    keys: further keys of the reconstruction.
    """
    ring.write_pictures(folder / "images", names)
    longer = max(ring.WIDTH, ring.HEIGHT)
    lens = {"projection_type": "perspective", "width": ring.WIDTH, "height": ring.HEIGHT}
    shots = {
        name: {
            "camera": "v2 a",
            "rotation": Rotation.from_matrix(rotation).as_rotvec().tolist(),
            "translation": translation.tolist(),
        }
        for name, (rotation, translation) in zip(names, posed or ring.poses(), strict=True)
    }
    xyz, rgb = ring.points()
    xyz = xyz if offset is None else xyz + offset
    points = {
        str(index): {"coordinates": place, "color": colour}
        for index, (place, colour) in enumerate(zip(xyz.tolist(), rgb.astype(float).tolist(), strict=True))
    }
    of_file = {"focal": ring.FOCAL / longer, "k1": 0.0, "k2": 0.0} if camera is None else camera
    part = {"cameras": {"v2 a": {**lens, **of_file}}, "shots": shots, "points": points, **keys}
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([part]))
    return path
