# SPDX-License-Identifier: Apache-2.0
"""Videos, read back by PyAV."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses
from needs import require
from numpy.typing import NDArray

from clsplat.config.pictures import VideoConfig
from clsplat.errors import ClsplatError
from clsplat.images.video import check_video, frame_planes, prores_planes, video_record, video_writer

require("av")
import av  # noqa: E402


def frames(count: int, width: int, height: int) -> list[NDArray[np.float32]]:
    """A smooth picture whose brightness says which frame it is."""
    y, x = np.mgrid[0:height, 0:width]
    base = np.stack([x / width, y / height, 0.5 + 0 * x], axis=2)
    return [(0.6 * base + 0.35 * index / count).astype(np.float32) for index in range(count)]


def write_video(path: Path, images: Iterable[NDArray[Any]], config: VideoConfig | None = None) -> int:
    """Write all images; returns how many."""
    with video_writer(path, config) as video:
        for image in images:
            video.add(frame_planes(image))
        return video.frames


def read(path: Path) -> tuple[list[NDArray[np.float64]], object]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        pictures = [frame.to_ndarray() for frame in container.decode(stream)]  # planes, as they are in the file
        return pictures, stream


@pytest.mark.parametrize(("width", "height"), [(64, 48), (63, 47)])
def test_frames_in_order(width: int, height: int, tmp_path: Path) -> None:
    path, made = tmp_path / "a.mp4", frames(9, width, height)
    assert write_video(path, made, VideoConfig(fps=30, crf=12)) == 9
    pictures, stream = read(path)
    assert len(pictures) == 9
    assert (stream.width, stream.height) == (width + width % 2, height + height % 2)
    assert stream.average_rate == 30
    assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    assert stream.codec_context.colorspace == 1  # the matrix that the values were made with
    for picture, wanted in zip(pictures, made, strict=True):
        # what crf 12 leaves of a smooth ramp: a few levels of 219; frames are 8 of them apart
        error = picture.astype(int) - frame_planes(wanted)
        assert np.abs(error).max() <= 6
        assert abs(error.mean()) < 0.5
    assert list(tmp_path.iterdir()) == [path]


def test_colours_have_the_matrix_of_their_size(tmp_path: Path) -> None:
    # Rec.601's matrix in place of Rec.709's moves saturated green by about ten levels.
    path = tmp_path / "a.mp4"
    image = np.zeros((48, 64, 3), np.uint8)
    image[:] = (20, 200, 30)
    write_video(path, [image] * 3, VideoConfig(crf=5))
    pictures, stream = read(path)
    assert stream.codec_context.color_range == 1
    # by hand: 16 + 219 * 0.5862; 128 + 224 * (0.1176 - 0.5862) / 1.8556; 128 + 224 * (0.0784 - 0.5862) / 1.5748
    assert abs(int(pictures[0][24, 32]) - 144) <= 1
    assert abs(int(pictures[0][48 + 6, 16]) - 71) <= 1
    assert abs(int(pictures[0][60 + 6, 16]) - 56) <= 1


def test_chroma_is_where_it_belongs() -> None:
    # A ramp of blue to the right: at the left site, a quarter of it each side, of its own column's value.
    rgb = np.zeros((4, 8, 3), np.float32)
    rgb[:, :, 2] = np.arange(8) / 10
    planes = frame_planes(rgb)
    assert planes.shape == (6, 8)
    luma, blue, red = planes[:4], planes[4].reshape(2, 4), planes[5].reshape(2, 4)
    np.testing.assert_array_equal(luma[0], np.rint(16 + 219 * 0.0722 * np.arange(8) / 10))
    # the first has itself at its left
    at = np.array([0.25, 2, 4, 6]) / 10
    np.testing.assert_array_equal(blue[1], np.rint(128 + 224 * at * (1 - 0.0722) / (2 * (1 - 0.0722))))
    np.testing.assert_array_equal(red[0], np.rint(128 - 224 * at * 0.0722 / (2 * (1 - 0.2126))))
    white = frame_planes(np.ones((2, 2, 3), np.float32))
    assert (white[:2] == 235).all() and (white[2:] == 128).all()


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        *((23.976, (24000, 1001)), (23.98, (24000, 1001)), (29.97, (30000, 1001)), (47.952, (48000, 1001))),
        *((59.94, (60000, 1001)), (119.88, (120000, 1001)), (24000 / 1001, (24000, 1001)), (14.985, (15000, 1001))),
        *((24, (24, 1)), (12.5, (25, 2)), (29.5, (59, 2)), (0.1, (1, 10)), (1000, (1000, 1)), (None, (24, 1))),
    ],
)
def test_film_rates(said: float | None, meant: tuple[int, int], tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", frames(3, 32, 32), VideoConfig(fps=said))
    assert read(tmp_path / "a.mp4")[1].average_rate == Fraction(*meant)


def test_the_same_bytes_twice_and_smaller_at_less_quality(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    made = [rng.uniform(-1, 2, (48, 64, 3)).astype(np.float32) for _ in range(4)]
    made[0][0, 0] = np.nan
    for name, config in (("a", VideoConfig()), ("b", VideoConfig()), ("c", VideoConfig(crf=40))):
        write_video(tmp_path / f"{name}.mp4", made, config)
    sizes = {path.stem: path.read_bytes() for path in tmp_path.iterdir()}
    assert sizes["a"] == sizes["b"]
    assert len(sizes["c"]) < len(sizes["a"]) / 2


def ramps(width: int, height: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A smooth picture, and its alpha, which it is associated with."""
    image = frames(1, width, height)[0]
    alpha = np.broadcast_to(np.linspace(0.1, 1, width, dtype=np.float32), (height, width))
    return image * alpha[:, :, None], alpha


