# SPDX-License-Identifier: Apache-2.0
"""`clsplat train --blocks` and the commands after the plan, from the outside: results, going on, and errors."""

from __future__ import annotations

import json
import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from calls import Capture, rejected

from clsplat.blocks.plan import read_plan
from clsplat.cli.main import main
from clsplat.cli.session import Services
from clsplat.cli.training_run import TrainingMachine
from clsplat.runs.run import Run

SETTINGS = ("--iterations", "60", "--random-points", "200", "--warmup", "4", "--density.start", "10", "--no-report")
RESULTS = ("merged.ply", "model.ply", "blocks/0_0/model.ply", "blocks/1_0/model.ply")


def in_blocks(scene: Path, city: Path, *flags: str, services: Services | None = None) -> int:
    words = ["train", str(scene), "-o", str(city), *SETTINGS, "--blocks", "2", "--device", "cpu", *flags]
    return main(words, services)


@pytest.fixture(scope="module")
def whole(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A city that one command has trained in this process."""
    city, printed = tmp_path_factory.mktemp("whole") / "city", StringIO()
    with redirect_stdout(printed):
        assert in_blocks(small_scene, city, "--json") == 0
    assert json.loads(printed.getvalue())["step"] == 3, "standard output has the JSON alone"
    return city


def planned(whole: Path, city: Path) -> Path:
    """A copy of the city's coarse model and plan."""
    city.mkdir()
    shutil.copytree(whole / "coarse", city / "coarse")
    shutil.copy(whole / "plan.json", city)
    return city


def same_results(city: Path, whole: Path) -> bool:
    return all((city / name).read_bytes() == (whole / name).read_bytes() for name in RESULTS)


def test_one_command_makes_a_run(whole: Path, small_scene: Path, capsys: Capture) -> None:
    capsys.readouterr()
    assert Run.open(whole).scene == small_scene
    assert main(["eval", str(whole), "--device", "cpu", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["views"]) == 2


def test_the_same_command_again_and_resume_do_nothing(whole: Path, small_scene: Path, capsys: Capture) -> None:
    before = {file: file.stat().st_mtime_ns for file in whole.rglob("*.ply")}
    capsys.readouterr()
    assert in_blocks(small_scene, whole, "--json") == 0
    assert json.loads(capsys.readouterr().out)["step"] == 3
    assert main(["train", "-o", str(whole), "--resume", "--device", "cpu"]) == 0
    said = capsys.readouterr().err
    assert "block 0,0 has finished before" in said
    assert f"model in {whole / 'model.ply'}" in said
    assert {file: file.stat().st_mtime_ns for file in before} == before


def test_a_link_to_the_scene_is_the_same_scene(whole: Path, small_scene: Path, tmp_path: Path) -> None:
    (link := tmp_path / "link").symlink_to(small_scene)
    before = (whole / "plan.json").read_bytes()
    assert in_blocks(link, whole) == 0
    assert main(["train", str(link), "-o", str(whole), "--resume", "--device", "cpu"]) == 0
    assert (whole / "plan.json").read_bytes() == before


def test_command_by_command_in_another_order(whole: Path, tmp_path: Path, capsys: Capture) -> None:
    city = planned(whole, tmp_path / "city")
    for name in ("1,0", "0,0", "1,0"):
        assert main(["blocks", "train", str(city), "--block", name, "--device", "cpu"]) == 0
    assert f"{city}: block 1,0 has finished before" in capsys.readouterr().err
    assert main(["blocks", "merge", str(city)]) == 0
    assert main(["blocks", "merge", str(city)]) == 0
    assert f"merged model in {city / 'merged.ply'} (merged before)" in capsys.readouterr().err
    assert main(["blocks", "finish", str(city), "--device", "cpu"]) == 0
    assert "2 held-out views  PSNR" in capsys.readouterr().out
    assert same_results(city, whole)


@pytest.mark.parametrize("stage", ["block", "finish"])
def test_ctrl_c_names_the_command_that_goes_on(
    whole: Path, small_scene: Path, tmp_path: Path, capsys: Capture, stage: str
) -> None:
    city = planned(whole, tmp_path / "city")
    train = Services().train

    def stopped(scene: Any, config: Any, **options: Any) -> Any:
        def between(trainer: Any, _: Any) -> None:
            if trainer.step == 2 and options["run"].path.name == ("1_0" if stage == "block" else "city"):
                raise KeyboardInterrupt

        return train(scene, config, **{**options, "between": between})

    assert in_blocks(small_scene, city, services=Services(train=stopped)) == 130
    where = "in block 1,0, 2 of 2" if stage == "block" else "after the blocks"
    again = f"clsplat train -o {city} --resume --device cpu"
    assert f"interrupted {where}; go on with: {again}" in capsys.readouterr().err
    assert main(again.split()[1:]) == 0
    assert same_results(city, whole)


@pytest.mark.slow
def test_processes_of_this_machine_make_the_same(whole: Path, small_scene: Path, tmp_path: Path) -> None:
    city = planned(whole, tmp_path / "city")
    assert in_blocks(small_scene, city, "--workers", "2") == 0
    assert same_results(city, whole)
    assert sorted(path.name for path in (city / "jobs").glob("*.log")) == [
        "block-0_0.log",
        "block-1_0.log",
        "finish.log",
        "merge.log",
    ]


def test_wrong_calls_are_refused(whole: Path, small_scene: Path, tmp_path: Path, capsys: Capture) -> None:
    scene, run, city = str(small_scene), str(tmp_path / "run"), str(whole)
    for words, message in (
        (["train", scene, "-o", run, "--workers", "2"], "--workers 2: is for trainings in blocks, expected --blocks"),
        (["train", scene, "-o", run, "--blocks", "2", "--auto"], "--auto and --blocks exclude each other"),
        (["train", scene, "-o", run, "--blocks", "2", "--workers", "0"], "--workers 0: expected at least 1"),
        (
            ["train", scene, "-o", run, "--blocks", "2", "--workers", "1", "--scheduler", "tcp://x:1"],
            "--workers and --scheduler exclude each other",
        ),
        (["train", scene, "-o", run, "--blocks", "2", "--finish", "0"], "--finish 0: expected at least 1 step"),
        (["train", "-o", run, "--blocks", "2"], "SCENE is missing"),
        (["train", scene, "-o", city], "has a training in blocks; expected --resume to go on with it"),
        (["train", "-o", city, "--resume", "--seed", "3"], "--seed and --resume exclude each other"),
        (["train", "-o", city, "--resume", "--blocks", "4"], "--blocks and --resume exclude each other"),
        (["train", str(tmp_path), "-o", city, "--resume"], "its plan is of the scene"),
        (["train", scene, "-o", city, "--blocks", "2", "--seed", "3"], "was made with other settings: "),
        (["train", "-o", run, "--blocks", "2", "--resume"], "--blocks and --resume exclude each other"),
        (["blocks", "train", city, "--block", "3,3"], "--block 3,3: the plan has no such block"),
        (["blocks", "train", run, "--block", "0,0"], "plan.json: no such file, expected a plan"),
        (["blocks", "merge", run], "plan.json: no such file, expected a plan"),
        (["blocks", "finish", city, "--finish", "0"], "--finish 0: expected at least 1 step"),
        (["blocks", "finish", city, "--max-host-mem", "much"], "--max-host-mem much: expected a size"),
    ):
        assert message in rejected(capsys, words), words
    assert not (tmp_path / "run").exists()


def test_finished_trainings_open_no_device(whole: Path, capsys: Capture) -> None:
    def forbidden(*_: object, **__: object) -> Any:
        raise AssertionError("no device is opened")

    services, city = Services(open_device=forbidden, open_devices=forbidden), str(whole)
    assert main(["blocks", "train", city, "--block", "1,0"], services) == 0
    assert main(["blocks", "train", city, "--block", "01"], services) == 0
    assert main(["blocks", "finish", city], services) == 0
    capsys.readouterr()
    assert main(["blocks", "train", city, "--block", "9" * 5000], services) == 0
    assert "the plan has 2 blocks, so there is nothing to do" in capsys.readouterr().err


def test_a_damaged_plan_is_one_line(whole: Path, tmp_path: Path, capsys: Capture) -> None:
    city = planned(whole, tmp_path / "city")
    (city / "plan.json").write_text("{")
    assert "plan.json: is not JSON" in rejected(capsys, ["blocks", "train", str(city), "--block", "0,0"])
    assert "plan.json: is not JSON" in rejected(capsys, ["train", "-o", str(city), "--resume"])


def test_the_plan_of_the_command_is_that_of_blocks_plan(whole: Path, small_scene: Path, tmp_path: Path) -> None:
    city = tmp_path / "city"
    words = ["blocks", "plan", str(small_scene), "-o", str(city), *SETTINGS, "--blocks", "2", "--device", "cpu"]
    assert main(words) == 0
    assert read_plan(city) == read_plan(whole)


def test_folders_of_other_processes_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker of a cluster has another current folder."""
    monkeypatch.chdir(tmp_path)
    flags = TrainingMachine("cpu", cache="none", scratch="rows").in_any_folder().flags
    assert flags == ["--device", "cpu", "--cache", "none", "--scratch", str(tmp_path / "rows")]
    assert TrainingMachine().in_any_folder().flags == []
