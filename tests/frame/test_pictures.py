# SPDX-License-Identifier: Apache-2.0
"""Everything that is made of a frame, together: light is added up in linear values, and strips change nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import scenes
from calls import refuses
from compare import assert_close, assert_same_bits

from clsplat.camera import Camera
from clsplat.config.pictures import ColourConfig, Encoding, FramingConfig, PictureConfig, SamplingConfig
from clsplat.errors import InputError
from clsplat.frame.draw import Planes
from clsplat.frame.pipeline import FramePipeline, FrameRequest
from clsplat.frame.strips import write_in_strips
from clsplat.images.colour import LINEAR, linear_to_srgb, srgb_to_linear
from clsplat.images.frame_files import FrameFileHeader, write_channels
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.task import framed

CLOUD, CAMERA = scenes.random_cloud(1500, 8, 100, 70)


def sliding(time: float) -> Camera:
    return replace(CAMERA, translation=CAMERA.translation - np.array([time, 0.0, 0.0]))


def still(_: float) -> Camera:
    return CAMERA


def picture_camera(pipeline: FramePipeline, at: Callable[[float], Camera]) -> Camera:
    return framed(at(pipeline.config.sampling.middle), pipeline.config.framing)


def drawn(pipeline: FramePipeline, at: Callable[[float], Camera], names: tuple[str, ...]) -> Planes:
    draw, finish = pipeline.draw(FrameRequest(at))
    return finish(draw(picture_camera(pipeline, at), names))


def straight(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return rgb / np.where(alpha > 0, alpha, 1)[:, :, None]


def test_nothing_asked_for_is_the_plain_frame() -> None:
    renderer = Renderer()
    plain = renderer.render(CLOUD, CAMERA)
    layers = drawn(FramePipeline(renderer, CLOUD), still, ("rgb", "alpha"))
    assert_same_bits(layers["rgb"], plain.image)
    assert_same_bits(layers["alpha"], plain.alpha)


@pytest.mark.parametrize(("recorded", "space"), [("sRGB", "sRGB"), (LINEAR, LINEAR)])
def test_light_is_added_up_in_linear_values(recorded: str, space: str) -> None:
    renderer = Renderer()
    config = PictureConfig(framing=FramingConfig(supersample=2))
    layers = drawn(FramePipeline(renderer, CLOUD, config, recorded=recorded), still, ("rgb", "alpha"))
    large = renderer.render(CLOUD, CAMERA.resized(200, 140))
    colour = straight(large.image, large.alpha)
    light = (srgb_to_linear(colour) if space == "sRGB" else colour) * large.alpha[:, :, None]
    mean = light.astype(np.float64).reshape(70, 2, 100, 2, 3).mean(axis=(1, 3))
    got = straight(layers["rgb"], layers["alpha"])
    got = (srgb_to_linear(got) if space == "sRGB" else got) * layers["alpha"][:, :, None]
    # The curve there and back, in float32.
    assert_close(got, mean, relative=1e-5, absolute=1e-5)
    if space == "sRGB":
        darker = large.image.reshape(70, 2, 100, 2, 3).mean(axis=(1, 3))
        assert (layers["rgb"] - darker).max() > 0.02


def test_an_opaque_picture_is_converted_as_it_is() -> None:
    config = PictureConfig(colour=ColourConfig(colorspace=LINEAR))
    renderer = Renderer()
    got = drawn(FramePipeline(renderer, CLOUD, config, background=(0.2, 0.4, 0.6)), still, ("rgb",))["rgb"]
    assert_same_bits(got, srgb_to_linear(renderer.render(CLOUD, CAMERA, (0.2, 0.4, 0.6)).image))


def test_samples_in_linear_light() -> None:
    config = PictureConfig(
        colour=ColourConfig(colorspace=LINEAR), sampling=SamplingConfig(samples=3, shutter_open=0.0, shutter_close=0.6)
    )
    renderer = Renderer()
    pipeline = FramePipeline(renderer, CLOUD, config)
    got = drawn(pipeline, sliding, ("rgb", "depth"))
    times = (0.1, 0.3, 0.5)
    light = [srgb_to_linear(renderer.render(CLOUD, sliding(time)).image).astype(np.float64) for time in times]
    assert_close(got["rgb"], np.mean(light, axis=0), relative=1e-6, absolute=1e-6)
    assert_same_bits(got["depth"], renderer.render_channels(CLOUD, sliding(0.3))[1]["depth"])
    assert_close(picture_camera(pipeline, sliding).position, sliding(0.3).position, absolute=1e-12)


def test_all_of_it_to_a_file_in_strips(tmp_path: Path) -> None:
    config = PictureConfig(
        ColourConfig(colorspace="ACEScg"),
        FramingConfig(overscan="10%", supersample=2, filter="blackman-harris"),
        SamplingConfig(samples=2, shutter_angle=90.0, aperture=0.05, focus=4.0),
    )
    names = ("rgb", "alpha", "depth", "motion")
    pipeline = FramePipeline(Renderer(), CLOUD, config)
    after = sliding(1.0)
    (draw, finish), camera = pipeline.draw(FrameRequest(sliding, after)), picture_camera(pipeline, sliding)
    file = Encoding(depth="float"), FrameFileHeader(window=camera.window)
    write_channels(tmp_path / "whole.exr", finish(draw(camera, names)), *file)
    write_in_strips(tmp_path / "strips.exr", lambda strip, _: finish(draw(strip, names)), camera, names, 16, *file)
    assert (tmp_path / "strips.exr").read_bytes() == (tmp_path / "whole.exr").read_bytes()
    spec = oiio.ImageBuf(str(tmp_path / "whole.exr")).spec()
    assert (spec.x, spec.y, spec.width, spec.height) == (-10, -7, 120, 84)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, 100, 70)
    write_channels(tmp_path / "a.png", drawn(pipeline, sliding, ("rgb", "alpha")))
    assert oiio.ImageBuf(str(tmp_path / "a.png")).spec().full_width == 120


def test_back_to_the_space_of_the_model() -> None:
    rgb = np.linspace(0, 3, 300, dtype=np.float32)
    assert_close(linear_to_srgb(srgb_to_linear(rgb)), rgb, relative=1e-6, absolute=1e-6)


def test_what_deep_pictures_have_not() -> None:
    PictureConfig(framing=FramingConfig(region="0,0,5,5")).check_deep()
    with pytest.raises(InputError, match="deep EXR: --supersample cannot filter deep samples"):
        PictureConfig(framing=FramingConfig(supersample=2)).check_deep()
    PictureConfig(sampling=SamplingConfig(shutter_angle=9.0)).check_deep()
    refuses("--supersample 0", FramePipeline, Renderer(), CLOUD, PictureConfig(framing=FramingConfig(supersample=0)))
