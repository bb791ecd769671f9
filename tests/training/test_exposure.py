# SPDX-License-Identifier: Apache-2.0
"""The exposure of photographs, learnt with the model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from compare import assert_same_bits
from held_out import change_photographs
from pictures import write_pixels
from same_bytes import trained_run
from tiny import CONFIG, trained_to

from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.evaluation import metrics
from clsplat.images.exif import exposure_of
from clsplat.images.reading import read_image
from clsplat.runs.appearance import held_out_looks
from clsplat.runs.checkpoints import Checkpoint
from clsplat.scenes.analysis.visible_points import VisiblePoints
from clsplat.scenes.scene import Scene, View
from clsplat.training.appearance import colours
from clsplat.training.appearance.colours import ColoursOfAll
from clsplat.training.trainer import Trainer

EXPOSED = replace(CONFIG, appearance="exposure")


def test_a_batch_learns_from_all_of_its_views(default_device: Device, scene: Scene) -> None:
    batch = len(scene.train_views)
    trainer = Trainer(scene, replace(EXPOSED, batch=batch), default_device)
    trainer.train_step()
    trainer.train_step()
    logs = trainer.checkpoint()[0]["appearance/logs"]
    assert logs.any(axis=1).all()
    assert trainer.step == 2 * batch


def test_gains_begin_where_the_points_have_them(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By EXIF, which tells nothing here, for photographs of which the points tell nothing."""
    first, second, *others = (view.name for view in scene.train_views)
    told = {first: np.array([1.0, 0.5, 0.0]), second: np.array([-1.0, 0.25, 0.0])}
    monkeypatch.setattr(VisiblePoints, "exposures", told)
    arrays = ColoursOfAll(EXPOSED, default_device, scene).arrays()
    start = np.array([told[first], told[second], *(np.zeros(3) for _ in others)])
    # rounded to a 1024th
    np.testing.assert_allclose(arrays["appearance/logs"], start - start.mean(axis=0), atol=2.0**-11)
    np.testing.assert_array_equal(arrays["appearance/start"], arrays["appearance/logs"])
    told = arrays["appearance/told"].any(axis=1)
    assert told.tolist() == [True, True, *(False for _ in others)], "those of which points tell"


