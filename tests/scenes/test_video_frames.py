# SPDX-License-Identifier: Apache-2.0
"""Frames of videos as photographs: a walk with stops and a fast turn in three codings, and files that are no videos."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses, warnings_of
from needs import require
from numpy.typing import NDArray
from OpenImageIO import ImageInput
from walk_videos import Walk, sliding, walk, write_walk

from clsplat.config.pictures import VideoConfig
from clsplat.images.video import frame_planes, prores_planes, video_writer
from clsplat.scenes.video.choice import choose
from clsplat.scenes.video.colours import display_rgb
from clsplat.scenes.video.frames import FRAME_TABLE_FILE, frame_sequences, measure_video, take_frames
from clsplat.scenes.video.reading import open_video, parse_place

require("av")
import av  # noqa: E402

WIDTH, HEIGHT, COUNT = 96, 72, 60
STILL = sliding(10)
VARIANTS = {"plain": {}, "hlg": {"hlg": True}, "turned": {"turns": 1}}


@pytest.fixture(scope="module")
def made() -> Walk:
    return walk(WIDTH, HEIGHT, COUNT)


@pytest.fixture(scope="module")
def videos(made: Walk, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("videos")
    return {name: write_walk(folder / f"{name}.mp4", made.frames, **how) for name, how in VARIANTS.items()}  # type: ignore[arg-type]


@pytest.fixture
def video(videos: dict[str, Path], tmp_path: Path) -> Path:
    return Path(shutil.copy(videos["plain"], tmp_path / "walk.mp4"))


def read_pixels(path: Path) -> NDArray[np.float64]:
    """Values of 0 to 255 of a frame, (H, W, 3)."""
    return np.asarray(ImageInput.open(str(path)).read_image("uint8"), np.float64)


def table_of(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / FRAME_TABLE_FILE).read_text())
    return document


@pytest.mark.parametrize("name", VARIANTS)
def test_a_walk_with_stops_and_a_fast_turn(name: str, made: Walk, videos: dict[str, Path], tmp_path: Path) -> None:
    assert warnings_of(lambda: take_frames([videos[name]], tmp_path / "out", count=12)) == []
    (row,) = table_of(tmp_path / "out")["videos"]
    chosen = [frame["frame"] for frame in row["frames"]]
    assert 10 <= len(chosen) <= 12
    assert {made.parts[index] for index in chosen} == {"stop", "walk"}  # none from the turn
    assert sum(made.parts[index] == "stop" for index in chosen) <= 4  # two stops take a quarter of the time
    with open_video(videos[name]) as reader:
        measured, _, _ = measure_video(reader, lambda _: None)
    choice = choose(measured, 12)
    assert choice.frames.tolist() == chosen
    for index in chosen:
        stretch = measured.sharpness[choice.stretches == choice.stretches[index]]
        assert measured.sharpness[index] > np.median(stretch) or len(set(stretch)) == 1, index
    assert (row["width"], row["height"], row["range"]) == (WIDTH, HEIGHT, "HLG" if name == "hlg" else "SDR")
    for frame in row["frames"]:
        pixels = read_pixels(tmp_path / "out" / frame["name"])
        assert pixels.shape == (HEIGHT, WIDTH, 3)
        # the codec at crf 12 and half-size chroma of a speckled picture, 10 bits of HLG: some 5 levels of 255
        assert np.abs(pixels - 255.0 * made.frames[frame["frame"]]).mean() < 6
        assert frame["seconds"] == pytest.approx(frame["frame"] / made.fps, abs=1e-4)


def test_the_same_bytes_twice_and_an_existing_result(video: Path, tmp_path: Path) -> None:
    first, second = (take_frames([video], tmp_path / name, count=6) for name in ("a", "b"))
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert [str(path) for path in files if path.suffix == ".jpg"] == first.names
    assert len(files) == len(first.names) + 2 and first.names == second.names  # with the folder and the table
    for path in (path for path in files if (tmp_path / "a" / path).is_file()):
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path
    before = (tmp_path / "a" / FRAME_TABLE_FILE).stat().st_mtime_ns
    heard: list[str] = []
    again = take_frames([video], tmp_path / "a", count=6, progress=lambda text, _: heard.append(text))
    assert (again.names, heard) == (first.names, ["using the frames taken before"])
    assert again.videos[0].preview == first.videos[0].preview
    assert (tmp_path / "a" / FRAME_TABLE_FILE).stat().st_mtime_ns == before
    assert frame_sequences(tmp_path / "a") == [first.names]
    refuses("a: has frames of other videos, or another number of frames", take_frames, [video], tmp_path / "a", count=7)
    refuses("without --frames, frames of the same videos are used", take_frames, [video], tmp_path / "a", count=7)
    assert take_frames([video], tmp_path / "a").names == first.names  # no number is asked for
    (tmp_path / "a" / first.names[2]).unlink()
    refuses(r"a: walk\.mp4/\d+\.jpg were removed or changed; give this folder", take_frames, [video], tmp_path / "a")
    refuses(
        r"a: walk\.mp4/\d+\.jpg were removed or changed; give this folder",
        take_frames,
        [video],
        tmp_path / "a",
        count=6,
    )
    assert frame_sequences(tmp_path / "a") == [[name for name in first.names if name != first.names[2]]]
    assert len(take_frames([video], tmp_path / "a", count=4, overwrite=True).names) == 4
    assert len(take_frames([video], tmp_path / "a", overwrite=True).names) == 4  # no number is asked for
    mask = Path(shutil.copy(tmp_path / "a" / first.names[0], tmp_path / "a" / "mask.jpg"))
    told = r"a: has pictures beside its frames \(mask\.jpg\), which would be removed"
    refuses(told, take_frames, [video], tmp_path / "a", count=6, overwrite=True)
    mask.unlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "walk.mp4"]


def test_several_videos_have_folders_of_their_names(videos: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "in" / "sub").mkdir(parents=True)
    paths = [tmp_path / "in" / "walk.mp4", tmp_path / "in" / "sub" / "walk.mp4"]
    for path, name in zip(paths, ("plain", "turned"), strict=True):
        shutil.copy(videos[name], path)
    taken = take_frames(paths, tmp_path / "out", root=tmp_path / "in", count=3)
    assert [video.video for video in taken.videos] == ["walk.mp4", "sub/walk.mp4"]
    assert {name.rpartition("/")[0] for name in taken.names} == {"walk.mp4", "sub/walk.mp4"}
    assert [len(names) for names in frame_sequences(tmp_path / "out")] == [3, 3]


@pytest.mark.parametrize(
    ("name", "codec", "form"),
    [
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.mkv", "libx265", "yuv422p10le"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.mkv", "libx264", "yuv444p"),
        ("a.mov", "png", "rgb24"),
        ("a.avi", "rawvideo", "gray"),
    ],
)
def test_other_codecs_of_ten_frames(name: str, codec: str, form: str, tmp_path: Path) -> None:
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, form, 2_000_000
        if codec == "libx265":
            stream.codec_context.options = {"x265-params": "log-level=none:pools=1:frame-threads=1"}
        for index in range(10):
            frame = av.VideoFrame.from_ndarray(np.rint(255 * STILL[index]).astype(np.uint8), format="rgb24")
            container.mux(stream.encode(frame.reformat(format=form)))
        container.mux(stream.encode(None))
    taken = take_frames([tmp_path / name], tmp_path / "out", count=10)
    assert len(taken.names) == 10
    for index in (0, 9):
        pixels = read_pixels(tmp_path / "out" / taken.names[index]).astype(float)
        wanted = 255 * STILL[index]
        if form == "gray":
            wanted = np.repeat((wanted @ [0.299, 0.587, 0.114])[:, :, None], 3, axis=2)
        # default qualities of the codecs, and chroma of half size
        assert np.corrcoef(pixels.ravel(), wanted.ravel())[0, 1] > 0.93


@pytest.mark.parametrize("height", [72, 720])
@pytest.mark.parametrize(("name", "codec", "form"), [("a.mkv", "libx264rgb", "rgb24"), ("a.mov", "png", "rgb24")])
def test_rgb_keeps_its_colours_at_any_size(name: str, codec: str, form: str, height: int, tmp_path: Path) -> None:
    """FFmpeg converts RGB by Rec.601, also where Rec.709 would be assumed of a video without a matrix."""
    picture = np.full((height, 128, 3), (200, 60, 30), np.uint8)
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"qp": "0"} if codec == "libx264rgb" else {})
        stream.width, stream.height, stream.pix_fmt = 128, height, form
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    with open_video(tmp_path / name) as reader:
        (found,) = [display_rgb(frame.planes(), reader.facts.coding) for frame in reader.frames()]
    # rounding of 8-bit values of limited range
    assert np.abs(found[8:-8, 8:-8].astype(int) - picture[8:-8, 8:-8]).max() <= 3


@pytest.mark.parametrize("suffix", ["mp4", "mov"])
def test_a_video_that_render_wrote(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{suffix}"
    y, x = np.mgrid[0:48, 0:64] / 64
    smooth = np.stack([x, y, 0.5 + 0 * x], axis=2).astype(np.float32)
    with video_writer(path, VideoConfig(fps=10)) as writer:
        for index in range(10):
            image = 0.4 * smooth + 0.1 * STILL[index]
            writer.add(frame_planes(image) if suffix == "mp4" else prores_planes(image, None, "hq"))
    taken = take_frames([path], tmp_path / "out", count=3)
    number = int(Path(taken.names[0]).stem)
    error = read_pixels(tmp_path / "out" / taken.names[0]) - 255 * (0.4 * smooth + 0.1 * STILL[number])
    assert np.abs(error).mean() < 3  # the codec's loss, mostly in the noise
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.5  # no level of brightness or colour is lost


def test_times_of_a_variable_frame_rate(made: Walk, tmp_path: Path) -> None:
    times = np.cumsum([0, *np.random.default_rng(0).integers(20, 200, 19)])
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for index, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(frame_planes(made.frames[10 + index]), format="yuv420p")
            frame.pts, frame.time_base = int(time) + 500, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with open_video(tmp_path / "a.mkv") as reader:
        found = [frame.seconds for frame in reader.frames()]
    np.testing.assert_allclose(found, times / 1000, atol=1e-9)


def test_times_go_on_in_files_that_were_joined(made: Walk, tmp_path: Path) -> None:
    """As the parts of a long .mts recording, whose times begin anew."""
    parts = []
    for name, frames in (("a.mts", made.frames[:40]), ("b.mts", made.frames[40:])):
        with av.open(str(tmp_path / name), "w", format="mpegts") as container:
            stream = container.add_stream("libx264", rate=12)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
            for picture in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame_planes(picture), format="yuv420p")))
            container.mux(stream.encode(None))
        parts.append((tmp_path / name).read_bytes())
    (tmp_path / "walk.mts").write_bytes(b"".join(parts))
    with open_video(tmp_path / "walk.mts") as reader:
        found = [frame.seconds for frame in reader.frames()]
    np.testing.assert_allclose(found, np.arange(COUNT) / 12, atol=1e-4)  # MPEG's clock has 90 kHz
    assert len(take_frames([tmp_path / "walk.mts"], tmp_path / "frames", count=8).names) > 4


@pytest.mark.needs("ffmpeg")
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_ffmpeg_turns_a_frame_the_same_way(turns: int, made: Walk, tmp_path: Path) -> None:
    path = write_walk(tmp_path / "a.mp4", made.frames[:10], turns=turns)
    taken = take_frames([path], tmp_path / "out", count=1)
    number = int(Path(taken.names[0]).stem)
    command = ["ffmpeg", "-v", "error", "-i", str(path), "-vf", f"select=eq(n\\,{number})", "-frames:v", "1"]
    raw = subprocess.run([*command, "-f", "rawvideo", "-pix_fmt", "gray", "-"], capture_output=True, check=True).stdout
    theirs = np.frombuffer(raw, np.uint8).reshape(HEIGHT, WIDTH).astype(float)
    ours = read_pixels(tmp_path / "out" / taken.names[0]) @ [0.2126, 0.7152, 0.0722]
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.99


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("+48.8577+002.2950+035.000/", (48.8577, 2.295, 35.0)),
        ("-33.8568+151.2153/", (-33.8568, 151.2153)),
        ("+27.5916+086.5640+8850CRSWGS_84/", (27.5916, 86.564, 8850.0)),
        ("Paris", ()),
        ("+91.0+000.0/", ()),
        ("", ()),
    ],
)
def test_a_place_in_the_form_of_iso_6709(text: str, place: tuple[float, ...]) -> None:
    assert parse_place(text) == place


def test_place_time_and_camera_of_the_file_are_kept(made: Walk, tmp_path: Path) -> None:
    path = tmp_path / "a.mov"
    known = {
        "com.apple.quicktime.location.ISO6709": "+48.8577+002.2950+035.000/",
        "com.apple.quicktime.creationdate": "2024-05-01T12:00:00+0200",
        "com.apple.quicktime.make": "Apple",
        "com.apple.quicktime.model": "iPhone 15",
    }
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update(known)
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for image in made.frames[10:20]:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame_planes(image), format="yuv420p")))
        container.mux(stream.encode(None))
    take_frames([path], tmp_path / "out", count=3)
    (row,) = table_of(tmp_path / "out")["videos"]
    assert row["place"] == [48.8577, 2.295, 35.0]
    assert (row["time"], row["make"], row["model"]) == ("2024-05-01T12:00:00+0200", "Apple", "iPhone 15")


def cut(whole: bytes) -> bytes:
    return whole[: len(whole) // 2]


def without_frames(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.start_encoding()


def sound(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda path, whole: path.unlink(), "no such file, expected a video"),
        (lambda path, whole: (path.unlink(), path.mkdir()), "is a folder, expected a video"),
        (lambda path, whole: path.write_bytes(b""), r"cannot be read as a video \(.*\), expected a complete file"),
        (lambda path, whole: path.write_text("hello\n" * 99), r"cannot be read as a video \(Invalid data"),
        (lambda path, whole: path.write_bytes(cut(whole)), r"cannot be read as a video \(Invalid data"),
        (
            lambda path, whole: path.write_text("#EXTM3U\n#EXTINF:9,\nhttp://localhost/a.ts\n"),
            "cannot be read as a video",
        ),
        (
            lambda path, whole: path.write_bytes(whole.replace(b"avc1\0\0", b"zzzz\0\0")),
            "has a codec that PyAV",
        ),
        (lambda path, whole: without_frames(path), r"has no video stream|has no frame that decodes"),
        (lambda path, whole: sound(path), r"has no video stream \(only audio\)"),
    ],
    ids=["missing", "folder", "empty", "text", "cut off", "playlist", "another codec", "no frames", "sound"],
)
def test_what_is_no_video_is_refused(
    damage: Callable[[Path, bytes], object], told: str, video: Path, tmp_path: Path
) -> None:
    damage(video, video.read_bytes())
    refuses(rf"walk\.mp4: {told}", take_frames, [video], tmp_path / "out")
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".*"))


def with_index_first(video: Path, target: Path) -> bytes:
    """Rewrite a video so that its index comes before its pictures, as programs for the web do."""
    with av.open(str(video)) as source, av.open(str(target), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
    return target.read_bytes()


def test_the_first_part_of_a_video_that_is_cut_off_is_used(video: Path, tmp_path: Path) -> None:
    whole = with_index_first(video, tmp_path / "b.mp4")
    video.write_bytes(whole[: 2 * len(whole) // 3])
    messages = warnings_of(lambda: take_frames([video], tmp_path / "out", count=5))
    assert any("walk.mp4: is cut off or damaged: " in text and "of 60 frames decode" in text for text in messages)
    assert len(frame_sequences(tmp_path / "out")[0]) >= 3


def test_damaged_frames_are_left_out(video: Path, tmp_path: Path) -> None:
    whole = bytearray(with_index_first(video, tmp_path / "b.mp4"))
    begin = whole.index(b"mdat") + len(whole) // 4
    for at in np.random.default_rng(0).integers(begin, len(whole), 60):
        whole[at] ^= 0x55
    video.write_bytes(whole)
    messages = warnings_of(lambda: take_frames([video], tmp_path / "out"))
    assert any("walk.mp4: has damaged parts" in text or "is cut off or damaged" in text for text in messages)


def flat_video(path: Path, level: float) -> Path:
    return write_walk(path, [np.full((48, 64, 3), level, np.float32)] * 10)


@pytest.mark.parametrize(("level", "brightness"), [(0.0, "0"), (0.5, "50")])
def test_a_black_or_bare_wall_is_refused(level: float, brightness: str, tmp_path: Path) -> None:
    told = rf"a\.mp4: shows no texture in 100 % of its picture \(brightness {brightness} % of white\)"
    refuses(told, take_frames, [flat_video(tmp_path / "a.mp4", level)], tmp_path / "out")


def test_small_pictures_and_a_strange_count_are_refused(tmp_path: Path, video: Path) -> None:
    small = write_walk(tmp_path / "a.mp4", [np.zeros((16, 16, 3), np.float32)] * 3)
    refuses(
        r"a\.mp4: its pictures are 16x16, expected at least 32 pixels a side", take_frames, [small], tmp_path / "out"
    )
    refuses("0 frames of a video were asked for, expected at least 1", take_frames, [video], tmp_path / "out", count=0)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a.txt").write_text("mine")
    refuses("full: is neither empty nor a folder of a video's frames", take_frames, [video], tmp_path / "full")
    refuses(r"walk\.mp4: is a file, expected a folder for frames", take_frames, [video], video)
    (tmp_path / "full" / FRAME_TABLE_FILE).write_text('{"videos": [{"frames": 3}]}')
    refuses(r"frames\.json: is not a table of a video's frames", take_frames, [video], tmp_path / "full")


def test_without_pyav_the_extra_is_named(video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    refuses(r"walk\.mp4: video needs PyAV, .*pip install 'clsplat\[video\]'", take_frames, [video], tmp_path / "out")


@pytest.mark.parametrize("stage", ["reading walk.mp4", "writing the frames of walk.mp4"])
def test_after_an_interruption_no_files_remain(stage: str, video: Path, tmp_path: Path) -> None:
    def interrupt(text: str, _: float | None) -> None:
        if text == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        take_frames([video], tmp_path / "out", count=5, progress=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["walk.mp4"]
