# SPDX-License-Identifier: Apache-2.0
"""The loss terms that a training's settings ask for: a new term is a row of `LOSS_TERMS`."""

from __future__ import annotations

from collections.abc import Callable

from clsplat.config.training import TrainConfig
from clsplat.stages.loss_terms import AlphaTerm, LossTerm
from clsplat.training.step.inputs import ViewInputs


def alpha_term(config: TrainConfig, inputs: ViewInputs) -> LossTerm | None:
    """The alpha loss, for photographs with alpha, or with masks if masks mean transparency."""
    wanted = config.alpha_loss > 0 and inputs.photograph.shape[2] > 3
    return AlphaTerm(config.alpha_loss) if wanted else None


def depth_term(config: TrainConfig, inputs: ViewInputs) -> LossTerm | None:  # noqa: ARG001
    """The depth loss, for views with known depths."""
    return inputs.depth


LOSS_TERMS: tuple[Callable[[TrainConfig, ViewInputs], LossTerm | None], ...] = (alpha_term, depth_term)
"""Terms in addition to L1 and D-SSIM, in the order of their gradients' planes."""


def loss_terms(config: TrainConfig, inputs: ViewInputs) -> tuple[LossTerm, ...]:
    """The terms of a view's loss."""
    return tuple(term for make in LOSS_TERMS if (term := make(config, inputs)) is not None)
