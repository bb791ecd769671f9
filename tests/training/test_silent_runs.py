# SPDX-License-Identifier: Apache-2.0
"""Runs, checkpoints and evaluations that went wrong without a word."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from calls import Capture, no_warnings, python, rejected, warnings_of
from tiny import FEW, short, write_scene

import clsplat
from clsplat.api import train
from clsplat.cli.main import main
from clsplat.config.presets import Preset, Schedule, bundled
from clsplat.config.training import OptimiserConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.images.reading import read_image
from clsplat.images.writing import write_image
from clsplat.runs.run import Run
from clsplat.scenes.analysis import sanity_checks
from clsplat.scenes.loading import load_scene
from clsplat.training.loop import OVERFITTING_DB, doubt_length
from clsplat.training.preparation import late_settings


def test_a_module_that_is_no_entry_point_is_not_silent() -> None:
    done = python("-m", "clsplat.cli", "--version")
    assert done.returncode == 1
    assert "cannot be directly executed" in done.stderr


@pytest.mark.parametrize("value", ['""', "5", "[]"])
def test_a_scene_that_is_no_path_is_named(value: str, run: Path, capsys: Capture) -> None:
    text = (run / "config.toml").read_text()
    lines = [f"scene = {value}" if line.startswith("scene = ") else line for line in text.splitlines()]
    (run / "config.toml").write_text("\n".join(lines))
    assert "expected the scene's path as text" in rejected(capsys, ["train", "-o", run, "--resume"])


@pytest.mark.parametrize("line", ["train  -o run", "train scene -o ", "eval ", "info "])
def test_an_empty_path_is_not_the_working_directory(line: str, capsys: Capture) -> None:
    """As a shell makes it of a variable that is not set."""
    assert "the path is empty" in rejected(capsys, line.split(" "))


def without_digests(change: Callable[[dict[str, Any], dict[str, Any]], object]) -> Callable[[Path], None]:
    """A change of a checkpoint's state and arrays, as another version might have written them."""

    def spoil(path: Path) -> None:
        with np.load(path) as archive:
            arrays = dict(archive)
        record = json.loads(arrays["state.json"].tobytes())
        del record["sha256"]
        change(record["state"], arrays)
        arrays["state.json"] = np.frombuffer(json.dumps(record).encode(), np.uint8)
        np.savez(path, **arrays)

    return spoil


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state, _: state.pop("rng"), "its state cannot be read (KeyError: 'rng')"),
        (lambda state, _: state.update(queue=["a"]), "its state cannot be read"),
        (lambda state, _: state.update(queue=[-1]), "its state cannot be read"),
        (lambda state, _: state.update(patience={"x": 1}), "its state cannot be read"),
        (lambda state, _: state.pop("seconds"), "its training time is None, expected a number of seconds"),
        (
            lambda _, arrays: arrays.update({"first/means": arrays["first/means"].astype(float)}),
            "first/means has shape (40, 3) of float64",
        ),
        (
            lambda _, arrays: arrays.update({name: arrays[name][:0] for name in arrays if name.startswith("param")}),
            "parameters/means has shape (0, 3)",
        ),
        (
            lambda _, arrays: arrays.update({"statistics/seen": arrays["statistics/seen"][:3]}),
            "statistics/seen has shape (3,)",
        ),
    ],
)
def test_a_checkpoint_of_another_form_is_named(
    change: Callable[[dict[str, Any], dict[str, Any]], object], message: str, run: Path, capfd: Capture
) -> None:
    without_digests(change)(run / "checkpoints" / "step-0000003.npz")
    assert main(["train", "-o", str(run), "--resume", "--iterations", "5"]) == 2
    line = capfd.readouterr().err.splitlines()[-1]
    assert line.startswith("clsplat: error: checkpoint of step 3: ")
    assert message in line


def test_a_checkpoint_of_more_coefficients_is_named(scene_folder: Path, run: Path, default_device: Device) -> None:
    text = (run / "config.toml").read_text()
    (run / "config.toml").write_text(text.replace("sh_degree = 2", "sh_degree = 1"))
    with pytest.raises(InputError, match="has 9 SH coefficients, more than the 4 of --sh-degree 1"):
        train(load_scene(scene_folder), device=default_device, run=Run.open(run), resume=True)


def test_a_checkpoint_under_another_name_is_passed_over(run: Path) -> None:
    latest = run / "checkpoints" / "step-0000003.npz"
    latest.rename(latest.with_name("step-0000900.npz"))
    with (
        pytest.warns(UserWarning, match="the file contains step 3, but its name says step"),
        pytest.raises(InputError, match="no intact checkpoint"),
    ):
        Run.open(run).load_latest_checkpoint()


