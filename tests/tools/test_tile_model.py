# SPDX-License-Identifier: Apache-2.0
"""`tools/stress/tile_model.py`: any number of Gaussians from a small model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tile_model

from clsplat.gaussians import Gaussians


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Gaussians in a box of 8 x 4 x 2 units, with a stray."""
    rng, count = np.random.default_rng(0), 500
    means = rng.uniform(0, 1, (count, 3)) * (8, 4, 2)
    means[0] = 1e4
    arrays = (means, rng.normal(size=(count, 4)), rng.normal(-4, 0.3, (count, 3)), rng.normal(size=count))
    sh = rng.normal(0, 0.3, (count, 16, 3)).astype(np.float32)
    gaussians = Gaussians(*(array.astype(np.float32) for array in arrays), sh, antialiased=True)
    gaussians.save(tmp_path / "model.ply")
    return tmp_path / "model.ply"


def test_copies_lie_side_by_side_and_differ_a_little(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tile_model, "PIECE_ROWS", 100)
    arguments = [str(model), str(tmp_path / "tiled.ply"), "--gaussians", "1700", "--box=-1,-1,-1,9,9,9"]
    assert tile_model.main(arguments) == 0
    source, tiled = Gaussians.load(model), Gaussians.load(tmp_path / "tiled.ply")
    assert len(tiled) == 1700 and tiled.sh_degree == 3 and tiled.antialiased
    kept = np.flatnonzero(np.isin(source.quaternions[:, 0], tiled.quaternions[:, 0]))
    size = len(kept)
    assert size == 499 and 0 not in kept
    for copy, corner in enumerate([(0, 0, 0), (10, 0, 0), (0, 10, 0), (10, 10, 0)]):
        rows = slice(copy * size, min(copy * size + size, 1700))
        own = kept[: rows.stop - rows.start]
        off = tiled.means[rows] - source.means[own] - corner
        assert 0 < np.abs(off).max() < 0.1
        np.testing.assert_array_equal(tiled.quaternions[rows], source.quaternions[own])
        np.testing.assert_array_equal(tiled.sh[rows, 1:], source.sh[own, 1:])
        for one, other, most in (
            (tiled.log_scales[rows], source.log_scales[own], 0.2),
            (tiled.opacity_logits[rows], source.opacity_logits[own], 0.6),
            (tiled.sh[rows, 0], source.sh[own, 0], 0.4),
        ):
            assert 0 < np.abs(one - other).max() < most
    assert not np.array_equal(tiled.sh[:size, 0], tiled.sh[size : 2 * size, 0])


def test_equal_arguments_give_equal_bytes_and_fewer_degrees_a_smaller_file(model: Path, tmp_path: Path) -> None:
    calls = {"one": "", "two": "", "seeded": "--seed 1", "lean": "--sh-degree 0 --up y"}
    for name, more in calls.items():
        words = [str(model), str(tmp_path / f"{name}.ply"), "--gaussians", "3000", *more.split()]
        assert tile_model.main(words) == 0
    files = {name: (tmp_path / f"{name}.ply").read_bytes() for name in calls}
    assert files["one"] == files["two"] != files["seeded"]
    lean = Gaussians.load(tmp_path / "lean.ply")
    assert len(lean) == 3000 and lean.sh_degree == 0 and len(files["lean"]) < len(files["one"]) / 3
    assert np.ptp(lean.means[:, 1]) < 4.5 and np.ptp(lean.means[:, 2]) > 4.5


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("--gaussians 0", "at least 1"),
        ("--gaussians 5 --sh-degree 4", "--sh-degree of 0 to 3"),
        ("--gaussians 5 --box 0,0,0,1,1", "--box 0,0,0,1,1: expected six numbers"),
        ("--gaussians 5 --box 0,0,0,1,1,-1", "--box 0,0,0,1,1,-1: expected six numbers, the low corner first"),
        ("--gaussians 5 --box 50,0,0,60,1,1", "--box: has none of the 500 Gaussians"),
    ],
)
def test_a_wrong_argument_is_one_line(
    more: str, told: str, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tile_model.main([str(model), str(tmp_path / "tiled.ply"), *more.split()]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "tiled.ply").exists()


def test_an_existing_file_stays(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tile_model.main([str(model), str(model), "--gaussians", "5"]) == 2
    assert "would be replaced" in capsys.readouterr().err
