# SPDX-License-Identifier: Apache-2.0
"""`clsplat blocks plan` from the outside: its files and table, going on, and its errors."""

from __future__ import annotations

import re
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture
from test_plan import PLAN, WITH_SKY

from clsplat.blocks.plan import read_plan
from clsplat.blocks.planning import measurement
from clsplat.blocks.planning.picture import plan_svg, plan_table, plan_total
from clsplat.cli.main import main
from clsplat.cli.session import Services
from clsplat.gaussians import Gaussians
from clsplat.runs.run import Run

SETTINGS = ("--iterations", "60", "--random-points", "200", "--warmup", "4", "--density.start", "10", "--no-report")


def plan(scene: Path, city: Path, *flags: str, services: Services | None = None) -> int:
    return main(["blocks", "plan", str(scene), "-o", str(city), *SETTINGS, "--device", "cpu", *flags], services)


@pytest.fixture(scope="module")
def made(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    city = tmp_path_factory.mktemp("made") / "city"
    assert plan(small_scene, city, "--blocks", "2") == 0
    return city


def test_a_plan_has_blocks_a_coarse_model_and_a_picture(made: Path) -> None:
    found = read_plan(made)
    assert [block.name for block in found.blocks] == ["0_0", "1_0"]
    assert found.photographs == 8
    in_blocks = {name for block in found.blocks for name in block.photographs}
    assert len(in_blocks) == 8  # each photograph belongs to a block
    coarse = Run.open(made / "coarse")
    assert coarse.config.iterations == 9  # 15 % of 60
    assert coarse.config.resolution == 24  # half of 48
    # the passes that the coarse model leaves: 51 steps of all 8 photographs
    assert all(block.iterations == round(len(block.photographs) * 51 / 8) for block in found.blocks)
    assert found.finish_steps == 3
    assert sum(block.gaussians for block in found.blocks) >= found.gaussians
    picture = ET.fromstring((made / "plan.svg").read_text("utf-8"))
    texts = [element.text for element in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert "block 0,0" in texts and "block 1,0" in texts
    assert len(list(picture.iter("{http://www.w3.org/2000/svg}circle"))) >= 8


def test_the_same_command_again_changes_nothing(made: Path, small_scene: Path, capsys: Capture) -> None:
    before = {file: file.stat().st_mtime_ns for file in sorted(made.rglob("*")) if file.is_file()}
    capsys.readouterr()
    assert plan(small_scene, made, "--blocks", "2") == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].split() == ["block", "photographs", "Gaussians", "steps"]
    assert re.fullmatch(r"2 blocks with \d+ photographs in all, \d\.\d\d times the scene's 8", out[-1])
    assert {file: file.stat().st_mtime_ns for file in before} == before


def test_a_plan_with_a_sky(
    made: Path, small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The farthest Gaussians of the model are the sky: one more block, which is trained by its name or its number."""
    city = tmp_path / "city"
    shutil.copytree(made / "coarse", city / "coarse")
    monkeypatch.setattr(measurement, "SKY_EXTENTS", 0.9)
    assert plan(small_scene, city, "--blocks", "2") == 0
    found = read_plan(city)
    assert [block.name for block in found.blocks] == ["0_0", "1_0", "sky"]
    sky, largest = found.blocks[2], max(block.iterations for block in found.cells)
    assert sky.iterations == min(round(0.25 * len(sky.photographs) * 51 / 8), largest)
    assert sum(block.gaussians for block in found.cells) + sky.gaussians >= found.gaussians > sky.gaussians > 0
    assert capsys.readouterr().out.splitlines()[-1].endswith(f"the sky is one more, with {len(sky.photographs)}")
    words = ["blocks", "train", str(city), "--device", "cpu", "--block"]
    assert main([*words, "sky"]) == 0
    assert main([*words, "2"]) == 0
    assert "block sky has finished before" in capsys.readouterr().err
    model = Gaussians.load(city / "blocks" / "sky" / "model.ply")
    assert found.sky is not None
    assert (np.linalg.norm(model.means - np.array(found.sky.centre), axis=1) >= 0.999 * found.sky.radius).all()


def test_another_division_keeps_the_coarse_model(made: Path, small_scene: Path, capsys: Capture) -> None:
    model = (made / "coarse" / "model.ply").stat().st_mtime_ns
    assert plan(small_scene, made, "--blocks", "1") == 0
    assert "the coarse model in" in capsys.readouterr().err
    assert len(read_plan(made).blocks) == 1
    assert (made / "coarse" / "model.ply").stat().st_mtime_ns == model
    assert plan(small_scene, made, "--blocks", "2") == 0


def test_an_interrupted_plan_goes_on_to_the_same(
    made: Path, small_scene: Path, tmp_path: Path, capsys: Capture
) -> None:
    city = tmp_path / "city"
    train = Services().train

    def stopped(*arguments: Any, **options: Any) -> Any:
        def between(trainer: Any, _: Any) -> None:
            if trainer.step == 5:
                raise KeyboardInterrupt

        return train(*arguments, **{**options, "between": between})

    assert plan(small_scene, city, "--blocks", "2", services=Services(train=stopped)) == 130
    assert f"interrupted before the plan in {city} was made; the same command goes on" in capsys.readouterr().err
    assert not (city / "plan.json").exists()
    assert plan(small_scene, city, "--blocks", "2") == 0
    assert read_plan(city) == read_plan(made)


def test_changed_settings_and_scenes_are_refused(made: Path, small_scene: Path, capsys: Capture) -> None:
    assert plan(small_scene, made, "--blocks", "2", "--seed", "5") == 2
    assert "was made with other settings: seed is 0 in the plan and 5 now" in capsys.readouterr().err
    (made / "plan.json").rename(made.parent / "away")
    try:
        assert plan(small_scene, made, "--blocks", "2", "--seed", "5") == 2
        assert "seed is 0 for the coarse model and 5 now" in capsys.readouterr().err
    finally:
        (made.parent / "away").rename(made / "plan.json")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--blocks", "2x"], "--blocks 2x: expected auto"),
        (["--blocks", "2", "--block-mem", "1G"], "--block-mem 1G and --blocks 2 exclude each other"),
        (["--blocks", "2x2", "--block-photographs", "9"], "--block-photographs 9 and --blocks 2x2 exclude"),
        (["--block-photographs", "1"], "--block-photographs 1: expected at least 2"),
        (["--block-mem", "some"], "--block-mem some: expected a size"),
        (["--up", "1,2"], "--up 1,2: expected three numbers"),
        (["--seed", "-1"], "--seed -1: expected at least 0"),
        (["--blokcs", "2"], "--blokcs is not a flag, did you mean --blocks?"),
    ],
)
def test_wrong_flags_are_refused_before_anything_is_written(
    flags: list[str], message: str, small_scene: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert plan(small_scene, tmp_path / "city", *flags) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "city").exists()


def test_folders_of_something_else_are_refused(made: Path, small_scene: Path, tmp_path: Path, capsys: Capture) -> None:
    assert plan(small_scene, made / "coarse") == 2
    assert "is a run, but not of blocks" in capsys.readouterr().err
    (tmp_path / "letter.txt").write_text("dear", "utf-8")
    assert plan(small_scene, tmp_path) == 2
    assert "has files (letter.txt)" in capsys.readouterr().err
    assert plan(small_scene, tmp_path / "letter.txt") == 2
    assert "is a file, expected a folder" in capsys.readouterr().err
    assert plan(tmp_path / "nowhere", tmp_path / "city") == 2
    assert "nowhere: no such" in capsys.readouterr().err


def test_words_after_blocks(capsys: Capture) -> None:
    for words, status, text in (
        (["blocks", "--help"], 0, "clsplat blocks plan"),
        (["blocks"], 2, "blocks is not complete, expected one of blocks plan"),
        (["blocks", "plna"], 2, "blocks plna is not a verb, did you mean blocks plan?"),
        (["block", "plan"], 2, "block is not a verb, did you mean blocks?"),
    ):
        assert main(words) == status
        printed = capsys.readouterr()
        assert text in printed.out + printed.err


def test_the_table_and_the_picture_of_a_plan() -> None:
    assert plan_table(PLAN)[1:] == [("0,0", "2", "1,000", "30"), ("1,0", "1", "900", "20")]
    assert plan_total(PLAN) == "2 blocks with 3 photographs in all, 1.00 times the scene's 3"
    assert plan_total(WITH_SKY) == plan_total(PLAN) + "; the sky is one more, with 1"
    assert plan_table(WITH_SKY) == [*plan_table(PLAN), ("sky", "1", "70", "9")]
    places = {"a.jpg": (0.0, 9.0, 0.0), "b ü.jpg": (0.0, 9.0, 1.0), "c.jpg": (1.0, 9.0, 2.0), "d.jpg": (5.0, 9.0, 0.0)}
    svg = plan_svg(PLAN, {name: np.array(place) for name, place in places.items()})
    assert plan_svg(WITH_SKY, {name: np.array(place) for name, place in places.items()}).count("<rect") == svg.count(
        "<rect"
    )
    picture = ET.fromstring(svg)
    circles = list(picture.iter("{http://www.w3.org/2000/svg}circle"))
    assert len(circles) == 4 + 2  # and one of each colour in the legend
    x, y = ([float(circle.attrib[key]) for circle in circles[:4]] for key in ("cx", "cy"))
    assert x[0] == x[1] < x[2] < x[3]
    assert y[2] < y[1] < y[0] == y[3]  # the second axis points up
    assert "3 cameras in 1 block" in svg and "1 cameras in no block" in svg
