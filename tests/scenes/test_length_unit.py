# SPDX-License-Identifier: Apache-2.0
"""The length that rates and sizes are relative to: what photographs look at, not how far apart they are."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny import DISTANCE, short, write_scene

from clsplat.api import train
from clsplat.arrays import Float64
from clsplat.device.context import Device
from clsplat.runs import scene_record
from clsplat.runs.run import Run
from clsplat.scenes.depth_sources import DEPTH_TO_UNIT, length_unit_of
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.colmap import Tracks
from clsplat.scenes.scene import Scene, View
from clsplat.training.preparation import prepared
from clsplat.training.trainer import Trainer

STREET = 40.0
"""Length of a street of cameras, in distances of what they look at."""


def street(folder: Path, *, length: float = STREET, factor: float = 1.0) -> Scene:
    """Copies of the tiny scene in a row, each with its own photographs and points."""
    one = load_scene(folder if folder.exists() else write_scene(folder), test_every=0)
    views, points = [], []
    for index, offset in enumerate(np.linspace(0, length * DISTANCE, 5)):
        place = np.array([offset, 0, 0])
        for view in one.views:
            camera = view.camera
            moved = replace(camera, translation=factor * (camera.translation - camera.rotation @ place))
            views.append(replace(view, name=f"{index}/{view.name}", camera=moved))
        points.append(factor * (one.points + place))
    colours = np.tile(one.point_colors, (5, 1))
    return Scene("street", views, np.concatenate(points), colours, one.bounds)  # without a source: no tracks


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_the_unit_of_a_street_is_the_depth_of_its_photographs(factor: float, tmp_path: Path) -> None:
    scene = street(tmp_path / "scene", factor=factor)
    unit = length_unit_of(scene)
    assert scene.extent > 10 * DISTANCE * factor
    # the nearest point of a cell is up to the radius of 1 before the middle
    assert DEPTH_TO_UNIT * (DISTANCE - 1) * factor < unit < DEPTH_TO_UNIT * (DISTANCE + 1) * factor


def test_a_scene_that_cameras_surround_keeps_the_extent(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path / "scene"))
    assert length_unit_of(scene) == scene.extent == scene.length_unit
    assert prepared(scene, short()).length_unit == scene.extent


def test_the_unit_grows_with_the_street_up_to_the_depth(tmp_path: Path) -> None:
    """No threshold: photographs further apart never have a much smaller unit."""
    units = [length_unit_of(street(tmp_path / "scene", length=length)) for length in (0.4, 1.6, 2.8, 4, 8, STREET)]
    # the nearest points of neighbours are in the photographs too, so that depths vary by the radius of 1
    assert all(later > 0.9 * unit for unit, later in itertools.pairwise(units)), units
    assert units[-1] == pytest.approx(units[-2], rel=0.1)


def test_a_scene_without_points_keeps_the_extent(tmp_path: Path) -> None:
    scene = street(tmp_path / "scene")
    assert length_unit_of(replace(scene, points=np.empty((0, 3)), point_colors=np.empty((0, 3)))) == scene.extent


def write_cloud(path: Path, points: Float64) -> str:
    """A PLY of the points without colours. Returns its path."""
    names = [f"property float {axis}" for axis in "xyz"]
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *names, "end_header"]
    path.write_text("\n".join([*head, *(" ".join(map(str, point)) for point in points)]) + "\n")
    return str(path)


def test_a_scene_without_points_takes_those_of_a_file(tmp_path: Path) -> None:
    scene = street(tmp_path / "scene")
    config = short(points=write_cloud(tmp_path / "cloud.ply", scene.points))
    made = prepared(replace(scene, points=np.empty((0, 3)), point_colors=np.empty((0, 3))), config)
    assert made.length_unit == pytest.approx(length_unit_of(scene))
    assert prepared(made, config).length_unit == made.length_unit


def test_a_prepared_scene_keeps_its_unit(tmp_path: Path) -> None:
    """As `clsplat train` has it, which hands one to `clsplat.train`. Other points do not count, nearer ones either."""
    scene = street(tmp_path / "scene", length=0.4)
    assert length_unit_of(scene) == scene.extent
    near = np.concatenate([view.camera.position + 0.3 * view.camera.rotation[2:] for view in scene.train_views])
    made = prepared(scene, config := short(points=write_cloud(tmp_path / "cloud.ply", near)))
    assert length_unit_of(made) < made.extent
    assert prepared(made, config).length_unit == made.length_unit == scene.extent


def seen_by(view: View, points: np.ndarray) -> Tracks:
    """Tracks of points that one photograph shows."""
    count = len(points)
    return Tracks(points, np.zeros(count), [view.name], np.zeros(count, np.int32), np.arange(1, count + 1))


def test_tracks_tell_what_a_photograph_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points behind a wall are in the frame, but not in the photograph."""
    scene = replace(street(tmp_path / "scene"), source=tmp_path / "scene")
    view = scene.train_views[0]
    shown = view.camera.position + np.array([[1.0], [2.0], [3.0]]) * view.camera.rotation[2]
    tracks = seen_by(view, shown)
    monkeypatch.setattr("clsplat.scenes.readers.colmap.read_tracks", lambda _: tracks)
    assert length_unit_of(scene) == pytest.approx(DEPTH_TO_UNIT * 2)


