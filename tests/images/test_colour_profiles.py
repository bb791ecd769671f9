# SPDX-License-Identifier: Apache-2.0
"""Photographs with an ICC profile, against the conversion in closed form from the primaries of their spaces."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import exif_bytes, write_heic
from icc_profiles import ADOBE, ADOBE_CURVE, P3, REC709, ROMM, SRGB_CURVE, in_srgb_by_hand, profile
from numpy.typing import NDArray
from PIL import Image, ImageCms

from clsplat.images.decoders.colour_profiles import ADOBE_RGB, DISPLAY_P3, SrgbPhoto, space_of
from clsplat.images.reading import image_size, open_image, open_photograph, read_image, stored_range
from clsplat.images.writing import write_image
from clsplat.scenes.sfm import photos as sfm_photos

PIXELS = np.random.default_rng(3).integers(0, 256, (24, 31, 3), dtype=np.uint8)
PIXELS[0, :3] = (0, 0, 0), (255, 255, 255), (0, 255, 0)  # black and white stay, and green is outside sRGB
EIGHT_BITS = 0.7 / 255
"""Rounding to 8 bits, and LittleCMS' own of some hundredths of a level."""
SPACES = {"p3": (P3, SRGB_CURVE), "adobe": (ADOBE, ADOBE_CURVE)}


def save(path: Path, pixels: NDArray[Any], icc: bytes, **more: Any) -> Path:
    Image.fromarray(pixels).save(path, icc_profile=icc, **more)
    return path


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("extension", ["png", "tif", "webp"])
def test_colours_are_converted_where_they_are_decoded(space: str, extension: str, tmp_path: Path) -> None:
    path = save(tmp_path / f"a.{extension}", PIXELS, profile(*SPACES[space]), lossless=True)
    expected = in_srgb_by_hand(PIXELS / 255, *SPACES[space])
    np.testing.assert_allclose(read_image(path), expected, atol=EIGHT_BITS)
    assert np.abs(read_image(path) - PIXELS / 255).max() > 0.1, "the stored values are others"
    assert np.abs(read_image(path)[0, :2] - [[0], [1]]).max() < 1e-4
    assert (image_size(path), stored_range(path)[0]) == ((31, 24), 255)
    alpha = np.dstack([PIXELS, PIXELS[:, :, 0]])
    path = save(tmp_path / f"b.{extension}", alpha, profile(*SPACES[space]), lossless=True, exact=True)
    read = read_image(path)
    np.testing.assert_allclose(read[:, :, 3], PIXELS[:, :, 0] / 255, atol=1e-6)
    seen = PIXELS[:, :, 0] > 0
    np.testing.assert_allclose(read[seen][:, :3], expected[seen], atol=EIGHT_BITS)


@pytest.mark.needs("pillow_heif")
@pytest.mark.brings("iPhones", "HEIC in Display P3", "sRGB")
@pytest.mark.parametrize("bits", [8, 10])
def test_a_phones_heic(bits: int, tmp_path: Path) -> None:
    most = (1 << bits) - 1
    pixels = PIXELS if bits == 8 else np.random.default_rng(3).integers(0, 1024, PIXELS.shape, dtype=np.uint16)
    path = write_heic(tmp_path / "a.heic", pixels, exif_bytes(6), profile=profile(P3, SRGB_CURVE))
    expected = np.rot90(in_srgb_by_hand(pixels / most, P3, SRGB_CURVE), -1)
    # 10 bits are converted by OpenColorIO and the curves in float32
    np.testing.assert_allclose(read_image(path), expected, atol=EIGHT_BITS if bits == 8 else 1e-4)


