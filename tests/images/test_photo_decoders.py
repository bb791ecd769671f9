# SPDX-License-Identifier: Apache-2.0
"""HEIC, AVIF, WebP and raw photographs, against PNG, linear values known by construction, and damaged files."""

from __future__ import annotations

import importlib.util
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import refuses
from camera_files import exif_bytes, write_avif, write_dng, write_heic
from numpy.typing import NDArray
from PIL import Image as Pillow

from clsplat.errors import InputError
from clsplat.images import depth_maps, stmap
from clsplat.images.decoders import raw
from clsplat.images.decoders.decoded_photo import DecodedPhoto, photo_spec
from clsplat.images.decoders.orientation import turned
from clsplat.images.decoders.photo_decoders import DECODED_PHOTO_EXTENSIONS, PHOTO_DECODERS, without_converted
from clsplat.images.decoders.tiff_tags import is_cut_off
from clsplat.images.exif import exposure_of, lens_of
from clsplat.images.reading import find_images, image_size, open_photograph, read_image, stored_range

pytestmark = [pytest.mark.needs("pillow_heif"), pytest.mark.needs("rawpy")]

HEIGHT, WIDTH = 37, 54
SMOOTH = np.asarray(
    Pillow.fromarray(np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)).resize((WIDTH, HEIGHT))
)
"""A picture with soft edges, as photographs have, which lossy formats keep well."""


