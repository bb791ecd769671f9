# SPDX-License-Identifier: Apache-2.0
"""The order of rows in space."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from clsplat.chunks.bounds import ChunkBounds
from clsplat.chunks.order import MORTON_BITS_PER_AXIS, beside_parents, every_third_bit, space_order


def cloud(count: int, seed: int = 0) -> np.ndarray:
    """Means (count, 3) on a grid of 2^-10, so that they scale without rounding."""
    return (np.random.default_rng(seed).integers(-(1 << 12), 1 << 12, (count, 3)) / 1024).astype(np.float32)


def box_sizes(means: np.ndarray) -> float:
    """Mean diagonal of the chunks' boxes."""
    bounds = ChunkBounds.measured(means, np.zeros_like(means))
    return float(np.linalg.norm(bounds.highest - bounds.lowest, axis=1).mean())


def test_bits_are_spread() -> None:
    numbers = np.array([0, 1, 0b101, (1 << MORTON_BITS_PER_AXIS) - 1], np.uint64)
    wanted = [int("0" + "".join(f"00{bit}" for bit in f"{number:b}"), 2) for number in numbers.tolist()]
    assert every_third_bit(numbers).tolist() == wanted


def test_cells_are_in_the_curve_s_order() -> None:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
    shuffled = np.random.default_rng(0).permutation(8)
    assert (corners[shuffled][space_order(corners[shuffled])] == corners).all()


@pytest.mark.parametrize("count", [0, 1, 2, 1025, 40_000])
def test_every_row_is_there_once(count: int) -> None:
    order = space_order(cloud(count))
    assert order.dtype == np.uint32
    assert (np.sort(order) == np.arange(count)).all()


def test_the_order_is_the_same_on_every_machine() -> None:
    found = hashlib.sha256(space_order(cloud(50_000)).astype("<u4").tobytes()).hexdigest()[:16]
    assert found == "dcf9bc0f5b7428cf"


def test_equal_means_keep_their_order() -> None:
    means = np.repeat(cloud(500), 5, axis=0)
    order = space_order(means)
    assert (np.diff(order.reshape(500, 5).astype(np.int64)) == 1).all()
    assert (space_order(np.ones((100, 3), np.float32)) == np.arange(100)).all()


def test_shuffled_rows_have_the_same_places() -> None:
    means = cloud(5000)
    shuffled = np.random.default_rng(1).permutation(5000)
    assert (means[space_order(means)] == means[shuffled][space_order(means[shuffled])]).all()


def test_scale_and_place_do_not_matter() -> None:
    means = cloud(5000)
    order = space_order(means)
    assert (space_order(means * 1024) == order).all()
    assert (space_order(means + np.float32(64)) == order).all()


def test_rows_that_are_not_finite_are_last_in_their_order() -> None:
    means = cloud(3000)
    bad = np.array([5, 100, 2999])
    means[bad, [0, 1, 2]] = [np.nan, np.inf, -np.inf]
    assert (space_order(means)[-3:] == bad).all()
    good = np.delete(np.arange(3000), bad)
    assert (space_order(means)[:-3] == good[space_order(means[good])]).all()
    assert (space_order(np.full((10, 3), np.nan, np.float32)) == np.arange(10)).all()


def test_outliers_do_not_coarsen_the_cells() -> None:
    means = cloud(20_000)
    far = means.copy()
    far[:10] = np.random.default_rng(2).choice([-1e30, 1e30], (10, 3))
    rest = np.arange(20_000) >= 10
    assert box_sizes(far[rest][space_order(far[rest])]) == pytest.approx(box_sizes(means[space_order(means)]), rel=0.1)
    order = space_order(far)
    assert box_sizes(far[order[order >= 10]]) < 1.1 * box_sizes(means[space_order(means)])


def test_chunks_are_small() -> None:
    """A thousandth of a cube has a tenth of its diagonal. Pieces of the curve are up to twice as long as a cube."""
    rng = np.random.default_rng(3)
    solid = rng.random((200_000, 3)).astype(np.float32)
    assert box_sizes(solid[space_order(solid)]) < 2 * (1024 / 200_000) ** (1 / 3) * np.sqrt(3)
    flat = solid * np.float32([100, 100, 1])  # a town: cells are cubes, so its height counts little
    assert box_sizes(flat[space_order(flat)]) < 2 * (1024 / 200_000) ** 0.5 * 100 * np.sqrt(2)
    assert box_sizes(flat) > 130


def test_new_rows_are_behind_their_parents() -> None:
    kept, cloned = np.array([0, 1, 2, 4, 5]), np.array([1, 4, 5, 5])
    order = beside_parents(np.concatenate([kept, cloned]).astype(np.uint32))
    assert order.dtype == np.uint32
    assert order.tolist() == [0, 1, 5, 2, 3, 6, 4, 7, 8]
    assert beside_parents(np.zeros(0, np.uint32)).tolist() == []