def straight(path: Path) -> tuple[list[NDArray[np.float64]], Any]:
    """Planes of a ProRes file's first frame, from 0 to 1023, and its stream."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frame = next(container.decode(stream))
        scale = 2 ** (int(frame.format.name[-4:-2]) - 10)  # FFmpeg decodes 4444 to twelve bits
        planes = []
        for plane in frame.planes:
            values = np.frombuffer(plane, np.uint16).reshape(plane.height, -1)[:, : plane.width]
            planes.append(values.astype(np.float64) / scale)
        return planes, stream


@pytest.mark.parametrize(("prores", "tag"), [("422", "apcn"), ("hq", "apch"), ("4444", "ap4h")])
@pytest.mark.parametrize("width", [64, 63])
def test_prores(prores: Any, tag: str, width: int, tmp_path: Path) -> None:
    path, planes = tmp_path / "a.mov", prores_planes(frames(1, width, 48)[0], None, prores)
    written = set()
    for _ in range(2):
        with video_writer(path, VideoConfig(fps=25, prores=prores), "clsplat model ab settings cd") as video:
            video.add(planes)
            video.add(planes)
        written.add(path.read_bytes())
    assert len(written) == 1
    got, stream = straight(path)
    context = stream.codec_context
    assert (context.name, context.codec_tag, stream.average_rate, stream.frames) == ("prores", tag, 25, 2)
    assert (context.color_range, context.colorspace, context.color_primaries, context.color_trc) == (1, 1, 1, 1)
    assert stream.width == (width if prores == "4444" else 64)
    # quantisation of a smooth ramp: 4 of 876 steps at the most, less than one in the mean
    for values, wanted in zip(got, planes, strict=True):
        assert np.abs(values - wanted).max() <= 4
        assert np.abs(values - wanted).mean() < 1
    assert video_record(path, 2) == {"clsplat:model": "ab", "clsplat:settings": "cd"}
    assert video_record(path, 3) == {}


def test_prores_with_alpha(tmp_path: Path) -> None:
    path, (image, alpha) = tmp_path / "a.mov", ramps(64, 48)
    with video_writer(path, VideoConfig(prores="4444")) as video:
        video.add(prores_planes(image, alpha, "4444"))
    got, stream = straight(path)
    assert stream.codec_context.pix_fmt.startswith("yuva444")
    # ProRes loses nothing of it: half of a step of ten bits, and of the twelve that FFmpeg decodes, 0 to 4095
    np.testing.assert_allclose(got[3] * 4 * 1023 / 4095, 1023 * alpha, atol=0.5 + 0.125)
    luma = frames(1, 64, 48)[0] @ np.array([0.2126, 0.7152, 0.0722])
    assert np.abs(got[0] - (64 + 876 * luma)).max() <= 6  # straight, and quantised


def test_prores_by_hand() -> None:
    """Black, white and pure red in ten bits of Rec.709 in limited range."""
    rgb = np.zeros((2, 4, 3), np.float32)
    rgb[1], rgb[0, 2:] = 1, (1, 0, 0)
    luma, blue, red = prores_planes(rgb, None, "4444")
    assert (luma[0, 0], luma[1, 0]) == (64, 940)
    assert (blue[1] == 512).all()
    # 64 + 876 * 0.2126; 512 - 896 * 0.2126 / 1.8556; 512 + 896 / 2
    assert (luma[0, 3], blue[0, 3], red[0, 3]) == (250, 409, 960)
    narrow = prores_planes(rgb, None, "hq")
    assert [plane.shape for plane in narrow] == [(2, 4), (2, 2), (2, 2)]
    assert narrow[2][0, 1] == 848  # of a red pixel at the left site's right, and a black one at its left: 3/4


def test_nothing_is_left_of_what_fails(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")
    made = frames(2, 32, 32)
    with pytest.raises(KeyboardInterrupt), video_writer(path) as video:
        video.add(frame_planes(made[0]))
        raise KeyboardInterrupt
    refuses("the video has no frames", write_video, path, [])
    refuses(r"frame is 32x16, expected 32x32", write_video, path, [made[0], made[0][:16]], error=ValueError)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
    (tmp_path / "folder.mp4").mkdir()
    refuses(r"folder\.mp4: cannot be written", write_video, tmp_path / "folder.mp4", made, error=ClsplatError)


def test_what_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuses(r"a\.avi: has the extension '\.avi', expected \.mp4 or \.mov", check_video, tmp_path / "a.avi")
    refuses(r"no such folder to write a\.mp4 to", check_video, tmp_path / "none" / "a.mp4")
    for config, message in (
        (VideoConfig(fps=0), "--video.fps 0: expected 0.01"),
        (VideoConfig(crf=52), "--video.crf 52: expected 0 to 51"),
        (VideoConfig(preset="best"), "--video.preset best: expected one of ultrafast"),
    ):
        refuses(message, write_video, tmp_path / "a.mp4", [], config)
    monkeypatch.setitem(sys.modules, "av", None)
    refuses(r"a\.mp4: video needs PyAV, .*pip install 'clsplat\[video\]'", write_video, tmp_path / "a.mp4", [])
