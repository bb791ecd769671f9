# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.scenes.sfm.reconstruct import SfmSettings


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_what_counts_as_transparent(dtype):
    opaque = np.iinfo(dtype).max if dtype.startswith("u") else 1
    pixels = np.full((3, 4, 4), opaque, dtype)
    assert not sfm_photos._is_transparent(pixels, 3)
    pixels[:, :, 0] = 0
    assert not sfm_photos._is_transparent(pixels, 3)
    assert not sfm_photos._is_transparent(pixels, -1)
    pixels[1, 1, 3] = 0
    assert sfm_photos._is_transparent(pixels, 3)


def test_copies_of_converted_photographs_have_names_of_their_own(tmp_path):
    for name in ("a.webp", "a.webp.jpg", "b.webp", "b.jpg", "c.webp"):
        (tmp_path / name).write_bytes(b"")
    used, left_out = sfm_photos.find_photos(tmp_path)
    assert [path.name for path in used] == ["a.webp.jpg", "b.jpg", "b.webp", "c.webp"]
    assert [path.name for path in left_out["their folder has the same photos in another format"]] == ["a.webp"]


def test_camera_groups():
    photo = sfm_photos.Photo
    wide, tall = photo("a", "a", 40, 30, ()), photo("b", "b", 30, 40, ())
    zoomed, other = photo("c", "c", 40, 30, ("x", "y", "50")), photo("d", "d", 40, 30, ())
    everything = [wide, tall, zoomed, other]
    assert sfm_photos.camera_groups(everything, "auto") == [["a", "d"], ["b"], ["c"]]
    assert sfm_photos.camera_groups(everything, True) == [["a", "c", "d"], ["b"]]
    assert sfm_photos.camera_groups(everything, False) == [["a"], ["b"], ["c"], ["d"]]


def test_settings_of_earlier_versions_keep_their_text():
    """Otherwise `sfm` and `train` would refuse the cameras that an earlier version has recovered."""
    assert str(SfmSettings()) == "auto auto auto 1600 8192 0"
    assert str(SfmSettings(max_features=8192)) != str(SfmSettings())
    assert str(SfmSettings(mapper="global")) != str(SfmSettings()) != str(SfmSettings(features="aliked"))
