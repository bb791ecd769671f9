# SPDX-License-Identifier: Apache-2.0
"""Videos in place of photographs, and beside them, in structure from motion and in scenes."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, raising, refuses, warnings_of
from needs import require
from pictures import write_pixels
from tiny import write_scene
from walk_videos import sliding, walk, write_walk

from clsplat.capture.folder import CaptureFolder
from clsplat.cli.main import main
from clsplat.config.masks import MaskUse
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.runs.run import Run
from clsplat.scenes import loading
from clsplat.scenes.folder_layouts import detect
from clsplat.scenes.sfm import reconstruct as sfm
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE
from clsplat.scenes.sfm.video_frames import find_videos, frames_folder, reconstruction_folder
from clsplat.scenes.video.frames import frame_sequences, take_frames

require("av")

COUNT = 24
FRAMES = sliding(COUNT, 96, 72)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("videos") / "walk.mp4", FRAMES)


@pytest.fixture
def tasks(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Tasks that the worker would have been given; every photograph gets a pose."""
    given: list[dict[str, Any]] = []

    def run(task: dict[str, Any], work: Path, _: object) -> dict[str, Any]:
        given.append(task)
        names = sorted(name for group in task["groups"] for name in group)
        for name in names:
            assert (Path(task["photos"]) / name).is_file()
        shutil.copytree(task["photos"], work / "result" / "images")
        (work / "result" / "sparse" / "0").mkdir(parents=True)
        (work / "result" / "sparse" / "0" / "images.bin").write_bytes(b"")
        return {"result": {"registered": names, "fragments": []}}

    monkeypatch.setattr(sfm, "run_worker", run)
    monkeypatch.setattr(sfm, "turn_new", lambda *_: None)
    return given


def names_of(task: dict[str, Any]) -> list[str]:
    return sorted(name for group in task["groups"] for name in group)


def test_a_video_alone(video: Path, tmp_path: Path, tasks: list[dict[str, Any]]) -> None:
    heard: list[str] = []
    sfm.reconstruct(video, tmp_path / "scene", frames=6, progress=lambda text, _: heard.append(text))
    (task,) = tasks
    assert task["groups"] == task["sequences"] and len(task["groups"]) == 1
    assert all(name.startswith("walk.mp4/") for name in names_of(task)) and 4 <= len(names_of(task)) <= 6
    told = [text for text in heard if " frames chosen" in text and "from 0:02 of 96x72 SDR" in text]
    assert len(told) == 1 and told[0].startswith(f"walk.mp4: {len(names_of(task))} of {COUNT} frames")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene", "scene_frames"]
    assert json.loads((tmp_path / "scene/sfm.json").read_text())["photos"] == len(names_of(task))

    # the same again, also after the frames were removed: they have the same table
    sfm.reconstruct(video, tmp_path / "scene", frames=6)
    shutil.rmtree(tmp_path / "scene_frames")
    sfm.reconstruct(video, tmp_path / "scene", frames=6)
    assert len(tasks) == 1
    refuses("scene_frames: has frames of other videos", sfm.reconstruct, video, tmp_path / "scene", frames=5)
    sfm.reconstruct(video, tmp_path / "scene", frames=5, overwrite=True)
    assert len(tasks) == 2


