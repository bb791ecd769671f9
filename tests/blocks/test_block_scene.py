# SPDX-License-Identifier: Apache-2.0
"""What blocks and finish take from the coarse model: appearance, which they train, and refined cameras."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from calls import refusal
from small_city import FINISH_STEPS, WHOLE, load, trains_on, write_city

from clsplat.blocks.block_training import finish, train_block
from clsplat.blocks.merging import merge
from clsplat.blocks.plan import SKY_BLOCK, Rectangle, Sky, read_plan, write_plan
from clsplat.blocks.progress_records import keep_done
from clsplat.device.context import Device
from clsplat.runs.refined_lenses import through_refined
from clsplat.runs.run import Run
from clsplat.runs.scene_record import read
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE, Georeference, read_georeference
from clsplat.scenes.loading import load_scene_of
from clsplat.scenes.readers.colmap import read_cameras
from clsplat.scenes.scene import Scene
from clsplat.training.start import Start

SETTINGS = replace(
    WHOLE,
    appearance="exposure",
    refine_poses=True,
    refine_lenses=True,
    refine_gate=0.0,
    density=replace(WHOLE.density, every=0),
)


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory, small_scene: Path, default_device: Device) -> Path:
    """A city whose coarse model has refined cameras and learnt exposures."""
    city = tmp_path_factory.mktemp("refined") / "city"
    write_city(city, small_scene, default_device, SETTINGS)
    (city / "coarse" / "refined" / GEOREFERENCE_FILE).write_bytes(Georeference(32632).content())
    for name in ("0,0", "1,0"):
        assert train_block(city, name, load(), trains_on(default_device))
    assert merge(city)
    assert finish(city, None, load(), trains_on(default_device))
    return city


EVERYWHERE = Rectangle((-inf, -inf), (inf, inf))


def gains(run: Path) -> dict[str, object]:
    photographs: dict[str, object] = json.loads((run / "appearance.json").read_text())["photographs"]
    return photographs


def test_blocks_and_finish_go_on_with_the_appearance(refined: Path, tmp_path: Path) -> None:
    """Blocks begin with the coarse model's, and the finish with the merged one."""
    city, starts = shutil.copytree(refined, tmp_path / "city"), list[Start]()

    def stop(_scene: Scene, _run: Run, start: Start) -> None:
        starts.append(start)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        finish(city, FINISH_STEPS + 1, load(), stop)
    shutil.rmtree(city / "blocks" / "0_0")
    with pytest.raises(KeyboardInterrupt):
        train_block(city, "0,0", load(), stop)
    last, block = starts
    assert (block.appearance_of, last.appearance_of) == (city / "coarse", city / "merged")


def test_all_photographs_of_a_block_get_an_appearance(refined: Path) -> None:
    coarse, last = gains(refined / "coarse"), gains(refined)
    assert any(np.abs(np.array(row["log2_gains"])).max() > 1e-3 for row in coarse.values())  # type: ignore[index]
    assert coarse.keys() == last.keys()
    for name in ("0_0", "1_0"):
        block = gains(refined / "blocks" / name)
        assert len(block) == 7
        assert all(block[each] != coarse[each] for each in block)


def test_blocks_and_finish_have_the_refined_cameras(refined: Path, small_scene: Path) -> None:
    cameras = read_cameras(refined / "coarse" / "refined")
    given = {view.name: view.camera for view in load_scene_of(SETTINGS, small_scene).views}
    for folder in ("blocks/0_0", "blocks/1_0", "."):
        run = Run.open(refined / folder)
        record = read(run)
        assert record is not None
        assert not run.config.refines
        for name, view in record["views"].items():
            camera = cameras[name] if view["split"] == "train" else given[name]
            # as text and back, with 17 digits
            np.testing.assert_allclose(view["pose"], [*camera.rotation.ravel(), *camera.translation], atol=1e-12)
            assert view["lens"][0] == pytest.approx(cameras[name].fx, rel=1e-12)
    moved = [np.abs(cameras[name].translation - camera.translation).max() for name, camera in given.items()]
    assert max(moved) > 1e-4


def test_the_evaluation_of_the_city_sees_through_the_refined_lenses(refined: Path, small_scene: Path) -> None:
    views = load_scene_of(SETTINGS, small_scene).test_views
    cameras = read_cameras(refined / "coarse" / "refined")
    for view in through_refined(views, Run.open(refined)):
        assert view.camera.fx == pytest.approx(cameras[view.name].fx, rel=1e-12)
        assert view.camera.fx != views[0].camera.fx


