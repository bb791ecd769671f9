# SPDX-License-Identifier: Apache-2.0
"""Axes of the ground, and where the up direction comes from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.blocks.planning.ground import axes_of_ground, ground_of, on_ground, parse_up
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.scenes.dataset import SceneFrame
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.scene import Scene


@pytest.fixture(scope="module")
def scene(small_scene: Path) -> Scene:
    return load_scene_of(TrainConfig(), small_scene)


def test_the_axes_of_upright_worlds_are_two_of_their_own() -> None:
    assert axes_of_ground((0.0, -1.0, 0.0)) == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert axes_of_ground((0.0, 0.0, 1.0)) == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    assert axes_of_ground((2.0, 0.0, 0.0)) == ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def test_the_axes_are_orthonormal_and_seen_from_above_anticlockwise() -> None:
    rng = np.random.default_rng(5)
    for scale in (1e-200, 1.0, 1e200):
        for up in rng.normal(size=(50, 3)):
            first, second = np.array(axes_of_ground(tuple(scale * up)))
            unit = up / np.linalg.norm(up)
            frame = np.stack([first, second, unit])
            # some roundings of each component, which is at most 1
            assert np.abs(frame @ frame.T - np.eye(3)).max() < 1e-14
            assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-14)


def test_coordinates_are_dot_products_with_the_axes() -> None:
    points = np.random.default_rng(1).normal(size=(20, 3))
    axes = axes_of_ground((0.1, 0.2, -0.9))
    # three products and two sums of numbers of about 1
    assert np.abs(on_ground(points, axes) - points @ np.array(axes).T).max() < 1e-14


def test_up_is_given_or_the_frames_or_estimated(scene: Scene) -> None:
    given = ground_of(scene, (0.0, 0.0, 3.0))
    assert given.up == (0.0, 0.0, 1.0) and given.note == "up is from --up"
    upright = ground_of(replace(scene, frame=SceneFrame(upright=True)), None)
    assert upright.up == (0.0, -1.0, 0.0)
    # the cameras of this scene stand on an arc around the y axis, which points down in their pictures
    found = ground_of(scene, None)
    assert found.up == pytest.approx((0.0, -1.0, 0.0), abs=0.02)
    assert "up is from" in found.note
    assert ground_of(scene, None) == found


def test_too_few_cameras_do_not_tell_up(scene: Scene) -> None:
    few = replace(scene, views=scene.views[:2])
    with pytest.raises(InputError, match=r"2 camera.* do not tell which way is up, expected at least 3, or --up X,Y,Z"):
        ground_of(few, None)
    assert ground_of(few, (0.0, -1.0, 0.0)).up == (0.0, -1.0, 0.0)


@pytest.mark.parametrize("text", ["", "1,2", "0,0,0", "a,b,c", "nan,0,1", "0,inf,0", "1,2,3,4"])
def test_a_wrong_up_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--up .*expected three numbers X,Y,Z"):
        parse_up(text)


def test_up_is_parsed() -> None:
    assert parse_up("0,-1,0.5") == (0.0, -1.0, 0.5)
