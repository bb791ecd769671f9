# SPDX-License-Identifier: Apache-2.0
"""Colour spaces: what a model records, conversions against closed forms, what lies beyond 0 and 1."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import refuses
from scenes import one

from clsplat.config.pictures import ColourConfig, Encoding
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.images.colour import (
    LINEAR,
    SRGB,
    Colours,
    comment,
    linear_to_srgb,
    photos_space,
    recorded_space,
    srgb_to_linear,
)
from clsplat.images.frame_files import write_channels

HALF = 2.0**-11
"""What rounding to a half loses, relative."""

ACESCG_FROM_REC709 = np.array(
    [[0.61309732, 0.33952285, 0.04737928], [0.07019422, 0.91634757, 0.01345260], [0.02061560, 0.10956983, 0.86981479]]
)
"""Linear Rec.709 to AP1 with Bradford's adaptation from D65 to ACES' white, of OpenColorIO's documentation."""


def truth(values: np.ndarray) -> np.ndarray:
    """sRGB's curve in float64."""
    wide = values.astype(np.float64)
    return np.where(wide > 0.04045, ((np.maximum(wide, 0.04045) + 0.055) / 1.055) ** 2.4, wide / 12.92)


def colours_of_all_kinds() -> tuple[np.ndarray, np.ndarray]:
    """rgb associated with alpha, beyond 0 and 1, and alpha, 0 in places."""
    rng = np.random.default_rng(0)
    straight = rng.uniform(-0.5, 4.0, (40, 50, 3)).astype(np.float32)
    straight[0] = np.linspace(0, 1, 150, dtype=np.float32).reshape(50, 3)
    alpha = rng.uniform(0.01, 1, (40, 50)).astype(np.float32)
    alpha[1], straight[1] = 0, 0
    return straight * alpha[:, :, None], alpha


def test_the_curve() -> None:
    values = np.linspace(-1, 8, 100_001, dtype=np.float32)
    linear = srgb_to_linear(values)
    np.testing.assert_allclose(linear, truth(values), rtol=1e-6, atol=1e-9)  # a few roundings of a float32
    np.testing.assert_allclose(linear_to_srgb(linear), values, rtol=1e-6, atol=1e-6)


def test_to_acescg_and_back_through_a_file(tmp_path: Path) -> None:
    rgb, alpha = colours_of_all_kinds()
    colours = Colours(ColourConfig(colorspace="ACEScg"))
    assert (colours.model, colours.light) == (SRGB, LINEAR)
    converted = colours.convert(rgb, alpha, colours.model, colours.output)
    some = alpha > 0
    linear = truth(rgb[some] / alpha[some][:, None])
    wanted = linear @ ACESCG_FROM_REC709.T
    # Seven digits of the matrix, of sums of values up to 28.
    np.testing.assert_allclose(converted[some] / alpha[some][:, None], wanted, rtol=1e-5, atol=1e-5)
    assert not converted[~some].any()
    assert converted.max() > 1 and converted.min() < 0

    write_channels(tmp_path / "a.exr", {"rgb": converted, "alpha": alpha}, Encoding(depth="half"))
    held = oiio.ImageBuf(str(tmp_path / "a.exr")).get_pixels(oiio.FLOAT)
    assert held[:, :, :3].max() > 1 and held[:, :, :3].min() < 0
    back = colours.convert(held[:, :, :3], None, colours.output, LINEAR)
    associated = linear * alpha[some][:, None]
    # Rounding is of ACEScg's channels, and the matrix back has rows of absolute sum up to 2.5.
    size = np.abs(held[:, :, :3][some]).max(axis=1, keepdims=True)
    assert (np.abs(back[some] - associated) <= 2.5 * HALF * size + 1e-6).all()
    straight = colours.convert(converted, alpha, colours.output, LINEAR)
    np.testing.assert_allclose(straight[some], associated, rtol=HALF, atol=1e-5)


