# SPDX-License-Identifier: Apache-2.0
"""Settings that make no sense are told by the name of their flag, before anything is touched."""

from __future__ import annotations

from dataclasses import fields, replace
from operator import attrgetter
from pathlib import Path
from typing import get_args

import pytest
from calls import Capture, printed, refuses, rejected
from tiny import write_scene

from clsplat.cli.main import main
from clsplat.config.presets import (
    RASTERIZER_PRESETS,
    STEP_SETTINGS,
    Schedule,
    bundled,
    by_passes,
    scheduled,
    steps_made_for,
)
from clsplat.config.training import DensityConfig, OptimiserConfig, TrainConfig
from clsplat.runs.run import Run

OUT_OF_RANGE = {
    "--optimiser.means-rate": ("-1e-4", "nan", "inf"),
    "--optimiser.means-rate-end": ("-1e-9", "nan", "inf", "0"),
    "--optimiser.means-rate-steps": ("0", "-1"),
    "--optimiser.sh-dc-rate": ("-1", "nan", "inf"),
    "--optimiser.sh-rest-rate": ("-1", "nan", "inf"),
    "--optimiser.opacities-rate": ("-1", "nan", "inf"),
    "--optimiser.scales-rate": ("-1", "nan", "inf"),
    "--optimiser.quaternions-rate": ("-1", "nan", "-inf"),
    "--optimiser.sh-rest-every": ("0", "-3"),
    "--optimiser.cooldown": ("-1",),
    "--optimiser.cooldown-to": ("0", "1.1", "nan"),
    "--optimiser.beta1": ("-0.1", "1", "nan"),
    "--optimiser.beta2": ("-0.1", "1", "nan"),
    "--optimiser.epsilon": ("0", "-1e-8", "nan", "inf"),
    "--density.every": ("-1",),
    "--density.start": ("-1",),
    "--density.stop": ("-1",),
    "--density.gradient-threshold": ("0", "-1", "nan", "inf"),
    "--density.dense-fraction": ("0", "1.1", "nan"),
    "--density.split-factor": ("1", "nan", "inf"),
    "--density.min-opacity": ("0", "1", "nan"),
    "--density.max-world-fraction": ("0", "-1", "nan", "inf"),
    "--density.max-screen-radius": ("-1", "nan", "inf"),
    "--density.opacity-reset-every": ("-1",),
    "--density.opacity-reset-to": ("0", "1", "nan"),
    "--density.max-gaussians": ("0", "-1"),
    "--density.min-contribution": ("-1", "nan", "inf"),
    "--density.prune-every": ("-1",),
    "--density.growth": ("budget", "mcmc"),
    "--density.spread": ("-1", "nan", "inf"),
    "--density.noise-rate": ("-1", "nan", "inf"),
    "--density.opacity-weight": ("-1", "nan", "inf"),
    "--density.scale-weight": ("-1", "nan", "inf"),
}


def refused(flags: list[str], tmp_path: Path, capsys: Capture) -> str:
    """The one line of an error that names the flag; nothing is written."""
    said = rejected(capsys, ["train", tmp_path, "-o", tmp_path / "run", *flags])
    assert said.startswith(f"clsplat: error: {flags[0]} "), said
    assert "expected" in said
    assert not list(tmp_path.iterdir())
    return said


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        pytest.param(flag, value, marks=() if value == each[0] else pytest.mark.slow)
        for flag, each in OUT_OF_RANGE.items()
        for value in each
    ],
)
def test_a_value_out_of_range(flag: str, value: str, tmp_path: Path, capsys: Capture) -> None:
    refused([flag, value], tmp_path, capsys)


def test_no_number_of_the_optimiser_or_density_control_is_left_out() -> None:
    for config, prefix in ((OptimiserConfig(), "--optimiser."), (DensityConfig(), "--density.")):
        numbers = [each.name for each in fields(config) if not isinstance(getattr(config, each.name), bool)]
        flags = {prefix + name.replace("_", "-") for name in numbers}
        assert flags == {flag for flag in OUT_OF_RANGE if flag.startswith(prefix)}


