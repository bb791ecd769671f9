# SPDX-License-Identifier: Apache-2.0
"""Partition of the ground into cells: half-open, without gaps or overlaps, with equal numbers of places."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.blocks.plan import Rectangle
from clsplat.blocks.planning.loads import CellBins
from clsplat.blocks.planning.split import (
    MAX_BLOCKS,
    PLANE,
    GroundCut,
    Leaf,
    Tree,
    balanced,
    bounds_of,
    cells,
    cut_again,
    gridded,
    parse_blocks,
    widened,
    without,
)
from clsplat.errors import InputError


def spread_places(count: int, seed: int = 0) -> NDArray[np.float64]:
    """Places that fill an L, half of them in one of its arms."""
    rng = np.random.default_rng(seed)
    corner = rng.uniform(0, 10, (count, 2))
    arm = rng.random(count) < 0.5
    return np.where(arm[:, None], corner * (4, 1), corner * (1, 3))


def counts(tree: Tree, places: NDArray[np.float64]) -> list[int]:
    return [int(((places >= cell.low) & (places < cell.high)).all(axis=1).sum()) for _, cell in cells(tree)]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 8, 16, 33])
def test_each_place_is_in_exactly_one_cell_and_cells_have_equal_numbers(count: int) -> None:
    places = spread_places(1000)
    tree = balanced(places, count)
    found = counts(tree, places)
    assert len(found) == count and sum(found) == len(places)
    # each cut rounds to a whole place, and there are at most six cuts above a cell
    assert max(found) - min(found) <= 6
    anywhere = np.random.default_rng(1).normal(scale=1e6, size=(500, 2))
    edges = np.array([[cut.at, 0.0] for cut in cuts(tree) if cut.axis == 0] or [[0.0, 0.0]])
    for points in (anywhere, edges):  # also points on the edges, and far outside
        assert sum(counts(tree, points)) == len(points)


def cuts(tree: Tree) -> list[GroundCut]:
    return [] if isinstance(tree, Leaf) else [tree, *cuts(tree.below), *cuts(tree.above)]


def test_names_of_a_balanced_division_are_the_sides_of_the_first_cut() -> None:
    def names(count: int) -> list[str]:
        return [name for name, _ in cells(balanced(spread_places(200), count))]

    assert names(1) == ["0_0"]
    assert names(4) == ["0_0", "0_1", "1_0", "1_1"]
    assert names(5) == ["0_0", "0_1", "1_0", "1_1", "1_2"]


def test_a_grid_has_columns_of_rows() -> None:
    places = np.stack(np.meshgrid(np.arange(12.0), np.arange(6.0)), axis=2).reshape(-1, 2)
    tree = gridded(places, 3, 2)
    found = dict(cells(tree))
    assert sorted(found) == ["0_0", "0_1", "1_0", "1_1", "2_0", "2_1"]
    assert found["0_0"] == Rectangle((-inf, -inf), (3.5, 2.5))
    assert found["1_1"] == Rectangle((3.5, 2.5), (7.5, inf))
    assert counts(tree, places) == [12] * 6


def test_a_cut_is_across_the_longer_side() -> None:
    wide = np.random.default_rng(3).uniform(0, 1, (100, 2)) * (10, 1)
    tree = balanced(wide, 2)
    assert isinstance(tree, GroundCut) and tree.axis == 0
    tree = balanced(wide[:, ::-1].copy(), 2)
    assert isinstance(tree, GroundCut) and tree.axis == 1


def test_equal_places_are_not_cut() -> None:
    same = np.ones((9, 2))
    assert balanced(same, 4) == Leaf("0_0")
    assert gridded(same, 2, 2) == Leaf("0_0")
    two = np.array([[0.0, 0.0]] * 5 + [[0.0, 1.0]] * 4)
    assert [name for name, _ in cells(balanced(two, 4))] == ["0_0", "1_0"]
    assert [name for name, _ in cells(gridded(two, 2, 2))] == ["0_0", "0_1"]


def test_neighbouring_floats_are_cut_apart() -> None:
    pair = np.array([[1.0, 0.0], [np.nextafter(1.0, 2), 0.0]])
    assert counts(balanced(pair, 2), pair) == [1, 1]


def test_a_cell_joins_the_other_side_of_its_last_cut() -> None:
    tree = gridded(spread_places(100), 2, 2)
    fewer, neighbours = without(tree, "0_1")
    assert neighbours == ["0_0"]
    assert [name for name, _ in cells(fewer)] == ["0_0", "1_0", "1_1"]
    assert dict(cells(fewer))["0_0"].high[1] == inf
    # now 0_0 is a column of its own: both rows of the other column reach over its ground
    fewest, neighbours = without(fewer, "0_0")
    assert neighbours == ["1_0", "1_1"]
    assert all(cell.low[0] == -inf for _, cell in cells(fewest))
    points = np.random.default_rng(2).normal(scale=100, size=(200, 2))
    assert sum(counts(fewer, points)) == sum(counts(fewest, points)) == 200


def test_named_cells_are_cut_again() -> None:
    places = spread_places(64)
    tree = balanced(places, 2)
    finer = cut_again(tree, ["1_0"], places)
    assert [name for name, _ in cells(finer)] == ["0_0", "1_0", "1_1"]
    assert counts(finer, places) == [32, 16, 16]
    assert cut_again(Leaf("0_0"), ["0_0"], np.ones((5, 2))) == Leaf("0_0")


def test_a_widened_cell_is_a_fifth_larger_on_each_inner_side() -> None:
    bounds = Rectangle((0.0, -5.0), (10.0, 5.0))
    cell = Rectangle((-inf, 1.0), (4.0, 3.0))
    # 4 wide within the bounds, and 2 high; products of small whole numbers and 0.2
    wide = widened(cell, bounds, 0.2)
    assert wide.low == (-inf, pytest.approx(0.6)) and wide.high == (pytest.approx(4.8), pytest.approx(3.4))
    assert widened(PLANE, bounds, 0.2) == PLANE


def test_bounds() -> None:
    assert bounds_of(np.array([[1.0, 5.0], [3.0, -2.0]])) == Rectangle((1.0, -2.0), (3.0, 5.0))


def test_sums_over_cells_are_those_of_a_loop() -> None:
    rng = np.random.default_rng(7)
    points = rng.integers(0, 8, (300, 2)).astype(float)  # many of them on edges
    rectangles = [
        Rectangle((-inf, -inf), (3.0, inf)),
        Rectangle((3.0, 2.0), (5.0, 6.0)),
        Rectangle((2.0, 4.0), (inf, inf)),
        PLANE,
    ]
    weights = np.where(rng.random(300) < 0.3, 0, rng.random(300)).astype(np.float32)
    bins = CellBins.of(points, rectangles)
    inside = [((points >= each.low) & (points < each.high)).all(axis=1) for each in rectangles]
    assert bins.sums().tolist() == [mask.sum() for mask in inside]
    # differences of float64 sums of 300 numbers below 1
    assert bins.sums(weights) == pytest.approx([weights[mask].sum(dtype=np.float64) for mask in inside], abs=1e-10)


def test_the_number_of_blocks_is_parsed() -> None:
    assert parse_blocks("auto") is None
    assert parse_blocks("4") == 4
    assert parse_blocks("2x3") == (2, 3)


@pytest.mark.parametrize("text", ["", "0", "-1", "2x", "x2", "2x0", "2x2x2", "1.5", "many", "²", f"{MAX_BLOCKS + 1}"])
def test_a_wrong_number_of_blocks_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--blocks .*expected"):
        parse_blocks(text)
