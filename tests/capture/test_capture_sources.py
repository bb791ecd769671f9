# SPDX-License-Identifier: Apache-2.0
"""Input of a capture: photographs, videos, or both in a folder; and interruptions while frames are taken."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from needs import require
from scipy import ndimage
from walk_videos import write_walk

from clsplat.capture.folder import CaptureFolder
from clsplat.capture.sources import check_sources, photographs_of
from clsplat.images.writing import write_image
from clsplat.progress import no_progress
from clsplat.scenes.sfm.photos import Photo, camera_groups, fingerprint
from clsplat.scenes.sfm.video_frames import frames_of_videos

require("av")


@pytest.fixture(scope="module")
def stills() -> list[np.ndarray]:
    """Textured pictures that move by 3 pixels from one to the next."""
    noise = ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 1, (48, 160, 3)), (1.5, 1.5, 0))
    picture = ((noise - noise.min()) / (noise.max() - noise.min())).astype(np.float32)
    return [picture[:, 3 * index : 3 * index + 64] for index in range(30)]


@pytest.fixture(scope="module")
def videos(stills: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two videos of one name in sub-folders, and a photograph."""
    folder = tmp_path_factory.mktemp("videos") / "in"
    for name, frames in (("a", stills), ("b", stills[::-1])):
        (folder / name).mkdir(parents=True)
        write_walk(folder / name / "walk.mp4", frames)
    write_image(folder / "photo.png", stills[0])
    return folder


def test_a_video(videos: Path, tmp_path: Path) -> None:
    folder = CaptureFolder(tmp_path)
    found = photographs_of([videos / "a" / "walk.mp4"], folder, 5, no_progress)
    assert (found.path, found.count, found.frames_to) == (folder.frames, 5, None)
    assert len(list(folder.frames.glob("walk.mp4/*.jpg"))) == 5


def test_frames_that_are_taken_again_are_the_same_photographs(videos: Path, tmp_path: Path) -> None:
    """So that their cameras are used again, as of a capture whose frames/ was removed to save room."""
    folder, found = CaptureFolder(tmp_path), []
    for _ in range(2):
        photographs_of([videos / "a" / "walk.mp4"], folder, 4, no_progress)
        found.append(fingerprint(folder.frames, sorted(folder.frames.rglob("*.jpg")), ""))
        shutil.rmtree(folder.frames)
    assert found[0] == found[1]


def test_several_videos_have_folders_below_their_common_one(videos: Path, tmp_path: Path) -> None:
    folder = CaptureFolder(tmp_path)
    found = photographs_of([videos / name / "walk.mp4" for name in ("a", "b")], folder, 4, no_progress)
    assert (found.path, found.count) == (folder.frames, 8)
    assert {path.parent.relative_to(folder.frames).as_posix() for path in folder.frames.rglob("*.jpg")} == {
        "a/walk.mp4",
        "b/walk.mp4",
    }


def test_each_video_of_a_folder_of_frames_has_a_camera(videos: Path, tmp_path: Path) -> None:
    folder = CaptureFolder(tmp_path)
    photographs_of([videos / name / "walk.mp4" for name in ("a", "b")], folder, 4, no_progress)
    names = [path.relative_to(folder.frames).as_posix() for path in folder.frames.rglob("*.jpg")]
    photos = [Photo(name, name, 64, 48, ("", "", "")) for name in (*names, "photo.jpg")]
    with frames_of_videos(folder.frames, folder.scene, None, no_progress) as found:
        pass
    groups = camera_groups(found.by_video(photos), "auto")
    assert sorted(sorted({name.rpartition("/")[0] for name in group}) for group in groups) == [
        [""],
        ["a/walk.mp4"],
        ["b/walk.mp4"],
    ]


def test_photographs_and_videos_in_a_folder(videos: Path, tmp_path: Path) -> None:
    folder = CaptureFolder(tmp_path)
    found = photographs_of([videos], folder, 4, no_progress)
    assert (found.path, found.count, found.frames, found.frames_to) == (videos, 9, 4, folder.frames)
    assert not (tmp_path / "scene_frames").exists()


def test_photographs_stay_where_they_are(videos: Path, stills: list[np.ndarray], tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    write_image(tmp_path / "in" / "a.png", stills[0])
    folder = CaptureFolder(tmp_path / "out")
    found = photographs_of([tmp_path / "in"], folder, None, no_progress)
    assert (found.path, found.count, found.frames, found.frames_to) == (tmp_path / "in", 1, None, None)
    assert not folder.frames.exists()
    refuses("--frames 3: .* has no videos", photographs_of, [tmp_path / "in"], folder, 3, no_progress)


def test_frames_are_taken_once_and_are_the_same_bytes(videos: Path, tmp_path: Path) -> None:
    """An interruption while a video is read or written leaves nothing, and the next call takes the frames."""
    video = videos / "a" / "walk.mp4"
    contents = []
    for name, stop in (("one", ""), ("two", "reading walk.mp4"), ("three", "writing the frames of walk.mp4")):
        folder = CaptureFolder(tmp_path / name)
        folder.path.mkdir()

        def interrupt(text: str, fraction: float | None = None, stop: str = stop) -> None:
            if text == stop:
                raise KeyboardInterrupt

        if stop:
            with pytest.raises(KeyboardInterrupt):
                photographs_of([video], folder, 5, interrupt)
            assert not list(folder.path.iterdir())
        photographs_of([video], folder, 5, no_progress)
        heard: list[str] = []
        photographs_of([video], folder, 5, lambda text, fraction=None, heard=heard: heard.append(text))
        assert heard == ["using the frames taken before"]
        files = (path for path in folder.frames.rglob("*") if path.is_file())
        contents.append({path.relative_to(folder.frames): path.read_bytes() for path in files})
    assert contents[0] == contents[1] == contents[2]
    table = json.loads(contents[0][Path("frames.json")])
    assert len(table["videos"][0]["frames"]) == 5


def test_inputs_that_do_not_go_together(videos: Path, tmp_path: Path) -> None:
    video = videos / "a" / "walk.mp4"
    out = tmp_path / "out"
    check_sources([video, videos / "b" / "walk.mp4"], out)
    check_sources([videos], out)
    refuses(f"{videos}: is a folder among 2 inputs", check_sources, [video, videos], out)
    refuses("is given twice", check_sources, [video, videos / "b" / ".." / "a" / "walk.mp4"], out)
    refuses("is inside the input", check_sources, [videos], videos / "a" / "out")
