# SPDX-License-Identifier: Apache-2.0
"""Chunks that culling leaves out, against every Gaussian in them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from stress_culling import BOXES, KINDS, Movements, by_kernels, compare
from tile_boxes import reach_a_tile

from clsplat.arrays import Bool
from clsplat.camera import Camera
from clsplat.chunks import culling
from clsplat.chunks.bounds import ChunkBounds
from clsplat.chunks.order import space_order
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import OptimiserConfig
from clsplat.device.context import Device

CAMERA = scenes.tilted_camera(640, 400)
RAYS = {
    "along rays": replace(CAMERA, by_rays=True),
    "fisheye": replace(CAMERA, fx=300.0, fy=310.0, projection="fisheye"),
    "bent fisheye": replace(CAMERA, fx=300.0, fy=310.0, projection="fisheye", radial=(0.05, -0.02, 0.0, 0.0)),
    "part of a panorama": replace(CAMERA, fx=400.0, fy=400.0, projection="equirectangular"),
}
CAMERAS = {"perspective": CAMERA, "orthographic": replace(CAMERA, fx=40.0, fy=44.0, projection="orthographic"), **RAYS}


def visible(bounds: ChunkBounds, camera: Camera, config: RasterizerConfig | None = None, factor: float = 1.0) -> Bool:
    return culling.visible(culling.PictureBorders.of(camera, config or RasterizerConfig(), factor), bounds)


def box(middle: np.ndarray, half: float, log_scale: float) -> ChunkBounds:
    """A cube around a point in the camera's axes of CAMERA."""
    world = np.linalg.inv(CAMERA.rotation) @ (np.asarray(middle, np.float64) - CAMERA.translation)
    return ChunkBounds.of_sides((world - half)[None], (world + half)[None], np.array([log_scale]))


@pytest.fixture(scope="module")
def movements() -> Movements:
    return Movements(np.random.default_rng(0), OptimiserConfig())


@pytest.mark.parametrize("kind", KINDS)
def test_no_gaussian_is_missed(kind: str, movements: Movements) -> None:
    """A sample of `tools/stress/run culling`; about half of the pairs have a Gaussian with a tile."""
    rng = np.random.default_rng(sum(kind.encode()))
    tallies = [compare(rng, kind, movements)[0] for _ in range(40)]
    assert sum(tally.missed for tally in tallies) == 0
    pairs, found = 40 * BOXES, sum(tally.found for tally in tallies)
    assert 0.1 * pairs < sum(tally.reached for tally in tallies) < found < 0.9 * pairs


