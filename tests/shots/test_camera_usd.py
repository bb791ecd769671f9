# SPDX-License-Identifier: Apache-2.0
"""Cameras of USD stages, held against USD's own mathematics."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from calls import complaint, refuses
from needs import require

from clsplat.errors import InputError
from clsplat.reference.cameras import pixel_from_world
from clsplat.shots import choose_shot, read_shot

STAGE = """#usda 1.0
(
    startTimeCode = 1001
    endTimeCode = 1005
    timeCodesPerSecond = 24
    metersPerUnit = 0.01
    upAxis = "Z"
)
def Xform "rig"
{
    double3 xformOp:translate.timeSamples = { 1001: (0, 0, 0), 1005: (8, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]

    def Camera "shot"
    {
        float focalLength.timeSamples = { 1001: 35, 1005: 75 }
        float horizontalAperture = 36
        float verticalAperture = 24
        float horizontalApertureOffset = 3.6
        float verticalApertureOffset = -1.2
        float2 clippingRange = (0.5, 500)
        double3 xformOp:translate = (1, 2, 3)
        float3 xformOp:rotateXYZ.timeSamples = { 1001: (20, 30, 40), 1005: (40, 20, 60) }
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }
}
"""


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    require("pxr")
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    return path


def assert_as_usd_projects(path: Path, prim: str, width: int, height: int) -> None:
    """Points through the view and projection matrices of Gf.Camera, which knows nothing of pixels."""
    from pxr import Gf, Usd, UsdGeom

    opened = Usd.Stage.Open(str(path))  # prims live as long as it does
    usd = UsdGeom.Camera(opened.GetPrimAtPath(prim))
    for frame in read_shot(path, size=(width, height)).frames:
        frustum = usd.GetCamera(frame.number).frustum
        matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        inverse = frustum.ComputeViewMatrix().GetInverse()
        local = np.random.default_rng(frame.number).uniform([-3, -2, -9], [3, 2, -2], (20, 3))
        world = np.array([inverse.Transform(Gf.Vec3d(*point)) for point in local])
        ndc = np.array([matrix.Transform(Gf.Vec3d(*point)) for point in world])
        expected = np.stack([(ndc[:, 0] + 1) / 2 * width, (1 - ndc[:, 1]) / 2 * height], axis=1)
        pixels, depths = pixel_from_world(frame.camera, world)
        # USD's focal lengths and apertures are float32
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-3)
        np.testing.assert_allclose(depths, -local[:, 2], rtol=1e-6)


def test_animated_camera_with_lens_shift(stage: Path) -> None:
    shot = read_shot(stage, size=(1920, None))
    assert [frame.number for frame in shot.frames] == [1001, 1002, 1003, 1004, 1005]
    assert [frame.name for frame in shot.frames][:2] == ["1001", "1002"]
    assert [frame.time for frame in shot.frames] == pytest.approx(np.arange(5) / 24)
    first, last = shot.cameras[0], shot.cameras[-1]
    assert (first.width, first.height) == (1920, 1280)
    assert (first.fx, first.fy) == pytest.approx((35 / 36 * 1920, 35 / 36 * 1920))
    assert last.fx == pytest.approx(75 / 36 * 1920)
    assert (first.cx, first.cy) == pytest.approx((960 - 192, 640 - 64))
    assert (first.near, first.far) == pytest.approx((0.5, 500))
    # neither metersPerUnit nor upAxis touches the world
    np.testing.assert_allclose([camera.position for camera in shot.cameras], [[1 + x, 2, 3] for x in (0, 2, 4, 6, 8)])
    assert_as_usd_projects(stage, "/rig/shot", 1920, 1280)
    assert choose_shot(stage, size=(90, 60)).told(stage) == ()


@pytest.mark.parametrize(
    ("authored", "rate"),
    [
        ("timeCodesPerSecond = 30", 30.0),
        ("framesPerSecond = 30", 30.0),
        ("framesPerSecond = 60\n    timeCodesPerSecond = 23.976", 23.976),
        ("", 24.0),
    ],
)
def test_the_rate_of_the_stage(stage: Path, authored: str, rate: float) -> None:
    stage.write_text(STAGE.replace("timeCodesPerSecond = 24", authored))
    shot = choose_shot(stage, size=(90, 60)).only("1001-1003")
    assert shot.fps == rate
    assert shot.frames[2].time == pytest.approx(2 / rate)
    assert choose_shot(stage, size=(90, 60), path="spiral").fps is None, "a path of its own has no rate"


def test_another_shape_than_the_aperture_keeps_the_horizontal_angle(stage: Path) -> None:
    camera = read_shot(stage, size=(1920, 800)).cameras[0]
    assert (camera.width, camera.height) == (1920, 800)
    assert camera.fx == camera.fy == pytest.approx(35 / 36 * 1920)
    assert camera.cy == pytest.approx(400 - 64)
    assert read_shot(stage, size=(None, 640)).cameras[0].width == 960


@pytest.mark.parametrize("scale", [1, 0.01])
def test_orthographic(stage: Path, scale: float) -> None:
    text = STAGE.replace("float focalLength", 'token projection = "orthographic"\n        float focalLength')
    text = text.replace('["xformOp:translate"]', '["xformOp:translate", "xformOp:scale"]')
    text = text.replace("    def Camera", f"    float3 xformOp:scale = ({scale}, {scale}, {scale})\n    def Camera")
    stage.write_text(text)
    camera = read_shot(stage, size=(360, 240)).cameras[0]
    assert camera.projection == "orthographic"
    assert 1 / camera.fx == pytest.approx(scale * 3.6 / 360)  # the aperture is in tenths of a unit
    assert camera.near == pytest.approx(0.5 * scale)
    if scale == 1:
        assert_as_usd_projects(stage, "/rig/shot", 360, 240)


def test_a_still_camera_without_a_range(stage: Path) -> None:
    stage.write_text('#usda 1.0\ndef Camera "still"\n{\n}\n')
    shot = read_shot(stage, size=(100, None))
    assert [(frame.number, frame.time) for frame in shot.frames] == [(1, None)]
    # the schema's defaults: 50 mm on 20.955 x 15.2908; its clipping range of (1, 1000000) is nobody's wish
    assert shot.cameras[0].fx == pytest.approx(100 * 50 / 20.955)
    assert (shot.cameras[0].height, shot.cameras[0].near, shot.cameras[0].far) == (73, 0.01, float("inf"))
    np.testing.assert_allclose(shot.cameras[0].rotation, np.diag([1, -1, -1]))


def test_frames_are_where_the_samples_are_if_there_is_no_range(stage: Path) -> None:
    stage.write_text(STAGE.replace("    startTimeCode = 1001\n    endTimeCode = 1005\n", ""))
    assert [frame.number for frame in read_shot(stage, size=(100, None)).frames] == list(range(1001, 1006))


def test_the_size_of_the_render_settings(stage: Path) -> None:
    settings = 'def RenderSettings "settings"\n{\n    uniform int2 resolution = (320, 200)\n}\n'
    stage.write_text(STAGE.replace("(\n", '(\n    renderSettingsPrimPath = "/settings"\n', 1) + settings)
    camera = read_shot(stage).cameras[0]
    assert (camera.width, camera.height) == (320, 200)


def test_one_camera_of_several(stage: Path) -> None:
    stage.write_text(STAGE + 'def Camera "other"\n{\n}\n')
    refuses(r"has 2 cameras, expected --usd-camera with one of /rig/shot, /other", read_shot, stage, size=(100, None))
    for name in ("shot", "/rig/shot"):
        shot = read_shot(stage, size=(100, None), usd_camera=name)
        assert shot.cameras[0].fx == pytest.approx(35 / 36 * 100)
    with pytest.raises(InputError, match=r"--usd-camera third: has no such camera, expected --usd-camera with one of"):
        read_shot(stage, size=(100, None), usd_camera="third")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("#usda", "usda", "cannot be opened as a USD stage"),
        ("def Camera", "def Xform", "has no camera in it"),
        ("horizontalAperture = 36", "horizontalAperture = 0", "has an aperture of 0 x 24, expected both above 0"),
        ("(0.5, 500)", "(0, 500)", "/rig/shot at 1001: clippingRange is 0 to 500, expected 0 < near < far"),
        ("1001: 35,", "1001: 0,", "/rig/shot at 1001: focalLength is 0, expected more than 0"),
        ("1001: 35,", "1001: nan,", "/rig/shot at 1001: focalLength is nan, expected a number"),
        ("endTimeCode = 1005", "endTimeCode = 1000.5", "/rig/shot: has no whole time code from 1001 to 1000.5"),
        (
            "endTimeCode = 1005",
            "endTimeCode = 1e12",
            "/rig/shot: has the time codes 1,001 to 1,000,000,000,000, expected at most 100,000 time codes",
        ),
    ],
)
def test_stages_that_cannot_be(stage: Path, old: str, new: str, message: str) -> None:
    stage.write_text(STAGE.replace(old, new))
    assert message in complaint(stage, read_shot, stage, size=(100, None))


def test_what_usd_warns_of_is_a_line(stage: Path, capfd: pytest.CaptureFixture[str]) -> None:
    stage.write_text(STAGE + 'def "gone" (references = @nowhere.usda@</x>)\n{\n}\n')
    (warning,) = read_shot(stage, size=(100, None)).warnings
    assert warning.startswith(f"{stage}: USD says: In </gone>: Could not open asset @nowhere.usda@")
    assert "0x" not in warning
    assert capfd.readouterr().err == ""


def test_the_example_of_the_documentation(stage: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "cameras.md").read_text()
    stage.write_text(text[text.index("#usda") : text.index("```", text.index("#usda"))])
    shot = read_shot(stage, size=(1920, None))
    assert (len(shot.frames), shot.frames[0].number, shot.cameras[0].height) == (48, 1001, 1080)
    np.testing.assert_allclose(shot.cameras[0].rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-7)
    assert shot.cameras[0].cx == pytest.approx(960 - 96)


def test_a_stage_without_a_size(stage: Path) -> None:
    refuses(r"a USD camera has no size in pixels, expected --width or --height", read_shot, stage)


def test_without_usd_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    (tmp_path / "shot.usda").write_text(STAGE)
    with pytest.raises(InputError, match=r"USD needs usd-core, which is not installed: pip install 'clsplat\[usd\]'"):
        read_shot(tmp_path / "shot.usda")
    (tmp_path / "a.json").write_text("{}")
    refuses(r"--usd-camera cam: .*a.json is not a USD stage", read_shot, tmp_path / "a.json", usd_camera="cam")


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ('token projection = "fisheyePolynomial"', "projection"),
        ('token cameraProjectionType = "fisheyeSpherical"', "cameraProjectionType"),
        ('token omni:lensdistortion:model = "opencvFisheye"', "omni:lensdistortion:model"),
    ],
)
def test_a_lens_that_is_no_pinhole(stage: Path, line: str, name: str) -> None:
    stage.write_text(STAGE.replace("float horizontalAperture = 36", f"float horizontalAperture = 36\n        {line}"))
    refuses(f"/rig/shot at 1001: {name} is .*, expected perspective or orthographic", read_shot, stage, size=(64, None))
    usual = "perspective" if name == "projection" else "pinhole"
    stage.write_text(stage.read_text().replace(line, f'{line.partition(chr(34))[0]}"{usual}"'))
    assert len(read_shot(stage, size=(64, None)).frames) == 5


@pytest.mark.parametrize("quaternion", ["(0, 0, 0, 0)", "(nan, 0, 0, 0)"])
def test_a_turn_that_is_none(stage: Path, quaternion: str) -> None:
    turn = "float3 xformOp:rotateXYZ.timeSamples = { 1001: (20, 30, 40), 1005: (40, 20, 60) }"
    text = STAGE.replace(turn, f"quatf xformOp:orient = {quaternion}").replace(
        '"xformOp:rotateXYZ"', '"xformOp:orient"'
    )
    stage.write_text(text)
    with pytest.raises(InputError, match=r"/rig/shot at 1001: xformOp:orient of /rig/shot is .*expected a unit quat"):
        read_shot(stage, size=(64, None))
