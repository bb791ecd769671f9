# SPDX-License-Identifier: Apache-2.0
"""Density control by contribution and budget in training: it happens when it is due, it repeats to the last byte
wherever training was stopped, and in pieces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import noted, warnings_of
from compare import assert_close, assert_same_bits
from same_bytes import model_bytes
from scenes import random_cloud
from test_trainer import host
from tiny import run_steps, short, trained_to

from clsplat.api import train
from clsplat.device.buffers import DeviceArray
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.optimisation.density_rules import FRESH
from clsplat.reference.render import render_grad
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene
from clsplat.stages.density import CONTRIBUTION_STATISTICS, DeviceRowList
from clsplat.training.density import ModelState, RowPlan, adaptive
from clsplat.training.trainer import Trainer

CONFIG = short(
    iterations=48, density={"min_contribution": 2.0, "prune_every": 6, "growth": "budget", "max_gaussians": 120}
)
"""All that goes beyond the paper, and steps of nothing but pruning before and after `stop`."""


@pytest.mark.parametrize(("growth", "most"), [("paper", 60), ("paper", 10_000), ("paper", 40), ("budget", 60)])
def test_a_limit_that_held_the_growth_is_told_of(scene: Scene, default_device: Device, growth: str, most: int) -> None:
    """Once, at the end, and not where the training began with as many: 40 points."""
    keeps = {"min_opacity": 1e-6, "opacity_reset_every": 0, "max_world_fraction": 10.0}
    config = short(
        iterations=120, density={"growth": growth, "max_gaussians": most, "gradient_threshold": 1e-6} | keeps
    )
    told = warnings_of(lambda: train(scene, config, device=default_device))
    held = [text for text in told if "has limited the growth" in text]
    assert len(held) == (growth == "paper" and most == 60)
    assert all(text.startswith("--density.max-gaussians 60 has limited the growth: --density.growth") for text in held)


def test_everything_happens(scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the tests below stop and repeat."""
    made: dict[tuple[str, int], tuple[int, np.ndarray]] = {}
    known: list[int] = []

    def noted(name: str) -> Any:
        real = getattr(adaptive, name)

        def call(config: Any, model: ModelState, **options: bool) -> RowPlan:
            result: RowPlan = real(config, model, **options)
            entries = result.listed.rows.get() if isinstance(result.listed, DeviceRowList) else np.zeros(0, np.uint32)
            made[name, model.step] = (model.count, entries)
            largest = [model.statistics[f"{epoch}_largest"].get() for epoch in ("current", "whole")]
            known.append(int(np.isfinite(np.maximum(*largest)).sum()))
            return result

        return call

    monkeypatch.setattr(adaptive, "plan", noted("plan"))
    monkeypatch.setattr(adaptive, "plan_pruning", noted("plan_pruning"))
    trained_to(CONFIG.iterations, scene, CONFIG, default_device)
    assert [step for name, step in made if name == "plan"] == [15, 20, 25, 30, 35]
    assert [step for name, step in made if name == "plan_pruning"] == [12, 18, 24, 36, 42]
    pruned = {step: count - len(rows) for (name, step), (count, rows) in made.items() if name == "plan_pruning"}
    assert pruned[42] > 0
    assert any((rows >= FRESH).any() for _, rows in made.values())
    assert 0 in known, "right after the reset"
    assert max(known) > 40


def test_a_pruning_alone_keeps_what_is_not_of_epochs(scene: Scene, default_device: Device) -> None:
    config = short(
        density={"prune_every": 26, "min_contribution": 20.0, "every": 99, "start": 5, "opacity_reset_every": 0}
    )
    trainer = trained_to(26, scene, config, default_device)
    before = {name: array.get() for name, array in trainer.statistics.named().items()}
    models = {kind: host(model) for kind, model in trainer.model.kinds().items()}
    gone = np.maximum(before["current_largest"], before["whole_largest"]) < 20.0
    assert 0 < gone.sum() < len(gone)
    trainer._control_density()
    for name, array in trainer.statistics.named().items():
        assert_same_bits(array.get(), before[name][~gone], name)
    for kind, values in models.items():
        after = host(trainer.model.kinds()[kind])
        for group in PARAMETER_GROUPS:
            assert_same_bits(after[group], values[group][~gone], f"{kind} {group}")


