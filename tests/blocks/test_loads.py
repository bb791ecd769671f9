# SPDX-License-Identifier: Apache-2.0
"""What photographs show, and to which blocks they belong."""

from __future__ import annotations

import numpy as np

from clsplat.blocks.planning.loads import belonging, places_seen


def test_a_photograph_shows_the_median_of_its_pixels() -> None:
    coordinates = np.array([[0.0, 9.0], [1.0, 8.0], [2.0, 7.0], [500.0, 0.0]])
    street = np.array([1, 5, 2, 4], np.float32)  # a third of the pixels are sky, far away
    nothing = np.zeros(4, np.float32)
    places = places_seen(coordinates, [street, nothing], np.array([[-1.0, -1.0], [3.0, 4.0]]))
    assert places.tolist() == [[1.0, 7.0], [3.0, 4.0]]  # half of the 12 pixels are up to there


def test_a_photograph_belongs_to_its_fullest_cell_and_those_filled_nearly_as_much() -> None:
    filled = np.array([[100.0, 25.0, 24.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    assert belonging(filled, 0.25).tolist() == [[True, True, False], [False, False, True], [False, False, False]]
