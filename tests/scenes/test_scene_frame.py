# SPDX-License-Identifier: Apache-2.0
"""The frame of scenes: COLMAP models that `sfm` turns, scenes that `train` turns, and the way back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
import pytest
import ring
from calls import refuses
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64
from clsplat.bench.workload import load_subject
from clsplat.config.depth import DepthUse
from clsplat.config.orientation import FrameUse
from clsplat.config.points import StartPoints
from clsplat.config.training import TrainConfig
from clsplat.images.geotags import GpsPosition
from clsplat.runs import scene_record
from clsplat.runs.run import Run
from clsplat.scenes.dataset import SOURCE_FRAME, SceneFrame
from clsplat.scenes.depth_sources import with_depths
from clsplat.scenes.loading import load_scene
from clsplat.scenes.orientation.frame_record import FRAME_RECORD_FILE, read_frame
from clsplat.scenes.orientation.new_frame import in_frame, new_frame
from clsplat.scenes.readers.colmap import read_model
from clsplat.scenes.scene import Scene
from clsplat.scenes.sfm.framing import MODEL_FOLDER, scale_new, set_frame, turn_new
from clsplat.scenes.start.initialise import from_scene
from clsplat.scenes.start.point_cloud import with_points
from clsplat.shots import choose_shot

TURN = Rotation.from_euler("xyz", [40, 20, -100], degrees=True).as_matrix()
UP = FrameUse("up")


def turned() -> tuple[list[ring.Pose], tuple[Float64, np.ndarray]]:
    """The ring's cameras and a floor of points, in a world that is turned by TURN and has other units."""
    rng = np.random.default_rng(8)
    floor = np.stack([rng.uniform(-2, 2, 400), rng.normal(0, 0.002, 400), rng.uniform(-2, 2, 400)], axis=1)
    posed = [(rotation @ TURN.T, 3 * translation) for rotation, translation in ring.poses()]
    return posed, (3 * floor @ TURN.T, rng.integers(0, 256, (400, 3), dtype=np.uint8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A COLMAP scene in text in this world."""
    posed, cloud = turned()
    return ring.write_colmap(tmp_path / "scene", posed=posed, cloud=cloud)


@pytest.fixture
def result(folder: Path) -> Path:
    """The same in COLMAP's binary files, as `clsplat sfm` writes it."""
    points = folder / MODEL_FOLDER / "points3D.txt"
    points.write_text(points.read_text().replace(" 0.5 1 0 2 0\n", " 0.5\n"))  # no image has observations
    model = pycolmap.Reconstruction(folder / MODEL_FOLDER)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (folder / MODEL_FOLDER / name).unlink()
    model.write(folder / MODEL_FOLDER)
    return folder


def pixels(scene: Scene) -> Float64:
    """Pixels (views, points, 2) of all points."""
    found = []
    for view in scene.views:
        inside = scene.points @ view.camera.rotation.T + view.camera.translation
        found.append(inside[:, :2] / inside[:, 2:])
    return np.stack(found)


def level_of(scene: Scene) -> float:
    """Angle in degrees between -y and the normal of the floor."""
    normal = np.linalg.svd(scene.points - scene.points.mean(axis=0))[2][2]
    return float(np.rad2deg(np.arccos(min(abs(normal[1]), 1.0))))


def test_a_scene_is_turned_when_it_is_loaded(folder: Path) -> None:
    plain, up = load_scene(folder), load_scene(folder, frame=UP)
    assert plain.frame is SOURCE_FRAME
    assert plain.world_from_files is None
    assert up.frame.upright
    assert not up.frame.metres
    assert level_of(up) < 0.05  # noise of 2 mm on 400 points over 4 units: 0.003 degrees
    assert abs(np.median(up.points[:, 1])) < 0.01
    assert all(view.camera.position[1] < 0 for view in up.views)
    np.testing.assert_allclose(pixels(up), pixels(plain), atol=1e-9)  # the pictures stay
    np.testing.assert_allclose(up.extent, plain.extent, rtol=1e-9)


def test_the_frame_of_a_run_is_the_same_bits_again(folder: Path) -> None:
    first = load_scene(folder, frame=FrameUse("up", "view00.png,view10.png=8"))
    again = load_scene(folder, frame=first.frame)
    for one, other in zip(first.views, again.views, strict=True):
        np.testing.assert_array_equal(one.camera.rotation, other.camera.rotation)
        np.testing.assert_array_equal(one.camera.translation, other.camera.translation)
    np.testing.assert_array_equal(first.points, again.points)
    assert first.frame.metres
    apart = first.views[0].camera.position - first.views[10].camera.position
    assert np.linalg.norm(apart) == pytest.approx(8, rel=1e-12)


def test_points_of_files_tracks_and_depth_maps_follow(folder: Path, tmp_path: Path) -> None:
    ends = ",".join(f"{value!r}" for value in (0.0, 0.0, 0.0, 0.0, 3.0, 4.0))
    use = FrameUse("up", f"{ends}=10")  # five units are ten metres
    _, (points, colors) = turned()
    ring.write_cloud(tmp_path / "cloud.ply", points, colors)
    scene = with_points(load_scene(folder, frame=use), StartPoints(file=str(tmp_path / "cloud.ply"), limit=10_000))
    np.testing.assert_allclose(scene.points, load_scene(folder, frame=use).points, atol=1e-4)  # float32 in the file
    assert level_of(scene) < 0.05
    known = with_depths(scene, DepthUse(source="points"))
    view = known.train_views[0]
    assert view.depth is not None
    depths = view.camera.depths_of(view.depth.points)
    plain = with_depths(load_scene(folder), DepthUse(source="points")).train_views[0]
    assert plain.depth is not None
    np.testing.assert_allclose(depths, 2 * plain.camera.depths_of(plain.depth.points), rtol=1e-9)
    (folder / "depths").mkdir()
    for name in ring.NAMES:
        np.save(folder / "depths" / f"{name}.npy", np.full((ring.HEIGHT, ring.WIDTH), 3.0, np.float32))
    mapped = with_depths(load_scene(folder, frame=use), DepthUse(source="maps")).train_views[0]
    assert mapped.depth is not None
    assert mapped.depth.unit == pytest.approx(2)


@pytest.mark.parametrize("orient", ["up", None])
def test_gps_scales_with_and_without_a_turn(
    orient: Literal["up"] | None, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ring of radius 4, which is 40 m: its cameras are 12 units from the middle in the scene's files."""
    places = np.stack([ring.centre_of(pose) for pose in ring.poses()])
    enu = 10 * places[:, [0, 2, 1]] * (1, 1, -1)  # x east, y down, z north
    globe = pycolmap.GPSTransform().enu_to_ellipsoid(enu, -33.0, 151.0, 20.0)
    positions = {name: GpsPosition(*row) for name, row in zip(ring.NAMES, globe.tolist(), strict=True)}
    monkeypatch.setattr("clsplat.scenes.orientation.new_frame.gps_of", lambda path: positions[path.name])
    scene = load_scene(folder, frame=FrameUse(orient, "gps"))
    assert scene.frame.metres
    centres = np.stack([view.camera.position for view in scene.views])
    apart = np.linalg.norm(centres[0] - centres[10])
    assert apart == pytest.approx(10 * np.linalg.norm(places[0] - places[10]), rel=1e-3)  # the floor's noise tilts up
    if orient == "up":
        np.testing.assert_allclose(centres - centres[0], 10 * (places - places[0]), atol=0.1)
        assert scene.frame.origin == pytest.approx((-33.0, 151.0, 20.0), abs=0.1)
        assert scene.frame.origin[:2] == pytest.approx((-33.0, 151.0), abs=1e-5)
    else:
        assert not scene.frame.upright
        assert scene.frame.origin == ()
        turned_by = scene.views[0].camera.rotation.T @ load_scene(folder).views[0].camera.rotation
        np.testing.assert_allclose(turned_by, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("orient", ["up", None])
def test_the_same_gps_again_changes_nothing(
    orient: Literal["up"] | None, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = np.stack([ring.centre_of(pose) for pose in ring.poses()])
    off = np.random.default_rng(0).normal(
        size=places.shape
    )  # errors of a metre, so that the fit is none without residual
    globe = pycolmap.GPSTransform().enu_to_ellipsoid(10 * places[:, [0, 2, 1]] * (1, 1, -1) + off, -33.0, 151.0, 20.0)
    positions = {name: GpsPosition(*row) for name, row in zip(ring.NAMES, globe.tolist(), strict=True)}
    monkeypatch.setattr("clsplat.scenes.orientation.new_frame.gps_of", lambda path: positions[path.name])
    monkeypatch.setattr("clsplat.scenes.orientation.new_frame.gravity_of", lambda path, upright: None)
    data = read_model(folder / "sparse" / "0")
    files = {name: Path(name) for name in ring.NAMES}
    use = FrameUse(orient, "gps")
    frame = new_frame("scene", data, files, use, data.frame, turned=True)
    change = frame.change_from(data.frame)
    assert change is not None
    again = in_frame(data, change)
    for repeated in (use, FrameUse(None, "gps")):
        assert new_frame("scene", again, files, repeated, frame, turned=True) is frame


def test_a_transforms_json_is_turned_too(tmp_path: Path) -> None:
    posed, cloud = turned()
    folder = ring.write_transforms(
        tmp_path / "scene", matrices=[ring.matrix_of(pose) for pose in posed], ply_file_path="cloud.ply"
    )
    ring.write_cloud(folder / "cloud.ply", *cloud)
    up = load_scene(folder, frame=UP)
    assert level_of(up) < 0.05
    assert up.world_from_files is not None
    assert np.isfinite(up.bounds).all()


def test_a_reconstruction_is_turned_in_its_files_and_back(result: Path) -> None:
    before = read_model(result / MODEL_FOLDER)
    frame = set_frame(result, result / "images", UP, result)
    assert read_frame(result / MODEL_FOLDER).world_from_source.tolist() == frame.world_from_source.tolist()
    scene = load_scene(result)
    assert level_of(scene) < 0.05
    assert scene.frame.upright
    assert scene.world_from_files is None
    model = pycolmap.Reconstruction(result / MODEL_FOLDER)
    model.update_point_3d_errors()
    assert [path.name for path in (result / "sparse").iterdir()] == ["0"]
    again = set_frame(result, result / "images", UP, result)  # it is upright: nothing changes
    assert again.world_from_source.tolist() == frame.world_from_source.tolist()
    set_frame(result, result / "images", FrameUse("none"), result)
    after, back = read_model(result / MODEL_FOLDER), read_frame(result / MODEL_FOLDER)
    assert back.is_source
    np.testing.assert_allclose(after.points, before.points, atol=1e-12)
    for one, other in zip(before.images, after.images, strict=True):
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-12)


def test_a_scale_keeps_the_axes_and_a_second_one_replaces_it(result: Path) -> None:
    set_frame(result, result / "images", UP, result)
    for metres in (8.0, 2.0):
        frame = set_frame(result, result / "images", FrameUse(None, f"view00,view10={metres}"), result)
        assert frame.upright
        assert frame.metres
        assert len(frame.notes) == 2
        scene = load_scene(result)
        apart = scene.views[0].camera.position - scene.views[10].camera.position
        assert np.linalg.norm(apart) == pytest.approx(metres, rel=1e-9)
        assert level_of(scene) < 0.05
    frame = set_frame(result, result / "images", FrameUse("none"), result)
    assert frame.metres
    assert not frame.upright
    np.testing.assert_array_equal(np.diag(np.diag(frame.world_from_source)), frame.world_from_source)


@pytest.mark.parametrize("scale", ["0,0,0,0.5,0,0=2", "view00,view10=8"])
def test_the_same_scale_twice_is_the_same_result(scale: str, result: Path) -> None:
    set_frame(result, result / "images", UP, result)
    before = load_scene(result)
    first = set_frame(result, result / "images", FrameUse(None, scale), result)
    files = {path.name: path.read_bytes() for path in (result / MODEL_FOLDER).iterdir()}
    assert set_frame(result, result / "images", FrameUse(None, scale), result).notes == first.notes
    assert {path.name: path.read_bytes() for path in (result / MODEL_FOLDER).iterdir()} == files
    trained = load_scene(result, frame=FrameUse(None, scale))  # as in training on the scene that sfm scaled
    np.testing.assert_array_equal(trained.frame.world_from_source, first.world_from_source)
    np.testing.assert_array_equal(trained.points, load_scene(result).points)
    if scale.startswith("0,"):
        np.testing.assert_allclose(trained.points, 4 * before.points, atol=1e-12)  # coordinates up to 30


def test_points_measured_before_the_scene_was_scaled(result: Path) -> None:
    """Another length for the same points corrects the first. Other points are measured in the scaled scene."""
    before = load_scene(result).points
    # 0.5 units are 2 m, then 3 m instead; a second length in between changes nothing about these points; in the scene
    # that is scaled by 6, 2 units are now measured as 1 m
    for scale, factor in (
        ("0,0,0,0.5,0,0=2", 4.0),
        ("0,0,0,0.5,0,0=3", 6.0),
        ("view00,view10=9", None),
        ("0,0,0,0.5,0,0=3", 6.0),
        ("0,0,0,0,2,0=1", 3.0),
        ("0,0,0,0,2,0=1", 3.0),
    ):
        frame = set_frame(result, result / "images", FrameUse(None, scale), result)
        assert frame.metres
        assert frame.scale_note.startswith(f"metres are from the known length {scale}: a unit was ")
        if factor is not None:
            np.testing.assert_allclose(load_scene(result).points, factor * before, atol=1e-12)


def test_the_same_points_in_the_other_order_are_the_same(result: Path) -> None:
    first = set_frame(result, result / "images", FrameUse(None, "0,0,0,0.5,0,0=2"), result)
    again = set_frame(result, result / "images", FrameUse(None, "0.5,0,0,0,0,0=2"), result)
    np.testing.assert_array_equal(again.world_from_source, first.world_from_source)


def test_a_run_keeps_its_frame_when_the_scene_gets_another(result: Path) -> None:
    set_frame(result, result / "images", UP, result)
    trained = load_scene(result)
    set_frame(result, result / "images", FrameUse(None, "view00,view10=1"), result)
    later = load_scene(result, frame=trained.frame)
    np.testing.assert_allclose(later.points, trained.points, atol=1e-9)
    assert later.frame is trained.frame


def test_a_run_goes_on_when_the_scene_gets_another_frame(result: Path, tmp_path: Path) -> None:
    """The points have other bits when they are brought back to the run's frame, and are still the same points."""
    set_frame(result, result / "images", UP, result)
    run = Run.create(tmp_path / "run", TrainConfig(), scene=result)
    scene_record.keep(run, load_scene(result), resuming=False)
    set_frame(result, result / "images", FrameUse(None, "view00,view10=1"), result)
    scene = load_scene(result, frame=run.frame_to_resume())
    before = scene_record.read(run)
    assert before is not None
    assert before["points"] != scene_record.record_of(scene, 0)["points"]
    assert not scene_record.check(run, scene, result, 0)
    scene.points, scene.point_colors = scene.points[1:], scene.point_colors[1:]
    refuses("other points .400 before, 399 now.", scene_record.check, run, scene, result, 0)
    # without the run's frame the cameras differ
    refuses("with another camera", scene_record.check, run, load_scene(result), result, 0)
    assert scene_record.of_evaluation(run, scene.test_views) == []
    (told,) = scene_record.of_evaluation(run, load_scene(result).test_views)
    assert told.startswith("3 views with another camera than in training (view00.png, view08.png, view16.png): were")


def test_the_bench_of_a_run_draws_its_view_in_the_frame_of_the_model(folder: Path, tmp_path: Path) -> None:
    """A scene that the training turned, whose files stay as they are."""
    scene = load_scene(folder, frame=UP)
    run = Run.create(tmp_path / "run", TrainConfig(), scene=folder)
    scene_record.keep(run, scene, resuming=False)
    run.save_model(from_scene(scene, 100, np.random.default_rng(0)))
    there, camera = scene.train_views[0].camera, load_subject(run.path).camera
    np.testing.assert_allclose(camera.rotation, there.rotation, atol=1e-12)  # the frame is read from its record
    np.testing.assert_allclose(camera.position, there.position, atol=1e-12)


def test_a_run_without_a_frame_has_the_frame_that_the_cameras_had_first(result: Path, tmp_path: Path) -> None:
    """A scene that is turned after a training still fits the model."""
    before, seen = load_scene(result), choose_shot(result).cameras[3]
    run = Run.create(tmp_path / "run", TrainConfig(), scene=result)
    scene_record.keep(run, before, resuming=False)
    assert run.frame is None
    np.testing.assert_array_equal(choose_shot(result, frame=run.frame_for(result)).cameras[3].rotation, seen.rotation)
    (run.path / "checkpoints").mkdir(exist_ok=True)
    (run.path / "checkpoints" / "step-10.npz").touch()
    set_frame(result, result / "images", UP, result)
    for frame in (run.frame_for(result), run.frame_to_resume()):
        np.testing.assert_allclose(load_scene(result, frame=frame).points, before.points, atol=1e-9)
    there = choose_shot(result, frame=run.frame_for(result)).cameras[3]
    np.testing.assert_allclose(there.rotation, seen.rotation, atol=1e-12)
    np.testing.assert_allclose(there.position, seen.position, atol=1e-12)


@pytest.mark.parametrize(("given", "made"), [("walk.mp4", "walk_colmap"), ("photos", "photos_colmap")])
def test_the_cameras_recovered_for_a_run_are_its_scene(given: str, made: str, tmp_path: Path) -> None:
    source = tmp_path / given
    source.touch() if source.suffix else source.mkdir()
    run = Run.create(tmp_path / "run", TrainConfig(), scene=source)
    assert run.is_scene(source)
    assert run.is_scene(tmp_path / made)
    assert not run.is_scene(tmp_path / "walk.mp4_colmap")


def test_the_scene_of_a_video_has_the_videos_name(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clsplat.scenes.loading.reconstruct", lambda *_, **__: folder)
    (tmp_path / "walk.mp4").touch()
    assert load_scene(tmp_path / "walk.mp4").name == "walk"


def test_the_same_bytes_twice(result: Path, tmp_path: Path) -> None:
    import shutil

    other = tmp_path / "other"
    shutil.copytree(result, other)
    for folder in (result, other):
        set_frame(folder, folder / "images", UP, folder)
    for file in sorted((result / MODEL_FOLDER).iterdir()):
        assert file.read_bytes() == (other / MODEL_FOLDER / file.name).read_bytes(), file.name


def test_an_interrupted_change_leaves_the_earlier_model(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (result / MODEL_FOLDER / "images.bin").read_bytes()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("clsplat.scenes.sfm.framing.atomic_write", interrupt)
    with pytest.raises(KeyboardInterrupt):
        set_frame(result, result / "images", UP, result)
    assert (result / MODEL_FOLDER / "images.bin").read_bytes() == before
    assert sorted(path.name for path in result.iterdir()) == ["images", "sparse"]


def test_wrong_scales_name_the_scene_and_the_flag(folder: Path) -> None:
    for scale, match in (
        ("view00,view99=1", "--scale view00,view99=1: the scene has no photograph view99"),
        ("gps", "--scale gps: 0 of 20 photographs have a GPS position in their EXIF"),
        ("1,1,1,1,1,1=2", "--scale 1,1,1,1,1,1=2: the two points are in the same place"),
    ):
        assert str(folder) in refuses(match, load_scene, folder, frame=FrameUse(None, scale))
    refuses("--scale x: expected NAME,NAME=METRES", load_scene, folder, frame=FrameUse(None, "x"))
    refuses("orient 'down': expected 'up' or 'none'", load_scene, folder, frame=FrameUse("down"))  # type: ignore[arg-type]


def test_two_cameras_cannot_be_turned(tmp_path: Path) -> None:
    folder = ring.write_colmap(tmp_path / "scene", ring.NAMES[:2], posed=ring.poses()[:2])
    refuses(
        r"2 camera\(s\) do not tell which way is up, expected at least 3; use --orient none",
        load_scene,
        folder,
        frame=UP,
    )


def test_a_reconstruction_is_never_lost_to_its_frame(tmp_path: Path) -> None:
    """Without an up direction it stays as COLMAP made it, with a warning. A wrong scale is an error that leaves it."""
    posed = ring.poses()[:2]
    few = ring.write_colmap(tmp_path / "few", ring.NAMES[:2], posed=posed)
    with pytest.warns(match="expected at least 3; use --orient none to keep its axes; it is kept in COLMAP's frame"):
        turn_new(few, few / "images", FrameUse(), few)
    assert read_frame(few / MODEL_FOLDER) is SOURCE_FRAME
    turn_new(few, few / "images", FrameUse("none"), few)
    match = "no photograph x and no y.*; the cameras are recovered, give another --scale to the same command"
    refuses(match, scale_new, few, few / "images", FrameUse("none", "x,y=2"))


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 0.1 * TURN, (1 / 3, 2e9, -1e-9)
    frame = SceneFrame(
        matrix, True, True, (48.1, 11.5, 520.0), (0.1, 0, 0, 1, 2, 3, 0.3), "up is from x", "metres are from y"
    )
    (tmp_path / FRAME_RECORD_FILE).write_bytes(frame.content())
    found = read_frame(tmp_path)
    assert found.document() == frame.document()
    assert found.change_from(frame) is None
    assert found.notes == ["up is from x", "metres are from y"]
    assert read_frame(tmp_path / "nowhere") is SOURCE_FRAME
    older = {key: value for key, value in frame.document().items() if key != "measured"}
    (tmp_path / FRAME_RECORD_FILE).write_text(json.dumps(older))
    assert read_frame(tmp_path).measured == ()


@pytest.mark.parametrize(
    "change",
    [
        {"world_from_source": [[1, 2], [3, 4]]},
        {"world_from_source": np.diag([1.0, 1, 2, 1]).tolist()},
        {"world_from_source": "x"},
        {"world_from_source": np.diag([np.inf, 1, 1, 1]).tolist()},
        {"upright": 1},
        {"metres": None},
        {"origin": [1]},
        {"origin": ["a", "b", "c"]},
        {"origin": [np.nan, 0, 0]},
        {"origin": [10**400, 0, 0]},
        {"measured": [1, 2, 3]},
        {"measured": [0, 0, 0, 1, 0, 0, 0]},
        {"measured": [10**400, 0, 0, 1, 0, 0, 1]},
        {"up_note": 3},
        {"scale_note": None},
    ],
)
def test_a_damaged_record_is_named(change: dict[str, object], tmp_path: Path) -> None:
    (tmp_path / FRAME_RECORD_FILE).write_text(json.dumps({**SOURCE_FRAME.document(), **change}))
    assert FRAME_RECORD_FILE in refuses("is damaged .* expected the record of a scene's frame", read_frame, tmp_path)
    (tmp_path / FRAME_RECORD_FILE).write_text("{")
    refuses("is damaged", read_frame, tmp_path)


def test_no_change_is_no_change(folder: Path) -> None:
    assert load_scene(folder, frame=FrameUse("none")).world_from_files is None
    assert replace(SOURCE_FRAME, upright=True).change_from(SOURCE_FRAME) is None
