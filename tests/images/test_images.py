# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import raising, refuses
from other_pictures import HEIGHT, KINDS, WIDTH, other_picture
from pictures import write_pixels
from PIL import Image as Pillow
from PIL import ImageOps

from clsplat.errors import ClsplatError
from clsplat.images import writing
from clsplat.images.reading import alpha_of, channels_of, downscale, image_size, read_image
from clsplat.images.writing import write_image

RNG = np.random.default_rng(1)
PHOTO = RNG.integers(0, 256, (37, 53, 4), dtype=np.uint8)


@pytest.mark.parametrize(("mode", "channels"), [("L", 3), ("LA", 4), ("RGB", 3), ("RGBA", 4), ("P", 3)])
def test_png_of_every_kind_becomes_rgb_or_rgba(tmp_path: Path, mode: str, channels: int) -> None:
    picture = Pillow.fromarray(PHOTO).convert("RGB" if mode == "P" else mode).convert(mode)
    picture.save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    expected = np.asarray(picture.convert("RGBA" if channels == 4 else "RGB"))
    assert image.dtype == np.float32
    assert image.shape == (37, 53, channels)
    np.testing.assert_array_equal(np.rint(image * 255), expected)  # straight: what the file says, not premultiplied
    assert image_size(tmp_path / "a.png") == (53, 37)


def test_sixteen_bits(tmp_path: Path) -> None:
    Pillow.fromarray(np.full((2, 3), 40000, np.uint16)).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), 40000 / 65535, rtol=1e-6)


def test_exr_keeps_values_beyond_one_and_loses_premultiplication(tmp_path: Path) -> None:
    write_pixels(
        tmp_path / "a.exr", np.array([[[2, 1, 0.5, 0.5], [0.25, 0, 0, 0]]], np.float32), channelnames=tuple("RGBA")
    )
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), [[[4, 2, 1, 0.5], [0.25, 0, 0, 0]]])


def test_exr_of_many_channels_gives_those_named_rgb(tmp_path: Path) -> None:
    pixels = np.arange(5, dtype=np.float32).reshape(1, 1, 5)
    write_pixels(tmp_path / "a.exr", pixels, channelnames=tuple("RGBZN"))
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), [[[0, 1, 2]]])
    write_pixels(tmp_path / "b.exr", pixels, channelnames=tuple("uvwZN"))
    refuses(r"b\.exr: has the channels .*expected grey or RGB", read_image, tmp_path / "b.exr")


def test_exr_data_window_is_placed_in_the_display_window(tmp_path: Path) -> None:
    window = {"x": 1, "y": 2, "full_width": 4, "full_height": 5}
    write_pixels(tmp_path / "a.exr", np.ones((1, 2, 3), np.float32), **window)
    image = read_image(tmp_path / "a.exr")
    assert image.shape == (5, 4, 3)
    assert image_size(tmp_path / "a.exr") == (4, 5)
    assert image.sum() == image[2, 1:3].sum() == 6


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path: Path, orientation: int) -> None:
    picture = Pillow.fromarray(PHOTO[:, :, :3])
    exif = picture.getexif()
    exif[0x112] = orientation
    path = tmp_path / "a.jpg"
    picture.save(path, exif=exif, quality=95, subsampling=0)
    turned = np.asarray(ImageOps.exif_transpose(Pillow.open(path)))
    assert np.abs(read_image(path) * 255 - turned).max() < 3  # two JPEG decoders
    assert image_size(path) == turned.shape[1::-1]
    assert np.abs(read_image(path, orient=False) * 255 - np.asarray(Pillow.open(path))).max() < 3
    assert image_size(path, orient=False) == (53, 37)


