# SPDX-License-Identifier: Apache-2.0
"""`clsplat render` of USD stages: what a stage says of a shot is in the pictures and in their headers."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, error_line, only, printed
from headers import exr_attributes
from needs import require
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.gaussians import Gaussians
from clsplat.images.colour import linear_to_srgb, srgb_to_linear
from clsplat.models.edit import take
from clsplat.rendering.renderer import Renderer

SHUTTER = "double shutter:open = -0.5\ndouble shutter:close = 0.5\n"
LENS = "float fStop = 1\nfloat focusDistance = 3\n"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.ply"
    hidden_model().save(path)
    return path


def write_stage(
    path: Path, camera: str = "", settings: str = "", moves: str = " = (0, 0, 4)", turns: str = " = (0, 0, 0)"
) -> Path:
    """A camera before the model, 36 by 30 mm, of frames 11 to 13."""
    require("pxr")
    path.write_text(f"""#usda 1.0
(
    renderSettingsPrimPath = "/Render"
    startTimeCode = 11
    endTimeCode = 13
    timeCodesPerSecond = 23.976
    metersPerUnit = 0.1
)
def Camera "shot"
{{
    float focalLength = 37.5
    float horizontalAperture = 36
    float verticalAperture = 30
    {camera}
    double3 xformOp:translate{moves}
    float3 xformOp:rotateXYZ{turns}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
}}
def RenderSettings "Render"
{{
    int2 resolution = ({WIDTH}, {HEIGHT})
    {settings}
}}
""")
    return path


def picture(model: Path, stage: Path, flags: str = "", frame: int = 12) -> tuple[np.ndarray, Any, Path]:
    """Pixels, specification and path of a frame."""
    file = stage.parent / f"a.{frame:04d}.exr"
    words = ["render", str(model), "--cameras", str(stage), "-o", str(stage.parent / "a.####.exr")]
    assert main([*words, "--progress", "none", "--frames", str(frame), *flags.split()]) == 0
    image = oiio.ImageBuf(str(file))
    return image.get_pixels(oiio.FLOAT), image.spec(), file


def usd_camera(camera: Any, time: float) -> Camera:
    """The pinhole that USD has at that time, by its own matrices."""
    found = camera.GetCamera(time)
    world = np.array(found.transform).T  # USD's vectors are rows
    rotation = (world[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
    focal = found.focalLength / found.horizontalAperture * WIDTH
    return Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, rotation, -rotation @ world[:3, 3])


@pytest.mark.slow
def test_shake_with_eight_samples_a_frame(model: Path, tmp_path: Path) -> None:
    """The mean, in linear light, of 64 sharp frames, by cameras of USD's own matrices."""
    rng = np.random.default_rng(4)
    times = np.arange(10, 14 + 1 / 16, 1 / 8)

    def shaken(middle: tuple[float, float, float], size: float) -> str:
        values = rng.normal(size=(len(times), 3)) * size + middle
        listed = ", ".join(f"{time}: ({x}, {y}, {z})" for time, (x, y, z) in zip(times, values.tolist(), strict=True))
        return f".timeSamples = {{ {listed} }}"

    path = tmp_path / "shot.usda"
    stage = write_stage(path, SHUTTER, moves=shaken((0, 0, 4), 0.08), turns=shaken((0, 0, 0), 1.5))
    from pxr import Usd, UsdGeom

    opened = Usd.Stage.Open(str(stage))
    camera = UsdGeom.Camera(opened.GetPrimAtPath("/shot"))
    renderer, gaussians = Renderer(), Gaussians.load(model)

    def mean_of(moments: np.ndarray) -> np.ndarray:
        sharp = [renderer.render(gaussians, usd_camera(camera, float(time))).image for time in moments]
        return linear_to_srgb(np.mean([srgb_to_linear(image) for image in sharp], axis=0))

    wanted = mean_of(12 - 0.5 + (np.arange(64) + 0.5) / 64)
    blurred, _, _ = picture(model, stage, "--samples 64")
    # the same times: float32, and the order of the sum
    assert np.abs(blurred - wanted).mean() < 1e-5
    fewer, _, _ = picture(model, stage, "--samples 32 --overwrite")
    assert np.abs(fewer - wanted).mean() < 1e-3  # other times than the wanted ones
    whole = mean_of(np.array([12.0]))
    assert np.abs(whole - wanted).mean() > 5e-3, "there is something to see"
    still, _, _ = picture(model, stage, "--shutter-angle 0")
    assert np.abs(still - whole).max() < 1e-5


