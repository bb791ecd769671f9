# SPDX-License-Identifier: Apache-2.0
"""Scenes far from the world's origin: trained and rendered as if they were near it, and written where they are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from calls import train as train_by_command
from models import assert_equal, random_gaussians
from same_bytes import trained_run
from scipy.spatial.transform import Rotation
from tiny import CONFIG, cameras, write_scene

from clsplat.api import train
from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.images.reading import read_image
from clsplat.models.formats import ply
from clsplat.reference import render as reference
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import FAR_ORIGIN_RATIO

OFFSET = np.array([5e5, -4.2e6, 333.3])
"""As UTM coordinates are: metres, far from their zero."""


def far_scene(folder: Path, offset: np.ndarray = OFFSET) -> Path:
    """The tiny scene, moved."""
    write_scene(folder)
    model = folder / "sparse" / "0"
    lines = []
    for line in (model / "images.txt").read_text().splitlines():
        words = line.split()
        if words:
            w, x, y, z, *translation = (float(word) for word in words[1:8])
            moved = np.array(translation) - Rotation.from_quat([x, y, z, w]).as_matrix() @ offset
            words[5:8] = [repr(value) for value in moved.tolist()]
        lines.append(" ".join(words) + "\n")
    (model / "images.txt").write_text("".join(lines))
    lines = []
    for line in (model / "points3D.txt").read_text().splitlines():
        words = line.split()
        words[1:4] = [repr(float(word) + by) for word, by in zip(words[1:4], offset.tolist(), strict=True)]
        lines.append(" ".join(words) + "\n")
    (model / "points3D.txt").write_text("".join(lines))
    return folder


def far_model(seed: int = 3) -> Gaussians:
    return replace(random_gaussians(200, seed=seed), origin=np.array([5e5, -4.2e6, 332.0]))


def test_an_ordinary_scene_has_its_own_origin(scene: Path) -> None:
    assert not load_scene(scene).origin.any()


def test_just_far_enough(tmp_path: Path) -> None:
    size = load_scene(far_scene(tmp_path / "at", np.zeros(3))).extent / 1.1
    near = load_scene(far_scene(tmp_path / "near", np.array([0.9 * FAR_ORIGIN_RATIO * size, 0, 0])))
    far = load_scene(far_scene(tmp_path / "far", np.array([1.1 * FAR_ORIGIN_RATIO * size, 0, 0])))
    assert not near.origin.any()
    assert far.origin.any()


def test_a_far_scene_counts_from_its_middle(tmp_path: Path) -> None:
    loaded = load_scene(far_scene(tmp_path / "far"))
    assert np.linalg.norm(loaded.origin - OFFSET) < 2 * loaded.extent
    # cameras and points stay in the world, as what reads them expects
    assert np.linalg.norm(loaded.points.mean(axis=0) - OFFSET) < loaded.extent


def test_training_is_as_near_the_origin(scene: Path, tmp_path: Path, default_device: Device) -> None:
    scores = []
    for name, folder in (("near", scene), ("far", far_scene(tmp_path / "scene"))):
        run = trained_run(load_scene(folder), CONFIG, default_device, tmp_path / name)
        scores.append(json.loads(run.eval_path.read_text())["mean"]["psnr"])
    # cameras that are given to 1e-10, and a grid of float32 that lies otherwise: 1e-7 in positions, grown by training
    assert abs(scores[0] - scores[1]) < 0.01


def test_commands_from_training_to_frames(tmp_path: Path) -> None:
    folder, run, again = far_scene(tmp_path / "scene"), tmp_path / "run", tmp_path / "again"
    config = replace(CONFIG, iterations=20)
    assert train_by_command(folder, run, config) == 0
    at_end = json.loads((run / "eval.json").read_text())["mean"]
    model = Gaussians.load(run / "model.ply")
    assert model.origin.any()
    assert np.abs(model.means).max() < 100
    # eval reads the model back, and measures the same to the last digit
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "eval.json").read_text())["mean"]["psnr"] == at_end["psnr"]
    # and render, from cameras in the world
    assert main(["render", str(run), "--cameras", str(folder), "-o", str(again / "{name}.png")]) == 0
    for name in ("00", "08"):
        np.testing.assert_array_equal(read_image(again / f"{name}.png"), read_image(run / "test" / f"{name}.png"))


def test_resume_gives_the_same_bytes(tmp_path: Path, default_device: Device) -> None:
    loaded = load_scene(far_scene(tmp_path / "scene"))
    whole = train(loaded, replace(CONFIG, iterations=12), device=default_device)
    run = trained_run(loaded, replace(CONFIG, iterations=6, checkpoint_every=6), default_device, tmp_path / "run")
    resumed = train(loaded, replace(CONFIG, iterations=12), device=default_device, run=run, resume=True)
    assert_equal(whole, resumed)
    np.testing.assert_array_equal(whole.origin, resumed.origin)


def test_render_counts_from_the_origin(default_device: Device) -> None:
    model = random_gaussians(200, seed=3)
    model.log_scales -= 2
    view = cameras()[0]
    near = Renderer(default_device).render(model, view)
    origin = np.array([1e6, -2e6, 3e5])
    moved = replace(view, translation=view.translation - view.rotation @ origin)
    far = Renderer(default_device).render(replace(model, origin=origin), moved)
    # the camera's way to 2e6 and back in float64 costs 1e-9; the means are the same
    assert np.abs(far.image - near.image).max() < 1e-5
    wanted, _ = reference.render(replace(model, origin=origin), moved)
    assert np.median(np.abs(far.image - wanted)) < 1e-6


def test_model_file_comes_back_bit_for_bit(tmp_path: Path) -> None:
    model = far_model()
    model.save(tmp_path / "model.ply")
    again = Gaussians.load(tmp_path / "model.ply")
    assert_equal(again, model)
    np.testing.assert_array_equal(again.origin, model.origin)
    again.save(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "model.ply").read_bytes()


def test_other_tools_find_the_world_in_the_usual_place(tmp_path: Path) -> None:
    model = far_model()
    model.save(tmp_path / "model.ply")
    head, _, data = (tmp_path / "model.ply").read_bytes().partition(b"end_header\n")
    width = 62  # floats of a vertex of degree 3, which some viewers take for granted
    table = np.frombuffer(data[: 4 * width * len(model)], "<f4").reshape(len(model), width)
    np.testing.assert_array_equal(table[:, :3], (model.means + model.origin).astype(np.float32))
    assert head.index(b"element vertex") < head.index(b"element clsplat_local")


def edited(path: Path, model: Gaussians) -> tuple[bytes, np.ndarray]:
    model.save(path)
    head, mark, data = path.read_bytes().partition(b"end_header\n")
    return head + mark, np.frombuffer(data, "<f4").copy()


def test_vertices_that_another_tool_has_moved_count(tmp_path: Path) -> None:
    model, path = far_model(), tmp_path / "model.ply"
    head, data = edited(path, model)
    data[0] += 100  # x of the first
    path.write_bytes(head + data.tobytes())
    again = Gaussians.load(path)
    wanted = model.means.copy()
    wanted[0, 0] = np.float64(data[0]) - model.origin[0]
    np.testing.assert_array_equal(again.means, wanted)


def test_without_the_element_the_rounded_vertices_count(tmp_path: Path) -> None:
    model, path = far_model(), tmp_path / "model.ply"
    head, data = edited(path, model)
    before, _, _ = head.partition(b"element clsplat_local")
    path.write_bytes(before + b"end_header\n" + data[: 62 * len(model)].tobytes())
    again = Gaussians.load(path)
    np.testing.assert_array_equal(again.origin, model.origin)
    assert np.abs(again.means - model.means).max() <= 0.25  # half of what float32 steps by at 4.2e6
    # and without the comment they are in the world
    path.write_bytes(path.read_bytes().replace(b"comment clsplat origin", b"comment someone else"))
    alone = Gaussians.load(path)
    assert not alone.origin.any()
    np.testing.assert_array_equal(alone.means, (model.means + model.origin).astype(np.float32))


def test_cut_element_is_named(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    far_model().save(path)
    path.write_bytes(path.read_bytes()[:-1])
    refuses(r"truncated: element clsplat_local needs 2400 bytes but has 2399", Gaussians.load, path)


@pytest.mark.parametrize("words", ["nan 0 0", "1 2", "a b c", "inf 0 0", "1 2 3 4", ""])
def test_comments_that_are_no_origin(words: str, tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    random_gaussians(5).save(path)
    path.write_bytes(path.read_bytes().replace(b"element", f"comment clsplat origin {words}\nelement".encode(), 1))
    assert not Gaussians.load(path).origin.any()


def test_origin_out_of_all_bounds(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    random_gaussians(5).save(path)
    path.write_bytes(path.read_bytes().replace(b"element", b"comment clsplat origin 1e300 0 0\nelement", 1))
    refuses("gives means that are not finite", Gaussians.load, path)


def test_origin_is_checked() -> None:
    refuses("origin is float32", replace(random_gaussians(2), origin=np.zeros(3, np.float32)).check, error=ValueError)


def test_a_near_model_has_no_new_bytes(tmp_path: Path) -> None:
    random_gaussians(3).save(tmp_path / "model.ply")
    with open(tmp_path / "model.ply", "rb") as file:
        header = ply.read_header(file, tmp_path / "model.ply")
    assert [element.name for element in header.elements] == ["vertex"]
    assert header.origin is None