def test_folders_that_clsplat_made_are_left_out(video: Path, tmp_path: Path, tasks: list[dict[str, Any]]) -> None:
    """NAME_frames and NAME_colmap beside the videos of a folder, which are known by their records, not their names."""
    folder = tmp_path / "shots"
    folder.mkdir()
    one = Path(shutil.copy(video, folder / "one.mp4"))
    sfm.reconstruct(one, folder / "one_colmap", frames=6)
    two = Path(shutil.copy(video, folder / "two.mp4"))
    (folder / "one_colmap").rename(folder / "scene")
    kept = folder / "kept_frames" / "7.png"  # has a table and a record of other programs
    write_pixels(kept, np.rint(255 * FRAMES[7]).astype(np.uint8))
    (kept.parent / "frames.json").write_text('{"frames": []}')
    (kept.parent / SFM_RECORD_FILE).write_text("[]")
    messages = warnings_of(lambda: sfm.reconstruct(folder, tmp_path / "all", frames=4))
    assert {name.rpartition("/")[0] for name in names_of(tasks[-1])} == {"kept_frames", "one.mp4", "two.mp4"}
    told = (
        "shots: 2 folder(s) (one_frames, scene) left out: made by clsplat from a video or photos; to use such pictures"
    )
    assert len([text for text in messages if told in text]) == 1
    # each of them can be given itself
    sfm.reconstruct(folder / "one_frames", tmp_path / "frames")
    assert len(names_of(tasks[-1])) == len(names_of(tasks[0]))
    one.unlink()
    two.unlink()
    kept.unlink()
    refuses(
        "shots: no photos found, only in one_frames, scene, made by clsplat",
        sfm.reconstruct,
        folder,
        tmp_path / "x",
    )


def test_runs_and_captures_among_photographs_are_left_out(
    video: Path, tmp_path: Path, tasks: list[dict[str, Any]]
) -> None:
    """The renders that a training writes to its run among the photographs leave the result of the photographs valid."""
    folder = tmp_path / "shots"
    for index in range(0, COUNT, 4):
        write_pixels(folder / f"{index}.png", np.rint(255 * FRAMES[index]).astype(np.uint8))
    scene = tmp_path / "scene"
    sfm.reconstruct(folder, scene)
    Run.create(folder / "run", TrainConfig())
    (folder / "shot").mkdir()
    CaptureFolder(folder / "shot").claim({"input": [str(video)]}, "capture")
    for place in ("run/test", "shot/turntable", "kept"):
        write_pixels(folder / place / "view.png", np.rint(255 * FRAMES[1]).astype(np.uint8))
    (folder / "kept/config.toml").write_text("[another]\nprogram = 1\n")
    refuses("other photos than those now in .*, or replace it with clsplat sfm --overw", sfm.reconstruct, folder, scene)
    shutil.rmtree(folder / "kept")
    sfm.reconstruct(folder, scene)
    assert len(tasks) == 1


def test_an_output_that_must_not_be_replaced_is_refused_before_videos_are_decoded(video: Path, tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").touch()
    (tmp_path / "file").touch()
    for name, told in (("notes", "neither empty nor a result of sfm"), ("file", "a file, expected a folder")):
        refuses(f"{name}: is {told}", sfm.reconstruct, video, tmp_path / name, frames=6)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "notes"]  # no frames


def test_too_few_frames_say_where_they_are(video: Path, tmp_path: Path, tasks: list[dict[str, Any]]) -> None:
    """Frames that were taken with a small --frames are used again without it, so that the message says how to go on."""
    refuses("only 2 photo", sfm.reconstruct, video, tmp_path / "scene", frames=2)
    told = r"2 photo\(s\) found, 2 of them from .*at least 3; remove the frames in .*scene_frames, and give a larger"
    refuses(told, sfm.reconstruct, video, tmp_path / "scene")
    shutil.rmtree(tmp_path / "scene_frames")
    sfm.reconstruct(video, tmp_path / "scene")
    assert len(tasks) == 1
    told = "at least 3; give a larger"  # the earlier frames stay
    refuses(told, sfm.reconstruct, video, tmp_path / "scene", frames=2, overwrite=True)
    assert len(list((tmp_path / "scene_frames").rglob("*.jpg"))) > 2