@pytest.mark.slow
def test_the_stages_lens_is_that_of_the_flags(model: Path, tmp_path: Path) -> None:
    """37.5 tenths of a unit at f/1 are a radius of 1.875 units."""
    stage = write_stage(tmp_path / "shot.usda", LENS)
    blurred, _, _ = picture(model, stage, "--samples 8")
    flags = write_stage(tmp_path / "flags.usda")
    same, _, _ = picture(model, flags, f"--samples 8 --aperture {37.5 * 0.1 / 2} --focus 3")
    np.testing.assert_allclose(blurred, same, atol=1e-6)  # the stage's numbers are float32
    sharp, _, _ = picture(model, flags)
    assert np.abs(blurred - sharp).mean() > 0.01
    off, _, _ = picture(model, stage, "--aperture 0")
    np.testing.assert_array_equal(off, sharp)
    stopped, _, _ = picture(model, stage, "--samples 8 --f-stop 2")
    same, _, _ = picture(model, flags, "--samples 8 --f-stop 2 --focus 3 --sensor-width 36 --metres 0.01")
    np.testing.assert_allclose(stopped, same, atol=1e-5)


def test_a_deep_frame_has_the_stages_shutter_and_lens(model: Path, tmp_path: Path) -> None:
    stage = write_stage(tmp_path / "shot.usda", LENS + SHUTTER)
    flags = "--samples 6 --model-colorspace lin_rec709 --colorspace lin_rec709"
    blurred, _, _ = picture(model, stage, f"{flags} --alpha")
    words = ["render", str(model), "--cameras", str(stage), "-o", str(tmp_path / "deep.exr"), "--frames", "12"]
    assert main([*words, "--deep", *flags.split()]) == 0
    flat = oiio.ImageBufAlgo.flatten(oiio.ImageBuf(str(tmp_path / "deep.exr"))).get_pixels(oiio.FLOAT)
    # slices of six samples, merged: a few units of 6e-8 of each
    np.testing.assert_allclose(flat[:, :, :4], blurred, atol=4e-6)
    sharp, _, _ = picture(model, stage, f"{flags} --alpha --aperture 0 --shutter-angle 0")
    assert np.abs(blurred - sharp).mean() > 0.01, "there is something to see"


def test_the_far_plane(model: Path, tmp_path: Path) -> None:
    gaussians = Gaussians.load(model)
    depths = 4 - gaussians.means[:, 2]  # the camera looks along -z
    cut = write_stage(tmp_path / "shot.usda", "float2 clippingRange = (0.1, 4)")
    near, _, _ = picture(model, cut, "--channels rgb,alpha")
    kept = take(gaussians, depths < 4)
    assert 0 < len(kept) < len(gaussians)
    kept.save(tmp_path / "kept.ply")
    open_ended = write_stage(tmp_path / "open.usda", "float2 clippingRange = (0.1, 1000)")
    wanted, _, _ = picture(tmp_path / "kept.ply", open_ended, "--channels rgb,alpha")
    np.testing.assert_array_equal(near, wanted)


def test_headers(model: Path, tmp_path: Path) -> None:
    """Units: millimetres, metres and seconds; of a stage in tenths of a metre, lenses are in hundredths."""
    stage = write_stage(tmp_path / "shot.usda", LENS + SHUTTER, "float pixelAspectRatio = 2")
    _, _, file = picture(model, stage, "--samples 2")
    found = exr_attributes(file)

    def floats(name: str) -> tuple[float, ...]:
        kind, value = found[name]
        assert kind in ("float", "v2f")
        return struct.unpack(f"<{len(value) // 4}f", value)

    assert found["framesPerSecond"] == ("rational", struct.pack("<iI", 24000, 1001))
    assert found["timeCode"] == ("timecode", struct.pack("<II", 0x00000012, 0))  # frame 12
    assert floats("pixelAspectRatio") == pytest.approx((2,))
    assert floats("aperture") == pytest.approx((1,)) and floats("focus") == pytest.approx((0.3,))
    for name in ("nominalFocalLength", "pinholeFocalLength", "effectiveFocalLength"):
        assert floats(name) == pytest.approx((375,))
    # expandAperture: 48 x 40 pixels of twice the width are 2.4 to 1, so that 30 high are 72 wide
    assert floats("sensorOverallDimensions") == pytest.approx((720, 300))
    assert floats("expTime") == pytest.approx((1 / 23.976,))
    _, _, file = picture(model, stage, "--samples 2 --f-stop 2.8 --focus 5 --shutter-angle 180")
    found = exr_attributes(file)
    assert floats("aperture") == pytest.approx((2.8,)) and floats("focus") == pytest.approx((0.5,))
    assert floats("expTime") == pytest.approx((0.5 / 23.976,))
    _, _, file = picture(model, stage, "--aperture 0 --shutter-angle 0 --parts several --channels rgb,depth")
    assert not {"aperture", "focus", "expTime"} & exr_attributes(file).keys()


