# SPDX-License-Identifier: Apache-2.0
"""What training does about numbers that are not finite: mends, tells, goes back with smaller steps, gives up."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bench_guards
import numpy as np
import pytest
from calls import Capture, noted, peak_of, ran, refuses
from calls import train as command_train
from compare import assert_same_bits
from quick import quick
from tiny import CONFIG, run_steps, short, trained_to

from clsplat.api import train
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.device.context import Device
from clsplat.device.source import kernel_source
from clsplat.errors import ClsplatError
from clsplat.gaussians import MAX_SH_COEFFICIENT, PARAMETER_GROUPS, group_shapes
from clsplat.runs.checkpoints import read_checkpoint, write_checkpoint
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.spherical_harmonics import sh_basis
from clsplat.stages.device_gaussians import KINDS, HostArray
from clsplat.training import repro_bundle
from clsplat.training.stability import health
from clsplat.training.stability.health import (
    MAX_CHECKPOINT_RETURNS,
    MAX_TROUBLED_STEPS,
    RETURN_RATE_FACTOR,
    TROUBLE_WINDOW_STEPS,
    RetryBudget,
    examine,
    finite_or_zero,
    lost,
)
from clsplat.training.trainer import Trainer

CHECKED = short(checkpoint_every=5)


Due = Callable[[Trainer], bool]


@contextmanager
def spoilt(due: Due, group: str = "means", row: int = 5, value: float = np.nan) -> Iterator[None]:
    """Before a step that is due a parameter turns bad, as in a memory that forgets."""

    def spoil(trainer: Trainer, **_: bool) -> None:
        if due(trainer):
            values = trainer.parameters[group].get()
            values.reshape(len(values), -1)[row, 0] = value
            trainer.parameters[group].set(values)

    with pytest.MonkeyPatch.context() as patch:
        noted(patch, Trainer, "train_step", spoil)
        yield


@contextmanager
def heard() -> Iterator[list[str]]:
    """What is told, line by line."""
    lines: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield lines
        lines += [str(each.message) for each in caught]


# Policy


def model(count: int = 6) -> dict[str, HostArray]:
    rng = np.random.default_rng(1)
    return {g: HostArray(rng.standard_normal(shape).astype(np.float32)) for g, shape in group_shapes(count, 4).items()}


def test_what_is_broken_and_what_is_refused() -> None:
    models = {kind: model() for kind in KINDS}
    parameters, first, second = models.values()
    assert not np.any(examine(models))
    parameters["means"].values[1, 2] = np.nan
    parameters["sh_rest"].values[2, 1, 0] = -MAX_SH_COEFFICIENT
    parameters["means"].values[3] = 1e18  # far away, but a place
    first["sh_dc"].values[4, 1] = np.inf
    second["opacity_logits"].values[5] = np.nan
    broken, refused = examine(models)
    assert broken.tolist() == [False, True, True, False, False, False]
    assert refused.tolist() == [False, False, False, False, True, True]
    assert lost("loss", broken, refused).tolist() == [False, True, True, False, False, False]
    assert lost("adam", broken, refused).tolist() == [False, True, True, False, True, True]
    assert finite_or_zero(first["sh_dc"].values)[4].tolist() == [
        first["sh_dc"].values[4, 0],
        0,
        first["sh_dc"].values[4, 2],
    ]


def test_gaussians_are_examined_a_part_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "EXAMINED_ROWS", 500)
    models = {kind: model(2001) for kind in KINDS}
    rows = [0, 499, 500, 1999, 2000]
    models["parameters"]["opacity_logits"].values[rows] = np.nan
    models["second"]["sh_rest"].values[rows] = np.inf
    for found in examine(models):
        assert np.flatnonzero(found).tolist() == rows
    most = peak_of(lambda: examine(models))
    assert most < models["parameters"]["sh_rest"].values.nbytes / 2, (
        "a part is a quarter; all would be all of it, and their marks"
    )


def test_patience() -> None:
    retries = RetryBudget()
    for index in range(MAX_TROUBLED_STEPS - 1):
        retries.note(10 * index + 1)
        retries.note(10 * index + 1)  # the same step
        assert not retries.over
    retries.note(TROUBLE_WINDOW_STEPS + 1)  # the first is forgotten by now
    assert not retries.over
    retries.note(TROUBLE_WINDOW_STEPS + 2)
    assert retries.over
    for index in range(MAX_CHECKPOINT_RETURNS):
        assert not retries.spent
        retries = retries.after_return()
        assert not retries.over
        assert retries.rate_factor == RETURN_RATE_FACTOR ** (index + 1)
    assert retries.spent
    retries.note(7, lost=True)
    assert retries.over


def test_what_is_not_drawn_for_its_colour_is_over_the_limit() -> None:
    directions = np.random.default_rng(0).standard_normal((5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    most = np.abs(sh_basis(directions, 3)).sum(axis=1).max()
    limit = re.search(r"#define COLOUR_LIMIT (\S+)f", kernel_source("project"))
    assert limit is not None
    assert 0.5 + most * MAX_SH_COEFFICIENT < float(limit[1])


# Training goes on


def test_a_gaussian_that_breaks_is_removed_and_told_once(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", CHECKED)
    with heard() as lines, spoilt(lambda trainer: trainer.step in (6, 17, 33)):
        result = train(scene, CHECKED, device=default_device, run=run)
    told, rest = lines
    assert re.fullmatch(
        r"step 7, view 0\d\.png, stage parameters: parameters of 1 Gaussian are not finite, or far too large; 1 "
        r"removed \(further incidents of this kind are only counted\)",
        told,
    )
    assert rest == "2 more steps had values that were not finite"
    for values in (result.means, result.quaternions, result.log_scales, result.opacity_logits, result.sh):
        assert np.isfinite(values).all()
    assert [record["step"] for record in run.read_metrics()] == [10, 20, 30, 40]


def test_trouble_in_the_command_line_is_a_warning(scene: Scene, tmp_path: Path, capfd: Capture) -> None:
    folder = Path(scene.views[0].path).parents[1]
    with spoilt(lambda trainer: trainer.step == 6):
        assert command_train(folder, tmp_path / "run", CONFIG) == 0
    told = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
    assert len(told) == 1
    assert told[0].startswith("clsplat: warning: step 7, view 0")


@pytest.mark.parametrize("stop", quick([7, 8, 9, 11, 12, 20], 7, 11))
def test_trouble_and_stopping_give_the_same_bytes_as_trouble_alone(
    scene: Scene, default_device: Device, tmp_path: Path, stop: int
) -> None:
    at = (6, 10, 19)
    models = []
    for name in ("whole", "stopped"):
        run = Run.create(tmp_path / name, CONFIG)
        with heard(), spoilt(lambda trainer: trainer.step in at):
            if name == "stopped":
                train(scene, replace(CONFIG, iterations=stop), device=default_device, run=run)
                run = Run.create(tmp_path / name, CONFIG, resume=True)
            train(scene, CONFIG, device=default_device, run=run, resume=name == "stopped")
        models.append(run.model_path.read_bytes())
    assert models[0] == models[1]


# Training goes back


def test_repeated_trouble_goes_back_with_smaller_steps(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", CHECKED)
    seen: list[tuple[int, float]] = []

    def due(trainer: Trainer) -> bool:
        factor = trainer.monitor.retries.rate_factor
        seen.append((trainer.step, factor))
        return trainer.step >= 21 and factor == 1.0

    with heard() as lines, spoilt(due):
        train(scene, CHECKED, device=default_device, run=run)
    back = next(line for line in lines if "returns to" in line)
    match = re.fullmatch(
        r"step (\d+): 5 of the last 100 steps had values that were not finite: training returns to step (\d+), "
        r"with learning rates multiplied by 0\.5",
        back,
    )
    assert match is not None
    stopped, resumed = int(match[1]), int(match[2])
    assert 21 <= resumed < stopped <= 33
    assert (resumed, 0.5) in seen
    steps = [record["step"] for record in run.read_metrics()]
    assert steps == [10, 20, 30, 40], "what was written of the steps that count no more is gone"
    checkpoint = run.load_latest_checkpoint()
    assert checkpoint is not None
    assert checkpoint.state["patience"]["rate_factor"] == 0.5
    trainer = Trainer(scene, CHECKED, default_device)
    plain = trainer.rates()
    trainer.restore(checkpoint)
    trainer.position.step = 0
    assert trainer.rates() == {group: 0.5 * rate for group, rate in plain.items()}


def test_a_model_that_is_mostly_broken_is_not_mended(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", CHECKED)

    def spoil(trainer: Trainer, **_: bool) -> None:
        if trainer.step == 17 and trainer.monitor.retries.rate_factor == 1.0:
            trainer.parameters["sh_dc"].fill(np.nan)

    with heard() as lines, pytest.MonkeyPatch.context() as patch:
        noted(patch, Trainer, "train_step", spoil)
        result = train(scene, CHECKED, device=default_device, run=run)
    assert re.search(r"parameters of (\d+) Gaussians .*; \1 of \1 are too many to remove", lines[0])
    said = r"step (19|20): 1 of the last 100 steps had values that were not finite: training returns to step 15"
    assert re.match(said, lines[1])
    assert np.isfinite(result.sh).all()


def test_without_a_checkpoint_it_starts_again(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    for run in (None, Run.create(tmp_path / "run", CONFIG)):
        with heard() as lines, spoilt(lambda trainer: trainer.monitor.retries.rate_factor == 1.0):
            train(scene, CONFIG, device=default_device, run=run)
        assert any("returns to step 0, with learning rates multiplied by 0.5" in line for line in lines)


# Training gives up


def test_what_cannot_be_helped_stops_with_a_bundle(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """Steps so large that every Gaussian has a colour that nothing can have."""
    config = replace(CHECKED, optimiser=OptimiserConfig(sh_dc_rate=1e9))
    run = Run.create(tmp_path / "run", config)
    with heard() as lines, pytest.raises(ClsplatError) as caught:
        train(scene, config, device=default_device, run=run)
    assert caught.value.exit_status == 1
    message = re.fullmatch(
        r"step (\d+), view (\S+), stage adam: .*, and 3 returns to a checkpoint .* did not help: (\S+) reproduces the "
        r"step \(python -m clsplat\.training\.repro_bundle\)",
        str(caught.value),
    )
    assert message is not None
    assert len([line for line in lines if "returns to" in line]) == MAX_CHECKPOINT_RETURNS
    bundle = repro_bundle.read_bundle(Path(message[3]))
    assert bundle.record["reproduced"]
    assert bundle.config == config
    assert bundle.record["device"]["name"] == default_device.name
    assert bundle.record["versions"].keys() == {"clsplat", "numpy", "pyopencl", "python", "system"}
    counts = repro_bundle.replay(bundle, default_device)
    assert repro_bundle.first_trouble(counts) == "adam"
    assert sum(counts.values()) == counts["adam"] > 0
    # and the run can be put right
    Run.create(run.path, CONFIG, overwrite=True)
    assert not Path(message[3]).exists()


def test_a_bundle_has_no_more_than_it_needs(
    scene: Scene, default_device: Device, tmp_path: Path, capsys: Capture
) -> None:
    config = replace(CHECKED, iterations=100)
    run = Run.create(tmp_path / "run", config)
    with heard(), pytest.raises(ClsplatError), spoilt(lambda trainer: trainer.step > 5, "log_scales", value=np.inf):
        train(scene, config, device=default_device, run=run)
    (path,) = run.path.glob("trouble-step-*.npz")
    bundle = repro_bundle.read_bundle(path)
    kept, of = bundle.record["of"]
    assert kept == 1 < of
    assert {model.count for model in bundle.models.values()} == {1}
    assert path.stat().st_size < 50_000
    out = ran(capsys, repro_bundle.main, [str(path)]).out
    assert "first in parameters" in out
    assert f"1 of {of} Gaussians" in out
    assert json.loads(ran(capsys, repro_bundle.main, [str(path), "--json"]).out)["stage"] == "parameters"


def test_a_bundle_of_a_sound_step_says_so(
    scene: Scene, default_device: Device, tmp_path: Path, capsys: Capture
) -> None:
    """Where the trouble was the machine's nothing shows it again: then all Gaussians are kept."""
    trainer = trained_to(7, scene, CONFIG, default_device)
    trainer.monitor.loss_failed()
    trainer.repair()
    assert trainer.monitor.latest is not None
    path = repro_bundle.write_bundle(tmp_path, trainer, trainer.monitor.latest)
    assert repro_bundle.read_bundle(path).record["of"] == [40, 40]
    assert not repro_bundle.read_bundle(path).record["reproduced"]
    assert "all is well on this device" in ran(capsys, repro_bundle.main, [str(path)], status=1).out


