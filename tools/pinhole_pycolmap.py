# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras, as pycolmap has them: an archive of tools/measure_gpu.py has this in its place, as the package
itself takes more room than all others together."""

from __future__ import annotations

import enum
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class CameraModelId(enum.IntEnum):
    """COLMAP's numbers of the models that are here."""

    SIMPLE_PINHOLE = 0
    PINHOLE = 1


_FOCAL = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2}
"""Focal lengths among a model's parameters, which come first."""


class Camera:
    """A pinhole camera; raises ValueError for any other. params: focal lengths, then the principal point, pixels."""

    def __init__(self, model: str, width: int, height: int, params: Sequence[float]) -> None:
        if model not in _FOCAL:
            raise ValueError(f"{model}: an archive without pycolmap has pinhole cameras alone")
        self.width, self.height, self.params = width, height, list(params)
        self._focal = _FOCAL[model]
        self.camera_id = 1

    @staticmethod
    def create_from_model_name(camera_id: int, name: str, focal: float, width: int, height: int) -> Camera:  # noqa: ARG004  # pycolmap's
        """A camera with its principal point in the middle."""
        return Camera(name, width, height, [focal] * _FOCAL[name] + [width / 2, height / 2])

    def focal_length_idxs(self) -> range:
        """Places of the focal lengths in params."""
        return range(self._focal)

    def principal_point_idxs(self) -> range:
        """Places of the principal point in params."""
        return range(self._focal, self._focal + 2)

    def extra_params_idxs(self) -> range:
        """Places of coefficients of distortion: none."""
        return range(0)

    @property
    def focal_length_x(self) -> float:
        """Pixels."""
        return self.params[0]

    @property
    def focal_length_y(self) -> float:
        """Pixels."""
        return self.params[self._focal - 1]

    @property
    def principal_point_x(self) -> float:
        """Pixels."""
        return self.params[self._focal]

    @property
    def principal_point_y(self) -> float:
        """Pixels."""
        return self.params[self._focal + 1]

    def img_from_cam(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of points (N, 3) in the camera; NaN behind it."""
        depth = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        focal = [self.focal_length_x, self.focal_length_y]
        return points[:, :2] / depth[:, None] * focal + [self.principal_point_x, self.principal_point_y]
