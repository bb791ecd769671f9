# SPDX-License-Identifier: Apache-2.0
"""Poses of a viewer's page, for tests of the viewer without a browser."""

from __future__ import annotations

import numpy as np

from clsplat.viewer.pose import Pose, read_pose

ZERO = np.zeros(3)
"""The origin of a world."""


def pose(x: float = 0.0, size: tuple[int, int] = (640, 360)) -> Pose:
    """The pose of a camera at (x, 0, -4) that looks along +z, on a page of this size."""
    found = read_pose((1.0, 0.0, 0.0, 0.0), (x, 0.0, -4.0), 1.0, size, ZERO)
    assert found is not None
    return found
