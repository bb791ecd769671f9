# SPDX-License-Identifier: Apache-2.0
"""Frames in strips: the bits of the whole, the files of the whole, and memory that is bounded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import scenes
from calls import refuses
from compare import assert_same_bits
from quick import quick

from clsplat.camera import Camera, Window
from clsplat.config.channels import FRAME_CHANNELS
from clsplat.config.pictures import Encoding, FramingConfig, SamplingConfig
from clsplat.device.selection import open_device
from clsplat.errors import InputError
from clsplat.frame.draw import drawn_by
from clsplat.frame.samples import sample_cameras, sampled, supersampled
from clsplat.frame.strips import in_strips, strip_rows, strips, write_in_strips
from clsplat.images.frame_files import FrameFileHeader, write_channels
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.task import framed

CLOUD, CAMERA = scenes.random_cloud(3000, 8, 150, 200)
EVERYTHING = tuple(FRAME_CHANNELS)


def test_strips_cover_the_picture_and_end_with_tiles() -> None:
    for camera in (CAMERA, CAMERA.cropped(5, 21, 100, 150), CAMERA.cropped(-7, -9, 170, 220)):
        top = camera.window.y if camera.window else 0
        for rows in (16, 48, 64):
            parts = list(strips(camera, rows))
            assert sum(part.height for part in parts) == camera.height
            edges = [part.window.y for part in parts if part.window]
            assert edges[0] == top and all(edge % 16 == 0 for edge in edges[1:])
            assert all(part.height <= rows and part.width == camera.width for part in parts)
    assert list(strips(CAMERA, 200)) == [CAMERA]


@pytest.mark.parametrize("projection", quick(["perspective", "equirectangular", "fisheye"], "perspective", "fisheye"))
def test_strips_have_the_bits_of_the_whole(projection: str) -> None:
    focal = 150 / (2 * np.pi) if projection == "equirectangular" else 140.0
    camera = CAMERA if projection == "perspective" else replace(CAMERA, fx=focal, fy=focal, projection=projection)  # type: ignore[arg-type]
    names = tuple(name for name in EVERYTHING if projection == "perspective" or name != "motion")
    draw = drawn_by(Renderer(), CLOUD, after=replace(camera, translation=camera.translation + 0.05))
    whole = draw(camera, names)
    for rows in (16, 80):
        for name, values in in_strips(draw, rows)(camera, names).items():
            assert_same_bits(values, whole[name])


def test_everything_at_once_in_strips() -> None:
    # Wide overscan, whose clamp is not the frame's, a wide filter, and samples.
    framing = FramingConfig(overscan="30%", supersample=2, filter="blackman-harris")
    config = SamplingConfig(samples=2, aperture=0.05, focus=4.0)
    draw = supersampled(drawn_by(Renderer(), CLOUD), framing)
    draw = sampled(draw, *sample_cameras(lambda _: CAMERA, config))
    picture = framed(CAMERA, framing)
    whole = draw(picture, ("rgb", "alpha", "depth"))
    for name, values in in_strips(draw, 48)(picture, ("rgb", "alpha", "depth")).items():
        assert_same_bits(values, whole[name])


@pytest.mark.parametrize("ending", ["exr", "png", "tif", "jpg"])
def test_files_are_those_of_the_whole(ending: str, tmp_path: Path) -> None:
    names = EVERYTHING if ending == "exr" else ("rgb",) if ending == "jpg" else ("rgb", "alpha")
    camera = CAMERA.cropped(5, 21, 100, 150)
    header = FrameFileHeader({"clsplat:frame": 7}, window=Window(5, 21, 150, 200) if ending == "exr" else None)
    draw = drawn_by(Renderer(), CLOUD)
    write_channels(tmp_path / f"whole.{ending}", draw(camera, names), Encoding(), header)
    write_in_strips(tmp_path / f"strips.{ending}", draw, camera, names, 32, Encoding(), header)
    whole, in_parts = (oiio.ImageBuf(str(tmp_path / f"{name}.{ending}")) for name in ("whole", "strips"))
    assert_same_bits(in_parts.get_pixels(oiio.FLOAT), whole.get_pixels(oiio.FLOAT))
    for spec in (whole.spec(), in_parts.spec()):
        assert (spec.width, spec.height) == (100, 150)
        if ending == "exr":
            assert (spec.x, spec.y, spec.full_width, spec.full_height) == (5, 21, 150, 200)
            assert spec.getattribute("clsplat:frame") == 7
    assert in_parts.spec().channelnames == whole.spec().channelnames
    if ending in ("exr", "png"):
        assert (tmp_path / f"whole.{ending}").read_bytes() == (tmp_path / f"strips.{ending}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def large(width: int, height: int) -> Camera:
    """The cloud's view, far finer."""
    return replace(scenes.random_cloud(1, 8, 150, 100)[1].resized(width, height))


def test_memory_is_bounded() -> None:
    # A picture of which image, transmittance and stops alone are 20 MB, in 12.
    limit = 12 << 20
    renderer = Renderer(open_device(None, limit))
    camera = large(1500, 700)
    rows = strip_rows(renderer.device, camera)
    assert rows < 700 and rows % 16 == 0
    drawn = in_strips(drawn_by(renderer, CLOUD), rows)(camera, ("rgb", "alpha"))
    assert renderer.device.memory.peak <= limit
    whole = Renderer().render(CLOUD, camera)
    assert_same_bits(drawn["rgb"], whole.image)
    assert_same_bits(drawn["alpha"], whole.alpha)


def test_rows_of_a_strip() -> None:
    device = open_device(None, 512 << 20)
    camera = large(16384, 8192)
    plain = strip_rows(device, camera)
    assert 16 <= plain < 8192 and plain % 16 == 0
    assert 16384 * plain * 21 * 4 <= 512 << 20
    more = strip_rows(device, camera, EVERYTHING)
    assert 16 <= more < plain
    fine = strip_rows(device, camera, ("rgb",), FramingConfig(supersample=2))
    assert 16 <= fine <= plain / 4 and fine % 16 == 0
    assert strip_rows(device, large(640, 480)) == 480
    assert strip_rows(open_device(None, 1 << 20), camera) == 16


def test_what_cannot_be(tmp_path: Path) -> None:
    draw = drawn_by(Renderer(), CLOUD)
    with pytest.raises(InputError, match="--parts several: a picture of 150x200 is too large to be written at once"):
        write_in_strips(tmp_path / "a.exr", draw, CAMERA, ("rgb",), 16, Encoding(parts="several"))
    refuses("no such folder", write_in_strips, tmp_path / "none" / "a.exr", draw, CAMERA, ("rgb",), 16)

    def fails(camera: Camera, names: object) -> dict[str, np.ndarray]:
        if camera.window and camera.window.y > 50:
            raise KeyboardInterrupt
        return draw(camera, ("rgb",))

    with pytest.raises(KeyboardInterrupt):
        write_in_strips(tmp_path / "a.exr", fails, CAMERA, ("rgb",), 16)
    assert not list(tmp_path.iterdir())
