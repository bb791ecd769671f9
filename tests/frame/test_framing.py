# SPDX-License-Identifier: Apache-2.0
"""Overscan, region and supersampling against the pixels of whole frames."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import scenes
from calls import refuses
from compare import assert_close, assert_same_bits
from quick import quick

from clsplat.camera import Camera, Projection, Window
from clsplat.config.channels import FRAME_CHANNELS
from clsplat.config.pictures import FramingConfig, parse_overscan
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.frame.draw import Draw, Planes, drawn_by
from clsplat.frame.samples import filter_taps, supersampled
from clsplat.reference import every_pixel
from clsplat.reference import render as reference
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.task import framed

WIDTH, HEIGHT = 150, 100
EVERYTHING = tuple(FRAME_CHANNELS)
PERSPECTIVE = scenes.random_cloud(3000, 8, WIDTH, HEIGHT)


def camera_of(projection: str) -> Camera:
    """Of the cloud; angles of view that wrap and reach behind it."""
    camera = PERSPECTIVE[1]
    if projection == "equirectangular":
        focal = WIDTH / (2 * np.pi)
        return replace(camera, fx=focal, fy=focal, cx=70.3, cy=48.1, projection="equirectangular")
    if projection == "fisheye":
        return replace(camera, fx=140.0, fy=138.0, cx=70.3, cy=48.1, projection="fisheye")
    if projection == "orthographic":
        return replace(camera, fx=30.0, fy=31.0, projection="orthographic")
    return camera


def drawer(device: Device, camera: Camera) -> Draw:
    after = replace(camera, translation=camera.translation + np.array([0.05, 0.02, 0.03]))
    return drawn_by(Renderer(device), PERSPECTIVE[0], after=after)


def assert_same(part: Planes, whole: Planes, rows: slice, columns: slice) -> None:
    assert part.keys() == whole.keys()
    for name, values in part.items():
        assert_same_bits(values, np.ascontiguousarray(whole[name][rows, columns]))


@pytest.mark.parametrize("projection", quick(get_args(Projection), "perspective", "fisheye"))
def test_a_region_has_the_bits_of_the_frame(device: Device, projection: str) -> None:
    camera, names = camera_of(projection), EVERYTHING
    draw = drawer(device, camera)
    whole = draw(camera, names)
    assert whole["alpha"].max() > 0.5
    for x, y, width, height in ((0, 0, WIDTH, HEIGHT), (48, 32, 64, 48), (37, 21, 50, 41), (WIDTH - 1, 0, 1, HEIGHT)):
        picture = framed(camera, FramingConfig(region=f"{x},{y},{width},{height}"))
        assert picture.window == Window(x, y, WIDTH, HEIGHT)
        assert_same(draw(picture, names), whole, slice(y, y + height), slice(x, x + width))


@pytest.mark.parametrize("projection", ["perspective", "orthographic", "fisheye"])
@pytest.mark.parametrize(("overscan", "across", "down"), [("16", 16, 16), ("7", 7, 7), ("15%", 22, 15)])
def test_overscan_has_the_frame_within(
    default_device: Device, projection: str, overscan: str, across: int, down: int
) -> None:
    camera, names = camera_of(projection), EVERYTHING
    draw = drawer(default_device, camera)
    picture = framed(camera, FramingConfig(overscan=overscan))
    assert (picture.width, picture.height) == (WIDTH + 2 * across, HEIGHT + 2 * down)
    larger = draw(picture, names)
    inner = {name: values[down : down + HEIGHT, across : across + WIDTH] for name, values in larger.items()}
    assert_same(draw(camera, names), inner, slice(None), slice(None))
    assert larger["alpha"][:, :across].max() > 0.5  # something is beyond the edge


def test_wide_overscan_is_exact_where_it_shows() -> None:
    # Beyond the frame's clamp the picture is that of a camera with a frame as large, not of one that is clamped.
    gaussians, camera = PERSPECTIVE
    picture = framed(camera, FramingConfig(overscan="60%"))
    assert picture.window is not None and picture.window.clamp == 1.2
    drawn = drawn_by(Renderer(), gaussians)(picture, ("rgb", "alpha"))
    image, alpha = reference.render(gaussians, picture)
    # A pixel at the edge of an ellipse may be in or out: alpha 1/255 of colours up to about 2.
    assert_close(drawn["rgb"], image, absolute=1e-2)
    assert np.mean(np.abs(drawn["rgb"] - image)) < 1e-6
    assert_close(drawn["alpha"], alpha, absolute=5e-3)


def test_the_twins_have_windows_too() -> None:
    gaussians, camera = scenes.overlap()
    whole, _ = reference.render(gaussians, camera)
    part, _ = reference.render(gaussians, camera.cropped(7, 5, 20, 11))
    np.testing.assert_allclose(part, whole[5:16, 7:27], rtol=0, atol=1e-12)
    focal = camera.width / (2 * np.pi)
    panorama = replace(camera, fx=focal, fy=focal, projection="equirectangular")
    pictures = [
        every_pixel.render(gaussians, each, (0, 0, 0)).image for each in (panorama, panorama.cropped(7, 5, 20, 11))
    ]
    np.testing.assert_allclose(pictures[1], pictures[0][5:16, 7:27], rtol=0, atol=1e-12)


def test_supersampling_is_the_mean_of_a_larger_frame(default_device: Device) -> None:
    camera = PERSPECTIVE[1]
    draw = drawer(default_device, camera)
    fine = supersampled(draw, FramingConfig(supersample=3))(camera, ("alpha", "rgb", "depth", "id"))
    large = draw(camera.resized(3 * WIDTH, 3 * HEIGHT), ("rgb", "alpha"))
    for name in ("rgb", "alpha"):
        mean = large[name].astype(np.float64).reshape(HEIGHT, 3, WIDTH, 3, -1).mean(axis=(1, 3))
        # Six products and sums of float32.
        assert_close(fine[name].reshape(mean.shape), mean, relative=1e-6, absolute=1e-7)
        assert np.abs(fine[name] - draw(camera, (name,))[name]).max() > 0.05
    plain = draw(camera, ("depth", "id"))
    for name in plain:  # there is no mean of these
        assert_same_bits(fine[name], plain[name])


@pytest.mark.parametrize("kind", ["box", "blackman-harris"])
def test_a_region_of_a_supersampled_frame(default_device: Device, kind: str) -> None:
    config = FramingConfig(supersample=2, filter=kind)  # type: ignore[arg-type]
    camera = PERSPECTIVE[1]
    draw = supersampled(drawer(default_device, camera), config)
    whole = draw(camera, EVERYTHING)
    for x, y, width, height in ((37, 21, 50, 41), (0, 0, 10, HEIGHT)):
        assert_same(
            draw(camera.cropped(x, y, width, height), EVERYTHING), whole, slice(y, y + height), slice(x, x + width)
        )


def test_filters() -> None:
    assert_close(filter_taps(FramingConfig(supersample=4)), np.full(4, 0.25))
    taps = filter_taps(FramingConfig(supersample=4, filter="blackman-harris"))
    assert len(taps) == 12
    assert taps.argmax() in (5, 6) and taps.min() >= 0 and taps[0] < 1e-2 * taps.max()
    assert_close(taps, taps[::-1], absolute=1e-7)
    assert abs(float(taps.sum()) - 1) < 1e-6


def test_the_same_again(default_device: Device) -> None:
    config = FramingConfig(supersample=2, filter="blackman-harris")
    camera = PERSPECTIVE[1]
    one, two = (supersampled(drawer(default_device, camera), config)(camera, EVERYTHING) for _ in range(2))
    assert_same(one, two, slice(None), slice(None))


def test_motion_is_up_in_files(default_device: Device) -> None:
    gaussians, camera = PERSPECTIVE
    lower = replace(camera, cy=camera.cy + 5.0)  # all goes down by five pixels
    motion = drawn_by(Renderer(default_device), gaussians, after=lower)(camera, ("motion", "alpha"))
    there = motion["alpha"] > 0.5
    assert_close(motion["motion"][there], np.tile([0.0, -5.0], (there.sum(), 1)), absolute=1e-4)


def test_a_camera_gets_the_window_of_another() -> None:
    camera = PERSPECTIVE[1]
    part = camera.resized(2 * WIDTH, 2 * HEIGHT).cropped(10, 20, 30, 40)
    moved = replace(camera, translation=camera.translation + 1)
    again = moved.reframed(part)
    assert (again.width, again.height, again.fx, again.cx) == (30, 40, part.fx, part.cx)
    assert again.window == part.window
    assert camera.reframed(camera).window is None
    refuses("edges at whole pixels", part.resized, 31, 40, error=ValueError)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (FramingConfig(overscan="wide"), "--overscan wide: expected pixels"),
        (FramingConfig(overscan="-3"), "--overscan -3: expected pixels"),
        (FramingConfig(overscan="nan%"), "--overscan nan%: expected"),
        (FramingConfig(region="1,2,3"), "--region 1,2,3: expected X,Y,WIDTH,HEIGHT"),
        (FramingConfig(region="1,2,0,3"), "--region 1,2,0,3: expected"),
        (FramingConfig(region="1,2,3,3", overscan="4"), "exclude each other"),
        (FramingConfig(supersample=0), "--supersample 0: expected 1 to 64"),
    ],
)
def test_settings_that_make_no_sense(config: FramingConfig, message: str) -> None:
    refuses(message, config.check)


def test_what_the_camera_cannot(default_device: Device) -> None:
    camera = PERSPECTIVE[1]
    with pytest.raises(InputError, match=r"--region 100,0,51,10: ends at 151,10, beyond the frame's size 150,100"):
        framed(camera, FramingConfig(region="100,0,51,10"))
    panorama = camera_of("equirectangular")
    config = FramingConfig(supersample=2, filter="blackman-harris")
    with pytest.raises(InputError, match="--filter blackman-harris: needs pixels beyond a panorama's edges"):
        supersampled(drawer(default_device, panorama), config)(panorama, ("rgb",))
    assert parse_overscan(" 5% ") == (0, 0.05)
    assert framed(camera, FramingConfig()) is camera
