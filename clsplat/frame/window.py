# SPDX-License-Identifier: Apache-2.0
"""The part of a frame that is rendered, with overscan and region of interest.

A picture is a window of its frame (`Camera.window`). Its pixels are bit-identical to those of the whole frame
(docs/pictures.md).
"""

from __future__ import annotations

from dataclasses import replace

from clsplat.camera import JACOBIAN_CLAMP_HALF_FRAMES, Camera, Window
from clsplat.config.pictures import FramingConfig, parse_overscan, parse_region
from clsplat.errors import InputError


def framed(camera: Camera, config: FramingConfig) -> Camera:
    """The camera of the picture to write, from the camera of the whole frame.

    Its window is None if the picture is the whole frame. Raises InputError for a region outside the frame.
    """
    pixels, share = parse_overscan(config.overscan)
    if config.region:
        x, y, width, height = parse_region(config.region)
        if x + width > camera.width or y + height > camera.height:
            raise InputError(
                f"--region {config.region}: ends at {x + width},{y + height}, beyond the frame's size "
                f"{camera.width},{camera.height}"
            )
        return crop(camera, x, y, width, height)
    across = pixels or round(share * camera.width)
    down = pixels or round(share * camera.height)
    if across == down == 0:
        return camera
    larger = crop(camera, -across, -down, camera.width + 2 * across, camera.height + 2 * down)
    assert larger.window is not None
    clamp = max(JACOBIAN_CLAMP_HALF_FRAMES, 2 * across / camera.width, 2 * down / camera.height)
    return replace(larger, window=replace(larger.window, clamp=clamp))


def crop(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """The camera of a part of a picture, which begins at its pixel (x, y). It may extend beyond the picture."""
    window = camera.window or Window(0, 0, camera.width, camera.height)
    return replace(camera, width=width, height=height, window=replace(window, x=window.x + x, y=window.y + y))


def reframed(camera: Camera, like: Camera) -> Camera:
    """The camera of a whole frame, with the size and window of `like`, whose frame may be larger or smaller."""
    frame = like.window or like
    sized = camera if (camera.width, camera.height) == (frame.width, frame.height) else None
    sized = sized or camera.resized(frame.width, frame.height)
    return replace(sized, width=like.width, height=like.height, window=like.window)
