# SPDX-License-Identifier: Apache-2.0
"""The run folder: what may be put where, settings there and back, metrics and checkpoints after a crash."""

import json
import os
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from calls import Capture, no_warnings, refuses, warned
from models import random_gaussians

import clsplat
from clsplat.cli.main import main, parse
from clsplat.cli.train import TrainVerb
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.files.atomic import TEMPORARY_SUFFIX
from clsplat.runs.run import Run, is_run
from clsplat.runs.settings import parse_config, read_config

CONFIG = TrainConfig(
    iterations=7,
    background="white",
    warmup=(),
    eval_at=(3, 5),
    dssim_weight=1 / 3,
    optimiser=OptimiserConfig(means_rate=1.1e-7),
    density=DensityConfig(absolute_gradients=True, every=0),
)


def test_config_comes_back(tmp_path: Path) -> None:
    for index, config in enumerate((TrainConfig(), CONFIG)):
        run = Run.create(tmp_path / str(index), config, scene="scene dir")
        again = Run.open(run.path)
        assert again.config == config
        assert again.scene == Path("scene dir").absolute()
        assert all(type(getattr(again.config, f.name)) is type(getattr(config, f.name)) for f in fields(config))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            'clsplat = "1"\n[train]\niteration = 3\n',
            "[train] has 'iteration', which is not a setting there; did you mean 'iterations' in [train]?",
        ),
        ('clsplat = "1"\n[train.density]\neach = 3\n', "[train.density] has 'each', which is not a setting there"),
        (
            'clsplat = "1"\n[train.rasterizer]\niterations = 3\n',
            "[train.rasterizer] has 'iterations', which is not a setting there; it belongs to [train]",
        ),
        ('clsplat = "1"\ntrian = 3\n', "has 'trian', which is not a setting"),
        ('clsplat = "1"\n[train]\niterations = "many"\n', "train.iterations is 'many', expected a whole number"),
        ('clsplat = "1"\n[train]\niterations = true\n', "train.iterations is True, expected a whole number"),
        ('clsplat = "1"\n[train]\nbackground = "red"\n', "expected one of black, white, random"),
        ('clsplat = "1"\n[train]\neval_at = [1, "x"]\n', "train.eval_at is [1, 'x'], expected whole numbers"),
        ('clsplat = "1"\n[train]\noptimiser = 3\n', "train.optimiser is 3, expected a table"),
        ('clsplat = "1"\n[train\n', "is not readable as TOML"),
    ],
)
def test_wrong_config_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "config.toml").write_text(text)
    said = refuses(".", Run.open, tmp_path)
    assert message in said and str(tmp_path / "config.toml") in said


