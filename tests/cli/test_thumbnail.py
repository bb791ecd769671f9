# SPDX-License-Identifier: Apache-2.0
"""Pictures of a model alone, without cameras: `clsplat thumbnail` and paths around a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calls import Capture, error_line
from tiny import hidden_model

from clsplat.cli.main import main
from clsplat.images import colour
from clsplat.images.reading import read_image


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "model.ply"
    hidden_model().save(path)
    monkeypatch.chdir(tmp_path)
    return path


def test_a_thumbnail_is_the_first_frame_of_a_turntable(model: Path, capsys: Capture) -> None:
    assert main(["thumbnail", str(model), "--size", "64"]) == 0
    picture = read_image(Path("model.ply.png"))
    assert picture.shape == (64, 64, 3) and picture.max() > 0.2
    assert main(["thumbnail", str(model), "--size", "64"]) == 0, "its own picture is replaced"
    sized = ["--path", "turntable", "--count", "4", "--width", "64", "--height", "64"]
    assert main(["render", str(model), *sized, "-o", "turn.#.png"]) == 0
    assert np.array_equal(read_image(Path("turn.1.png")), picture)
    assert not np.array_equal(read_image(Path("turn.2.png")), picture)
    assert main(["thumbnail", str(model), "-o", "up.png", "--up=z", "--size", "64", "--alpha"]) == 0
    assert read_image(Path("up.png")).shape == (64, 64, 4)
    assert not np.array_equal(read_image(Path("up.png"))[:, :, :3], picture)
    capsys.readouterr()


def test_a_model_of_linear_colours_has_a_thumbnail(model: Path, capsys: Capture) -> None:
    """In sRGB, which is brighter than the same numbers."""
    assert main(["thumbnail", str(model), "-o", "a.png", "--size", "64"]) == 0
    hidden_model().save(model, comments=(colour.comment("lin_rec709"),))
    assert main(["thumbnail", str(model), "-o", "b.png", "--size", "64"]) == 0
    assert read_image(Path("b.png")).mean() > 1.2 * read_image(Path("a.png")).mean()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["render", "model.ply", "-o", "a.png"], "--cameras is missing, expected cameras to render from; or --path"),
        (["render", "model.ply", "-o", "a.png", "--path", "through"], "--path through: goes through cameras"),
        (["render", "model.ply", "-o", "#.png", "--path", "spiral", "--count", "0"], "--count 0: expected 1 to"),
        (["render", "model.ply", "-o", "a.png", "--path", "spiral", "--usd-camera", "c"], "--usd-camera c: expected"),
        (["render", "model.ply", "-o", "a.png", "--cameras", "x", "--up", "y"], "--up y: is of paths around the"),
        (["thumbnail", "model.ply", "--up", "north"], "--up north: expected x, y, z"),
        (["thumbnail", "model.ply", "--size", "8"], "--size 8: expected 16 to 8192"),
        (["thumbnail", "model.ply", "-o", "a.##.png"], "a.##.png: has a place for frames' numbers, expected the name"),
        (["thumbnail", "model.ply", "-o", "shot#1/a.png"], "shot#1/a.png: has a place for frames' numbers"),
        (["thumbnail", "model.ply", "-o", "a.$F.png"], "a.$F.png: has a place for frames' numbers"),
        (["thumbnail", "a@@b.ply"], "a@@b.ply.png: has a place for frames' numbers"),
        (["thumbnail", "model.ply", "-o", "a.gif"], "a.gif: has the extension '.gif', expected one of .exr, .png"),
        (["thumbnail", "model.ply", "-o", "a.mp4"], "a.mp4: has the extension '.mp4', expected one of .exr, .png"),
        (
            ["render", "model.ply", "-o", "a.png", "--path", "spiral", "--lenses", "native"],
            "--lenses native: is of the",
        ),
        (["thumbnail", "nowhere.ply"], "nowhere.ply: no such file"),
    ],
)
def test_wrong_calls_are_one_line(words: list[str], message: str, model: Path, capsys: Capture) -> None:
    assert main(words) == 2
    assert message in error_line(capsys)
    assert [path.name for path in model.parent.iterdir()] == ["model.ply"]
