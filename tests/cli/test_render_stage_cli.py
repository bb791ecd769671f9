# SPDX-License-Identifier: Apache-2.0
"""Gaussians that a USD stage places, against the same ones moved by hand, end to end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, error_line, ran
from compare import assert_same_bits
from needs import require
from rendered import pixels_of
from tiny import HEIGHT, WIDTH, hidden_model
from usd_stages import saved, stage_with_camera

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.config.pictures import SamplingConfig
from clsplat.gaussians import Gaussians
from clsplat.images.colour import LINEAR, SRGB, linear_to_srgb, srgb_to_linear
from clsplat.models import edit
from clsplat.models.formats import colour_space, load, usd
from clsplat.rendering.renderer import Renderer
from clsplat.spherical_harmonics import SH_C0

require("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom  # noqa: E402

CLOSE = 1e-5
"""Float32's rounding of means and SH that were turned once more, in a picture of values up to 2."""
MODEL = replace(
    hidden_model(), sh=np.concatenate([hidden_model().sh, np.random.default_rng(2).normal(0, 0.15, (40, 3, 3))], axis=1)
)
MODEL.sh = MODEL.sh.astype(np.float32)


def turned(frame: float) -> Float64:
    """The matrix of the prim that moves: USD interpolates each of its operations."""
    share = (frame - 1) / 4
    angle = np.radians(60 * share)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    matrix[:3, :3] *= 1 + share
    matrix[:3, 3] = np.array([0.4, 0.2, -0.3]) * share
    return matrix


def moving(prim: Any) -> None:
    """Operations with values at the frames 1 and 5."""
    prim = UsdGeom.Xformable(prim)
    shift, turn, scale = prim.AddTranslateOp(), prim.AddRotateYOp(), prim.AddScaleOp()
    for frame, share in ((1, 0.0), (5, 1.0)):
        shift.Set(Gf.Vec3d(0.4 * share, 0.2 * share, -0.3 * share), frame)
        turn.Set(60 * share, frame)
        scale.Set(Gf.Vec3f(1 + share), frame)