def test_whole_numbers_serve_as_floats_and_missing_keys_as_defaults(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text('clsplat = "1"\n[train]\ndssim_weight = 1\n')
    assert read_config(path) == (TrainConfig(dssim_weight=1.0), None)


@pytest.mark.parametrize("angle", [0.0, 2.5])
def test_a_setting_of_an_earlier_version_still_loads(angle: float, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "config.toml"
    path.write_text(f'clsplat = "1"\n[train]\niterations = 9\n[train.rasterizer]\nsh_angle = {angle}\n')
    verb = parse(["train", "S", "-o", str(tmp_path), "--resume"])
    assert isinstance(verb, TrainVerb)
    assert verb.config == TrainConfig(iterations=9)
    assert main(["eval", str(tmp_path)]) == 2, "it has no model"
    told = [line for line in capsys.readouterr().err.splitlines() if "sh_angle" in line]
    assert len(told) <= (angle != 0)
    assert parse_config(path.read_text(), path)[0] == TrainConfig(iterations=9)


def test_a_setting_of_an_earlier_version_is_told_once(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text('clsplat = "1"\n[train.rasterizer]\nsh_angle = 2.5\n')
    with pytest.warns(
        UserWarning,
        match=r"config\.toml: has settings that this version lacks, .*: train\.rasterizer\.sh_angle = 2\.5$",
    ) as told:
        assert read_config(path) == read_config(path) == (TrainConfig(), None)
    assert len(told) == 1


def test_switches_that_only_the_bench_has_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    gone = dict.fromkeys(("vector_skip", "last_contributor", "gradient_skip", "opacity_cull"), True)
    text = tomli_w.dumps({"clsplat": "1", "train": {"rasterizer": asdict(BenchSwitches()) | gone}})
    path.write_text(text)
    with no_warnings():
        assert read_config(path) == (TrainConfig(), None), "as every earlier version wrote them"
    path.write_text(
        text.replace("row_skip = true", "row_skip = false")
        .replace("gradient_skip = true", "gradient_skip = false")
        .replace('extent = "opacity"', 'extent = "constant"')
        .replace("sh_degree_limit = 3", "sh_degree_limit = 1")
    )
    with pytest.warns(UserWarning, match="has settings that this version lacks") as told:
        assert read_config(path) == (TrainConfig(rasterizer=RasterizerConfig(sh_degree_limit=1)), None)
    assert len(told) == 1
    named = ("extent = 'constant'", "row_skip = False", "gradient_skip = False")
    assert str(told[0].message).endswith(": " + ", ".join(f"train.rasterizer.{name}" for name in named))
    path.write_text(text.replace('extent = "opacity"', "extent = 3"))
    refuses(r"train\.rasterizer\.extent is 3, expected one of opacity, 3sigma", read_config, path)


def test_settings_of_training_that_are_gone_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    nothing = {"edge_views": 0, "prune_at": [], "prune_fraction": 0.0, "views_agree": 1}
    path.write_text(tomli_w.dumps({"train": {"frequency_steps": 0, "density": nothing | {"every": 50}}}))
    config = TrainConfig(density=DensityConfig(every=50))
    with no_warnings():
        assert read_config(path) == (config, None), "as every earlier version wrote them"
    once = {"edge_views": 5, "prune_at": [600, 3000], "prune_fraction": 0.25, "views_agree": 2}
    path.write_text(tomli_w.dumps({"train": {"frequency_steps": 500, "density": once | {"every": 50}}}))
    with pytest.warns(UserWarning, match="has settings that this version lacks") as told:
        assert read_config(path) == (config, None)
    assert len(told) == 1
    assert str(told[0].message).endswith(
        ": train.frequency_steps = 500, train.density.edge_views = 5, train.density.prune_at = [600, 3000], "
        "train.density.prune_fraction = 0.25, train.density.views_agree = 2"
    )


def test_a_run_is_not_written_over(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", CONFIG)
    run.model_path.write_bytes(b"precious")
    refuses("already a run, use --resume", Run.create, run.path, TrainConfig())
    assert run.model_path.read_bytes() == b"precious"
    assert Run.open(run.path).config == CONFIG


def test_other_folders_are_not_taken(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")
    (tmp_path / "config.toml").write_text("[tool]\nof = 'another program'\n")
    for overwrite in (False, True):
        refuses(r"is not a run but has files \(config\.toml\)", Run.create, tmp_path, CONFIG, overwrite=overwrite)
    refuses("no run to resume", Run.create, tmp_path, CONFIG, resume=True)
    refuses("is a file", Run.create, tmp_path / "thesis.tex", CONFIG)
    assert (tmp_path / "thesis.tex").read_text() == "years"


def test_overwrite_removes_what_the_run_owns_only(tmp_path: Path) -> None:
    run = Run.create(tmp_path, CONFIG)
    run.save_checkpoint(3, {"a": np.zeros(3)}, {})
    run.append_metrics({"step": 1})
    run.write_eval({"step": 1})
    (run.test_path / "sub").mkdir(parents=True)
    ours = [run.model_path, run.test_path / "sub" / "a.png", tmp_path / f".model.ply.12{TEMPORARY_SUFFIX}"]
    theirs = [tmp_path / "notes.txt", run.test_path / "mine.txt", run.checkpoints_path / "best.npz"]
    for path in [*ours, *theirs]:
        path.write_bytes(b"x")
    Run.create(tmp_path, TrainConfig(), overwrite=True)
    assert not any(path.exists() for path in [*ours, run.metrics_path, run.eval_path])
    assert all(path.exists() for path in theirs)
    assert run.checkpoints() == []
    assert Run.open(tmp_path).config == TrainConfig()


def test_resume_keeps_what_cannot_change(tmp_path: Path) -> None:
    Run.create(tmp_path, CONFIG, scene="/scene")
    resumed = Run.create(tmp_path, replace(CONFIG, iterations=20), resume=True)
    assert resumed.resuming
    assert resumed.scene == Path("/scene")
    assert Run.open(tmp_path).config.iterations == 20
    with pytest.raises(InputError, match="seed is 0, a resumed run cannot change it to 9"):
        Run.create(tmp_path, replace(CONFIG, seed=9), resume=True)
    refuses("exclude each other", Run.create, tmp_path, CONFIG, resume=True, overwrite=True)


def test_metrics_are_lines_and_a_cut_one_is_left_out(tmp_path: Path) -> None:
    run = Run.create(tmp_path, CONFIG)
    assert run.read_metrics() == []
    for step in range(1, 6):
        run.append_metrics({"step": step, "loss": 1 / step})
        assert len(run.metrics_path.read_text().splitlines()) == step  # there at once
    with open(run.metrics_path, "a") as file:
        file.write('{"step": 6, "lo')
    assert [record["step"] for record in run.read_metrics()] == [1, 2, 3, 4, 5]
    run.truncate_metrics(3)
    run.append_metrics({"step": 4})
    assert [json.loads(line)["step"] for line in run.metrics_path.read_text().splitlines()] == [1, 2, 3, 4]


def test_what_the_model_was_trained_for(tmp_path: Path) -> None:
    run = Run.create(tmp_path, CONFIG)
    assert run.model_record() == {}
    run.append_metrics({"step": 7, "seconds": 1.0})
    assert run.model_record()["step"] == 7
    run.save_model(random_gaussians(3))
    run.write_eval({"step": 5, "seconds": 0.5})
    assert run.model_record() == {"step": 5, "seconds": 0.5}
    os.utime(run.eval_path, (1, 1))  # of the model before: an interrupted evaluation leaves it so
    assert run.model_record()["step"] == 7
    os.utime(run.eval_path)
    run.eval_path.write_text('{"st')
    assert run.model_record()["step"] == 7


def test_numbers_that_are_not_finite_stop_the_run(tmp_path: Path) -> None:
    run = Run.create(tmp_path, CONFIG)
    refuses("diverged at step 3", run.append_metrics, {"step": 3, "loss": float("nan")}, error=ClsplatError)
    assert run.read_metrics() == []


def arrays(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {"means": rng.standard_normal((5, 3)).astype(np.float32), "count": np.arange(4, dtype=np.uint64)}


def test_checkpoints_come_back_and_two_are_kept(tmp_path: Path) -> None:
    run = Run.create(tmp_path, CONFIG)
    assert run.load_latest_checkpoint() is None
    for step in (10, 200, 3000):
        run.save_checkpoint(step, arrays(step), {"rng": {"big": 2**100}, "seconds": 0.1 + 0.2})
    assert [step for step, _ in run.checkpoints()] == [200, 3000]
    checkpoint = run.load_latest_checkpoint()
    assert checkpoint.step == 3000
    assert checkpoint.state == {"rng": {"big": 2**100}, "seconds": 0.1 + 0.2}
    assert checkpoint.arrays.keys() == arrays(0).keys()
    for name, array in arrays(3000).items():
        assert checkpoint.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(checkpoint.arrays[name], array)


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text"])
def test_a_damaged_checkpoint_is_passed_over(tmp_path: Path, damage: str) -> None:
    run = Run.create(tmp_path, CONFIG)
    run.save_checkpoint(1, arrays(1), {})
    path = run.save_checkpoint(2, arrays(2), {})
    data = bytearray(path.read_bytes())
    data[data.index(arrays(2)["means"].tobytes()) + 7] ^= 16
    path.write_bytes({"cut": data[: len(data) // 2], "flip": data, "empty": b"", "text": b"text" * 99}[damage])
    checkpoint = warned(r"step-0000002\.npz: is a damaged checkpoint", run.load_latest_checkpoint)
    assert checkpoint.step == 1
    run.save_checkpoint(1, arrays(1), {})
    assert [step for step, _ in run.checkpoints()] == [1]  # the damaged one was of a later step

    run.checkpoints()[0][1].write_bytes(b"")
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(InputError, match="no intact checkpoint"):
        run.load_latest_checkpoint()


def test_resuming_cuts_the_metrics_back_to_the_checkpoint(tmp_path: Path) -> None:
    run = Run.create(tmp_path, CONFIG)
    for step in range(1, 8):
        run.append_metrics({"step": step})
    run.save_checkpoint(5, arrays(5), {})
    assert Run.open(tmp_path).load_latest_checkpoint() is not None
    assert len(run.read_metrics()) == 7  # only looking changes nothing
    Run.create(tmp_path, CONFIG, resume=True).load_latest_checkpoint()
    assert [record["step"] for record in run.read_metrics()] == [1, 2, 3, 4, 5]


def test_what_is_a_run(tmp_path: Path) -> None:
    assert not is_run(tmp_path)
    Run.create(tmp_path / "run", CONFIG)
    assert is_run(tmp_path / "run")
    refuses("no such folder", Run.open, tmp_path / "none")
    refuses("not a run", Run.open, tmp_path)
    assert f'clsplat = "{clsplat.__version__}"' in (tmp_path / "run" / "config.toml").read_text()
