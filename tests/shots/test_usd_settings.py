# SPDX-License-Identifier: Apache-2.0
"""Render settings, shutter, lens and sub-frame samples of USD stages."""

from __future__ import annotations

import pickle
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from calls import complaint, refuses
from needs import require

from clsplat.camera import Camera
from clsplat.config.pictures import PictureConfig, SamplingConfig
from clsplat.reference.cameras import pixel_from_world
from clsplat.sequence.shot_tasks import make_tasks, settled
from clsplat.sequence.task import RenderOptions, Task, camera_after, picture_camera, settings_digest
from clsplat.shots import Shot, choose_shot, read_shot
from clsplat.shots.optics import Optics, time_code
from clsplat.shots.readers.usd_settings import CONFORM_POLICIES

LENS = "float fStop = 2\nfloat focusDistance = 5\n"
SHUTTER = "double shutter:open = -0.25\ndouble shutter:close = 0.25\n"
WINDOW = "float4 dataWindowNDC = (-0.5, 0, 1, 1)\n"


def write_stage(
    path: Path, camera: str = "", settings: str | None = "int2 resolution = (90, 60)", more: str = ""
) -> Path:
    """A stage whose camera moves from sample to sample, three of them within frame 2's half shutter."""
    require("pxr")
    render = "" if settings is None else f'def RenderSettings "Render"\n{{\n{settings}\n}}\n'
    path.write_text(f"""#usda 1.0
(
    renderSettingsPrimPath = "/Render"
    startTimeCode = 1
    endTimeCode = 4
    metersPerUnit = 0.01
)
def Xform "rig"
{{
    double3 xformOp:translate.timeSamples = {{
        1: (0, 0, 0), 1.8: (1, 0, 0), 2: (3, 1, 0), 2.15: (4, 0, 2), 4: (8, 0, 0)
    }}
    uniform token[] xformOpOrder = ["xformOp:translate"]

    def Camera "shot"
    {{
        float focalLength = 40
        float horizontalAperture = 36
        float verticalAperture = 24
        {camera}
        double3 xformOp:translate = (1, 2, 3)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
{render}{more}""")
    return path


def tasks_of(shot: Shot, sampling: SamplingConfig | None = None, channels: tuple[str, ...] = ("rgb",)) -> list[Task]:
    return make_tasks(shot, shot, "a.####.exr", lambda camera: camera, channels, sampling)


@pytest.mark.parametrize("policy", CONFORM_POLICIES)
@pytest.mark.parametrize(
    ("pixel", "size", "kind"),
    [
        (1.0, (160, 40), "perspective"),
        (2.0, (160, 40), "perspective"),
        (0.5, (50, 80), "perspective"),
        (2.0, (90, 60), "orthographic"),
        (1.0, (90, 60), "perspective"),  # of the aperture's own shape
    ],
)
def test_the_aperture_is_fitted_to_the_picture(
    tmp_path: Path, policy: str, pixel: float, size: tuple[int, int], kind: str
) -> None:
    """The window on the film is worked out as a rectangle, and points are projected on it by similar triangles."""
    offsets = f'float horizontalApertureOffset = 3\nfloat verticalApertureOffset = -2\ntoken projection = "{kind}"'
    settings = f"int2 resolution = ({size[0]}, {size[1]})\nfloat pixelAspectRatio = {pixel}\n"
    settings += f'token aspectRatioConformPolicy = "{policy}"'
    camera = read_shot(write_stage(tmp_path / "shot.usda", offsets, settings)).cameras[0]
    assert (camera.width, camera.height) == size
    shape = size[0] * pixel / size[1]
    width, height = {
        "expandAperture": (max(36, 24 * shape), max(24, 36 / shape)),
        "cropAperture": (min(36, 24 * shape), min(24, 36 / shape)),
        "adjustApertureWidth": (24 * shape, 24),
        "adjustApertureHeight": (36, 36 / shape),
        "adjustPixelAspectRatio": (36, 24),
    }[policy]
    left, top = 3 - width / 2, -2 + height / 2
    local = np.random.default_rng(1).uniform([-1, -1, -9], [1, 1, -2], (20, 3))  # right, up, backward
    film = 40 * local[:, :2] / -local[:, 2:] if kind == "perspective" else 10 * local[:, :2]
    expected = np.stack([(film[:, 0] - left) / width * size[0], (top - film[:, 1]) / height * size[1]], axis=1)
    pixels, _ = pixel_from_world(camera, local + np.array([1, 2, 3]))
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-3)  # apertures are float32; asked for is 0.01
    if policy != "adjustPixelAspectRatio":
        assert camera.fy / camera.fx == pytest.approx(pixel)


