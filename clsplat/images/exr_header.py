# SPDX-License-Identifier: Apache-2.0
"""The header of a picture: attributes, matrices, window and chromaticities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera, Window


@dataclass(frozen=True, eq=False)
class Header:
    """Contents of a file beside pixels; window: None where the picture is the display window; chromaticities: x and y
    of red, green, blue and white, none where they are not known; is_srgb: True if the colours are sRGB's."""

    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    matrices: Mapping[str, Float64] = field(default_factory=dict)
    window: Window | None = None
    chromaticities: Sequence[float] = ()
    is_srgb: bool = True


def camera_matrices(camera: Camera) -> dict[str, Float64]:
    """worldToCamera and worldToNDC of row vectors, as OpenEXR defines them, for a camera that has an image plane; none
    for others.

    In the camera's space x is right, y up and z along the view, a left-handed frame. In NDC (0, 0) is the upper left
    corner of the display window, and (1, 1) the lower right one. OpenEXR says nothing of z: here it is 0 at the near
    plane and 1 at infinity. Of an orthographic camera it is 1 at the far plane, or without one grows by 1 a world unit.
    """
    if camera.projection not in ("perspective", "orthographic"):
        return {}
    to_camera = np.eye(4)
    flip = np.diag([1.0, -1.0, 1.0])
    to_camera[:3, :3] = (flip @ camera.rotation).T
    to_camera[3, :3] = flip @ camera.translation
    display = camera.window or camera
    centre = camera.cx / display.width, camera.cy / display.height
    projection = np.zeros((4, 4))
    projection[0, 0] = camera.fx / display.width
    projection[1, 1] = -camera.fy / display.height
    if camera.projection == "perspective":  # w = z
        projection[2] = [*centre, 1.0, 1.0]
        projection[3, 2] = -camera.near
    else:
        along = 1 / (camera.far - camera.near) if np.isfinite(camera.far) else 1.0
        projection[2, 2] = along
        projection[3] = [*centre, -along * camera.near, 1.0]
    return {"worldToCamera": to_camera, "worldToNDC": to_camera @ projection}