def test_a_bundle_with_a_setting_of_an_earlier_version_loads(
    scene: Scene, default_device: Device, tmp_path: Path
) -> None:
    trainer = Trainer(scene, CONFIG, default_device)
    trainer.train_step()
    trainer.monitor.loss_failed()
    trainer.repair()
    assert trainer.monitor.latest is not None
    path = repro_bundle.write_bundle(tmp_path, trainer, trainer.monitor.latest)
    saved = read_checkpoint(path)
    earlier = "[train.rasterizer]\nsh_angle = 1.5\nrow_skip = false"
    settings = saved.state["settings"].replace("[train.rasterizer]", earlier)
    write_checkpoint(path, saved.step, saved.arrays, {**saved.state, "settings": settings})
    with pytest.warns(UserWarning, match=r"sh_angle = 1\.5, train\.rasterizer\.row_skip = False$") as told:
        assert repro_bundle.read_bundle(path).config == CONFIG
    assert len(told) == 1


def test_what_is_no_bundle_is_named(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "some.npz"
    assert f"{path}: no such file" in ran(capsys, repro_bundle.main, [str(path)], status=2).err
    np.savez(path, a=np.zeros(3))
    refuses("is not a bundle", repro_bundle.read_bundle, path)
    path.write_bytes(b"PK")
    refuses("is not a bundle", repro_bundle.read_bundle, path)


def test_without_a_run_it_says_how_to_get_a_bundle(scene: Scene, default_device: Device) -> None:
    config = replace(CONFIG, iterations=100)
    with (
        heard(),
        spoilt(lambda _: True),
        pytest.raises(ClsplatError, match=r"to get a file that reproduces the step, give clsplat\.train a run="),
    ):
        train(scene, config, device=default_device)


# Without the checks


@pytest.mark.slow
def test_kernels_without_checks_have_the_same_bits_and_no_checks(scene: Scene, default_device: Device) -> None:
    """What `tools/bench/bench_guards.py` compares with."""
    trainers = [Trainer(scene, CONFIG, each) for each in (default_device, unguarded(default_device))]
    for trainer in trainers:
        run_steps(20, trainer)
    arrays = [trainer.checkpoint()[0] for trainer in trainers]
    for name, array in arrays[0].items():
        assert_same_bits(arrays[1][name], array, name)
    for trainer in trainers:
        values = trainer.model.first["means"].get()
        values[3] = np.nan
        trainer.model.first["means"].set(values)
        trainer.train_step()
    spoilt = [bool(np.isnan(trainer.parameters["means"].get()).any()) for trainer in trainers]
    assert spoilt == [False, True]


def unguarded(device: Device) -> Device:
    return device.with_switches({"UNGUARDED": True})


@pytest.mark.slow
def test_the_cost_of_the_checks_is_told(scene: Scene, capsys: Capture) -> None:
    folder = Path(scene.views[0].path).parents[1]
    result = json.loads(ran(capsys, bench_guards.main, [str(folder), "--repeat", "2", "--json"]).out)
    assert result["gaussians"] == 40
    for kind in ("wall", "cpu"):
        assert result[kind]["with_ms"] > 0
        assert result[kind]["without_ms"] > 0
    assert "--repeat 0: expected at least 1" in ran(capsys, bench_guards.main, ["--repeat", "0"], status=2).err


def test_rates_are_the_settings_where_nothing_happened(scene: Scene, default_device: Device) -> None:
    trainer = Trainer(scene, CONFIG, default_device)
    trainer.position.step = 1
    assert trainer.rates()["sh_dc"] == TrainConfig().optimiser.sh_dc_rate
    assert all(group in trainer.rates() for group in PARAMETER_GROUPS)
