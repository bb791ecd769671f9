# SPDX-License-Identifier: Apache-2.0
"""`clsplat render` as a job, on a real device and a tiny model: files, gaps, plans, signals, troubles."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import stress_render_kills
from calls import Capture, error_line, fails, left_behind, ran
from needs import require
from pictures import write_pixels
from quick import quick
from rendered import camera_file, contents
from systems import posix
from tiny import HEIGHT, WIDTH, cameras, hidden_model

from clsplat.cli.main import main
from clsplat.device.selection import list_devices
from clsplat.gaussians import Gaussians
from clsplat.rendering.renderer import Renderer
from clsplat.shots import choose_shot
from clsplat.shots.motion import camera_after

COUNT = 6
ALL = "rgb,alpha,depth,normals,position,motion,backward,median,first,count,id"


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A model and a turntable of COUNT frames, as arguments of render."""
    folder = tmp_path_factory.mktemp("shot")
    hidden_model().save(folder / "model.ply")
    frames = []
    for camera in cameras():
        world = np.eye(4)
        world[:3, :3] = camera.rotation.T @ np.diag([1, -1, -1])
        world[:3, 3] = camera.position
        frames.append({"transform_matrix": world.tolist(), "file_path": f"{len(frames):02d}.png"})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 50.0, "fl_y": 50.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps({**lens, "camera_model": "PINHOLE", "frames": frames}))
    path = ["--path", "turntable", "--count", str(COUNT)]
    return [str(folder / "model.ply"), "--cameras", str(folder / "transforms.json"), *path]


def render(shot: list[str], folder: Path, *more: str, pattern: str = "a.####.exr") -> int:
    return main(["render", *shot, "-o", str(folder / pattern), *more])


def read(path: Path) -> tuple[dict[str, np.ndarray], list[Any]]:
    source = oiio.ImageInput.open(str(path))
    found, specs = {}, []
    while source.seek_subimage(len(specs), 0):
        spec = source.spec()
        pixels = source.read_image(len(specs), 0, 0, spec.nchannels, oiio.FLOAT)
        found.update({name: pixels[:, :, index] for index, name in enumerate(spec.channelnames)})
        specs.append(spec)
    return found, specs


def test_every_channel_is_that_of_the_renderer(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    records = json.loads(ran(capsys, render, shot, tmp_path, "--channels", ALL, "--frames", "2,6", "--json").out)
    assert [(record["frame"], record["skipped"]) for record in records] == [(2, False), (6, False)]
    whole = choose_shot(Path(shot[2]), path="turntable", count=COUNT)
    frames = whole.frames
    found, (spec,) = read(tmp_path / "a.0002.exr")
    assert list(spec.channelnames[:5]) == ["R", "G", "B", "A", "Z"]
    gaussians = Gaussians.load(shot[0])
    camera, others = frames[1].camera, {"after": frames[2].camera, "before": frames[0].camera}
    image, own = Renderer().render_channels(gaussians, camera, ("normal", "position", "motion", "backward"), **others)
    wanted = {
        "A": image.alpha,
        "Z": own["depth"],
        "median.Z": own["median"],
        "first.Z": own["first"],
        "count": own["count"],
    }
    wanted |= {"id": own["index"], "forward.u": own["motion"][:, :, 0], "forward.v": -own["motion"][:, :, 1]}
    wanted |= {"backward.u": own["backward"][:, :, 0], "backward.v": -own["backward"][:, :, 1]}
    for index in range(3):
        wanted["RGB"[index]] = image.image[:, :, index]
        wanted[f"N.{'xyz'[index]}"] = own["normal"][:, :, index]
        wanted[f"P.{'xyz'[index]}"] = own["position"][:, :, index]
    assert set(spec.channelnames) == set(wanted)
    for name, values in wanted.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    assert spec.getattribute("clsplat:frame") == 2
    assert len(spec.getattribute("clsplat:model")) == 64
    last, after = frames[-1].camera, camera_after(whole, COUNT - 1)
    motion = Renderer().render_channels(gaussians, last, ("motion",), after=after)[1]["motion"]
    found, _ = read(tmp_path / "a.0006.exr")
    np.testing.assert_array_equal(found["forward.u"], motion[:, :, 0])
    assert np.abs(found["forward.u"]).max() > 1


def test_up_in_a_file_is_up_in_the_picture(shot: list[str], tmp_path: Path) -> None:
    """The camera sinks, so what it sees rises, and v is positive."""
    path = camera_file(tmp_path / "keys.json", {1: 0, 2: [0, 0.5, -4]})  # y is down
    assert (
        main(["render", shot[0], "--cameras", str(path), "-o", f"{tmp_path}/##.exr", "--channels", "alpha,motion"]) == 0
    )
    for name in ("01", "02"):  # the second goes on as the first did
        found, _ = read(tmp_path / f"{name}.exr")
        seen = found["A"] > 0.5
        assert seen.any()
        assert (found["forward.v"][seen] > 1).all()
        np.testing.assert_allclose(found["forward.u"][seen], 0, atol=1e-3)


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("extension", "flags", "format_"),
    [
        ("exr", "--exr half", "half"),
        ("exr", "--channels rgb", "float"),
        ("png", "--bits 16 --alpha", "uint16"),
        ("tif", "--alpha", "uint8"),
        ("jpg", "--quality 60", "uint8"),
        ("dpx", "", "uint10"),
        ("dpx", "--bits 16 --alpha", "uint16"),
    ],
)
def test_formats(extension: str, flags: str, format_: str, shot: list[str], tmp_path: Path) -> None:
    assert render(shot, tmp_path, "--frames", "1", *flags.split(), pattern=f"a.{extension}") == 0
    _, (spec,) = read(tmp_path / f"a.{extension}")
    bits = spec.get_int_attribute("oiio:BitsPerSample")
    assert (f"uint{bits}" if extension == "dpx" else str(spec.format)) == format_
    assert spec.nchannels == (4 if "--alpha" in flags else 3)


