# SPDX-License-Identifier: Apache-2.0
"""Models placed in a shot against the same Gaussians merged beforehand, and against brute force, end to end."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, error_line, fails
from cg import write_flat
from compare import assert_same_bits
from models import random_gaussians
from rendered import camera_file, pixels_of
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.config.pictures import SamplingConfig
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.gaussians import Gaussians
from clsplat.images.colour import linear_to_srgb, srgb_to_linear
from clsplat.models import edit
from clsplat.models.instances import Ensemble, Placement, grade, placed, rows_of
from clsplat.reference.blend import layers
from clsplat.reference.render import forward
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.farm import Failure, WorkerJob, render_frame
from clsplat.sequence.job_models import load_job_models
from clsplat.sequence.shot_tasks import make_tasks
from clsplat.sequence.task import RenderOptions
from clsplat.shots import read_shot
from clsplat.shots.shot_file import parse_transform, read_layout
from clsplat.spherical_harmonics import SH_C0, sh_basis

CLOSE = 1e-5
"""Float32's rounding of means and SH that were turned once more, in a picture of values up to 2."""


def coloured(count: int, seed: int) -> Gaussians:
    """A part of the tiny scene's Gaussians, with SH of degree 2."""
    rng = np.random.default_rng(seed)
    model = edit.take(hidden_model(), rng.permutation(40)[:count])
    sh = np.concatenate([model.sh, rng.normal(0, 0.15, (count, 8, 3)).astype(np.float32)], axis=1)
    return replace(model, sh=sh)