def test_flags_go_before_the_resolution(tmp_path: Path) -> None:
    path = write_stage(tmp_path / "shot.usda", settings="int2 resolution = (90, 30)\nfloat pixelAspectRatio = 2")
    for size, wanted in (
        ((None, None), (90, 30)),
        ((30, None), (30, 10)),
        ((None, 60), (180, 60)),
        ((64, 64), (64, 64)),
    ):
        camera = read_shot(path, size=size).cameras[0]
        assert (camera.width, camera.height) == wanted
        assert camera.fy / camera.fx == pytest.approx(2)
    # without a resolution the aperture gives the other side, in pixels of that shape
    camera = read_shot(write_stage(path, settings="float pixelAspectRatio = 2"), size=(90, None)).cameras[0]
    assert (camera.width, camera.height) == (90, 120)


def test_a_product_goes_before_the_settings_and_they_name_the_camera(tmp_path: Path) -> None:
    settings = "rel camera = </rig/shot>\nrel products = [</Other>, </Product>, </Third>]\nint2 resolution = (90, 60)\n"
    settings += 'token aspectRatioConformPolicy = "cropAperture"'
    more = (
        'def Camera "second"\n{\n}\ndef RenderProduct "Other"\n{\nrel camera = </second>\nint2 resolution = (9, 9)\n}\n'
    )
    more += 'def RenderProduct "Product"\n{\nint2 resolution = (120, 60)\nrel orderedVars = </Beauty>\n'
    more += 'token productName = "beauty.exr"\n}\ndef RenderVar "Beauty"\n{\n}\ndef RenderProduct "Third"\n{\n}\n'
    path = write_stage(tmp_path / "shot.usda", settings=settings, more=more)
    second = read_shot(path)  # the first product's camera
    assert (second.cameras[0].width, second.cameras[0].height) == (9, 9)
    shot = read_shot(path, usd_camera="/rig/shot")
    assert (shot.cameras[0].width, shot.cameras[0].height) == (120, 60)
    assert shot.cameras[0].fx == pytest.approx(40 / 36 * 120), "cropAperture, of the settings, keeps the width"
    assert shot.told(path)[-1].endswith("RenderProduct /Third, orderedVars (Beauty), productName (beauty.exr)")


def test_what_is_not_applied_is_one_warning(tmp_path: Path) -> None:
    camera = f'float exposure = 1\ntoken stereoRole = "left"\nfloat exposure:iso = 200\n{LENS}{SHUTTER}'
    path = write_stage(tmp_path / "shot.usda", camera, f"int2 resolution = (90, 60)\n{WINDOW}")
    left = "exposure (1), exposure:iso (200), stereoRole (left)"
    assert choose_shot(path).told(path) == (f"{path}: not applied: {left}",)
    of_frames = "fStop (2), focusDistance (5), shutter:open (-0.25), shutter:close (0.25)"
    assert choose_shot(path).without_optics().told(path) == (f"{path}: not applied: {left}, {of_frames}",)
    window = "dataWindowNDC (-0.5, 0, 1, 1)"
    assert choose_shot(path, path="turntable").told(path) == (f"{path}: not applied: {left}, {of_frames}, {window}",)
    plain = write_stage(path, "float fStop = 0\nfloat focusDistance = 5\ndouble shutter:open = 0\nfloat exposure = 0")
    assert choose_shot(plain).told(plain) == ()
    unnamed = plain.read_text().replace('    renderSettingsPrimPath = "/Render"\n', "")
    plain.write_text(unnamed)
    told = f"{plain}: not applied: RenderSettings /Render (renderSettingsPrimPath does not name it)"
    assert choose_shot(plain, size=(90, 60)).told(plain) == (told,)


