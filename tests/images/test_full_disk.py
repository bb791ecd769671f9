# SPDX-License-Identifier: Apache-2.0
"""A disk that is full for real: every writer names it, with what was being written, and leaves nothing cut behind."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from full_disk import mounts, on_disk
from models import random_gaussians
from needs import missing
from quick import quick

from clsplat.errors import WriteError
from clsplat.files.atomic import require_room
from clsplat.models import formats

SUFFIXES = [each for each in formats.suffixes(writable=True) if each.startswith(".")]


CONVERT = """
import sys
from pathlib import Path
from clsplat.models.formats import load, save
model, folder = load(sys.argv[1]), Path(sys.argv[2])
for suffix in sys.argv[3:]:
    try:
        save(folder / f"x{suffix}", model)
        print("written")
    except OSError as error:
        print(error.exit_status, error)
    print(len(list(folder.iterdir())))
"""


@mounts
def test_every_model_format_names_the_full_disk(tmp_path: Path) -> None:
    random_gaussians(3000, 3).save(tmp_path / "model.ply")
    suffixes = [each for each in SUFFIXES if not each.startswith(".usd") or not missing("pxr")]
    disk = tmp_path / "disk"
    lines = on_disk(disk, "32k", CONVERT, str(tmp_path / "model.ply"), str(disk), *suffixes)
    for suffix, said, left in zip(suffixes, lines[::2], lines[1::2], strict=True):
        name = disk / ("x.bin" if suffix == ".gltf" else f"x{suffix}")
        assert said.startswith(f"1 {name}: cannot be written: the disk is full: "), said
        assert " needed and 32 KiB are free; make room" in said
        assert left == "0"


@mounts
def test_a_full_folder_for_temporary_files_is_named(tmp_path: Path) -> None:
    random_gaussians(3000, 3).save(tmp_path / "model.ply")
    disk = tmp_path / "disk"
    suffixes = [".sog", *([] if missing("pxr") else [".usdc", ".usdz"])]
    lines = on_disk(disk, "32k", CONVERT, str(tmp_path / "model.ply"), str(tmp_path), *suffixes, TMPDIR=str(disk))
    for said in lines[::2]:
        assert said.startswith(f"1 {disk}/clsplat-")
        assert "the disk is full: " in said
        assert said.endswith("(TMPDIR sets another folder)")


PICTURES = """
import sys
from pathlib import Path
import numpy as np
from clsplat.config.pictures import Encoding; from clsplat.images.frame_files import is_whole, write_channels
folder, name = Path(sys.argv[1]), sys.argv[2]
rng = np.random.default_rng(0)
for size in range(*map(int, sys.argv[3:])):
    try:
        write_channels(folder / name, {"rgb": rng.random((size, size, 3)).astype(np.float32)})
        print("whole" if is_whole(folder / name, size, size, ["rgb"], Encoding()) else "cut")
        (folder / name).unlink()
    except OSError as error:
        print(error.exit_status, error)
    assert not list(folder.iterdir())
"""


@mounts
@pytest.mark.parametrize("extension", quick([".png", ".exr", ".tif", ".jpg"], ".exr", ".png"))
def test_no_picture_is_cut_without_a_word(extension: str, tmp_path: Path) -> None:
    """Sizes about that of the disk: the last bytes of a file are where libraries do not look."""
    disk, sizes = tmp_path / "disk", ("80", "180", "2") if extension != ".jpg" else ("60", "400", "20")
    lines = on_disk(disk, "80k", PICTURES, str(disk), f"a{extension}", *sizes)
    assert "whole" in lines
    assert "cut" not in lines
    full = [line for line in lines if line != "whole"]
    assert full
    for line in full:
        assert line.startswith(f"1 {disk / f'a{extension}'}: cannot be written: the disk is full: "), line


VIDEO = """
import sys
from pathlib import Path
import numpy as np
from clsplat.images.video import frame_planes, video_writer
rng = np.random.default_rng(0)
try:
    with video_writer(Path(sys.argv[1])) as video:
        for _ in range(10):
            video.add(frame_planes((rng.random((200, 200, 3)) * 255).astype(np.uint8)))
except OSError as error:
    print(error.exit_status, error)
print(len(list(Path(sys.argv[1]).parent.iterdir())))
"""


@mounts
@pytest.mark.needs("av")
def test_a_video_names_the_full_disk(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    said, left = on_disk(disk, "64k", VIDEO, str(disk / "a.mp4"))
    assert said.startswith(f"1 {disk / 'a.mp4'}: cannot be written: the disk is full: more than ")
    assert left == "0"


def test_room_is_counted_for_all_who_write(tmp_path: Path) -> None:
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize if os.name == "posix" else 1 << 30
    with require_room(tmp_path / "a", free // 3), require_room(tmp_path / "b", free // 3):  # noqa: SIM117
        with pytest.raises(WriteError, match="c: cannot be written: the disk is full"):
            with require_room(tmp_path / "c", free):
                pass
    with require_room(tmp_path / "c", free // 2):
        pass
