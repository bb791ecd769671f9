# SPDX-License-Identifier: Apache-2.0
"""Training on fisheye photographs and on panoramas as they are: it learns, repeats to the bit, and goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import printed, refuses
from compare import assert_close, assert_same_arrays, assert_same_bits
from same_bytes import outcome, stopped
from test_trainer import host, quiet
from tiny import HEIGHT, WIDTH, cameras, hidden_model, short, write_scene

from clsplat.api import train
from clsplat.camera import Camera
from clsplat.cli.main import parse
from clsplat.cli.render.flags import RenderVerb
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.evaluation.held_out import EvaluatedModel, evaluate
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.layouts.columns import PLAIN_SLOTS
from clsplat.reference import every_pixel
from clsplat.reference.cameras import pixel_from_cam
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.rendering.renderer import Renderer
from clsplat.runs.run import Run
from clsplat.scenes.dataset import pixels_of
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.shots import choose_shot
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians
from clsplat.training.step.gradient_step import GradientStep, StepProbe
from clsplat.training.step.inputs import ViewInputs

RATES = {group: 10.0**-index for index, group in enumerate(PARAMETER_GROUPS, 2)}
RADIAL = (0.05, -0.02, 0.006, -0.001)
FOCAL = 40.0
LENSES = {
    "fisheye": f"OPENCV_FISHEYE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2} {' '.join(map(str, RADIAL))}",
    "panorama": f"EQUIRECTANGULAR {2 * WIDTH} {WIDTH} {2 * WIDTH} {WIDTH}",
}


def seen_by(name: str, camera: Camera) -> Camera:
    if name == "fisheye":
        return replace(camera, fx=FOCAL, fy=FOCAL, projection="fisheye", radial=RADIAL)
    # From the middle of the arc, and turned so that some of what there is lies on the seam.
    turn = np.diag([-1.0, 1.0, -1.0])
    focal = {"fx": 2 * WIDTH / (2 * np.pi), "fy": WIDTH / np.pi, "cx": float(WIDTH), "cy": WIDTH / 2}
    pose = {"rotation": turn @ camera.rotation, "translation": turn @ camera.translation}
    return replace(camera, width=2 * WIDTH, height=WIDTH, **focal, **pose, projection="equirectangular")


def write_lens_scene(folder: Path, name: str) -> Path:
    write_scene(folder)
    sparse = folder / "sparse" / "0"
    (sparse / "cameras.txt").write_text(f"1 {LENSES[name]}\n")
    lines = (sparse / "images.txt").read_text().splitlines()
    for index, given in enumerate(cameras()):
        camera = seen_by(name, given)
        if name == "panorama":  # a half turn about y before the given one: (w, x, y, z) -> (-y, z, w, -x)
            number, w, x, y, z, *_, lens, file = lines[2 * index].split()
            turned = (-float(y), float(z), float(w), -float(x))
            t = camera.translation
            lines[2 * index] = " ".join([number, *map(repr, turned), *map(repr, t.tolist()), lens, file])
        picture = every_pixel.render(hidden_model(), camera).image
        write_image(folder / "images" / f"{index:02d}.png", np.clip(picture, 0, 1).astype(np.float32))
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module", params=LENSES)
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_lens_scene(tmp_path_factory.mktemp("lens") / "scene", request.param), lenses="native")


def test_the_cameras_are_those_of_the_file(scene: Scene) -> None:
    name = "fisheye" if scene.views[0].camera.projection == "fisheye" else "panorama"
    for view, given in zip(scene.views, cameras(), strict=True):
        wanted = seen_by(name, given)
        for field in ("fx", "fy", "cx", "cy", "rotation", "translation", "radial"):
            assert_close(getattr(view.camera, field), getattr(wanted, field), absolute=1e-9, name=field)
        assert view.load().shape == (wanted.height, wanted.width, 3)
        rows, columns, inside = pixels_of(scene.points, view.camera, view.lens)
        local = scene.points @ view.camera.rotation.T + view.camera.translation
        exact = pixel_from_cam(view.camera, local)[0][inside]
        assert inside.any()
        assert (columns == np.floor(exact[:, 0])).all() and (rows == np.floor(exact[:, 1])).all()


@pytest.mark.slow
@pytest.mark.parametrize("antialiased", [False, True])
def test_it_learns_to_the_held_out_views(scene: Scene, default_device: Device, antialiased: bool) -> None:
    losses: list[float] = []
    steps = replace(quiet(120), antialiased=antialiased)
    model = train(scene, steps, device=default_device, on_step=lambda report: losses.append(report.loss))
    assert losses[-1] < 0.5 * losses[0], losses
    renderer = Renderer(default_device)
    result = evaluate(
        lambda view: renderer.render(model, view.camera).image,
        scene.test_views,
        (0, 0, 0),
        model=EvaluatedModel(None, len(model), None),
    )
    assert result["mean"]["psnr"] > 25


@pytest.mark.slow
@pytest.mark.parametrize("batch", [1, 2])
def test_a_resumed_run_is_an_uninterrupted_one(
    scene: Scene, default_device: Device, tmp_path: Path, batch: int
) -> None:
    config = short(batch=batch, report=False)
    whole = outcome(scene, config, default_device, tmp_path / "whole")
    assert_same_arrays(outcome(scene, config, default_device, tmp_path / "again"), whole)
    assert_same_arrays(stopped(10, scene, config, default_device, tmp_path / "stopped"), whole)


@pytest.mark.slow
def test_gradients_in_memory_change_no_bit(scene: Scene, default_device: Device) -> None:
    """project_step takes the step of project_grad and adam one after the other."""
    camera, photograph = scene.views[0].camera, scene.views[0].load()
    outcomes = []
    for in_memory in (False, True):
        start = upload_gaussians(default_device, hidden_model())
        moments = [allocate_gaussians(default_device, start.count, 1, zero=True) for _ in range(2)]
        step = GradientStep(default_device, Rasterizer(default_device), TrainConfig(), 3, RATES, PLAIN_SLOTS)
        room = allocate_gaussians(default_device, start.count, 1, zero=True) if in_memory else None
        step.run((start, *moments), ViewInputs(0, photograph, camera, np.zeros(3, np.float32)), StepProbe(), room)
        outcomes.append(host(start))
    for group, values in outcomes[0].items():
        assert np.isfinite(values).all()
        assert_same_bits(values, outcomes[1][group])
    assert (outcomes[0]["means"] != hidden_model().means).any()


def test_a_fisheye_is_undistorted_unless_asked(tmp_path: Path) -> None:
    folder = write_lens_scene(tmp_path / "scene", "fisheye")
    assert {view.camera.projection for view in load_scene(folder).views} == {"perspective"}


def test_a_panorama_of_another_size_is_named(tmp_path: Path) -> None:
    folder = write_lens_scene(tmp_path / "scene", "panorama")
    (folder / "sparse/0/cameras.txt").write_text("1 EQUIRECTANGULAR 96 48 96 40\n")
    refuses("expected the size of a full panorama, 96 48", load_scene, folder)


@pytest.mark.slow
def test_frames_are_drawn_through_the_lens_that_the_run_was_trained_with(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scene.source is not None
    run, name = tmp_path / "run", scene.views[0].camera.projection
    train(scene, replace(quiet(2), lenses="native"), run=Run.create(run, replace(quiet(2), lenses="native")))

    def projections(*more: str) -> set[str]:
        words = ["render", str(run), "--cameras", str(scene.source), "-o", str(tmp_path / "{name}.##.png"), *more]
        printed(capsys, [*words, "--overwrite"])
        verb = parse(words)
        assert isinstance(verb, RenderVerb)
        assert verb.lenses is not None
        return {camera.projection for camera in choose_shot(verb.cameras, path=verb.path, lenses=verb.lenses).cameras}

    assert projections() == {name}
    view, drawn = scene.views[0].camera, min(tmp_path.glob("00*.png"))
    assert read_image(drawn).shape[:2] == (view.height, view.width)
    assert projections("--lenses", "undistort") == {"perspective" if name == "fisheye" else name}
    if name == "fisheye":
        assert projections("--path", "turntable", "--count", "2") == {"perspective"}
