# SPDX-License-Identifier: Apache-2.0
"""The command line's own structure: verbs as modules, one parsing, flags over a run's settings, services."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import tyro
from calls import Capture, noted, ran

from clsplat.cli import parsing
from clsplat.cli.main import main, parse
from clsplat.cli.options import DeviceOptions, Verb
from clsplat.cli.session import Services, imported
from clsplat.cli.train import TrainVerb
from clsplat.config.presets import RASTERIZER_PRESETS
from clsplat.config.training import TrainConfig
from clsplat.progress import aligned
from clsplat.runs.run import Run


def test_every_verb_is_a_module_with_its_arguments_and_its_function() -> None:
    for name in parsing.VERBS:
        module = parsing.verb_module(name)
        assert issubclass(parsing.verb_class(name), Verb), name
        assert callable(module.run), name


def test_the_list_of_verbs_says_what_their_help_begins_with() -> None:
    for name, sentence in parsing.VERBS.items():
        help_text = " ".join((parsing.verb_class(name).__doc__ or "").split())
        assert help_text.startswith(sentence), name


@pytest.mark.parametrize(("words", "called"), [(["--help"], []), (["info", "--help"], ["info"])])
def test_no_other_verb_is_imported_than_the_one_that_is_called(words: list[str], called: list[str]) -> None:
    code = (
        "import sys; from clsplat.cli.main import main; main(sys.argv[1:]); "
        "from clsplat.cli.parsing import VERBS; "
        "print([name for name in VERBS if f'clsplat.cli.{name}' in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == str(called)


@pytest.mark.parametrize(
    "line",
    [
        "train -o RUN --resume --json --view --overwrite --port 81",
        "train S -o RUN --preset fast --json",
        "bench --preset fast --json",
        "render RUN --cameras S -o {name}.png --json",
    ],
)
def test_a_command_line_is_parsed_once(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    Run.create(run, TrainConfig(seed=5), scene=tmp_path)
    calls: list[Any] = []
    noted(monkeypatch, tyro, "cli", lambda _, **options: calls.append([options["prog"], *options["args"]]))
    words = [word.replace("RUN", str(run)) for word in line.replace(" --overwrite", "").split()]
    assert parse(words).json  # type: ignore[attr-defined]
    assert calls == [[f"clsplat {words[0]}", *words[1:]]]


@pytest.mark.parametrize("flag", [each.name for each in fields(TrainVerb) if each.type == "Flag"])
def test_every_flag_goes_with_resume(flag: str, tmp_path: Path, capsys: Capture) -> None:
    if flag == "overwrite":
        pytest.skip("--resume and --overwrite exclude each other")
    Run.create(tmp_path / "run", TrainConfig(seed=5), scene=tmp_path)
    words = ["train", "-o", str(tmp_path / "run"), "--resume"]
    verb = parse(words if flag == "resume" else [*words, f"--{flag.replace('_', '-')}"])
    assert isinstance(verb, TrainVerb)
    assert getattr(verb, flag)
    assert verb.config.seed == 5
    assert capsys.readouterr().err == ""


def test_a_flag_that_repeats_the_default_changes_a_runs_setting(tmp_path: Path) -> None:
    usual = TrainConfig()
    config = replace(usual, iterations=9, report=False, rasterizer=RASTERIZER_PRESETS["fast"], warmup=(1, 2))
    Run.create(tmp_path, config, scene=tmp_path)
    words = ["train", "-o", str(tmp_path), "--resume"]
    verb = parse([*words, f"--iterations={usual.iterations}", "--report", "--rasterizer.sh_storage", "float"])
    assert isinstance(verb, TrainVerb)
    fast = replace(RASTERIZER_PRESETS["fast"], sh_storage="float")
    assert verb.config == replace(config, iterations=usual.iterations, report=True, rasterizer=fast)
    off = parse([*words, "--no-report", "--density.no-absolute-gradients", "--warmup", ""])
    assert isinstance(off, TrainVerb)
    assert off.config == replace(config, warmup=())


def test_services_are_the_packages_functions() -> None:
    for service in fields(Services):
        module, _, name = getattr(Services(), service.name).__name__.rpartition(".")
        assert callable(getattr(import_module(module), name)), service.name
    assert imported("clsplat.progress.aligned")([["a", "b"]]) == ["a  b"]


def test_a_device_has_its_limit_and_is_tested() -> None:
    events: list[Any] = []

    def open_device(selector: str | None, limit: int | None) -> str:
        events.append((selector, limit))
        return "opened"

    def require(device: str, *stages: object) -> str:
        events.append((device, stages))
        return "trusted"

    services = Services(open_device=open_device, require=require)  # type: ignore[arg-type]
    assert DeviceOptions("gpu", "1MiB").trusted(services, ("project",)) == "trusted"
    assert events == [("gpu", 1 << 20), ("opened", (("project",),))]


def test_a_verb_gets_the_services_of_its_call(tmp_path: Path, capsys: Capture) -> None:
    def run_demo(output: Path, **_: object) -> dict[str, Any]:
        return {"output": output.name}

    services = Services(open_device=lambda *_: None, require=lambda *_: None, run_demo=run_demo)  # type: ignore[arg-type,return-value]
    assert ran(capsys, main, ["demo", "-o", str(tmp_path / "d"), "--json"], services).out == '{\n  "output": "d"\n}\n'


def test_a_table_is_aligned() -> None:
    rows = [("name", "ms", "where"), ("sort", "1.5", "here"), ("project", "12", "")]
    assert aligned(rows) == ["name      ms  where", "sort     1.5   here", "project   12"]
    assert aligned(rows, left=(0, 2)) == ["name      ms  where", "sort     1.5  here", "project   12"]