def test_back_to_the_model_space() -> None:
    rgb, alpha = colours_of_all_kinds()
    colours = Colours(ColourConfig(colorspace="ACEScct"))  # a curve of OpenColorIO's, not of 0 at 0
    there = colours.convert(rgb, alpha, colours.model, colours.output)
    assert not there[alpha == 0].any()
    dark = rgb[0, 0], alpha[0, 0]
    assert there[0, 0, 0] > 0.05 * dark[1]
    # OpenColorIO's own logarithms are good to about 1e-5; colours below 0 are outside of what ACEScct resolves
    inside = (rgb >= 0).all(axis=2)
    back = colours.convert(there, alpha, colours.output, colours.model)
    np.testing.assert_allclose(back[inside], rgb[inside], rtol=1e-3, atol=1e-3)


def test_nothing_to_do_is_nothing_done() -> None:
    rgb, alpha = colours_of_all_kinds()
    colours = Colours(ColourConfig(colorspace="sRGB - Texture"))
    assert colours.output == colours.model == SRGB
    assert colours.convert(rgb, alpha, colours.model, colours.output) is rgb


def test_a_model_in_linear_values() -> None:
    for name in ("lin_rec709", "Linear Rec.709 (sRGB)"):
        assert Colours(recorded=name).model == LINEAR
    colours = Colours(ColourConfig(colorspace="ACEScg"), recorded="acescg")
    assert colours.model == colours.light == colours.output == "ACEScg"
    assert Colours(ColourConfig(model_colorspace="lin_rec709"), recorded="ACEScg").model == LINEAR
    assert Colours(recorded="ACEScct").light == LINEAR


def test_a_space_that_is_not_there() -> None:
    with pytest.raises(
        InputError, match=r"^--colorspace ACEScq: is not in the configuration ocio://.*; similar names: ACEScg"
    ):
        Colours(ColourConfig(colorspace="ACEScq"))
    with pytest.raises(InputError, match=r"^--model-colorspace zzz: .*; it has .+, .+, .+ and \d+ more"):
        Colours(ColourConfig(model_colorspace="zzz"))
    refuses(r"^the model's colour space sRBG: .*sRGB", Colours, recorded="sRBG")


def test_a_configuration_that_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"^ocio://nonsense: is not an OpenColorIO configuration: "):
        Colours(ColourConfig(colorspace="ACEScg", ocio_config="ocio://nonsense"))
    monkeypatch.setenv("OCIO", str(tmp_path / "none.ocio"))
    with pytest.raises(InputError, match=r"none\.ocio: is not an OpenColorIO configuration: .*non-existent"):
        Colours(ColourConfig(colorspace="ACEScg"))


def test_a_configuration_without_the_way(tmp_path: Path) -> None:
    config = tmp_path / "own.ocio"
    config.write_text(
        "ocio_profile_version: 1\nroles:\n  default: house\ndisplays:\n  sRGB:\n"
        "    - !<View> {name: house, colorspace: house}\n"
        "active_displays: []\nactive_views: []\ncolorspaces:\n  - !<ColorSpace>\n    name: house\n"
    )
    assert Colours(ColourConfig(ocio_config=str(config))).output == SRGB  # nothing is converted
    with pytest.raises(InputError, match=r"own\.ocio: lacks a colour space for conversions, expected one of lin_rec"):
        Colours(ColourConfig(colorspace="house", ocio_config=str(config)))


def test_what_a_model_records(tmp_path: Path) -> None:
    gaussians, _ = one()
    path = tmp_path / "a.ply"
    gaussians.save(path)
    assert recorded_space(path) == SRGB
    plain = path.read_bytes()
    gaussians.save(path, comments=[comment("Linear Rec.709 (sRGB)")])
    assert recorded_space(path) == "Linear Rec.709 (sRGB)"
    np.testing.assert_array_equal(Gaussians.load(path).means, gaussians.means)
    gaussians.save(path, comments=["made by hand"])
    assert recorded_space(path) == SRGB
    path.write_bytes(plain.replace(b"element vertex", b"obj_info clsplat colorspace ACEScg\nelement vertex", 1))
    assert recorded_space(path) == "ACEScg"
    refuses("expected one line", gaussians.save, path, comments=["a\nelement vertex 7"], error=ValueError)


def test_what_photos_are_in() -> None:
    assert photos_space(["a.jpg", "b.PNG"]) == SRGB
    assert photos_space(["a.exr", "b.EXR"]) == LINEAR
    assert photos_space(["a.exr", "b.jpg"]) == photos_space([]) == SRGB
