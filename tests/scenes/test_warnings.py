# SPDX-License-Identifier: Apache-2.0
"""Warnings go one way: `errors.warn`, which the command line shows, and which a scene gathers while it is read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from calls import Capture, no_warnings, warned
from models import random_gaussians

from clsplat.cli.main import main
from clsplat.errors import warn
from clsplat.images.writing import write_image
from clsplat.scenes.loading import load_scene

CLOUD = """ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
1 2 3
more
"""


def test_a_warning_of_a_reader_reaches_the_command_line(tmp_path: Path, capsys: Capture) -> None:
    """Which passes over the warnings of other packages."""
    path = tmp_path / "model.ply"
    random_gaussians(4).save(path)
    path.write_bytes(path.read_bytes() + b"more")
    assert main(["info", str(path)]) == 0
    assert capsys.readouterr().err == f"clsplat: warning: {path}: 4 bytes after the last Gaussian are ignored\n"


def test_a_warning_is_one_line() -> None:
    warned(r"^a\\nb\\x1b$", warn, "a\nb\x1b")


def test_a_scene_gathers_what_its_readers_warn_of(tmp_path: Path) -> None:
    """Of every reader, in the order in which they are heard, and nothing is said twice."""
    frames = [{"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    document = {"fl_x": 10, "w": 8, "h": 8, "ply_file_path": "cloud.ply", "rolling_shutter": 1, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    (tmp_path / "cloud.ply").write_text(CLOUD)
    for name in "abc":
        write_image(tmp_path / f"{name}.png", np.full((8, 8, 3), "abc".index(name) / 3, np.float32))
    with no_warnings():
        told = load_scene(tmp_path).warnings
    wanted = ("'rolling_shutter' is ignored", "text after the last point is ignored", "does not list 1 image(s)")
    assert len(told) == len(wanted), told
    assert all(words in line for words, line in zip(wanted, told, strict=True)), told
