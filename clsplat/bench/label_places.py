# SPDX-License-Identifier: Apache-2.0
"""Label placement for plots: no label covers another label, a point or a leader line.

Boxes are (..., 4): left, bottom, right, top, in pixels.
Segments are (..., 2, 2): x and y of each end.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64

LABEL_GAP_PX = 9.0
"""Radius in pixels of the innermost ring of candidate boxes around a point."""
RING_SPACING_PX = 8.0
"""Difference in pixels between the radii of two consecutive rings."""
RING_COUNT, DIRECTIONS_PER_RING = 50, 24
"""Number of rings of candidate boxes around a point, and of boxes in a ring."""
MARKER_RADIUS_PX = 6.0
"""Half the side in pixels of the square that a point's marker covers."""
LEADER_LINE_DISTANCE_PX = 12.0
"""Distance in pixels beyond which a label has a leader line."""
CROSSING_COST_PX = 60.0
"""Cost of a label or leader line that crosses a line, as an additional distance in pixels between point and label."""
AMBIGUOUS_POINT_COST_PX = 40.0
"""Cost, as a distance in pixels, for each other point that is about as near to a label as the label's own point."""


@dataclass(frozen=True, eq=False)
class LabelBox:
    """Box (4,) of a label, and the leader line (2, 2) to the label's point, or None for a label near its point."""

    box: Float64
    leader: Float64 | None


def place_labels(points: Float64, sizes: Float64, frame: Float64, lines: Float64) -> list[LabelBox]:
    """Place a label near each point, inside the box `frame`.

    points: (n, 2), in pixels.
    sizes: (n, 2), widths and heights of the labels.
    lines: segments that labels and leader lines should not cross.
    A point's marker covers a square around the point.
    The search is greedy and starts with the points that have the most neighbours.
    Each label gets the candidate box with the smallest penalty. Penalties are for covered labels, markers and leader
    lines, and for the area outside the frame. Among equal penalties the lowest cost decides.
    Costs are for the distance, for crossings, and for other points near the label.
    """
    markers = np.hstack([points - MARKER_RADIUS_PX, points + MARKER_RADIUS_PX])
    crowded = (1 / (1 + np.linalg.norm(points[:, None] - points, axis=2))).sum(axis=1)
    places: dict[int, LabelBox] = {}
    for index in np.argsort(-crowded, kind="stable"):
        point = points[index]
        boxes = _candidates(point, sizes[index])
        ends = _nearest(boxes, point)
        distances = np.linalg.norm(ends - point, axis=1)
        links = np.stack([np.broadcast_to(point, ends.shape), ends], axis=1)
        apart = distances > LEADER_LINE_DISTANCE_PX
        taken = np.array([*(place.box for place in places.values()), *markers])
        leaders = np.array([p.leader for p in places.values() if p.leader is not None]).reshape(-1, 2, 2)
        others = taken[(taken != markers[index]).any(axis=1)]
        covered = shared(boxes, taken).sum(axis=1) + 100 * crossed(boxes, leaders).sum(axis=1)
        covered += 100 * apart * crossed(others, links).sum(axis=0)
        covered += 10 * ((boxes[:, 2:] - boxes[:, :2]).prod(axis=1) - shared(boxes, frame[None])[:, 0])
        crossings = crossed(boxes, lines).sum(axis=1) + apart * _cross(links, leaders).sum(axis=1)
        rivals = points[(points != point).any(axis=1)]
        gaps = np.linalg.norm(_nearest(boxes[:, None], rivals) - rivals, axis=2)
        mistaken = (gaps < distances[:, None] + LABEL_GAP_PX).sum(axis=1)
        best = np.lexsort((distances + CROSSING_COST_PX * crossings + AMBIGUOUS_POINT_COST_PX * mistaken, covered))[0]
        places[index] = LabelBox(boxes[best], links[best] if apart[best] else None)
    return [places[index] for index in range(len(points))]


def _candidates(point: Float64, size: Float64) -> Float64:
    """Return the candidate boxes (RING_COUNT * DIRECTIONS_PER_RING, 4) for a label near a point, nearest ring first.

    point: (2,), and size: (2,), the label's width and height, in pixels.
    A ring is a circle around the point. Its boxes extend outwards from DIRECTIONS_PER_RING positions on the circle.
    """
    angles = 2 * pi * np.arange(DIRECTIONS_PER_RING) / DIRECTIONS_PER_RING
    directions = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)
    rings = LABEL_GAP_PX + RING_SPACING_PX * np.arange(RING_COUNT)[:, None, None]
    corners = point + rings * directions - size * (1 - directions) / 2
    return np.concatenate([corners, corners + size], axis=2).reshape(-1, 4)


def _nearest(boxes: Float64, points: Float64) -> Float64:
    """Return the position (..., 2) in each box (..., 4) that is nearest to the box's point (..., 2)."""
    return points.clip(boxes[..., :2], boxes[..., 2:])


def shared(boxes: Float64, others: Float64) -> Float64:
    """Return the areas (m, n) of the intersections of boxes (m, 4) with boxes (n, 4)."""
    low = np.maximum(boxes[:, None, :2], others[:, :2])
    areas: Float64 = (np.minimum(boxes[:, None, 2:], others[:, 2:]) - low).clip(0).prod(axis=2)
    return areas


def crossed(boxes: Float64, segments: Float64) -> NDArray[np.bool_]:
    """Mask (m, n), True where a segment (n, 2, 2) passes through the inside of a box (m, 4).

    Segments are clipped against each edge (Liang and Barsky).
    """
    start, move = segments[:, 0], segments[:, 1] - segments[:, 0]
    low, high = boxes[:, None, :2], boxes[:, None, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        clips = np.sort(np.stack([(low - start) / move, (high - start) / move]), axis=0)
    first, last = np.where(move == 0, 0, clips[0]).max(axis=2), np.where(move == 0, 1, clips[1]).min(axis=2)
    misses = ((move == 0) & ~((low < start) & (start < high))).any(axis=2)
    inside: NDArray[np.bool_] = ~misses & (first.clip(0) < last.clip(None, 1))
    return inside


def _cross(segments: Float64, others: Float64) -> NDArray[np.bool_]:
    """Mask (m, n), True where segments (m, 2, 2) and (n, 2, 2) properly cross each other."""
    through = _sides(segments, others[:, 0]) * _sides(segments, others[:, 1]) < 0
    return through & (_sides(others, segments[:, 0]) * _sides(others, segments[:, 1]) < 0).T


def _sides(lines: Float64, points: Float64) -> Float64:
    """Return numbers (m, n): positive where a point (n, 2) is left of a line (m, 2, 2), negative where it is right."""
    along, offsets = (lines[:, 1] - lines[:, 0])[:, None], points - lines[:, None, 0]
    return along[..., 0] * offsets[..., 1] - along[..., 1] * offsets[..., 0]