def test_defaults_presets_and_the_ends_of_ranges_make_sense() -> None:
    TrainConfig().check()
    for preset in RASTERIZER_PRESETS.values():
        TrainConfig(rasterizer=preset).check()
    still = {each.name: 0.0 for each in fields(OptimiserConfig) if each.name.endswith(("_rate", "_rate_end"))}
    OptimiserConfig(**still, means_rate_steps=1, beta1=0, beta2=0, cooldown_to=1).check()  # type: ignore[arg-type]
    DensityConfig(every=0, start=0, stop=0, opacity_reset_every=0, dense_fraction=1, max_gaussians=1).check()
    DensityConfig(max_world_fraction=1e9).check()  # prunes none
    DensityConfig(growth="budget", max_gaussians=1).check()


def test_an_evaluation_after_the_last_step(tmp_path: Path, capsys: Capture) -> None:
    line = refused(["--eval-at", "300,500,1000", "--iterations", "499"], tmp_path, capsys)
    assert line == "clsplat: error: --eval-at 500: training ends before that, expected at most --iterations 499"
    TrainConfig(iterations=500, eval_at=(300, 500)).check()


def test_the_papers_schedule_is_the_default() -> None:
    assert scheduled("paper", 30_000) == TrainConfig()
    assert scheduled("paper", 7000) == TrainConfig(iterations=7000)


@pytest.mark.parametrize("schedule", ["short", "high-rates"])
@pytest.mark.parametrize("iterations", [1, 2, 13, 7000, 30_000])
def test_a_schedule_makes_sense_for_any_number_of_steps(schedule: Schedule, iterations: int) -> None:
    config = scheduled(schedule, iterations)
    config.check()
    assert config.iterations == config.optimiser.means_rate_steps == iterations
    assert config.density.stop + config.optimiser.cooldown <= iterations


@pytest.mark.parametrize("iterations", [1, 2, 3, 13, 7000, 30_000])
def test_presets_make_sense_for_any_number_of_steps(iterations: int) -> None:
    for preset, rasterizer in RASTERIZER_PRESETS.items():
        for schedule in (None, *get_args(Schedule)):
            if (preset, schedule) == ("fast", "high-rates"):
                continue
            config = bundled(preset, schedule, iterations)
            config.check()
            assert config.iterations == iterations
            assert config.rasterizer == rasterizer
    assert bundled("default", None, iterations) == bundled("exact", None, iterations) == scheduled("paper", iterations)
    assert bundled("fast", None, iterations) == bundled("fast", "short", iterations)
    assert bundled("fast", "paper", iterations) != bundled("fast", "short", iterations)


@pytest.mark.slow
def test_short_schedule_on_the_command_line(tmp_path: Path, capsys: Capture) -> None:
    scene, run = write_scene(tmp_path / "scene"), tmp_path / "run"
    short = ["--schedule", "short"]
    flags = ["--iterations", "14", "--preset", "fast", "--optimiser.opacities-rate", "0.04"]
    assert main(["train", str(scene), "-o", str(run), *short, *flags]) == 0
    wanted = bundled("fast", "short", 14)
    wanted = replace(wanted, optimiser=replace(wanted.optimiser, opacities_rate=0.04))
    assert Run.open(run).config == wanted, "flags go before the bundles, which go together"
    assert "--schedule short and --resume" in printed(capsys, ["train", "-o", run, "--resume", *short], status=2).err


def test_high_rates_are_those_of_the_short_schedule_but_for_these() -> None:
    """The values that docs/decisions/0031-high-rates.md measured."""
    short, high = scheduled("short", 7000), scheduled("high-rates", 7000)
    rates = {"means_rate": 3.2e-4, "means_rate_end": 1.6e-5, "sh_rest_rate": 1.6e-3}
    rates |= {"scales_rate": 0.01, "quaternions_rate": 4e-3, "cooldown_to": 0.05}
    assert high.optimiser == replace(short.optimiser, **rates)  # type: ignore[arg-type]
    assert high.density == replace(short.density, noise_rate=2e5)
    assert high == replace(short, sh_degree_every=300, optimiser=high.optimiser, density=high.density)
    refuses("--preset fast and --schedule high-rates exclude each other", bundled, "fast", "high-rates", 7000)


