# SPDX-License-Identifier: Apache-2.0
"""A sequence as a job: which frames, what is skipped, the loop and its troubles. No OpenCL."""

from __future__ import annotations

import os
import pickle
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import left_behind, only, refuses
from rendered import contents
from scenes import tilted_camera

from clsplat.camera import Camera
from clsplat.config.channels import FRAME_CHANNELS
from clsplat.config.pictures import ColourConfig, Encoding, PictureConfig, SamplingConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.files.atomic import temporary_name
from clsplat.frame.draw import Planes
from clsplat.sequence import finished_frames, workers
from clsplat.sequence import task as sequence_task
from clsplat.sequence.finished_frames import is_complete
from clsplat.sequence.frame_renderer import FrameRenderer, RenderedFrame
from clsplat.sequence.shot_tasks import make_tasks
from clsplat.sequence.task import Record, RenderOptions, Task, settings_digest
from clsplat.sequence.workers import encode_frame, run_tasks
from clsplat.shots.motion import camera_after, camera_before, stretches
from clsplat.shots.shot import Frame, Shot, numbered

EVERYTHING = tuple(FRAME_CHANNELS)
OPTIONS = RenderOptions(("rgb", "alpha", "depth"), attributes={"clsplat:model": "abc", "Software": "clsplat"})


