# SPDX-License-Identifier: Apache-2.0
"""Pictures' flags of `clsplat render`, each once from end to end on a tiny model: what it does to the file."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, error_line, fails, printed, ran
from headers import exr_attributes, png_chunks
from pictures import write_pixels
from quick import quick
from rendered import SHOT_FRAMES, camera_file, contents, render_shot
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.cli.main import main
from clsplat.config.pictures import ColourConfig
from clsplat.images.colour import LINEAR, Colours, comment, linear_to_srgb, srgb_to_linear
from clsplat.images.video import video_missing

HALF = 2.0**-11
"""What rounding to a half loses, relative."""
FLAGS = [
    *("--colorspace", "--model-colorspace", "--ocio-config", "--overscan", "--region", "--supersample", "--filter"),
    *("--samples", "--shutter-angle", "--shutter-open", "--shutter-close", "--f-stop", "--aperture", "--focus"),
    *("--sensor-width", "--metres", "--deep", "--deep.bins"),
    *("--video.fps", "--video.crf", "--video.preset"),
]


def picture(shot: list[str], folder: Path, flags: str = "", frame: int = 2) -> tuple[np.ndarray, Any]:
    """Pixels and specification of one frame."""
    assert render_shot(shot, folder, f"--frames {frame} {flags}") == 0
    image = oiio.ImageBuf(str(folder / f"a.{frame:04d}.exr"))
    return image.get_pixels(oiio.FLOAT), image.spec()


@pytest.fixture(scope="module")
def bright(shot: list[str], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """As `shot`, of a model with colours of up to 1.9 and some channels of 0."""
    model = hidden_model()
    path = tmp_path_factory.mktemp("bright") / "model.ply"
    replace(model, sh=3 * model.sh).save(path)
    return [str(path), *shot[1:]]


@pytest.fixture(scope="module")
def plain(shot: list[str], tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Frame 2 with alpha and depth."""
    return picture(shot, tmp_path_factory.mktemp("plain"), "--channels rgb,alpha,depth")[0]


def test_the_help_has_every_flag(capsys: Capture) -> None:
    words = printed(capsys, ["render", "--help"]).out.split()
    assert [flag for flag in FLAGS if flag not in words] == []


def test_overscan_and_region(shot: list[str], plain: np.ndarray, tmp_path: Path) -> None:
    larger, spec = picture(shot, tmp_path, "--channels rgb,alpha,depth --overscan 5")
    assert (spec.x, spec.y, spec.width, spec.height) == (-5, -5, WIDTH + 10, HEIGHT + 10)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, WIDTH, HEIGHT)
    np.testing.assert_array_equal(larger[5:-5, 5:-5], plain)
    part, spec = picture(shot, tmp_path, "--channels rgb,alpha,depth --region 7,9,20,11")
    assert (spec.x, spec.y, spec.width, spec.height, spec.full_width) == (7, 9, 20, 11, WIDTH)
    np.testing.assert_array_equal(part, plain[9:20, 7:27])


