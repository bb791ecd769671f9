# SPDX-License-Identifier: Apache-2.0
"""Loss terms beyond L1 and D-SSIM, as the settings ask for them: the alpha loss and the depth loss."""

from __future__ import annotations

from collections.abc import Callable

from clsplat.config.training import TrainConfig
from clsplat.stages.loss_terms import AlphaTerm, LossTerm
from clsplat.training.step.inputs import ViewInputs


def alpha_term(config: TrainConfig, inputs: ViewInputs) -> LossTerm | None:
    """Return the alpha loss; None if the settings ask for none, or if the photograph has neither alpha nor a mask."""
    wanted = config.alpha_loss > 0 and inputs.photograph.shape[2] > 3
    return AlphaTerm(config.alpha_loss) if wanted else None


def depth_term(config: TrainConfig, inputs: ViewInputs) -> LossTerm | None:  # noqa: ARG001
    """Return the depth loss of the view; None if the settings ask for no depths."""
    return inputs.depth


LOSS_TERMS: tuple[Callable[[TrainConfig, ViewInputs], LossTerm | None], ...] = (alpha_term, depth_term)
"""Functions that return a term of a view's loss in addition to L1 and D-SSIM, or None if it is not wanted."""


def loss_terms(config: TrainConfig, inputs: ViewInputs) -> tuple[LossTerm, ...]:
    """Terms of a view's loss in addition to L1 and D-SSIM."""
    return tuple(term for make in LOSS_TERMS if (term := make(config, inputs)) is not None)
