# SPDX-License-Identifier: Apache-2.0
"""Plans of density control on the host, for tests: made by the twin, or copied from a device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.optimisation.density_rules import FRESH, MarkRules
from clsplat.reference import density as twin
from clsplat.training.density import RowPlan


@dataclass(frozen=True, eq=False)
class TwinRows:
    """A list of rows on the host, as the twin makes it."""

    rows: NDArray[np.uint32]
    halves: int

    @property
    def count(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class TwinMarker:
    """A marker that uses the NumPy twin. Missing statistics count as 0, so that they exceed no edge."""

    parameters: Mapping[str, NDArray[Any]]
    statistics: Mapping[str, NDArray[Any]]

    def _known(self) -> dict[str, NDArray[Any]]:
        count = len(self.parameters["opacity_logits"])
        zeros = {name: np.zeros(count, np.float32) for name in ("gradient_sums", "seen", "radii")}
        return {**zeros, **self.statistics}

    def _means(self) -> NDArray[np.float32]:
        return self.parameters.get("means", np.zeros((len(self.parameters["opacity_logits"]), 3), np.float32))

    def scores(self, rules: MarkRules) -> NDArray[np.float32]:
        return twin.scores(rules, self._known(), self._means())

    def rows(self, rules: MarkRules) -> TwinRows:
        logits = self.parameters["opacity_logits"]
        log_scales = self.parameters.get("log_scales", np.zeros((len(logits), 3), np.float32))
        return TwinRows(*twin.rows(rules, self._known(), self._means(), log_scales, logits))


def on_host(plan: RowPlan, parameters: Mapping[str, NDArray[Any]]) -> RowPlan:
    """The plan with NumPy arrays: rows, fresh rows, and the values of the halves, which are drawn here.

    parameters: the model's parameters before the plan.
    """
    listed: Any = plan.listed
    entries = listed.rows if isinstance(listed, TwinRows) else listed.rows.get()
    rows, values = entries & ~FRESH, dict(plan.values)
    if listed.halves and plan.halves is not None:
        split = rows[len(rows) - listed.halves // 2 :]
        halves = np.arange(len(rows) - listed.halves, len(rows))
        of_split = {name: parameters[name][split] for name in plan.halved}
        first, second = (plan.halves(of_split, later) for later in (False, True))
        values |= {name: (halves, np.concatenate([found, second[name]])) for name, found in first.items()}
    return replace(plan, rows=rows, fresh=entries >= FRESH, values=values, listed=None)
