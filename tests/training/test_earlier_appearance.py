# SPDX-License-Identifier: Apache-2.0
"""A training that begins with the appearance of an earlier run."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refusal
from compare import assert_same_bits
from tiny import short

from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.training.loop import StepReport
from clsplat.training.start import Start
from clsplat.training.trainer import Trainer

KINDS = ("exposure", "ppisp", "grid")
CONFIG = short(iterations=12, report=False, test_every=0, warmup=(), density={"every": 0})


def config_of(kind: str, **changes: object) -> TrainConfig:
    return replace(CONFIG, appearance=kind, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module", params=KINDS)
def earlier(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, scene: Scene, default_device: Device
) -> Run:
    """A run that has learnt one of the appearances of all photographs."""
    config = config_of(request.param)
    run = Run.create(tmp_path_factory.mktemp("earlier") / "run", config)
    run.model = train(scene, config, run=run, device=default_device)
    return run


def some_of(scene: Scene) -> Scene:
    """Every second training view, so that places in arrays differ from the earlier run's."""
    return replace(scene, views=scene.train_views[1::2])


def photographs(record: dict[str, object]) -> dict[str, object]:
    return json.loads(json.dumps(record["photographs"]))


def values(trainer: Trainer) -> dict[str, np.ndarray]:
    """What the trainer's appearance has of each photograph."""
    record = photographs(trainer.appearance.record() or {})
    grids = trainer.appearance.tables().get("grids")
    if grids is not None:
        return {name: grids[row["grid"]] for name, row in record.items()}
    return {name: np.concatenate([row[part] for part in sorted(row)]) for name, row in record.items()}


def of_run(run: Run) -> dict[str, np.ndarray]:
    record = photographs(json.loads(run.appearance_path.read_text()))
    if run.config.appearance == "grid":
        grids = grids_of_run(run)
        return {name: grids[row["grid"]] for name, row in record.items()}
    return {name: np.concatenate([row[part] for part in sorted(row)]) for name, row in record.items()}


def grids_of_run(run: Run) -> np.ndarray:
    with np.load(run.appearance_path.with_suffix(".npz")) as file:
        return file["grids"]