A, B = coloured(15, 0), coloured(20, 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two models, and a camera that goes to the right."""
    folder = tmp_path_factory.mktemp("shot")
    A.save(folder / "a.ply")
    B.save(folder / "b.ply")
    camera_file(folder / "cameras.json", {1: -0.3, 5: 0.3})
    return folder


def layout(folder: Path, file: str, /, **of_b: Any) -> Path:
    """A shot of both models, of which the second has these properties."""
    path = folder / f"{file}.json"
    models = [{"name": "a", "path": "a.ply"}, {"name": "b", "path": "b.ply"} | of_b]
    path.write_text(json.dumps({"clsplat_shot": 1, "models": models}))
    return path


def render(folder: Path, model: Path, out: Path, flags: str = "", *more: str) -> int:
    cameras = ["--cameras", str(folder / "cameras.json"), "-o", str(out / "####.exr"), "--progress", "none"]
    return main(["render", str(model), *cameras, *flags.split(), *more])


def camera_at(frame: float) -> Camera:
    """The camera of the file, which goes at one speed."""
    focal, x = 0.5 * WIDTH / np.tan(np.radians(30)), -0.3 + 0.15 * (frame - 1)
    return Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, np.eye(3), np.array([-x, 0.0, 4.0]))


MOVING: dict[str, Any] = {
    "keys": [
        {"frame": 1, "translate": [0, 0, 0], "rotate": [0, 0, 0], "scale": 1},
        {"frame": 3, "translate": [0.4, -0.2, 0.3], "rotate": [20, 90, -40], "scale": 1.5},
    ]
}


def moved_by(frame: float) -> Float64:
    """The matrix of MOVING, by hand."""
    share = np.clip((frame - 1) / 2, 0, 1)
    x, y, z = np.radians(np.array([20, 90, -40]) * share)
    c, s = np.cos, np.sin
    about_x = np.array([[1, 0, 0], [0, c(x), -s(x)], [0, s(x), c(x)]])
    about_y = np.array([[c(y), 0, s(y)], [0, 1, 0], [-s(y), 0, c(y)]])
    about_z = np.array([[c(z), -s(z), 0], [s(z), c(z), 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = (1 + 0.5 * share) * about_z @ about_y @ about_x
    matrix[:3, 3] = np.array([0.4, -0.2, 0.3]) * share
    return matrix


@pytest.mark.slow
def test_models_over_time_are_one_model_merged_beforehand(folder: Path, tmp_path: Path) -> None:
    shot, channels = layout(folder, "moving", **MOVING), "--channels rgb,alpha,depth,id,normals"
    assert render(folder, shot, tmp_path, f"--frames 1-3 {channels}") == 0
    for frame in (1, 2, 3):
        merged, one = tmp_path / "merged.ply", tmp_path / "one"
        edit.merge([A, B if frame == 1 else edit.transform(B, moved_by(frame))]).save(merged)
        assert render(folder, merged, one, f"--frames {frame} {channels}") == 0
        got, wanted = pixels_of(tmp_path / f"{frame:04d}.exr"), pixels_of(one / f"{frame:04d}.exr")
        if frame == 1:  # B is where it was
            assert_same_bits(got, wanted)
        assert np.abs(got - wanted).max() < CLOSE
    assert np.abs(pixels_of(tmp_path / "0003.exr") - pixels_of(tmp_path / "0001.exr"))[:, :, :3].max() > 0.1


def test_sh_turn_with_the_model() -> None:
    """Seen from a camera that moves along, a model looks as it did."""
    model, matrix = random_gaussians(30), moved_by(2.5)
    there = placed(model, Placement(rows_of(matrix)))
    directions = np.random.default_rng(3).standard_normal((30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
    before = np.einsum("nk,nkc->nc", sh_basis(directions, 3), model.sh)
    after = np.einsum("nk,nkc->nc", sh_basis(directions @ turn.T, 3), there.sh)
    np.testing.assert_allclose(after, before, atol=2e-5)  # float32 of 16 terms up to 4


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [{"opacity": 0}, {"keys": [{"frame": 9, "visible": False}]}])
def test_a_hidden_model_is_not_there(hidden: dict[str, Any], folder: Path, tmp_path: Path) -> None:
    assert render(folder, layout(folder, "hidden", **hidden), tmp_path, "--frames 2 --channels rgb,alpha,id") == 0
    assert render(folder, folder / "a.ply", tmp_path / "a", "--frames 2 --channels rgb,alpha,id") == 0
    assert_same_bits(pixels_of(tmp_path / "0002.exr"), pixels_of(tmp_path / "a" / "0002.exr"))


def test_visibility_changes_at_its_key(folder: Path) -> None:
    keys = [{"frame": 2, "visible": True}, {"frame": 3, "visible": False}, {"frame": 4, "visible": True}]
    track = read_layout(layout(folder, "blinking", keys=keys))[1].track
    assert [track.at(frame).opacity for frame in (1, 2, 2.9, 3, 3.5, 4, 9)] == [1, 1, 1, 0, 0, 1, 1]


def test_opacity_and_colour_over_time(folder: Path, tmp_path: Path) -> None:
    keys = [
        {"frame": 1, "opacity": 1, "gain": [1, 1, 1], "offset": [0, 0, 0], "saturation": 1},
        {"frame": 3, "opacity": 0.2, "gain": [2, 1, 0.5], "offset": [0.1, 0, -0.1], "saturation": 0},
    ]
    assert render(folder, layout(folder, "graded", keys=keys), tmp_path, "--frames 2") == 0
    # half way, colour by colour: a colour c of ASC CDL is s v + (1 - s) luma(v), v = gain c + offset
    opacity = 0.6 / (1 + np.exp(-B.opacity_logits.astype(np.float64)))
    gain, offset, saturation = np.array([1.5, 1, 0.75]), np.array([0.05, 0, -0.05]), 0.5
    sh = B.sh.astype(np.float64) * gain
    sh[:, 0] += (0.5 * gain + offset - 0.5) / SH_C0
    luma = sh @ [0.2126, 0.7152, 0.0722]
    sh = saturation * sh + (1 - saturation) * luma[:, :, None]
    by_hand = replace(B, sh=sh.astype(np.float32), opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32))
    edit.merge([A, by_hand]).save(tmp_path / "merged.ply")
    assert render(folder, tmp_path / "merged.ply", tmp_path / "one", "--frames 2") == 0
    assert np.abs(pixels_of(tmp_path / "0002.exr") - pixels_of(tmp_path / "one" / "0002.exr")).max() < CLOSE


def test_a_colour_within_a_colour() -> None:
    inner = Placement(rows_of(moved_by(2)), 0.5, grade(np.array([2, 1, 1.0]), np.array([0, 0.1, 0]), 0.5))
    outer = Placement(rows_of(moved_by(3)), 0.4, grade(np.array([1, 3, 1.0]), np.array([0.2, 0, 0]), 1.5))
    twice, once = placed(placed(B, inner), outer), placed(B, inner.within(outer))
    for name, array in twice.arrays().items():
        np.testing.assert_allclose(getattr(once, name), array, atol=3e-6, err_msg=name)


@pytest.mark.slow
def test_a_moving_model_blurs(folder: Path, tmp_path: Path) -> None:
    shot = layout(folder, "moving", **MOVING)
    flags = "--frames 2 --shutter-angle 180 --samples 8"
    assert render(folder, shot, tmp_path, flags) == 0
    renderer, means = Renderer(), []
    for time in SamplingConfig(samples=8, shutter_angle=180).sample_times:
        merged = edit.merge([A, edit.transform(B, moved_by(2 + time))])
        means.append(srgb_to_linear(renderer.render(merged, camera_at(2 + time)).image))
    wanted, got = (
        linear_to_srgb(np.mean(means, axis=0, dtype=np.float64).astype(np.float32)),
        pixels_of(tmp_path / "0002.exr"),
    )
    assert np.abs(got - wanted).max() < 5e-5  # sRGB's curve is steep where it is dark: 12.9 times CLOSE and less
    assert render(folder, layout(folder, "still", matrix=moved_by(2).ravel().tolist()), tmp_path / "still", flags) == 0
    assert np.abs(got - pixels_of(tmp_path / "still" / "0002.exr")).max() > 0.03  # and the model's own motion is in it


OPEN = "--shutter-open 0 --shutter-close 0.5 --samples 2"


@pytest.mark.parametrize(("shutter", "wall"), [("", np.inf), (OPEN, np.inf), (OPEN, 4.0)])
def test_motion_is_the_models_too(shutter: str, wall: float, folder: Path, tmp_path: Path) -> None:
    """wall: depth of a holdout, behind which nothing is seen."""
    shot = layout(folder, "moving", **MOVING)
    held = write_flat(tmp_path / "wall.exr", {"Z": np.full((HEIGHT, WIDTH), wall)})
    assert render(folder, shot, tmp_path, f"--frames 2 --channels motion,alpha {shutter} --holdout {held}") == 0
    now = 2.25 if shutter else 2.0
    here, there = (edit.merge([A, edit.transform(B, moved_by(frame))]) for frame in (now, now + 1))
    places = []
    for model, camera in ((here, camera_at(now)), (there, camera_at(now + 1))):
        p = model.means.astype(np.float64) @ camera.rotation.T + camera.translation
        places.append(p[:, :2] / p[:, 2:] * camera.fx)
    wanted = blended(here, camera_at(now), places[1] - places[0], wall)[0]
    got = pixels_of(tmp_path / "0002.exr")
    alpha, motion = got[:, :, 0], got[:, :, 1:] * [1, -1]  # v is up in a file
    opaque = alpha > 0.5
    assert opaque.sum() > 200
    alphas = []
    for frame in (2.125, 2.375) if shutter else (2.0,):
        merged, camera = edit.merge([A, edit.transform(B, moved_by(frame))]), camera_at(frame)
        alphas.append(blended(merged, camera, np.zeros((len(merged), 1)), wall)[1])
    np.testing.assert_allclose(alpha, np.mean(alphas, axis=0), atol=CLOSE)
    np.testing.assert_allclose(motion[opaque], wanted[opaque], atol=2e-3)  # the twin's bound: 1e-4 of the largest, 15
    assert np.abs(places[1] - places[0]).max() > 5


def blended(model: Gaussians, camera: Camera, values: Float64, wall: float) -> tuple[Float64, Float64]:
    """(H, W, d): means of the Gaussians' values by their weights, of those before a depth; (H, W): the sums of these.
    In float64."""
    projected = forward(model, camera).projected
    sums, total = np.zeros((HEIGHT, WIDTH, values.shape[1])), np.zeros((HEIGHT, WIDTH, 1))
    for layer in layers(projected, WIDTH, HEIGHT):
        if projected.depths[layer.gaussian] < wall:
            weight = np.where(layer.added, layer.before * layer.alpha, 0.0)[:, :, None]
            sums[layer.box] += weight * values[layer.gaussian]
            total[layer.box] += weight
    return sums / np.where(total > 0, total, 1.0), total[:, :, 0]


@pytest.mark.slow
def test_the_same_file_twice_and_a_transform_of_all(folder: Path, tmp_path: Path) -> None:
    path, shift = tmp_path / "shot.json", [0.5, 0, 0.2]
    two = [{"name": str(x), "path": str(folder / "a.ply"), "translate": [x, 0, 0]} for x in (-0.5, 0.5)]
    path.write_text(json.dumps({"clsplat_shot": 1, "models": two}))
    steps = "rotate=0,30,0 translate=0.5,0,0.2"
    assert render(folder, path, tmp_path, "--frames 2", "--transform", steps) == 0
    outer = edit.shifting(shift) @ edit.turning([0, 30, 0])
    merged = edit.merge([edit.transform(A, outer @ edit.shifting([x, 0, 0])) for x in (-0.5, 0.5)])
    wanted = Renderer().render(merged, camera_at(2)).image
    assert np.abs(pixels_of(tmp_path / "0002.exr") - wanted).max() < CLOSE


@pytest.mark.parametrize("kind", ["numbers", "text", "keys", "matrices"])
def test_transforms(kind: str, tmp_path: Path) -> None:
    numbers, path = moved_by(2).ravel().tolist(), tmp_path / "m.json"
    if kind == "numbers":
        track = parse_transform(",".join(map(repr, numbers)))
    elif kind == "text":
        path.write_text("\n".join(map(repr, numbers)))
        track = parse_transform(str(path))
    else:
        matrices = [moved_by(1).tolist(), moved_by(2).tolist(), moved_by(3).tolist()]
        keys = [{"frame": 1 + index, "matrix": matrix} for index, matrix in enumerate(matrices)]
        path.write_text(json.dumps({"keys": keys} if kind == "keys" else {"first_frame": 1, "matrices": matrices}))
        track = parse_transform(str(path))
        assert track.at(1).matrix == rows_of(np.eye(4)) and track.at(0) == track.at(1)
        between = track.at(2.25).transform
        first, last = (np.linalg.det(moved_by(frame)[:3, :3]) ** (1 / 3) for frame in (2, 3))
        scale, turn, shift = edit.decompose(between)
        np.testing.assert_allclose(scale, first**0.75 * last**0.25, rtol=1e-12)
        np.testing.assert_allclose(shift, 0.75 * moved_by(2)[:3, 3] + 0.25 * moved_by(3)[:3, 3], rtol=1e-12)
        way = [edit.decompose(moved_by(frame))[1] for frame in (2, 3)]
        whole, part = (np.arccos((np.trace(b @ way[0].T) - 1) / 2) for b in (way[1], turn))
        np.testing.assert_allclose(part, 0.25 * whole, rtol=1e-9)
    np.testing.assert_array_equal(track.at(2).transform, moved_by(2))


@pytest.mark.slow
def test_skip_existing_sees_the_placements(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    def rendered(shot: Path) -> list[int]:
        capsys.readouterr()
        assert render(folder, shot, tmp_path, "--frames 1-3 --skip-existing --json --height 8 --width 8") == 0
        return [record["frame"] for record in json.loads(capsys.readouterr().out) if not record["skipped"]]

    shot = layout(folder, "again", **MOVING)
    assert rendered(shot) == [1, 2, 3]
    assert rendered(shot) == []
    renamed = folder / "renamed.json"
    renamed.write_bytes(shot.read_bytes())
    assert rendered(renamed) == []  # paths are not in it
    later = {"keys": [MOVING["keys"][0], {**MOVING["keys"][1], "scale": 1.6}]}
    assert rendered(layout(folder, "again", **later)) == [2, 3]
    assert rendered(layout(folder, "again", **later, opacity=0.5)) == [1, 2, 3]


def test_an_ensemble_makes_what_changes() -> None:
    ensemble, still, there = Ensemble([A, B]), Placement(), Placement(rows_of(moved_by(2)))
    both = ensemble.at((still, there))
    assert ensemble.at((still, there)) is both
    assert ensemble.moved((still, there), (still, there)) is None
    assert ensemble.moved((still, there), (still, Placement(there.matrix, 0.5))) is None
    moved = ensemble.moved((still, still), (still, there))
    np.testing.assert_array_equal(moved.means, both.means)


WRONG: list[tuple[dict[str, Any] | str, str]] = [
    ({"opacity": 2}, "model 'b': 'opacity' is 2, expected 0 to 1"),
    ({"visible": 1}, "model 'b': 'visible' is 1, expected true or false"),
    ({"scale": [1, 2, 1]}, "model 'b': 'scale' is [1, 2, 1], expected a number"),
    ({"colour": 1}, "model 'b': 'colour' is not known here, expected one of name, path, mattes, keys"),
    ({"gain": [1, -1, 1]}, "'gain' is [1, -1, 1], expected three numbers of at least 0"),
    ({"keys": []}, "model 'b': has no keys"),
    ({"keys": [{"scale": 1}]}, "model 'b': key 0: has no 'frame'"),
    ({"keys": [{"frame": 1, "scale": 1}, {"frame": 1, "scale": 2}]}, "has two keys at frame 1"),
    ({"scale": 2, "keys": [{"frame": 1, "scale": 1}]}, "has 'scale' for all frames and in keys"),
    ({"matrix": [1, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "frame 0: has a transform that is not a similarity"),
    ({"matrix": [1, 2]}, "'matrix' is [1, 2], expected a list of 16 numbers"),
    ({"first_frame": 3}, "has 'first_frame' without 'matrices'"),
    ({"path": "c.ply"}, "model 'b': "),
    ({"name": "a"}, "model 'a': has a name that is used twice"),
    ("{}", "'clsplat_shot' is None, expected 1"),
    ('{"clsplat_shot": 1, "models": []}', "has no models"),
    ("[", "is not JSON"),
]


@pytest.mark.parametrize(("wrong", "message"), WRONG)
def test_wrong_shots_are_one_line(
    wrong: dict[str, Any] | str, message: str, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    path = folder / "wrong.json"
    if isinstance(wrong, str):
        path.write_text(wrong)
    else:
        layout(folder, "wrong", **wrong)
    line = fails(capsys, render, folder, path, tmp_path / "none", "--frames 1")
    assert str(path) in line and message in line
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2", "expected 16 numbers with commas, found '1,2'"),
        ("spin=1", "'spin' is not known, expected steps of translate, rotate, scale"),
        ("scale=0", "a transform that is not invertible"),
        ("rotate=1,2", "expected 3 numbers"),
        ("none.json", "no such file"),
    ],
)
def test_wrong_transforms_are_one_line(text: str, message: str, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    assert message in fails(capsys, render, folder, folder / "a.ply", tmp_path / "none", "", "--transform", text)


def test_models_that_are_not_drawn_alike(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    replace(B, antialiased=True).save(folder / "soft.ply")
    assert render(folder, layout(folder, "unlike", path="soft.ply"), tmp_path / "none") == 2
    assert "model 'b': is antialiased, unlike model 'a'" in error_line(capsys)
    B.save(folder / "linear.ply", comments=("clsplat colorspace lin_rec709",))
    assert render(folder, layout(folder, "unlike", path="linear.ply"), tmp_path / "none") == 2
    assert "model 'b': has the colour space lin_rec709, expected sRGB like model 'a'" in error_line(capsys)
    assert render(folder, layout(folder, "shot"), tmp_path / "none", "", "--appearance", "x.jpg") == 2
    assert "--appearance x.jpg: is for one run's model" in error_line(capsys)


def test_a_worker_places_what_it_has_read(folder: Path, tmp_path: Path) -> None:
    """Placements come with the tasks: of the shot it reads the models alone."""
    shot, channels = layout(folder, "farm", **MOVING), ("rgb", "motion")
    job_models, options = load_job_models(shot), RenderOptions(channels)
    cameras = read_shot(folder / "cameras.json")
    tasks = make_tasks(cameras.only("2"), cameras, str(tmp_path / "#.exr"), lambda c: c, channels)
    (task,) = job_models.seen(tasks, options.pictures, channels)
    layout(folder, "farm")  # changed meanwhile
    job = WorkerJob(str(shot), job_models.digest, options, RasterizerConfig(), placed=True)
    assert not isinstance(render_frame(pickle.loads(pickle.dumps(task)), job), Failure)
    renderer = Renderer()
    here, there = job_models.at(2), job_models.at(3)
    picture, made = renderer.render_channels(here, camera_at(2), ("motion",), after=camera_at(3), moved=there)
    found = pixels_of(tmp_path / "2.exr")
    np.testing.assert_allclose(found[:, :, :3], picture.image, atol=CLOSE)
    np.testing.assert_allclose(found[:, :, 3:] * [1, -1], made["motion"], atol=1e-4)
    replace(B, opacity_logits=B.opacity_logits + 1).save(folder / "c.ply")
    layout(folder, "farm", path="c.ply")
    failure = render_frame(replace(task, path=tmp_path / "3.exr"), replace(job, memory_limit=1 << 30))
    assert isinstance(failure, Failure) and "on a worker, expected" in failure.message


def test_the_plan_counts_all(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    assert render(folder, layout(folder, "plan", **MOVING), tmp_path, "--dry-run --json --channels motion") == 0
    assert json.loads(capsys.readouterr().out)["gaussians"] == len(A) + len(B)


@pytest.mark.slow
def test_a_path_goes_around_all_models(folder: Path, tmp_path: Path) -> None:
    shot = str(layout(folder, "around"))
    out = ["-o", str(tmp_path / "####.exr"), "--progress", "none", "--width", "20", "--height", "20"]
    assert main(["render", shot, "--path", "turntable", "--count", "1", *out]) == 0
    assert pixels_of(tmp_path / "0001.exr").max() > 0.1