@pytest.mark.slow
def test_high_rates_on_the_command_line(tmp_path: Path, capsys: Capture) -> None:
    scene, run = write_scene(tmp_path / "scene"), tmp_path / "run"
    words = ["train", str(scene), "-o", str(run), "--schedule", "high-rates", "--iterations", "14"]
    assert main([*words, "--preset", "fast"]) == 2
    assert "--preset fast and --schedule high-rates exclude each other" in capsys.readouterr().err
    assert not run.exists()
    assert main([*words, "--optimiser.opacities-rate", "0.04"]) == 0
    wanted = scheduled("high-rates", 14)
    assert Run.open(run).config == replace(wanted, optimiser=replace(wanted.optimiser, opacities_rate=0.04))


def test_a_setting_that_two_places_have_has_one_default() -> None:
    import inspect

    from clsplat.cli.convert import ConvertVerb
    from clsplat.cli.options import PageOptions
    from clsplat.cli.render.flags import RenderVerb
    from clsplat.cli.render.request import bits_of
    from clsplat.config.pictures import Encoding
    from clsplat.scenes.loading import load_scene
    from clsplat.viewer.server import Address

    def default(owner: type, name: str) -> object:
        return next(field.default for field in fields(owner) if field.name == name)

    assert [default(each, "port") for each in (PageOptions, Address)] == [8080] * 2
    assert [default(each, "host") for each in (PageOptions, Address)] == ["127.0.0.1"] * 2
    held_out = inspect.signature(load_scene).parameters["test_every"].default
    assert [default(each, "test_every") for each in (TrainConfig, ConvertVerb)] == [held_out] * 2 == [8] * 2
    most = inspect.signature(load_scene).parameters["test_most"].default
    assert default(TrainConfig, "test_most") == most == 200
    names = {"exr": "depth", "parts": "parts", "compression": "compression", "quality": "quality"}
    for flag, name in names.items():
        assert default(RenderVerb, flag) == default(Encoding, name), flag
    assert bits_of("a.png", default(RenderVerb, "bits"), ["rgb"]) == default(Encoding, "bits")


@pytest.mark.parametrize("schedule", get_args(Schedule))
@pytest.mark.parametrize(("passes", "photographs"), [(30, 1000), (30, 2000), (10, 40), (1, 1)])
def test_passes_stretch_a_schedule(schedule: Schedule, passes: int, photographs: int) -> None:
    made_for = steps_made_for("default", schedule)
    before = scheduled(schedule, made_for)
    config = by_passes(before, passes, photographs)
    config.check()
    assert config.iterations == passes * photographs
    factor = passes * photographs / made_for
    for name in STEP_SETTINGS:
        old, new = attrgetter(name)(before), attrgetter(name)(config)
        if isinstance(old, tuple):
            assert all(abs(b - factor * a) <= 1 for a, b in zip(old, new, strict=False)), name
        else:
            assert abs(new - factor * old) <= 1, name
            assert (new == 0) == (old == 0), name
    assert by_passes(config, passes, photographs) == config
    back = config
    for name in STEP_SETTINGS:
        back = back.changed(name, attrgetter(name)(before))
    assert back == before, "nothing else changes"


def test_passes_leave_settings_that_are_given() -> None:
    config = TrainConfig().changed("density.stop", 900)
    assert by_passes(config, 60, 1000, {"density.stop"}).density.stop == 900
    refuses("--passes 0: expected at least 1", by_passes, config, 0, 10)


@pytest.mark.slow
def test_passes_on_the_command_line(tmp_path: Path, capsys: Capture) -> None:
    scene, run = write_scene(tmp_path / "scene"), tmp_path / "run"  # eight training photographs
    words = ["train", str(scene), "-o", str(run), "--passes"]
    for number, more, said in (
        ("0", (), "--passes 0: expected at least 1"),
        ("2", ("--iterations", "9"), "--passes 2 and --iterations 9 exclude each other"),
    ):
        assert said in printed(capsys, [*words, number, *more], status=2).err
        assert not run.exists()
    assert main([*words, "2", "--schedule", "short", "--density.start", "3"]) == 0
    wanted = by_passes(scheduled("short", 7000), 2, 8).changed("density.start", 3)
    assert Run.open(run).config == wanted
    assert wanted.iterations == 16
    assert main(["train", "-o", str(run), "--resume", "--passes", "3"]) == 2
    assert "--passes 3 and --resume exclude each other" in capsys.readouterr().err
