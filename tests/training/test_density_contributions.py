# SPDX-License-Identifier: Apache-2.0
"""The policy beyond the paper: growth by a budget, pruning by contribution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from marking import on_host
from numpy.typing import ArrayLike
from test_density import CONFIG, STRONG, WEAK, state
from test_density import make_plan as plan_of

from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.density import RowPlan, StatisticsNeeds
from clsplat.training.density.adaptive import Adaptive, budget, is_due, is_pruning_due, plan_pruning

GROWING = replace(CONFIG, growth="budget", max_gaussians=9000, start=500, stop=2500)


def contributions(totals: ArrayLike, largest: ArrayLike | None = None) -> dict[str, np.ndarray]:
    """Statistics of the last whole epoch; `largest` are of the one under way."""
    values = np.asarray(totals, np.float32)
    largest = values if largest is None else np.asarray(largest, np.float32)
    return {"whole_totals": values, "whole_largest": np.minimum(values, largest), "current_largest": largest}


def make_plan(gradients: Sequence[float], config: DensityConfig = CONFIG, **how: Any) -> RowPlan:
    """All small, so that who is densified is cloned, and seen in four views."""
    return plan_of(gradients, np.full(len(gradients), 0.05), config=config, **how)


def cloned(made: RowPlan) -> list[int]:
    rows: list[int] = made.rows[made.fresh].tolist()
    return rows


def kept(made: RowPlan) -> list[int]:
    rows: list[int] = made.rows[~made.fresh].tolist()
    return rows


# Growth


def steps_of(config: DensityConfig) -> list[int]:
    return [step for step in range(config.stop + 1) if is_due(config, step)]


@pytest.mark.parametrize(
    ("every", "start", "stop"), [(100, 500, 2500), (100, 500, 2501), (70, 333, 1999), (500, 0, 600)]
)
def test_the_number_follows_the_parabola(every: int, start: int, stop: int) -> None:
    """Taming 3DGS's A(x), in its own form, where the passes are evenly spaced; and its ends in any case."""
    config = replace(GROWING, every=every, start=start, stop=stop)
    steps, first, last = steps_of(config), 1000, config.max_gaussians
    counts = [first]
    for step in steps:
        counts.append(budget(config, step, counts[-1]))
    assert counts[-1] == last, "the last densification reaches the budget"
    assert sorted(counts) == counts
    span = steps[-1] - start
    slope = 2 * (last - first) / span
    x = np.array([start, *steps]) - start
    wanted = (last - first - slope * span) / span**2 * x**2 + slope * x + first
    # whole Gaussians: half a one is rounded at each pass, and less is left of that at the next
    np.testing.assert_allclose(counts, wanted, atol=1.0 * len(steps) ** 0.5)


def test_what_was_pruned_is_made_up_for() -> None:
    config, count = GROWING, 1000
    for step in steps_of(config):
        count = budget(config, step, count)
        if step == 1200:
            count //= 2
    assert count == config.max_gaussians


def test_a_budget_that_is_exceeded_adds_nothing() -> None:
    config = replace(GROWING, max_gaussians=4)
    assert cloned(make_plan([STRONG] * 6, config, step=2400)) == []


def test_the_strongest_go_first_whatever_the_threshold() -> None:
    config = replace(GROWING, max_gaussians=9, start=500, stop=601)  # one densification, with room for four
    gradients = [WEAK, STRONG, 0, WEAK / 2, 2 * STRONG]
    assert cloned(make_plan(gradients, config)) == [0, 1, 3, 4], "no gradient, no clone"
    assert cloned(make_plan(gradients, replace(config, max_gaussians=8))) == [0, 1, 4]
    assert cloned(make_plan(gradients, replace(config, max_gaussians=6))) == [4]
    useless = contributions([9, 9, 9, 9, 0.1])
    made = make_plan(gradients, replace(config, max_gaussians=6, min_contribution=1.0), known=useless)
    assert (kept(made), cloned(made)) == ([0, 1, 2, 3], [1])


# Contribution


def test_what_no_view_needs_goes() -> None:
    known = contributions([0, 3, 9, np.inf, 9], [0, 0.49, 0.5, np.inf, 0.1])
    config = replace(CONFIG, min_contribution=0.5)
    made = make_plan([WEAK, WEAK, WEAK, WEAK, STRONG], config, known=known)
    assert (kept(made), cloned(made)) == ([2, 3], []), "not known is kept; what goes is not cloned"
    made = make_plan([WEAK] * 5, CONFIG, known=known)
    assert kept(made) == [0, 1, 2, 3, 4], "only if asked for"


def test_pruning_alone_adds_nothing_and_asks_for_less() -> None:
    config = replace(CONFIG, min_contribution=0.5, prune_every=100)
    opacities = np.array([0.5, 0.004, 0.5, 0.5])
    logits = np.log(opacities / (1 - opacities)).astype(np.float32)
    known = {"opacity_logits": logits}
    made = on_host(plan_pruning(config, state(20_000, 10.0, known, contributions([9, 9, 0.4, 9]))), known)
    assert (made.rows.tolist(), made.fresh.any(), made.values) == ([0, 3], False, {})
    assert made.rows.dtype == np.uint32
    known = {"opacity_logits": np.zeros(3, np.float32)}
    made = on_host(plan_pruning(replace(config, min_contribution=0.0), state(20_000, 10.0, known, {})), known)
    assert made.rows.tolist() == [0, 1, 2]


def test_when_pruning_is_due() -> None:
    assert not any(is_pruning_due(CONFIG, step) for step in range(20_000))
    config = replace(CONFIG, prune_every=2000)
    due = [step for step in range(20_001) if is_pruning_due(config, step)]
    assert due == list(range(2000, 20_001, 2000))


def needs(config: DensityConfig, step: int = 0) -> StatisticsNeeds:
    return Adaptive(TrainConfig(density=config)).needs(step)


def test_contributions_are_gathered_only_while_something_goes_by_them() -> None:
    assert not needs(CONFIG).contributions
    assert not needs(replace(CONFIG, prune_every=100)).contributions, "that alone goes by opacity"

    def last(config: DensityConfig) -> int:
        wanted = [needs(config, step).contributions for step in range(20_001)]
        assert wanted == sorted(wanted, reverse=True), "from the first step on"
        return sum(wanted) - 1

    assert last(replace(CONFIG, min_contribution=1.0)) == CONFIG.stop - 1
    assert last(replace(CONFIG, min_contribution=1.0, every=0)) == -1, "no pass would read them"
    assert last(replace(CONFIG, min_contribution=1.0, every=0, prune_every=100)) == 20_000
