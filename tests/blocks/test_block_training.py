# SPDX-License-Identifier: Apache-2.0
"""The trainings of a city: blocks, merge and finish, which go on where they stopped, and what is refused."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from calls import raising, refusal
from compare import assert_same_bits
from small_city import BLOCK_STEPS, FINISH_STEPS, WHOLE, in_cell, load, trains_on

from clsplat.blocks.block_training import finish, is_finished, train_block
from clsplat.blocks.merging import is_merged, merge
from clsplat.blocks.plan import SKY_BLOCK, Block, Rectangle, Sky, read_plan, write_plan
from clsplat.blocks.tasks import tasks_of
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.runs import locks
from clsplat.runs.run import Run
from clsplat.runs.scene_record import read
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.scene import Scene
from clsplat.training.start import Start

BLOCKS = ("0,0", "1,0")


def test_a_block_has_the_gaussians_of_its_widened_cell(done_city: Path) -> None:
    plan = read_plan(done_city)
    for block in plan.blocks:
        run = Run.open(done_city / "blocks" / block.name)
        model = Gaussians.load(run.model_path)
        assert in_cell(model, block.widened).all()
        assert not in_cell(model, block.cell).all(), "the margin's Gaussians are trained too"
        record = read(run)
        assert record is not None
        assert {name: view["split"] for name, view in record["views"].items()} == dict.fromkeys(
            block.photographs, "train"
        )
        assert not run.eval_path.exists(), "the city is evaluated once, as a whole"


def test_the_lengths_of_a_block_are_those_of_the_whole(done_city: Path) -> None:
    coarse, block = (read(Run.open(done_city / name)) for name in ("coarse", "blocks/0_0"))
    assert coarse is not None
    assert block is not None
    assert coarse.get("length_unit") == block.get("length_unit")


def test_the_merge_has_each_cell_from_its_block(done_city: Path) -> None:
    plan, parts = read_plan(done_city), []
    for block in plan.blocks:
        model = Gaussians.load(done_city / "blocks" / block.name / "model.ply")
        parts.append(model.means[in_cell(model, block.cell)])
    assert_same_bits(Gaussians.load(done_city / "merged.ply").means, np.concatenate(parts))


def test_a_block_in_a_folder_without_locks(
    city: Path, done_city: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is said, and the bytes are the same."""
    monkeypatch.setattr(locks, "try_lock", raising(OSError(errno.ENOLCK, "No locks available")))
    with pytest.warns(UserWarning, match="is on a file system without locks"):
        assert train_block(city, "0,0", load(), trains_on(default_device))
    model = Path("blocks", "0_0", "model.ply")
    assert (city / model).read_bytes() == (done_city / model).read_bytes()


def test_the_sky_is_a_block_of_its_own(city: Path, default_device: Device) -> None:
    plan, coarse = read_plan(city), Gaussians.load(city / "coarse" / "model.ply")
    distances = np.linalg.norm(coarse.means, axis=1)
    radius = float(np.median(distances))
    photographs = tuple(sorted({name for block in plan.blocks for name in block.photographs}))
    everywhere = Rectangle((-inf, -inf), (inf, inf))
    sky = Block(SKY_BLOCK, everywhere, everywhere, photographs, BLOCK_STEPS, int((distances >= radius).sum()))
    write_plan(city, replace(plan, sky=Sky((0.0, 0.0, 0.0), radius), blocks=(*plan.blocks, sky)))
    parts = []
    for block in read_plan(city).blocks:
        assert train_block(city, block.shown, load(), trains_on(default_device))
        model = Gaussians.load(city / "blocks" / block.name / "model.ply")
        far = np.linalg.norm(model.means, axis=1) >= radius
        assert len(model)
        assert far.all() if block.is_sky else not far.any()
        parts.append(model.means[in_cell(model, block.cell)])
    assert merge(city)
    assert_same_bits(Gaussians.load(city / "merged.ply").means, np.concatenate(parts))


def test_the_city_is_a_run(done_city: Path) -> None:
    run = Run.open(done_city)
    evaluation = json.loads(run.eval_path.read_text())
    assert evaluation["step"] == FINISH_STEPS == run.config.iterations
    assert len(evaluation["views"]) == 2
    assert len(Gaussians.load(run.model_path)) == len(Gaussians.load(done_city / "merged.ply"))


