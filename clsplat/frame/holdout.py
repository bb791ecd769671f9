# SPDX-License-Identifier: Apache-2.0
"""Resampling of a frame's holdout to the pixels of the pictures that are rendered: windows, strips, supersampled
pictures."""

from __future__ import annotations

import numpy as np

from clsplat.camera import Camera
from clsplat.images.holdouts import Holdout, Surfaces


class Cut:
    """Function that returns a frame's holdout surfaces at the pixels of a camera's picture.

    Only the picture's size and window matter, not the pose, so the last result is cached and reused for all samples of
    shutter and lens.
    """

    def __init__(self, holdout: Holdout) -> None:
        self._holdout = holdout
        self._key: tuple[int, ...] | None = None
        self._last: Surfaces | None = None

    def __call__(self, camera: Camera) -> Surfaces | None:
        """The holdout surfaces of each pixel of the picture, with depths as in the kernels; None if no pixel has any.

        A pixel's top left corner decides: its surfaces are those of the holdout's pixel that contains this corner.
        """
        window, holdout = camera.window, self._holdout
        x, y, across, down = (
            (window.x, window.y, window.width, window.height) if window else (0, 0, camera.width, camera.height)
        )
        key = (x, y, across, down, camera.width, camera.height)
        if key != self._key:
            columns = (x + np.arange(camera.width)) * holdout.size[0] // across - holdout.x
            rows = (y + np.arange(camera.height)) * holdout.size[1] // down - holdout.y
            self._key, self._last = key, holdout.surfaces.taken(columns, rows)
        surfaces = self._last
        assert surfaces is not None
        if len(surfaces.rows) == 0:
            return None
        cosines = camera.depths_of_distances()
        return surfaces if cosines is None else surfaces.scaled(np.float32(1) / cosines)

    @property
    def goes_on(self) -> bool:
        """True if the holdout may continue outside the frame: surfaces touch an edge of the frame, and the file has no
        pixels beyond that edge."""
        counts, (width, height) = self._holdout.surfaces.counts, self._holdout.size
        left, top = -self._holdout.x, -self._holdout.y
        right, bottom = left + width - counts.shape[1], top + height - counts.shape[0]
        edges = ((left, counts[:, :1]), (top, counts[:1]), (right, counts[:, -1:]), (bottom, counts[-1:]))
        return any(beyond == 0 and bool(edge.any()) for beyond, edge in edges)