def linear_of(values: NDArray[Any]) -> NDArray[Any]:
    """Linear values of sRGB values."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_of(values: NDArray[Any]) -> NDArray[Any]:
    """sRGB values of linear ones."""
    values = np.clip(values, 0, 1)
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)


def decibels(image: NDArray[Any], other: NDArray[Any]) -> float:
    return float(-10 * np.log10(np.mean((image.astype(np.float64) - other) ** 2)))


def png_of(path: Path, pixels: NDArray[Any]) -> NDArray[Any]:
    Pillow.fromarray(pixels).save(path)
    return read_image(path)


def heic(path: Path, orientation: int = 1) -> None:
    write_heic(path, SMOOTH, exif_bytes(orientation))


def avif(path: Path, orientation: int = 1) -> None:
    write_avif(path, SMOOTH, exif_bytes(orientation))


def webp(path: Path, orientation: int = 1) -> None:
    Pillow.fromarray(SMOOTH).save(path, "WEBP", lossless=True, exif=exif_bytes(orientation))


def dng(path: Path, orientation: int = 1) -> None:
    write_dng(path, np.rint(65535 * linear_of(SMOOTH / 255)), orientation=orientation)


WRITERS: dict[str, Callable[..., None]] = {".heic": heic, ".avif": avif, ".webp": webp, ".dng": dng}


@pytest.mark.brings("phones, cameras", "HEIC, AVIF, raw files, turned by EXIF", "upright pictures, raw ones developed")
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("extension", WRITERS)
def test_pixels_of_the_png_turned_once(tmp_path: Path, extension: str, orientation: int) -> None:
    expected = turned(png_of(tmp_path / "a.png", SMOOTH), orientation)
    path = tmp_path / f"a{extension}"
    WRITERS[extension](path, orientation)
    image = read_image(path)
    assert image.shape == expected.shape and image.dtype == np.float32
    if extension in (".heic", ".webp"):
        np.testing.assert_array_equal(image, expected)  # coded without loss
    elif extension == ".avif":
        # 8 bits of luma and chroma hold RGB within 1.5 levels, and quality 100 quantises by 1: RMS 0.7 levels is 51 dB
        assert decibels(image, expected) > 48
    else:
        # LibRaw's table of the sRGB curve, and the sensor's 16 bits, which are coarsest where the slope is 12.92
        assert np.abs(image - expected).max() < 1 / 2048
    assert image_size(path) == expected.shape[1::-1]
    # libheif and libavif turn pixels when they decode, so that there is nothing to leave out
    keeps = extension in (".webp", ".dng")
    assert image_size(path, orient=False) == ((WIDTH, HEIGHT) if keeps else expected.shape[1::-1])
    np.testing.assert_array_equal(
        read_image(path, orient=False), turned(image, TURNED_BACK[orientation]) if keeps else image
    )


TURNED_BACK = {**{same: same for same in (1, 2, 3, 4, 5, 7)}, 6: 8, 8: 6}
"""Orientation that undoes an orientation."""


def test_lossy_heic_and_webp(tmp_path: Path) -> None:
    png = png_of(tmp_path / "a.png", SMOOTH)
    write_heic(tmp_path / "a.heic", SMOOTH, quality=90, chroma=444)
    Pillow.fromarray(SMOOTH).save(tmp_path / "a.webp", quality=95)
    # a quality of 90 is at least 40 dB on soft edges; WebP also halves chroma, which costs 8 dB on patches of 7 pixels
    assert decibels(read_image(tmp_path / "a.heic"), png) > 38
    assert decibels(read_image(tmp_path / "a.webp"), png) > 30
    assert [stored_range(tmp_path / name) for name in ("a.heic", "a.webp")] == [(255, False)] * 2


def test_data_are_no_photographs(tmp_path: Path) -> None:
    heic(tmp_path / "a.heic")
    for read in (depth_maps.map_header, depth_maps.read_map, stmap.read_stmap):
        refuses("a.heic: does not decode: .*expected an image", read, tmp_path / "a.heic")


def test_ten_bits_of_heic_stay_ten_bits(tmp_path: Path) -> None:
    levels = np.repeat(np.arange(1024, dtype=np.uint16).reshape(32, 32, 1), 3, axis=2)
    path = write_heic(tmp_path / "a.heic", levels)
    np.testing.assert_array_equal(read_image(path), levels * np.float32(1 / 1023))
    assert stored_range(path) == (65535, False)
    source = open_photograph(path)
    whole = source.read_image(source.spec().format)
    np.testing.assert_array_equal(whole, np.rint(levels * (65535 / 1023)))
    assert whole.dtype == np.uint16
    np.testing.assert_array_equal(source.read_image(oiio.UINT8), np.rint(levels * (255 / 1023)))


@pytest.mark.parametrize("extension", [".heic", ".avif"])
def test_alpha_is_straight(tmp_path: Path, extension: str) -> None:
    alpha = np.repeat(np.linspace(0, 255, WIDTH).astype(np.uint8)[None, :, None], HEIGHT, axis=0)
    pixels = np.concatenate([SMOOTH, alpha], axis=2)
    expected, path = png_of(tmp_path / "a.png", pixels), tmp_path / f"a{extension}"
    (write_heic if extension == ".heic" else write_avif)(path, pixels)
    image = read_image(path)
    assert image.shape == (HEIGHT, WIDTH, 4)
    if extension == ".heic":
        np.testing.assert_array_equal(image, expected)
    else:  # encoders may change colours where alpha is 0
        assert decibels(image[:, 1:], expected[:, 1:]) > 48  # as without alpha


def test_premultiplied_heic_becomes_straight(tmp_path: Path) -> None:
    import pillow_heif

    straight = np.array([200, 100, 40, 102], np.uint8)
    premultiplied = np.tile(np.array([80, 40, 16, 102], np.uint8), (64, 64, 1))
    file = pillow_heif.HeifFile()
    file.add_frombytes("RGBa", (64, 64), premultiplied.tobytes())
    file.save(tmp_path / "a.heic", quality=-1, chroma=444, matrix_coefficients=0)
    np.testing.assert_allclose(255 * read_image(tmp_path / "a.heic"), np.tile(straight, (64, 64, 1)), atol=1e-3)


def test_grey_heic(tmp_path: Path) -> None:
    import pillow_heif

    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    file = pillow_heif.HeifFile()
    file.add_frombytes("L", (16, 16), grey.tobytes())
    file.save(tmp_path / "a.heic", quality=-1)
    np.testing.assert_array_equal(
        np.rint(read_image(tmp_path / "a.heic") * 255), np.repeat(grey[:, :, None], 3, axis=2)
    )


def test_raw_is_developed_by_the_file_alone(tmp_path: Path) -> None:
    """Balance, black and white are the camera's, the curve is sRGB's; the picture's own range counts for nothing."""
    linear = np.linspace(0, 0.25, HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3)
    neutral = np.array([0.5, 1.0, 0.8])
    values = np.rint(1000 + 60000 * linear * neutral)
    path = write_dng(tmp_path / "a.dng", values, neutral=tuple(neutral), black=1000, white=61000)
    image = read_image(path)
    # a step of the sensor is 1/60000, by up to 2 for red, and 12.92 in the curve: 4e-4; LibRaw's table as above
    assert np.abs(image - srgb_of(linear)).max() < 1 / 1024
    np.testing.assert_array_equal(read_image(path), image)
    bright = values.copy()
    bright[0, 0] = 61000
    again = read_image(write_dng(tmp_path / "b.dng", bright, neutral=tuple(neutral), black=1000, white=61000))
    np.testing.assert_array_equal(again[1:], image[1:])


def test_raw_with_a_colour_filter(tmp_path: Path) -> None:
    colour = np.array([0.2, 0.5, 0.1])
    values = np.zeros((HEIGHT - 1, WIDTH), np.uint16)
    values[0::2, 0::2], values[1::2, 1::2] = 60000 * colour[[0, 2]]
    values[0::2, 1::2] = values[1::2, 0::2] = 60000 * colour[1]
    image = read_image(write_dng(tmp_path / "a.dng", values, white=60000))
    assert image.shape == (HEIGHT - 1, WIDTH, 3)
    assert np.abs(image - srgb_of(colour)).max() < 1 / 2048  # as for all three channels: a flat colour stays flat