def turned(angle: float) -> Camera:
    """On a circle about the origin, looking at it."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    return Camera(40, 30, 35.0, 35.0, 20.0, 15.0, rotation, np.array([0.1, 0.2, 4.0]))


def circle(count: int, first: int = 1) -> Shot:
    return Shot(numbered([turned(0.1 * index) for index in range(count)], first))


def tasks_in(folder: Path, count: int = 6, channels: tuple[str, ...] = OPTIONS.channels) -> list[Task]:
    shot = circle(count)
    return make_tasks(shot, shot, str(folder / "a.####.exr"), lambda camera: camera, channels)


def planes_of(task: Task, channels: tuple[str, ...] = OPTIONS.channels) -> Planes:
    rng = np.random.default_rng(task.number)
    size = (task.camera.height, task.camera.width)
    return {name: rng.uniform(0, 1, (*size, len(FRAME_CHANNELS[name].names))).astype(np.float32) for name in channels}


def rendered(task: Task) -> RenderedFrame:
    return RenderedFrame(planes_of(task), 0.5)


def assert_same_pose(a: Camera, b: Camera) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, atol=1e-12)
    np.testing.assert_allclose(a.translation, b.translation, atol=1e-12)


def test_motion_goes_to_the_next_frame_number() -> None:
    shot = circle(5)
    for index in range(4):
        assert camera_after(shot, index) is shot.frames[index + 1].camera
    assert_same_pose(camera_after(shot, 4), turned(0.5))  # a turntable turns on
    alone = Shot(shot.frames[2:3])
    assert camera_after(alone, 0) is shot.frames[2].camera
    gappy = Shot((shot.frames[0], shot.frames[2], shot.frames[4]))
    assert_same_pose(camera_after(gappy, 0), gappy.at(2))
    before, last = gappy.at(4), shot.frames[4].camera
    further = camera_after(gappy, 2)
    np.testing.assert_allclose(further.rotation @ last.rotation.T, last.rotation @ before.rotation.T, atol=1e-12)


def test_backward_motion_goes_to_the_frame_number_before() -> None:
    shot = circle(5)
    for index in range(1, 5):
        assert camera_before(shot, index) is shot.frames[index - 1].camera
    assert_same_pose(camera_before(shot, 0), turned(-0.1))  # a turntable turned before
    alone = Shot(shot.frames[2:3])
    assert camera_before(alone, 0) is shot.frames[2].camera
    gappy = Shot((shot.frames[0], shot.frames[2], shot.frames[4]))
    assert_same_pose(camera_before(gappy, 1), gappy.at(2))
    (task,) = make_tasks(shot.only("1"), shot, "{frame}.exr", lambda camera: camera, ("rgb", "backward"))
    assert task.earlier is not None
    assert task.after is None
    assert_same_pose(task.earlier, turned(-0.1))
    # of a shutter that is open after the frame: from its middle to the middle before
    late = SamplingConfig(shutter_open=0.0, shutter_close=0.5)
    (task,) = make_tasks(shot.only("1"), shot, "{frame}.exr", lambda camera: camera, ("rgb", "backward"), late)
    before = sequence_task.camera_before(task, PictureConfig(sampling=late))
    # a circle's cameras between frames are interpolated: within a thousandth of a frame's way
    np.testing.assert_allclose(before.rotation, turned(-0.075).rotation, atol=1e-4)


def test_tasks_know_the_whole_shot(tmp_path: Path) -> None:
    whole = circle(5)
    pattern = str(tmp_path / "{frame}.exr")

    def half(camera: Camera) -> Camera:
        return camera.resized(20, 15)

    (task,) = make_tasks(whole.only("3"), whole, pattern, half, ("rgb", "motion"))
    assert (task.number, task.path, task.camera.width) == (3, tmp_path / "3.exr", 20)
    assert (task.after.width, task.after.fx) == (20, 17.5)
    assert_same_pose(task.after, turned(0.3))
    assert only(make_tasks(whole.only("3"), whole, pattern, half, ("rgb",))).after is None
    panorama = replace(turned(0), projection="equirectangular")
    mixed = Shot((*whole.frames, Frame(6, panorama, "0006")))
    with pytest.raises(InputError, match="--channels motion: frame 6 is equirectangular"):
        make_tasks(mixed.only("1-5"), mixed, pattern, half, ("motion",))


def test_a_stretch_is_the_shot_there() -> None:
    rng = np.random.default_rng(1)
    frames = [replace(camera, fx=camera.fx + rng.uniform(0, 5)) for camera in circle(12).cameras]
    shot = Shot(numbered(frames))
    of = stretches(shot, lambda camera: camera, -0.25, 0.75)
    for number in (4, 7):
        stretch = of(number)
        assert stretch is not None and len(stretch.frames) < 8  # and not all of the shot goes to a worker
        sent = pickle.loads(pickle.dumps(stretch))
        for time_ in (-0.25, 0.0, 0.1, 0.75):
            wanted, got = shot.at(number + time_), sent.at(time_)
            assert_same_pose(got, wanted)
            np.testing.assert_allclose(got.fx, wanted.fx, rtol=1e-12)
        assert stretch.at(0) is frames[number - 1]
    even = circle(12)
    of = stretches(even, lambda camera: camera, -2.5, 2.5)
    for number, angle in ((1, -0.15), (12, 1.25)):  # before its first and after its last frame it goes on
        stretch = of(number)
        time_ = -1.5 if number == 1 else 1.5
        np.testing.assert_allclose(stretch.at(time_).rotation, turned(angle).rotation, atol=1e-6)
    assert stretches(Shot(even.frames[:1]), lambda camera: camera, -1, 1)(1) is None
    mixed = Shot(numbered([turned(0), turned(0.1).resized(80, 60)]))
    with pytest.raises(InputError, match="motion blur: frame 1 is 40x30 perspective and frame 2 80x60"):
        stretches(mixed, lambda camera: camera, -1, 1)


class FakeRenderer:
    """Gives every channel a constant of its own."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.device = SimpleNamespace(budget=1 << 30, max_allocation=1 << 30, profile=False)

    def render(self, _: object, camera: Camera, background: object, **how: Any) -> Any:
        self.asked.append((background, how))
        size = (camera.height, camera.width)
        return type("Result", (), {"image": np.full((*size, 3), 0.25), "alpha": np.full(size, 0.5)})

    def render_channels(self, gaussians: object, camera: Camera, wanted: Any, **how: Any) -> Any:
        self.asked.append((wanted, how))
        size = (camera.height, camera.width)
        planes = {
            name: np.full(size, value) for value, name in enumerate(("depth", "median", "first", "count", "index"))
        }
        fields = {"normal": np.full((*size, 3), 7.0), "position": np.full((*size, 3), 8.0)}
        fields["motion"] = np.broadcast_to(np.float32([2, 3]), (*size, 2))
        fields["backward"] = np.broadcast_to(np.float32([4, 5]), (*size, 2))
        planes |= {name: fields[name] for name in wanted if name in fields}
        return self.render(gaussians, camera, None), planes


def shade(renderer: Any, task: Task, options: RenderOptions) -> Planes:
    made = FrameRenderer(renderer, None, options)(task).planes  # type: ignore[arg-type]
    assert made is not None
    return made


def test_shade_takes_each_channel_from_its_place(tmp_path: Path) -> None:
    renderer: Any = FakeRenderer()
    (task,) = tasks_in(tmp_path, 1, EVERYTHING)
    made = shade(renderer, task, RenderOptions(EVERYTHING))
    assert tuple(made) == EVERYTHING
    ones = {"rgb": 0.25, "alpha": 0.5, "depth": 0, "median": 1, "first": 2, "count": 3, "id": 4}
    for name, value in {**ones, "normals": 7, "position": 8}.items():
        assert (made[name] == value).all(), name
    assert (made["motion"] == [2, -3]).all()  # y is down in docs/channels.md, v is up in a file
    assert (made["backward"] == [4, -5]).all()
    wanted, how = renderer.asked[0]
    assert set(wanted) == {"depth", "normal", "position", "motion", "backward"}
    assert how["before"].translation is task.earlier.translation
    assert (how["after"].width, how["after"].translation is task.after.translation) == (task.after.width, True)
    renderer.asked.clear()
    plain = shade(renderer, task, RenderOptions(("alpha",), (1, 0, 0)))
    assert list(plain) == ["alpha"]
    assert [background for background, _ in renderer.asked] == [(1, 0, 0)]
    shade(renderer, task, RenderOptions(("first",)))
    assert renderer.asked[1][0] == ()