def test_all_of_it_again_does_nothing(done_city: Path) -> None:
    def forbidden(*_: object) -> None:
        raise AssertionError("nothing is loaded or trained")

    before = {path: path.stat().st_mtime_ns for path in done_city.rglob("*") if path.is_file()}
    assert not any(train_block(done_city, name, forbidden, forbidden) for name in BLOCKS)  # type: ignore[arg-type]
    assert not merge(done_city)
    assert not finish(done_city, None, forbidden, forbidden)  # type: ignore[arg-type]
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.parametrize("stops", [0, 3, BLOCK_STEPS - 1])
def test_a_stopped_city_has_the_same_bytes(city: Path, done_city: Path, default_device: Device, stops: int) -> None:
    """Each training is stopped, and the blocks come in another order. Checkpoints are every fifth step."""
    for name in BLOCKS[::-1]:
        with pytest.raises(KeyboardInterrupt):
            train_block(city, name, load(), trains_on(default_device, stops))
        assert train_block(city, name, load(), trains_on(default_device))
    assert merge(city)
    with pytest.raises(KeyboardInterrupt):
        finish(city, None, load(), trains_on(default_device, min(stops, FINISH_STEPS - 1)))
    assert finish(city, None, load(), trains_on(default_device))
    for name in ("blocks/0_0/model.ply", "blocks/1_0/model.ply", "merged.ply", "model.ply"):
        assert (city / name).read_bytes() == (done_city / name).read_bytes(), name


def test_a_longer_finish_goes_on(done_city: Path, tmp_path: Path, default_device: Device) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    assert finish(city, FINISH_STEPS + 4, load(), trains_on(default_device))
    assert Run.open(city).checkpoints()[-1][0] == FINISH_STEPS + 4
    before = (city / "config.toml").read_bytes()
    assert "--finish 2: " in (said := refusal(lambda: finish(city, 2, load(), trains_on(default_device))))
    assert "is already at step" in said
    assert (city / "config.toml").read_bytes() == before, "a refused number of steps changes nothing"
    assert is_finished(city, read_plan(city), FINISH_STEPS + 4)
    assert "--finish 0: expected at least 1 step" in refusal(lambda: finish(city, 0, load(), trains_on(default_device)))


@pytest.mark.parametrize("again", [None, FINISH_STEPS + 4])
def test_a_stopped_longer_finish_goes_on(
    done_city: Path, tmp_path: Path, default_device: Device, again: int | None
) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    plan = read_plan(city)
    assert is_finished(city, plan, None)
    assert not is_finished(city, plan, FINISH_STEPS + 4), "the task of a longer finish has something to do"
    with pytest.raises(KeyboardInterrupt):
        finish(city, FINISH_STEPS + 4, load(), trains_on(default_device, FINISH_STEPS + 1))
    assert not is_finished(city, plan, None)
    assert finish(city, again, load(), trains_on(default_device))
    assert Run.open(city).model_record()["step"] == FINISH_STEPS + 4
    assert not finish(city, again, load(), trains_on(default_device))


def test_the_tasks_of_a_finished_city_are_done_up_to_its_steps(done_city: Path) -> None:
    plan = read_plan(done_city)
    assert all(task.is_done() for task in tasks_of(done_city, plan, None))
    *others, last = tasks_of(done_city, plan, FINISH_STEPS + 1)
    assert all(task.is_done() for task in others)
    assert not last.is_done()


def test_a_finish_on_another_merge_says_what_to_remove(done_city: Path, tmp_path: Path, default_device: Device) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    (city / "letter.txt").write_text("the user's own")
    begun = json.loads((city / "begun.json").read_text())
    (city / "begun.json").write_text(json.dumps({**begun, "start": "0" * 64}))
    (city / "done.json").unlink()
    said = refusal(lambda: finish(city, None, load(), trains_on(default_device)))
    assert "its training began with another model (start 000000000000" in said
    named = said.partition("remove from this folder: ")[2].split(", ")
    assert {"begun.json", "config.toml", "model.ply", "checkpoints"} <= set(named)
    assert not {"merged.ply", "plan.json", "blocks", "coarse", "letter.txt"} & set(named)
    (city / "letter.txt").unlink()  # a new run's folder has no foreign files
    for name in named:
        shutil.rmtree(city / name) if (city / name).is_dir() else (city / name).unlink()
    assert finish(city, None, load(), trains_on(default_device))
    assert (city / "model.ply").read_bytes() == (done_city / "model.ply").read_bytes()


def test_a_damaged_merge_is_written_anew(done_city: Path, tmp_path: Path) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    (city / "merged.ply").write_bytes(b"no PLY")
    assert not is_merged(city, read_plan(city))
    assert merge(city)
    assert (city / "merged.ply").read_bytes() == (done_city / "merged.ply").read_bytes()


def test_what_is_not_finished_is_named(city: Path, default_device: Device) -> None:
    assert "2 of 2 blocks are not finished (0,0, 1,0); run clsplat blocks train" in refusal(lambda: merge(city))
    train_block(city, "0,0", load(), trains_on(default_device))
    assert "1 of 2 blocks are not finished (1,0)" in refusal(lambda: merge(city))
    assert "1 of 2 blocks are not finished" in refusal(lambda: finish(city, None, load(), trains_on(default_device)))
    assert "--block 7,7: the plan has no such block, expected one of 0,0, 1,0" in refusal(
        lambda: train_block(city, "7,7", load(), trains_on(default_device))
    )


