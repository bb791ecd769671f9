# SPDX-License-Identifier: Apache-2.0
"""Settings of blocks and of the finish: what the coarse model leaves of the whole's schedule."""

from __future__ import annotations

from dataclasses import replace
from math import inf, sqrt
from pathlib import Path

import pytest

from clsplat.blocks.block_settings import block_settings, finish_settings
from clsplat.blocks.plan import Block, BlockPlan, Partition, Rectangle
from clsplat.config.presets import scheduled
from clsplat.config.training import TrainConfig

EVERYWHERE = Rectangle((-inf, -inf), (inf, inf))
WHOLE = replace(scheduled("short", 7000), warmup=(250, 500), eval_at=(100, 7000), refine_poses=True)
COARSE = replace(WHOLE, iterations=1000)


def plan_of(whole: TrainConfig, share: int = 100) -> BlockPlan:
    """A plan of a scene with 400 photographs and 9000 Gaussians, and one block with `share` photographs."""
    names = tuple(f"{index:03d}" for index in range(share))
    block = Block("0_0", EVERYWHERE, EVERYWHERE, names, (whole.iterations - 1000) * share // 400, 3000)
    return BlockPlan(
        scene=Path("/scene"),
        settings=whole,
        division=Partition("1"),
        up=(0, -1, 0),
        axes=((1, 0, 0), (0, 0, 1)),
        margin=0.2,
        share=0.02,
        coarse="c",
        extent=1.0,
        finish_steps=350,
        blocks=(block,),
        photographs=400,
        gaussians=9000,
    )


def settings(whole: TrainConfig = WHOLE, share: int = 100) -> TrainConfig:
    plan = plan_of(whole, share)
    found = block_settings(plan, plan.blocks[0], COARSE, surroundings=2000)
    found.check()
    return found


def test_a_block_goes_through_what_is_left_of_the_schedule() -> None:
    block = settings()
    assert block.iterations == 1500
    assert block.density.every == 25, "the same fraction of the photographs between densifications"
    assert block.density.start == 0, "the coarse model has passed it"
    assert block.density.stop == 1000, "(5000 - 1000) / 4"
    assert block.optimiser.means_rate_steps == 1500
    assert block.optimiser.cooldown == 250
    assert block.warmup == () and block.eval_at == ()
    assert block.density.opacity_reset_every == 0
    assert not block.refines


@pytest.mark.parametrize("share", [100, 400])
def test_rates_are_higher_by_the_root_of_the_photographs(share: int) -> None:
    was, now, times = WHOLE.optimiser, settings(share=share).optimiser, 400 / share
    for name in ("means_rate", "means_rate_end", "scales_rate", "sh_dc_rate", "sh_rest_rate", "opacities_rate"):
        assert getattr(now, name) == pytest.approx(getattr(was, name) * sqrt(times), rel=1e-12)
    assert (now.beta1, now.beta2) == (was.beta1**times, was.beta2**times)


def test_sparse_adam_has_the_rates_of_the_whole() -> None:
    sparse = replace(WHOLE, optimiser=replace(WHOLE.optimiser, sparse=True))
    found = settings(sparse).optimiser
    assert (found.means_rate, found.beta2) == (sparse.optimiser.means_rate, sparse.optimiser.beta2)


def test_a_block_has_its_share_of_the_gaussians() -> None:
    """A third of 12,000 inside, and 2000 frozen ones; never fewer inside than the coarse model has."""
    limited = replace(WHOLE, density=replace(WHOLE.density, max_gaussians=12_000))
    assert settings(limited).density.max_gaussians == 4000 + 2000
    few = replace(WHOLE, density=replace(WHOLE.density, max_gaussians=300))
    assert settings(few).density.max_gaussians == 3000 + 2000


@pytest.mark.parametrize(("photographs", "photos"), [(400, "8bit"), (200, "exact")])
def test_photographs_are_rounded_as_in_the_whole(photographs: int, photos: str) -> None:
    """The whole's number of photographs decides, not the block's."""
    plan = replace(plan_of(WHOLE), photographs=photographs)
    assert block_settings(plan, plan.blocks[0], COARSE, 0).photos == photos
    assert finish_settings(plan, 10).photos == photos


def test_the_finish_ends_with_small_rates_and_moves_no_rows() -> None:
    mcmc = replace(WHOLE, density=replace(WHOLE.density, growth="mcmc", max_gaussians=5000))
    found = finish_settings(plan_of(mcmc), 350)
    found.check()
    assert found.iterations == found.optimiser.cooldown == 350
    assert found.optimiser.means_rate == found.optimiser.means_rate_end == WHOLE.optimiser.means_rate_end
    assert (found.density.every, found.density.prune_every, found.density.growth) == (0, 0, "paper")
    assert found.eval_at == (), "the city is evaluated once, at the end"
    assert not found.refines
