# SPDX-License-Identifier: Apache-2.0
"""The policy of density control against expectations written by hand: extent 10, so that 0.1 is small and 1 is big."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from marking import TwinMarker, on_host
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from clsplat.config.training import DensityConfig
from clsplat.stages.device_gaussians import HostArray
from clsplat.training.density import ModelState, RowPlan
from clsplat.training.density.adaptive import is_due, is_reset_due, plan, reset_opacities, split_halves

CONFIG = DensityConfig()
EXTENT = 10.0
WEAK, STRONG = 1e-4, 3e-4
"""Mean gradients on either side of the threshold."""


def logit(opacity: ArrayLike) -> np.ndarray:
    p = np.asarray(opacity, np.float64)
    return np.log(p / (1 - p)).astype(np.float32)


def state(step: int, extent: float, parameters: dict[str, np.ndarray], statistics: dict[str, np.ndarray]) -> ModelState:
    """A model whose arrays are on the host."""
    arrays = ({name: HostArray(values) for name, values in held.items()} for held in (parameters, statistics))
    marker = TwinMarker(parameters, statistics)
    return ModelState(
        len(parameters["opacity_logits"]), step, extent, extent, *arrays, np.random.default_rng(0), marker
    )


def make_plan(
    gradients: ArrayLike,
    sizes: ArrayLike,
    *,
    config: DensityConfig = CONFIG,
    step: int = 600,
    seen: ArrayLike = 4,
    radii: ArrayLike = 5,
    opacities: ArrayLike = 0.5,
    known: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> RowPlan:
    """sizes: the largest axis of each; the others are a tenth of it. known: further statistics."""
    largest = np.asarray(sizes, np.float32)
    n = len(largest)
    views = np.broadcast_to(np.asarray(seen, np.float32), n)
    log_scales = np.log(np.stack([0.1 * largest, largest, 0.1 * largest], axis=1))
    statistics = {
        "gradient_sums": (np.asarray(gradients) * views).astype(np.float32),
        "seen": views,
        "radii": np.broadcast_to(np.asarray(radii, np.float32), n),
        **known,
    }
    parameters = {"log_scales": log_scales, "opacity_logits": np.broadcast_to(logit(opacities), n)}
    parameters |= {"means": np.zeros((n, 3), np.float32), "quaternions": np.ones((n, 4), np.float32)}
    return on_host(plan(config, state(step, EXTENT, parameters, statistics)), parameters)


def split_of(made: RowPlan) -> np.ndarray:
    """True for rows that are halves: they get other means and sizes."""
    assert made.rows is not None
    halves, _ = made.values.get("means", (np.zeros(0, int), None))
    if len(halves):
        np.testing.assert_array_equal(made.values["log_scales"][0], halves)
    return np.isin(np.arange(len(made.rows)), halves)


def assert_plan(got: RowPlan, rows: list[int], fresh: list[int], split: list[int]) -> None:
    """fresh, split: 0 or 1 for each of the rows."""
    assert got.rows.dtype == np.uint32
    assert (got.rows.tolist(), got.fresh.astype(int).tolist(), split_of(got).astype(int).tolist()) == (
        rows,
        fresh,
        split,
    )


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    # 0.01 of the extent, 0.1, divides them: the largest axis counts
    got = make_plan([STRONG, WEAK, STRONG, STRONG], [0.09, 0.09, 0.11, 0.02])
    # kept in order, then the clones, then both halves of the one that is split, which itself goes
    assert_plan(got, [0, 1, 3, 0, 3, 2, 2], [0, 0, 0, 1, 1, 1, 1], [0, 0, 0, 0, 0, 1, 1])


def test_weak_gradients_change_nothing() -> None:
    assert_plan(make_plan([WEAK, 0, WEAK], [0.09, 5, 0.5]), [0, 1, 2], [0, 0, 0], [0, 0, 0])


def test_the_gradient_is_the_mean_over_the_views_that_saw_it() -> None:
    # the same sum seen once and seen often; never seen: 0 / 0 is no gradient
    got = make_plan([STRONG, STRONG / 2, STRONG], [0.05, 0.05, 0.05], seen=[1, 2, 0])
    assert_plan(got, [0, 1, 2, 0], [0, 0, 0, 1], [0, 0, 0, 0])


def test_transparent_ones_are_pruned_with_their_clones_and_halves() -> None:
    got = make_plan([WEAK, STRONG, STRONG, WEAK], [0.05, 0.05, 0.5, 0.05], opacities=[0.0049, 0.0049, 0.0049, 0.0051])
    assert_plan(got, [3], [0], [0])


def test_oversized_ones_are_pruned_only_after_the_first_reset() -> None:
    sizes = [0.9, 1.1, 1.7]  # 0.1 of the extent is 1
    assert_plan(make_plan([WEAK] * 3, sizes, step=3000), [0, 1, 2], [0] * 3, [0] * 3)
    assert_plan(make_plan([WEAK] * 3, sizes, step=3100), [0], [0], [0])
    # a half has shrunk by 1.6 before it is looked at: 1.1 to 0.69, 1.7 to 1.06
    assert_plan(make_plan([STRONG] * 3, sizes, step=3100), [0, 1, 0, 1], [1] * 4, [1] * 4)
    never = replace(CONFIG, opacity_reset_every=0)
    assert_plan(make_plan([WEAK] * 3, sizes, step=9000, config=never), [0, 1, 2], [0] * 3, [0] * 3)


def test_the_screen_radius_prunes_only_if_asked_for() -> None:
    radii = [19, 21, 500]
    assert_plan(make_plan([WEAK] * 3, [0.05] * 3, step=3100, radii=radii), [0, 1, 2], [0] * 3, [0] * 3)
    config = replace(CONFIG, max_screen_radius=20.0)
    assert_plan(make_plan([WEAK] * 3, [0.05] * 3, step=3000, radii=radii, config=config), [0, 1, 2], [0] * 3, [0] * 3)
    # as with the authors, what is new has not been seen large on any screen yet
    got = make_plan([WEAK, WEAK, STRONG], [0.05] * 3, step=3100, radii=radii, config=config)
    assert_plan(got, [0, 2], [0, 1], [0, 0])


@pytest.mark.parametrize(
    ("room", "densified"), [(9, [0, 1, 2, 3]), (4, [0, 1, 2, 3]), (3, [0, 2, 3]), (1, [3]), (0, []), (-2, [])]
)
def test_the_cap_leaves_the_strongest(room: int, densified: list[int]) -> None:
    gradients = [5e-4, 3e-4, 4e-4, 9e-4, WEAK]
    sizes = np.array([0.05, 0.5, 0.05, 0.5, 0.05])
    got = make_plan(gradients, sizes, config=replace(CONFIG, max_gaussians=5 + room))
    assert len(got.rows) == 5 + len(densified)
    assert sorted(set(got.rows[got.fresh].tolist())) == densified


def test_when_it_is_due() -> None:
    due = [step for step in range(20_001) if is_due(CONFIG, step)]
    # the authors' loop: after 500 up to before 15,000, every 100
    assert due == list(range(600, 15_000, 100))
    assert not any(is_due(replace(CONFIG, every=0), step) for step in range(2000))


def test_when_opacities_are_reset() -> None:
    resets = [3000, 6000, 9000, 12_000]
    assert [step for step in range(1, 20_001) if is_reset_due(CONFIG, step, white=False)] == resets
    assert [step for step in range(1, 20_001) if is_reset_due(CONFIG, step, white=True)] == [500, *resets]
    assert not any(is_reset_due(replace(CONFIG, every=0), step, white=True) for step in range(20_001))
    assert not any(is_reset_due(replace(CONFIG, opacity_reset_every=0), step, white=False) for step in range(20_001))


def test_a_reset_lowers_and_never_raises() -> None:
    got = reset_opacities(CONFIG, logit([0.004, 0.0099, 0.011, 0.5, 0.999]))
    np.testing.assert_allclose(1 / (1 + np.exp(-got)), [0.004, 0.0099, 0.01, 0.01, 0.01], rtol=1e-6)
    assert got.dtype == np.float32


def test_halves_are_smaller_by_the_factor_and_drawn_from_their_gaussian() -> None:
    """Their mean and covariance are those of the Gaussian that was split, within what chance allows."""
    count, q, scales = 40_000, np.array([2.0, 0.6, -0.9, 1.4]), np.array([0.5, 0.1, 0.02])  # raw: its length is 2.7
    centre = np.array([3.0, -2.0, 1.0])
    rows = {"means": centre, "quaternions": q, "log_scales": np.log(scales)}
    split = {group: np.tile(row, (count, 1)).astype(np.float32) for group, row in rows.items()}
    means, log_scales = split_halves(CONFIG, split, np.random.default_rng(0))
    assert means.dtype == log_scales.dtype == np.float32
    np.testing.assert_allclose(np.exp(log_scales[7]), scales / 1.6, rtol=1e-6)
    rotation = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    along = (means - centre) @ rotation  # in the Gaussian's own axes
    # 4 standard errors: sigma / sqrt(n) of a mean, 1 / sqrt(2 n) relative of a deviation
    assert np.all(np.abs(along.mean(axis=0)) < 4 * scales / np.sqrt(count))
    np.testing.assert_allclose(along.std(axis=0), scales, rtol=4 / np.sqrt(2 * count))
    correlations = np.corrcoef(along.T)[np.triu_indices(3, 1)]
    assert np.all(np.abs(correlations) < 4 / np.sqrt(count))


def test_the_same_seed_gives_the_same_halves() -> None:
    values = {
        "means": np.zeros((3, 3), np.float32),
        "quaternions": np.ones((3, 4), np.float32),
        "log_scales": np.zeros((3, 3), np.float32),
    }
    first, again = (split_halves(CONFIG, values, np.random.default_rng(5))[0] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first, axis=0)) == 3, "two halves are drawn apart"


def test_splitting_a_zero_quaternion_gives_finite_halves() -> None:
    split = {
        "means": np.ones((4, 3), np.float32),
        "quaternions": np.array([[0, 0, 0, 0], [1e-42, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1e-20]], np.float32),
        "log_scales": np.zeros((4, 3), np.float32),
    }
    means, log_scales = split_halves(CONFIG, split, np.random.default_rng(0))
    assert np.isfinite(means).all()
    assert np.isfinite(log_scales).all()
