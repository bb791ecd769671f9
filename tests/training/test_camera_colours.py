# SPDX-License-Identifier: Apache-2.0
"""Gains and mixes of photographs and vignettes of lenses, learnt with the model."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from compare import assert_close
from held_out import change_photographs, psnr_of
from tiny import CONFIG, trained_to

from clsplat.api import train
from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.evaluation import metrics
from clsplat.gaussians import Gaussians
from clsplat.models.edit import exposed
from clsplat.reference.appearance import spread
from clsplat.reference.ppisp import light, unmixing
from clsplat.rendering.renderer import Renderer
from clsplat.runs.appearance import gains_of
from clsplat.runs.checkpoints import Checkpoint
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.appearance.colours import ColoursOfAll
from clsplat.training.trainer import Trainer

OF_CAMERAS = replace(CONFIG, appearance="ppisp")
MIXES = np.array([0.15, 0.0, 0.0, 0.15, 0.15, 0.0])
CORNERS = -1.0
"""Octaves of light in the corners, along s."""


def taken_otherwise(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    """Let photographs be float, mixed by MIXES and against them by turns, and dark in the corners."""

    def change(index: int, values: np.ndarray) -> np.ndarray:
        height, width, _ = values.shape
        camera = scene.train_views[index].camera
        centre = camera.cx / camera.width * width, camera.cy / camera.height * height
        values = values @ np.linalg.inv(unmixing(MIXES * (1 if index % 2 else -1))).T
        return values * light(np.array([CORNERS, 0, 0]), spread(width, height, centre))[:, :, None]

    change_photographs(monkeypatch, change)


@pytest.fixture(scope="module")
def learnt(scene: Scene, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of such photographs."""
    density = replace(CONFIG.density, every=0)
    config = replace(OF_CAMERAS, iterations=400, density=density, warmup=())
    run = Run.create(tmp_path_factory.mktemp("runs") / "run", config)
    with pytest.MonkeyPatch.context() as patch:
        taken_otherwise(patch, scene)
        train(scene, config, device=default_device, run=run)
    return run


def test_mixes_and_vignettes_are_learnt(scene: Scene, learnt: Run) -> None:
    record = json.loads(learnt.appearance_path.read_text("utf-8"))
    assert record["kind"] == "ppisp"
    rows = [record["photographs"][view.name] for view in scene.train_views]
    vignettes = {tuple(row["vignette"]) for row in rows}
    assert len(vignettes) == 1, "one lens took all"
    assert abs(sum(next(iter(vignettes))) - CORNERS) < 0.4  # in the corners; all views look at one place
    mixes = np.array([row["mixes"] for row in rows])
    along = (np.where(np.arange(len(rows)) % 2, 1.0, -1.0)[:, None] * mixes)[:, MIXES > 0]
    assert along.mean(axis=0).min() > 0.03  # of 0.15; so few steps
    for view in scene.test_views:
        assert tuple(record["held_out"][view.name]["vignette"]) in vignettes


def test_a_model_with_the_colours_of_a_photograph(scene: Scene, learnt: Run, tmp_path: Path) -> None:
    """`render --appearance` has the matrix of the photograph, which is the inverse of what developing does."""
    name = scene.train_views[1].name
    row = json.loads(learnt.appearance_path.read_text("utf-8"))["photographs"][name]
    matrix = np.array(gains_of(learnt.path, name)).reshape(3, 3)
    developing = unmixing(np.array(row["mixes"])) @ np.diag(2.0 ** -np.array(row["log2_gains"]))
    assert_close(matrix @ developing, np.eye(3), absolute=1e-12)
    model = Gaussians.load(learnt.model_path)
    half, dc = 0.5, 0.28209479177387814
    colours, seen = (half + dc * each.sh[:, 0].astype(float) for each in (model, exposed(model, matrix.ravel())))
    assert_close(seen, colours @ matrix.T, absolute=5e-6)  # roundings of coefficients up to 8
    cameras, pattern = str(scene.train_views[1].path.parents[1]), f"{tmp_path}/{{name}}.png"
    assert main(["render", str(learnt.path), "--cameras", cameras, "-o", pattern, "--appearance", name]) == 0
    assert list(tmp_path.rglob("*.png"))