def test_undecodable_images_are_named_with_the_reason(tmp_path: Path) -> None:
    noise = Pillow.fromarray(RNG.integers(0, 256, (300, 300, 3), dtype=np.uint8))
    for name in ("cut.jpg", "cut.png"):
        noise.save(tmp_path / name)
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:40_000])
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "empty.jpg").touch()
    for name in ("cut.jpg", "cut.png", "text.png", "empty.jpg"):
        refuses(f"{name}: does not decode: ", read_image, tmp_path / name)
    refuses(r"cut\.png: does not decode: the PNG ends early", image_size, tmp_path / "cut.png")
    refuses(r"gone\.png: no such image", read_image, tmp_path / "gone.png")


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    write_pixels(tmp_path / "a.exr", np.full((2, 2, 3), np.nan, np.float32))
    refuses(r"a\.exr: has 4 pixels that are not finite", read_image, tmp_path / "a.exr")


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_write_and_read_again(tmp_path: Path, channels: int) -> None:
    image = RNG.random((9, 7, channels), np.float32)
    if channels == 4:
        image[0, :, 3] = 0.5
    expected = np.repeat(image, 3, axis=2) if channels == 1 else image
    write_image(tmp_path / "a.png", image)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, atol=0.5 / 255 + 1e-6)
    write_image(tmp_path / "a.exr", image * 3 if channels != 4 else image)
    np.testing.assert_allclose(
        read_image(tmp_path / "a.exr"), expected * 3 if channels != 4 else expected, rtol=1e-5, atol=1e-6
    )
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    assert spec.channelnames == writing.CHANNEL_NAMES_BY_COUNT[channels]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.png"]


def test_alpha_in_files_is_associated_in_exr_and_straight_in_png(tmp_path: Path) -> None:
    straight, associated = np.array([[[[0.5, 1, 0, 0.5]]], [[[0.25, 0.5, 0, 0.5]]]], np.float32)
    write_image(tmp_path / "a.exr", straight)
    np.testing.assert_array_equal(oiio.ImageInput.open(str(tmp_path / "a.exr")).read_image(oiio.FLOAT), associated)
    write_image(tmp_path / "a.png", straight)
    np.testing.assert_array_equal(np.asarray(Pillow.open(tmp_path / "a.png")), [[[128, 255, 0, 128]]])


def test_a_failed_write_leaves_the_previous_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.png"
    write_image(path, np.zeros((2, 2, 3), np.float32))
    before = path.read_bytes()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "replace", raising(KeyboardInterrupt()))
        write_image(path, np.ones((2, 2, 3), np.float32))
    assert path.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    refuses(r"expected \.png or \.exr", write_image, tmp_path / "a.gif", np.zeros((2, 2, 3), np.float32))
    refuses("none: no such folder", write_image, tmp_path / "none" / "a.png", np.zeros((2, 2, 3), np.float32))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full, a disk that is full, is not there")
def test_a_full_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "with_name", lambda _self, _name: Path("/dev/full"))
    monkeypatch.setattr(Path, "unlink", lambda *_: None)
    with pytest.raises(ClsplatError, match=r"a\.exr: cannot be written"):
        write_image(tmp_path / "a.exr", RNG.random((300, 300, 3), np.float32))


def test_downscale_by_whole_factors_is_the_mean() -> None:
    image = RNG.random((12, 18, 3), np.float32)
    mean = image.reshape(4, 3, 6, 3, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(downscale(image, 6, 4), mean, atol=1e-6)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 5), (18, 11), (17, 12), (30, 40), (18, 12)])
def test_downscale_keeps_constants_and_the_mean(width: int, height: int) -> None:
    constant = np.full((12, 18, 3), 0.7, np.float32)
    np.testing.assert_allclose(downscale(constant, width, height), 0.7, rtol=1e-5)
    image = RNG.random((12, 18, 3), np.float32)
    small = downscale(image, width, height)
    assert small.shape == (height, width, 3)
    if width <= 18 and height <= 12:
        np.testing.assert_allclose(small.mean(), image.mean(), rtol=1e-5)  # area: each source pixel counts the same