def test_tracks_of_another_world_frame_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = street(tmp_path / "scene")
    wanted = length_unit_of(scene)
    view = scene.train_views[0]
    behind = view.camera.position - np.array([[1.0], [2.0], [3.0]]) * view.camera.rotation[2]
    ahead = 0.1 * view.camera.position + np.array([[100.0, 40, 30]])  # before the camera, but far beside its picture
    tracks = seen_by(view, np.concatenate([behind, ahead]))
    monkeypatch.setattr("clsplat.scenes.readers.colmap.find_model", lambda _: tmp_path)
    monkeypatch.setattr("clsplat.scenes.readers.colmap.read_tracks", lambda _: tracks)
    assert length_unit_of(replace(scene, source=tmp_path / "scene")) == wanted


def test_the_extent_of_cameras_in_one_place_follows_the_start_points(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path / "scene"), test_every=0)
    views = [replace(view, camera=replace(view.camera, translation=np.zeros(3))) for view in scene.views]
    spot = replace(scene, views=views, points=np.empty((0, 3)), point_colors=np.empty((0, 3), np.float32))
    made = prepared(spot, short())
    assert made.unit is None
    far = replace(made, points=np.full((5, 3), 7.0), point_colors=np.zeros((5, 3), np.float32))
    assert far.length_unit == far.extent == pytest.approx(7 * np.sqrt(3))


def test_rates_and_sizes_count_in_the_unit(tmp_path: Path, default_device: Device) -> None:
    scene = prepared(street(tmp_path / "scene"), short())
    trainer = Trainer(scene, short(), default_device)
    plain = Trainer(replace(scene, unit=None), short(), default_device)
    ratio = scene.length_unit / scene.extent
    assert ratio < 0.25
    assert trainer.rates()["means"] == pytest.approx(ratio * plain.rates()["means"])
    assert trainer._state().length_unit == scene.length_unit
    assert trainer.near == scene.near


def test_a_run_keeps_its_unit(tmp_path: Path, default_device: Device) -> None:
    scene, config = street(tmp_path / "scene"), short(iterations=2)
    run = Run.create(tmp_path / "run", config, scene=tmp_path / "scene")
    train(scene, config, device=default_device, run=run)
    unit = prepared(scene, config).length_unit
    assert (scene_record.read(run) or {})["length_unit"] == unit
    assert prepared(scene, config, run).length_unit == unit


def test_a_run_that_ended_before_its_scene_was_recorded_begins_with_its_unit(tmp_path: Path) -> None:
    scene, config = street(tmp_path / "scene"), short(iterations=2)
    run = Run.create(tmp_path / "run", config, scene=tmp_path / "scene")
    assert prepared(scene, config, run).length_unit == prepared(scene, config).length_unit < scene.extent


def test_a_run_whose_record_was_removed_is_warned_of(tmp_path: Path, default_device: Device) -> None:
    scene, config = street(tmp_path / "scene"), short(iterations=2)
    run = Run.create(tmp_path / "run", config, scene=tmp_path / "scene")
    train(scene, config, device=default_device, run=run)
    (run.path / scene_record.SCENE_RECORD_FILE_NAME).unlink()
    with pytest.warns(UserWarning, match=r"scene\.json: is missing, so lengths are relative to the extent"):
        assert prepared(scene, config, run).length_unit == scene.extent


def test_a_run_of_an_earlier_version_keeps_the_extent(tmp_path: Path, default_device: Device) -> None:
    scene, config = street(tmp_path / "scene"), short(iterations=2)
    run = Run.create(tmp_path / "run", config, scene=tmp_path / "scene")
    scene_record.write(run, scene)  # before its unit is known, as those versions did
    assert "length_unit" not in (scene_record.read(run) or {})
    assert prepared(scene, config, run).length_unit == scene.extent
    train(scene, config, device=default_device, run=run, resume=True)
    assert "length_unit" not in (scene_record.read(run) or {})