def test_held_out_views_are_seen_through_their_lens(scene: Scene, learnt: Run, default_device: Device) -> None:
    """By `eval` as at the end of training, though nothing is learnt of these views; and through another lens."""
    before = json.loads(learnt.eval_path.read_text("utf-8"))["mean"]["psnr"]
    record = json.loads(learnt.appearance_path.read_text("utf-8"))
    folder, (vignette, centre) = str(scene.train_views[0].path.parents[1]), ([-4.0, 1.0, 0.0], (0.25, 0.75))
    assert main(["eval", str(learnt.path), "--scene", folder]) == 0
    again = json.loads(learnt.eval_path.read_text("utf-8"))["mean"]["psnr"]
    assert again == pytest.approx(before, abs=1e-3)  # of a model in a file, activated once more
    rows = {view.name: {"log2_gains": [0.5] * 3, "vignette": vignette, "centre": centre} for view in scene.test_views}
    learnt.appearance_path.write_text(json.dumps(record | {"held_out": rows}), "utf-8")
    assert main(["eval", str(learnt.path), "--scene", folder]) == 0
    got = json.loads(learnt.eval_path.read_text("utf-8"))["mean"]["psnr"]
    learnt.appearance_path.write_text(json.dumps(record), "utf-8")
    model, found = Gaussians.load(learnt.model_path), []
    for view in scene.test_views:
        width, height = view.camera.width, view.camera.height
        left = light(np.array(vignette), spread(width, height, (centre[0] * width, centre[1] * height)))
        image = Renderer(default_device).render(model, view.camera).image * 2**0.5 * left[:, :, None]
        found.append(metrics.psnr(image, view.load()[:, :, :3]))
    assert got == pytest.approx(np.mean(found), abs=1e-3)
    assert got < before - 1


@pytest.mark.parametrize(
    "change",
    [
        *({"mixes": [0.0] * 5}, {"mixes": [0.3] * 6}, {"vignette": [1.0, "x", 0.0]}, {"vignette": None}),
        *({"centre": [0.5]}, {"log2_gains": "123"}, {"log2_gains": [10**400, 0, 0]}),
    ],
    ids=["five", "large", "no number", "none", "one", "text", "huge"],
)
def test_a_damaged_row(tmp_path: Path, change: dict[str, object]) -> None:
    run = Run.create(tmp_path / "run", OF_CAMERAS)
    row = {"log2_gains": [0.0] * 3, "mixes": [0.0] * 6, "vignette": [0.0] * 3, "centre": [0.5, 0.5]} | change
    run.write_appearance({"kind": "ppisp", "photographs": {"a.jpg": row}, "held_out": {}})
    refuses(r"appearance.json: .*expected a file that clsplat train --appearance", gains_of, run.path, "a.jpg")


def with_two_lenses(scene: Scene) -> Scene:
    """The scene, of which the first training photograph and the held-out ones are taken through a lens of their own."""
    first, *others = scene.train_views
    focal, *rest = first.lens.params
    other = replace(first.lens, params=(np.nextafter(focal, 0), *rest))
    return replace(scene, views=[first, *(replace(view, lens=other) for view in others), *scene.test_views])


def test_lenses_move_by_themselves(default_device: Device, scene: Scene) -> None:
    """A photograph's step moves its own lens's vignette alone."""
    trainer = Trainer(with_two_lenses(scene), OF_CAMERAS, default_device)
    appearance = trainer.appearance
    assert isinstance(appearance, ColoursOfAll)
    assert appearance.arrays()["appearance/lenses_logs"].shape == (2, 3)
    trainer.train_step()
    assert appearance.arrays()["appearance/lenses_first"].any(axis=1).sum() == 1