def test_the_loop_writes_every_frame_once(tmp_path: Path) -> None:
    tasks, done = tasks_in(tmp_path, 20), []
    threads = set()

    def noting(task: Task) -> RenderedFrame:
        threads.add(threading.current_thread())
        time.sleep(0.005)
        return rendered(task)

    def on_done(record: Record) -> None:
        assert Path(record.path).is_file()
        done.append(record)

    run_tasks(tasks, [noting, noting, noting], OPTIONS, on_done)
    assert sorted(record.frame for record in done) == list(range(1, 21))
    assert len(threads) == 3
    assert all(record.seconds > 0.5 and not record.skipped for record in done)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a.{index:04d}.exr" for index in range(1, 21)]
    alone = tmp_path / "alone"
    alone.mkdir()
    run_tasks(tasks_in(alone, 20), [rendered], OPTIONS, lambda record: None)
    assert contents(alone) == contents(tmp_path)
    source = oiio.ImageInput.open(done[0].path)
    assert source.spec().getattribute("clsplat:frame") == done[0].frame
    assert source.spec().getattribute("clsplat:model") == "abc"
    assert source.spec().getattribute("worldToNDC") is not None


def test_frames_that_wait_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = tasks_in(tmp_path, 40)
    writers, held = workers.frames_ahead(tasks, OPTIONS, 1)
    assert held <= writers + 2
    waiting, most, lock = 0, 0, threading.Lock()

    def counting(task: Task) -> RenderedFrame:
        nonlocal waiting, most
        with lock:
            waiting += 1
            most = max(most, waiting)
        return rendered(task)

    def slow(task: Task, *rest: Any) -> Any:
        nonlocal waiting
        time.sleep(0.01)
        record = encode_frame(task, *rest)
        with lock:
            waiting -= 1
        return record

    monkeypatch.setattr(workers, "encode_frame", slow)
    run_tasks(tasks, [counting], OPTIONS, lambda record: None)
    assert 1 < most <= held
    huge = [replace(task, camera=replace(task.camera, width=40_000, height=20_000)) for task in tasks]
    assert workers.frames_ahead(huge, OPTIONS, 1) == (2, 3)


@pytest.mark.parametrize("where", ["render", "write", "report"])
def test_trouble_ends_the_job(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks, shaded = tasks_in(tmp_path, 30), []
    error = ClsplatError("disk full")

    def failing(task: Task) -> RenderedFrame:
        shaded.append(task.number)
        if where == "render" and task.number == 5:
            raise error
        return rendered(task)

    def broken(task: Task, *rest: Any) -> Any:
        if where == "write" and task.number == 5:
            raise error
        return encode_frame(task, *rest)

    def on_done(record: Record) -> None:
        if where == "report":
            raise KeyboardInterrupt

    monkeypatch.setattr(workers, "encode_frame", broken)
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt if where == "report" else ClsplatError):
        run_tasks(tasks, [failing], OPTIONS, on_done)
    assert threading.active_count() == before
    assert len(shaded) < 30
    assert all(is_complete(task, OPTIONS) for task in tasks if task.path.exists())
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".exr"]


def written(tmp_path: Path, extension: str, options: RenderOptions) -> Task:
    (task,) = tasks_in(tmp_path, 1)
    task = replace(task, path=tmp_path / f"a.{extension}")
    encode_frame(task, RenderedFrame(planes_of(task, options.channels), 0.0), options)
    return task


