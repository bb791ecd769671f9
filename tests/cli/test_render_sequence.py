# SPDX-License-Identifier: Apache-2.0
"""Models of a file a frame, and stages with time samples, against renders of their single models."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, fails, ran
from compare import assert_same_bits
from needs import require
from rendered import camera_file, pixels_of
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.arrays import Float32
from clsplat.cli.main import main
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.models.formats import usd
from clsplat.sequence.job_models import load_job_models

MODEL = hidden_model(30)
COUNT = 5
EVERYTHING = "--channels rgb,alpha,depth,id --exr float"


def at(frame: float) -> Gaussians:
    """The capture: it falls ever faster."""
    means = MODEL.means.copy()
    means[:, 1] += np.float32(0.01 * frame * frame)
    return replace(MODEL, means=means)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Frames 1 to COUNT, and a camera that goes to the right."""
    for frame in range(1, COUNT + 1):
        at(frame).save(tmp_path / f"capture.{frame:04d}.ply")
    camera_file(tmp_path / "cameras.json", {1: -0.3, COUNT: 0.3})
    camera_file(tmp_path / "one.json", {1: -0.3})
    return tmp_path


def render(folder: Path, model: str, out: str, flags: str = "", cameras: str = "cameras.json") -> int:
    given = ["--cameras", str(folder / cameras), "-o", str(folder / out / "####.exr"), "--progress", "none"]
    return main(["render", str(folder / model), *given, *flags.split()])


def named(folder: Path, out: str, frame: int) -> dict[str, Float32]:
    """The planes of a picture by their channels."""
    image = oiio.ImageBuf(str(folder / out / f"{frame:04d}.exr"))
    planes = image.get_pixels(oiio.FLOAT)
    return {name: planes[:, :, index] for index, name in enumerate(image.spec().channelnames)}


def pixels(folder: Path, out: str, frame: int) -> Float32:
    return pixels_of(folder / out / f"{frame:04d}.exr")


@pytest.mark.parametrize("pattern", ["capture.####.ply", "capture.%04d.ply", "capture.$F4.ply"])
def test_each_frame_is_a_render_of_its_file(pattern: str, folder: Path) -> None:
    assert render(folder, pattern, "all", EVERYTHING) == 0
    for frame in range(1, COUNT + 1):
        assert render(folder, f"capture.{frame:04d}.ply", "one", f"{EVERYTHING} --frames {frame}") == 0
        assert_same_bits(pixels(folder, "all", frame), pixels(folder, "one", frame))


def test_counts_that_differ(folder: Path) -> None:
    edit.take(at(3), slice(11)).save(folder / "capture.0003.ply")
    assert render(folder, "capture.####.ply", "all", EVERYTHING) == 0
    assert render(folder, "capture.0003.ply", "one", f"{EVERYTHING} --frames 3") == 0
    assert_same_bits(pixels(folder, "all", 3), pixels(folder, "one", 3))


def test_a_folder_a_frame(folder: Path) -> None:
    for frame in (1, 2):
        (folder / f"frame_{frame:03d}").mkdir()
        at(frame).save(folder / f"frame_{frame:03d}" / f"point_cloud_{frame:03d}.ply")
    assert render(folder, "frame_###/point_cloud_###.ply", "all", f"{EVERYTHING} --frames 1-2") == 0
    assert render(folder, "capture.####.ply", "one", f"{EVERYTHING} --frames 1-2") == 0
    assert_same_bits(pixels(folder, "all", 2), pixels(folder, "one", 2))


def test_a_camera_that_stands_sees_all_of_it(folder: Path, capsys: Capture) -> None:
    assert render(folder, "capture.####.ply", "all", EVERYTHING, "one.json") == 0
    assert sorted(path.name for path in (folder / "all").iterdir()) == [f"{n:04d}.exr" for n in range(1, COUNT + 1)]
    assert render(folder, "capture.####.ply", "some", f"{EVERYTHING} --frames 2-3", "one.json") == 0
    assert_same_bits(pixels(folder, "all", 3), pixels(folder, "some", 3))
    assert capsys.readouterr().err == ""