def test_a_checkpoint_of_other_lenses_is_refused(default_device: Device, scene: Scene) -> None:
    trainer = Trainer(scene, replace(CONFIG, appearance="exposure"), default_device)
    trainer.train_step()
    with pytest.raises(InputError, match="appearance/lenses_logs"):
        Trainer(scene, OF_CAMERAS, default_device).restore(Checkpoint(1, *trainer.checkpoint()))
    of_two = Trainer(with_two_lenses(scene), OF_CAMERAS, default_device)
    of_two.train_step()
    with pytest.raises(InputError, match=r"appearance/lenses_logs of shape \(1, 3\)"):
        Trainer(scene, OF_CAMERAS, default_device).restore(Checkpoint(1, *of_two.checkpoint()))


def test_photographs_that_are_alike_are_left_so(default_device: Device, scene: Scene) -> None:
    """A common part of photographs is the model's: the mean of all is 0 after each step, and no mix is large."""
    trainer = trained_to(40, scene, replace(OF_CAMERAS, appearance_rate=1e-4), default_device)
    arrays = trainer.checkpoint()[0]
    assert_close(arrays["appearance/logs"].mean(axis=0), np.zeros(9), absolute=1e-6)
    assert np.abs(arrays["appearance/logs"][:, 3:]).max() < 0.05  # of 0.2, the bound
    assert arrays["appearance/lenses_logs"].shape == (1, 3)


def test_where_a_photograph_was_taken(default_device: Device, scene: Scene) -> None:
    """The principal point in parts of an oblong picture, none for a panorama, and the mean of all lenses for a
    held-out photograph through another."""
    first, second, *others = with_two_lenses(scene).train_views
    camera = replace(first.camera, cx=0.25 * first.camera.width, cy=0.75 * first.camera.height)
    around = replace(second.camera, projection="equirectangular")
    views = [replace(first, camera=camera), replace(second, camera=around), *others]
    held = [replace(view, lens=replace(view.lens, model="unknown")) for view in scene.test_views]
    appearance = ColoursOfAll(OF_CAMERAS, default_device, replace(scene, views=[*views, *held]))
    taken = [view.taken for view in appearance.of_views([0, 1], 2)]
    assert [(each.photograph, each.lens, each.flat) for each in taken] == [(0, 0, True), (1, 1, False)]
    assert taken[0].centre == (0.25, 0.75)
    lenses = np.array([[-1.0, 0.5, 0.25], [0.5, 0.25, -0.5]], np.float32)
    held_arrays = {name.removeprefix("appearance/"): array for name, array in appearance.arrays().items()}
    appearance.take(held_arrays | {"lenses_logs": lenses})
    record = appearance.record()
    assert record["photographs"][first.name]["vignette"] == lenses[0].tolist()
    assert record["photographs"][first.name]["centre"] == [0.25, 0.75]
    for view in held:
        assert record["held_out"][view.name]["vignette"] == lenses.mean(axis=0).tolist()


def test_refined_cameras_are_judged_through_the_lens(
    scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A render that is right comes to what its photograph shows; without the lens's look it would be far off."""
    trainer = Trainer(scene, replace(OF_CAMERAS, refine_poses=True), default_device)
    vignette = {"vignette": [CORNERS, 0.0, 0.0], "centre": [0.5, 0.5], "log2_gains": [0.0] * 3}
    cameras = [view.camera for view in trainer.validation_views.views]
    found = {}
    for name, row in (("through", vignette), ("without", {"log2_gains": [0.0] * 3})):
        record = {"held_out": {view.name: row for view in scene.test_views}}
        monkeypatch.setattr(trainer.appearance, "record", lambda record=record: record)
        with monkeypatch.context() as patch:
            change_photographs(patch, dark(trainer))
            found[name] = psnr_of(trainer, cameras)
    assert found["through"] > 60  # rounded to float32
    assert found["without"] < found["through"] - 10


def dark(trainer: Trainer) -> Callable[[int, object], np.ndarray]:
    """What the model shows of a validation view, dark in the corners."""
    renderer = Renderer(trainer.device, trainer.rasterizer)

    def change(index: int, _: object) -> np.ndarray:
        camera = trainer.validation_views.views[index].camera
        image = renderer.render(trainer.parameters, trainer.local(camera), (0, 0, 0)).image[:, :, :3]
        middle = camera.width / 2, camera.height / 2
        return image * light(np.array([CORNERS, 0, 0]), spread(camera.width, camera.height, middle))[:, :, None]

    return change
