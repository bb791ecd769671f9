# SPDX-License-Identifier: Apache-2.0
"""The strategies of density control, by name."""

from __future__ import annotations

from collections.abc import Callable

from clsplat.config.training import TrainConfig
from clsplat.training.density import Strategy
from clsplat.training.density.adaptive import Adaptive

STRATEGIES: dict[str, Callable[[TrainConfig], Strategy]] = {"adaptive": Adaptive}
