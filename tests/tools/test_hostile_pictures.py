# SPDX-License-Identifier: Apache-2.0
"""Hostile pictures: sizes that are not true, links that go round, names that are no text."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import calls
import numpy as np
import pytest
from calls import refusal
from hostile import (
    make_colmap_text,
    make_photos,
)
from pictures import write_pixels
from systems import links

from clsplat.errors import InputError
from clsplat.images import reading, writing
from clsplat.images.reading import find_images, image_size, read_image
from clsplat.scenes.loading import load_scene
from clsplat.scenes.sfm import reconstruct


@links
def test_links_that_go_round(tmp_path: Path) -> None:
    make_photos(tmp_path)
    for name in ("a", "b", "c"):
        (tmp_path / "photos" / name).symlink_to(".")
        (tmp_path / name).symlink_to("photos")
    assert [path.name for path in find_images(tmp_path)] == ["a.png", "b.png", "picture.jpg"]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_a_png_of_100_000_by_100_000_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    rest = chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")
    for side, kind, said in (
        (100_000, 2, "does not decode"),
        (30_000, 0, "30000 x 30000"),
    ):  # its limit, ours
        head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, kind, 0, 0, 0))
        path.write_bytes(reading.PNG_SIGNATURE + head + rest)
        for read in (image_size, read_image):
            assert said in refusal(lambda read=read: read(path))


def test_an_exr_shown_as_100_000_by_100_000_pixels(tmp_path: Path) -> None:
    path, black = tmp_path / "a.exr", np.zeros((8, 8, 3), np.float32)
    write_pixels(path, black, "half", full_width=100_000, full_height=100_000)
    assert calls.peak_of(lambda: refusal(lambda: read_image(path))) < 1e6
    write_pixels(path, black, "half", full_width=3000, full_height=3000)
    assert read_image(path).shape == (3000, 3000, 3)


def test_large_flat_pictures_are_pictures(tmp_path: Path) -> None:
    """What compresses best of what there is."""
    path = tmp_path / "a.png"
    writing.write_image(path, np.zeros((3000, 4000), np.uint8))
    assert path.stat().st_size < 40_000
    assert read_image(path).shape == (3000, 4000, 3)


def test_a_decoder_that_says_what_is_no_text() -> None:
    class Decoder:
        def geterror(self) -> str:
            return b"\xff".decode()

    assert reading.error_of(Decoder()) == "in a message that is not text"


def test_a_png_of_empty_chunks_takes_no_long_look(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with open(path, "wb") as file:
        file.write(reading.PNG_SIGNATURE)
        file.truncate(1 << 29)
    with pytest.raises(InputError):
        reading._check_png_is_whole(path)


def test_names_that_no_scene_can_list(tmp_path: Path) -> None:
    make_photos(tmp_path)
    for name in ("a\nb.png", "\udcff.png"):
        odd = tmp_path / "photos" / name
        odd.write_bytes((tmp_path / "photos" / "a.png").read_bytes())
        assert "rename it" in refusal(lambda: reconstruct.sfm_photos.find_photos(tmp_path / "photos"))
        odd.unlink()


def test_a_picture_whose_name_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "\udcff.png"
    make_photos(tmp_path)
    path.write_bytes((tmp_path / "photos" / "a.png").read_bytes())
    assert "rename it" in refusal(lambda: read_image(path))


def test_warnings_of_a_scene_are_plain_lines(tmp_path: Path) -> None:
    make_colmap_text(tmp_path)
    for name in ("a\nb.png", "\udcff.png"):
        (tmp_path / "images" / name).write_bytes(b"")
    warnings = load_scene(tmp_path).warnings
    assert warnings
    assert all(warning.isprintable() for warning in warnings)
