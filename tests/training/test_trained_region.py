# SPDX-License-Identifier: Apache-2.0
"""Trainings of the Gaussians in a region: the others keep every byte, and no way of running a step changes a bit."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare import assert_same_arrays
from pipeline import shaped
from quick import quick
from same_bytes import SETTINGS, State, make_too_small, opened_again, scene_for, state, state_of, write_known_scene
from tiny import CONFIG, FEW, hidden_model, run_steps, short, trained_to
from wide import let_small_models_have_chunks, wide_model

from clsplat.api import train
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.device.selection import open_device
from clsplat.errors import ClsplatError, InputError
from clsplat.gaussians import Gaussians
from clsplat.models.edit import take
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.runs.checkpoints import Checkpoint
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.stages import region as region_stage
from clsplat.training.memory import UNLIMITED, HostMemory
from clsplat.training.repro_bundle import read_bundle, replay, write_bundle
from clsplat.training.stability.health import Incident
from clsplat.training.start import Start, region_of, region_state
from clsplat.training.step import visible_chunks
from clsplat.training.step.speculative_steps import BY_CAPACITY_VARIABLE
from clsplat.training.trainer import Trainer

GROUND = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
REGION = TrainedRegion(GROUND, np.array([-0.1, -np.inf]), np.array([np.inf, 0.6]))
"""Region with 24 of the 40 Gaussians of `start_model`."""
EVERYWHERE = TrainedRegion(GROUND, np.full(2, -np.inf), np.full(2, np.inf))
CENTRE = np.array([0.1, -0.05, 0.2])
"""Centre of the regions with limits of distance, at which half of those Gaussians are nearer than 0.55."""
NEAR = replace(REGION, centre=CENTRE, farthest=0.55)
FAR = replace(EVERYWHERE, centre=CENTRE, nearest=0.55)
NAMES = [name for name, config in SETTINGS.items() if not config.refines]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene with alpha, masks and known depths."""
    return write_known_scene(tmp_path_factory.mktemp("known") / "scene")


def start_model(*, antialiased: bool = False) -> Gaussians:
    """The hidden model of the tiny scene, somewhat off."""
    rng, model = np.random.default_rng(3), hidden_model()
    model.means += rng.normal(0, 0.05, model.means.shape).astype(np.float32)
    model.log_scales += rng.normal(0.1, 0.2, model.log_scales.shape).astype(np.float32)
    model.sh *= np.float32(0.5)
    model.antialiased = antialiased
    return model


def rows_of(model: Gaussians) -> list[bytes]:
    """The bytes of all parameters of each Gaussian, with SH of degree 3."""
    sh = np.zeros((len(model), 16, 3), np.float32)
    sh[:, : model.sh.shape[1]] = model.sh
    arrays = {**model.arrays(), "sh": sh}
    return [b"".join(array[row].tobytes() for array in arrays.values()) for row in range(len(model))]


