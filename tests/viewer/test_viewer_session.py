# SPDX-License-Identifier: Apache-2.0
"""The viewer's policy: cameras, what is shown when, how a model is looked at, recorded paths. No device, no browser."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses
from looking import ZERO, pose
from models import assert_equal, random_gaussians
from splats import opacity
from systems import links
from tiny import cameras

from clsplat.images.writing import steps_of
from clsplat.rotations import quaternion_of
from clsplat.shots import choose_shot
from clsplat.shots.viewpoints import extent_of
from clsplat.viewer.appearance import (
    MAX_EDITED_OPACITY,
    VIRIDIS_RGB,
    Look,
    alpha_picture,
    colour_picture,
    count_picture,
    depth_picture,
    edited,
    read_look,
)
from clsplat.viewer.path_recorder import MAX_KEY_FRAMES, add_key, path_document, save_path
from clsplat.viewer.pose import MAX_START_FOV_Y_RADIANS, Pose, fitted, looking, read_pose, start_of
from clsplat.viewer.refinement import (
    FIRST_SETTLE_SECONDS,
    MAX_UNPREPARED_EXACT_SECONDS,
    MIN_MOTION_SCALE,
    MOTION_PICTURE_SECONDS,
    SETTLE_SECONDS_RANGE,
    Level,
    Refinement,
    Share,
    next_scale,
)

TURN = np.array([0.5, -0.5, 0.5, 0.5])
"""A rotation by 120 degrees: w x y z."""


# cameras


def test_a_browsers_camera_is_ours() -> None:
    origin = np.array([1e6, -2e6, 30.0])
    found = read_pose(2 * TURN, (1.0, 2.0, 3.0), math.radians(60), (800, 600), origin)
    camera = found.camera()
    assert (camera.width, camera.height, camera.cx, camera.cy) == (800, 600, 400, 300)
    assert camera.fx == camera.fy == pytest.approx(300 / math.tan(math.radians(30)))
    # x y z -> y z x up to signs, by hand: R e_x = (2 (w^2 + x^2) - 1, 2 (xy + wz), 2 (xz - wy)) = (0, 0, -1)
    np.testing.assert_allclose(camera.rotation.T @ [1, 0, 0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(camera.rotation.T @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    # the position, that far out, to float64's rounding of 2e6, which multiplying by a rotation makes a few of
    np.testing.assert_allclose(camera.position, origin + np.array([1, 2, 3]), rtol=0, atol=2e-9)


def test_another_size_keeps_the_vertical_angle() -> None:
    wide, tall = pose().camera(1000, 500), pose().camera(100, 500)
    assert wide.fy == tall.fy == pytest.approx(250 / math.tan(0.5))
    assert (tall.cx, tall.cy) == (50, 250)


@pytest.mark.parametrize(
    "change",
    [
        *({"wxyz": (math.nan, 0, 0, 1)}, {"wxyz": (0, 0, 0, 0)}, {"wxyz": (1, 0, 0)}, {"wxyz": "1000"}),
        *({"position": (math.inf, 0, 0)}, {"position": (1e300, 0, 0)}, {"position": None}, {"fov": 0.0}),
        *({"fov": math.pi}, {"fov": math.nan}, {"fov": "wide"}, {"size": (0, 10)}, {"size": (1 << 20, 10)}),
        {"size": (math.inf, 10)},
    ],
)
def test_what_no_camera_has_is_left_out(change: dict[str, Any]) -> None:
    given: dict[str, Any] = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov": 1.0, "size": (10, 10)}
    assert read_pose(**given, origin=ZERO) is not None
    assert read_pose(**{**given, **change}, origin=ZERO) is None


def test_quaternions_go_there_and_back() -> None:
    found = read_pose(-TURN, (0, 0, 0), 1.0, (8, 8), ZERO)
    np.testing.assert_allclose(quaternion_of(found.rotation), TURN, atol=1e-12)


def test_the_start_is_where_the_first_camera_stands() -> None:
    start = start_of(cameras(), np.zeros((0, 3)))
    first = cameras()[0]
    page = looking(start, (first.width, first.height)).camera()
    np.testing.assert_allclose(page.position, first.position, atol=1e-12)
    np.testing.assert_allclose(page.rotation, first.rotation, atol=1e-9)  # the cameras of the scene are level
    assert page.fy == pytest.approx(first.fy)
    np.testing.assert_allclose(
        start.target, ZERO, atol=0.7
    )  # they look at the origin, some from above, some from below
    np.testing.assert_allclose(start.up, [0, -1, 0], atol=0.05)


@pytest.mark.parametrize("size", [(390, 844), (360, 640), (600, 800), (500, 501)])
def test_an_upright_page_shows_what_the_first_photograph_does(size: tuple[int, int]) -> None:
    """From side to side and more above and below: a corner of the photograph is on the page."""
    first = cameras()[0]
    assert first.width > first.height
    start = start_of(cameras(), np.zeros((0, 3)))
    page = looking(start, size).camera()
    across = [0.5 * each.width / each.fx for each in (page, first)]
    assert across[0] == pytest.approx(across[1])  # of the horizontal angle the tangent, to rounding
    assert page.height / page.fy > first.height / first.fy
    assert start.fov_on(first.width, first.height) == start.fov == start.fov_on(1920, 300)


def test_a_page_that_takes_the_start_late_gets_its_field_of_view_again() -> None:
    """And after each change of its size, unless it shows a camera that was clicked."""
    start = start_of(cameras(), np.zeros((0, 3)))
    fitted, turned = start.fov_on(390, 844), start.fov_on(844, 390)
    assert fitted > start.fov == turned
    assert start.misfits(start.fov, start.fov, 390, 844), "a new page"
    assert start.misfits(start.fov, fitted, 390, 844), "the start's own came after the fitted one"
    assert not start.misfits(fitted * (1 + 1e-9), fitted, 390, 844)
    assert start.misfits(fitted, fitted, 844, 390)
    assert not start.misfits(0.9 * fitted, fitted, 390, 844), "of a clicked camera"
    assert not start.misfits(start.fov, start.fov, 0, 844), "a page without a size yet"


def test_an_upright_page_shows_all_of_a_model_without_cameras() -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3))
    start = start_of([], points)
    for width, height in ((390, 844), (640, 480), (1, 3)):
        camera = looking(start, (width, height)).camera()
        seen = points @ camera.rotation.T + camera.translation
        pixels = seen[:, :2] / seen[:, 2:] * camera.fx
        inside = (abs(pixels[:, 0]) < width / 2) & (abs(pixels[:, 1]) < height / 2) & (seen[:, 2] > 0)
        assert inside.mean() > (0.95 if height < 3 * width else 0.8), (width, height)
    assert start.fov_on(1, 1000) == MAX_START_FOV_Y_RADIANS


def test_a_picture_of_an_upright_page_is_no_wider_than_the_page() -> None:
    """The angle across the page is that across a square, and that down a wider picture."""
    upright = replace(pose(size=(300, 600)), fov=2 * math.atan(1.2))
    sizes = {(300, 600): 1.2, (600, 600): 0.6, (1280, 720): 0.6, (400, 600): 0.9, (9, 90): 1.2}
    for (width, height), down in sizes.items():
        camera = upright.camera(width, height)
        assert 0.5 * height / camera.fy == pytest.approx(down)
        document = json.loads(path_document([upright], (width, height)))
        assert math.tan(math.radians(document["keys"][0]["fov_y"]) / 2) == pytest.approx(down)


def test_without_cameras_the_start_is_before_the_points() -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3)) + np.array([7.0, 0.0, 0.0])
    points[0] = 1e6
    start = start_of([], points)
    camera = looking(start, (640, 480)).camera()
    seen = points[1:] @ camera.rotation.T + camera.translation
    pixels = seen[:, :2] / seen[:, 2:] * camera.fx
    assert np.mean((abs(pixels[:, 0]) < 320) & (abs(pixels[:, 1]) < 240) & (seen[:, 2] > 0)) > 0.95
    np.testing.assert_array_equal(camera.rotation, np.eye(3))  # y down, along z, as COLMAP's
    assert np.isfinite(looking(start_of([], np.zeros((0, 3))), (8, 8)).camera().translation).all()
    assert np.isfinite(looking(start_of([], np.ones((1, 3))), (8, 8)).camera().translation).all()


def test_extent_leaves_strays_out() -> None:
    points = np.linspace(0, 1, 1001)[:, None].repeat(3, axis=1)
    points[7] = 1e9
    low, high = extent_of(points)
    np.testing.assert_allclose(low, 0.02, atol=2e-3)
    np.testing.assert_allclose(high, 0.98, atol=2e-3)


def test_fitted_sizes() -> None:
    assert fitted(640, 360, 0.5) == (320, 180)
    assert fitted(3, 1, 0.01) == (1, 1)
    width, height = fitted(8000, 4000, 1.0, 2_000_000)
    assert (width, height) == (2000, 1000)


# refinement


def shown(refinement: Refinement, level: Level, seconds: float, now: float, model: int = 0) -> None:
    refinement.shown(refinement.changes, level, seconds, now, model)


def test_coarse_in_motion_exact_at_rest() -> None:
    refinement = Refinement(0.0)
    refinement.changed(1.0)
    level = refinement.due(1.0)
    assert level is not None and not level.exact and level.scale < 1
    shown(refinement, level, 0.05, 1.05)
    assert refinement.due(1.1) is None
    assert refinement.wait(1.1) == pytest.approx(SETTLE_SECONDS_RANGE[0] - 0.1)
    assert refinement.due(1.0 + SETTLE_SECONDS_RANGE[0]) == Level(1.0, exact=True)
    assert refinement.wait(1.0 + SETTLE_SECONDS_RANGE[0]) == 0
    shown(refinement, Level(1.0, exact=True), 0.3, 1.5)
    assert refinement.due(100.0) is None
    assert refinement.wait(100.0) is None
    refinement.changed(100.0)
    moving = refinement.due(100.0)
    assert moving is not None and not moving.exact
    assert moving.quality < level.quality + 1 <= Level(1.0, exact=True).quality


def test_a_camera_that_jumps_is_not_at_rest_between_two_jumps() -> None:
    refinement, now = Refinement(0.0), 0.0
    for _ in range(20):
        now += 0.3
        refinement.changed(now)
        shown(refinement, Level(0.25, exact=False), 0.01, now)
    assert refinement.due(now + 0.5) is None
    assert refinement.due(now + SETTLE_SECONDS_RANGE[1]) == Level(1.0, exact=True)
    for _ in range(20):
        now += 0.02
        refinement.changed(now)
        shown(refinement, Level(0.25, exact=False), 0.01, now)
    assert refinement.due(now + SETTLE_SECONDS_RANGE[0]) == Level(1.0, exact=True)


def test_the_first_exact_picture_leaves_the_browser_some_time() -> None:
    refinement = Refinement(0.0)
    shown(refinement, Level(0.25, exact=False), 0.01, 0.0)
    assert refinement.due(FIRST_SETTLE_SECONDS - 0.01) is None
    assert refinement.due(FIRST_SETTLE_SECONDS) == Level(1.0, exact=True)


def test_what_changes_while_a_picture_is_made_is_shown_next() -> None:
    refinement = Refinement(0.0)
    begun, level = refinement.changes, refinement.due(0.0)
    assert level is not None
    refinement.changed(0.02)
    refinement.shown(begun, level, 0.05, 0.05)
    again = refinement.due(0.05)
    assert again is not None and not again.exact
    assert refinement.moving


def test_a_slow_exact_picture_is_led_up_to() -> None:
    refinement = Refinement(0.0)
    refinement.scale = 0.2
    shown(refinement, Level(0.2, exact=False), 2 * MAX_UNPREPARED_EXACT_SECONDS, 0.0)
    refinement.changed(0.0)
    shown(refinement, Level(0.2, exact=False), 2 * MAX_UNPREPARED_EXACT_SECONDS, 0.0)
    seen = []
    while (level := refinement.due(10.0)) is not None:
        seen.append(level)
        shown(refinement, level, 2 * MAX_UNPREPARED_EXACT_SECONDS, 10.0)
    assert seen == [Level(0.4, exact=False), Level(0.8, exact=False), Level(1.0, exact=True)]


def test_a_model_in_training_is_shown_again() -> None:
    refinement = Refinement(0.0)
    shown(refinement, Level(0.25, exact=False), 0.01, 0.0, model=3)
    shown(refinement, Level(1.0, exact=True), 0.01, 1.0, model=3)
    assert refinement.due(2.0, model=3) is None
    assert refinement.due(2.0, model=4) == Level(1.0, exact=True)
    assert not refinement.moving


@pytest.mark.parametrize("fixed", [0.0, 0.01])
def test_the_pace_finds_the_size_that_takes_the_time(fixed: float) -> None:
    scale = Refinement(0.0).scale
    for _ in range(40):
        scale = next_scale(scale, fixed + 0.4 * scale**2)
    assert fixed + 0.4 * scale**2 == pytest.approx(MOTION_PICTURE_SECONDS, rel=0.05)


def test_the_pace_stays_in_its_range() -> None:
    scale = Refinement(0.0).scale
    for _ in range(50):
        scale = next_scale(scale, 10.0)
    assert scale == MIN_MOTION_SCALE
    for _ in range(50):
        scale = next_scale(scale, 0.0)
    assert scale == 1.0


def test_a_share_of_the_time() -> None:
    share = Share((0.2, 0.05))
    assert share.ready(0.0, moving=False)
    share.spent(10.0, 1.0)
    assert not share.ready(13.9, moving=True)
    assert share.ready(14.1, moving=True)
    assert not share.ready(28.9, moving=False)
    assert share.ready(29.1, moving=False)


# how a model is looked at


def test_looks_of_a_page_are_brought_into_range() -> None:
    assert read_look("depth", 2, 0.5, 2.0) == Look("depth", 2, 0.5, 2.0)
    assert read_look("../etc", 99, -1, math.nan) == Look("colour", 3, 0.05, 1.0)
    assert read_look("alpha", 0, 1, 1, [[3, 2, 1], [0, 5, 0]]).crop == (0, 2, 0, 3, 5, 1)
    assert read_look("alpha", 0, 1, 1, [[math.nan, 2, 1], [0, 5, 0]]).crop is None


def test_only_what_changes_the_model_is_another_model() -> None:
    assert Look("depth").changes(3) is None
    assert Look("colour", degree=3).changes(1) is None
    assert Look("depth", degree=1).changes(3) == Look("alpha", degree=1).changes(3)
    assert Look(size=0.5).changes(3) is not None


def test_edits() -> None:
    model = random_gaussians(500)
    model.origin = np.array([10.0, 20.0, 30.0])
    before = random_gaussians(500)
    plain = edited(model, Look())
    assert_equal(plain, model)
    assert plain.sh is model.sh

    assert edited(model, Look(degree=1)).sh.shape == (500, 4, 3)
    np.testing.assert_allclose(
        np.exp(edited(model, Look(size=0.5)).log_scales), np.exp(model.log_scales) / 2, rtol=1e-5
    )
    np.testing.assert_allclose(opacity(edited(model, Look(opacity=0.5))), opacity(model) / 2, rtol=1e-5)
    strong = edited(model, Look(opacity=3.0))
    assert np.isfinite(strong.opacity_logits).all()
    assert opacity(strong).max() == pytest.approx(MAX_EDITED_OPACITY, rel=1e-5)
    assert np.isfinite(edited(model, Look(opacity=0.0)).opacity_logits).all()

    half = edited(model, Look(crop=(10.0, -1e9, -1e9, 1e9, 1e9, 1e9)))
    assert 150 < len(half) < 350
    assert (half.means[:, 0] >= 0).all()
    half.check()
    assert len(edited(model, Look(crop=(0, 0, 0, 1, 1, 1)))) == 0
    assert_equal(model, before)


def test_colours_are_rounded_as_in_a_png() -> None:
    """Next to half steps float32 and float64 differ."""
    halves = np.float32((np.arange(255) + 0.5) / 255)
    values = np.concatenate([np.nextafter(halves, np.float32(side)) for side in (0, 1)] + [halves])
    image = np.repeat(values, 3).reshape(1, -1, 3)
    assert len(values) == 765
    np.testing.assert_array_equal(colour_picture(image), steps_of([image], 8))


def test_pictures() -> None:
    image = np.array([[[0.0, 0.5, 1.0], [np.nan, -1.0, 2.0]]], np.float32)
    assert colour_picture(image).tolist() == [[[0, 128, 255], [0, 0, 255]]]
    assert alpha_picture(np.array([[0.0, 1.0]], np.float32)).tolist() == [[[0, 0, 0], [255, 255, 255]]]

    depth, alpha = np.array([[1.0, 2.0, 3.0, 0.0]], np.float32), np.array([[1.0, 1.0, 1.0, 0.0]], np.float32)
    picture, text = depth_picture(depth, alpha)
    brightness = picture.sum(axis=2)[0]
    assert brightness[0] > brightness[1] > brightness[2] > brightness[3] == 0
    np.testing.assert_array_equal(picture[0, 0], VIRIDIS_RGB[-1])
    assert text == "depth 1.04 (bright) to 2.96"
    nothing, text = depth_picture(depth, np.zeros_like(alpha))
    assert (nothing == 0).all()
    assert text == "nothing is visible"

    counts, text = count_picture(np.array([[0, 5, 10]], np.int32))
    assert counts[0, 0].tolist() == VIRIDIS_RGB[0].tolist()
    assert counts[0, 2].tolist() == VIRIDIS_RGB[-1].tolist()
    assert text.endswith("maximum 10")
    assert count_picture(np.zeros((2, 2), np.int32))[0].shape == (2, 2, 3)


# paths


def recorded(*positions: float) -> list[Pose]:
    keys: list[Pose] = []
    for x in positions:
        add_key(keys, pose(x))
    return keys


def test_a_recorded_path_is_read_by_render(tmp_path: Path) -> None:
    path = save_path(tmp_path, path_document(recorded(0.0, 1.0, 3.0), (320, 200), apart=0.5, fps=24))
    shot = choose_shot(path, path=None, count=None)
    assert [frame.number for frame in shot.frames] == list(range(1, 26))
    for number, x in ((0, 0.0), (12, 1.0), (24, 3.0)):
        camera, wanted = shot.frames[number].camera, pose(x).camera(320, 200)
        np.testing.assert_allclose(camera.position, wanted.position, atol=1e-9)
        np.testing.assert_allclose(camera.rotation, wanted.rotation, atol=1e-9)
        assert (camera.width, camera.height, camera.fy) == (320, 200, pytest.approx(wanted.fy))


def test_a_recorded_key_is_seen_to_the_last_bit(tmp_path: Path) -> None:
    """The camera of a screenshot is that of the exported path at that key, also between others and far out."""
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(40):
        pose = read_pose(
            rng.normal(size=4), rng.normal(size=3), rng.uniform(0.2, 2), (801, 603), 1e5 * rng.normal(size=3)
        )
        assert pose is not None
        poses.append(pose)
    (tmp_path / "path.json").write_text(path_document(poses, (1280, 720), apart=0.5))
    shot = choose_shot(tmp_path / "path.json").only(",".join(str(1 + 12 * index) for index in range(40)))
    for pose, camera in zip(poses, shot.cameras, strict=True):
        wanted = pose.camera(1280, 720)
        for name in ("fx", "fy", "cx", "cy", "near"):
            assert getattr(camera, name) == getattr(wanted, name), name
        np.testing.assert_array_equal(camera.rotation, wanted.rotation)
        np.testing.assert_array_equal(camera.translation, wanted.translation)


def test_a_closed_loop_has_as_many_frames_as_a_turn(tmp_path: Path) -> None:
    keys = recorded(0.0, 1.0)
    path = save_path(tmp_path, path_document(keys, (32, 20), apart=1.0, fps=10, loop=True))
    assert len(choose_shot(path, path=None, count=None).frames) == 20
    assert "loop_frames" not in json.loads(path_document(recorded(0.0), (32, 20), loop=True))


def test_keys_are_taken_back() -> None:
    keys = recorded(0.0, 1.0)
    del keys[-1:]
    assert [key.position[0] for key in keys] == [0.0]
    keys.clear()
    del keys[-1:]
    refuses("no key frames", path_document, keys, (32, 20))


@pytest.mark.parametrize(
    ("size", "numbers"), [((0, 20), {}), ((1 << 20, 20), {}), ((32, 20), {"apart": math.nan}), ((32, 20), {"fps": 0.0})]
)
def test_numbers_that_make_no_path(size: tuple[int, int], numbers: dict[str, float]) -> None:
    refuses("expected", path_document, recorded(0.0), size, **numbers)


def test_too_many_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = recorded(0.0)
    keys *= MAX_KEY_FRAMES
    refuses("10,000", add_key, keys, pose())


@links
def test_saved_paths_replace_nothing(tmp_path: Path) -> None:
    (tmp_path / "path-002.json").symlink_to(tmp_path / "elsewhere")
    names = [save_path(tmp_path, "{}").name for _ in range(2)]
    assert names == ["path-001.json", "path-003.json"]
    assert not (tmp_path / "elsewhere").exists()