def test_a_city_without_the_learnt_appearance_is_refused(refined: Path, tmp_path: Path, default_device: Device) -> None:
    city = shutil.copytree(refined, tmp_path / "city")
    (city / "coarse" / "appearance.json").unlink()
    (city / "blocks" / "0_0" / "done.json").unlink()
    said = refusal(lambda: train_block(city, "0,0", load(), trains_on(default_device)))
    assert "coarse/appearance.json: no such file, expected the result of the coarse model; remove" in said
    assert "plan.json, and run clsplat blocks plan again" in said


def test_the_merged_appearance_is_the_mean_of_the_blocks(refined: Path) -> None:
    coarse, merged = gains(refined / "coarse"), gains(refined / "merged")
    blocks = [gains(refined / "blocks" / name) for name in ("0_0", "1_0")]
    assert merged.keys() == coarse.keys()
    assert any(name in blocks[0] and name in blocks[1] for name in merged)
    held_out = json.loads((refined / "appearance.json").read_text())["held_out"]
    mean = np.mean([row["log2_gains"] for row in merged.values()], axis=0)  # type: ignore[index]
    assert np.abs(mean).max() > 1e-4
    for row in held_out.values():
        np.testing.assert_allclose(row["log2_gains"], mean, rtol=1e-12)  # a sum of ten doubles
    for name, row in merged.items():
        found = [block[name]["log2_gains"] for block in blocks if name in block]  # type: ignore[index]
        wanted = np.mean(found, axis=0).tolist() if found else coarse[name]["log2_gains"]  # type: ignore[index]
        assert row == {"log2_gains": wanted}


def test_the_skys_gains_are_not_merged(refined: Path, tmp_path: Path) -> None:
    city = shutil.copytree(refined, tmp_path / "city")
    plan, folder = read_plan(city), city / "blocks" / "sky"
    shutil.copytree(city / "blocks" / "1_0", folder)
    record = json.loads((folder / "appearance.json").read_text())
    for row in record["photographs"].values():
        row["log2_gains"] = [5.0, 5.0, 5.0]
    (folder / "appearance.json").write_text(json.dumps(record))
    sky = replace(plan.blocks[1], name=SKY_BLOCK, cell=EVERYWHERE, widened=EVERYWHERE)
    plan = replace(plan, sky=Sky((0.0, 0.0, 0.0), 100.0), blocks=(*plan.blocks, sky))
    write_plan(city, plan)
    for block in plan.blocks:
        keep_done(Run.open(city / "blocks" / block.name), plan.digest, plan.coarse)
    before = gains(city / "merged")
    assert merge(city)
    assert gains(city / "merged") == before


def test_a_block_without_its_appearance_is_trained_again(refined: Path, tmp_path: Path, default_device: Device) -> None:
    """As when someone has copied the models of blocks alone."""
    city = shutil.copytree(refined, tmp_path / "city")
    learnt = city / "blocks" / "0_0" / "appearance.json"
    content = learnt.read_bytes()
    assert not train_block(city, "0,0", load(), trains_on(default_device))
    learnt.unlink()
    for call in (lambda: merge(city), lambda: finish(city, FINISH_STEPS + 1, load(), trains_on(default_device))):
        assert "1 of 2 blocks are not finished (0,0); run clsplat blocks train" in refusal(call)
    assert (city / "done.json").exists()
    assert train_block(city, "0,0", load(), trains_on(default_device))
    assert learnt.read_bytes() == content
    assert not merge(city)


def test_the_merged_appearance_is_missing_or_a_blocks_has_changed(
    refined: Path, tmp_path: Path, default_device: Device
) -> None:
    city = shutil.copytree(refined, tmp_path / "city")
    merged, block = city / "merged" / "appearance.json", city / "blocks" / "1_0" / "appearance.json"
    content = merged.read_bytes()
    merged.unlink()
    said = refusal(lambda: finish(city, FINISH_STEPS + 1, load(), trains_on(default_device)))
    assert (
        f"merged: lacks the merged appearance, expected the merge of all blocks; run clsplat blocks merge {city}"
        in said
    )
    assert merge(city)
    assert merged.read_bytes() == content
    merged.write_text("{")
    said = refusal(lambda: finish(city, FINISH_STEPS + 1, load(), trains_on(default_device)))
    assert f"remove the file, and run clsplat blocks merge {city}" in said
    assert (city / "done.json").exists()
    merged.unlink()
    block.write_bytes(block.read_bytes().replace(b"0.", b"1.", 1))
    assert "1_0/appearance.json: is not the file that the block's training wrote; put it back" in refusal(
        lambda: merge(city)
    )


def test_the_city_has_the_refined_cameras_and_their_place(refined: Path) -> None:
    names = {"cameras.txt", "images.txt", "points3D.txt", GEOREFERENCE_FILE}
    assert {path.name for path in (refined / "refined").iterdir()} == names
    place = read_georeference(refined / "refined" / GEOREFERENCE_FILE)
    assert place is not None
    assert place.epsg == 32632