def test_parts_and_compression(shot: list[str], tmp_path: Path) -> None:
    flags = "--channels id,depth,rgb,alpha --parts several --compression piz --frames 1"
    assert render(shot, tmp_path, *flags.split()) == 0
    _, specs = read(tmp_path / "a.0001.exr")
    assert [spec.getattribute("oiio:subimagename") for spec in specs] == ["rgba", "depth", "id"]
    assert {spec.getattribute("compression") for spec in specs} == {"piz"}


def test_gaps_alone_are_rendered(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    assert render(shot, tmp_path) == 0
    whole = contents(tmp_path)
    capsys.readouterr()
    (tmp_path / "a.0002.exr").unlink()
    (tmp_path / "a.0004.exr").write_bytes(whole["a.0004.exr"][:-50])
    left_behind(tmp_path / "a.0005.exr")
    kept = {name: (tmp_path / name).stat().st_mtime_ns for name in ("a.0001.exr", "a.0003.exr", "a.0005.exr")}
    assert "skipped   4: 1,3,5-6" in ran(capsys, render, shot, tmp_path, "--skip-existing", "--dry-run").out
    assert render(shot, tmp_path, "--skip-existing", "--progress", "json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {line["frame"]: line["skipped"] for line in lines} == {n: n not in (2, 4) for n in range(1, COUNT + 1)}
    assert [line["done"] for line in lines] == list(range(1, COUNT + 1))
    assert {line["total"] for line in lines} == {COUNT}
    assert set(lines[-1]) == {"frame", "name", "path", "seconds", "skipped", "done", "total"}
    assert contents(tmp_path) == whole
    assert kept == {name: (tmp_path / name).stat().st_mtime_ns for name in kept}
    assert render(shot, tmp_path, "--skip-existing", "--width", "24", "--progress", "openjd") == 0
    out = capsys.readouterr().out.splitlines()
    assert out[-2] == "openjd_progress: 100.0"
    assert "took" in out[-1]  # another size is not what is wanted


@pytest.mark.slow
def test_frames_made_otherwise_are_told_and_rendered_again(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    """By their cameras, precision or model; a frame that is broken is rendered without a word."""
    ran(capsys, render, shot, tmp_path)
    assert ran(capsys, render, shot, tmp_path, "--skip-existing").err == ""
    for change in (("--frames", "1-4", "--exr", "half"), ("--background", "white"), ("--rasterizer.alpha-min", "0.01")):
        assert render(shot, tmp_path, "--skip-existing", *change) == 0
        count = 4 if "half" in change else COUNT
        said = capsys.readouterr()
        assert f"warning: --skip-existing: {count} of the existing frames were rendered from another model" in said.err
        rendered = re.findall(
            r"  \d+\.\d\d s(?:  \d+:\d\d left)?$", said.out, re.MULTILINE
        )  # slow ones tell what is left
        assert len(rendered) == count
    hidden_model(30).save(tmp_path / "other.ply")
    assert render([str(tmp_path / "other.ply"), *shot[1:]], tmp_path, "--skip-existing", "--dry-run") == 0
    assert f"{COUNT} of the existing frames" in capsys.readouterr().err
    (tmp_path / "a.0003.exr").write_bytes(b"")
    assert ran(capsys, render, shot, tmp_path, "--skip-existing", "--rasterizer.alpha-min", "0.01").err == ""


@pytest.mark.slow
def test_two_jobs_started_together_write_each_frame_once(shot: list[str], tmp_path: Path) -> None:
    """At most two frames more, and both end well with all frames there."""
    count = 60
    words = [sys.executable, "-m", "clsplat", "render", *shot[:-1], str(count), "-o", str(tmp_path / "a.####.png")]
    jobs = [
        subprocess.Popen([*words, "--skip-existing", "--json"], stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    written = 0
    for job in jobs:
        records = json.loads(job.communicate(timeout=300)[0])
        assert job.returncode == 0 and len(records) == count
        written += sum(not record["skipped"] for record in records)
    assert count <= written <= count + 2
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a.{number:04d}.png" for number in range(1, count + 1)]


def test_progress_beside_json(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    captured = ran(capsys, render, shot, tmp_path, "--json", "--progress", "json", "--frames", "1-2", "--profile")
    records = json.loads(captured.out)
    lines = captured.err.splitlines()
    assert [json.loads(line)["done"] for line in lines[:2]] == [1, 2]
    assert "the device spent " in lines[2] and "% of the time on kernels" in lines[2]
    assert all(record["kernel_ms"] > 0 and record["transfer_ms"] > 0 for record in records)
    assert ran(capsys, render, shot, tmp_path, "--progress", "none") == ("", "")


def test_a_dry_run_writes_nothing(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "new"
    text = ran(capsys, render, shot, folder, "--dry-run", "--channels", "rgb,depth", "--width", "96").out
    for part in ("40 Gaussians, SHA-256 ", f"frames    {COUNT}: 1-{COUNT}; 96x80", "channels  rgb, depth"):
        assert part in text
    assert "of device memory needed" in text
    assert f"a.0001.exr to {folder / f'a.{COUNT:04d}.exr'}" in text
    plan = json.loads(ran(capsys, render, shot, folder, "--dry-run", "--json", "--max-device-mem", "400KiB").out)
    assert [frame["frame"] for frame in plan["frames"]] == list(range(1, COUNT + 1))
    assert {(frame["width"], frame["height"], frame["skipped"]) for frame in plan["frames"]} == {(WIDTH, HEIGHT, False)}
    assert (plan["gaussians"], plan["channels"]) == (40, ["rgb"])
    assert plan["devices"][0]["allowed"] == 400 * 1024
    assert 0 < plan["devices"][0]["needed"] < 400 * 1024
    assert plan["host_bytes"] > 0
    assert not folder.exists()


@pytest.mark.slow
def test_several_devices_share_the_frames(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    assert render(shot, tmp_path / "one") == 0
    assert render(shot, tmp_path / "all", "--device", "all") == 0
    assert contents(tmp_path / "one") == contents(tmp_path / "all")
    capsys.readouterr()
    assert "--device 0,0: names a device twice" in fails(capsys, render, shot, tmp_path / "twice", "--device", "0,0")
    if len(list_devices()) > 1:
        assert render(shot, tmp_path / "two", "--device", "0,1") == 0
        assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_calls_that_make_no_sense(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").write_bytes(b"")
    cases = [
        ("--channels rgb,colour", "--channels rgb,colour: has 'colour', expected some of rgb, alpha"),
        ("--channels alpha --background white", "--channels alpha and --background exclude each other"),
        ("--frames 3-", "--frames 3-: '3-' is not a frame or a range"),
        ("--frames 100-200", "--frames 100-200: holds none of the frames to render"),
        ("--quality 0", "--quality 0: expected 1 to 100"),
        ("--workers 0", "--workers 0: expected at least 1"),
        ("--workers 2 --scheduler tcp://a:1", "--workers and --scheduler exclude each other"),
        ("--workers 2 --device all", "--device all and --workers exclude each other"),
        ("--scheduler tcp://a:1 --device 0,1", "--device 0,1 and --scheduler exclude each other"),
        ("--device 0,abacus", "--device abacus: no such device"),
        (
            f"-o {tmp_path}/new/a.exr",
            "names a single file for 6 frames, expected {name} or a frame number such as ####",
        ),
        (f"-o {tmp_path}/new/#.png --channels rgb,depth", "a PNG cannot hold depth; write .exr"),
        (f"-o {tmp_path}/file/#.png", "file: is a file, expected a folder"),
    ]
    for flags, message in cases:
        assert message in fails(capsys, render, shot, tmp_path / "new", *flags.split()), flags
    assert not (tmp_path / "new").exists()


def start(shot: list[str], folder: Path, *more: str) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "clsplat", "render", *shot, "-o", str(folder / "a.####.exr"), *more]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@posix
@pytest.mark.parametrize("number", quick([signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", 1)], signal.SIGINT))
def test_interrupted(number: int, shot: list[str], tmp_path: Path) -> None:
    process = start(shot, tmp_path, "--count", "3000", "--progress", "json")
    for _ in range(3):
        process.stdout.readline()
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert err.startswith("clsplat: interrupted after ")
    assert err.endswith(" of 3000 frames; go on with --skip-existing\n")
    assert err.count("\n") == 1
    names = [path.name for path in tmp_path.iterdir()]
    assert 3 <= len(names) < 3000
    assert all(name.startswith("a.") for name in names)


@pytest.mark.slow
def test_a_reader_that_has_gone(shot: list[str], tmp_path: Path) -> None:
    process = start(shot, tmp_path, "--count", "3000", "--progress", "json")
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=60) == 1


def test_a_full_disk_ends_the_job(shot: list[str], tmp_path: Path, capsys: Capture, monkeypatch: Any) -> None:
    from clsplat import errors

    def full(path: Path, *_: Any) -> None:
        if "0003" in str(path):
            raise errors.ClsplatError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr("clsplat.images.frame_files.write_spec", full)
    assert render(shot, tmp_path, "--progress", "none") == 1
    assert "a.0003.exr: cannot be written: No space left on device" in error_line(capsys)


@pytest.mark.slow
def test_killed_at_random(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    more = ["--count", "40", "--channels", "rgb,alpha,depth,normals", "--exr", "half", "--width", "240"]
    assert stress_render_kills.main(["-o", str(tmp_path), "--kills", "3", "--", *shot, *more]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["frames"], found["same"], found["damaged"]) == (40, True, [])
    assert found["frames_after_each_kill"] == sorted(found["frames_after_each_kill"])
    assert found["frames_after_each_kill"][0] < 40
    with pytest.raises(SystemExit):
        stress_render_kills.main(["-o", str(tmp_path), "--", *shot])


@pytest.mark.slow
def test_the_kill_test_finds_damage(shot: list[str], tmp_path: Path, monkeypatch: Any, capsys: Capture) -> None:
    def spoil(line: object, folder: Path, *_: object) -> int:
        folder.mkdir(exist_ok=True)
        (folder / "frame.0001.exr").write_bytes(b"half a frame")
        return 1

    monkeypatch.setattr(stress_render_kills, "kill", spoil)
    assert stress_render_kills.main(["-o", str(tmp_path), "--kills", "1", "--", *shot]) == 1
    assert json.loads(capsys.readouterr().out)["damaged"] == ["frame.0001.exr"]


def save_away(folder: Path) -> str:
    """The path of a model that no camera sees."""
    away = hidden_model(5)
    away.means += np.float32(1000)
    away.save(folder / "away.ply")
    return str(folder / "away.ply")


def test_frames_that_show_nothing(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    call = [save_away(tmp_path), *shot[1:]]
    for channels in ("rgb", "rgb,alpha"):
        captured = ran(capsys, render, call, tmp_path, "--json", "--channels", channels, "--overwrite")
        assert [record["blank"] for record in json.loads(captured.out)] == [True] * COUNT
        said = "6 of 6 frames show nothing of the model: 1, 2, 3 and 3 more; are the cameras in the model's world?"
        assert captured.err.splitlines() == [f"clsplat: warning: {said}"]
    captured = ran(capsys, render, shot, tmp_path, "--json", "--frames", "2")
    assert json.loads(captured.out)[0]["blank"] is False
    assert captured.err == ""


@pytest.mark.parametrize(
    "flags",
    quick(
        ["--width 960 --max-device-mem 4MiB", "--deep", "--deep --width 960"],
        "--width 960 --max-device-mem 4MiB",
        "--deep",
    ),
)
def test_frames_in_strips_and_deep_ones_that_show_nothing(
    flags: str, shot: list[str], tmp_path: Path, capsys: Capture
) -> None:
    more = ["--json", "--frames", "2", "--overwrite", *flags.split()]
    for model, blank in ((save_away(tmp_path), True), (shot[0], False)):
        captured = ran(capsys, render, [model, *shot[1:]], tmp_path, *more)
        assert json.loads(captured.out)[0]["blank"] is blank
        assert ("1 of 1 frames show nothing of the model: 2; are the cameras" in captured.err) is blank


@pytest.mark.parametrize("extension", quick(["png", "jpg", "tif", "exr", "dpx"], "exr", "png"))
def test_pictures_of_others_are_left(extension: str, shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    pattern, photo = f"a.####.{extension}", tmp_path / f"a.0002.{extension}"
    pixels = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    write_pixels(photo, pixels, "uint8" if extension != "exr" else "half")
    before = photo.read_bytes()
    assert render(shot, tmp_path, pattern=pattern) == 2
    assert f"{photo}: exist, and clsplat did not make them; name other files, or give --over" in error_line(capsys)
    assert list(tmp_path.iterdir()) == [photo]
    assert photo.read_bytes() == before
    assert render(shot, tmp_path, "--overwrite", pattern=pattern) == 0
    assert photo.read_bytes() != before
    assert render(shot, tmp_path, pattern=pattern) == 0, "frames of its own are replaced"


def test_flags_that_the_files_have_no_use_for(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    flags = ("--frames", "1", "--exr", "half", "--compression", "piz", "--quality", "50")
    said = ran(capsys, render, shot, tmp_path, *flags, pattern="a.####.png").err
    assert "warning: flags without effect on .png files: --exr, --compression, --quality\n" in said
    assert render(shot, tmp_path, "--frames", "1", "--channels", "depth", "--background", "white", "--bits", "16") == 0
    said = capsys.readouterr().err
    assert "warning: flags without effect on .exr files of these channels: --bits, --background\n" in said


@pytest.mark.slow
def test_a_frame_with_a_hole_is_not_whole(shot: list[str], tmp_path: Path) -> None:
    """Blocks that a machine did not write before it stopped: the last row is there, those in the middle are not."""
    large = ("--width", "400", "--frames", "1", "--exr", "float")
    assert render(shot, tmp_path, *large) == 0
    path = tmp_path / "a.0001.exr"
    whole = path.read_bytes()
    middle = len(whole) // 2
    assert len(whole) > 30_000
    path.write_bytes(whole[:middle] + bytes(8192) + whole[middle + 8192 :])
    assert render(shot, tmp_path, *large, "--skip-existing") == 0
    assert path.read_bytes() == whole


def test_a_video_that_is_too_large(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    require("av")
    assert render(shot, tmp_path, "--width", "17000", "--height", "16", pattern="a.mp4") == 2
    assert "a.mp4: its frames are 17000x16, expected at most 16,384 pixels a side and 260" in error_line(capsys)
    assert not list(tmp_path.iterdir())
