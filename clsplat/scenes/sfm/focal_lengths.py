# SPDX-License-Identifier: Apache-2.0
"""Focal lengths from EXIF, with which pycolmap begins, compared with those that structure from motion finds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clsplat.errors import examples

MAX_FOCAL_DIFFERENCE = 0.1
"""Largest difference between the focal length found and EXIF's, as a fraction of EXIF's, without a warning.

Smaller differences are usual. EXIF rounds the 35 mm equivalent to whole millimetres, which is up to 4 % of 13 mm.
Focusing changes a focal length by a few per cent.
"""


def from_exif(database: Path) -> dict[int, float]:
    """Return the focal length in pixels of each camera in COLMAP's database for which EXIF gives it."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    return {camera.camera_id: camera.mean_focal_length() for camera in cameras if camera.has_prior_focal_length}


def compared(model: Any, given: dict[int, float]) -> list[dict[str, Any]]:
    """Return the focal lengths, from EXIF and found, of each camera of a reconstruction for which EXIF gives one.

    Keys: "photo" is the first of the camera's photographs and "photos" their number; "exif_px" and "found_px".
    model: pycolmap's reconstruction.
    given: focal lengths from EXIF, by camera (`from_exif`).
    """
    names: dict[int, list[str]] = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        names.setdefault(image.camera_id, []).append(image.name)
    return [
        {
            "photo": min(names[camera]),
            "photos": len(names[camera]),
            "exif_px": round(given[camera], 2),
            "found_px": round(model.cameras[camera].mean_focal_length(), 2),
        }
        for camera in sorted(names.keys() & given.keys())
    ]


def told(cameras: Sequence[dict[str, Any]]) -> str:
    """Return a warning about the cameras whose focal lengths differ by more than MAX_FOCAL_DIFFERENCE; "" for none.

    cameras: focal lengths from `compared`.
    """
    differences = []
    for camera in cameras:
        change = camera["found_px"] / camera["exif_px"] - 1
        if abs(change) > MAX_FOCAL_DIFFERENCE:
            others = f" and {camera['photos'] - 1:,} more" if camera["photos"] > 1 else ""
            differences.append(
                f"{camera['found_px']:.0f} px, {change:+.0%} from EXIF's {camera['exif_px']:.0f} px "
                f"({camera['photo']}{others})"
            )
    if not differences:
        return ""
    return (
        f"the focal length found is {examples(differences)}; if the photos were not cropped, the cameras may be wrong: "
        "look at them, or take photos from more directions"
    )
