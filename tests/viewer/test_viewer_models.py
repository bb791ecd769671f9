# SPDX-License-Identifier: Apache-2.0
"""The viewer's pictures are the renderer's, and a training that is watched has the same bits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import noted, refuses
from tiny import CONFIG, cameras, hidden_model, trained_to, write_scene

from clsplat.api import train
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.gaussians import Gaussians
from clsplat.images.colour import LINEAR, SRGB, displayed
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.training.trainer import Trainer
from clsplat.viewer.appearance import Look, alpha_picture, colour_picture, count_picture, depth_picture, edited
from clsplat.viewer.models import HeldModel, LiveModel, draft
from clsplat.viewer.pose import Pose
from clsplat.viewer.refinement import Level, Share
from clsplat.viewer.scheduler import Viewing

BLACK = (0.0, 0.0, 0.0)
CAMERA = cameras()[3]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("viewer") / "scene"))


def test_every_mode_is_the_renderers(default_device: Device) -> None:
    gaussians, background = hidden_model(), (0.2, 0.3, 0.4)
    model = HeldModel(gaussians, default_device, RasterizerConfig(), background)
    frame, channels = Renderer(default_device).render_channels(gaussians, CAMERA, background=background)
    wanted = {
        "colour": (colour_picture(frame.image), ""),
        "alpha": (alpha_picture(frame.alpha), ""),
        "depth": depth_picture(channels["depth"], frame.alpha),
        "count": count_picture(channels["count"]),
    }
    for mode, (image, text) in wanted.items():
        got, said = model.picture(CAMERA, Look(mode), exact=True)  # type: ignore[arg-type]
        np.testing.assert_array_equal(got, image, err_msg=mode)
        assert said == text
        assert got.std() > 1, mode


def test_a_linear_model_is_shown_in_srgb(default_device: Device) -> None:
    """As `clsplat render --colorspace sRGB` writes it; what is no colour stays as it is."""
    gaussians, background = hidden_model(), (0.2, 0.3, 0.4)
    config = RasterizerConfig()
    plain, linear = (HeldModel(gaussians, default_device, config, background, space) for space in (SRGB, LINEAR))
    frame = Renderer(default_device).render(gaussians, CAMERA, background)
    shown = colour_picture(displayed(frame.image, LINEAR))
    assert (shown[0, 0] > colour_picture(frame.image)[0, 0] + 50).all(), "the background too"
    for look in (Look(), Look(size=0.5)):
        assert (linear.picture(CAMERA, look, exact=True)[0] >= plain.picture(CAMERA, look, exact=True)[0]).all()
    np.testing.assert_array_equal(linear.picture(CAMERA, Look(), exact=True)[0], shown)
    for mode in ("alpha", "depth", "count"):
        pictures = [model.picture(CAMERA, Look(mode), exact=True)[0] for model in (plain, linear)]  # type: ignore[arg-type]
        np.testing.assert_array_equal(*pictures)


def test_drafts_are_near_and_leave_exact_ones_alone(default_device: Device) -> None:
    model = HeldModel(hidden_model(), default_device, RasterizerConfig(), BLACK)
    exact, _ = model.picture(CAMERA, Look(), exact=True)
    quick, _ = model.picture(CAMERA, Look(), exact=False)
    assert np.abs(exact.astype(int) - quick).max() < 20
    np.testing.assert_array_equal(model.picture(CAMERA, Look(), exact=True)[0], exact)
    assert draft(RasterizerConfig(alpha_min=0.1)).alpha_min == 0.1


def test_looks_alternate(default_device: Device) -> None:
    gaussians = hidden_model()
    model = HeldModel(gaussians, default_device, RasterizerConfig(), BLACK)
    looks = [Look(size=0.5), Look(), Look(opacity=0.3), Look(crop=(-1, -1, -1, 0, 1, 1)), Look(size=0.5)]
    for look in looks * 2:
        wanted = Renderer(default_device).render(edited(gaussians, look), CAMERA, BLACK).image
        np.testing.assert_array_equal(model.picture(CAMERA, look, exact=True)[0], colour_picture(wanted))
    refuses("crop box", model.picture, CAMERA, Look(crop=(9, 9, 9, 10, 10, 10)), exact=True)


def test_a_model_far_from_the_origin(default_device: Device) -> None:
    gaussians = hidden_model()
    far = replace(gaussians, origin=np.array([5e5, -3e6, 100.0]))
    pose = Pose(CAMERA.rotation.T, CAMERA.position + far.origin, 0.8, 64, 48)
    near = Pose(CAMERA.rotation.T, CAMERA.position, 0.8, 64, 48)
    got, _ = HeldModel(far, default_device, RasterizerConfig(), BLACK).picture(pose.camera(), Look(), exact=True)
    wanted, _ = HeldModel(gaussians, default_device, RasterizerConfig(), BLACK).picture(
        near.camera(), Look(), exact=True
    )
    assert np.abs(got.astype(int) - wanted).max() <= 1  # the camera is known to 1e-9 of a unit there


def test_a_training_on_linear_photographs_is_shown_in_srgb(default_device: Device, photographs: Scene) -> None:
    views = [replace(view, path=view.path.with_suffix(".exr")) for view in photographs.views]
    trainer = Trainer(photographs, CONFIG, default_device)
    as_it_is, _ = LiveModel(trainer, BLACK).picture(CAMERA, Look(), exact=True)
    trainer.scene = replace(photographs, views=views)
    brighter, _ = LiveModel(trainer, BLACK).picture(CAMERA, Look(), exact=True)
    assert brighter.mean() > as_it_is.mean() + 5


def test_other_models_make_room(default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    model = HeldModel(hidden_model(), default_device, RasterizerConfig(), BLACK)
    wanted, _ = model.picture(CAMERA, Look(size=0.5), exact=True)
    model.picture(CAMERA, Look(), exact=True)
    held = []

    def short(*_: object, **__: object) -> None:
        held.append(len(model._held))
        if len(held) == 1:
            raise CapacityError("no room")

    noted(monkeypatch, Renderer, "render", short)
    np.testing.assert_array_equal(model.picture(CAMERA, Look(size=0.5), exact=True)[0], wanted)
    assert held == [2, 1]


class Watching:
    """A page that moves its camera all the time, in every mode."""

    def __init__(self) -> None:
        self.shown, self.told = 0, []

    def show(self, image: np.ndarray, _level: Level, _text: str) -> None:
        assert image.dtype == np.uint8
        self.shown += 1

    def tell(self, message: str) -> None:
        self.told.append(message)


def watched(scene: Scene, device: Device, share: Share | None = None, **limits: str) -> tuple[Gaussians, Watching]:
    viewing, page = Viewing(), Watching()
    viewer = viewing.join(page)
    looks = [Look(), Look("depth"), Look("count"), Look("alpha"), Look(size=0.5), Look(degree=0)]

    def between(trainer: Trainer, _interrupted: object) -> None:
        viewing.model = viewing.model or LiveModel(trainer, BLACK)
        place = CAMERA.position + 0.01 * trainer.step
        viewing.moved(viewer, Pose(CAMERA.rotation.T, place, 0.8, 640, 480))
        viewing.looks(viewer, looks[trainer.step % len(looks)])
        viewing.work(share)

    return train(scene, CONFIG, device=device, between=between, **limits), page  # type: ignore[arg-type]


def same(one: Gaussians, other: Gaussians) -> bool:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def test_a_watched_training_has_the_same_bits(device: Device, photographs: Scene) -> None:
    alone = train(photographs, CONFIG, device=device)
    model, page = watched(photographs, device)
    assert page.shown >= CONFIG.iterations
    assert page.told == []
    assert same(model, alone)


def test_a_training_in_little_memory_shows_what_it_can(default_device: Device, photographs: Scene) -> None:
    fresh = Device(default_device.cl_device)
    fresh.memory.limit = 64 << 20
    alone = train(photographs, CONFIG, device=default_device)
    model, page = watched(photographs, fresh)
    assert same(model, alone)
    assert page.shown >= CONFIG.iterations // 3
    assert "only unedited colour and alpha" in page.told[0]


def test_a_picture_of_a_training_is_the_models(default_device: Device, photographs: Scene, tmp_path: Path) -> None:
    trainer = trained_to(3, photographs, CONFIG, default_device)
    live = LiveModel(trainer, BLACK)
    assert live.version == 3
    held = HeldModel(trainer.gaussians(), default_device, CONFIG.rasterizer, BLACK)
    for look in (Look(), Look("depth"), Look(size=0.7)):
        got, _ = live.picture(CAMERA, look, exact=False)
        np.testing.assert_array_equal(got, held.picture(CAMERA, look, exact=True)[0])
    assert live.pixels == CAMERA.width * CAMERA.height
