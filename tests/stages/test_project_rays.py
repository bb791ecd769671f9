# SPDX-License-Identifier: Apache-2.0
"""Equirectangular and fisheye pictures, and perspective ones along rays, against a float64 twin that has every Gaussian
at every pixel."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_close_images, assert_same_bits
from pipeline import BACKGROUND
from quick import quick

from clsplat.camera import Camera, Projection, focal_length
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.reference import every_pixel
from clsplat.rendering.renderer import Renderer


def all_around(count: int, seed: int) -> Gaussians:
    """Gaussians on every side of the origin, at distances of 0.3 to 6, some of them at the poles and on the seam."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions[:4] = [[0, 1, 0], [0, -1, 1e-4], [1e-4, 0, -1], [-1e-4, 0.2, -1]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = np.exp(rng.uniform(np.log(0.3), np.log(6.0), (count, 1)))
    scales = distances * np.exp(rng.uniform(np.log(0.003), np.log(0.3), (count, 3)))
    return scenes.make_gaussians(
        directions * distances,
        rng.normal(size=(count, 4)),
        np.log(scales),
        rng.uniform(0.02, 0.98, count),
        scenes.random_sh(rng, count),
    )


def panorama(width: int, height: int, turn: float = 2 * np.pi) -> Camera:
    """Of `turn` radians around and as much up and down as its shape has."""
    focal = width / turn
    tilted = scenes.tilted_camera(width, height)
    return replace(tilted, fx=focal, fy=focal, cx=width / 2, cy=height / 2, projection="equirectangular")


def fisheye(width: int, height: int, angle: float) -> Camera:
    focal = focal_length(np.deg2rad(angle), width, "fisheye")
    tilted = scenes.tilted_camera(width, height)
    return replace(tilted, fx=focal, fy=1.1 * focal, cx=0.47 * width, cy=0.52 * height, projection="fisheye")


def pinhole(width: int, height: int, angle: float) -> Camera:
    """Perspective along rays."""
    focal = focal_length(np.deg2rad(angle), width)
    return replace(fisheye(width, height, 90), fx=focal, fy=1.1 * focal, projection="perspective", by_rays=True)


CAMERAS = {
    "panorama": panorama(96, 48),
    "panorama of a width that is no multiple of a tile": panorama(70, 35),
    "half a turn": panorama(64, 40, np.pi),
    "beyond the poles": panorama(48, 40),
    "panorama off the middle": replace(panorama(96, 48), cx=20.0),
    "fisheye of 180 degrees": fisheye(60, 50, 180),
    "fisheye of 300 degrees": fisheye(60, 60, 300),
    "a whole sphere in a circle": fisheye(64, 64, 360),
    "perspective": pinhole(60, 50, 100),
    "perspective of 150 degrees": pinhole(60, 50, 150),
    "antialiased half a turn": panorama(64, 40, np.pi),
    "antialiased fisheye": fisheye(60, 50, 120),
}
"""By name; what begins with antialiased is."""


def model_for(name: str, count: int, seed: int) -> Gaussians:
    """Gaussians all around, drawn as the camera of this name does."""
    antialiased = name.startswith("antialiased")
    return replace(all_around(count, seed), by_rays=CAMERAS[name].by_rays, antialiased=antialiased)


QUICK = ("panorama", "fisheye of 300 degrees", "perspective of 150 degrees", *list(CAMERAS)[-2:])
FEATURES = ("normal", "position", "motion")


def moved(camera: Camera) -> Camera:
    """A step, a turn of 5 degrees to the side and a lens that is a little longer; of a panorama another middle."""
    turn = np.array([[np.cos(0.09), 0.0, np.sin(0.09)], [0.0, 1.0, 0.0], [-np.sin(0.09), 0.0, np.cos(0.09)]])
    rotation = turn @ camera.rotation
    step = np.array([0.02, -0.03, 0.015])
    of = {"rotation": rotation, "translation": turn @ camera.translation + step, "cy": camera.cy + 0.3}
    longer = {} if camera.projection == "equirectangular" else {"fx": 1.02 * camera.fx}
    return replace(camera, cx=camera.cx - 0.4, **of, **longer)  # type: ignore[arg-type]


@cache
def expected(name: str) -> every_pixel.Picture:
    return every_pixel.render(model_for(name, 300, 5), CAMERAS[name], BACKGROUND, moved(CAMERAS[name]))


@pytest.mark.parametrize("name", quick(CAMERAS, *QUICK))
def test_against_the_twin(device: Device, name: str) -> None:
    wanted = expected(name)
    assert ((wanted.alpha > 0.5) & (wanted.margin > 3e-4)).mean() > 0.2
    assert_as_the_twin(device, (model_for(name, 300, 5), CAMERAS[name]), moved(CAMERAS[name]), wanted)