def test_contributions_are_those_of_an_epoch(scene: Scene, default_device: Device) -> None:
    """With rates of zero every view sees the same model: an epoch's totals are those of the float64 twin, and views at
    a quarter of the size count as much as whole ones."""
    still = dict.fromkeys(("means_rate", "means_rate_end", "sh_dc_rate", "sh_rest_rate", "opacities_rate"), 0.0)
    base = short(density={"every": 1000, "min_contribution": 1.0})
    optimiser = replace(base.optimiser, **still, scales_rate=0.0, quaternions_rate=0.0)
    config = replace(base, optimiser=optimiser, warmup=())
    trainer = Trainer(scene, config, default_device)
    model, views = trainer.gaussians(), scene.train_views
    run_steps(len(views) + 1, trainer)
    nothing = np.zeros((views[0].camera.height, views[0].camera.width, 3))
    each = np.array([render_grad(model, view.camera, nothing).contributions for view in views])
    assert trainer.statistics.whole_totals is not None
    # 4/255 a view, as of the stage itself
    assert_close(trainer.statistics.whole_totals.get(), each.sum(axis=0), relative=1e-4, absolute=len(views) * 4 / 255)
    assert_close(trainer.statistics.whole_largest.get(), each.max(axis=0), relative=1e-4, absolute=4 / 255)
    coarse = Trainer(scene, replace(config, warmup=(99,)), default_device)
    run_steps(len(views) + 1, coarse)
    assert coarse.statistics.whole_totals is not None
    # half the pixels a side: the low-pass of 0.3 square pixels weighs four times as much, which makes small ones larger
    ratio = coarse.statistics.whole_totals.get().sum() / each.sum()
    assert ratio == pytest.approx(1.0, abs=0.1)


def test_a_reset_forgets_contributions(scene: Scene, default_device: Device) -> None:
    trainer = trained_to(20, scene, CONFIG, default_device)
    assert trainer.statistics.whole_totals is not None
    assert np.isfinite(trainer.statistics.whole_totals.get()).any()
    trainer._control_density()
    for name in CONTRIBUTION_STATISTICS:
        assert np.isinf(trainer.statistics.named()[name].get()).all()


@pytest.mark.parametrize(
    ("changes", "most"),
    [({}, 0), ({"max_gaussians": 2300}, 4), ({"opacity_reset_every": 5}, 8)],
    ids=["paper", "short of room", "with a reset"],
)
def test_what_crosses_the_bus(
    changes: dict[str, Any], most: int, scene: Scene, default_device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a model that is on the device a column of scores where room is short, and of a reset the opacities; 88 bytes
    of each Gaussian that is split, and a few numbers. NumPy on the host had 139 bytes a Gaussian."""
    count, rng = 2000, np.random.default_rng(3)
    density = {"start": 1, "every": 5, "stop": 40, "gradient_threshold": 2e-4, "opacity_reset_every": 0, **changes}
    trainer = Trainer(scene, short(density=density), default_device, random_cloud(count, 3, 60, 40)[0])
    needs = trainer.strategy.needs()
    assert needs.gradients
    trainer.statistics.gradient_sums.set(rng.uniform(0, 2.5e-4, count).astype(np.float32))
    trainer.statistics.seen.fill(1.0)
    scales = trainer.parameters["log_scales"]
    scales.set(np.where(np.arange(count)[:, None] % 9 == 0, np.float32(3), np.float32(-9)) + 0 * scales.get())
    trainer.position.step = 5
    moved = []

    def note(array: DeviceArray, name: str, event: Any, nbytes: int | None = None) -> None:
        moved.append(0 if name == "fill" else array.nbytes if nbytes is None else nbytes)

    noted(monkeypatch, DeviceArray, "_note", note)
    plan = trainer.strategy.before_step(trainer._state())
    assert plan.listed is not None
    halves = plan.listed.halves
    trainer._rearrange(plan)
    assert halves > 0
    assert trainer.parameters.count > count
    assert sum(moved) <= most * trainer.parameters.count + 88 * (halves // 2) + 64


def test_settings_that_come_with_resume(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """The checkpoint has no contributions: nothing is known until an epoch is over, and nothing is pruned by it."""
    plain = short(iterations=14)
    model_bytes(scene, plain, default_device, tmp_path / "run")
    run = Run.create(tmp_path / "run", CONFIG, resume=True)
    checkpoint = run.load_latest_checkpoint()
    assert checkpoint is not None
    trainer = Trainer(scene, CONFIG, default_device)
    trainer.restore(checkpoint)
    assert trainer.statistics.whole_largest is not None
    assert np.isinf(trainer.statistics.whole_largest.get()).all()
    assert trainer.statistics.seen.get().any(), "what it has is taken"
    train(scene, CONFIG, device=default_device, run=run, resume=True)
    assert run.model_path.exists()


def test_the_budget_is_reached(scene: Scene, default_device: Device) -> None:
    counts: list[int] = []
    config = short(density={"growth": "budget", "max_gaussians": 150, "min_opacity": 1e-6, "max_world_fraction": 1e9})
    train(scene, config, device=default_device, on_step=lambda report: counts.append(report.gaussians))
    assert counts[-1] == 150, "nothing is pruned, and the last densification reaches it"
    assert len(scene.points) < counts[1] < 150
