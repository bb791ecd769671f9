# SPDX-License-Identifier: Apache-2.0
"""Places for labels beside the points of a plot, so that no label covers another, a point or a leader line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import cos, hypot, inf, pi, sin

Point = tuple[float, float]
Segment = tuple[Point, Point]

NEAR = 9.0
"""Pixels from a point to the label beside it."""
STEP = 8.0
"""Pixels from one ring of candidates to the next."""
DIRECTIONS = 24
LEADER = 12.0
"""A label farther from its point than this has a leader line."""
CROSSING = 60.0
"""A crossed line costs as much as a label so many pixels farther away."""
MISTAKEN = 40.0
"""So does a point that is not its own, as near to the label or nearly."""


@dataclass(frozen=True)
class Box:
    """A rectangle in pixels."""

    left: float
    bottom: float
    right: float
    top: float

    def overlaps(self, other: Box) -> bool:
        """True if the two share more than an edge."""
        across = self.left < other.right and other.left < self.right
        return across and self.bottom < other.top and other.bottom < self.top

    def shared(self, other: Box) -> float:
        """The area that both cover."""
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.top, other.top) - max(self.bottom, other.bottom)
        return max(width, 0.0) * max(height, 0.0)

    def holds(self, other: Box) -> bool:
        """True if all of the other lies in it."""
        inside = self.left <= other.left and other.right <= self.right
        return inside and self.bottom <= other.bottom and other.top <= self.top

    def nearest(self, point: Point) -> Point:
        """The place in it that is nearest to a point."""
        x, y = point
        return min(max(x, self.left), self.right), min(max(y, self.bottom), self.top)

    def distance(self, point: Point) -> float:
        """Pixels from a point to it."""
        x, y = self.nearest(point)
        return hypot(x - point[0], y - point[1])

    def crossed(self, segment: Segment) -> bool:
        """True if a segment goes through the inside. Clipped edge by edge (Liang and Barsky)."""
        (x0, y0), (x1, y1) = segment
        first, last = 0.0, 1.0
        for start, move, low, high in ((x0, x1 - x0, self.left, self.right), (y0, y1 - y0, self.bottom, self.top)):
            if move == 0:
                if not low < start < high:
                    return False
                continue
            a, b = sorted(((low - start) / move, (high - start) / move))
            first, last = max(first, a), min(last, b)
        return first < last


@dataclass(frozen=True)
class Place:
    """A label's box, and the line from its point to it where it lies apart."""

    box: Box
    leader: Segment | None


def place_labels(
    points: Sequence[Point],
    sizes: Sequence[tuple[float, float]],
    frame: Box,
    lines: Sequence[Segment] = (),
    marker: float = 6.0,
) -> list[Place]:
    """A place for each label of the size (width, height) beside its point, all in pixels, inside `frame`.

    Greedy: the points with the most neighbours first, each at the cheapest of the candidates around it that covers
    nothing. Distance costs, and so does crossing one of `lines`. A marker covers `marker` pixels around its point.
    Where no candidate is free the one is taken that covers the least.
    """
    markers = [Box(x - marker, y - marker, x + marker, y + marker) for x, y in points]
    places: dict[int, Place] = {}
    for index in sorted(range(len(points)), key=lambda index: _crowd(points, index)):
        boxes = [*(place.box for place in places.values()), *markers]
        leaders = [place.leader for place in places.values() if place.leader]
        best, least = None, (inf, inf)
        for place, distance in _candidates(points[index], sizes[index]):
            if least < (0.0, distance / 2):  # farther rings have nothing cheaper
                break
            covered = _covered(place, frame, boxes, leaders, markers[index])
            crossings = sum(place.box.crossed(line) for line in lines)
            crossings += sum(_cross(place.leader, line) for line in leaders) if place.leader else 0
            mistaken = sum(place.box.distance(other) < distance + NEAR for other in points if other != points[index])
            cost = (covered, distance + CROSSING * crossings + MISTAKEN * mistaken)
            if cost < least:
                best, least = place, cost
        assert best is not None
        places[index] = best
    return [places[index] for index in range(len(points))]


def _crowd(points: Sequence[Point], index: int) -> tuple[float, int]:
    """A key by which the point with the nearest neighbours comes first; ties by number."""
    x, y = points[index]
    return -sum(1 / (1 + hypot(x - a, y - b)) for a, b in points), index


def _candidates(point: Point, size: tuple[float, float]) -> Iterator[tuple[Place, float]]:
    """Boxes around a point, ring by ring: each touches its ring from outside. To the right first."""
    x, y = point
    width, height = size
    for ring in range(50):
        distance = NEAR + STEP * ring
        for number in range(DIRECTIONS):
            angle = 2 * pi * number / DIRECTIONS
            across, up = round(cos(angle), 9), round(sin(angle), 9)
            # the box's middle moves along the edge with the direction, from the corner on one side to that on the other
            left = x + distance * across - width * (1 - across) / 2
            bottom = y + distance * up - height * (1 - up) / 2
            box = Box(left, bottom, left + width, bottom + height)
            apart = box.distance(point)
            yield Place(box, (point, box.nearest(point)) if apart > LEADER else None), apart


def _covered(place: Place, frame: Box, boxes: Sequence[Box], leaders: Sequence[Segment], own: Box) -> float:
    """Cost of a place, by the pixels that it covers: 0 for one that is free."""
    box = place.box
    covered = sum(box.shared(other) for other in boxes)
    covered += sum(100.0 for leader in leaders if box.crossed(leader))
    if place.leader:
        covered += sum(100.0 for other in boxes if other != own and other.crossed(place.leader))
    if not frame.holds(box):
        area = (box.right - box.left) * (box.top - box.bottom)
        covered += 10 * (area - box.shared(frame))
    return covered


def _cross(one: Segment | None, other: Segment) -> bool:
    """True if two segments cross, each from side to side of the other."""
    if one is None:
        return False

    def side(line: Segment, point: Point) -> float:
        (ax, ay), (bx, by) = line
        return (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax)

    (a, b), (c, d) = one, other
    return side(one, c) * side(one, d) < 0 and side(other, a) * side(other, b) < 0