def assert_as_the_twin(device: Device, scene: scenes.Scene, after: Camera, wanted: every_pixel.Picture) -> None:
    """Image, alpha, and where that is over one half the channels."""
    image, found = Renderer(device).render_channels(*scene, FEATURES, after=after, background=BACKGROUND)
    unsure = wanted.margin < 3e-4
    # As of a frame; a direction of float32 is good to 1e-7, that of a pixel is 0.1.
    assert_close_images(image.image, wanted.image, 2e-5, ignore=unsure)
    assert_close_images(image.alpha, wanted.alpha, 2e-5, ignore=unsure)
    solid = (wanted.alpha > 0.5) & ~unsure
    assert solid.any()
    fields = {name: plane for name, plane in found.items() if name not in ("median", "first", "count", "index")}
    assert set(fields) == {"depth", *FEATURES}
    for name, plane in fields.items():
        of, got = (values.reshape(*solid.shape, -1)[solid] for values in (wanted.features[name], plane))
        # The bound, relative to what a value is made of.
        size = np.abs(of).max(axis=1, keepdims=True)
        assert_close(got / size, of / size, absolute=1e-4, name=name)


@pytest.mark.parametrize("name", ["panorama", "fisheye of 300 degrees", "perspective", "perspective of 150 degrees"])
def test_gaussians_that_move_are_a_camera_that_moves(device: Device, name: str) -> None:
    camera, gaussians = CAMERAS[name], model_for(name, 300, 5)
    there = moved(camera)
    # R' x + t' is R (R^T (R' x + t' - t)) + t
    means = (gaussians.means @ there.rotation.T + there.translation - camera.translation) @ camera.rotation
    still = replace(there, rotation=camera.rotation, translation=camera.translation)
    then = replace(gaussians, means=means.astype(np.float32))
    renderer = Renderer(device)
    wanted = renderer.render_channels(gaussians, camera, ("motion",), after=there)[1]["motion"]
    found = renderer.render_channels(gaussians, camera, ("motion",), after=still, moved=then)[1]["motion"]
    assert_close(found, wanted, absolute=1e-3)  # pixels: float32's rounding of means, seen across up to 64 of them
    assert np.abs(wanted).max() > 0.3


def one_at(direction: list[float]) -> Gaussians:
    """A ball at the distance 2, seen under a tenth of a radian."""
    mean = 2.0 * np.array([direction]) / np.linalg.norm(direction)
    sh = np.zeros((1, 1, 3))
    return scenes.make_gaussians(mean, np.array([[1.0, 0, 0, 0]]), np.log([[0.2] * 3]), np.array([0.9]), sh)


def motion_of(device: Device, direction: list[float], camera: Camera, after: Camera) -> np.ndarray:
    """Of the pixel that has most of it."""
    image, found = Renderer(device).render_channels(one_at(direction), camera, ("motion",), after=after)
    motion: np.ndarray = found["motion"][np.unravel_index(np.argmax(image.alpha), image.alpha.shape)]
    return motion


def test_motion_over_the_seam_is_the_short_way(device: Device) -> None:
    camera = replace(panorama(96, 48), rotation=np.eye(3), translation=np.zeros(3))
    angle = 2 * np.pi / 96 * 3  # of three pixels
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    for x in (-0.05, 0.05):  # behind, on either side of the seam
        for rotation, u in ((turn, 3.0), (turn.T, -3.0)):
            motion = motion_of(device, [x, 0.1, -1.0], camera, replace(camera, rotation=rotation))
            assert_close(motion, [u, 0.0], absolute=1e-5)


def test_motion_of_a_zoom_and_of_a_shift(device: Device) -> None:
    # At the longitude and latitude (0.5, 0.3), of a whole panorama and of what shows the side away from its axis.
    direction = [np.sin(0.5) * np.cos(0.3), np.sin(0.3), np.cos(0.5) * np.cos(0.3)]
    middle = replace(panorama(64, 40, np.pi), rotation=np.eye(3), translation=np.zeros(3))
    behind = replace(middle, cx=middle.cx - 2 * np.pi * middle.fx)  # the same picture, a turn on
    for camera, turns in ((middle, 0), (behind, 1)):
        after = replace(camera, fx=1.1 * camera.fx, fy=1.2 * camera.fy, cx=camera.cx + 2.5, cy=camera.cy - 1.5)
        wanted = [0.1 * camera.fx * (0.5 + 2 * np.pi * turns) + 2.5, 0.2 * camera.fy * 0.3 - 1.5]
        assert_close(motion_of(device, direction, camera, after), wanted, relative=2e-6)
    camera = replace(fisheye(60, 50, 180), rotation=np.eye(3), translation=np.zeros(3))
    after = replace(camera, fx=1.1 * camera.fx, cx=camera.cx + 2.5, cy=camera.cy - 1.5)
    wanted = [0.1 * camera.fx * 0.7 * 0.8 + 2.5, -1.5]
    direction = [np.sin(0.7) * 0.8, np.sin(0.7) * 0.6, np.cos(0.7)]
    assert_close(motion_of(device, direction, camera, after), wanted, relative=2e-6)