@pytest.mark.parametrize("extension", ["exr", "png", "tif", "jpg", "dpx"])
@pytest.mark.parametrize("parts", ["one", "several"])
def test_a_file_is_complete_or_not(extension: str, parts: Any, tmp_path: Path, capfd: Any) -> None:
    channels: tuple[str, ...] = ("rgb", "alpha", "depth", "id") if extension == "exr" else ("rgb", "alpha")
    channels = ("rgb",) if extension == "jpg" else channels
    encoding = Encoding(parts=parts, bits=16 if extension == "dpx" else 8)
    options = RenderOptions(channels, encoding=encoding, attributes={"clsplat:model": "abc"})
    task = written(tmp_path, extension, options)
    assert is_complete(task, options)
    assert not is_complete(replace(task, path=tmp_path / f"b.{extension}"), options)
    assert not is_complete(replace(task, camera=tilted_camera(41, 30)), options)
    assert not is_complete(task, replace(options, channels=("rgb",) if len(channels) > 1 else ("rgb", "alpha")))
    assert not is_complete(task, replace(options, attributes={"clsplat:model": "abd"}))
    assert not is_complete(task, replace(options, background=(0.0, 0.0, 0.5)))
    if extension == "exr":
        other = Encoding(parts="several" if parts == "one" else "one")
        assert not is_complete(task, replace(options, encoding=other))
    whole = task.path.read_bytes()
    for size in (0, 1, len(whole) // 3, len(whole) - 40):
        task.path.write_bytes(whole[:size])
        assert not is_complete(task, options), size
    task.path.write_bytes(os.urandom(500))
    assert not is_complete(task, options)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_stale_temporaries_of_the_shot_alone_go(tmp_path: Path) -> None:
    tasks = tasks_in(tmp_path, 3)
    mine = temporary_name(tmp_path / "a.0002.exr").name  # somebody still writes it
    elsewhere, old = (f".a.0002.exr.{token * 5}.clsplat-tmp" for token in ("0123", "fedc"))  # of other machines
    others = [mine, elsewhere, ".a.0002.exr.clsplat-tmp", "a.0002.exr", ".a.0002.exr.swp"]
    for name in [*others, old]:
        (tmp_path / name).write_bytes(b"x")
    os.utime(tmp_path / old, (0, 0))
    left_behind(tmp_path / "a.0002.exr")
    left_behind(tmp_path / "a.0003.exr")
    others.append(left_behind(tmp_path / "a.0004.exr"))
    finished_frames.remove_temporaries(tasks)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)
    finished_frames.remove_temporaries(tasks_in(tmp_path / "none", 3))


def test_folders_are_looked_at_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "a.0002.exr").mkdir()
    refuses(r"file: is a file, expected a folder", finished_frames.check_folders, tasks_in(tmp_path / "file" / "shot"))
    with pytest.raises(InputError, match=r"a\.0002\.exr: is a folder, expected the name of a file"):
        finished_frames.check_folders(tasks_in(tmp_path))
    finished_frames.check_folders(tasks_in(tmp_path / "new" / "shot"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write anywhere
    refuses("is not writable", finished_frames.check_folders, tasks_in(tmp_path / "new" / "shot"))
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: (_ for _ in ()).throw(OSError(30, "Read-only file system")))
    tasks = tasks_in(tmp_path / "new" / "shot")
    refuses("cannot be created: the disk is read-only", finished_frames.make_folders, tasks)


def test_the_digest_goes_by_what_a_colour_configuration_says(tmp_path: Path) -> None:
    here, there = tmp_path / "a.ocio", tmp_path / "b.ocio"
    here.write_text("one")
    there.write_text("one")

    def found(path: Path) -> str:
        pictures = PictureConfig(ColourConfig(ocio_config=str(path)))
        return settings_digest(tasks_in(tmp_path)[0], replace(OPTIONS, pictures=pictures))

    before = found(here)
    assert found(there) == before
    there.write_text("two")
    assert found(there) != before


@pytest.mark.parametrize(
    "paths",
    [
        "search_path: luts:other",
        "search_path: [other, luts]",
        "search_path:\n  - other\n  - luts",
        'search_path: "$LUTS"',
    ],
)
@pytest.mark.parametrize(
    "named",
    ["{src: film.cube}", '{src: "film.cube", interpolation: linear}', "\n    src: film.cube", "{src: $LOOK.cube}"],
)
def test_the_digest_goes_by_the_tables_that_a_colour_configuration_names(
    paths: str, named: str, tmp_path: Path
) -> None:
    folder = tmp_path / "show [1]" / "luts"
    folder.mkdir(parents=True)
    config, table, other = folder.parent / "a.ocio", folder / "film.cube", folder / "film.txt"
    config.write_text(f"ocio_profile_version: 2\n{paths}\nlooks:\n  - transform: !<FileTransform> {named}\n")

    def found() -> str:
        pictures = PictureConfig(ColourConfig(ocio_config=str(config)))
        return settings_digest(tasks_in(tmp_path)[0], replace(OPTIONS, pictures=pictures))

    digests = [found()]
    for content in ("one", "two"):
        table.write_text(content)
        os.utime(table, ns=(len(digests), len(digests)))  # clocks of file systems may be slow
        digests.append(found())
    assert len(set(digests)) == 3
    other.write_text("nobody names it")
    assert found() == digests[-1]