def test_16_bits_stay_16_bits(tmp_path: Path) -> None:
    """Neighbouring values, less than a level of 8 bits apart, stay different."""
    import OpenImageIO as oiio

    pixels = np.stack([np.arange(20000, 20064, dtype=np.uint16)] * 3, axis=1)[None]
    spec = oiio.ImageSpec(64, 1, 3, "uint16")
    icc = profile(P3, SRGB_CURVE)
    spec.attribute("ICCProfile", f"uint8[{len(icc)}]", np.frombuffer(icc, np.uint8))
    output = oiio.ImageOutput.create(str(tmp_path / "a.png"))
    assert output.open(str(tmp_path / "a.png"), spec)
    assert output.write_image(pixels)
    output.close()
    read = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(read, in_srgb_by_hand(pixels / 65535, P3, SRGB_CURVE), atol=1e-5)
    assert len(np.unique(read[:, :, 0])) == 64


def test_a_picture_is_converted_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of one row, of three with a smaller last one, and the whole."""
    rgb = np.random.default_rng(0).random((10, 6, 3), np.float32)
    whole = ADOBE_RGB.to_srgb(rgb)
    for pixels in (1, 18, 60):
        monkeypatch.setattr("clsplat.images.decoders.colour_profiles.CONVERTED_PIXELS", pixels)
        np.testing.assert_allclose(ADOBE_RGB.to_srgb(rgb), whole, rtol=0, atol=1e-6)  # rounding of float32


def test_a_large_profile_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    icc = profile(P3, SRGB_CURVE)
    path = save(tmp_path / "a.png", PIXELS, icc)
    for limit in (len(icc), len(icc) - 1):
        monkeypatch.setattr("clsplat.images.decoders.colour_profiles.MAX_PROFILE_BYTES", limit)
        assert isinstance(open_photograph(path), SrgbPhoto) == (limit == len(icc))


def test_profiles_of_other_spaces_change_nothing(tmp_path: Path) -> None:
    known = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for icc in (known, profile(REC709, SRGB_CURVE), profile(ROMM, (1.8,)), b"no profile", known[:200]):
        assert space_of(icc) is None
        np.testing.assert_allclose(read_image(save(tmp_path / "a.png", PIXELS, icc)), PIXELS / 255, atol=1e-7)
    assert space_of(profile(P3, SRGB_CURVE)) is DISPLAY_P3
    assert space_of(profile(ADOBE, ADOBE_CURVE)) is ADOBE_RGB
    assert space_of(profile(P3, (1.0,))) is None, "the primaries of P3, but another curve"
    grey = save(tmp_path / "grey.png", PIXELS[:, :, 0], profile(P3, SRGB_CURVE))
    np.testing.assert_allclose(read_image(grey)[:, :, 0], PIXELS[:, :, 0] / 255, atol=1e-7)  # float32 rounding


def test_copies_for_structure_from_motion_are_converted_once(tmp_path: Path) -> None:
    folder, target = tmp_path / "photos", tmp_path / "staged"
    folder.mkdir()
    icc = profile(P3, SRGB_CURVE)
    save(folder / "a.png", PIXELS, icc)
    soft = np.asarray(Image.fromarray(PIXELS[:5, :7]).resize((56, 40)))  # JPEG keeps it well
    save(folder / "b.jpg", soft, icc, quality=98)
    write_image(folder / "c.png", np.float32(PIXELS / 255))
    paths, _ = sfm_photos.find_photos(folder)
    sfm_photos.stage_photos(folder, paths, target, lambda _: None, 1)
    for path in target.iterdir():
        assert not isinstance(open_image(path), SrgbPhoto), path
        assert Image.open(path).info.get("icc_profile") is None, path
    levels = np.rint(255 * in_srgb_by_hand(PIXELS / 255, P3, SRGB_CURVE))
    assert np.abs(np.asarray(Image.open(target / "a.png")) - levels).max() <= 1  # 1: a tie of rounding
    np.testing.assert_allclose(read_image(target / "a.png"), levels / 255, atol=1.01 / 255)
    np.testing.assert_allclose(read_image(target / "c.png"), PIXELS / 255, atol=1e-7)
    seen = np.asarray(Image.open(io.BytesIO((target / "b.jpg").read_bytes())), np.float64)
    assert (
        np.abs(seen - 255 * read_image(folder / "b.jpg")).mean() < 4
    )  # a second JPEG, with half-size chroma; unconverted: 10