@pytest.mark.parametrize("projection", ["equirectangular", "fisheye"])
def test_motion_where_an_angle_is_none(device: Device, projection: Projection) -> None:
    # On the axis, straight behind, at the poles, and where the other camera stands at the mean: finite.
    camera = replace(panorama(64, 32), projection=projection, rotation=np.eye(3), translation=np.zeros(3))
    for direction in ([0.0, 0, 1], [0.0, 0, -1], [0.0, 1, 0], [0.0, -1, 0]):
        step = replace(camera, translation=np.array([0.1, 0.0, 0.0]))
        there = replace(camera, translation=-2.0 * np.array(direction))
        for after in (camera, step, there):
            motion = motion_of(device, direction, camera, after)
            assert np.isfinite(motion).all()
            assert motion.any() == (after is step and (projection == "equirectangular" or direction[2] != -1))


def test_motion_to_another_projection_is_none(default_device: Device) -> None:
    camera = panorama(64, 32)
    with pytest.raises(InputError, match="motion: the other frame's camera is fisheye, expected equirectangular"):
        motion_of(default_device, [0.0, 0, 1], camera, replace(camera, projection="fisheye"))


@pytest.mark.smoke
def test_a_turn_of_the_panorama_is_a_shift(device: Device) -> None:
    # A quarter turn of the camera about its own vertical axis moves the picture by a quarter of its width.
    camera, gaussians = panorama(96, 48), all_around(300, 7)
    about_y = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    turned = replace(camera, rotation=about_y @ camera.rotation, translation=about_y @ camera.translation)
    renderer = Renderer(device)
    image, moved = (renderer.render(gaussians, view).image for view in (camera, turned))
    difference = np.abs(np.roll(image, 24, axis=1) - moved).max(axis=2)
    # Thresholds of alpha and transmittance may flip in a few pixels, each less than a step of 8 bits.
    assert np.count_nonzero(difference > 2e-5) < 0.01 * difference.size
    assert difference.max() < 1 / 255


def test_in_the_middle_a_long_fisheye_is_a_pinhole(device: Device) -> None:
    rng = np.random.default_rng(3)
    camera = replace(scenes.straight_camera(40, 40), fx=600.0, fy=600.0)
    depths = rng.uniform(2.0, 6.0, 100)
    gaussians = scenes.make_gaussians(
        scenes.world_from_pixels(camera, rng.uniform(0, 40, (100, 2)), depths),
        rng.normal(size=(100, 4)),
        np.log(depths[:, None] / 600 * np.exp(rng.uniform(0, 1, (100, 3)))),
        rng.uniform(0.1, 0.9, 100),
        scenes.random_sh(rng, 100),
    )
    renderer = Renderer(device)
    wanted = renderer.render(gaussians, camera)
    got = renderer.render(gaussians, replace(camera, projection="fisheye"))
    assert wanted.alpha.mean() > 0.4
    # Angle and tangent differ by a third of the angle squared: at the edge, 20 pixels off, by 0.007 of a pixel.
    assert np.abs(got.image - wanted.image).max() < 0.01


