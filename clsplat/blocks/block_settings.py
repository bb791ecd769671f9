# SPDX-License-Identifier: Apache-2.0
"""Settings of a block's training, and of the finish: the schedule of the whole, from where the coarse model left it."""

from __future__ import annotations

from dataclasses import fields, replace
from math import sqrt

from clsplat.blocks.plan import Block, BlockPlan
from clsplat.config.colour_models import appearance_rate_of_part
from clsplat.config.depth import DEPTH_WEIGHT_END_FRACTION
from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.training.learning_rates import means_rate_at

FINISH_APPEARANCE_RATE = 0.3
"""Learning rate of appearance in the finish, as a fraction of that in a training of the whole. The finish begins with
appearances that need small corrections only."""
FINISH_COOLDOWN_TO = 0.2
"""Fraction of every learning rate that is left at the end of the finish."""


def block_settings(plan: BlockPlan, block: Block, coarse: TrainConfig, surroundings: int) -> TrainConfig:
    """Return the settings of a block's training: the rest of the whole's schedule after the coarse model's steps.

    coarse: settings of the coarse model.
    surroundings: number of Gaussians outside the widened cell, which are drawn and stay as they are.

    Steps of the schedule are scaled by the block's fraction of the photographs, so that a densification sees the same
    fraction of them as in a training of the whole. The sky's block has as many densifications in a quarter of the
    passes, so each of them sees fewer. The SH degree is full from the start, photographs have their full
    size, and opacities are not reset, since the Gaussians have been trained already. Without resets there is no pruning
    by size either.
    """
    whole, density, optimiser = plan.settings, plan.settings.density, plan.settings.optimiser
    passed = coarse.iterations
    scale = block.iterations / max(whole.iterations - passed, 1)

    def left(step: int) -> int:
        return max(round((step - passed) * scale), 0)

    def scaled(steps: int) -> int:
        return max(round(steps * scale), 1) if steps else 0

    inside = max(round(block.gaussians / plan.gaussians * density.max_gaussians), block.gaussians)
    return replace(
        _without_events(whole, photographs=plan.photographs),
        iterations=block.iterations,
        eval_at=(),
        report=False,
        appearance_rate=appearance_rate_of_part(
            whole.appearance_rate, whole.appearance, whole.iterations, block.iterations
        ),
        depth_weight=whole.depth_weight * DEPTH_WEIGHT_END_FRACTION ** (passed / whole.iterations),
        optimiser=replace(
            _for_fewer_photographs(optimiser, plan.photographs / len(block.photographs)),
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
            max_gaussians=surroundings + inside,
        ),
    )


def finish_settings(plan: BlockPlan, steps: int) -> TrainConfig:
    """Return the settings of the finish: `steps` steps on the merged model, with the schedule's final rate of means.

    No Gaussians are added or removed. Held-out views are evaluated once, at the end. All learning rates fall to
    FINISH_COOLDOWN_TO times their value.
    """
    whole = plan.settings
    return replace(
        _without_events(whole, photographs=plan.photographs),
        iterations=steps,
        eval_at=(),
        appearance_rate=FINISH_APPEARANCE_RATE
        * appearance_rate_of_part(whole.appearance_rate, whole.appearance, whole.iterations, steps),
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


def _for_fewer_photographs(optimiser: OptimiserConfig, times: float) -> OptimiserConfig:
    """Return Adam's settings for a block, where a larger fraction of the photographs shows a Gaussian.

    times: the scene's number of photographs divided by the block's.

    In a training of the whole, a Gaussian has zero gradients in all steps that do not show it. These zeros divide
    Adam's second moment by about `times`. A view that shows the Gaussian then changes it more, by the root of `times`.
    A block has few zeros, so its learning rates are multiplied by the root. Moments decay as much in a pass as in the
    whole. With sparse Adam there are no zeros in either training, so nothing changes.
    """
    if optimiser.sparse:
        return optimiser
    rates = [field.name for field in fields(optimiser) if field.name.endswith(("_rate", "_rate_end"))]
    changes = {name: getattr(optimiser, name) * sqrt(times) for name in rates}
    return replace(optimiser, **changes, beta1=optimiser.beta1**times, beta2=optimiser.beta2**times)


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