def to_end(scene: Scene, config: TrainConfig, device: Device, start: Start, **options: Any) -> Trainer:
    """The trainer after all steps. options: arguments of `Trainer`."""
    trainer = Trainer(scene, config, device, start, **options)
    run_steps(config.iterations // config.batch, trainer)
    return trainer


def start_of(config: TrainConfig, region: TrainedRegion | None = REGION) -> Start:
    return Start(start_model(antialiased=config.antialiased), region)


def outside(model: Gaussians, region: TrainedRegion = REGION) -> Gaussians:
    return take(model, ~region.contains(model.means))


# The region itself


def test_cells_that_share_edges_cover_each_point_once() -> None:
    """Also points on the edges, at any origin, for axes that are not those of the world."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    origin = np.array([4.5e5, -12.0, 5.4e6])
    means = rng.normal(0, 50, (2000, 3)).astype(np.float32)
    found = TrainedRegion(axes, np.full(2, -np.inf), np.full(2, np.inf)).relative_to(origin).coordinates(means)
    # some edges are a coordinate of a mean to the bit
    edges = [np.concatenate([[-np.inf], np.sort(found[rng.integers(0, 2000, 3), k]), [np.inf]]) for k in range(2)]
    shift, covered = axes @ origin, np.zeros(len(means), int)
    for i in range(4):
        for j in range(4):
            low = np.array([edges[0][i], edges[1][j]]) + shift
            high = np.array([edges[0][i + 1], edges[1][j + 1]]) + shift
            covered += TrainedRegion(axes, low, high).contains(means, origin)
    assert (covered == 1).all()


def test_edges_are_half_open() -> None:
    region = TrainedRegion(GROUND, np.array([0.0, 0.0]), np.array([1.0, 1.0]))
    below = np.nextafter(np.float32(1), np.float32(0))
    means = np.array([[0, 9, 0], [below, -9, below], [1, 0, 0.5], [0.5, 0, 1], [-1e-30, 0, 0], [np.nan, 0, 0.5]])
    assert region.contains(means.astype(np.float32)).tolist() == [True, True, False, False, False, False]
    huge = np.array([[np.inf, 0, 0], [3e38, 0, 0]], np.float32)
    assert EVERYWHERE.contains(huge).tolist() == [False, True], "infinity times the axis' 0 is no number"


def test_a_sphere_divides_each_cell_in_two() -> None:
    """Also at distances that are exactly the radius, and beyond float32's squares."""
    rng, origin = np.random.default_rng(2), np.array([4.5e5, -12.0, 5.4e6])
    means = rng.normal(0, 50, (2000, 3)).astype(np.float32)
    means[:3] = [[3e38, 0, 0], [0, 1e25, 0], [np.nan, 0, 0]]
    centre = origin + rng.normal(0, 20, 3)
    squares = replace(EVERYWHERE, centre=centre).relative_to(origin).squares(means)
    for radius in (*np.sqrt(squares[5:9].astype(np.float64)), 40.0, 1e-3):
        cell = TrainedRegion(GROUND, origin[[0, 2]], np.full(2, np.inf), centre)
        parts = replace(cell, farthest=radius), replace(cell, nearest=radius)
        inside, outside = (part.contains(means, origin) for part in parts)
        assert not (inside & outside).any()
        assert ((inside | outside) == cell.contains(means, origin)).all()
    found = replace(EVERYWHERE, nearest=5.0).contains(np.array([[3, 4, 0], [3, 3.9, 0], [3e38, 1, 1]], np.float32))
    assert found.tolist() == [True, False, True]
    assert replace(EVERYWHERE, farthest=5.0).contains(np.array([[3, 4, 0], [3, 3.9, 0]], np.float32)).tolist() == [
        False,
        True,
    ]


def test_far_from_the_origin_of_the_world() -> None:
    """A region of 0.1 at 5,000 km, where float32 numbers are 0.5 apart."""
    origin = np.array([5e6, 0.0, 5e6])
    region = TrainedRegion(GROUND, origin[[0, 2]] - 0.05, origin[[0, 2]] + 0.05)
    means = np.array([[0.04, 1, 0], [0.06, 1, 0], [0, 1, -0.06]], np.float32)
    assert region.contains(means, origin).tolist() == [True, False, False]


@pytest.mark.parametrize("rows", [1, 7, 20, 40, 41])
def test_rows_inside_are_found_piece_by_piece(
    default_device: Device, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    monkeypatch.setattr(region_stage, "TESTED_ROWS", rows)
    means = start_model().means
    found = region_stage.rows_inside(upload(default_device, means), REGION)
    assert found.tolist() == np.flatnonzero(REGION.contains(means)).tolist()
    assert len(region_stage.rows_inside(upload(default_device, means[:0]), REGION)) == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axes": np.ones(3)}, r"region: axes is array\(.*, expected \(2, 3\) numbers"),
        ({"axes": np.full((2, 3), np.inf)}, "region: axes is"),
        ({"low": [0, np.nan]}, r"region: low is \[0, nan\], expected \(2,\) numbers"),
        ({"high": "wide"}, r"region: high is 'wide', expected \(2,\) numbers"),
        ({"low": [1, 0]}, r"region: low is \[1.0, 0.0\] and high \[1.0, 1.0\], expected low < high"),
        ({"centre": np.array([0, 0, np.inf])}, r"region: centre is array\(.*, expected \(3,\) numbers"),
        (
            {"nearest": 2.0, "farthest": 2.0},
            "region: nearest is 2.0 and farthest 2.0, expected 0 <= nearest < farthest",
        ),
        ({"nearest": -1.0}, "region: nearest is -1.0"),
        ({"farthest": np.nan}, "region: nearest is 0.0 and farthest nan"),
    ],
)
def test_a_wrong_region(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrainedRegion(**{"axes": GROUND, "low": np.zeros(2), "high": np.ones(2), **changes})


# Trainings


@pytest.mark.parametrize("region", [NEAR, FAR], ids=["near", "far"])
def test_gaussians_beyond_a_distance_keep_every_byte(
    region: TrainedRegion, folder: Path, default_device: Device
) -> None:
    config, model = SETTINGS["MCMC"], start_model()
    given = rows_of(outside(model, region))
    assert 5 < len(given) < 35
    trainer = to_end(scene_for(folder, config), config, default_device, Start(model, region))
    after = rows_of(trainer.gaussians())
    assert set(given) <= set(after)
    assert not set(after) & set(rows_of(take(model, region.contains(model.means))))
    again = region_of(region_state(region)["region"])
    assert again is not None
    assert again.numbers == region.numbers


@dataclass(frozen=True)
class Outcome:
    """A training in REGION: the arrays of the last checkpoint, the model before `Trainer.finish`, and after it."""

    checkpoint: State
    before: Gaussians
    finished: Gaussians


Outcomes = Callable[[str], Outcome]


def outcome_of(folder: Path, name: str, device: Device) -> Outcome:
    """Train `start_model` with these settings."""
    config = SETTINGS[name]
    trainer = to_end(scene_for(folder, config), config, device, start_of(config))
    # copies, as arrays of a trainer may change when it finishes
    checkpoint = {key: array.copy() for key, array in trainer.checkpoint()[0].items()}
    before = trainer.gaussians()
    trainer.finish()
    return Outcome(checkpoint, before, trainer.gaussians())


@pytest.fixture(scope="module")
def undisturbed(folder: Path, default_device: Device) -> Outcomes:
    """Outcomes of trainings in the region, by the name of the settings, each trained once."""
    return cache(lambda name: outcome_of(folder, name, default_device))


def check_outside(name: str, found: Outcome) -> None:
    """Fail unless the Gaussians outside keep their bytes until they go, and density control changes the others."""
    model = start_model(antialiased=SETTINGS[name].antialiased)
    given, after = rows_of(outside(model)), rows_of(found.before)
    assert len(given) == 16
    assert set(given) <= set(after)
    assert not set(after) & set(rows_of(take(model, REGION.contains(model.means)))), "the others are trained"
    assert len(after) != len(model), "and density control changes their number"
    assert len(outside(found.finished)) == 0
    assert set(rows_of(found.finished)) < set(after)


@pytest.mark.parametrize("name", quick(NAMES, "contributions", "MCMC", "absolute", "late", "antialiased"))
def test_gaussians_outside_keep_every_byte(name: str, undisturbed: Outcomes) -> None:
    """Through density control, opacity resets and SH degrees; at the end they are gone."""
    check_outside(name, undisturbed(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["contributions", "MCMC", "late", "rays"])
def test_in_groups_of_work_items_too(name: str, folder: Path, default_device: Device) -> None:
    """Each way of growth, of steps, and of projection once: the settings differ in kernels of their own."""
    check_outside(name, outcome_of(folder, name, shaped(default_device, 1, 64)))


@pytest.mark.parametrize("lanes", quick([8, 1], 8))
@pytest.mark.parametrize("batch", [1, 2])
def test_a_step_inside_is_that_without_a_region(scene: Scene, default_device: Device, lanes: int, batch: int) -> None:
    config = replace(FEW, batch=batch, penalty=0.01, optimiser=CONFIG.optimiser)
    device, model = default_device if lanes > 1 else shaped(default_device, 1, 64), start_model()
    free, held = (trained_to(1, scene, config, device, initial=Start(model, region)) for region in (None, REGION))
    inside, wanted, got = REGION.contains(model.means), rows_of(free.gaussians()), rows_of(held.gaussians())
    assert [row for row, of in zip(got, inside, strict=True) if of] == [
        row for row, of in zip(wanted, inside, strict=True) if of
    ]
    assert [row for row, of in zip(got, inside, strict=True) if not of] == rows_of(outside(model))


@pytest.mark.parametrize("name", quick(NAMES, "contributions", "batch"))
def test_a_region_of_everything_changes_nothing(name: str, folder: Path, default_device: Device) -> None:
    config, found = SETTINGS[name], []
    for region in (None, EVERYWHERE):
        trainer = to_end(scene_for(folder, config), config, default_device, start_of(config, region))
        trainer.finish()
        found.append(trainer.checkpoint()[0])
    assert_same_arrays(found[1], found[0])


@pytest.mark.parametrize("name", quick(NAMES, "contributions", "absolute"))
def test_in_poisoned_memory(
    name: str, folder: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch, undisturbed: Outcomes
) -> None:
    """Nothing reads results of Gaussians outside that no kernel has written."""
    wanted, config = undisturbed(name).checkpoint, SETTINGS[name]
    monkeypatch.setenv("CLSPLAT_POISON", "1")
    got = to_end(scene_for(folder, config), config, default_device, start_of(config))
    assert_same_arrays(got.checkpoint()[0], wanted)


@pytest.mark.parametrize("name", quick(["exposure", "long axis", "MCMC", "late"], "MCMC"))
def test_steps_that_are_repeated(
    name: str, folder: Path, default_device: Device, monkeypatch: pytest.MonkeyPatch, undisturbed: Outcomes
) -> None:
    monkeypatch.setenv(BY_CAPACITY_VARIABLE, "1")
    config = SETTINGS[name]
    trainer = Trainer(scene_for(folder, config), config, default_device, start_of(config))
    make_too_small(monkeypatch, trainer, (12, 31))
    run_steps(config.iterations, trainer)
    assert trainer.pending.redone > 0
    assert_same_arrays(trainer.checkpoint()[0], undisturbed(name).checkpoint)


def test_two_devices(folder: Path, default_device: Device, undisturbed: Outcomes) -> None:
    config, further = SETTINGS["batch"], [opened_again(default_device)]
    trainer = to_end(scene_for(folder, config), config, default_device, start_of(config), further=further)
    assert_same_arrays(trainer.checkpoint()[0], undisturbed("batch").checkpoint)
    trainer.close()


WIDE = short(iterations=40, report=False, warmup=(), density={"max_gaussians": 16_000})
LIMITS = {"device 4 MiB": (4 << 20, None), "host 1 MiB": (None, 1 << 20)}
"""Limits of memory as in test_visible_chunks.py. A host limit puts the chunks into a file."""


@pytest.mark.parametrize("name", ["chunks", *LIMITS])
def test_steps_over_chunks(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """On the device and streamed, steps over the chunks in view have the bytes of those over the whole model."""
    let_small_models_have_chunks(monkeypatch)
    of_device, of_host = LIMITS.get(name, (None, None))
    device = default_device if of_device is None else open_device(memory_limit=of_device)
    memory = UNLIMITED if of_host is None else HostMemory(limit=of_host, scratch=tmp_path, owner="test")
    start, found = Start(wide_model(), REGION), []
    for limited in (False, True):
        with pytest.MonkeyPatch.context() as patch:
            if not limited:
                patch.setattr(visible_chunks, "ORDERED_ROWS", 1 << 30)
            on = (device, start) if limited else (default_device, start)
            trainer = Trainer(scene, WIDE, *on, memory=memory if limited else UNLIMITED)
            run_steps(32, trainer)
            assert trainer.plan.streamed == (limited and name in LIMITS)
            found.append(state(trainer))
            trainer.finish()
            found.append(state(trainer))
            frozen = rows_of(outside(wide_model()))
            trainer.close()
    assert_same_arrays(found[2], found[0])
    assert_same_arrays(found[3], found[1])
    means = found[1]["parameters/means"]
    assert REGION.contains(means).all()
    assert 0 < len(means) < len(found[0]["parameters/means"]) - len(frozen) + 100


@pytest.mark.parametrize("name", quick(["antialiased", "MCMC", "batch", "late"], "MCMC"))
def test_in_less_memory(name: str, folder: Path, default_device: Device) -> None:
    """A model whose parts come to the device one after the other, since these steps run over the whole model."""
    config, found = replace(SETTINGS[name], density=replace(SETTINGS[name].density, max_gaussians=5000)), []
    start = Start(replace(wide_model(4000), antialiased=config.antialiased), REGION)
    device = default_device.with_memory_limit(None)
    for _ in range(2):
        trainer = to_end(scene_for(folder, config), config, device, start)
        found.append(trainer.checkpoint()[0])
        device = default_device.with_memory_limit(int(0.45 * device.memory.peak))
    assert trainer.plan.streamed
    assert_same_arrays(found[1], found[0])


# Runs


def test_a_run_that_is_stopped_goes_on(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    config, start = replace(CONFIG, report=False), Start(start_model(), REGION)

    def outcome(name: str, stop: int) -> Run:
        def press(trainer: Trainer, _: object) -> None:
            if trainer.step == stop:
                signal.raise_signal(signal.SIGINT)

        run = Run.create(tmp_path / name, config)
        if stop:
            with pytest.raises(KeyboardInterrupt):
                train(scene, config, device=default_device, run=run, start=start, between=press)
            run = Run.create(tmp_path / name, config, resume=True)
        train(scene, config, device=default_device, run=run, start=start, resume=bool(stop))
        return run

    whole, stopped = outcome("whole", 0), outcome("stopped", 17)
    assert_same_arrays(state_of(stopped), state_of(whole))
    model = Gaussians.load(whole.model_path)
    assert REGION.contains(model.means).all()
    assert len(model) < len(state_of(whole)["parameters/means"]), "checkpoints have the Gaussians outside too"


def test_another_region_is_refused(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    config = replace(FEW, checkpoint_every=2)
    run = Run.create(tmp_path / "run", config)
    train(scene, config, device=default_device, run=run, start=Start(start_model(), REGION))
    for start in (Start(), Start(start_model()), Start(start_model(), EVERYWHERE)):
        more = replace(config, iterations=6)
        with pytest.raises(
            InputError, match=r"step 3: was written by a training of the region .*'low': \[-0.1, None\]"
        ):
            train(scene, more, device=default_device, run=run, start=start, resume=True)
    plain = trained_to(1, scene, FEW, default_device)
    held = Trainer(scene, FEW, default_device, Start(start_model(), REGION))
    with pytest.raises(InputError, match=r"of the whole scene, and this training is of the region \{'axes'"):
        held.restore(Checkpoint(1, *plain.checkpoint()))


def test_a_scene_needs_no_points(scene: Scene, default_device: Device) -> None:
    """And the model's number of Gaussians stays without density control."""
    bare = replace(scene, points=scene.points[:0], point_colors=scene.point_colors[:0])
    model = train(bare, FEW, device=default_device, start=Start(start_model()))
    assert len(model) == len(start_model())


def model_with(**changes: Any) -> Gaussians:
    return replace(start_model(), **changes)


@pytest.mark.parametrize(
    ("start", "changes", "message"),
    [
        (start_model(), {}, r"start is Gaussians\(.*, expected Start\(model=..., region=...\)"),
        (Start(region=REGION), {}, "start has a region but no model"),
        (Start(start_model(), REGION), {"refine_poses": True}, "start has a region, and the settings refine cameras"),
        (Start(model_with(means=np.zeros((40, 2)))), {}, r"start: the model's means is float64 \(40, 2\)"),
        (Start(model_with(sh=np.zeros((40, 16, 3), np.float32))), {}, "SH degree 3, expected at most sh_degree 2"),
        (Start(start_model(antialiased=True)), {}, "antialiased=True, the settings have antialiased=False"),
        (
            Start(start_model(), TrainedRegion(GROUND, np.full(2, 9.0), np.full(2, 10.0))),
            {},
            "start: the model of 40 Gaussians has none in the region, expected at least one",
        ),
    ],
)
def test_a_wrong_start(scene: Scene, default_device: Device, start: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        train(scene, replace(FEW, **changes), device=default_device, start=start)


def test_nothing_left_in_the_region(scene: Scene, default_device: Device) -> None:
    model = start_model()
    model.opacity_logits[REGION.contains(model.means)] = -9  # below --density.min-opacity
    config = short(iterations=16, density={"opacity_reset_every": 0})
    trainer = to_end(scene, config, default_device, Start(model, REGION))
    with pytest.raises(ClsplatError, match=r"no Gaussian is left in the region.*--density.min-opacity"):
        trainer.finish()
    with pytest.raises(InputError, match="none of the 8 training photographs shows the region"):
        train(scene, config, device=default_device, start=Start(model, REGION))


# Values that are not finite


def test_a_broken_gaussian_outside_is_removed(scene: Scene, default_device: Device) -> None:
    """As one that no view shows; the others outside keep their bytes."""
    trainer = Trainer(scene, FEW, default_device, Start(start_model(), REGION))
    row = int(np.flatnonzero(~REGION.contains(start_model().means))[3])
    means = trainer.parameters["means"].get()
    means[row] = np.nan
    trainer.parameters["means"].set(means)
    run_steps(2, trainer)
    trainer.repair(look=True)
    frozen = rows_of(outside(start_model()))
    assert trainer.parameters.count == len(start_model()) - 1
    assert set(frozen) - set(rows_of(trainer.gaussians())) == {frozen[3]}


def test_a_bundle_replays_with_the_region(
    scene: Scene, default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Gaussian outside has no gradient in the replay either: the one in it is the only one that fails."""
    trainer = trained_to(2, scene, FEW, default_device, initial=Start(start_model(), REGION))
    trainer.monitor.look()
    path = write_bundle(tmp_path, trainer, incident_of(trainer))
    bundle = read_bundle(path)
    assert bundle.region is not None
    assert bundle.region.numbers == REGION.numbers
    given: list[object] = []
    from clsplat.training.step import gradient_step

    real = gradient_step.project_grad
    monkeypatch.setattr(
        gradient_step, "project_grad", lambda *a, region, **k: (given.append(region), real(*a, region=region, **k))
    )
    replay(bundle, default_device)
    assert given == [bundle.region]


def incident_of(trainer: Trainer) -> Incident:
    last = trainer.monitor.last
    assert last is not None
    return Incident(
        step=last.step, view=last.view, name=last.name, stage="adam", count=1, done="", background=last.background,
        gaussians={},
    )  # fmt: skip