@pytest.mark.parametrize("projection", ["perspective", "fisheye"])
def test_what_a_ray_shows_depends_on_no_camera(device: Device, projection: Projection) -> None:
    """The pixel on the axis of a camera that is turned to where another pixel looks, in the same place."""
    rng = np.random.default_rng(4)
    camera = replace(scenes.straight_camera(65, 65), fx=40.0, fy=40.0, cx=32.5, cy=32.5, by_rays=True)
    ratios, depths = rng.uniform(-0.7, 0.7, (80, 2)), rng.uniform(2.0, 6.0, (80, 1))
    means = np.concatenate([ratios, np.ones((80, 1))], axis=1) * depths
    scales = np.log(depths * np.exp(rng.uniform(np.log(0.1), np.log(0.4), (80, 3))))
    gaussians = scenes.make_gaussians(
        means, rng.normal(size=(80, 4)), scales, rng.uniform(0.1, 0.6, 80), scenes.random_sh(rng, 80)
    )
    renderer, differences = Renderer(device), {}
    for by_rays in (True, False):
        gaussians.by_rays = by_rays
        wide = renderer.render(gaussians, camera).image
        differences[by_rays] = 0.0
        for u, v in ((4, 32), (60, 8), (20, 61), (32, 32)):
            ahead = np.array([(u - 32) / 40, (v - 32) / 40, 1.0])
            ahead /= np.linalg.norm(ahead)
            right = np.cross([0.0, 1.0, 0.0], ahead)
            right /= np.linalg.norm(right)
            turn = np.stack([right, np.cross(ahead, right), ahead])
            turned = replace(camera, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
            narrow = renderer.render(gaussians, replace(turned, projection=projection, by_rays=False)).image
            differences[by_rays] = max(differences[by_rays], float(np.abs(wide[v, u] - narrow[32, 32]).max()))
    # The low-pass alone, of 0.3 square pixels where a Gaussian has 16 and more; the image's plane bends them.
    assert differences[True] < 0.015
    assert projection == "fisheye" or differences[False] > 0.05


def test_depths_along_rays_are_those_of_the_plane(device: Device) -> None:
    """A wall at z = 2, whose distance at the picture's corners is 2.9."""
    camera = replace(scenes.straight_camera(64, 64), fx=43.0, fy=43.0, cx=32.0, cy=32.0)
    across = np.linspace(-3.0, 3.0, 121)
    local = np.stack([*(axis.ravel() for axis in np.meshgrid(across, across)), np.full(121 * 121, 2.0)], axis=1)
    means, count = (local - camera.translation) @ camera.rotation, len(local)
    gaussians = scenes.make_gaussians(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), np.log(0.04)),
        np.full(count, 0.9),
        np.zeros((count, 1, 3)),
    )
    gaussians.by_rays = True
    image, planes = Renderer(device).render_channels(gaussians, camera)
    assert (image.alpha > 0.9).all()
    for name in ("depth", "median", "first"):
        # A Gaussian's distance and a pixel's angle: the two are up to three deviations of 0.04 apart, at 46 degrees.
        # The first are the nearest, so on the axis' side. Distances alone would be 0.3 more on average.
        assert_close(planes[name], np.full((64, 64), 2.0), absolute=0.15, name=name)
    slices = Renderer(device).render_deep(gaussians, camera, 1)
    assert_close(slices[0, :, :, 4], np.full((64, 64), 2.0), absolute=0.15)


def test_by_rays_of_another_projection_is_none(default_device: Device) -> None:
    camera = replace(panorama(64, 32), by_rays=True)
    with pytest.raises(InputError, match="by_rays is True but projection is 'equirectangular', expected 'perspective'"):
        Renderer(default_device).render(all_around(4, 1), camera)


def test_what_is_too_near_or_transparent_is_left_out(device: Device) -> None:
    gaussians = all_around(4, 1)
    gaussians.means[0] = 0.005 * gaussians.means[0] / np.linalg.norm(gaussians.means[0])
    gaussians.opacity_logits[1:] = -20.0
    camera = replace(panorama(32, 16), rotation=np.eye(3), translation=np.zeros(3))
    result = Renderer(device).render(gaussians, camera)
    assert not result.alpha.any()


@pytest.mark.parametrize("group", ["means", "quaternions", "log_scales", "opacity_logits", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -3e38])
@pytest.mark.parametrize(
    "name", quick(["panorama", "fisheye of 300 degrees", "perspective of 150 degrees"], "panorama")
)
def test_what_is_not_finite_is_left_out_alone(default_device: Device, name: str, value: float, group: str) -> None:
    renderer, camera = Renderer(default_device), CAMERAS[name]
    clean, broken = model_for(name, 60, 9), model_for(name, 60, 9)
    clean.opacity_logits[7] = -20.0
    getattr(broken, group)[7] = value
    wanted, got = (renderer.render_channels(gaussians, camera, ("normal", "position")) for gaussians in (clean, broken))
    for planes in (got[0].image, got[0].alpha, *got[1].values()):
        assert np.isfinite(planes).all()
    # Opaque, black and scaled to a point are Gaussians as good as any.
    drawn = (group, np.sign(value)) in (("opacity_logits", 1.0), ("sh", -1.0), ("log_scales", -1.0))
    if not drawn:
        assert_same_bits(got[0].image, wanted[0].image)
        assert_same_bits(got[1]["index"], wanted[1]["index"])