def test_beginning_again_for_want_of_a_checkpoint_is_told(run: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    with pytest.warns(UserWarning, match="has no checkpoint: training starts again, and the 3 earlier steps are lost"):
        assert Run.open(run).load_latest_checkpoint() is None


def test_another_background_on_the_way_is_told(run: Path) -> None:
    earlier = Run.open(run)
    with pytest.warns(UserWarning, match="the background was black so far and is white from here on"):
        Run.create(run, replace(earlier.config, background="white"), resume=True)


def test_photographs_of_one_colour_are_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "scene", alpha=True)
    for path in (folder / "images").iterdir():
        pixels = read_image(path)
        pixels[:, :, 3] = 0
        write_image(path, pixels)
    found = sanity_checks.of_scene(load_scene(folder), "black")
    assert any("has a single colour or is transparent" in text for text in found)


def test_settings_that_come_to_nothing_are_told(scene_folder: Path, default_device: Device) -> None:
    loaded = load_scene(scene_folder, test_every=0)
    config = replace(FEW, iterations=2, eval_at=(1,), density=replace(FEW.density, every=5, max_gaussians=3))
    told = warnings_of(lambda: train(loaded, config, device=default_device))
    assert any("--eval-at 1: no view is held out" in text for text in told)
    assert any("training begins with 40 Gaussians, more than --density.max-gaussians 3" in text for text in told)


def test_a_run_that_ends_below_an_earlier_evaluation_is_told(
    scene_folder: Path, tmp_path: Path, default_device: Device
) -> None:
    """A rate of the means that grows from step 2 on throws a model off that was right."""
    loaded = load_scene(scene_folder)
    rates = replace(FEW.optimiser, means_rate=1e-6, means_rate_end=10.0, means_rate_steps=12)
    config = replace(FEW, iterations=12, eval_at=(2,), optimiser=rates)
    run = Run.create(tmp_path / "run", config, scene=scene_folder)
    with pytest.warns(UserWarning, match=r"had \d+\.\d\d dB after step 2 and have .* Train with --iterations 2"):
        train(loaded, config, device=default_device, run=run)
    with no_warnings():
        doubt_length(run.read_metrics(), run.read_metrics()[0]["eval"]["mean"]["psnr"] - OVERFITTING_DB)
        doubt_length([], 20.0)


def test_an_evaluation_of_what_was_trained_on_says_so(
    scene_folder: Path, run: Path, tmp_path: Path, capfd: Capture
) -> None:
    assert main(["eval", str(run)]) == 0
    assert "warning" not in capfd.readouterr().err
    assert main(["eval", str(run), "--test-every", "3"]) == 0
    assert "warning: 3 of 4 views were trained on (03.png, 06.png, 09.png): they score" in capfd.readouterr().err
    own = Path(shutil.copytree(scene_folder, tmp_path / "own"))
    shutil.copy(own / "images" / "05.png", own / "images" / "00.png")
    assert main(["eval", str(run), "--scene", str(own)]) == 0
    assert "1 view with another photograph than in training (00.png)" in capfd.readouterr().err


def test_an_evaluation_of_a_model_that_is_not_seen_says_so(run: Path, capfd: Capture) -> None:
    model = clsplat.Gaussians.load(run / "model.ply")
    model.means += 1e4
    model.save(run / "model.ply")
    assert main(["eval", str(run)]) == 0
    assert "no Gaussian is visible in any of the 2 held-out views" in capfd.readouterr().err


LATE = {
    "cooldown": (
        {"optimiser": OptimiserConfig(cooldown=6, cooldown_to=0.25)},
        (
            "--optimiser.cooldown 6: the learning rates begin at 0.5 of their values, as training has only 3 steps; "
            "expected at most --iterations 3"
        ),
    ),
    "growth": (
        {"density": {"every": 1, "growth": "mcmc", "max_gaussians": 2000, "stop": 9}},
        (
            "--density.growth mcmc: --density.max-gaussians 2,000 is reached at --density.stop 9, but training ends "
            "at step 3; expected a --density.stop of at most --iterations 3, such as 2"
        ),
    ),
    "warmup": (
        {"warmup": (1, 3, 9)},
        (
            "--warmup 3,9: the training resolution does not double after these steps, because training ends at step 3 "
            "at 1/4 of the size; expected steps below --iterations 3"
        ),
    ),
}


@pytest.mark.parametrize("name", LATE)
def test_what_comes_after_the_last_step_is_told(name: str, scene_folder: Path, default_device: Device) -> None:
    settings, text = LATE[name]
    config = short(**{"iterations": 3, "report": False, "warmup": (), "density": {"every": 0}, **settings})
    told = warnings_of(lambda: train(load_scene(scene_folder), config, device=default_device))
    assert [each for each in told if "--iterations" in each] == [text]


def test_defaults_are_silent_for_every_number_of_iterations() -> None:
    for iterations in (*range(1, 40), 249, 250, 251, 499, 500, 7000):
        for preset in get_args(Preset):
            for schedule in (None, *get_args(Schedule)):
                if (preset, schedule) == ("fast", "high-rates"):
                    continue  # refused
                assert list(late_settings(bundled(preset, schedule, iterations))) == []