def test_gains_that_points_tell_are_held_there(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a pull that is far stronger than the loss, of each or of what neighbours have in common, they stay; without
    one they go where the loss is least."""
    truth = dict.fromkeys((view.name for view in scene.train_views), np.zeros(3))
    truth |= {scene.train_views[0].name: np.full(3, 0.5), scene.train_views[1].name: np.full(3, -0.5)}
    monkeypatch.setattr(VisiblePoints, "exposures", truth)
    moved = {}
    for pulls in ((0.0, 0.0), (1e3, 0.0), (0.0, 1e3)):
        for name, pull in zip(("VIEW_PULL_WEIGHT", "NEIGHBOUR_PULL_WEIGHT"), pulls, strict=True):
            monkeypatch.setattr(colours, name, pull)
        trainer = trained_to(30, scene, EXPOSED, default_device)
        arrays = trainer.checkpoint()[0]
        moved[pulls] = np.abs(arrays["appearance/logs"] - arrays["appearance/start"]).max()
    assert moved[1e3, 0.0] < 0.3 * moved[0.0, 0.0], moved
    assert moved[0.0, 1e3] < 0.3 * moved[0.0, 0.0], moved


def exposed(monkeypatch: pytest.MonkeyPatch, logs: np.ndarray) -> None:
    """Let photographs be float, of these exposures (photographs,)."""
    change_photographs(monkeypatch, lambda index, values: values * np.float32(2.0 ** logs[index]))


def test_exposures_that_are_known_change_no_bit(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A photograph counts alike, however bright it is: in the model by powers of two, which round nothing, to the
    bit; in its gains but for the rounding of their logs."""
    truth = np.zeros(len(scene.train_views))
    truth[:4] = 1.0, -1.0, 2.0, -2.0
    arrays = []
    for logs in (np.zeros_like(truth), truth):
        with monkeypatch.context() as patch:
            exposed(patch, logs)
            told = {view.name: np.full(3, log) for view, log in zip(scene.train_views, logs, strict=True)}
            patch.setattr(VisiblePoints, "exposures", told)
            trainer = Trainer(scene, replace(EXPOSED, batch=len(truth)), default_device)
            trainer.train_step()
            arrays.append(trainer.checkpoint()[0])
    wanted, got = arrays
    moved = [each["appearance/logs"] - each["appearance/start"] for each in arrays]
    assert moved[0].all()
    np.testing.assert_allclose(moved[1], moved[0], rtol=0, atol=3e-7)  # of up to 2, in 24 bits
    for name in ("appearance/first", "appearance/second"):
        np.testing.assert_allclose(got[name], wanted[name], rtol=1e-5, atol=1e-12, err_msg=name)
    models = [name for name in wanted if not name.startswith("appearance/")]
    assert any("second" in name for name in models), "squares of the model's gradients"
    for name in models:
        assert_same_bits(got[name], wanted[name], name)


def test_gains_of_photographs_are_learnt(
    default_device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    truth = np.where(np.arange(len(scene.train_views)) % 2, 1.0, -1.0)
    exposed(monkeypatch, truth)
    config = replace(EXPOSED, iterations=400, density=replace(CONFIG.density, every=0), warmup=())
    run = trained_run(scene, config, default_device, tmp_path / "run")
    record = json.loads(run.appearance_path.read_text("utf-8"))
    logs = np.array([record["photographs"][view.name]["log2_gains"] for view in scene.train_views])
    assert np.abs(logs.mean(axis=0)).max() < 1e-6
    assert np.abs(logs - truth[:, None]).max() < 0.3  # of 2; so few steps
    assert "psnr_corrected" in json.loads(run.eval_path.read_text("utf-8"))["mean"]
    name, cameras = scene.train_views[1].name, str(scene.train_views[1].path.parents[1])
    flags: dict[str, list[str]] = {"plain": [], "exposed": ["--appearance", name]}
    frames = {}
    for kind, more in flags.items():
        pattern = f"{tmp_path}/{kind}/{{name}}.exr"
        assert main(["render", str(run.path), "--cameras", cameras, "-o", pattern, "--exr", "float", *more]) == 0
        frames[kind] = read_image(next((tmp_path / kind).rglob("*.exr")))
    factors = 2.0 ** np.array(record["photographs"][name]["log2_gains"])
    assert frames["plain"].max() > 0.2
    # Coefficients and colours of up to 4, rounded.
    np.testing.assert_allclose(frames["exposed"], frames["plain"] * factors, atol=2e-5)


def test_exposures_that_exif_tells(default_device: Device, scene: Scene, tmp_path: Path) -> None:
    """Gains begin there; held-out photographs get what goes with theirs."""

    def told(index: int, view: View) -> View:
        path = tmp_path / f"{index}.png"
        pixels = np.rint(255 * view.load()[:, :, :3]).astype(np.uint8)
        time, stop, speed = [(1 / 60, 2.0, 100), (1 / 30, 2.0, 100), (1 / 60, 2.0, 400), (1 / 60, 4.0, 100)][index % 4]
        film = {} if index == 3 else {"Exif:PhotographicSensitivity": speed}
        return replace(
            view, path=write_pixels(path, pixels, attributes={"ExposureTime": time, "FNumber": stop, **film})
        )

    scene = replace(scene, views=[told(index, view) for index, view in enumerate(scene.views)])
    exposures = {view.name: exposure_of(view.path) for view in scene.views}
    assert [value is None for value in exposures.values()] == [index == 3 for index in range(len(exposures))]
    appearance = ColoursOfAll(EXPOSED, default_device, scene)
    record = appearance.record()
    assert record is not None
    known = [value for view in scene.train_views if (value := exposures[view.name]) is not None]
    for view in scene.views:
        exposure = exposures[view.name]
        wanted = 0.0 if exposure is None else (exposure - np.mean(known)) / 2.2
        got = record["photographs" if view.split == "train" else "held_out"][view.name]["log2_gains"]
        np.testing.assert_allclose(got, 3 * [wanted], atol=1e-6)  # of 32 bits
    assert sum(view.split == "test" and exposures[view.name] is not None for view in scene.views)
    seen, view = held_out_looks(record), scene.test_views[0]
    white = np.ones((view.camera.height, view.camera.width, 3), np.float32)
    gains = 2.0 ** np.array(record["held_out"][view.name]["log2_gains"])
    np.testing.assert_allclose(seen(view.name, white), white * gains, rtol=1e-6)
    assert (seen("elsewhere", white) == 1).all()


def test_switched_off_there_is_nothing_of_it(default_device: Device, scene: Scene) -> None:
    trainer = Trainer(scene, CONFIG, default_device)
    trainer.train_step()
    assert not any(name.startswith("appearance") for name in trainer.checkpoint()[0])
    assert trainer.appearance.record() is None


def test_a_checkpoint_without_gains_is_refused(default_device: Device, scene: Scene) -> None:
    trainer = Trainer(scene, CONFIG, default_device)
    trainer.train_step()
    refuses("appearance/logs", Trainer(scene, EXPOSED, default_device).restore, Checkpoint(1, *trainer.checkpoint()))


def test_settings_that_exclude_each_other() -> None:
    with pytest.raises(InputError, match=r"--appearance exposure: excludes --masks transparent"):
        TrainConfig(appearance="exposure", masks="transparent").check()


def test_colours_are_corrected_by_an_affine_map() -> None:
    rng = np.random.default_rng(3)
    image = rng.random((9, 8, 3))
    truth = image @ rng.uniform(0, 0.3, (3, 3)) + 0.05
    np.testing.assert_allclose(metrics.corrected(image, truth), truth, atol=1e-12)


def test_corrected_psnr_knows_values_over_one() -> None:
    rng = np.random.default_rng(4)
    image, noise = rng.random((9, 8, 3)), rng.normal(0, 0.01, (9, 8, 3))
    bright = 3 * image + 0.5
    assert metrics.psnr_corrected(image, bright) > 100
    assert metrics.psnr_corrected(image + noise, bright) < 32  # of 3 times 0.01, 30.5 dB, where most of it is over 1
    counts = np.zeros((9, 8), bool)
    counts[:4] = True
    spoiled = np.where(counts[:, :, None], bright, 1e6)
    assert metrics.psnr_corrected(image, spoiled, counts) > 100
