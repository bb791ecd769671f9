# SPDX-License-Identifier: Apache-2.0
"""plan.json: what is written is read again, damage is named, and a changed scene or setting is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import pytest
from small_city import WHOLE

from clsplat.blocks import plan as plans
from clsplat.blocks import plan_check
from clsplat.blocks.plan import PLAN_FILE, Block, BlockPlan, Partition, Rectangle, Sky, read_plan, write_plan
from clsplat.blocks.plan_check import check_coarse, check_plan, kept_plan
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene_of

WEST, EAST = Rectangle((-inf, -inf), (0.1 + 0.2, inf)), Rectangle((0.1 + 0.2, -inf), (inf, inf))
PLAN = BlockPlan(
    scene=Path("/scenes/town"),
    settings=TrainConfig(seed=3, warmup=(5, 9)),
    division=Partition("auto", 1 << 33, 500),
    up=(0.0, -1.0, 0.0),
    axes=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    margin=0.2,
    share=0.25,
    coarse="c" * 64,
    extent=120.1,
    finish_steps=7,
    blocks=(Block("0_0", WEST, WEST, ("a.jpg", "b ü.jpg"), 30, 1000), Block("1_0", EAST, EAST, ("c.jpg",), 20, 900)),
    joined=("block 1,1 has no points: its cell is joined to block 1,0",),
    photographs=3,
    gaussians=1800,
)


PLANE = Rectangle((-inf, -inf), (inf, inf))
WITH_SKY = replace(
    PLAN, blocks=(*PLAN.blocks, Block("sky", PLANE, PLANE, ("a.jpg",), 9, 70)), sky=Sky((0.5, -1.0, 2.0), 600.5)
)


@pytest.mark.parametrize("plan", [PLAN, WITH_SKY], ids=["ground", "sky"])
def test_a_plan_is_read_as_it_was_written(plan: BlockPlan, tmp_path: Path) -> None:
    write_plan(tmp_path, plan)
    assert read_plan(tmp_path) == plan
    document = json.loads((tmp_path / PLAN_FILE).read_text("utf-8"))
    assert document["blocks"][0]["cell"] == {"low": [None, None], "high": [0.30000000000000004, None]}


def test_the_digest_does_not_depend_on_the_scenes_path_or_the_version(monkeypatch: pytest.MonkeyPatch) -> None:
    digest = PLAN.digest
    assert replace(PLAN, scene=Path("/mnt/town")).digest == digest
    monkeypatch.setattr(plans, "package_version", lambda: "9.9")
    assert PLAN.digest == digest
    assert replace(PLAN, finish_steps=8).digest != digest
    assert replace(PLAN, settings=TrainConfig()).digest != digest


def test_a_block_is_found_by_its_name() -> None:
    assert PLAN.block("1,0") is PLAN.block("1_0") is PLAN.blocks[1]
    assert WITH_SKY.block("sky") is WITH_SKY.blocks[2]
    assert WITH_SKY.cells == list(PLAN.blocks)
    with pytest.raises(InputError, match="--block 3,0: the plan has no such block, expected one of 0,0, 1,0"):
        PLAN.block("3,0")


def damaged(tmp_path: Path, change: Callable[[dict[str, Any]], object]) -> str:
    write_plan(tmp_path, PLAN)
    document = json.loads((tmp_path / PLAN_FILE).read_text("utf-8"))
    change(document)
    (tmp_path / PLAN_FILE).write_text(json.dumps(document), "utf-8")
    with pytest.raises(InputError) as caught:
        read_plan(tmp_path)
    return str(caught.value)


def test_a_missing_plan_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such file, expected a plan .*run clsplat blocks plan SCENE -o"):
        read_plan(tmp_path)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda plan: plan.update(clsplat_blocks=1), "clsplat_blocks is 1, expected 2"),
        (lambda plan: plan.pop("coarse"), "'coarse' is missing"),
        (lambda plan: plan.update(axes=[[1, 0, 0]]), "is damaged"),
        (lambda plan: plan.update(up=[0, True, 0]), "True stands where a finite number"),
        (lambda plan: plan.update(finish_steps=-1), "-1 stands where a whole number"),
        (lambda plan: plan.update(blocks=[]), "expected blocks"),
        (lambda plan: plan["blocks"].append(plan["blocks"][0]), "a name of its own"),
        (lambda plan: plan["blocks"][0].update(name="../0_0"), "expected two numbers such as 0_1"),
        (lambda plan: plan["blocks"][0]["cell"].update(low=[1, None]), "a low corner below the high corner"),
        (lambda plan: plan["blocks"][0].update(photographs=[3]), "3 stands where a text"),
        (lambda plan: plan["train"].update(seed="x"), "train.seed is 'x', expected a whole number"),
        (lambda plan: plan["train"].update(sed=1), "'sed', which is not a setting"),
        (lambda plan: plan.update(joined=None), "is damaged"),
        (lambda plan: plan.update(sky={"centre": [0, 0, 0], "radius": 0}), "the sky begins at the distance 0.0"),
        (lambda plan: plan.update(sky={"centre": [0, 0, 0], "radius": 3}), "expected a block named sky if it is said"),
        (
            lambda plan: plan["blocks"][0].update(name="sky"),
            "sky is None, and the blocks are sky, 1_0; expected a block",
        ),
    ],
)
def test_damage_is_named(change: Callable[[dict[str, Any]], object], why: str, tmp_path: Path) -> None:
    message = damaged(tmp_path, change)
    assert why in message and message.startswith(str(tmp_path / PLAN_FILE)) and "\n" not in message


def test_a_plan_fits_the_scene_that_it_was_made_for(city: Path, small_scene: Path) -> None:
    scene = load_scene_of(WHOLE, small_scene)
    plan = check_plan(city, scene, WHOLE)
    assert plan == read_plan(city)
    # settings that do not change the model may differ
    check_plan(city, scene, replace(WHOLE, checkpoint_every=9, report=True))
    check_plan(city, scene, photographs=plan.blocks[0].photographs)


def test_changed_settings_are_refused_with_what_differs(city: Path, small_scene: Path) -> None:
    scene = load_scene_of(WHOLE, small_scene)
    other = replace(WHOLE, seed=4).changed("density.stop", 20)
    with pytest.raises(InputError, match=r"seed is 0 in the plan and 4 now, density.stop is 38 in the plan and 20 now"):
        check_plan(city, scene, other)


def test_a_changed_scene_is_refused_with_what_differs(city: Path, small_scene: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_scene, tmp_path / "scene")
    names = [view.name for view in load_scene_of(WHOLE, copy).train_views]
    (copy / "images" / names[1]).write_bytes((copy / "images" / names[2]).read_bytes())
    changed = load_scene_of(WHOLE, copy)
    with pytest.raises(InputError, match=rf"1 view with another photograph \({names[1]}\)"):
        check_plan(city, changed, WHOLE)
    check_plan(city, changed, photographs=[name for name in names if name != names[1]])
    fewer = replace(changed, views=[view for view in changed.views if view.name != names[1]])
    with pytest.raises(InputError, match=rf"1 view missing now \({names[1]}\)"):
        check_plan(city, fewer, photographs=names[:3])
    with pytest.raises(InputError, match="all 1 views are missing now"):
        check_plan(city, fewer, photographs=names[1:2])


def test_another_coarse_model_is_refused(city: Path, small_scene: Path) -> None:
    model = city / "coarse" / "model.ply"
    data = bytearray(model.read_bytes())
    data[-1] ^= 1
    model.write_bytes(data)
    with pytest.raises(InputError, match=r"is not the coarse model that .*plan.json was made with"):
        check_plan(city, load_scene_of(WHOLE, small_scene))


def test_a_moved_scene_keeps_its_plan(city: Path, small_scene: Path, tmp_path: Path) -> None:
    plan, moved = read_plan(city), shutil.copytree(small_scene, tmp_path / "moved")
    (city / "blocks" / "0_0").mkdir(parents=True)
    found = kept_plan(city, moved, load_scene_of(WHOLE, moved), WHOLE, plan.division, plan.up)
    assert found == read_plan(city) == replace(plan, scene=moved)
    assert found.digest == plan.digest


@pytest.mark.parametrize("lost", ["model.ply", "appearance.json", "refined"])
def test_a_coarse_model_without_all_results_is_not_finished(
    city: Path, small_scene: Path, monkeypatch: pytest.MonkeyPatch, lost: str
) -> None:
    """The training writes the model first, so a kill may leave it alone."""
    coarse = Run.open(city / "coarse")
    coarse.config = replace(coarse.config, appearance="exposure", refine_poses=True)
    monkeypatch.setattr(plan_check, "scene_differences", lambda *_: [])
    scene = load_scene_of(WHOLE, small_scene)
    assert not check_coarse(coarse, coarse.config, scene, WHOLE)
    coarse.appearance_path.touch()
    coarse.refined_path.mkdir()
    for name in ("cameras", "images", "points3D"):
        (coarse.refined_path / f"{name}.txt").touch()
    assert check_coarse(coarse, coarse.config, scene, WHOLE)
    shutil.move(coarse.path / lost, city.parent)
    assert not check_coarse(coarse, coarse.config, scene, WHOLE)


def test_a_plan_with_other_options_is_made_anew_until_blocks_are_trained(city: Path, small_scene: Path) -> None:
    scene, plan = load_scene_of(WHOLE, small_scene), read_plan(city)
    assert kept_plan(city, small_scene, scene, WHOLE, plan.division, plan.up) == plan
    assert kept_plan(city, small_scene, scene, WHOLE, Partition("3"), plan.up) is None
    assert kept_plan(city, small_scene, scene, WHOLE, plan.division, (0.0, -1.0, 1e-5)) == plan
    assert kept_plan(city, small_scene, scene, WHOLE, plan.division, (0.0, 0.0, 1.0)) is None
    (city / "blocks" / "0_0").mkdir(parents=True)
    with pytest.raises(InputError, match=r"--blocks is 2 in the plan and 3 now.*expected the same"):
        kept_plan(city, small_scene, scene, WHOLE, Partition("3"), plan.up)
    with pytest.raises(InputError, match="--up is 0,-1,0 in the plan and 0,0,1 now"):
        kept_plan(city, small_scene, scene, WHOLE, plan.division, (0.0, 0.0, 2.0))
    assert kept_plan(city, small_scene, scene, WHOLE, plan.division, plan.up) == plan
