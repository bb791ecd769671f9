# SPDX-License-Identifier: Apache-2.0
"""Settings of a block's training, and of the finish: the schedule of the whole, from where the coarse model left it."""

from __future__ import annotations

from dataclasses import replace

from clsplat.blocks.plan import Block, BlockPlan
from clsplat.config.depth import DEPTH_WEIGHT_END_FRACTION
from clsplat.config.training import TrainConfig
from clsplat.training.learning_rates import means_rate_at

FINISH_APPEARANCE_RATE = 0.1
"""Learning rate of appearance in the finish, as a fraction of the setting. The finish begins with appearances that
need small corrections only."""
FINISH_COOLDOWN_TO = 0.1
"""Fraction of every learning rate that is left at the end of the finish."""


def block_settings(plan: BlockPlan, block: Block, coarse: TrainConfig, gaussians: int) -> TrainConfig:
    """Return the settings of a block's training: what remains of the whole's schedule after the coarse model's steps.

    coarse: settings of the coarse model.
    gaussians: number of Gaussians of the coarse model.

    Numbers of steps are scaled like the number of steps, so that a densification sees the same fraction of the
    photographs as in a training of the whole. The SH degree is full from the start, photographs have their full size,
    and opacities are not reset, since the Gaussians have been trained already.
    """
    whole, density, optimiser = plan.settings, plan.settings.density, plan.settings.optimiser
    passed = coarse.iterations
    scale = block.iterations / max(whole.iterations - passed, 1)

    def left(step: int) -> int:
        return max(round((step - passed) * scale), 0)

    def scaled(steps: int) -> int:
        return max(round(steps * scale), 1) if steps else 0

    inside = block.gaussians / max(gaussians, 1)
    return replace(
        _without_events(whole, photographs=photographs_of(plan)),
        iterations=block.iterations,
        eval_at=(),
        report=False,
        depth_weight=whole.depth_weight * DEPTH_WEIGHT_END_FRACTION ** (passed / whole.iterations),
        optimiser=replace(
            optimiser,
            means_rate=means_rate_at(whole, passed),
            means_rate_steps=max(left(optimiser.means_rate_steps), 1),
            cooldown=scaled(optimiser.cooldown),
        ),
        density=replace(
            density,
            every=scaled(density.every),
            start=left(density.start),
            stop=left(density.stop),
            opacity_reset_every=0,
            prune_every=scaled(density.prune_every),
            max_gaussians=gaussians - block.gaussians + max(round(inside * density.max_gaussians), block.gaussians),
        ),
    )


def finish_settings(plan: BlockPlan, steps: int) -> TrainConfig:
    """Return the settings of the finish: `steps` steps on the merged model, with the schedule's final rate of means.

    No Gaussians are added or removed. All learning rates fall to FINISH_COOLDOWN_TO times their value.
    """
    whole = plan.settings
    return replace(
        _without_events(whole, photographs=photographs_of(plan)),
        iterations=steps,
        eval_at=tuple(step for step in whole.eval_at if step <= steps),
        appearance_rate=whole.appearance_rate * FINISH_APPEARANCE_RATE,
        depth_weight=whole.depth_weight * DEPTH_WEIGHT_END_FRACTION,
        optimiser=replace(
            whole.optimiser,
            means_rate=means_rate_at(whole, whole.iterations),
            means_rate_end=means_rate_at(whole, whole.iterations),
            cooldown=steps,
            cooldown_to=FINISH_COOLDOWN_TO,
        ),
        density=replace(whole.density, every=0, prune_every=0, opacity_reset_every=0, growth="paper"),
    )


def photographs_of(plan: BlockPlan) -> int:
    """Number of photographs that belong to a block."""
    return len({name for block in plan.blocks for name in block.photographs})


def _without_events(whole: TrainConfig, *, photographs: int) -> TrainConfig:
    """Return the settings of a training that begins with trained Gaussians, and with cameras that stay as they are.

    photographs: number of photographs, which decides if they are rounded to 8 bits.
    """
    return replace(
        whole,
        sh_degree_every=1,
        warmup=(),
        photos="8bit" if whole.rounds_photos(photographs) else "exact",
        refine_poses=False,
        refine_lenses=False,
    )