def test_masks_of_frames(video: Path, tmp_path: Path, tasks: list[dict[str, Any]]) -> None:
    """Masks are found beside the frames whether the video, the folder of its frames, or the video's folder is given."""
    scene, frames = tmp_path / "scene", tmp_path / "scene_frames"
    sfm.reconstruct(video, scene, frames=6)
    use = MaskUse("ignore")
    told = (
        r"walk\.mp4: has no masks, expected masks/walk\.mp4/\d+\.jpg\.png in .*scene_frames, its folder of frames, or"
    )
    refuses(told, sfm.reconstruct, video, scene, masks=use, overwrite=True)
    masked = names_of(tasks[0])[1:]
    for name in masked:
        write_pixels(frames / "masks" / f"{name}.png", np.full((72, 96, 3), 255, np.uint8))
    sfm.reconstruct(frames, tmp_path / "other", masks=use)
    sfm.reconstruct(video, scene, masks=use, overwrite=True)
    assert [sorted(task["masks"]) for task in tasks[1:]] == [masked, masked]
    refuses("scene_frames: has pictures beside its frames", sfm.reconstruct, video, scene, frames=5, overwrite=True)

    folder = tmp_path / "shot"
    folder.mkdir()
    shutil.copy(video, folder / "walk.mp4")
    for index in (10, 14, 18):
        write_pixels(folder / f"{index}.png", np.rint(255 * FRAMES[index]).astype(np.uint8))
    sfm.reconstruct(folder, tmp_path / "mixed", frames=6)
    shutil.copytree(frames / "masks", tmp_path / "masks")  # beside both folders
    write_pixels(tmp_path / "masks" / "14.png", np.full((72, 96, 3), 255, np.uint8))
    sfm.reconstruct(folder, tmp_path / "mixed", masks=use, overwrite=True)
    assert sorted(tasks[-1]["masks"]) == ["14.png", *masked]


