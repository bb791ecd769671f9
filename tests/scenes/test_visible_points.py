# SPDX-License-Identifier: Apache-2.0
"""Exposures of photographs beside each other, from the points that several of them show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_photo_findings import changed, made

from clsplat.scenes.analysis.visible_points import MIN_POINTS_PER_VIEW, VisiblePoints, relative_exposures
from clsplat.scenes.scene import Scene


def observed(views: int, points: int, shown: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Points, views and the exposures (V, 3) and colours (P, 3) that make up the logs, of pairs that are shown."""
    rng = np.random.default_rng(seed)
    exposures, colors = rng.uniform(-1, 1, (views, 3)), rng.uniform(-3, 0, (points, 3))
    which, where = np.nonzero(rng.random((points, views)) < shown)
    return which, where, exposures, colors


def test_exposures_are_found_whatever_colours_the_points_have() -> None:
    points, views, exposures, colors = observed(30, 400, 0.3)
    found = relative_exposures(points, views, exposures[views] + colors[points])
    # of exact numbers, but for the ridge
    np.testing.assert_allclose(found - found.mean(axis=0), exposures - exposures.mean(axis=0), atol=1e-6)


def test_a_fifth_that_is_something_else_hardly_moves_them() -> None:
    points, views, exposures, colors = observed(30, 400, 0.3)
    logs = exposures[views] + colors[points]
    rng = np.random.default_rng(1)
    wrong = rng.random(len(logs)) < 0.2
    logs[wrong] += rng.uniform(0.5, 2.0, (wrong.sum(), 3))
    found = relative_exposures(points, views, logs)
    apart = np.abs(found - found.mean(axis=0) - exposures + exposures.mean(axis=0))
    assert apart.max() < 0.02  # a mean of the logs is off by 0.2 * 1.25 * what shares differ, 0.1


def test_groups_that_share_no_point_have_a_mean_of_their_own() -> None:
    points, views, exposures, colors = observed(20, 400, 0.5)
    apart = (points < 200) == (views < 10)
    points, views = points[apart], views[apart]
    found = relative_exposures(points, views, exposures[views] + colors[points])
    for group in (slice(0, 10), slice(10, 20)):
        differences = found[group] - exposures[group]
        np.testing.assert_allclose(differences - differences.mean(axis=0), 0, atol=1e-6)
        assert np.abs(found[group].mean(axis=0)).max() < 0.05  # by weights it is 0


def spread(scene: Scene, gains: np.ndarray) -> np.ndarray:
    """Exposures that are told of the scene with gains on its photographs, which do not clip."""
    for index, gain in enumerate(gains):
        changed(scene, index, pixels=scene.thumbnails[scene.views[index].name].pixels * np.float32(gain))
    told = VisiblePoints(scene).exposures
    return np.array([told[view.name] for view in scene.views])


def test_gains_on_photographs_are_told_from_them_alone() -> None:
    gains = 2 ** np.random.default_rng(3).uniform(-1, 1, 24)
    found, own = spread(made(24), gains), spread(made(24), np.ones(24))
    apart = found - own - np.log2(gains)[:, None]
    # Pixels that are too bright to tell of a photograph without gains do so with them.
    assert np.abs(apart - apart.mean(axis=0)).max() < 0.1
    assert np.abs(apart - apart.mean(axis=0)).mean() < 0.01
    grey = replace(made(24), point_colors=np.full((6000, 3), 0.5, np.float32))
    grey.__dict__["thumbnails"] = made(24).thumbnails
    assert np.array_equal(spread(grey, gains), found)


def test_a_dark_photograph_keeps_its_dark_points() -> None:
    """Many points are of 0.012 to 0.03; without the darkest of them the photograph would seem brighter than it is."""
    gains = np.tile([0.5, 1.0], 12)
    dark = [made(24), made(24)]
    for scene in dark:
        for index, view in enumerate(scene.views):
            pixels = scene.thumbnails[view.name].pixels
            changed(scene, index, pixels=np.where(pixels < 0.5, pixels * np.float32(0.06), pixels))
    apart = spread(dark[0], gains) - spread(dark[1], np.ones(24)) - np.log2(gains)[:, None]
    assert np.abs(apart - apart.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("count", [0, MIN_POINTS_PER_VIEW - 1])
def test_few_points_tell_nothing(count: int) -> None:
    """And no photograph is looked at, of which there is no file here."""
    scene = made(24)
    few = replace(scene, points=scene.points[:count], point_colors=scene.point_colors[:count])
    assert "thumbnails" not in few.__dict__
    assert VisiblePoints(few).exposures == {}