def test_motion_is_that_of_the_gaussians(folder: Path) -> None:
    """Against finite differences of a Gaussian that fills the picture's middle: a camera that stands, f = 41.6 px."""
    big = replace(
        edit.take(MODEL, slice(1)),
        means=np.zeros((1, 3), np.float32),
        log_scales=np.full((1, 3), np.log(0.5), np.float32),
        opacity_logits=np.full(1, 4.0, np.float32),
    )
    places = [np.array([0.02 * frame, 0.01 * frame * frame, 0.1 * frame]) for frame in range(COUNT + 1)]
    for frame in range(1, COUNT + 1):
        replace(big, means=places[frame][None].astype(np.float32)).save(folder / f"capture.{frame:04d}.ply")
    flags = "--channels rgb,motion,backward --exr float"
    assert render(folder, "capture.####.ply", "all", flags, "one.json") == 0
    focal = WIDTH / 2 / np.tan(np.radians(30))

    def place(frame: int) -> np.ndarray:
        x, y, z = places[frame] - [-0.3, 0, -4]
        return focal * np.array([x, y]) / z

    for frame in range(2, COUNT):
        planes = named(folder, "all", frame)
        row, column = (round(value) for value in place(frame)[::-1] + np.array([HEIGHT, WIDTH]) / 2 - 0.5)
        for layer, other in (("forward", frame + 1), ("backward", frame - 1)):
            found = [planes[f"{layer}.{axis}"][row, column] for axis in "uv"]
            np.testing.assert_allclose(found, (place(other) - place(frame)) * [1, -1], atol=1e-4)  # v is up


def test_motion_blur_is_the_mean_over_the_shutter(folder: Path) -> None:
    """Frames of the interpolated models, averaged in light: --samples 4 takes them at four times of the shutter."""
    flags = "--channels alpha --exr float --samples 4"
    assert render(folder, "capture.####.ply", "blurred", f"{flags} --shutter-angle 180", "one.json") == 0
    assert render(folder, "capture.####.ply", "sharp", "--channels alpha --exr float", "one.json") == 0
    for frame in range(1, COUNT + 1):
        assert np.abs(pixels(folder, "blurred", frame) - pixels(folder, "sharp", frame)).max() > 1e-3
    constant = folder / "still"
    constant.mkdir()
    for frame in range(1, COUNT + 1):
        at(2).save(constant / f"capture.{frame:04d}.ply")
    assert render(folder, "still/capture.####.ply", "unmoved", f"{flags} --shutter-angle 180", "one.json") == 0
    # averages of equal pictures are rounded
    np.testing.assert_allclose(pixels(folder, "unmoved", 3), pixels(folder, "sharp", 2), atol=1e-6)


def test_gaps_are_filled_and_told(folder: Path, capsys: Capture) -> None:
    (folder / "capture.0003.ply").unlink()
    assert "has no file for frame(s) 3, so neighbouring files are used; there are files for 1-2,4-5" in (
        ran(capsys, render, folder, "capture.####.ply", "all", "--channels alpha --exr float").err
    )
    means = (at(2).means.astype(float) + at(4).means) / 2
    replace(MODEL, means=means.astype(np.float32)).save(folder / "between.ply")
    assert render(folder, "between.ply", "one", "--channels alpha --exr float --frames 3") == 0
    # quaternions are normalised in between, which rounds them
    np.testing.assert_allclose(pixels(folder, "all", 3), pixels(folder, "one", 3), atol=1e-5)


def test_only_frames_whose_files_changed_are_made_again(folder: Path, capsys: Capture) -> None:
    assert render(folder, "capture.####.ply", "all", "--exr half") == 0
    at(9).save(folder / "capture.0002.ply")
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "all").iterdir()}
    capsys.readouterr()
    assert render(folder, "capture.####.ply", "all", "--exr half --skip-existing") == 0
    after = {path.name: path.stat().st_mtime_ns for path in (folder / "all").iterdir()}
    assert [name for name in sorted(before) if before[name] != after[name]] == ["0002.exr"]
    assert "1 of the existing frames were rendered from another model" in capsys.readouterr().err


