# SPDX-License-Identifier: Apache-2.0
"""Models that the mappers give, made by pycolmap's synthetic scenes."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest

from clsplat.scenes.sfm import worker
from clsplat.scenes.sfm.pipeline import mapping

PHOTOS = 8


def synthetic(points: int = 60) -> pycolmap.Reconstruction:
    """A model in which each photograph has its own camera, and shows all points."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = PHOTOS, 1, 1
    options.num_points3D = points
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def spoil(model: pycolmap.Reconstruction) -> list[int]:
    """Give one photograph a negative focal length, and take all points from another. Returns the remaining ones."""
    first, second, *others = sorted(model.reg_image_ids())
    camera = model.cameras[model.images[first].camera_id]
    camera.params = [-camera.params[0], *camera.params[1:]]
    for index, point in enumerate(model.images[second].points2D):
        if point.has_point3D():
            model.delete_observation(second, index)
    return others


def test_a_plausible_model_stays() -> None:
    model = synthetic()
    mapping.remove_implausible(model)
    assert (model.num_reg_images(), len(model.cameras), model.num_points3D()) == (PHOTOS, PHOTOS, 60)


def test_photographs_without_points_and_with_impossible_cameras_go() -> None:
    model = synthetic()
    others = spoil(model)
    mapping.remove_implausible(model)
    assert sorted(model.reg_image_ids()) == others
    assert len(model.cameras) == len(others)


@pytest.mark.parametrize(
    ("points", "left"), [(mapping.MIN_SHOWN_POINTS, PHOTOS - 2), (mapping.MIN_SHOWN_POINTS - 1, 0)]
)
def test_the_global_mapper_gives_no_others(
    points: int, left: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = synthetic(points)
    spoil(model)

    def global_mapping(*, output_path: Path, **_: object) -> dict[int, pycolmap.Reconstruction]:
        (output_path / "0").mkdir()
        return {0: model}

    monkeypatch.setattr(pycolmap, "calibrate_view_graph", lambda **_: True)
    monkeypatch.setattr(pycolmap, "global_mapping", global_mapping)
    found = mapping.global_models(tmp_path, tmp_path, tmp_path / "out", threads=1, seed=0)
    assert [each.num_reg_images() for each in found.values()] == ([left] if left else [])
    if left:
        assert pycolmap.Reconstruction(tmp_path / "out" / "0").num_reg_images() == left, "it is written again"


@pytest.fixture
def located(tmp_path: Path) -> tuple[Path, pycolmap.Reconstruction]:
    """A database with matches and GPS positions, of which two are 1 km off, and the true model in metres."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 12
    options.num_points3D, options.prior_position = 150, True
    options.prior_position_coordinate_system = pycolmap.PosePriorCoordinateSystem.WGS84
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        model = pycolmap.synthesize_dataset(options, opened)
        for prior in opened.read_all_pose_priors()[3:5]:
            prior.position = prior.position + np.array([1000 / 111_195, 0, 0])  # metres in a degree of latitude
            opened.update_pose_prior(prior)
        without = opened.read_all_pose_priors()[0]
        without.position = np.array([*without.position[:2], np.nan])
        opened.update_pose_prior(without)
    return tmp_path / "database.db", model


@pytest.mark.parametrize("by_gps", [True, False])
def test_gps_holds_the_cameras_in_metres(
    by_gps: bool, located: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    """Also with a position without an altitude and two that are far off. Without GPS the scale is pycolmap's own."""
    database, true = located
    models = mapping.incremental_models(
        database, tmp_path, tmp_path / "sparse", threads=1, seed=0, relaxed=False, by_gps=by_gps, placed=lambda: None
    )
    (found,) = models.values()
    assert found.num_reg_images() == 12
    sizes = [
        np.linalg.norm(
            model.find_image_with_name("camera000001_frame000001.png").projection_center()
            - model.find_image_with_name("camera000001_frame000002.png").projection_center()
        )
        for model in (found, true)
    ]
    # The robust loss still lets the two positions pull the cameras, which are only 10 m apart: 2 % were seen.
    assert (abs(sizes[0] / sizes[1] - 1) < 0.05) == by_gps


@pytest.mark.parametrize("relaxed", [False, True])
def test_points_of_two_photographs_are_added(tmp_path: Path, *, relaxed: bool) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 1, 1
    options.num_points3D, options.num_points2D_without_point3D = 60, 0
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        model = pycolmap.synthesize_dataset(options, opened)
    poses = {image: model.images[image].cam_from_world().matrix() for image in model.reg_image_ids()}
    lenses = {camera: model.cameras[camera].params.tolist() for camera in model.cameras}
    kept = sorted(model.point3D_ids())[:20]
    for point in set(model.point3D_ids()) - set(kept):
        model.delete_point3D(point)
    model.write(tmp_path)
    found = mapping.add_two_view_points(
        tmp_path / "database.db", tmp_path, tmp_path, threads=1, seed=0, relaxed=relaxed
    )
    assert found.num_points3D() == pycolmap.Reconstruction(tmp_path).num_points3D() > 50  # some have too small an angle
    assert {image: found.images[image].cam_from_world().matrix().tolist() for image in poses} == {
        image: pose.tolist() for image, pose in poses.items()
    }
    assert {camera: found.cameras[camera].params.tolist() for camera in lenses} == lenses
    assert found.compute_mean_reprojection_error() < 1e-3  # the synthetic features have no noise


@pytest.mark.parametrize(
    ("cameras", "at_once", "tried"),
    [
        (1, 50, ["one by one"]),
        (10, 50, ["one by one", "at once"]),  # 5 photographs of a camera
        (11, 50, ["at once"]),
        (11, 15, ["at once"]),  # 30 %
        (11, 14, ["at once", "one by one", "relaxed"]),
    ],
)
def test_photographs_of_many_cameras_are_placed_at_once_first(
    cameras: int, at_once: int, tried: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, done = [f"{index}.jpg" for index in range(50)], list[str]()
    placed = {"at once": at_once, "one by one": 50 if cameras == 1 else 29, "relaxed": 0}

    def models(way: str) -> dict[Path, Any]:
        done.append(way)
        return {tmp_path / way: SimpleNamespace(num_reg_images=lambda: placed[way])}

    groups = [names[start::cameras] for start in range(cameras)]
    task = {"photos": tmp_path, "work": tmp_path, "groups": groups, "mapper": "auto"}
    work = worker.Worker(task, io.StringIO())
    monkeypatch.setattr(work, "solve_at_once", lambda: models("at once"))
    monkeypatch.setattr(work, "add_one_by_one", lambda *, relaxed: models("relaxed" if relaxed else "one by one"))
    work.map()
    assert done == tried