@pytest.mark.parametrize("size", [(10, 6), (47, 31), (13, 29)])
def test_downscale_keeps_a_ramp_in_place(size: tuple[int, int]) -> None:
    x, y = np.meshgrid(np.arange(48) + 0.5, np.arange(32) + 0.5)
    ramp = np.stack([x, y, x + y], axis=2).astype(np.float32)
    small = downscale(ramp, *size)
    x, y = np.meshgrid((np.arange(size[0]) + 0.5) * 48 / size[0], (np.arange(size[1]) + 0.5) * 32 / size[1])
    # a pixel is constant over its area, so one cut by a new pixel's edge moves the mean: by 1/8 of it at most an axis
    np.testing.assert_allclose(small, np.stack([x, y, x + y], axis=2), atol=0.25)
    np.testing.assert_allclose((small - np.stack([x, y, x + y], axis=2)).mean(), 0, atol=1e-3)  # no shift of the whole


def test_transparent_colour_does_not_bleed() -> None:
    image = np.zeros((2, 2, 4), np.float32)
    image[0, 0] = [1, 0.5, 0.25, 1]
    image[1, 1] = [0, 1, 0, 0]  # green, but nothing of it
    np.testing.assert_allclose(downscale(image, 1, 1), [[[1, 0.5, 0.25, 0.25]]], atol=1e-6)


UNREAD = ("pcx",)
CLOSE = {"tiff-palette": 1, "jpeg": 1, "jpeg-cmyk": 2, "tiff-cmyk": 1}
"""Levels that decoders may differ by: a palette of 16 bits in 8, and the arithmetic of JPEG's and CMYK's colours."""


@pytest.mark.brings("browsers, converters", "GIF, WebP and others under the name of a PNG", "the first frame")
@pytest.mark.parametrize("extension", ["png", "JPG", "tif", "exr"])
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in UNREAD])
def test_pictures_of_any_kind_under_any_name(kind: str, extension: str, tmp_path: Path) -> None:
    """The first frame, with the colours that Pillow reads."""
    path = tmp_path / f"a.{extension}"
    path.write_bytes(other_picture(kind))
    image = read_image(path)
    with Pillow.open(path) as picture:
        if kind == "tiff-16":
            wanted = np.repeat(np.asarray(picture, np.float64)[:, :, None], 3, axis=2) * 255 / 65535
        else:
            wanted = np.asarray(picture.convert("RGBA" if image.shape[2] == 4 else "RGB"), np.float64)
    assert image_size(path) == (wanted.shape[1], wanted.shape[0])
    assert wanted.shape[:2] == ((13, 16) if kind == "ico" else (HEIGHT, WIDTH))
    assert image.shape[2] == 4 if "alpha" in kind or kind == "gif-transparent" else image.shape[2] in (3, 4)
    difference = np.abs(image.astype(np.float64) * 255 - wanted)
    if image.shape[2] == 4:
        difference[wanted[:, :, 3] == 0, :3] = 0  # the colour of nothing
    # beyond levels, what float32 makes of them
    assert difference.max() <= CLOSE.get(kind, 0) + 1e-4


@pytest.mark.parametrize("kind", UNREAD)
def test_pictures_that_cannot_be_read_are_named(kind: str, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(other_picture(kind))
    refuses(r"a\.png: does not decode: .*; expected an image", read_image, tmp_path / "a.png")


class Header:
    """What a decoder says."""

    def __init__(self, names: tuple[str, ...], alpha: int, count: int) -> None:
        self.channelnames, self.alpha_channel, self.nchannels = names, alpha, count


@pytest.mark.parametrize(
    ("names", "alpha", "count", "wanted"),
    [
        (("R", "G", "B", "A"), 3, 4, 3),
        (("R", "G", "B", "A"), 4, 4, 3),  # OpenImageIO's GIF
        (("R", "G", "B"), 3, 3, -1),
        (("R", "G", "B", "A"), -1, 4, -1),
        (("R", "G", "B", "A"), -7, 4, -1),
        (("R", "G", "B"), 2**31 - 1, 3, -1),
        (("R", "G", "B", "A"), 0, 4, 3),
        (("Y", "A"), 1, 2, 1),
        (("Y",), 1, 2, 1),
        (("R", "G", "B", "A", "Z"), 3, 4, 3),
    ],
)
def test_no_index_of_a_decoder_is_believed(names: tuple[str, ...], alpha: int, count: int, wanted: int) -> None:
    header = Header(names, alpha, count)
    assert alpha_of(header) == wanted
    assert len(channels_of(header)) == count
