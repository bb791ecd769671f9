# SPDX-License-Identifier: Apache-2.0
"""Bounds of chunks, and of the movements of their Gaussians by Adam."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from stress_culling import paths

from clsplat.chunks.bounds import ChunkBounds, hidden_path, largest_resumed_step, largest_step, rounded_share
from clsplat.config.training import OptimiserConfig
from clsplat.layouts.columns import CHUNK_ROWS

DEFAULT = OptimiserConfig()
BETAS = [(0.9, 0.999), (0.0, 0.9), (0.5, 0.5), (0.9, 0.95), (0.8, 0.9999), (0.9, 0.811), (0.95, 0.99999)]


@pytest.mark.parametrize("count", [1, CHUNK_ROWS, CHUNK_ROWS + 1, 3 * CHUNK_ROWS - 1])
def test_bounds_are_those_of_the_rows(count: int) -> None:
    means, log_scales = np.random.default_rng(count).standard_normal((2, count, 3)).astype(np.float32)
    bounds = ChunkBounds.measured(means, log_scales)
    assert len(bounds) == -(-count // CHUNK_ROWS)
    for chunk in range(len(bounds)):
        rows = slice(chunk * CHUNK_ROWS, (chunk + 1) * CHUNK_ROWS)
        assert (bounds.lowest[chunk] == means[rows].min(axis=0)).all()
        assert (bounds.highest[chunk] == means[rows].max(axis=0)).all()
        assert bounds.terms[6, chunk] == np.exp(np.float64(log_scales[rows].max()))
    assert bounds.finite.all()


def test_a_model_without_rows_has_no_chunks() -> None:
    assert len(ChunkBounds.measured(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))) == 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("which", [0, 1])
def test_values_that_are_not_finite_make_a_bound_that_is_not(value: float, which: int) -> None:
    arrays = np.zeros((2, 2 * CHUNK_ROWS, 3), np.float32)
    arrays[which, CHUNK_ROWS + 7, 1] = value
    assert ChunkBounds.measured(*arrays).finite.tolist() == [True, False]


def test_each_chunk_widens_by_its_own_step() -> None:
    sides = np.array([[0.0, 1, 2], [3, 4, 5]]), np.array([[1.0, 2, 3], [4, 5, 6]])
    bounds = ChunkBounds.of_sides(*sides, np.array([-1.0, -2]))
    wide = bounds.widened(np.array([0.0, 0.5]), 0.25)
    assert (wide.lowest == [[0, 1, 2], [2.5, 3.5, 4.5]]).all()
    assert (wide.highest == [[1, 2, 3], [4.5, 5.5, 6.5]]).all()
    np.testing.assert_allclose(wide.terms[6], np.exp([-0.75, -1.75]), rtol=1e-15)  # three roundings
    assert (wide.terms[7] == [6, 16.5]).all(), "the sum of the coordinates of the farthest corner"
    assert not bounds.widened(math.inf, 0.0).finite.any()
    assert not bounds.with_rounding(1 << 24).finite.any()
    assert rounded_share(1 << 24) == math.inf


def test_rounding_of_each_update_is_in_the_widened_bounds() -> None:
    """Steps of a little more than half an ulp move a float32 by a whole one: twice as far."""
    start, step = np.float32(1000.0), 1.01 * 2.0**-15
    value = start
    for _ in range(500):
        value = np.float32(value + np.float32(step))
    bounds = ChunkBounds.of_sides(np.full((1, 3), start, np.float64), np.full((1, 3), start, np.float64), np.zeros(1))
    assert value > bounds.widened(500 * step, 0.0).highest[0, 0]
    wide = bounds.with_rounding(500).widened(500 * step * rounded_share(500), 0.0)
    assert value <= wide.highest[0, 0] < start + 3 * 500 * step


def test_rounding_of_log_scales_is_in_the_widened_bounds() -> None:
    """As above, of a log scale of -20, for which float32 has steps of 2^-19."""
    start, step = np.float32(-20.0), 1.01 * 2.0**-20
    value = start
    for _ in range(500):
        value = np.float32(value + np.float32(step))
    bounds = ChunkBounds.of_sides(np.zeros((1, 3)), np.zeros((1, 3)), np.array([start], np.float64))
    assert value > np.log(bounds.widened(0.0, 500 * step).terms[6, 0])
    wide = bounds.with_rounding(500).widened(0.0, 500 * step * rounded_share(500))
    assert value <= np.log(wide.terms[6, 0]) < start + 3 * 500 * step


def test_the_bounds_with_the_defaults() -> None:
    assert largest_step(DEFAULT) == pytest.approx(7.28, abs=0.01)
    assert hidden_path(DEFAULT) == pytest.approx(65.9, abs=0.1)


@pytest.mark.parametrize(("beta1", "beta2"), BETAS)
def test_no_step_is_larger(beta1: float, beta2: float) -> None:
    """In float64, gradients for which the bound is tight after t steps, and random ones, at every t."""
    config = replace(DEFAULT, beta1=beta1, beta2=beta2)
    bound, largest = largest_step(config), 0.0
    rng = np.random.default_rng(0)
    for steps in (1, 2, 3, 10, 100, 3000):
        tight = np.maximum((beta2 / max(beta1, 1e-3)) ** np.arange(-steps + 1.0, 1.0), 1e-100)
        gradients = np.stack(
            [tight, np.ones(steps), *rng.standard_normal((4, steps)) * 10 ** rng.normal(0, 2, (4, steps))]
        )
        m = v = np.zeros(len(gradients))
        for step in range(1, steps + 1):
            g = gradients[:, step - 1]
            m, v = beta1 * m + (1 - beta1) * g, beta2 * v + (1 - beta2) * g * g
            moved = np.abs(m / (1 - beta1**step)) / (np.sqrt(v / (1 - beta2**step)) + 1e-300)
            largest = max(largest, float(moved.max()))
    assert largest <= bound
    if 3000 * (1 - beta2) >= 3:  # otherwise the second moment is still far from its limit
        assert largest > 0.95 * bound


@pytest.mark.parametrize("steps", range(2, 60))
def test_the_corrected_bound_rises_to_its_limit(steps: int) -> None:
    """sqrt(S(r) S(b2)) / S(b1) from t - 1 to t, as the proof says."""
    for beta1, beta2 in BETAS[1:]:
        before, after = (
            math.sqrt((beta1**2 / beta2) ** np.arange(t) @ np.ones(t) * (beta2 ** np.arange(t)).sum())
            / (beta1 ** np.arange(t)).sum()
            for t in (steps - 1, steps)
        )
        assert before <= after * (1 + 1e-12) <= largest_step(replace(DEFAULT, beta1=beta1, beta2=beta2)) * (1 + 1e-12)


@pytest.mark.parametrize(("beta1", "beta2"), BETAS)
@pytest.mark.parametrize("shown", [1, 3, 50, 400])
def test_a_hidden_row_moves_no_farther(beta1: float, beta2: float, shown: int) -> None:
    """In float32, like the kernels: all steps that show a row, and 2000 that do not."""
    config = replace(DEFAULT, beta1=max(beta1, 1e-3), beta2=beta2)
    count = 64
    before, after = (paths(np.random.default_rng(shown), shown, hidden, count, config) for hidden in (0, 2000))
    assert np.abs(before).max() <= shown * largest_step(config)
    tail = np.abs(after - before).max()
    assert tail <= hidden_path(config)
    if (shown, beta1, beta2) == (400, 0.9, 0.999):  # the tight gradients need some hundred steps
        assert tail > 0.55 * hidden_path(config)


@pytest.mark.parametrize(("beta1", "beta2"), [(0.9, 0.9), (0.5, 0.6), (0.9, 0.999), (0.8, 0.95)])
@pytest.mark.parametrize("ratio", [0.0, 3.0, 7.28, 40.0])
@pytest.mark.parametrize("begun", [1, 20, 5000])
def test_no_step_is_larger_after_other_decays(beta1: float, beta2: float, ratio: float, begun: int) -> None:
    """In float64, from moments of this ratio on, with gradients of all sizes; and hidden after each step."""
    config, rng, count = replace(DEFAULT, beta1=beta1, beta2=beta2), np.random.default_rng(begun), 256
    bound = largest_resumed_step(config, ratio, begun)
    v = 10 ** rng.uniform(-6, 2, count)
    m = ratio * np.sqrt(v)
    largest = 0.0
    for step in range(begun + 1, begun + 40):
        moved = np.zeros(count)
        tail_m, tail_v = m, v
        for later in range(step, step + 60):
            tail_m, tail_v = beta1 * tail_m, beta2 * tail_v
            moved += tail_m / (1 - beta1**later) / np.sqrt(tail_v / (1 - beta2**later))
        assert moved.max() <= hidden_path(config, bound)
        g = np.where(rng.random(count) < 0.5, np.sqrt(v) * 10 ** rng.uniform(-1, 1, count), 0.0)
        m, v = beta1 * m + (1 - beta1) * g, beta2 * v + (1 - beta2) * g * g
        largest = max(largest, float((np.abs(m) / (1 - beta1**step) / np.sqrt(v / (1 - beta2**step))).max()))
    assert largest <= bound
    assert begun < 5000 or largest > 0.2 * bound, "without the corrections, the bound is not far from what happens"


@pytest.mark.parametrize(
    "config",
    [
        replace(DEFAULT, beta1=0.9, beta2=0.8),
        replace(DEFAULT, beta1=0.0, beta2=0.0),
        replace(DEFAULT, beta2=1 - 1e-9),
        replace(DEFAULT, epsilon=1e-20),
    ],
)
def test_without_a_bound_it_is_infinite(config: OptimiserConfig) -> None:
    assert largest_step(config) == hidden_path(config) == math.inf


def test_moments_that_underflow_stay_in_the_bound() -> None:
    """Gradients whose squares are under float32's range: epsilon then divides."""
    for size in (1e-16, 3e-18, 1e-19, 1e-22):
        m = v = p = np.float32(0)
        for step in range(1, 300):
            g = np.float32(size if step < 100 else 0)
            m, v = np.float32(0.9) * m + np.float32(0.1) * g, np.float32(0.999) * v + np.float32(0.001) * (g * g)
            v = np.float32(0) if v < 1.2e-38 else v  # as on devices without denormal numbers
            root = np.float32((1 - 0.999**step) ** -0.5)
            by = m / np.float32(1 - 0.9**step) / (np.sqrt(v) * root + np.float32(1e-15))
            p = p + by
            assert abs(by) <= largest_step(DEFAULT)
        assert p <= 100 * largest_step(DEFAULT)