@pytest.mark.parametrize(
    ("camera", "settings", "message"),
    [
        ("double shutter:open = 0.25", "", "/rig/shot at 1: shutter:open is 0.25 and shutter:close 0, expected two"),
        ("double shutter:close = nan", "", "/rig/shot at 1: shutter:close is nan, expected a number"),
        ("float fStop = -2", "", "/rig/shot at 1: fStop is -2, expected at least 0"),
        ("float fStop = inf", "", "/rig/shot at 1: fStop is inf, expected a number"),
        ("float focusDistance = -1", "", "/rig/shot at 1: focusDistance is -1, expected at least 0"),
        ("float2 clippingRange = (1, 1)", "", "/rig/shot at 1: clippingRange is 1 to 1, expected 0 < near < far"),
        ("", "int2 resolution = (0, 9)", "/Render: resolution is 0 x 9, expected both above 0"),
        ("", "float pixelAspectRatio = 0", "/Render: pixelAspectRatio is 0.0, expected a number above 0"),
        ("", "float pixelAspectRatio = nan", "/Render: pixelAspectRatio is nan, expected a number above 0"),
        ("", 'token aspectRatioConformPolicy = "fit"', "/Render: aspectRatioConformPolicy is fit, expected one of exp"),
        ("", "float4 dataWindowNDC = (1, 0, 0, 1)", "/Render: dataWindowNDC is (1, 0, 0, 1), expected left <"),
        ("", "float4 dataWindowNDC = (0, 0, inf, 1)", "/Render: dataWindowNDC is (0, 0, inf, 1), expected left <"),
    ],
)
def test_values_that_cannot_be(tmp_path: Path, camera: str, settings: str, message: str) -> None:
    path = write_stage(tmp_path / "shot.usda", camera, settings)
    assert complaint(path, read_shot, path, size=(90, None)).startswith(message)