def test_raw_of_a_camera_without_colours(tmp_path: Path) -> None:
    image = read_image(write_dng(tmp_path / "a.dng", np.full((HEIGHT, WIDTH), 20000), mosaic=False))
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(image - srgb_of(np.array(20000 / 65535))).max() < 1 / 1024  # as for colours


def test_raw_without_a_white_balance_is_not_balanced_by_its_picture(tmp_path: Path) -> None:
    values = np.full((HEIGHT, WIDTH, 3), (10000, 30000, 20000), np.uint16)
    image = read_image(write_dng(tmp_path / "a.dng", values, neutral=(0, 0, 0)))
    assert np.abs(image - srgb_of(values[0, 0] / 65535)).max() < 1 / 1024  # daylight is this camera's white


@pytest.mark.parametrize("extension", DECODED_PHOTO_EXTENSIONS)
def test_size_is_known_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extension: str) -> None:
    path = tmp_path / f"a{extension.upper()}"
    kind = next(kind for kind, each in PHOTO_DECODERS.items() if extension in each.extensions)
    {"heif": heic, "avif": avif, "raw": dng}[kind](path, 6)
    monkeypatch.setattr(DecodedPhoto, "read_image", None)
    assert image_size(path) == (HEIGHT, WIDTH)
    assert find_images(tmp_path) == [path]


def test_camera_lens_and_exposure(tmp_path: Path) -> None:
    exif = exif_bytes(6, 6.765, 24, lens="Acme wide", gps=True)
    write_heic(tmp_path / "a.heic", SMOOTH, exif)
    write_avif(tmp_path / "a.avif", SMOOTH, exif)
    Pillow.fromarray(SMOOTH).save(tmp_path / "a.jpg", exif=exif)
    for name in ("a.heic", "a.avif", "a.jpg"):
        spec = open_photograph(tmp_path / name).spec()
        assert lens_of(spec) == ("Acme", "Cam 1", "Acme wide", "6.765", "24")
        assert exposure_of(tmp_path / name) == pytest.approx(np.log2(0.01 * 200 / 16))
        assert spec.getattribute("GPS:Latitude") == (47, 30, 0) and spec.getattribute("GPS:LongitudeRef") == "E"
    write_dng(tmp_path / "a.dng", np.zeros((HEIGHT, WIDTH, 3)), focal=(50, 75))
    assert lens_of(open_photograph(tmp_path / "a.dng").spec()) == ("Acme", "Cam 1", "", "50.000", "75")
    write_heic(tmp_path / "b.heic", SMOOTH, b"Exif\0\0MM\0*\xff\xff\xff\xff")
    assert lens_of(open_photograph(tmp_path / "b.heic").spec()) == ("",) * 5
    assert exposure_of(tmp_path / "b.heic") is None


def test_exif_of_raw_files_that_are_not_plain_tiff(tmp_path: Path) -> None:
    tiff = exif_bytes(1, 35, 52).removeprefix(b"Exif\0\0")
    assert tiff.startswith(b"MM\0*")
    Pillow.fromarray(SMOOTH).save(tmp_path / "a.jpg", exif=exif_bytes(1, 35, 52))
    jpeg = (tmp_path / "a.jpg").read_bytes()
    raf = b"FUJIFILMCCD-RAW".ljust(84, b"\0") + struct.pack(">II", 92, len(jpeg)) + jpeg
    for head in (tiff, b"MMOR" + tiff[4:], raf):
        (tmp_path / "a.raw").write_bytes(head)
        spec = photo_spec(1, 1, "RGB", oiio.UINT16, raw._exif(tmp_path / "a.raw"))
        assert lens_of(spec) == ("Acme", "Cam 1", "", "35.000", "52")
    for head in (b"", b"\0\0\0\x18ftypcrx ", raf[:88], raf[:84] + b"\xff" * 8):
        (tmp_path / "a.raw").write_bytes(head)
        assert not raw._exif(tmp_path / "a.raw")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.heic", "a.avif", "a.nef", "a.dng", "a.raf"])
@pytest.mark.parametrize("extension", WRITERS)
def test_renamed_photographs_are_read_as_what_they_are(tmp_path: Path, extension: str, name: str) -> None:
    WRITERS[extension](tmp_path / f"b{extension}")
    expected = read_image(tmp_path / f"b{extension}")
    (tmp_path / f"b{extension}").rename(tmp_path / name)
    np.testing.assert_array_equal(read_image(tmp_path / name), expected)


