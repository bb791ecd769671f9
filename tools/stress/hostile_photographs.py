# SPDX-License-Identifier: Apache-2.0
"""Photographs in formats of phones and cameras, for the stress test of damaged files; see `hostile.py`."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from camera_files import write_avif, write_dng, write_heic

CAMERA_WRITERS: dict[str, Callable[[Path, Any], Path]] = {"heic": write_heic, "avif": write_avif, "dng": write_dng}
HAS_CAMERA_DECODERS = bool(find_spec("pillow_heif") and find_spec("rawpy"))


def make_camera_image(folder: Path, extension: str) -> None:
    """Write a picture in a format of phones and cameras."""
    pixels = np.random.default_rng(2).integers(0, 256, (28, 36, 3), np.uint8)
    CAMERA_WRITERS[extension](folder / f"picture.{extension}", pixels)