def test_the_comparison_finds_a_reach_that_is_too_short(movements: Movements, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.chunks.culling._REACH_SLACK", 0.8)
    rng = np.random.default_rng(0)
    still = Movements(rng, OptimiserConfig(), [(0, 0)])
    assert sum(compare(rng, "orthographic", still)[0].missed for _ in range(40)) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_no_gaussian_is_missed_that_the_kernels_show(device: Device, movements: Movements, kind: str) -> None:
    rng = np.random.default_rng(sum(kind.encode()))
    tallies = [compare(rng, kind, movements, by_kernels(device))[0] for _ in range(10)]
    assert sum(tally.missed for tally in tallies) == 0
    assert sum(tally.reached for tally in tallies) > 10


@pytest.mark.parametrize("name", CAMERAS)
def test_a_box_far_outside_is_left_out(name: str) -> None:
    camera = CAMERAS[name]
    assert visible(box([0, 0, 5], 0.5, -3), camera).all()
    for middle in ([-200, 0, 5], [200, 0, 5], [0, -200, 5], [0, 200, 5], [-60, 60, 40]):
        assert not visible(box(middle, 0.5, -3), camera).any(), middle
        assert visible(box(middle, 0.5, 6), camera).all(), middle  # one that is large enough


@pytest.mark.parametrize("name", CAMERAS)
def test_near_and_far_plane(name: str) -> None:
    camera = replace(CAMERAS[name], near=2.0, far=10.0)
    assert visible(box([0, 0, 5], 1, -3), camera).all()
    assert not visible(box([0, 0, 0.5], 0.5, 5), camera).any()
    assert not visible(box([0, 0, 20], 1, 5), camera).any()
    assert visible(box([0, 0, 0.5], 2, -3), camera).all()


def test_a_whole_panorama_leaves_out_by_distance_alone() -> None:
    camera = replace(
        CAMERA,
        width=720,
        height=360,
        fx=720 / (2 * math.pi),
        fy=360 / math.pi,
        cx=360.0,
        cy=180.0,
        projection="equirectangular",
        far=50.0,
    )
    directions = np.random.default_rng(0).standard_normal((300, 3))
    directions *= 20 / np.linalg.norm(directions, axis=1, keepdims=True)
    assert all(visible(box(middle, 0.5, -3), camera).all() for middle in directions)
    assert not visible(box(directions[0] * 3, 0.5, -3), camera).any()


@pytest.mark.parametrize("name", CAMERAS)
def test_bounds_that_are_not_finite_are_visible(name: str) -> None:
    for bad in (np.nan, np.inf, -np.inf):
        for part in range(3):
            sides = [box([0, 0, -500], 1, -3).lowest, box([0, 0, -500], 1, -3).highest, np.array([-3.0])]
            sides[part] = np.full_like(sides[part], bad)
            assert visible(ChunkBounds.of_sides(*sides), CAMERAS[name]).all()


def test_a_model_without_chunks() -> None:
    assert visible(ChunkBounds.of_sides(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), CAMERA).shape == (0,)


def test_the_rasterizer_s_settings_count() -> None:
    """A Gaussian's end at 1/255 of a larger opacity, at a smaller alpha, and in the square of the tile test."""
    border = [-640 * 0.42 / CAMERA.fx * 5, 0, 5.0]  # at the left border

    def shows(offset: float, config: RasterizerConfig, factor: float = 1.0) -> bool:
        middle = [border[0] - offset, border[1], border[2]]
        return bool(visible(box(middle, 1e-6, math.log(0.1)), CAMERA, config, factor)[0])

    plain, reach = (
        RasterizerConfig(),
        math.sqrt(2 * math.log(255)) * (0.1 * math.hypot(1, 0.57) + math.sqrt(0.3) * 5 / CAMERA.fx),
    )
    assert shows(0.99 * reach, plain) and not shows(1.1 * reach, plain)
    assert shows(1.1 * reach, plain, 10.0)
    assert shows(1.04 * reach, RasterizerConfig(alpha_min=1e-3))
    assert not shows(0.98 * reach, RasterizerConfig(extent="3sigma"))
    assert shows(1.3 * reach, BenchSwitches(tile_test="square"))
    assert shows(100.0, BenchSwitches(frustum_cull=False))


def test_few_chunks_of_a_town_are_left_in_without_need() -> None:
    """A made-up town: a ground of 400 m and 300 houses. At most a fifth more chunks are visible than have a tile.

    The chunks are 40 m wide here. Of smaller ones, fewer reach over a border of the picture by their boxes alone."""
    rng = np.random.default_rng(5)
    ground = np.concatenate([rng.uniform(-200, 200, (40_000, 2)), rng.normal(0, 0.05, (40_000, 1))], axis=1)
    houses = np.repeat(np.column_stack([rng.uniform(-200, 200, (300, 2)), np.zeros(300)]), 200, axis=0)
    houses += rng.uniform([-5, -5, 0], [5, 5, 10], houses.shape)
    means = np.concatenate([ground, houses]).astype(np.float32)
    means = means[space_order(means)]
    scales = np.log(rng.uniform(0.02, 0.3, means.shape)).astype(np.float32)
    bounds = ChunkBounds.measured(means, scales)
    kept, needed = 0, 0
    for _ in range(6):
        angle, (x, y) = rng.uniform(0, 2 * np.pi), rng.uniform(-150, 150, 2)
        right, ahead = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), -0.3])
        ahead /= np.linalg.norm(ahead)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        camera = Camera(640, 400, 500.0, 500.0, 320.0, 200.0, rotation, -rotation @ [x, y, rng.uniform(2, 60)])
        quaternions = np.tile([1.0, 0, 0, 0], (len(means), 1))
        rows = reach_a_tile(
            means.astype(np.float64), quaternions, scales.astype(np.float64), np.full(len(means), 2.0), camera
        )
        exact, found = np.logical_or.reduceat(rows, np.arange(0, len(rows), 1024)), visible(bounds, camera)
        assert not (exact & ~found).any()
        kept, needed = kept + int(found.sum()), needed + int(exact.sum())
    assert needed < 0.5 * 6 * len(bounds)
    assert kept < 1.2 * needed, f"{kept} of {6 * len(bounds)}, {needed} needed"