@pytest.mark.parametrize("damage", ["garbage", "empty", "short", "half", "most"])
@pytest.mark.parametrize("extension", WRITERS)
def test_damaged_photographs_are_named(
    tmp_path: Path, extension: str, damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"a{extension}"
    WRITERS[extension](path)
    whole = path.read_bytes()
    cut = {"short": 20, "half": len(whole) // 2, "most": len(whole) - 20}
    path.write_bytes({"garbage": b"hello" * 100, "empty": b""}.get(damage) or whole[: cut.get(damage, 0)])
    if (extension, damage) != (".avif", "most"):  # whose header is at the file's begin
        refuses(rf"a\{extension}: does not decode", image_size, path)
    refuses(rf"a\{extension}: does not decode", read_image, path)
    assert capfd.readouterr() == ("", "")  # decoders print nothing


def test_changed_bytes_never_crash(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for extension, write in WRITERS.items():
        path = tmp_path / f"a{extension}"
        write(path)
        whole = np.frombuffer(path.read_bytes(), np.uint8)
        for _ in range(25):
            spoiled = whole.copy()
            spoiled[rng.integers(0, min(600, len(whole)), 4)] = rng.integers(0, 256, 4)
            path.write_bytes(spoiled.tobytes())
            reads_or_refuses(path)


def reads_or_refuses(path: Path) -> None:
    told = ""
    try:
        image_size(path)
        assert np.isfinite(read_image(path)).all()
    except InputError as error:
        told = str(error)
    assert not told or (path.name in told and told.isprintable())


def test_huge_sizes_in_headers_are_refused(tmp_path: Path) -> None:
    for extension in (".heic", ".avif"):
        path = tmp_path / f"a{extension}"
        WRITERS[extension](path)
        whole = path.read_bytes()
        at = whole.index(b"ispe") + 8
        path.write_bytes(whole[:at] + struct.pack(">II", 60000, 60000) + whole[at + 8 :])
        refuses(rf"a\{extension}: (does not decode|its header gives 60000 x 60000 pixels)", read_image, path)
    path = tmp_path / "a.webp"
    webp(path)
    whole = path.read_bytes()
    at = whole.index(b"VP8X") + 12
    path.write_bytes(whole[:at] + b"\xff\x3f\0\xff\x3f\0" + whole[at + 6 :])
    refuses(r"a\.webp: does not decode", read_image, path)
    path = write_dng(tmp_path / "a.dng", np.zeros((HEIGHT, WIDTH, 3)))
    whole = path.read_bytes()
    for tag, value in ((256, WIDTH), (257, HEIGHT)):
        whole = whole.replace(struct.pack("<HHII", tag, 4, 1, value), struct.pack("<HHII", tag, 4, 1, 60000))
    path.write_bytes(whole)
    refuses(r"a\.dng: (does not decode|its header gives 60000 x 60000 pixels)", image_size, path)


def test_without_the_extra_one_line_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for extension, write in WRITERS.items():
        write(tmp_path / f"a{extension}")
    for module in ("pillow_heif", "rawpy"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr("clsplat.images.decoders.avif.find_spec", lambda _: None)
    for extension, kind in (
        (".heic", "a HEIC photograph"),
        (".avif", "an AVIF photograph"),
        (".dng", "a raw photograph"),
    ):
        for read in (image_size, read_image):
            told = rf"a\{extension}: {kind} needs .*, which is not installed: pip install 'clsplat\[photos\]'$"
            refuses(told, read, tmp_path / f"a{extension}")
    assert read_image(tmp_path / "a.webp").shape == (HEIGHT, WIDTH, 3)


@pytest.mark.brings("cameras, converters", "IMG.jpg beside IMG.dng or IMG.heic", "IMG.jpg alone")
def test_photographs_that_are_there_in_another_format_are_left_out(tmp_path: Path) -> None:
    names = ("a.JPG", "A.dng", "b.heic", "b.heic.jpg", "c.heic", "c.heic.png", "d.nef", "e/d.jpg", "f.avif", "f.heic")
    used, converted = without_converted(tmp_path / name for name in names)
    assert [path.name for path in converted] == ["A.dng", "b.heic"]  # c.heic.png is a mask of c.heic
    assert len(used) == len(names) - 2
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert find_images(tmp_path) == sorted(used)


def test_modules_of_the_table_are_those_that_are_imported() -> None:
    assert all(importlib.util.find_spec(each.module) for each in PHOTO_DECODERS.values())


def test_a_tiff_whose_directories_form_a_circle_is_read_to_an_end(tmp_path: Path) -> None:
    entry = struct.pack("<HHII", 330, 4, 1, 8)
    (tmp_path / "a.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 8))
    assert not is_cut_off(tmp_path / "a.tif", "<")
    (tmp_path / "b.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, 65535) + 9000 * entry)
    assert not is_cut_off(tmp_path / "b.tif", "<")