def test_what_is_replaced_stays_whole_until_the_new_scene_is_complete(
    video: Path, tmp_path: Path, tasks: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "scene"
    sfm.reconstruct(video, scene, frames=6)

    def contents() -> dict[str, bytes]:
        files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
        return {path.relative_to(tmp_path).as_posix(): path.read_bytes() for path in files}

    before, run_worker, move = contents(), sfm.run_worker, sfm.move_into_place
    for trouble in (InputError("no cameras"), KeyboardInterrupt()):
        monkeypatch.setattr(sfm, "run_worker", raising(trouble))
        with pytest.raises(type(trouble)):
            sfm.reconstruct(video, scene, frames=5, overwrite=True)
        assert contents() == before
    monkeypatch.setattr(sfm, "run_worker", run_worker)
    # the scene cannot be renamed, as when another program has it open on Windows: the frames go back too
    monkeypatch.setattr(sfm, "move_into_place", lambda frames, scene: move(frames, (tmp_path / "none", scene[1])))
    with pytest.raises(FileNotFoundError):
        sfm.reconstruct(video, scene, frames=5, overwrite=True)
    assert contents() == before
    monkeypatch.setattr(sfm, "move_into_place", move)
    sfm.reconstruct(video, scene, frames=5, overwrite=True)
    assert names_of(tasks[-1]) == frame_sequences(tmp_path / "scene_frames")[0]
    assert 0 < len(names_of(tasks[-1])) <= 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene", "scene_frames"]


def test_training_takes_the_frames_that_sfm_made(
    video: Path, tmp_path: Path, tasks: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    given: list[object] = []

    def reconstruct(*paths: Any, frames: int | None, **named: Any) -> Path:
        given.append(frames)
        sfm.reconstruct(*paths, frames=frames, **named)
        raise InputError("cameras are there")  # the fake worker writes no model to train on

    monkeypatch.setattr(loading, "reconstruct", reconstruct)
    walk_mp4 = Path(shutil.copy(video, tmp_path / "walk.mp4"))
    assert main(["sfm", str(walk_mp4), "-o", str(tmp_path / "walk_colmap"), "--frames", "6"]) == 0
    train = ["train", str(walk_mp4), "-o", str(tmp_path / "run")]
    for more in ([], ["--frames", "6"]):
        capsys.readouterr()
        assert main([*train, *more]) == 2
        assert "cameras are there" in capsys.readouterr().err
    assert len(tasks) == 1, "the same frames, so the same cameras"
    assert main([*train, "--frames", "5"]) == 2
    assert "walk_frames: has frames of other videos, or another number of frames" in capsys.readouterr().err
    assert given == [None, 6, 5]
    assert main([*train, "--frames", "0"]) == 2
    assert "--frames 0: expected at least 1" in capsys.readouterr().err
    assert main(["train", str(write_scene(tmp_path / "scene")), *train[2:], "--frames", "5"]) == 2
    assert "--frames 5: " in (said := capsys.readouterr().err) and "is a scene with cameras, expected a video" in said


def test_videos_and_photographs_in_one_folder_are_several_cameras(
    video: Path, tmp_path: Path, tasks: list[dict[str, Any]]
) -> None:
    folder = tmp_path / "shot"
    (folder / "more").mkdir(parents=True)
    shutil.copy(video, folder / "walk.mp4")
    shutil.copy(video, folder / "more" / "Walk.MOV")
    for index in (10, 14, 18):
        write_pixels(folder / f"{index}.png", np.rint(255 * FRAMES[index]).astype(np.uint8))
    (folder / "live.mov").write_bytes(b"a moving photograph")
    shutil.copy(folder / "10.png", folder / "LIVE.png")
    (folder / "live.mov").rename(folder / "LIVE.mov")
    messages = warnings_of(lambda: sfm.reconstruct(folder, folder / "scene", frames=4))
    (task,) = tasks
    assert {name.split("/")[0] for name in names_of(task)} >= {"10.png", "walk.mp4", "more"}
    groups = [{name.rpartition("/")[0] for name in group} for group in task["groups"]]
    assert sorted(map(sorted, groups)) == [[""], ["more/Walk.MOV"], ["walk.mp4"]]
    assert [len(names) for names in task["sequences"]] == [4, 4]
    assert any("1 video(s) (LIVE.mov) left out: a photograph has the same name" in text for text in messages)
    # the output is inside the folder: neither its frames nor its photographs are found next time
    sfm.reconstruct(folder, folder / "scene", frames=4)
    assert len(tasks) == 1


def test_without_pyav_videos_beside_photographs_are_left_out(
    tmp_path: Path, tasks: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    folder = tmp_path / "in"
    (folder / "more").mkdir(parents=True)
    (folder / "more" / "walk.mp4").touch()
    refuses(r"walk\.mp4: video needs PyAV", sfm.reconstruct, folder, tmp_path / "scene")
    for index in (10, 14, 18):
        write_pixels(folder / f"{index}.png", np.rint(255 * FRAMES[index]).astype(np.uint8))
    refuses(r"walk\.mp4: video needs PyAV", sfm.reconstruct, folder, tmp_path / "scene", frames=5)
    (message,) = warnings_of(lambda: sfm.reconstruct(folder, tmp_path / "scene"))
    assert "1 video(s) (more/walk.mp4) left out: video needs PyAV, which is not installed: pip install" in message
    assert names_of(tasks[0]) == ["10.png", "14.png", "18.png"]


def test_a_folder_of_frames_keeps_their_order(video: Path, tmp_path: Path, tasks: list[dict[str, Any]]) -> None:
    taken = take_frames([video], tmp_path / "frames", count=6)
    (tmp_path / "frames" / taken.names[1]).unlink()
    sfm.reconstruct(tmp_path / "frames", tmp_path / "scene")
    assert tasks[0]["sequences"] == [[name for name in taken.names if name != taken.names[1]]]
    assert not (tmp_path / "scene_frames").exists()


@pytest.mark.parametrize("text", ["[]", "{", '{"frames": []}', '{"videos": [{"video": "a", "frames": [{"name": 3}]}]}'])
def test_a_table_of_another_program_is_ignored(text: str, tmp_path: Path) -> None:
    (tmp_path / "frames.json").write_text(text)
    assert frame_sequences(tmp_path) == []


def test_photographs_alone_have_no_sequences(tmp_path: Path, tasks: list[dict[str, Any]]) -> None:
    for index in (10, 14, 18):
        write_pixels(tmp_path / "in" / f"{index}.png", np.rint(255 * FRAMES[index]).astype(np.uint8))
    sfm.reconstruct(tmp_path / "in", tmp_path / "scene")
    assert tasks[0]["sequences"] == []
    refuses("--frames 5: .*in has no videos", sfm.reconstruct, tmp_path / "in", tmp_path / "other", frames=5)


@pytest.mark.parametrize(
    ("given", "reconstruction", "frames"),
    [
        ("a/walk.mp4", "a/walk_colmap", "a/walk_frames"),
        ("a/photos", "a/photos_colmap", "a/photos_frames"),
        ("a/my.photos", "a/my.photos_colmap", "a/my.photos_frames"),
    ],
)
def test_names_of_folders(given: str, reconstruction: str, frames: str) -> None:
    assert reconstruction_folder(Path(given)) == Path(reconstruction)
    assert frames_folder(reconstruction_folder(Path(given))) == Path(frames)
    assert frames_folder(Path("b/scene")) == Path("b/scene_frames")


def test_the_working_folder_as_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scene" / "inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "scene" / "inner")
    assert frames_folder(Path()) == tmp_path.resolve() / "scene" / "inner_frames"
    assert frames_folder(Path("..")) == tmp_path.resolve() / "scene_frames"
    (tmp_path / "in").mkdir()
    for index in range(3):
        write_pixels(tmp_path / "in" / f"{index}.png", np.rint(255 * FRAMES[index]).astype(np.uint8))
    refuses(r"^\.: is the working folder or one above", sfm.reconstruct, tmp_path / "in", Path())


@pytest.mark.parametrize("extension", ["HEIC", "jpg", "JPEG", "dng", "gif"])
def test_the_videos_of_moving_photographs_are_left_out(extension: str, tmp_path: Path) -> None:
    for name in (f"IMG_1.{extension}", "IMG_1.MOV", "walk.mov"):
        (tmp_path / name).touch()
    videos, left_out = find_videos(tmp_path)
    assert videos == [tmp_path / "walk.mov"]
    assert list(left_out.values()) == [[tmp_path / "IMG_1.MOV"]]


def test_layout_of_a_video_and_of_a_folder_of_videos(video: Path, tmp_path: Path) -> None:
    assert detect(video) == "photos"
    shutil.copy(video, tmp_path / "a.MP4")
    assert detect(tmp_path) == "photos"
    assert find_videos(tmp_path) == ([tmp_path / "a.MP4"], {})
    (tmp_path / "a.txt").write_text("no video")
    refuses(
        r"a\.txt: is a file, expected a scene's folder, a transforms\.json, .* or a video", detect, tmp_path / "a.txt"
    )


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda path: None, "no such file or folder, expected a folder with photos, or a video"),
        (lambda path: path.write_text("hello" * 50), "cannot be read as a video"),
    ],
)
def test_the_command_line_refuses_what_is_no_video(
    make: Callable[[Path], object], told: str, tmp_path: Path, capsys: Capture
) -> None:
    make(tmp_path / "walk.mp4")
    assert main(["sfm", str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "scene")]) == 2
    said = capsys.readouterr().err
    assert told in said and "walk.mp4" in said and "Traceback" not in said
    (tmp_path / "a.txt").write_text("hello")
    assert main(["sfm", str(tmp_path / "a.txt"), "-o", str(tmp_path / "scene")]) == 2
    assert "a.txt: is a file, expected a folder with photos, or a video (.mp4" in capsys.readouterr().err
    assert main(["sfm", str(tmp_path), "-o", str(tmp_path / "scene"), "--frames", "0"]) == 2
    assert "--frames 0: expected at least 1" in capsys.readouterr().err
    assert main(["train", str(tmp_path / "a.txt"), "-o", str(tmp_path / "run")]) == 2


@pytest.mark.slow
def test_cameras_of_a_video(tmp_path: Path) -> None:
    video = write_walk(tmp_path / "walk.mp4", walk(320, 240, 40, sub_frames=1).frames)
    scene = sfm.reconstruct(video, tmp_path / "scene", sfm.SfmSettings(camera_model="SIMPLE_PINHOLE"))
    record = json.loads((scene / SFM_RECORD_FILE).read_text())
    assert record["photos"] >= 10
    assert len(record["registered"]) >= 0.8 * record["photos"]