def test_one_of_several_models(folder: Path) -> None:
    edit.transform(MODEL, edit.shifting([1.5, 0, 0])).save(folder / "room.ply")
    models = [{"name": "room", "path": "room.ply"}, {"name": "man", "path": "capture.####.ply", "opacity": 0.5}]
    (folder / "shot.json").write_text(json.dumps({"clsplat_shot": 1, "models": models}))
    assert render(folder, "shot.json", "all", EVERYTHING) == 0
    models[1]["path"] = "capture.0004.ply"
    (folder / "one_shot.json").write_text(json.dumps({"clsplat_shot": 1, "models": models}))
    assert render(folder, "one_shot.json", "one", f"{EVERYTHING} --frames 4") == 0
    assert_same_bits(pixels(folder, "all", 4), pixels(folder, "one", 4))


def test_placed_as_one(folder: Path) -> None:
    flags = f"{EVERYTHING} --transform rotate=0,30,0"
    assert render(folder, "capture.####.ply", "all", flags) == 0
    assert render(folder, "capture.0002.ply", "one", f"{flags} --frames 2") == 0
    assert_same_bits(pixels(folder, "all", 2), pixels(folder, "one", 2))


@pytest.mark.parametrize(
    ("model", "flags", "words"),
    [
        ("none.####.ply", "", "none.####.ply: no file matches, expected one file per frame, such as "),
        ("late.####.ply", "", "has no file for frame(s) 1-2,5; there are files for 3-4; give --frames 3-4"),
        ("capture.####.ply", "--channels objects", "--channels objects: "),
        ("capture.####.ply", "--appearance a.png", "--appearance a.png: is for one run's model"),
        ("odd.####.ply", "", "odd.####.ply: frame 2 is antialiased, frame 1 is not antialiased"),
        ("torn.####.ply", "", "torn.0002.ply: "),
    ],
)  # fmt: skip
def test_what_is_wrong(model: str, flags: str, words: str, folder: Path, capsys: Capture) -> None:
    for frame in (3, 4):
        at(frame).save(folder / f"late.{frame:04d}.ply")
    for frame in range(1, COUNT + 1):
        replace(at(frame), antialiased=frame == 2).save(folder / f"odd.{frame:04d}.ply")
        at(frame).save(folder / f"torn.{frame:04d}.ply")
    os.truncate(folder / "torn.0002.ply", 700)
    assert words in fails(capsys, render, folder, model, "none", f"--exr half {flags}")


def test_the_plan(folder: Path, capsys: Capture) -> None:
    plan = json.loads(ran(capsys, render, folder, "capture.####.ply", "none", "--dry-run --json").out)
    assert (plan["gaussians"], len(plan["frames"])) == (30, COUNT)
    assert load_job_models(folder / "capture.####.ply").digest == plan["digest"]


# Stages


def stage_of(folder: Path, name: str, **samples: Gaussians) -> Path:
    """A stage of one prim with these time samples."""
    require("pxr")
    from pxr import Usd

    path = folder / f"{name}.usda"
    usd.write(folder / "whole.usdc", next(iter(samples.values())))
    whole = Usd.Stage.Open(str(folder / "whole.usdc"))
    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().TransferContent(whole.GetRootLayer())
    prim = next(prim for prim in stage.Traverse() if str(prim.GetTypeName()).startswith("ParticleField"))
    for code, model in samples.items():
        prim.GetAttribute("positions").Set(np.asarray(model.means), float(code[1:]))
    stage.GetRootLayer().Save()
    return path


@pytest.mark.slow
def test_time_samples_of_a_stage(folder: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usd, "_lives", lambda *_: True)
    stage_of(folder, "capture", **{f"f{frame}": at(frame) for frame in (1, 2, 4)})
    assert ran(capsys, render, folder, "capture.usda", "all", EVERYTHING).err == ""
    between_them = replace(MODEL, means=((at(2).means.astype(float) + at(4).means) / 2).astype(np.float32))
    for frame, model in ((1, at(1)), (2, at(2)), (4, at(4)), (5, at(4)), (3, between_them)):
        stage_of(folder, f"one{frame}", f1=model)
        assert render(folder, f"one{frame}.usda", "one", f"{EVERYTHING} --frames {frame}") == 0
        found, wanted = pixels(folder, "all", frame), pixels(folder, "one", frame)
        # between samples quaternions are normalised, which rounds them
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5 if frame == 3 else 0)
