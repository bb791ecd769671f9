# SPDX-License-Identifier: Apache-2.0
"""Motion blur and depth of field against closed forms and means of the float64 twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from calls import refuses
from compare import assert_close, assert_same_bits

from clsplat.camera import Camera
from clsplat.config.pictures import FramingConfig, SamplingConfig, stratified_times
from clsplat.errors import InputError
from clsplat.frame.draw import drawn_by
from clsplat.frame.samples import lens_points, lens_radius, sample_cameras, sampled, through_lens
from clsplat.reference import render as reference
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.task import framed
from clsplat.shots.shot import Shot, numbered

CLOUD, CAMERA = scenes.random_cloud(1000, 8, 100, 70)


def sliding(time: float) -> Camera:
    """A unit to the right each frame."""
    return replace(CAMERA, translation=CAMERA.translation - np.array([time, 0.0, 0.0]))


def dot(depth: float, width: int = 201) -> tuple[scenes.Gaussians, Camera]:
    """A white Gaussian a few pixels wide, in the middle."""
    camera = scenes.straight_camera(width, width)
    size = 2.0 * depth / camera.fx
    gaussians = scenes.make_gaussians(
        np.array([[0.0, 0.0, depth]]),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.log([[size, size, size]]),
        np.array([0.9]),
        np.full((1, 1, 3), 0.5 / 0.28209479),
    )
    return gaussians, camera


def test_times_are_one_in_each_interval() -> None:
    for count in (1, 2, 7, 16, 100):
        times = np.array(stratified_times(count))
        assert_close(np.sort(times), (np.arange(count) + 0.5) / count)
    times = np.array(stratified_times(64))
    assert abs(np.corrcoef(times, np.arange(64))[0, 1]) < 0.2  # the lens's radius grows with the index
    assert (np.abs(np.diff(times)) > 0.25).mean() > 0.5


def test_lens_points_are_evenly_on_the_disc() -> None:
    points = lens_points(256)
    radii = np.hypot(*points.T)
    assert radii.max() < 1
    # The mean of r^2 over a disc is 1/2, that of x and y 0, that of x^2 1/4.
    assert_close(np.mean(radii**2), 0.5, absolute=1e-12)
    assert_close(points.mean(axis=0), np.zeros(2), absolute=5e-3)
    assert_close((points**2).mean(axis=0), np.full(2, 0.25), absolute=5e-3)


def test_the_focal_plane_stays_put() -> None:
    camera, focus = scenes.tilted_camera(100, 70), 3.0
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 70, (20, 2))
    points = scenes.world_from_pixels(camera, pixels, np.full(20, focus))
    moved = through_lens(camera, 0.3, -0.2, focus)
    assert_close(np.linalg.norm(moved.position - camera.position), np.hypot(0.3, 0.2), absolute=1e-12)
    p = points @ moved.rotation.T + moved.translation
    again = p[:, :2] / p[:, 2:] * [moved.fx, moved.fy] + [moved.cx, moved.cy]
    assert_close(again, pixels, absolute=1e-9)
    assert_close(p[:, 2], np.full(20, focus), absolute=1e-12)


def test_f_numbers() -> None:
    camera = scenes.straight_camera(1000, 500, focal=1400.0)
    # 50.4 mm on 36 mm of 1000 pixels; f/2 is 25.2 mm across.
    radius = lens_radius(camera, SamplingConfig(f_stop=2.0, focus=1.0))
    assert_close(radius, 0.0126, absolute=1e-12)
    assert_close(lens_radius(camera, SamplingConfig(f_stop=2.0, focus=1.0, metres=10.0)), radius / 10, absolute=1e-12)
    assert_close(lens_radius(camera, SamplingConfig(aperture=0.7, focus=1.0)), 0.7)


def test_a_frame_is_the_mean_of_its_samples() -> None:
    config = SamplingConfig(samples=5, shutter_angle=180.0, aperture=0.05, focus=4.0)
    middle, cameras = sample_cameras(sliding, config)
    assert_close(middle.translation, CAMERA.translation, absolute=1e-12)
    shifts = (
        np.sort([camera.position @ CAMERA.rotation[0] for camera in cameras]) - CAMERA.position @ CAMERA.rotation[0]
    )
    assert abs(shifts.min() + 0.2) < 0.06 and abs(shifts.max() - 0.2) < 0.06
    draw = sampled(drawn_by(Renderer(), CLOUD), middle, cameras)
    got = draw(middle, ("rgb", "alpha"))
    images, alphas = zip(*(reference.render(CLOUD, camera) for camera in cameras), strict=True)
    # As of one frame: a pixel at the edge of an ellipse may be in or out, alpha 1/255, in some of the samples.
    for wanted, name in ((np.mean(images, axis=0), "rgb"), (np.mean(alphas, axis=0), "alpha")):
        error = np.abs(got[name] - wanted)
        assert error.max() < 5e-3 and error.mean() < 1e-6
    assert np.abs(got["rgb"] - reference.render(CLOUD, CAMERA)[0]).max() > 0.1


def test_blur_has_the_right_length_and_the_light_stays() -> None:
    depth, width = 4.0, 201
    gaussians, camera = dot(depth, width)
    per_frame = 40.0 * depth / camera.fx  # 40 pixels
    config = SamplingConfig(samples=64, shutter_open=0.0, shutter_close=0.5)
    middle, cameras = sample_cameras(
        lambda time: replace(camera, translation=np.array([-per_frame * time, 0.0, 0.0])), config
    )
    got = sampled(drawn_by(Renderer(), gaussians), middle, cameras)(middle, ("alpha",))["alpha"].astype(np.float64)
    still = reference.render(gaussians, camera)[1]
    assert_close(got.sum(), still.sum(), relative=5e-3)  # the cut at 1/255 falls on other pixels
    x = np.arange(width) + 0.5 - camera.cx
    profile, sharp = got.sum(axis=0), still.sum(axis=0)
    # The camera goes right, so the dot goes left: from 0 to 20 pixels.
    assert_close((profile * x).sum() / profile.sum(), -10.0, absolute=1e-2)
    spread = (profile * (x + 10) ** 2).sum() / profile.sum() - (sharp * x**2).sum() / sharp.sum()
    assert_close(spread, 20.0**2 / 12, relative=1e-3)  # variance of a box, which 64 samples have to 1/64^2


def test_circle_of_confusion() -> None:
    focus, radius = 4.0, 0.2
    config = SamplingConfig(samples=256, aperture=radius, focus=focus)
    spreads = {}
    for depth in (focus, 8.0, 3.0):
        gaussians, camera = dot(depth)
        middle, cameras = sample_cameras(lambda _, camera=camera: camera, config)
        got = sampled(drawn_by(Renderer(), gaussians), middle, cameras)(middle, ("alpha",))["alpha"].astype(np.float64)
        x = np.arange(camera.width) + 0.5 - camera.cx
        profile, sharp = got.sum(axis=0), reference.render(gaussians, camera)[1].sum(axis=0)
        spreads[depth] = (profile * x**2).sum() / profile.sum() - (sharp * x**2).sum() / sharp.sum()
        blur = camera.fx * radius * abs(1 / depth - 1 / focus)  # radius in pixels
        # x^2 over a disc is r^2 / 4; the dot as a cloud is seen from aside by a hundredth differently
        assert_close(spreads[depth], blur**2 / 4, relative=2e-2, absolute=2e-2)
    assert spreads[8.0] > 5


def test_other_layers_are_of_the_middle() -> None:
    config = SamplingConfig(samples=3, shutter_open=0.0, shutter_close=1.0)
    middle, cameras = sample_cameras(sliding, config)
    base = drawn_by(Renderer(), CLOUD)
    got = sampled(base, middle, cameras)(CAMERA, ("depth", "rgb", "id"))
    assert set(got) == {"rgb", "depth", "id"}
    still = base(sliding(0.5), ("depth", "id"))
    for name, values in still.items():
        assert_same_bits(got[name], values)


def test_windows_have_the_bits_of_the_frame_and_twice_the_same() -> None:
    config = SamplingConfig(samples=4, shutter_angle=90.0, aperture=0.05, focus=4.0)
    draw = sampled(drawn_by(Renderer(), CLOUD), *sample_cameras(sliding, config))
    whole, again = (draw(CAMERA, ("rgb", "alpha", "depth")) for _ in range(2))
    part = draw(CAMERA.cropped(21, 13, 40, 30), ("rgb", "alpha", "depth"))
    for name, values in whole.items():
        assert_same_bits(values, again[name])
        assert_same_bits(part[name], np.ascontiguousarray(values[13:43, 21:61]))
    larger = draw(framed(CAMERA, FramingConfig(overscan="8")), ("rgb",))["rgb"]
    assert_same_bits(np.ascontiguousarray(larger[8:-8, 8:-8]), whole["rgb"])


def test_of_a_shot() -> None:
    shot = Shot(numbered([sliding(time) for time in range(5)]))
    config = SamplingConfig(samples=2, shutter_angle=180.0)
    middle, cameras = sample_cameras(lambda time: shot.at(3 + time), config)
    assert_close(middle.position, sliding(2).position, absolute=1e-9)
    assert_close(cameras[0].position, sliding(2 - 0.125).position, absolute=1e-9)
    assert_close(cameras[1].position, sliding(2 + 0.125).position, absolute=1e-9)


def test_nothing_open_is_one_camera() -> None:
    for config in (SamplingConfig(), SamplingConfig(samples=1, shutter_angle=90.0)):
        middle, cameras = sample_cameras(sliding, config)
        assert cameras == [middle]
    assert not SamplingConfig().on


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (SamplingConfig(samples=0), "--samples 0: expected 1 to 4096"),
        (SamplingConfig(shutter_angle=-1.0), "--shutter-angle -1.0: expected 0 to 3600"),
        (SamplingConfig(shutter_open=0.5), "--shutter-open 0.5 --shutter-close None: expected two times"),
        (SamplingConfig(shutter_open=0.5, shutter_close=0.25), "the second after the first"),
        (SamplingConfig(shutter_angle=9.0, shutter_open=0.0, shutter_close=1.0), "exclude each other"),
        (SamplingConfig(aperture=0.1), "--focus 0.0: expected the depth"),
        (SamplingConfig(aperture=-0.1, focus=1.0), "--aperture -0.1: expected a radius"),
        (SamplingConfig(f_stop=0.0, focus=1.0), "--f-stop 0.0: expected a number above 0"),
        (SamplingConfig(aperture=0.1, f_stop=2.0, focus=1.0), "--aperture and --f-stop exclude"),
    ],
)
def test_settings_that_make_no_sense(config: SamplingConfig, message: str) -> None:
    refuses(message, config.check)
    SamplingConfig(shutter_angle=180.0, f_stop=2.8, focus=3.0).check()


def test_a_lens_needs_an_image_plane() -> None:
    with pytest.raises(InputError, match="depth of field is not defined for fisheye cameras"):
        through_lens(replace(CAMERA, projection="fisheye"), 0.1, 0.0, 1.0)
