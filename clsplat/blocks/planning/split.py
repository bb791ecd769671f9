# SPDX-License-Identifier: Apache-2.0
"""Partition of the ground into cells: a k-d tree over the places that photographs show.

The outer cells have no outer edges. So the cells cover the plane, and each point is in exactly one of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from clsplat.arrays import Float64
from clsplat.blocks.plan import Pair, Rectangle
from clsplat.errors import InputError

MAX_BLOCKS = 10_000
"""Largest number of blocks."""


@dataclass(frozen=True)
class Leaf:
    """A cell of the tree. name: such as "0_1"."""

    name: str


@dataclass(frozen=True)
class GroundCut:
    """A cut of a part of the plane in two.

    axis: 0 or 1, the axis along which the coordinate is compared with `at`.
    below, above: the parts with coordinates less than `at`, and from `at` on.
    """

    axis: int
    at: float
    below: Tree
    above: Tree


Tree = Leaf | GroundCut
PLANE = Rectangle((-inf, -inf), (inf, inf))
"""The whole plane."""


def parse_blocks(text: str) -> int | tuple[int, int] | None:
    """Parse the value of --blocks: a number, or two such as 2x3; None for "auto". Raises InputError."""
    words = text.lower().split("x")
    if text == "auto":
        return None
    if len(words) > 2 or not all(word.isascii() and word.isdigit() for word in words):
        raise InputError(f"--blocks {text}: expected auto, a number of blocks such as 4, or NxM such as 2x3")
    counts = [int(word[:9]) for word in words]
    if min(counts) < 1 or int(np.prod(counts)) > MAX_BLOCKS:
        raise InputError(f"--blocks {text}: expected at least 1 block and at most {MAX_BLOCKS:,}")
    return counts[0] if len(counts) == 1 else (counts[0], counts[1])


def balanced(places: Float64, count: int) -> Tree:
    """Divide the plane into `count` cells with nearly equal numbers of places, each cut across the longer side.

    places: (P, 2), coordinates on the ground.
    The names of the cells are I_J: I is 0 for the cells below the first cut and 1 for those above, and J counts the
    cells on each side. There are fewer cells if too many places are equal.
    """
    return _named(_halved(places, count))


def gridded(places: Float64, columns: int, rows: int) -> Tree:
    """Divide the plane into columns along the first axis, and each column into rows along the second.

    places: (P, 2), coordinates on the ground. The columns, and the rows of a column, have nearly equal numbers of
        places.
    The names of the cells are COLUMN_ROW, counted from 0. There are fewer cells if too many places are equal.
    """

    def parts(some: Float64, axis: int, first: int, count: int, within: int | None) -> Tree:
        """Cut along `axis` into the parts `first` to `first + count`. within: column of the parts; None for columns."""
        at = _cut(some[:, axis], count // 2, count) if count > 1 else None
        if at is None:
            return Leaf(f"{within}_{first}") if within is not None else parts(some, 1, 0, rows, first)
        low = some[:, axis] < at
        below = parts(some[low], axis, first, count // 2, within)
        return GroundCut(axis, at, below, parts(some[~low], axis, first + count // 2, count - count // 2, within))

    return parts(places, 0, 0, columns, None)


def cut_again(tree: Tree, names: Sequence[str], places: Float64) -> Tree:
    """Cut each of the named cells in two, and number all cells anew. A cell whose places are all equal stays.

    places: (P, 2), coordinates on the ground.
    """

    def cut(part: Tree, some: Float64) -> Tree:
        if isinstance(part, Leaf):
            return _halved(some, 2) if part.name in names else part
        low = some[:, part.axis] < part.at
        return replace(part, below=cut(part.below, some[low]), above=cut(part.above, some[~low]))

    return _named(cut(tree, places))


def _named(tree: Tree) -> Tree:
    """Name the cells by the sides of the first cut, as `balanced` does."""
    if isinstance(tree, Leaf):
        return Leaf("0_0")
    return replace(tree, below=_numbered(tree.below, 0), above=_numbered(tree.above, 1))


def without(tree: Tree, name: str) -> tuple[Tree, list[str]]:
    """Join a cell to the neighbours on the other side of its last cut. Returns the tree and the neighbours' names.

    The tree must have at least two cells.
    """
    if isinstance(tree, Leaf):
        return tree, []
    for own, other in ((tree.below, tree.above), (tree.above, tree.below)):
        if own == Leaf(name):
            return other, [leaf for leaf, _ in cells(other)]
    below, joined = without(tree.below, name)
    above, others = without(tree.above, name)
    return replace(tree, below=below, above=above), joined + others


def cells(tree: Tree, within: Rectangle = PLANE) -> Iterator[tuple[str, Rectangle]]:
    """Yield name and rectangle of each cell. within: the part of the plane that the tree divides."""
    if isinstance(tree, Leaf):
        yield tree.name, within
        return
    yield from cells(tree.below, replace(within, high=_with(within.high, tree.axis, tree.at)))
    yield from cells(tree.above, replace(within, low=_with(within.low, tree.axis, tree.at)))


def widened(cell: Rectangle, bounds: Rectangle, margin: float) -> Rectangle:
    """Return a cell with a margin on each side that is not infinite.

    bounds: rectangle around all places, which limits the cell where it is infinite, to measure its size.
    margin: width of the margin, as a fraction of the cell's size along the same axis.
    """
    low, high = [], []
    for begin, end, least, most in zip(cell.low, cell.high, bounds.low, bounds.high, strict=True):
        width = margin * max(min(end, most) - max(begin, least), 0.0)
        low.append(begin - width)
        high.append(end + width)
    return Rectangle((low[0], low[1]), (high[0], high[1]))


def bounds_of(places: Float64) -> Rectangle:
    """Return the smallest rectangle around places (P, 2)."""
    low, high = places.min(axis=0), places.max(axis=0)
    return Rectangle((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))


def _halved(places: Float64, count: int) -> Tree:
    """Divide places into `count` cells without names, by cuts across the longer side of the places' bounds."""
    if count < 2 or len(places) < 2:
        return Leaf("")
    sides = places.max(axis=0) - places.min(axis=0)
    for axis in (0, 1) if sides[0] >= sides[1] else (1, 0):
        at = _cut(places[:, axis], count // 2, count)
        if at is not None:
            low = places[:, axis] < at
            return GroundCut(axis, at, _halved(places[low], count // 2), _halved(places[~low], count - count // 2))
    return Leaf("")


def _cut(coordinates: Float64, part: int, whole: int) -> float | None:
    """Return the coordinate that has about `part / whole` of the coordinates below it; None if they are all equal.

    It is halfway between two coordinates, so that a small change of them does not move a place across the cut.
    """
    ordered = np.unique(coordinates)
    if len(ordered) < 2:
        return None
    wanted = np.sort(coordinates)[min(max(round(len(coordinates) * part / whole), 1), len(coordinates) - 1)]
    above = max(int(np.searchsorted(ordered, wanted)), 1)
    before, after = float(ordered[above - 1]), float(ordered[above])
    middle = 0.5 * before + 0.5 * after
    return middle if middle > before else after  # between neighbouring floats, the middle may be rounded to the lower


def _numbered(tree: Tree, side: int) -> Tree:
    """Name the cells of one side of the first cut: "0_0", "0_1" and so on. side: 0 or 1."""
    count = 0

    def named(part: Tree) -> Tree:
        nonlocal count
        if isinstance(part, Leaf):
            count += 1
            return Leaf(f"{side}_{count - 1}")
        return replace(part, below=named(part.below), above=named(part.above))

    return named(tree)


def _with(values: Pair, axis: int, value: float) -> Pair:
    return (value, values[1]) if axis == 0 else (values[0], value)
