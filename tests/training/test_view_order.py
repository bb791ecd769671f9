# SPDX-License-Identifier: Apache-2.0
"""Order of the training views: a permutation in each pass, random or through clusters of near views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, refuses, rejected
from compare import assert_same_arrays
from numpy.typing import NDArray
from same_bytes import PLAIN, outcome, scene_for, stopped, write_known_scene
from tiny import short, write_scene

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.runs.run import Run
from clsplat.runs.settings import config_text, parse_config
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.step import view_order
from clsplat.training.step.view_order import CLUSTER_VIEWS, CLUSTERS_AT_ONCE, ViewOrder
from clsplat.training.trainer import Trainer

COUNTS = (1, 2, CLUSTER_VIEWS, CLUSTER_VIEWS + 1, 33, 210, 1001)
NEAR = replace(PLAIN, view_order="near")
SETTINGS = {
    "near": NEAR,
    "batch": replace(NEAR, batch=3, background="random"),
    "masks": replace(NEAR, masks="ignore", thinning=0.3),
}


def looking(position: Sequence[float] | NDArray[np.float64], heading: float = 0.0) -> Camera:
    """A camera that looks horizontally, `heading` radians from +z to +x."""
    sine, cosine = np.sin(heading), np.cos(heading)
    rotation = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    return Camera(8, 8, 8.0, 8.0, 4.0, 4.0, rotation, -rotation @ np.asarray(position))


def scattered(count: int, *, scale: float = 1.0, shift: Sequence[float] = (0, 0, 0)) -> list[Camera]:
    """Cameras at random places and headings; every other one is on a grid, where many coordinates are equal."""
    rng = np.random.default_rng(count)
    places, headings = rng.uniform(-2, 2, (count, 3)), rng.uniform(-3, 3, count)
    places[::2], headings[::2] = np.round(2 * places[::2]) / 2, np.pi / 2 * np.round(headings[::2])
    return [looking(place * scale + shift, heading) for place, heading in zip(places, headings, strict=True)]


def clusters(cameras: list[Camera], unit: float = 1.0) -> list[list[int]]:
    found = ViewOrder(cameras, unit, near=True).clusters
    assert found is not None
    return sorted(list(map(int, views)) for views in found)


def homes_of(order: list[int], of: list[list[int]]) -> list[int]:
    """The cluster of each view of an order."""
    homes = {view: place for place, views in enumerate(of) for view in views}
    return [homes[view] for view in order]


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_a_pass_shows_each_view_once(count: int, near: bool) -> None:
    order, rng = ViewOrder(scattered(count), 1.0, near=near), np.random.default_rng(3)
    passes = [order.next_pass(rng) for _ in range(4)]
    assert all(sorted(each) == list(range(count)) for each in passes)
    assert all(type(view) is int for view in passes[0]), "as JSON, and as a checkpoint expects"
    assert count <= 2 or len({tuple(each) for each in passes}) == 4
    again = np.random.default_rng(3)
    same = ViewOrder(scattered(count), 1.0, near=near)
    assert [same.next_pass(again) for _ in range(4)] == passes
    assert again.bit_generator.state == rng.bit_generator.state


@pytest.mark.parametrize("count", COUNTS)
def test_the_random_order_is_that_of_the_generator(count: int) -> None:
    order, rng, plain = (ViewOrder(scattered(count), 1.0, near=False), *map(np.random.default_rng, (8, 8)))
    for _ in range(3):
        assert order.next_pass(rng) == plain.permutation(count).tolist()
    assert rng.bit_generator.state == plain.bit_generator.state


@pytest.mark.parametrize("count", COUNTS)
def test_clusters_have_nearly_the_same_size(count: int) -> None:
    found = clusters(scattered(count))
    assert sorted(view for views in found for view in views) == list(range(count))
    sizes = list(map(len, found))
    assert max(sizes) <= CLUSTER_VIEWS
    assert min(sizes) >= min(count, CLUSTER_VIEWS // 2)
    assert max(sizes) - min(sizes) <= 1 + count // 100, "each division rounds once"


def test_four_clusters_take_turns_and_are_shuffled_inside_and_out() -> None:
    cameras, rng = scattered(210), np.random.default_rng(1)
    found, order = clusters(cameras), ViewOrder(cameras, 1.0, near=True)
    assert [len(views) for views in found] == [15] * 14
    passes = [order.next_pass(rng) for _ in range(2)]
    homes = [homes_of(each, found) for each in passes]
    for each in homes:
        fours = np.array(each[: 3 * 15 * CLUSTERS_AT_ONCE]).reshape(3, 15, CLUSTERS_AT_ONCE)
        np.testing.assert_array_equal(fours, fours[:, :1].repeat(15, axis=1), "four take turns until they are through")
        assert each[180:] == each[180:182] * 15, "the last two of fourteen"
        assert len({*fours[:, 0].ravel(), *each[180:182]}) == 14
    assert homes[0] != homes[1]
    inside = [[view for view in each if view in found[0]] for each in passes]
    assert inside[0] != inside[1] and sorted(inside[0]) == sorted(inside[1]) == found[0]


@pytest.mark.parametrize("count", [33, 100, 1001])
def test_clusters_of_different_sizes_are_finished_before_others_begin(count: int) -> None:
    cameras = scattered(count)
    found, order = clusters(cameras), ViewOrder(cameras, 1.0, near=True)
    assert len(set(map(len, found))) > 1 or count == 33
    left, begun = dict(enumerate(map(len, found))), set[int]()
    for home in homes_of(order.next_pass(np.random.default_rng(0)), found):
        begun.add(home)
        assert len(begun) <= CLUSTERS_AT_ONCE
        left[home] -= 1
        begun -= {home} if left[home] == 0 else set()
    assert not begun


def test_cameras_in_two_places_are_two_clusters() -> None:
    wanted = [list(range(0, 32, 2)), list(range(1, 32, 2))]
    rng = np.random.default_rng(0)
    apart = [looking(rng.normal([0, 0, 5 * (index % 2)], 0.1)) for index in range(32)]
    turned = [looking(rng.normal(0, 0.1, 3), np.pi * (index % 2)) for index in range(32)]
    assert clusters(apart) == clusters(turned) == wanted


def test_cameras_that_look_at_one_thing_from_both_sides_are_near() -> None:
    """Of two things a long way apart: each has cameras on both sides, at a length unit and a half."""
    cameras = [
        looking([10 * (index % 2), 0.01 * index, 1.5 * side], 0 if side < 0 else np.pi)
        for index, side in enumerate([1, 1, -1, -1] * 8)
    ]
    assert clusters(cameras) == [list(range(0, 32, 2)), list(range(1, 32, 2))]


def test_the_axis_of_a_panorama_does_not_count() -> None:
    headings = np.random.default_rng(2).uniform(-3, 3, 40)
    still = [looking([index, 0, 0]) for index in range(40)]
    turned = [looking([index, 0, 0], heading) for index, heading in enumerate(headings)]
    all_round = [replace(camera, projection="equirectangular") for camera in turned]
    assert clusters(all_round, 5.0) == clusters(still, 5.0) != clusters(turned, 5.0)


@pytest.mark.parametrize("heading", [0.0, 0.3])
def test_cameras_in_one_place_are_divided_by_their_index(heading: float) -> None:
    cameras = [looking([3e5, 7.1, -2e6], heading)] * 40
    assert clusters(cameras) == [list(range(13)), list(range(13, 26)), list(range(26, 40))]


@pytest.mark.parametrize("count", [40, 210])
@pytest.mark.parametrize("scale", [1e-4, 1 / 3, 1000.0])
def test_the_size_and_the_place_of_the_scene_do_not_count(count: int, scale: float) -> None:
    """Positions have the rounding errors of coordinates of a million, 1e-10, far below that of points, 1.5e-5."""
    wanted = clusters(scattered(count))
    shift = scale * np.array([123_456.7, -33.3, 1e6])
    assert clusters(scattered(count, scale=scale, shift=shift), scale) == wanted
    assert clusters(scattered(count, scale=scale), scale) == wanted


# Trainings


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clusters of two or three of the eight training views, one after another; one cluster would have all."""
    monkeypatch.setattr(view_order, "CLUSTER_VIEWS", 3)
    monkeypatch.setattr(view_order, "CLUSTERS_AT_ONCE", 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_known_scene(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture
def scene(folder: Path) -> Scene:
    return load_scene(folder)


@pytest.mark.usefixtures("small")
def test_steps_follow_the_order(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, NEAR, default_device)
    found = clusters([view.camera for view in scene.train_views], scene.length_unit)
    assert sorted(map(len, found)) == [2, 3, 3]
    for _ in range(3):
        views = [trainer._next_view() for _ in range(8)]
        assert sorted(views) == list(range(8))
        assert sum(a != b for a, b in pairwise(homes_of(views, found))) == 2
    trainer.close()


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", SETTINGS)
def test_a_training_that_stops_within_a_pass_goes_on_to_the_same_bytes(
    name: str, folder: Path, default_device: Device, tmp_path: Path
) -> None:
    config = SETTINGS[name]
    scene = scene_for(folder, config)
    whole = outcome(scene, config, default_device, tmp_path / "whole")
    assert_same_arrays(stopped(20, scene, config, default_device, tmp_path / "stopped"), whole)
    if name == "near":
        random = outcome(scene, replace(config, view_order="random"), default_device, tmp_path / "random")
        assert random["model.ply"].tobytes() != whole["model.ply"].tobytes()


def test_one_photograph(folder: Path, default_device: Device, tmp_path: Path) -> None:
    scene = load_scene(folder, test_every=0)
    one = replace(scene, views=scene.views[:1])
    config = short(iterations=3, warmup=(), report=False)
    models = [
        outcome(one, replace(config, view_order=order), default_device, tmp_path / order)["model.ply"].tobytes()
        for order in ("random", "near")
    ]
    assert models[0] == models[1]


# The setting


def test_the_default_is_random() -> None:
    """The near order has a price (docs/decisions/0050-view-order.md), so no number of photographs changes it."""
    assert TrainConfig().view_order == "random"


@pytest.mark.parametrize("order", ["random", "near"])
def test_train_says_that_the_order_is_near(order: str, tmp_path: Path, capsys: Capture) -> None:
    words = ["train", str(write_scene(tmp_path / "scene")), "-o", str(tmp_path / "run"), "--iterations", "1"]
    assert main([*words, "--no-report", "--view-order", order]) == 0
    said = f"8 training pictures{' in near order' if order == 'near' else ''}, 2 held out"
    assert said in capsys.readouterr().err


def test_an_order_that_is_none(tmp_path: Path, capsys: Capture) -> None:
    refuses(r"^--view-order nearby: expected one of random, near$", replace(PLAIN, view_order="nearby").check)
    said = rejected(capsys, ["train", tmp_path, "-o", tmp_path / "run", "--view-order", "nearby"])
    assert "invalid choice 'nearby' for argument '--view-order'. Expected one of ('random', 'near')" in said
    path = tmp_path / "config.toml"
    refuses(r"train\.view_order is 'nearby', expected one of", parse_config, '[train]\nview_order = "nearby"\n', path)


@pytest.mark.parametrize("order", ["random", "near"])
def test_a_run_keeps_its_order(order: str, tmp_path: Path) -> None:
    path = tmp_path / "run"
    assert Run.open(Run.create(path, replace(PLAIN, view_order=order)).path).config.view_order == order


def test_runs_of_earlier_versions_have_the_random_order(tmp_path: Path) -> None:
    text = config_text(TrainConfig(view_order="near"), None)
    assert 'view_order = "near"\n' in text
    config, _ = parse_config(text.replace('view_order = "near"\n', ""), tmp_path / "config.toml")
    assert config == TrainConfig(view_order="random")
