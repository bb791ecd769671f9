# SPDX-License-Identifier: Apache-2.0
"""Pictures of a model alone, without cameras: `clsplat thumbnail` and paths around a model."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, rejected
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
        (["render", "model.ply", "-o", "a.png", "--cameras", "x", "--up", "y"], "--up y: is for paths around the"),
        (["thumbnail", "model.ply", "--up", "north"], "--up north: expected x, y, z"),
        (["thumbnail", "model.ply", "--size", "8"], "--size 8: expected 16 to 8192"),
        (["thumbnail", "model.ply", "-o", "a.##.png"], "a.##.png: is a pattern for frame numbers, expected the name"),
        (["thumbnail", "model.ply", "-o", "shot#1/a.png"], "shot#1/a.png: is a pattern for frame numbers"),
        (["thumbnail", "model.ply", "-o", "a.$F.png"], "a.$F.png: is a pattern for frame numbers"),
        (["thumbnail", "a@@b.ply"], "a@@b.ply.png: is a pattern for frame numbers"),
        (["thumbnail", "model.ply", "-o", "a.gif"], "a.gif: has the extension '.gif', expected one of .exr, .png"),
        (["thumbnail", "model.ply", "-o", "a.mp4"], "a.mp4: has the extension '.mp4', expected one of .exr, .png"),
        (
            ["render", "model.ply", "-o", "a.png", "--path", "spiral", "--lenses", "native"],
            "--lenses native: is for cameras",
        ),
        (["thumbnail", "nowhere.ply"], "nowhere.ply: no such file"),
    ],
)
def test_wrong_calls_are_one_line(words: list[str], message: str, model: Path, capsys: Capture) -> None:
    assert message in rejected(capsys, words)
    assert [path.name for path in model.parent.iterdir()] == ["model.ply"]


def test_a_run_is_seen_from_among_its_photographs(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its folder and the model file in it; a copy elsewhere, and a run that knows no photographs, from outside."""
    monkeypatch.chdir(tmp_path)
    run, bare = tmp_path / "run", tmp_path / "bare"
    for folder in (run, bare):
        shutil.copytree(trained, folder)
    (bare / "scene.json").unlink()
    shutil.copy(run / "model.ply", "alone.ply")
    pictures = {}
    for model in ("run", "run/model.ply", "bare", "alone.ply"):
        assert main(["thumbnail", model, "-o", "a.png", "--size", "40", "--overwrite"]) == 0
        pictures[model] = read_image(Path("a.png"))
    assert np.array_equal(pictures["run"], pictures["run/model.ply"])
    assert np.array_equal(pictures["bare"], pictures["alone.ply"])
    assert not np.array_equal(pictures["run"], pictures["bare"])
    assert main(["thumbnail", "run", "-o", "a.png", "--size", "40", "--up=-y", "--overwrite"]) == 0
    assert np.array_equal(read_image(Path("a.png")), pictures["bare"]), "a direction that is given: from outside"


@pytest.mark.parametrize("path", ["turntable", "spiral", "through"])
def test_paths_of_a_run_are_those_of_its_cameras(
    path: str, trained: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit the frames that the scene's own cameras give; all of its photographs have one shape."""
    monkeypatch.chdir(tmp_path)
    words = ["--path", path, "--count", "3"]
    assert main(["render", str(trained), *words, "-o", "own.#.png"]) == 0
    assert main(["render", str(trained), "--cameras", str(scene), *words, "-o", "given.#.png"]) == 0
    for number in (1, 2, 3):
        own, given = (read_image(Path(f"{name}.{number}.png")) for name in ("own", "given"))
        assert np.array_equal(own, given)


def test_a_moved_run_is_seen_from_outside(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its photographs stand elsewhere then."""
    monkeypatch.chdir(tmp_path)
    words = ["--path", "turntable", "--count", "1", "--width", "40", "--height", "40", "--transform", "translate=0,0,0"]
    assert main(["render", str(trained), *words, "-o", "moved.#.png"]) == 0
    assert main(["render", str(trained / "model.ply"), *words, "-o", "file.#.png"]) == 0
    assert np.array_equal(read_image(Path("moved.1.png")), read_image(Path("file.1.png")))
    shutil.copy(trained / "model.ply", "alone.ply")
    assert main(["render", "alone.ply", *words[:-2], "-o", "alone.#.png"]) == 0
    assert np.abs(read_image(Path("moved.1.png")) - read_image(Path("alone.1.png"))).max() < 2 / 255  # rounding
