# SPDX-License-Identifier: Apache-2.0
"""Upright frames and known lengths, on scenes whose true up and size are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calls import refuses
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.orientation import FrameUse, ScaleRule, parse_scale
from clsplat.images.geotags import GpsPosition
from clsplat.models.edit import moved, scaling, transform_camera
from clsplat.scenes.orientation.known_length import metres_per_unit
from clsplat.scenes.orientation.level import COLMAP_UP, median_roll, up_axis
from clsplat.scenes.orientation.plane import MIN_PLANE_POINTS, ground_height, level_plane
from clsplat.scenes.orientation.positions import fit_map, globe_position, up_from_gps
from clsplat.scenes.orientation.upright import looks_down, up_from_gravity, upright
from clsplat.shots.viewpoints import look_at

UP = np.array(COLMAP_UP)
WORLD = np.eye(4)
WORLD[:3, :3], WORLD[:3, 3] = 2.5 * Rotation.from_euler("xyz", [70, -35, 130], degrees=True).as_matrix(), (3, -2, 7)
"""A similarity from an upright frame to one like COLMAP's, whose axes mean nothing."""
NAMES = [f"photo_{index:02}.jpg" for index in range(16)]


def angle(a: Float64, b: Float64) -> float:
    """Angle between two directions in degrees."""
    return float(np.rad2deg(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def camera_at(position: Float64, target: Float64, roll: float = 0.0, up: Float64 = UP) -> Camera:
    """A camera that faces a point, rolled by some degrees about its axis."""
    rotation, _ = look_at(position, target, up)
    rotation = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ rotation
    return Camera(60, 40, 50.0, 50.0, 30.0, 20.0, rotation, -rotation @ position)


def ring(rolls: float = 0.0, count: int = 16) -> list[Camera]:
    """Cameras around a table, held level up to a random roll in degrees."""
    rng = np.random.default_rng(5)
    turns = 2 * np.pi * np.arange(count) / count
    places = np.stack([4 * np.sin(turns), -1.5 - 0.4 * (np.arange(count) % 3), -4 * np.cos(turns)], axis=1)
    held = zip(places, rng.normal(0, rolls, count), strict=True)
    return [camera_at(place, np.array([0.0, -0.4, 0.0]), roll) for place, roll in held]


def floor_and_things(count: int = 2000) -> Float64:
    """Points on a floor at y = 0 with a little noise, things that stand on it, and a wall."""
    rng = np.random.default_rng(6)
    floor = np.stack([rng.uniform(-3, 3, count), rng.normal(0, 0.005, count), rng.uniform(-3, 3, count)], axis=1)
    things = rng.uniform((-1, -1.2, -1), (1, 0, 1), (count, 3))
    wall = np.stack([rng.uniform(-3, 3, count // 2), rng.uniform(-2, 0, count // 2), np.full(count // 2, 3.0)], axis=1)
    return np.concatenate([floor, things, wall])


def put(cameras: list[Camera], points: Float64, world: Float64 = WORLD) -> tuple[list[Camera], Float64]:
    """The cameras and points in another world."""
    return [transform_camera(camera, world) for camera in cameras], moved(points, world)


def test_a_scene_with_a_floor_stands_on_it_in_the_middle() -> None:
    cameras, points = put(ring(rolls=4.0), floor_and_things())
    found = upright(cameras, points)
    assert "level plane" in found.note
    change = found.motion()
    whole = change @ WORLD
    # the noise of 5 mm on 2000 points over 6 m tilts a plane by 0.004 degrees
    assert angle(whole[:3, :3] @ UP, UP) < 0.05
    heights = moved(points[:2000], change)[:, 1]
    assert abs(np.median(heights)) < 0.01 * 2.5  # within the noise of the floor, in this world's units
    assert np.linalg.norm(np.delete(moved(WORLD[:3, 3][None], change)[0], 1)) < 0.2  # what the cameras look at
    ahead = transform_camera(cameras[0], change).rotation[2]
    assert ahead[2] > 0.9  # the first camera looks along z
    assert abs(ahead[0]) < 1e-9
    assert np.allclose(change[:3, :3] @ change[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(change[:3, :3]) > 0


@pytest.mark.parametrize(
    ("rolls", "degrees", "decides"),
    [(0.0, 2.0, True), (0.0, 4.0, False), (6.0, 6.0, True), (6.0, 12.0, False), (20.0, 12.0, True), (20.0, 30, False)],
)
def test_rolled_cameras_yield_to_the_plane_but_not_to_a_slope(rolls: float, degrees: float, decides: bool) -> None:
    """A plane decides within twice the median roll of the cameras, or within 3 degrees, but not beyond 15 degrees.

    A slope beneath cameras that are held level is no floor. The median roll of these cameras is 0.6 times `rolls`.
    """
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    cameras = ring(rolls)
    found = upright(cameras, moved(floor_and_things()[:2000], turn))
    assert ("level plane" if decides else "no plane") in found.note
    if decides:
        assert angle(found.up, UP) == pytest.approx(degrees, abs=0.1)
    else:
        assert angle(found.up, up_axis(cameras)) < 1e-6


def test_cameras_on_one_side_do_not_tell_how_level_they_are_held() -> None:
    """They may all look down by the same angle, so that the plane decides."""
    places = np.stack([np.linspace(-1, 1, 9), np.full(9, -1.5), np.full(9, -4.0)], axis=1)
    down = np.array([0.0, np.sin(np.deg2rad(12)), np.cos(np.deg2rad(12))])
    cameras = [camera_at(place, place + down) for place in places]
    assert median_roll(cameras) is None
    found = upright(cameras, floor_and_things()[:2000])
    assert "level plane" in found.note
    assert angle(found.up, UP) < 0.1


def test_a_wall_without_a_floor_leaves_up_to_the_cameras() -> None:
    rng = np.random.default_rng(1)
    wall = np.stack([rng.uniform(-3, 3, 3000), rng.uniform(-3, 0, 3000), rng.normal(0, 0.01, 3000)], axis=1)
    places = np.stack([np.linspace(-3, 3, 9), np.full(9, -1.5), np.full(9, -5.0)], axis=1)
    cameras, points = put([camera_at(place, place + np.array([0, 0, 5])) for place in places], wall)
    found = upright(cameras, points)
    assert found.plane is None
    assert "cameras' up direction, as no plane within 15 degrees" in found.note
    assert angle(found.up, WORLD[:3, :3] @ UP) < 1e-4


def survey(headings: tuple[float, ...] = (0.0, 180.0)) -> tuple[list[Camera], Float64]:
    """Cameras of a drone that look straight down on bumpy ground, with the headings of its flight lines in degrees."""
    rng = np.random.default_rng(2)
    ground = np.stack([rng.uniform(-60, 60, 4000), rng.normal(0, 0.3, 4000), rng.uniform(-60, 60, 4000)], axis=1)
    cameras = []
    for line, z in enumerate(np.linspace(-40, 40, 4)):
        heading = np.deg2rad(headings[line % len(headings)])
        ahead = np.array([np.sin(heading), 0.0, np.cos(heading)])
        for x in np.linspace(-40, 40, 4):
            place = np.array([x, -50.0, z])
            cameras.append(camera_at(place, place + (0, 50, 0) + 2 * rng.normal(size=3) * (1, 0, 1), up=ahead))
    return cameras, ground


def test_a_drone_that_turns_around_looks_down() -> None:
    cameras, points = put(*survey())
    assert looks_down(cameras)
    assert not looks_down(put(ring(), points)[0])
    found = upright(cameras, points)
    assert "look down" in found.note
    assert angle(found.up, WORLD[:3, :3] @ UP) < 0.3  # bumps of 0.3 m over 120 m
    assert np.median(moved(points, found.motion())[:, 1]) == pytest.approx(0, abs=2.5 * 0.5)
    assert all(transform_camera(camera, found.motion()).position[1] < 0 for camera in cameras)
    # without points, the view directions alone
    assert angle(upright(cameras, np.empty((0, 3))).up, WORLD[:3, :3] @ UP) < 5


def gps(cameras: list[Camera], error: float = 0.0, vertical: float = 0.0) -> dict[str, GpsPosition]:
    """GPS positions of cameras in an upright world in metres, with x east and z north, near 48 N 11 E."""
    import pycolmap

    rng = np.random.default_rng(3)
    places = np.stack([camera.position for camera in cameras])
    enu = np.stack([places[:, 0], places[:, 2], -places[:, 1]], axis=1) + rng.normal(size=places.shape) * (
        error, error, vertical
    )  # fmt: skip
    globe = pycolmap.GPSTransform().enu_to_ellipsoid(enu, 48.0, 11.0, 500.0)
    return {name: GpsPosition(*(float(value) for value in row)) for name, row in zip(NAMES, globe, strict=True)}


def named(cameras: list[Camera]) -> dict[str, Camera]:
    return dict(zip(NAMES, cameras, strict=True))


def test_gps_gives_metres_north_and_the_place_of_the_origin() -> None:
    true, ground = survey()
    cameras, _ = put(true, ground)
    up = WORLD[:3, :3] @ UP / 2.5
    fit = fit_map(named(cameras), gps(true, error=1.0, vertical=30.0), up)
    assert fit.metres == pytest.approx(1 / 2.5, rel=0.02)  # errors of 1 m over 40 m, 16 photographs: 0.9 %
    assert angle(fit.north, WORLD[:3, :3] @ (0.0, 0.0, 1.0)) < 1.5
    assert fit.residual == pytest.approx(2**0.5, rel=0.5)
    assert not fit.doubtful
    exact = fit_map(named(cameras), gps(true), up)
    assert exact.metres == pytest.approx(1 / 2.5, rel=1e-6)  # the earth is round: 80 m are 1e-9 of its square
    places = {name: camera.position for name, camera in named(true).items()}
    assert globe_position(exact, gps(true), places) == pytest.approx((48.0, 11.0, 500.0), abs=1e-3)


def test_gps_that_is_a_kilometre_off_is_named_and_not_believed() -> None:
    true, ground = survey()
    cameras, _ = put(true, ground)
    positions = gps(true, error=1.0)
    for index in (2, 7, 11):
        at = positions[NAMES[index]]
        positions[NAMES[index]] = replace(at, latitude=at.latitude + 0.009)  # a kilometre to the north
    fit = fit_map(named(cameras), positions, WORLD[:3, :3] @ UP / 2.5)
    assert fit.metres == pytest.approx(1 / 2.5, rel=0.02)
    assert sorted(fit.doubtful) == [NAMES[index] for index in (2, 7, 11)]
    assert all(990 < metres < 1010 for metres in fit.doubtful.values())
    assert "3 photograph(s)" in fit.doubt
    assert NAMES[7] in fit.doubt


def test_up_from_gps_only_of_a_wide_flight_with_good_altitudes() -> None:
    true, ground = survey(headings=(0.0,))
    cameras, _ = put(true, ground)
    assert not looks_down(cameras)  # photographs of a wall would be the same
    found = up_from_gps(named(cameras), gps(true, error=0.5, vertical=0.5))
    assert found is not None
    assert angle(found.up, WORLD[:3, :3] @ UP) < 1.0
    level = upright(cameras, moved(ground, WORLD), found)
    assert angle(level.up, WORLD[:3, :3] @ UP) < 1.0
    assert "GPS" in level.note
    assert up_from_gps(named(cameras), gps(true, error=0.5, vertical=20.0)) is None
    assert up_from_gps(named(cameras[:2] + cameras[2:]), {}) is None


def test_gps_that_says_nothing_is_refused() -> None:
    true, _ = survey()
    cameras, up = named(true), UP
    refuses("2 of 16 photographs have a GPS position", fit_map, cameras, dict(list(gps(true).items())[:2]), up)
    small = named([transform_camera(camera, scaling(0.02)) for camera in true])  # a table, with the errors of a phone
    refuses("and a spread of several times the error", fit_map, small, gps(list(small.values()), error=5.0), up)
    same = {name: GpsPosition(48.0, 11.0, 500.0) for name in NAMES}
    refuses("give a known length instead", fit_map, cameras, same, up)


def test_gravity_decides_where_the_photographs_agree() -> None:
    cameras, points = put(ring(rolls=8.0), floor_and_things())
    true = -WORLD[:3, :3] @ UP / 2.5
    down = {name: camera.rotation @ true for name, camera in named(cameras).items()}
    found = up_from_gravity(named(cameras), down)
    assert found is not None
    assert angle(found.up, -true) < 1e-4
    assert "gravity in the metadata of 16 photographs" in upright(cameras, points, found).note
    assert up_from_gravity(named(cameras), dict(list(down.items())[:2])) is None
    wrong = {name: np.array([0.0, 1.0, 0.0])[[(i + 1) % 3, i % 3, (i + 2) % 3]] for i, name in enumerate(NAMES)}
    assert up_from_gravity(named(cameras), wrong) is None


def test_panoramas_and_cameras_that_look_outwards_have_a_middle() -> None:
    pano = [
        Camera(80, 40, 1.0, 1.0, 40.0, 20.0, np.eye(3), -place, projection="equirectangular")
        for place in np.array([(0.0, -1.6, 0.0), (1.0, -1.6, 0.0), (0.0, -1.6, 1.0), (1.0, -1.6, 1.0)])
    ]
    outwards = [camera_at(camera.position * 0.01, camera.position) for camera in ring()]
    for cameras in (pano, outwards):
        found = upright(*put(cameras, floor_and_things()))
        assert angle(found.up, WORLD[:3, :3] @ UP) < 0.1
        assert np.isfinite(found.motion()).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_cameras_are_refused(count: int) -> None:
    refuses(rf"{count} camera\(s\) .* at least 3", upright, ring()[:count], floor_and_things())


@pytest.mark.parametrize("count", [0, 1, MIN_PLANE_POINTS - 1])
def test_few_points_are_no_plane(count: int) -> None:
    assert level_plane(floor_and_things()[:count], UP, 0.3, 4.0) is None
    found = upright(ring(), floor_and_things()[:count])
    assert angle(found.up, UP) < 1e-4


def test_points_in_a_line_or_in_one_place_are_no_plane() -> None:
    line = np.outer(np.linspace(-1, 1, 200), (1.0, 0.0, 0.3))
    assert level_plane(line, UP, 0.3, 4.0) is None
    assert level_plane(np.zeros((200, 3)), UP, 0.3, 4.0) is None


def test_the_ground_is_below_the_table() -> None:
    rng = np.random.default_rng(4)
    table, floor = rng.normal(1.0, 0.003, 3000), rng.normal(0.0, 0.003, 1500)
    strays = rng.uniform(-3, 3, 30)
    assert ground_height(np.concatenate([table, floor, strays]), 2.0, 4.0) == pytest.approx(0.0, abs=0.01)
    assert ground_height(np.concatenate([floor, rng.normal(5, 0.003, 9000)]), 2.0, 4.0) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("", None),
        ("gps", ScaleRule("gps")),
        ("a.jpg,b.jpg=1.25", ScaleRule("photographs", 1.25, names="a.jpg,b.jpg")),
        ("a=b.jpg,c.jpg=2", ScaleRule("photographs", 2.0, names="a=b.jpg,c.jpg")),
        ("1,2,3,4,5,6e0=0.5", ScaleRule("points", 0.5, (1, 2, 3, 4, 5, 6))),
    ],
)
def test_values_of_scale(text: str, rule: ScaleRule | None) -> None:
    assert parse_scale(text) == rule


WRONG = ("2", "=2", "a.jpg=2", "a,b", "a,b=x", "a,b=0", "a,b=-1", "a,b=inf", "a,b=nan", "1,2,3,4=2", "1,2,3,4,5,inf=2")


@pytest.mark.parametrize("text", [*WRONG, "GPS"])
def test_wrong_values_of_scale_are_refused(text: str) -> None:
    refuses(f"--scale {text}: ", parse_scale, text)
    refuses(f"--scale {text}: ", FrameUse(scale=text).check)


def test_known_lengths() -> None:
    cameras = named(ring())
    length = float(np.linalg.norm(cameras[NAMES[0]].position - cameras[NAMES[3]].position))
    for names in (f"{NAMES[0]},{NAMES[3]}", f" photo_00 , {NAMES[3]}"):
        assert metres_per_unit(ScaleRule("photographs", 3.0, names=names), cameras) == pytest.approx(3 / length)
    odd = {"left, 1/a.jpg": cameras[NAMES[0]], "left, 1/b,c.jpg": cameras[NAMES[3]]}
    found = metres_per_unit(ScaleRule("photographs", 3.0, names="left, 1/a.jpg,b,c.jpg"), odd)
    assert found == pytest.approx(3 / length)
    converted = {"in/a.heic.jpg": cameras[NAMES[0]], "in/b.dng.png": cameras[NAMES[3]], "in/b.c.jpg": cameras[NAMES[5]]}
    for names in ("in/a.heic,b.dng", "a,b.dng.png", "a.heic.jpg,in/b.dng"):
        assert metres_per_unit(ScaleRule("photographs", 3.0, names=names), converted) == pytest.approx(3 / length)
    refuses("no photograph b;", metres_per_unit, ScaleRule("photographs", 3.0, names="a,b"), converted)  # of two
    assert metres_per_unit(ScaleRule("points", 5.0, (0, 0, 0, 0, 3, 4)), {}) == 1
    for names, match in (
        (f"{NAMES[0]},photo_17.jpg", "no photograph photo_17.jpg; did you mean photo_1"),
        (f"{NAMES[0]},{NAMES[0]}", "named twice"),
        ("x,y", "no photograph x and no y; its photographs have names such as photo_00.jpg, photo_01.jpg"),
    ):
        refuses(match, metres_per_unit, ScaleRule("photographs", 1.0, names=names), cameras)
    twins = {"a.jpg": cameras[NAMES[0]], "b.jpg": cameras[NAMES[0]]}
    rule = ScaleRule("photographs", 1.0, names="a.jpg,b.jpg")
    refuses("the cameras of a.jpg and b.jpg are in the same place", metres_per_unit, rule, twins)
    refuses("the two points are in the same place", metres_per_unit, ScaleRule("points", 1.0, (1, 2, 3, 1, 2, 3)), {})