def test_changed_models_are_refused(done_city: Path, tmp_path: Path, default_device: Device) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    model = city / "blocks" / "0_0" / "model.ply"
    whole = model.read_bytes()
    model.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    (city / "merged.ply").unlink()
    assert f"{model}: is not the file that the block's training wrote" in refusal(lambda: merge(city))
    model.write_bytes(whole)
    assert "merged.ply: is missing, expected the merge" in refusal(
        lambda: finish(city, None, load(), trains_on(default_device))
    )
    shutil.copy(model, city / "merged.ply")
    assert "merged.ply: is no merge of blocks, expected the merge of all blocks" in refusal(
        lambda: finish(city, None, load(), trains_on(default_device))
    )
    coarse = city / "coarse" / "model.ply"
    coarse.write_bytes(whole)
    (city / "blocks" / "1_0" / "done.json").unlink()
    assert "coarse/model.ply: is not the coarse model" in refusal(
        lambda: train_block(city, "1,0", load(), trains_on(default_device))
    )


def test_a_run_of_another_plan_is_refused(done_city: Path, tmp_path: Path, default_device: Device) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    plan = json.loads((city / "plan.json").read_text())
    plan["blocks"][0]["iterations"] += 1
    (city / "plan.json").write_text(json.dumps(plan))
    assert "blocks/0_0: its training began by another plan" in refusal(
        lambda: train_block(city, "0,0", load(), trains_on(default_device))
    )
    done = city / "blocks" / "0_0" / "done.json"
    for content, said in (
        ("[]", "done.json: is not a JSON object"),
        (
            '{"clsplat_block": 1, "model": "ab"}',
            "clsplat_block is 1, expected 2: another version of clsplat began this training",
        ),
        ('{"clsplat_block": 2, "plan": "ab", "start": "cd", "files": {}}', "done.json: is damaged, expected a record"),
    ):
        done.write_text(content)
        assert said in refusal(lambda: train_block(city, "0,0", load(), trains_on(default_device)))


def test_a_finish_of_another_version(done_city: Path, tmp_path: Path, default_device: Device) -> None:
    city = shutil.copytree(done_city, tmp_path / "city")
    (city / "done.json").unlink()
    (city / "begun.json").write_text('{"clsplat_block": 1}')
    said = refusal(lambda: finish(city, None, load(), trains_on(default_device)))
    assert "another version of clsplat began this training" in said
    assert "to train the finish anew, remove from this folder: begun.json, " in said


def test_a_missing_photograph_is_named(
    planned_city: Path, small_scene: Path, tmp_path: Path, default_device: Device
) -> None:
    city = shutil.copytree(planned_city, tmp_path / "city")
    scene = shutil.copytree(small_scene, tmp_path / "scene")
    plan = json.loads((city / "plan.json").read_text())
    plan["scene"] = str(scene)
    (city / "plan.json").write_text(json.dumps(plan))
    (scene / "images" / "09.png").unlink()
    units = list[float]()

    def train(scene: Scene, run: Run, start: Start) -> object:
        units.append(scene.extent)
        return trains_on(default_device)(scene, run, start)

    assert train_block(city, "0,0", load(), train), "the block does not have this photograph"
    assert units == [load_scene_of(WHOLE, small_scene).extent], "that of the whole, with the missing camera"
    assert "1 view missing now (09.png)" in refusal(lambda: train_block(city, "1,0", load(), trains_on(default_device)))


def test_a_folder_that_another_process_writes_is_refused(city: Path, default_device: Device) -> None:
    import subprocess
    import sys

    folder = city / "blocks" / "0_0"
    folder.mkdir(parents=True)
    code = (
        "import sys\nfrom pathlib import Path\nfrom clsplat.runs.locks import locked\n"
        "with locked(Path(sys.argv[1]), 'blocks'):\n    print('held', flush=True)\n    sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        assert other.stdin is not None
        other.stdout.readline()
        said = refusal(lambda: train_block(city, "0,0", load(), trains_on(default_device)))
        other.stdin.close()
    assert "blocks/0_0: is being written by clsplat blocks (process" in said


@pytest.mark.parametrize("sky", [0, 5])
def test_only_the_skys_points_may_be_others(city: Path, default_device: Device, sky: int) -> None:
    """How many points the sky gets depends on the size of the photographs, which the coarse model has another."""
    plan = json.loads((city / "plan.json").read_text())
    plan["train"]["sky"] = sky
    (city / "plan.json").write_text(json.dumps(plan))
    record = json.loads((city / "coarse" / "scene.json").read_text())
    record["points"]["count"] += 1
    (city / "coarse" / "scene.json").write_text(json.dumps(record))
    if sky:
        assert train_block(city, "0,0", load(), trains_on(default_device))
    else:
        assert "other points" in refusal(lambda: train_block(city, "0,0", load(), trains_on(default_device)))
