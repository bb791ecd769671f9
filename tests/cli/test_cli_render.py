# SPDX-License-Identifier: Apache-2.0
"""`clsplat render` as a user calls it, on fakes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, error_line, rejected
from fakes import Pipeline, camera
from rendered import camera_file

from clsplat.cli.main import main, parse
from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.render.request import resizer
from clsplat.config.presets import RASTERIZER_PRESETS
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.config.training import TrainConfig
from clsplat.runs.run import Run


def test_render(model: str, folder: str, pipeline: Pipeline, tmp_path: Path, capsys: Capture) -> None:
    pattern = str(tmp_path / "out" / "x_{name}_y.exr")
    assert (
        pipeline.main(["render", model, "--cameras", folder, "-o", pattern, "--background", "0.5,0,1", "--json"]) == 0
    )
    records = json.loads(capsys.readouterr().out)
    assert [record["name"] for record in records] == ["a.jpg", "sub/b.c.jpg"]
    assert [Path(record["path"]) for record in records] == [
        tmp_path / "out" / "x_a_y.exr",
        tmp_path / "out" / "x_sub" / "b.c_y.exr",
    ]
    assert sorted(pipeline.written) == sorted(record["path"] for record in records)
    assert pipeline.calls == [("render", 4, 32, 24, (0.5, 0, 1)), ("render", 4, 20, 40, (0.5, 0, 1))]
    assert pipeline.written[records[0]["path"]].shape == (24, 32, 3)


def test_rasterizer_flags_of_render(model: str, tmp_path: Path, capsys: Capture) -> None:
    run = tmp_path / "run"
    own = RasterizerConfig(alpha_min=3 / 255, sh_tolerance=0.5)
    Run.create(run, TrainConfig(rasterizer=own))

    def parsed(path: object, *flags: str) -> RenderVerb:
        verb = parse(["render", str(path), "--cameras", "S", "-o", "{name}.png", "--alpha", "--json", *flags])
        assert isinstance(verb, RenderVerb)
        assert (verb.model, verb.output, verb.alpha, verb.json) == (Path(str(path)), "{name}.png", True, True)
        return verb

    half = ["--rasterizer.sh-storage", "half", "--rasterizer.sh-degree-limit", "1"]
    changes: dict[str, Any] = {"sh_storage": "half", "sh_degree_limit": 1}
    for path, bundle in ((model, RasterizerConfig()), (run, own)):
        assert parsed(path).rasterizer == bundle
        assert parsed(path, *half).rasterizer == replace(bundle, **changes)
        for preset in ("exact", "default", "fast"):
            assert parsed(path, "--preset", preset).rasterizer == RASTERIZER_PRESETS[preset]
            assert parsed(path, *half, "--preset", preset).rasterizer == replace(RASTERIZER_PRESETS[preset], **changes)
    assert parsed(run, "--rasterizer.sh-tolerance", "0").rasterizer == replace(own, sh_tolerance=0.0)
    assert main(["render", model, "--cameras", "S", "-o", "{name}.png", "--rasterizer.sh-tolerance", "-1"]) == 2
    assert "--rasterizer.sh-tolerance -1.0: expected 0 to 1" in error_line(capsys)
    assert "not a run" in rejected(capsys, ["render", tmp_path, "--cameras", "S", "-o", "{name}.png"])


@pytest.mark.parametrize("extension", ["exr", "png"])
def test_render_with_alpha(extension: str, model: str, folder: str, pipeline: Pipeline, tmp_path: Path) -> None:
    assert (
        pipeline.main(["render", model, "--cameras", folder, "-o", f"{tmp_path}/{{name}}.{extension}", "--alpha"]) == 0
    )
    image = pipeline.written[f"{tmp_path}/a.{extension}"]
    np.testing.assert_allclose(image, np.broadcast_to([0.25] * 3 + [0.5], (24, 32, 4)))


@pytest.mark.parametrize(
    ("flags", "size"),
    [
        ("--width 64", (64, 48)),
        ("--height 12", (16, 12)),
        ("--scale 0.5", (16, 12)),
        ("--width 10 --height 5", (10, 5)),
    ],
)
def test_render_sizes(
    flags: str, size: tuple[int, int], model: str, folder: str, pipeline: Pipeline, tmp_path: Path
) -> None:
    pipeline.cameras = {"a.jpg": camera()}
    assert pipeline.main(["render", model, "--cameras", folder, "-o", str(tmp_path / "one.png"), *flags.split()]) == 0
    assert pipeline.calls == [("render", 4, *size, (0, 0, 0))]


PATH = {
    "render_width": 40,
    "render_height": 30,
    "camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 60}] * 12,
}


def test_render_of_a_camera_path(model: str, pipeline: Pipeline, tmp_path: Path, capsys: Capture) -> None:
    cameras = tmp_path / "camera_path.json"
    cameras.write_text(json.dumps(PATH))
    out = str(tmp_path / "shot" / "beauty.####.exr")
    assert pipeline.main(["render", model, "--cameras", str(cameras), "-o", out, "--frames", "3,8-11:2", "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert [record["frame"] for record in records] == [3, 8, 10]
    assert sorted(pipeline.written) == [str(tmp_path / "shot" / f"beauty.{i:04d}.exr") for i in (3, 8, 10)]
    assert pipeline.calls == [("render", 4, 40, 30, (0, 0, 0))] * 3
    assert (
        pipeline.main(["render", model, "--cameras", str(cameras), "-o", out, "--frames", "12-13", "--width", "80"])
        == 0
    )
    assert pipeline.calls[3:] == [("render", 4, 80, 60, (0, 0, 0))]
    captured = capsys.readouterr()
    assert captured.err == (
        "clsplat: warning: --frames 12-13: 1 of these frames do not exist; the shot has the frames 1-12\n"
    )


@pytest.mark.parametrize("path", ["turntable", "spiral", "through"])
def test_render_along_a_path(path: str, model: str, folder: str, pipeline: Pipeline, tmp_path: Path) -> None:
    out = str(tmp_path / "%02d.png")
    assert pipeline.main(["render", model, "--cameras", folder, "-o", out, "--path", path, "--count", "5"]) == 0
    assert sorted(pipeline.written) == [str(tmp_path / f"{i:02d}.png") for i in range(1, 6)]
    assert pipeline.calls == [("render", 4, 32, 24, (0, 0, 0))] * 5


def test_render_of_frames_that_begin_negative(model: str, pipeline: Pipeline, tmp_path: Path) -> None:
    cameras = camera_file(tmp_path / "cameras.json", {-5: 0, 5: 0}, size=(8, 6))
    out = str(tmp_path / "{frame}.png")
    assert pipeline.main(["render", model, "--cameras", str(cameras), "-o", out, "--frames=-2-1"]) == 0
    assert set(pipeline.written) == {str(tmp_path / f"{i}.png") for i in (-2, -1, 0, 1)}


def test_cameras_that_cannot_be_rendered(model: str, pipeline: Pipeline, tmp_path: Path, capsys: Capture) -> None:
    cameras, out = tmp_path / "camera_path.json", ["-o", str(tmp_path / "shot" / "####.exr")]
    cases: list[tuple[dict[str, object], list[str], str]] = [
        ({"camera_path": []}, out, f"{cameras}: has no keys in 'camera_path'"),
        ({}, [*out, "--count", "3"], "--count 3: expected --path with it"),
        ({}, [*out, "--path", "turntable", "--count", "0"], "--count 0: expected 1 to 100,000 frames"),
        ({}, [*out, "--usd-camera", "c"], "is not a USD stage"),
        ({}, ["-o", str(tmp_path / "shot" / "a.exr")], "or a frame number such as ####"),
        ({}, ["-o", str(tmp_path / "shot" / "{nam}.exr")], "{nam} is not known, expected {name}, {frame}, ####, "),
    ]
    for changes, arguments, message in cases:
        cameras.write_text(json.dumps({**PATH, **changes}))
        assert message in rejected(capsys, ["render", model, "--cameras", cameras, *arguments], call=pipeline.main)
    assert pipeline.main(["render", model, "--cameras", str(cameras), *out, "--path", "zigzag"]) == 2
    assert "zigzag" in error_line(capsys)
    assert not pipeline.written
    assert not (tmp_path / "shot").exists()


def test_render_that_cannot_be(model: str, folder: str, pipeline: Pipeline, tmp_path: Path, capsys: Capture) -> None:
    out = str(tmp_path / "{name}.png")
    cases = [
        (["--cameras", folder, "-o", str(tmp_path / "one.png")], "names a single file for 2 frames, expected"),
        (["--cameras", folder, "-o", str(tmp_path / "{name}.tga")], "extension '.tga', expected one of .exr, .png"),
        (["--cameras", folder, "-o", str(tmp_path / "{name}")], "extension 'none'"),
        (["--cameras", str(tmp_path / "none"), "-o", out], "none: no such folder"),
        (["--cameras", folder, "-o", out, "--background", "red"], "expected black, white or three numbers"),
        (["--cameras", folder, "-o", out, "--background", "1,2,3"], "expected black, white or three numbers"),
        (["--cameras", folder, "-o", out, "--background", "white", "--alpha"], "exclude each other"),
        (["--cameras", folder, "-o", out, "--width", "0"], "--width 0: expected a number above 0"),
        (["--cameras", folder, "-o", out, "--scale", "2", "--width", "9"], "exclude each other"),
    ]
    for arguments, message in cases:
        assert message in rejected(capsys, ["render", model, *arguments], call=pipeline.main)
    for names, message in [
        (["a.jpg", "a.png"], "would be the file of both a.jpg and a.png"),
        (["../../a.jpg"], "leads out of the output folder"),
        ([], "has no images"),
    ]:
        pipeline.cameras = {name: camera() for name in names}
        assert message in rejected(capsys, ["render", model, "--cameras", folder, "-o", out], call=pipeline.main)
    assert not pipeline.written


def test_a_size_of_another_shape_keeps_the_pixels_square() -> None:
    """And the vertical angle of view; where the shape is but rounded, too."""
    before = replace(camera(40, 80), fx=50.0, fy=51.0, cx=22.0, cy=30.0)
    wide = resizer(160, 40, 1.0)(before)
    assert (wide.width, wide.height, wide.fx, wide.fy, wide.cx, wide.cy) == (160, 40, 25.0, 25.5, 81.0, 15.0)
    near = resizer(21, 40, 1.0)(before)
    assert (near.fx, near.fy, near.cx) == (25.0, 25.5, 10.5 + (22 - 20) / 2)
    panorama = replace(before, projection="equirectangular")
    assert resizer(160, 40, 1.0)(panorama).fx == pytest.approx(200), "that shows all around"


def test_all_sizes_of_a_shape_show_the_same() -> None:
    """Of a camera whose own shape they have but for rounding, however they are asked for."""
    before = replace(camera(996, 748), fx=900.0, fy=901.0, cx=500.0, cy=370.0)
    found = [
        resizer(width, height, scale)(before)
        for width, height, scale in (
            (320, 240, 1.0), (640, 480, 1.0), (1280, 960, 1.0), (4000, 3000, 1.0), (320, None, 1.0), (None, 240, 1.0),
        )
    ]  # fmt: skip
    assert all(3 * each.width == 4 * each.height for each in found)
    views = [
        (each.fx / each.width, each.fy / each.height, each.cx / each.width, each.cy / each.height) for each in found
    ]
    np.testing.assert_allclose(views, [views[0]] * len(views), rtol=1e-12)
    assert all(each.fx / each.fy == pytest.approx(900 / 901) for each in found), "pixels are square as they were"
    exact = resizer(None, None, 0.25)(before)
    assert exact.fx == before.resized(249, 187).fx, "the same shape is a pure scaling"