def write_changed(folder: Path, run: Run, names: Iterable[str], change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """Write what a run has learnt of some photographs, with other gains or grids. Returns the folder."""
    folder.mkdir()
    record = json.loads(run.appearance_path.read_text())
    rows = {name: dict(record["photographs"][name]) for name in names}
    if run.config.appearance == "grid":
        np.savez(folder / "appearance.npz", grids=change(grids_of_run(run)).astype(np.float32))
    else:
        for row in rows.values():
            row["log2_gains"] = change(np.array(row["log2_gains"])).tolist()
    (folder / "appearance.json").write_text(json.dumps({**record, "photographs": rows}))
    return folder


def test_the_loss_is_that_of_the_earlier_appearance(earlier: Run, scene: Scene, default_device: Device) -> None:
    """The first step's loss is the earlier training's with the same model and view, not that of plain photographs."""
    one = replace(scene, views=scene.train_views[2:3])
    config = earlier.config
    start = Start(earlier.model, appearance_of=earlier.path)
    begun = Trainer(one, config, default_device, start).train_step(reads_loss=True).read()[0]
    fresh, plain = (
        Trainer(one, other, default_device, earlier.model).train_step(reads_loss=True).read()[0]
        for other in (config, replace(config, appearance="none"))
    )
    assert begun not in (fresh, plain)


def test_an_appearance_goes_on_where_it_was(earlier: Run, scene: Scene, default_device: Device) -> None:
    start = Start(earlier.model, appearance_of=earlier.path)
    trainer = Trainer(scene, earlier.config, default_device, start)
    for name, value in values(trainer).items():
        assert_same_bits(value, of_run(earlier)[name], name)
    for _ in range(6):
        trainer.train_step()
    assert any((value != of_run(earlier)[name]).any() for name, value in values(trainer).items())


def test_the_mean_of_some_photographs_stays(earlier: Run, scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """The photographs of a block may all be brighter than the scene's. The block trains their differences alone."""
    some = some_of(scene)
    brighter = write_changed(
        tmp_path / "brighter", earlier, [view.name for view in some.views], lambda values: values + 0.5
    )
    start = Start(earlier.model, appearance_of=brighter)
    trainer = Trainer(some, earlier.config, default_device, start)

    def kept() -> np.ndarray:
        record = photographs(trainer.appearance.record() or {})
        rows = [row.get("log2_gains") for row in record.values()]  # type: ignore[attr-defined]
        return np.array(list(values(trainer).values()) if None in rows else rows)

    before = kept()
    for _ in range(3 * len(before)):
        trainer.train_step()
    now = kept()
    assert np.abs(now - before).max() > 1e-3
    assert np.abs(before.mean(axis=0)).max() > 0.4
    # roundings of float32 numbers below 2
    np.testing.assert_allclose(now.mean(axis=0), before.mean(axis=0), rtol=0, atol=4e-7)


def test_vignettes_stay_in_a_region(scene: Scene, default_device: Device, earlier: Run) -> None:
    """Gains and mixes of its photographs move."""
    everywhere = TrainedRegion(np.eye(3)[:2], np.full(2, -np.inf), np.full(2, np.inf))
    for region in (everywhere, None):
        trainer = Trainer(scene, earlier.config, default_device, Start(earlier.model, region, earlier.path))
        before = photographs(trainer.appearance.record() or {})
        for _ in range(4):
            trainer.train_step()
        now = photographs(trainer.appearance.record() or {})
        moved = {part for name, row in now.items() for part in row if row[part] != before[name][part]}  # type: ignore[index, attr-defined]
        kept = {"centre", "grid"} | ({"vignette"} if region is not None else set())
        assert moved == {part for row in now.values() for part in row} - kept  # type: ignore[attr-defined]


@pytest.mark.parametrize("batch", [1, 2])
def test_a_resumed_training_has_the_same_bytes(
    earlier: Run, scene: Scene, default_device: Device, tmp_path: Path, batch: int
) -> None:
    some, config = some_of(scene), replace(earlier.config, batch=batch, checkpoint_every=4)
    start = Start(earlier.model, appearance_of=earlier.path)
    runs = [Run.create(tmp_path / name, config) for name in ("whole", "run")]
    whole = train(some, config, run=runs[0], device=default_device, start=start)

    def stop(report: StepReport) -> None:
        if report.step == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(some, config, run=runs[1], device=default_device, start=start, on_step=stop)
    resumed = train(some, config, run=Run.open(runs[1].path), resume=True, device=default_device, start=start)
    for name, array in whole.arrays().items():
        assert_same_bits(resumed.arrays()[name], array, name)
    learnt = of_run(Run.open(runs[0].path))
    for name, value in of_run(Run.open(runs[1].path)).items():
        assert_same_bits(value, learnt[name], name)
        assert (value != of_run(earlier)[name]).any()


def test_what_is_missing_is_named(earlier: Run, scene: Scene, default_device: Device, tmp_path: Path) -> None:
    def begun(folder: Path, kind: str = earlier.config.appearance) -> str:
        start = Start(earlier.model, appearance_of=folder)
        return refusal(lambda: Trainer(scene, config_of(kind), default_device, start))

    assert "appearance.json: no such file" in begun(tmp_path)
    other = KINDS[KINDS.index(earlier.config.appearance) - 1]
    assert f"is of --appearance {earlier.config.appearance}, expected --appearance {other}" in begun(
        earlier.path, other
    )
    record = json.loads(earlier.appearance_path.read_text())
    name = scene.train_views[3].name
    del record["photographs"][name]
    (tmp_path / "appearance.json").write_text(json.dumps(record))
    assert f"lacks 1 of {len(scene.train_views)} photographs ({name})" in begun(tmp_path)
    record["photographs"][name] = {"log2_gains": [0, "a", 1], "grid": -1}
    (tmp_path / "appearance.json").write_text(json.dumps(record))
    assert "expected a file that clsplat train --appearance writes" in begun(tmp_path)
    start = Start(earlier.model, appearance_of=earlier.path)
    said = refusal(lambda: train(scene, config_of("none"), device=default_device, start=start))
    assert "the settings learn no appearance" in said
