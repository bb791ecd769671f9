# SPDX-License-Identifier: Apache-2.0
"""The scenes that `tools/quality_masks.py` makes, and its answer to a scene that is none."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import quality_masks
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.demo.ray_caster import Floor, Wall, cameras, still_life
from clsplat.images.reading import read_image
from clsplat.scenes.loading import load_scene

LEVEL = 1 / 255
"""The largest distance of two 8 bit pictures of the same values."""


def test_a_block_is_where_the_mask_is_and_other_pixels_stay(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    made = quality_masks.with_block(scene, tmp_path / "block", 1)
    other = quality_masks.with_block(scene, tmp_path / "other", 2)
    places = set()
    for index in range(VIEWS):
        name = f"{index:06d}.png"
        before = read_image(scene / "images" / f"{index:02d}.png")
        after = read_image(made / "images" / name)
        if index % 8 == 0:
            np.testing.assert_allclose(after, before, atol=LEVEL)
            assert not (made / "masks" / name).exists(), "a photograph that is held out"
            continue
        mask = read_image(made / "masks" / name)[:, :, 0] > 0.5
        assert (~mask).sum() == (WIDTH // 3) * (HEIGHT // 4)
        np.testing.assert_allclose(after[mask], before[mask], atol=LEVEL)
        again = read_image(other / "images" / name)
        assert np.abs(after - again)[~mask].mean() > 0.1, "other pixels of the block"
        np.testing.assert_array_equal(after[mask], again[mask])
        places.add(tuple(np.argwhere(~mask)[0]))
    assert len(places) == VIEWS - 2, "it moves"
    assert [view.name for view in load_scene(made).test_views] == ["000000.png", "000008.png"]


def test_things_are_cut_out_of_their_surroundings() -> None:
    things = [surface for surface in still_life() if not isinstance(surface, Floor | Wall)]
    for thing in things:
        thing.texture = np.full((thing.rows, thing.columns, 3), 0.5, np.float32)
    picture = quality_masks.cut_out(things, cameras(40, 32, 24, 0)[0])
    alpha = picture[:, :, 3]
    assert picture.shape == (24, 32, 4)
    assert set(np.unique(alpha)) == {0, 0.25, 0.5, 0.75, 1}, "four rays a pixel"
    inside = picture[alpha == 1][:, :3]
    ends = picture[(alpha > 0) & (alpha < 1)][:, :3]
    assert ends.min() >= inside.min() - 1e-5, "straight: no darker than inside, but for float32's products of alpha"
    assert not picture[alpha == 0].any()


def test_a_scene_that_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["quality_masks", str(tmp_path / "none"), str(tmp_path / "out")])
    assert quality_masks.main() == 2
    error = capsys.readouterr().err
    assert error == f"quality_masks: {tmp_path / 'none' / 'sparse' / '0'}: no such folder, expected a COLMAP scene\n"