@pytest.mark.slow
def test_the_data_window(model: Path, tmp_path: Path) -> None:
    plain, _, _ = picture(model, write_stage(tmp_path / "plain.usda"))
    # 0.25 to 0.75 of 48, and from the bottom 0.1 to 0.5 of 40: pixels whose centres are in it
    path = tmp_path / "shot.usda"
    part, spec, _ = picture(model, write_stage(path, settings="float4 dataWindowNDC = (0.25, 0.1, 0.75, 0.5)"))
    assert (spec.x, spec.y, spec.width, spec.height, spec.full_width) == (12, 20, 24, 16, WIDTH)
    np.testing.assert_array_equal(part, plain[20:36, 12:36])
    _, spec, _ = picture(model, path, "--region 1,2,3,4")
    assert (spec.x, spec.y, spec.width, spec.height) == (1, 2, 3, 4)
    wide = write_stage(tmp_path / "wide.usda", settings="float4 dataWindowNDC = (-0.125, -0.125, 1.125, 1.125)")
    larger, spec, _ = picture(model, wide)
    assert (spec.x, spec.y, spec.width, spec.height) == (-6, -5, WIDTH + 12, HEIGHT + 10)
    np.testing.assert_array_equal(larger[5:-5, 6:-6], plain)


def warnings_of(capsys: Capture, model: Path, stage: Path, flags: str = "") -> list[str]:
    words = ["render", str(model), "--cameras", str(stage), "-o", str(stage.parent / "b.####.exr"), "--dry-run"]
    capsys.readouterr()
    return [line for line in printed(capsys, [*words, *flags.split()]).err.splitlines() if "not applied" in line]


@pytest.mark.slow
def test_one_warning_of_what_is_not_applied(model: Path, tmp_path: Path, capsys: Capture) -> None:
    window = "float4 dataWindowNDC = (-0.25, 0, 1, 1)"
    stage = write_stage(tmp_path / "shot.usda", f"float exposure = 1\n{LENS}{SHUTTER}", window)
    (line,) = warnings_of(capsys, model, stage)
    assert line.endswith(f"{stage}: not applied: exposure (1), dataWindowNDC (-0.25, 0, 1, 1)")
    (line,) = warnings_of(capsys, model, stage, "--region 0,0,9,9 --samples 3")
    assert line.endswith(": not applied: exposure (1)")
    assert only(warnings_of(capsys, model, stage, "--deep --region 0,0,9,9")).endswith(": not applied: exposure (1)")
    unfocused = write_stage(tmp_path / "unfocused.usda", "float fStop = 1")
    assert only(warnings_of(capsys, model, unfocused)).endswith(": not applied: fStop (1)")
    assert warnings_of(capsys, model, unfocused, "--focus 3") == []
    assert warnings_of(capsys, model, unfocused, "--aperture 0") == []


def test_pixels_that_a_file_shows_as_squares(model: Path, tmp_path: Path, capsys: Capture) -> None:
    stage = write_stage(tmp_path / "shot.usda", settings="float pixelAspectRatio = 2")
    assert warnings_of(capsys, model, stage) == []
    (line,) = warnings_of(capsys, model, stage, f"-o {tmp_path}/c.####.png")
    assert ": not applied: pixelAspectRatio (2), because .png files cannot store it and viewers show square" in line


@pytest.mark.slow
def test_the_plan_and_errors(model: Path, tmp_path: Path, capsys: Capture) -> None:
    stage = write_stage(tmp_path / "shot.usda", LENS + SHUTTER)
    words = ["render", str(model), "--cameras", str(stage), "-o", str(tmp_path / "b.####.exr"), "--samples", "7"]
    assert json.loads(printed(capsys, [*words, "--dry-run", "--json"]).out)["samples"] == 7
    line = next(line for line in printed(capsys, [*words, "--dry-run"]).out.splitlines() if line.startswith("samples"))
    assert line == "samples   7 pictures per frame, shutter from -0.5 to 0.5 frames, lens in focus at 3"
    thin = write_stage(tmp_path / "thin.usda", settings="float4 dataWindowNDC = (0.5, 0, 0.501, 1)")
    assert main(["render", str(model), "--cameras", str(thin), "-o", str(tmp_path / "c.####.exr")]) == 2
    assert f"{thin}: dataWindowNDC (0.5, 0, 0.501, 1) contains no pixel centre of the 48x40 frame" in error_line(capsys)
    wrong = write_stage(tmp_path / "wrong.usda", "double shutter:close = -1")
    assert main(["render", str(model), "--cameras", str(wrong), "-o", str(tmp_path / "c.####.exr")]) == 2
    assert f"{wrong}: /shot at 11: shutter:open is 0 and shutter:close -1, expected two times" in error_line(capsys)