def test_a_camera_at_any_time_is_what_the_stage_says(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    zoom = 'float focalLength.timeSamples = { 1: 40, 2.1: 50 }\ntoken projection = "perspective"'
    path = write_stage(tmp_path / "shot.usda")
    path.write_text(path.read_text().replace("float focalLength = 40", zoom))
    shot = read_shot(path)
    opened = Usd.Stage.Open(str(path))
    camera = UsdGeom.Camera(opened.GetPrimAtPath("/rig/shot"))
    assert shot.moment is not None
    for time in (1.0, 1.3, 1.8, 1.99, 2.0, 2.1, 2.149, 3.7, 4.0, 4.3, 0.5):
        ours, theirs = shot.moment(time), camera.GetCamera(time)
        wanted = np.array(theirs.transform.ExtractTranslation())
        np.testing.assert_allclose(ours.position, wanted, atol=1e-12)
        assert ours.fx == pytest.approx(theirs.focalLength / 36 * 90, rel=1e-6)
    assert shot.moment(2.05).position == pytest.approx([1 + 3 + 1 / 3, 2 + 2 / 3, 3 + 2 / 3]), "linear from 2 to 2.15"


def test_tasks_hold_the_moments_of_the_shutter(tmp_path: Path) -> None:
    shot = read_shot(write_stage(tmp_path / "shot.usda", SHUTTER))
    own = SamplingConfig(samples=5)
    task = tasks_of(shot, own)[1]
    assert task.sampling == SamplingConfig(samples=5, shutter_open=-0.25, shutter_close=0.25)
    sent = pickle.loads(pickle.dumps(task))  # as Dask does
    assert shot.moment is not None
    for time in (*task.sampling.sample_times, -0.25, 0.25, 1.8 - 2, 2.15 - 2):
        for one in (task, sent):
            np.testing.assert_array_equal(one.at(time).position, shot.moment(2 + time).position)
            assert one.at(time).fx == shot.moment(2 + time).fx
    with pytest.raises(KeyError):
        sent.at(0.01)


def test_the_digest_sees_every_sample_of_the_shutter(tmp_path: Path) -> None:
    """One of them is at no time that the frame is rendered at."""
    path, options = write_stage(tmp_path / "shot.usda", SHUTTER), RenderOptions()
    text = path.read_text()

    def digests(old: str = "", new: str = "", sampling: SamplingConfig | None = None) -> list[str]:
        path.write_text(text.replace(old, new))
        shot = read_shot(path)
        return [settings_digest(task, options) for task in tasks_of(shot, sampling or SamplingConfig(samples=1))]

    usual = digests()
    for old, new in (("1.8: (1,", "1.8: (1.001,"), ("2.15: (4,", "2.15: (4.001,"), ("0.25\n", "0.24\n")):
        changed = digests(old, new)
        assert changed[1] != usual[1]
    assert digests("4: (8,", "4: (9,")[1] != usual[1], "what is after the shutter's end moves that end"
    assert digests("1.8: (1,", "1.8: (1.001,")[3] == usual[3], "frame 4 does not look there"
    closed = SamplingConfig(shutter_angle=0)
    assert digests("1.8: (1,", "1.8: (1.001,", closed) == digests(sampling=closed), "whole frames alone"


def test_flags_go_before_the_stages_shutter(tmp_path: Path) -> None:
    shot = read_shot(write_stage(tmp_path / "shot.usda", SHUTTER))
    for flags, wanted in (
        (SamplingConfig(), (-0.25, 0.25)),
        (SamplingConfig(shutter_angle=360), (-0.5, 0.5)),
        (SamplingConfig(shutter_angle=0), (0, 0)),
        (SamplingConfig(shutter_open=0.0, shutter_close=0.1), (0, 0.1)),
    ):
        task = tasks_of(shot, flags)[1]
        assert task.sampling is not None and task.sampling.shutter == wanted
    del shot, task  # else USD keeps the file's old text
    animated = "double shutter:open = 0\ndouble shutter:close.timeSamples = { 1: 0.1, 3: 0.3 }"
    tasks = tasks_of(read_shot(write_stage(tmp_path / "shot.usda", animated)))
    closes = [task.sampling.shutter[1] for task in tasks if task.sampling]
    assert closes == pytest.approx([0.1, 0.2, 0.3, 0.3])
    instant = "double shutter:open = 0.15\ndouble shutter:close = 0.15"
    task = tasks_of(read_shot(write_stage(tmp_path / "shot.usda", instant)))[1]
    assert task.sampling is not None and not task.sampling.on
    np.testing.assert_allclose(picture_camera(task, PictureConfig()).position, [5, 2, 5], atol=1e-12)


@pytest.mark.parametrize(
    ("setting", "shutter", "f_stop"),
    [
        ("", (-0.25, 0.25), 2),
        ("bool disableMotionBlur = 1", (0, 0), 2),
        ("bool instantaneousShutter = 1", (-0.25, -0.25), 2),
        ("bool disableDepthOfField = 1", (-0.25, 0.25), 0),
    ],
)
def test_settings_that_switch_off(tmp_path: Path, setting: str, shutter: tuple[float, float], f_stop: float) -> None:
    path = write_stage(tmp_path / "shot.usda", LENS + SHUTTER, f"int2 resolution = (90, 60)\n{setting}")
    optics = read_shot(path).frames[0].optics
    assert optics is not None and (optics.shutter, optics.f_stop) == (shutter, f_stop)


def test_motion_of_the_stages_shutter(tmp_path: Path) -> None:
    """From the middle of the shutter to a frame later; after the last frame as it went on before."""
    late = "double shutter:open = 0\ndouble shutter:close = 0.5"
    shot = read_shot(write_stage(tmp_path / "shot.usda", late))
    tasks, options = tasks_of(shot, channels=("rgb", "motion")), RenderOptions(("rgb", "motion"))
    assert shot.moment is not None
    for task in tasks:
        after = camera_after(task, options.pictures)
        assert after is not None
        here = shot.moment(task.number + 0.25)
        step = shot.moment(task.number + 1.25) if task.number < 3 else None
        wanted = step.position if step else 2 * here.position - shot.moment(task.number - 0.75).position
        np.testing.assert_allclose(after.position, wanted, atol=1e-12)


def lens_of(path: Path, flags: SamplingConfig) -> SamplingConfig:
    sampling = tasks_of(read_shot(path), flags)[0].sampling
    assert sampling is not None
    return sampling


def test_the_stages_lens(tmp_path: Path) -> None:
    """Focal lengths are in tenths of the stage's unit: 40 at f/2 is 4 units over 4. A scaled rig scales all of it."""
    path = write_stage(tmp_path / "shot.usda", LENS)
    lens = lens_of(path, SamplingConfig())
    assert (lens.aperture, lens.focus, lens.f_stop) == (pytest.approx(1.0), 5, None)
    for flags, radius, focus in (
        (SamplingConfig(focus=3.0), 1.0, 3),
        (SamplingConfig(f_stop=4.0), 0.5, 5),
        (SamplingConfig(aperture=0.2), 0.2, 5),
        (SamplingConfig(aperture=0.2, focus=7.0), 0.2, 7),
        (SamplingConfig(aperture=0.0), 0.0, 5),
    ):
        lens = lens_of(path, flags)
        assert (lens.aperture, lens.focus) == (pytest.approx(radius), focus)
        assert lens.has_lens == (radius > 0)
    # a sensor of 18 mm in place of the 36 that the stage has, its unit a centimetre
    lens = lens_of(path, SamplingConfig(f_stop=4.0, sensor_width=18.0))
    assert (lens.f_stop, lens.sensor_width, lens.metres) == (4, 18, 0.01)
    scaled = path.read_text().replace("double3 xformOp:translate = (1, 2, 3)", "float3 xformOp:scale = (2, 2, 2)")
    path.write_text(scaled.replace('"xformOp:translate"]\n    }', '"xformOp:scale"]\n    }'))
    lens = lens_of(path, SamplingConfig())
    assert (lens.aperture, lens.focus) == (pytest.approx(2.0), pytest.approx(10))


def test_a_lens_without_a_focus(tmp_path: Path) -> None:
    path = write_stage(tmp_path / "shot.usda", "float fStop = 2")
    assert not lens_of(path, SamplingConfig()).has_lens
    assert lens_of(path, SamplingConfig(focus=4.0)).aperture == pytest.approx(1)
    refuses(r"--focus 0.0: expected the depth that is in focus", lens_of, path, SamplingConfig(f_stop=2.8))
    flat = write_stage(path, f'{LENS}token projection = "orthographic"')
    assert not lens_of(flat, SamplingConfig()).has_lens
    refuses("depth of field: frame 1 is orthographic, expected perspective", lens_of, flat, SamplingConfig(f_stop=2.8))


def test_a_shot_without_a_stage_has_the_flags_alone() -> None:
    flags, camera = SamplingConfig(aperture=0.1, focus=2.0), Camera(4, 3, 2.0, 2.0, 2.0, 1.5, np.eye(3), np.zeros(3))
    assert settled(flags, None, camera) is flags
    assert settled(flags, Optics(), camera) == flags
    PictureConfig(sampling=flags).check()


@pytest.mark.parametrize(
    ("number", "rate", "digits"),
    [
        (0, Fraction(24), "00000000"),
        (1001, Fraction(24), "00004117"),
        (107892, Fraction(30000, 1001), "00595612"),  # none is dropped: 30 to a second
        (24 * 3600 * 25, Fraction(25), "00000000"),
        (23 * 3600 * 24 + 59 * 60 * 24 + 59 * 24 + 23, Fraction(24000, 1001), "23595923"),
        (-1, Fraction(24), None),
        (100, Fraction(48), None),
        (100, Fraction(25, 2), None),
    ],
)
def test_time_codes(number: int, rate: Fraction, digits: str | None) -> None:
    code = time_code(number, rate)
    assert (code if code is None else f"{code:08x}") == digits