def shot(folder: Path) -> Usd.Stage:
    """A stage with a camera, and under /Asset the model of another file by reference."""
    usd.write(folder / "asset" / "model.usdc", MODEL)
    (folder / "shots").mkdir()
    stage = stage_with_camera(folder / "shots" / "shot.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    asset = UsdGeom.Xform.Define(stage, "/Asset").GetPrim()
    asset.GetReferences().AddReference("../asset/model.usdc")
    return stage


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Usd.Stage:
    """Stages of this test do not end the process, so that none has to try them first."""
    monkeypatch.setattr(usd, "_lives", lambda *_: True)
    (tmp_path / "asset").mkdir()
    return shot(tmp_path)


CAMERA = Camera(
    WIDTH, HEIGHT, float(WIDTH), float(WIDTH), WIDTH / 2, HEIGHT / 2, np.diag([1.0, -1, -1]), np.array([0, 0, 5.0])
)


def render(stage: Usd.Stage | str, out: Path, flags: str = "", cameras: str = "") -> int:
    path = stage if isinstance(stage, str) else saved(stage)
    words = ["render", path, "--cameras", cameras or path, "-o", str(out / "####.exr"), "--progress", "none"]
    return main([*words, "--width", str(WIDTH), *flags.split()])


def image(model: Gaussians) -> Float32:
    return Renderer().render(model, CAMERA).image


def test_a_stage_places_its_models(stage: Usd.Stage, tmp_path: Path) -> None:
    moving(stage.GetPrimAtPath("/Asset"))
    still = UsdGeom.Xform.Define(stage, "/Still").GetPrim()
    still.GetReferences().AddReference("../asset/model.usdc")
    still.SetInstanceable(True)
    UsdGeom.Imageable(still).GetVisibilityAttr().Set("inherited", 1)
    UsdGeom.Imageable(still).GetVisibilityAttr().Set("invisible", 3)
    assert render(stage, tmp_path, "--frames 1,2,4") == 0
    own = load(tmp_path / "asset" / "model.usdc")
    for frame in (1, 2, 4):
        moved = own if frame == 1 else edit.transform(own, turned(frame))
        wanted = image(edit.merge([moved, own]) if frame < 3 else moved)
        got = pixels_of(tmp_path / f"{frame:04d}.exr")
        if frame == 1:
            assert_same_bits(got, wanted)
        assert np.abs(got - wanted).max() < CLOSE
    assert np.abs(image(own) - image(edit.transform(own, turned(2)))).max() > 0.1


def test_a_stages_model_blurs_and_moves(stage: Usd.Stage, tmp_path: Path) -> None:
    moving(stage.GetPrimAtPath("/Asset"))
    assert render(stage, tmp_path, "--frames 3 --channels rgb,alpha,motion --shutter-angle 180 --samples 6") == 0
    own = load(tmp_path / "asset" / "model.usdc")
    times = [3 + time for time in SamplingConfig(samples=6, shutter_angle=180).sample_times]
    pictures = [Renderer().render(edit.transform(own, turned(time)), CAMERA) for time in times]
    alpha = np.mean([picture.alpha for picture in pictures], axis=0, dtype=np.float64)
    got = pixels_of(tmp_path / "0003.exr")
    assert np.abs(got[:, :, 3] - alpha).max() < CLOSE
    light = np.mean(
        [srgb_to_linear(p.image / p.alpha.clip(1e-9)[..., None]) * p.alpha[..., None] for p in pictures], axis=0
    )
    wanted = linear_to_srgb((light / alpha.clip(1e-9)[..., None]).astype(np.float32)) * alpha[..., None]
    assert np.abs(got[:, :, :3] - wanted).max() < 1e-4  # sRGB's curve is up to 12.9 times as steep as a line
    here, there = edit.transform(own, turned(3)), edit.transform(own, turned(4))
    motion = Renderer().render_channels(here, CAMERA, ("motion",), after=CAMERA, moved=there)[1]["motion"]
    assert np.abs(got[:, :, 4:] * [1, -1] - motion).max() < 1e-3  # pixels, of up to 14
    assert np.abs(motion).max() > 3


def test_units_move_nothing_and_cameras_may_be_others(stage: Usd.Stage, tmp_path: Path) -> None:
    path = saved(stage)
    other = tmp_path / "camera.usda"
    cameras = Usd.Stage.CreateNew(str(other))
    Sdf.CopySpec(stage.GetRootLayer(), "/Camera", cameras.GetRootLayer(), "/Camera")
    cameras.GetRootLayer().Save()
    own = image(load(tmp_path / "asset" / "model.usdc"))
    assert render(path, tmp_path / "a", "", str(other)) == 0
    assert_same_bits(pixels_of(tmp_path / "a" / "0001.exr"), own)


def test_prims_without_sh(stage: Usd.Stage, tmp_path: Path) -> None:
    for name, colours in (("One", [(0.2, 0.5, 0.9)]), ("Each", [(0.2, 0.5, 0.9), (0.9, 0.1, 0.0)]), ("None", [])):
        prim = stage.DefinePrim(f"/{name}", usd.GAUSSIAN_PRIM_TYPE)
        prim.CreateAttribute("positions", Sdf.ValueTypeNames.Point3fArray).Set([(0, 0, 0), (1, 0, 0)])
        prim.CreateAttribute("scales", Sdf.ValueTypeNames.Float3Array).Set([(0.1, 0.2, 0.3)] * 2)
        if colours:
            UsdGeom.Gprim(prim).CreateDisplayColorAttr(colours)
            UsdGeom.Gprim(prim).CreateDisplayOpacityAttr([0.25])
    stage.RemovePrim("/Asset")
    stage.Flatten().Export(str(tmp_path / "plain.usda"))
    model = load(tmp_path / "plain.usda")
    colours = 0.5 + SH_C0 * model.sh[:, 0]
    wanted = linear_to_srgb(np.array([[0.2, 0.5, 0.9]] * 2 + [[0.2, 0.5, 0.9], [0.9, 0.1, 0.0]], np.float32))
    np.testing.assert_allclose(colours[:4], wanted, atol=1e-6)  # displayColor is linear, models are sRGB
    np.testing.assert_allclose(colours[4:], 0.5)
    opacities = 1 / (1 + np.exp(-model.opacity_logits.astype(np.float64)))
    np.testing.assert_allclose(opacities, [0.25] * 4 + [1] * 2, atol=1e-6)
    assert render(stage, tmp_path, "--frames 1") == 0
    assert_same_bits(pixels_of(tmp_path / "0001.exr"), image(model))


@pytest.mark.slow
@pytest.mark.parametrize("where", ["attribute", "prim", "above"])
def test_a_linear_stage(where: str, stage: Usd.Stage, tmp_path: Path, capsys: Capture) -> None:
    prim = stage.GetPrimAtPath("/Asset/Gaussians")
    if where == "attribute":
        prim.GetAttribute(usd.SH_COEFFICIENTS_ATTRIBUTE).SetColorSpace("lin_rec709_scene")
    else:
        named = prim if where == "prim" else prim.GetParent()
        named.CreateAttribute("colorSpace:name", Sdf.ValueTypeNames.Token).Set("lin_rec709_scene")
    assert render(stage, tmp_path, "--frames 1 --colorspace sRGB") == 0
    own = load(tmp_path / "asset" / "model.usdc")
    picture = Renderer().render(own, CAMERA)
    assert np.abs(pixels_of(tmp_path / "0001.exr") - linear_to_srgb(picture.image)).max() < 1e-6
    stage.Flatten().Export(str(tmp_path / "flat.usda"))
    assert (colour_space(tmp_path / "flat.usda"), colour_space(tmp_path / "asset" / "model.usdc")) == (LINEAR, SRGB)
    other = UsdGeom.Xform.Define(stage, "/Other").GetPrim()
    other.GetReferences().AddReference("../asset/model.usdc")
    assert render(stage, tmp_path / "none") == 2
    assert "has Gaussians in the colour spaces lin_rec709 (/Asset/Gaussians), sRGB (/Other" in error_line(capsys)


def test_wrong_stages_are_one_line(stage: Usd.Stage, tmp_path: Path, capsys: Capture) -> None:
    scale = UsdGeom.Xformable(stage.GetPrimAtPath("/Asset")).AddScaleOp()
    scale.Set(Gf.Vec3f(1, 1, 1), 1)
    scale.Set(Gf.Vec3f(1, 2, 1), 3)
    ran(capsys, render, stage, tmp_path / "ok", "--frames 1")
    assert render(stage, tmp_path / "none", "--frames 1-3") == 2
    assert "/Asset/Gaussians at 2: has a transform that is not a similarity" in error_line(capsys)
    assert not (tmp_path / "none").exists()


def test_only_frames_in_which_something_moves_are_made_again(stage: Usd.Stage, tmp_path: Path, capsys: Capture) -> None:
    moving(stage.GetPrimAtPath("/Asset"))
    assert render(stage, tmp_path, "--frames 1-3") == 0
    UsdGeom.Xformable(stage.GetPrimAtPath("/Asset")).GetOrderedXformOps()[1].Set(30.0, 2)
    capsys.readouterr()
    lines = ran(capsys, render, stage, tmp_path, "--frames 1-3 --skip-existing")
    assert "2 of the existing frames were rendered from another model" in lines.err  # 3 is between 2 and 5