@pytest.mark.parametrize("kind", ["box", "blackman-harris"])
def test_supersampling(kind: str, shot: list[str], plain: np.ndarray, tmp_path: Path) -> None:
    flags = f"--channels rgb,alpha,depth --supersample 3 --filter {kind}"
    fine, _ = picture(shot, tmp_path, flags)
    np.testing.assert_array_equal(fine[:, :, 4], plain[:, :, 4])  # of depth there is no mean
    assert 0.002 < np.abs(fine[:, :, 3] - plain[:, :, 3]).mean() < 0.1
    if kind == "box":
        large, _ = picture(shot, tmp_path, f"--channels alpha --width {3 * WIDTH}")
        mean = large[:, :, 0].reshape(HEIGHT, 3, WIDTH, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(fine[:, :, 3], mean, atol=1e-6)  # sums of nine floats up to 1


def test_colour_through_a_half_file_and_back(bright: list[str], tmp_path: Path) -> None:
    plain, _ = picture(bright, tmp_path, "--channels rgb,alpha")
    held, spec = picture(bright, tmp_path, "--channels rgb,alpha --colorspace ACEScg --exr half")
    assert (spec.getattribute("clsplat:colorspace"), spec.getattribute("colorInteropID")) == ("ACEScg", "lin_ap1_scene")
    alpha = plain[:, :, 3]
    straight = plain[:, :, :3] / np.where(alpha > 0, alpha, 1)[:, :, None]
    truth = srgb_to_linear(straight) * alpha[:, :, None]
    colours = Colours(ColourConfig(colorspace="ACEScg"))
    back = colours.convert(held[:, :, :3], None, "ACEScg", LINEAR)
    # rounding is of ACEScg's channels, and the matrix back has rows of absolute sum up to 2.5
    size = np.abs(held[:, :, :3]).max(axis=2, keepdims=True)
    assert (np.abs(back - truth) <= 2.5 * HALF * size + 1e-6).all()
    assert truth.max() > 1 > truth.min() >= 0  # what is over 1 survives


def test_colours_beyond_0_and_1_survive(bright: list[str], tmp_path: Path) -> None:
    # a colour of Rec.709 that is called one of AP1, which reaches further, is beyond Rec.709 where it is saturated
    flags = "--channels rgb,alpha --exr half --model-colorspace ACEScg --colorspace"
    held, _ = picture(bright, tmp_path, f"{flags} lin_rec709")
    assert held[:, :, :3].min() < -0.1
    assert held[:, :, :3].max() > 1.2
    same, _ = picture(bright, tmp_path, f"{flags} ACEScg")
    colours = Colours(ColourConfig(colorspace="ACEScg"))
    size = np.abs(held[:, :, :3]).max(axis=2, keepdims=True)
    back = colours.convert(held[:, :, :3], None, LINEAR, "ACEScg")
    # rows of the matrix there add up to 1, and the other picture is of halves too
    assert (np.abs(back - same[:, :, :3]) <= HALF * (size + np.abs(same[:, :, :3])) + 1e-6).all()


def test_the_space_is_that_of_the_model_file(shot: list[str], plain: np.ndarray, tmp_path: Path) -> None:
    hidden_model().save(tmp_path / "linear.ply", comments=[comment(LINEAR)])
    encoded, spec = picture([str(tmp_path / "linear.ply"), *shot[1:]], tmp_path, "--colorspace sRGB")
    np.testing.assert_allclose(encoded, linear_to_srgb(plain[:, :, :3]), rtol=1e-6, atol=1e-7)
    assert spec.getattribute("clsplat:colorspace") == "sRGB"
    same, spec = picture([str(tmp_path / "linear.ply"), *shot[1:]], tmp_path)
    np.testing.assert_array_equal(same, plain[:, :, :3])
    assert spec.getattribute("clsplat:colorspace") == LINEAR


def test_a_configuration_of_ones_own(shot: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tmp_path / "own.ocio"
    config.write_text(
        "ocio_profile_version: 1\nroles:\n  default: lin_rec709\ndisplays:\n  sRGB:\n"
        "    - !<View> {name: view, colorspace: lin_rec709}\nactive_displays: []\nactive_views: []\ncolorspaces:\n"
        "  - !<ColorSpace>\n    name: lin_rec709\n  - !<ColorSpace>\n    name: twice\n"
        "    from_reference: !<MatrixTransform> {matrix: [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]}\n"
    )
    monkeypatch.chdir(tmp_path)  # a file beside, as workers elsewhere have to find it too
    once, _ = picture(shot, tmp_path, "--colorspace lin_rec709")
    twice, _ = picture(shot, tmp_path, "--colorspace twice --ocio-config own.ocio")
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-6)


def blur(image: np.ndarray) -> float:
    """Sum of the differences between neighbours: less where it is blurred."""
    return float(np.abs(np.diff(image[:, :, 3], axis=1)).sum())


def test_shutter(shot: list[str], plain: np.ndarray, tmp_path: Path) -> None:
    flags = "--channels rgb,alpha,depth --samples 8"
    turned, _ = picture(shot, tmp_path, f"{flags} --shutter-angle 360")
    assert blur(turned) < 0.95 * blur(plain)
    np.testing.assert_array_equal(turned[:, :, 4], plain[:, :, 4])  # the middle of the shutter is the frame
    timed, _ = picture(shot, tmp_path, f"{flags} --shutter-open -0.5 --shutter-close 0.5")
    np.testing.assert_array_equal(timed, turned)
    later, _ = picture(shot, tmp_path, f"{flags} --shutter-open 0 --shutter-close 1")
    assert np.abs(later[:, :, 4] - plain[:, :, 4]).max() > 0.01
    # the camera goes on at both ends as it did there, at one speed: each frame is blurred as much
    ends = [blur(picture(shot, tmp_path, f"{flags} --shutter-angle 360", frame)[0]) for frame in (1, SHOT_FRAMES)]
    assert max(ends) < 0.95 * blur(plain)


def test_motion_of_an_open_shutter(shot: list[str], tmp_path: Path) -> None:
    flags = "--channels alpha,motion --samples 2"
    whole, _ = picture(shot, tmp_path, flags, SHOT_FRAMES)
    late, _ = picture(shot, tmp_path, f"{flags} --shutter-open 0 --shutter-close 0.5", SHOT_FRAMES)
    seen = (whole[:, :, 0] > 0.5) & (late[:, :, 0] > 0.5)
    # a frame's way from the middle of the shutter on, at one speed; depths differ by what the camera has moved
    np.testing.assert_allclose(np.median(late[seen][:, 1]), np.median(whole[seen][:, 1]), rtol=0.02)


def test_lens(shot: list[str], plain: np.ndarray, tmp_path: Path) -> None:
    flags = "--channels rgb,alpha,depth --samples 8"
    near, _ = picture(shot, tmp_path, f"{flags} --aperture 0.2 --focus 1")
    assert blur(near) < 0.9 * blur(plain)
    sharp, _ = picture(shot, tmp_path, f"{flags} --aperture 0.2 --focus 4")
    assert blur(near) < blur(sharp) < blur(plain)
    # fx = W / 2 / tan 30 degrees, on a sensor of 36 mm, so 31.18 mm at 1 m a unit: radius 0.2 at this f-number
    stop = 36 / 2 / np.tan(np.pi / 6) / 1000 / 0.4
    stopped, _ = picture(shot, tmp_path, f"{flags} --f-stop {stop} --focus 1")
    np.testing.assert_allclose(stopped[:, :, :4], near[:, :, :4], atol=1e-5)
    double, _ = picture(shot, tmp_path, f"{flags} --f-stop {stop} --focus 1 --sensor-width 72 --metres 2")
    np.testing.assert_allclose(double[:, :, :4], near[:, :, :4], atol=1e-5)


def test_deep(shot: list[str], plain: np.ndarray, tmp_path: Path, capsys: Capture) -> None:
    assert render_shot(shot, tmp_path, "--deep --deep.bins 4 --frames 2") == 0
    image = oiio.ImageBuf(str(tmp_path / "a.0002.exr"))
    assert image.spec().deep
    data = image.deepdata()
    assert 1 < max(data.samples(pixel) for pixel in range(data.pixels)) <= 4
    flat = oiio.ImageBufAlgo.flatten(image).get_pixels(oiio.FLOAT)
    np.testing.assert_allclose(flat[:, :, :4], plain[:, :, :4], atol=2e-6)  # sums in float, as docs/pictures.md says
    before = (tmp_path / "a.0002.exr").stat().st_mtime_ns
    whole = (tmp_path / "a.0002.exr").read_bytes()
    again = "--deep --deep.bins 4 --frames 2 --skip-existing"
    assert render_shot(shot, tmp_path, again) == 0
    assert (tmp_path / "a.0002.exr").stat().st_mtime_ns == before
    (tmp_path / "a.0002.exr").write_bytes(whole[:-100])
    assert render_shot(shot, tmp_path, again) == 0
    assert (tmp_path / "a.0002.exr").read_bytes() == whole
    assert render_shot(shot, tmp_path, "--alpha --frames 2 --skip-existing") == 0  # a flat one is another
    assert not oiio.ImageBuf(str(tmp_path / "a.0002.exr")).spec().deep


def test_deep_of_a_shutter_and_a_lens(shot: list[str], tmp_path: Path) -> None:
    flags = (
        "--model-colorspace lin_rec709 --colorspace lin_rec709 --samples 4 --shutter-angle 360 --aperture 0.1 --focus 2"
    )
    flat, _ = picture(shot, tmp_path / "flat", f"{flags} --alpha")
    assert render_shot(shot, tmp_path / "deep", f"{flags} --deep --frames 2") == 0
    image = oiio.ImageBuf(str(tmp_path / "deep" / "a.0002.exr"))
    over = oiio.ImageBufAlgo.flatten(image).get_pixels(oiio.FLOAT)
    np.testing.assert_allclose(over[:, :, :4], flat, atol=4e-6)  # slices of four samples, merged
    before = (tmp_path / "deep" / "a.0002.exr").stat().st_mtime_ns
    assert render_shot(shot, tmp_path / "deep", f"{flags} --deep --frames 2 --skip-existing") == 0
    assert (tmp_path / "deep" / "a.0002.exr").stat().st_mtime_ns == before
    assert render_shot(shot, tmp_path / "deep", f"{flags} --deep --frames 2 --skip-existing --samples 5") == 0
    assert (tmp_path / "deep" / "a.0002.exr").stat().st_mtime_ns != before


def test_another_colour_space_is_not_what_is_wanted(shot: list[str], tmp_path: Path) -> None:
    picture(shot, tmp_path)
    _, spec = picture(shot, tmp_path, "--colorspace ACEScg --skip-existing")
    assert spec.getattribute("clsplat:colorspace") == "ACEScg"


@pytest.mark.parametrize(
    "change",
    quick(
        [
            *(
                "--exr half",
                "--parts several",
                "--compression none",
                "--background white",
                "--shutter-angle 90",
                "moved",
            ),
            *("--aperture 0.1 --focus 4", "--supersample 2", "--model-colorspace ACEScg --colorspace sRGB"),
            *("--rasterizer.sh-degree-limit 0", "nothing", "--quality 50", "--samples 3"),
        ],
        *("moved", "nothing"),
    ),
)
def test_a_frame_of_other_settings_is_not_what_is_wanted(
    change: str, shot: list[str], tmp_path: Path, capsys: Capture
) -> None:
    """Of a still camera: only the last three change no frame."""
    kept = change in ("nothing", "--quality 50", "--samples 3")
    places = [0, 1e-3 if change == "moved" else 0]
    files = [camera_file(tmp_path / f"{index}.json", {1: x}) for index, x in enumerate(places)]
    first, second = ([*shot[:2], str(file)] for file in files)
    flags = "--channels rgb,depth" if change == "--parts several" else ""
    assert render_shot(first, tmp_path, flags) == 0
    before = (tmp_path / "a.0001.exr").stat().st_mtime_ns
    more = f"{flags} {'' if change in ('moved', 'nothing') else change} --skip-existing"
    assert render_shot(second, tmp_path, more) == 0
    assert ((tmp_path / "a.0001.exr").stat().st_mtime_ns == before) == kept
    written = (tmp_path / "a.0001.exr").stat().st_mtime_ns
    assert render_shot(second, tmp_path, more) == 0
    assert (tmp_path / "a.0001.exr").stat().st_mtime_ns == written
    told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    again = [line for line in told if "1 of the existing frames were rendered from another model, or with" in line]
    assert len(again) == (0 if kept else 1)
    assert all(line.endswith("flags without effect on .exr files: --quality") for line in told if line not in again)


@pytest.mark.parametrize("extension", ["tif", "jpg", "dpx"])
def test_files_without_attributes_say_how_they_were_made(
    extension: str, shot: list[str], tmp_path: Path, capsys: Capture
) -> None:
    """In a text of their header, so that there is no file beside them."""
    pattern = f"a.####.{extension}"
    assert render_shot(shot, tmp_path, "--frames 1,2", pattern) == 0
    assert len(list(tmp_path.iterdir())) == 2
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert render_shot(shot, tmp_path, "--frames 1,2 --skip-existing", pattern) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    assert capsys.readouterr().err == ""
    document = json.loads(Path(shot[2]).read_text())
    document["keys"][1]["position"] = [0.5, 0, -3.9]  # frame 1 is where it was, frame 2 is not
    (tmp_path / "moved.json").write_text(json.dumps(document))
    moved = [*shot[:2], str(tmp_path / "moved.json")]
    (line,) = ran(capsys, render_shot, moved, tmp_path, "--frames 1,2 --skip-existing", pattern).err.splitlines()
    assert "1 of the existing frames were rendered from another model, or with other cameras or settings" in line
    changed = {path.name for path, stamp in before.items() if path.stat().st_mtime_ns != stamp}
    assert changed == {f"a.0002.{extension}"}
    other = {"jpg": "--quality 50"}.get(extension, "--bits 16")
    assert render_shot(moved, tmp_path, f"--frames 1,2 --skip-existing {other}", pattern) == 0
    assert "2 of the existing frames were rendered from another model, or with other" in capsys.readouterr().err
    replace(hidden_model(), sh=0.9 * hidden_model().sh).save(tmp_path / "other.ply")
    assert render_shot([str(tmp_path / "other.ply"), *moved[1:]], tmp_path, f"--skip-existing {other}", pattern) == 0
    assert "2 of the existing frames were rendered from another model" in capsys.readouterr().err


def test_frames_that_do_not_say_how_they_were_made(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    for number in range(1, 5):
        made = {"Software": "clsplat of an earlier version"}
        write_pixels(tmp_path / f"a.{number:04d}.jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8), attributes=made)
    for more in ("", "--dry-run"):
        assert render_shot(shot, tmp_path, f"--skip-existing --quality 5 {more}", "a.####.jpg") == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("clsplat: warning: --skip-existing: 4 existing frames have no record of their settings")
        assert line.endswith("a.0001.jpg; they are kept unchecked")
    assert render_shot(shot, tmp_path, "", "a.####.png") == 0
    assert "clsplat:settings" in " ".join(png_chunks(tmp_path / "a.0001.png"))
    assert render_shot(shot, tmp_path, "--skip-existing --bits 16", "a.####.png") == 0
    assert png_chunks(tmp_path / "a.0001.png")["IHDR"][8] == 16, "bits"


def test_strips(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    flags = f"--width {20 * WIDTH} --frames 2 --channels rgb,alpha,depth --max-device-mem"
    plenty, little = (f"{flags} {size}" for size in ("1GiB", "4MiB"))
    assert render_shot(shot, tmp_path / "plenty", plenty) == 0
    plan = json.loads(ran(capsys, render_shot, shot, tmp_path, f"{little} --dry-run --json").out)
    assert plan["devices"][0]["strips"] > 1
    assert plan["devices"][0]["needed"] <= 4 << 20
    assert render_shot(shot, tmp_path / "little", little) == 0
    assert contents(tmp_path / "little") == contents(tmp_path / "plenty")
    assert render_shot(shot, tmp_path / "parts", f"{little} --parts several") == 2
    assert "--parts several: a picture of 960x800 is too large to be written at once" in error_line(capsys)
    assert not (tmp_path / "parts").exists()


EVERYTHING = "--channels rgb,alpha,depth,motion --overscan 3 --supersample 2 --colorspace ACEScg --shutter-angle 180 "
EVERYTHING += "--samples 3 --aperture 0.1 --focus 4"


def test_the_plan(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    text = ran(capsys, render_shot, shot, tmp_path / "new", f"{EVERYTHING} --dry-run").out
    for part in (
        f"{WIDTH + 6}x{HEIGHT + 6} at -3,-3 of {WIDTH}x{HEIGHT}",
        "colour    sRGB to ACEScg",
        "samples   3 pictures per frame, shutter from -0.25 to 0.25 frames, lens in focus at 4, 2x2 samples per pixel",
    ):
        assert part in text
    plan = json.loads(ran(capsys, render_shot, shot, tmp_path / "new", f"{EVERYTHING} --dry-run --json").out)
    wanted = {"model_colorspace": "sRGB", "colorspace": "ACEScg", "samples": 3, "supersample": 2, "deep_bins": 0}
    assert {name: plan[name] for name in wanted} == wanted
    assert plan["frames"][0]["window"] == [-3, -3, WIDTH, HEIGHT]
    assert plan["devices"][0]["strips"] == 1
    assert render_shot(shot, tmp_path / "new", "--deep --deep.bins 5 --dry-run") == 0
    assert "channels  rgb, alpha in 5 slices by depth" in capsys.readouterr().out
    assert not (tmp_path / "new").exists()


def test_headers_tell_the_truth_of_colours(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    """Red, green, blue and white as the standards have them (SMPTE ST 2065-1, S-2014-004, Rec.709)."""
    white, d65 = (0.32168, 0.33767), (0.3127, 0.3290)
    wanted = {
        "ACEScg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *white),
        "ACES2065-1": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *white),
        "lin_rec709": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *d65),
    }
    for space, values in wanted.items():
        assert render_shot(shot, tmp_path, f"--frames 2 --colorspace {space}") == 0
        kind, data = exr_attributes(tmp_path / "a.0002.exr")["chromaticities"]
        assert kind == "chromaticities"
        np.testing.assert_allclose(np.frombuffer(data, "<f4"), values, rtol=1e-6, err_msg=space)
    assert "warning" not in capsys.readouterr().err
    for flags, there in (("", True), ("--colorspace Rec.1886_Rec.709_-_Display", False)):
        words = [word.replace("_", " ") for word in f"--frames 2 {flags}".split()]
        assert main(["render", *shot, "-o", str(tmp_path / "a.####.png"), "--progress", "none", *words]) == 0
        chunks = png_chunks(tmp_path / "a.0002.png")
        assert [name in chunks for name in ("sRGB", "gAMA", "cHRM")] == [there] * 3


def test_matrices_in_the_header_are_those_of_openexr(shot: list[str], tmp_path: Path) -> None:
    """A point ahead of the camera by its definitions: z of the camera's space is along the view, y is up; in NDC (0, 0)
    is the upper left corner, (1, 1) the lower right one."""
    assert render_shot(shot, tmp_path, "--frames 1") == 0
    found = exr_attributes(tmp_path / "a.0001.exr")
    assert "worldToScreen" not in found
    to_camera, to_ndc = (np.frombuffer(found[name][1], "<f4").reshape(4, 4) for name in ("worldToCamera", "worldToNDC"))
    assert {found[name][0] for name in ("worldToCamera", "worldToNDC")} == {"m44f"}
    focal = 0.5 / np.tan(np.radians(30))  # of the width
    for right, down, ahead in ((0.0, 0.0, 2.0), (0.4, 0.3, 5.0)):
        point = np.array([-0.5 + right, down, -4 + ahead, 1])
        np.testing.assert_allclose(point @ to_camera, [right, -down, ahead, 1], atol=1e-6)
        x, y, _, w = point @ to_ndc
        wanted = 0.5 + focal * right / ahead, 0.5 + focal * down / ahead * WIDTH / HEIGHT
        np.testing.assert_allclose([x / w, y / w], wanted, atol=1e-6)


@pytest.mark.slow
@pytest.mark.needs("distributed")
def test_everything_on_a_farm(shot: list[str], tmp_path: Path) -> None:
    import distributed

    cases = [("all", EVERYTHING, "a.####.exr"), ("deep", "--deep --deep.bins 3", "a.####.exr")]
    cases += [] if video_missing() else [("video", "", "a.mp4")]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, host="127.0.0.1", protocol="tcp://"
    ) as cluster:
        for name, flags, pattern in cases:
            assert render_shot(shot, tmp_path / name / "here", flags, pattern) == 0
            address = f"--scheduler {cluster.scheduler_address}"
            assert render_shot(shot, tmp_path / name / "there", f"{flags} {address}", pattern) == 0
            assert contents(tmp_path / name / "there") == contents(tmp_path / name / "here") != {}, name


@pytest.mark.needs("av")
def test_calls_that_make_no_sense(shot: list[str], tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    cases = [
        ("--colorspace ACEScq", "a.#.exr", "--colorspace ACEScq: is not in the configuration"),
        ("--model-colorspace srbg", "a.#.exr", "--model-colorspace srbg: is not in the configuration"),
        ("--ocio-config none.ocio --colorspace ACEScg", "a.#.exr", "none.ocio: is not an OpenColorIO configuration"),
        ("--region 40,0,20,10", "a.#.exr", f"--region 40,0,20,10: ends at 60,10, beyond the frame's size {WIDTH}"),
        ("--region 0,0,8,8 --overscan 2", "a.#.exr", "--overscan and --region exclude each other"),
        ("--supersample 0", "a.#.exr", "--supersample 0: expected 1 to 64"),
        ("--shutter-open 0.1", "a.#.exr", "--shutter-open 0.1 --shutter-close None: expected two times"),
        ("--aperture 0.1", "a.#.exr", "--focus 0.0: expected the depth that is in focus"),
        ("--deep --supersample 2", "a.#.exr", "deep EXR: --supersample cannot filter deep samples"),
        ("--deep --channels rgb,depth", "a.#.exr", "--deep: deep EXR cannot hold depth besides its own depths"),
        ("--deep --parts several", "a.#.exr", "--deep and --parts several exclude each other"),
        ("--deep", "a.#.tif", "cannot hold deep samples, expected an .exr file"),
        ("--deep --background white", "a.#.exr", "--deep and --background exclude each other"),
        ("--deep.bins 8", "a.#.exr", "expected --deep with it"),
        ("--video.fps 25", "a.#.exr", "--video flags are for videos, expected the name of an .mp4 or .mov file"),
        ("--channels rgb,depth", "a.mp4", "an MP4 cannot hold depth"),
        ("--alpha", "a.mp4", "an MP4 cannot hold alpha"),
        ("--alpha", "a.#.jpg", "a JPG cannot hold alpha"),
        ("--video.prores 422", "a.mp4", "--video.prores 422: applies to ProRes only, expected a .mov"),
        ("--video.crf 5", "a.mov", "--video.crf 5: applies to H.264 only, expected an .mp4"),
        ("--alpha", "a.mov", "ProRes hq cannot hold alpha, expected --video.prores 4444"),
        ("--bits 8", "a.#.dpx", "--bits 8: is for PNG and TIFF, expected 10 or 16 for"),
        ("--bits 10", "a.#.png", "--bits 10: is for DPX, expected 8 or 16"),
        ("--alpha", "a.#.dpx", "DPX files of 10 bits are written without alpha, expected --bits 16"),
        ("--video.crf 99", "a.mp4", "--video.crf 99: expected 0 to 51"),
        ("--colorspace ACEScg", "a.#.png", "its colours would be ACEScg, which is linear, expected sRGB; write .exr"),
        ("--colorspace lin_rec709 --bits 16", "a.#.tif", "would be lin_rec709, which is linear, expected sRGB"),
        (
            "--model-colorspace ACEScg",
            "a.#.jpg",
            "would be ACEScg, which is linear, expected sRGB; write .exr, or give",
        ),
        ("--colorspace ACEScg", "a.mp4", "its colours would be ACEScg, which is linear, expected sRGB"),
        ("--colorspace ACEScct", "a.mp4", "its colours would be ACEScct, expected sRGB's primaries; write .exr, or"),
    ]
    for flags, pattern, message in cases:
        assert message in fails(capsys, render_shot, shot, tmp_path / "new", flags, pattern), flags
    monkeypatch.setitem(sys.modules, "av", None)
    assert render_shot(shot, tmp_path / "new", "", "a.mp4") == 2
    assert "a.mp4: video needs PyAV, which is not installed" in error_line(capsys)
    assert not (tmp_path / "new").exists()
