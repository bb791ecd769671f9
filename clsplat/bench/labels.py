# SPDX-License-Identifier: Apache-2.0
"""Places for labels beside the points of a plot, so that no label covers another, a point or a leader line.

Boxes are (..., 4) pixels: left, bottom, right, top. Segments are (..., 2, 2): two ends of x and y.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64

NEAR = 9.0
"""Pixels from a point to the label beside it."""
STEP = 8.0
"""Pixels from one ring of candidates to the next."""
RINGS, DIRECTIONS = 50, 24
MARKER = 6.0
LEADER = 12.0
"""A label farther from its point than this has a leader line."""
CROSSING = 60.0
"""A crossed line costs as much as a label so many pixels farther away."""
MISTAKEN = 40.0
"""So does a point that is not its own, as near to the label or nearly."""


@dataclass(frozen=True, eq=False)
class Place:
    """A label's box (4,), and the line from its point to it (2, 2) where it lies apart."""

    box: Float64
    leader: Float64 | None


def place_labels(points: Float64, sizes: Float64, frame: Float64, lines: Float64) -> list[Place]:
    """A place for each label beside its point and inside the box `frame`. points (n, 2), sizes (n, 2): of the labels.

    Greedy: the points with the most neighbours first, each at the cheapest of the candidates around it that covers
    nothing. Distance costs, and so does crossing one of `lines`. A marker covers MARKER pixels around its point.
    Where no candidate is free the one is taken that covers the least.
    """
    markers = np.hstack([points - MARKER, points + MARKER])
    crowded = (1 / (1 + np.linalg.norm(points[:, None] - points, axis=2))).sum(axis=1)
    places: dict[int, Place] = {}
    for index in np.argsort(-crowded, kind="stable"):
        point = points[index]
        boxes = _candidates(point, sizes[index])
        ends = _nearest(boxes, point)
        distances = np.linalg.norm(ends - point, axis=1)
        links = np.stack([np.broadcast_to(point, ends.shape), ends], axis=1)
        apart = distances > LEADER
        taken = np.array([*(place.box for place in places.values()), *markers])
        leaders = np.array([p.leader for p in places.values() if p.leader is not None]).reshape(-1, 2, 2)
        others = taken[(taken != markers[index]).any(axis=1)]
        covered = shared(boxes, taken).sum(axis=1) + 100 * crossed(boxes, leaders).sum(axis=1)
        covered += 100 * apart * crossed(others, links).sum(axis=0)
        covered += 10 * ((boxes[:, 2:] - boxes[:, :2]).prod(axis=1) - shared(boxes, frame[None])[:, 0])
        crossings = crossed(boxes, lines).sum(axis=1) + apart * _cross(links, leaders).sum(axis=1)
        rivals = points[(points != point).any(axis=1)]
        gaps = np.linalg.norm(_nearest(boxes[:, None], rivals) - rivals, axis=2)
        mistaken = (gaps < distances[:, None] + NEAR).sum(axis=1)
        best = np.lexsort((distances + CROSSING * crossings + MISTAKEN * mistaken, covered))[0]
        places[index] = Place(boxes[best], links[best] if apart[best] else None)
    return [places[index] for index in range(len(points))]


def _candidates(point: Float64, size: Float64) -> Float64:
    """Boxes around a point (RINGS * DIRECTIONS, 4), ring by ring, to the right first. Each touches its ring from
    outside: its middle moves along the edge with the direction, from the corner on one side to that on the other."""
    angles = 2 * pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)
    rings = NEAR + STEP * np.arange(RINGS)[:, None, None]
    corners = point + rings * directions - size * (1 - directions) / 2
    return np.concatenate([corners, corners + size], axis=2).reshape(-1, 4)


def _nearest(boxes: Float64, points: Float64) -> Float64:
    """The place in each box that is nearest to a point."""
    return points.clip(boxes[..., :2], boxes[..., 2:])


def shared(boxes: Float64, others: Float64) -> Float64:
    """The areas that boxes (m, 4) and others (n, 4) both cover, (m, n)."""
    low = np.maximum(boxes[:, None, :2], others[:, :2])
    areas: Float64 = (np.minimum(boxes[:, None, 2:], others[:, 2:]) - low).clip(0).prod(axis=2)
    return areas


def crossed(boxes: Float64, segments: Float64) -> NDArray[np.bool_]:
    """True where a segment (n, 2, 2) goes through the inside of a box (m, 4); (m, n). Clipped edge by edge (Liang and
    Barsky)."""
    start, move = segments[:, 0], segments[:, 1] - segments[:, 0]
    low, high = boxes[:, None, :2], boxes[:, None, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        clips = np.sort(np.stack([(low - start) / move, (high - start) / move]), axis=0)
    first, last = np.where(move == 0, 0, clips[0]).max(axis=2), np.where(move == 0, 1, clips[1]).min(axis=2)
    misses = ((move == 0) & ~((low < start) & (start < high))).any(axis=2)
    inside: NDArray[np.bool_] = ~misses & (first.clip(0) < last.clip(None, 1))
    return inside


def _cross(segments: Float64, others: Float64) -> NDArray[np.bool_]:
    """True where a segment (m, 2, 2) and another (n, 2, 2) cross, each from side to side of the other; (m, n)."""
    through = _sides(segments, others[:, 0]) * _sides(segments, others[:, 1]) < 0
    return through & (_sides(others, segments[:, 0]) * _sides(others, segments[:, 1]) < 0).T


def _sides(lines: Float64, points: Float64) -> Float64:
    """Above 0 where a point (n, 2) lies to the left of a line (m, 2, 2), below 0 to the right; (m, n)."""
    along, offsets = (lines[:, 1] - lines[:, 0])[:, None], points - lines[:, None, 0]
    return along[..., 0] * offsets[..., 1] - along[..., 1] * offsets[..., 0]
