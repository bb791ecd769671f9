# SPDX-License-Identifier: Apache-2.0
"""Videos of the demo's still life: a camera walk with stops and a fast turn, blurred by averaging sub-frames.

Variants have 10 bits and HLG, or pixels that are stored turned by 90 degrees.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
from demo_photographs import baked_still_life
from numpy.typing import NDArray
from scipy import ndimage

from clsplat.camera import Camera
from clsplat.demo import ray_caster
from clsplat.images.video import frame_planes
from clsplat.scenes.video import colours
from clsplat.shots.viewpoints import look_at

Part = Literal["stop", "walk", "turn"]
PARTS: tuple[tuple[Part, float], ...] = (("stop", 0.15), ("walk", 0.35), ("turn", 0.06), ("walk", 0.32), ("stop", 0.12))
"""Parts of the walk with their fractions of the frames."""
WALK_RADIANS = 0.55 * np.pi
"""Angle of the walk on the ring, in both parts together."""
TURN_RADIANS = 0.6 * np.pi
"""Angle of the fast turn, to the side and back."""
HAND_METRES = 0.0015
"""Standard deviation of the hand's movements at rest."""
SHAKE_RADIANS_PER_SECOND = 0.4
"""Largest speed at which the direction of view changes while the shutter is open. Each frame has its own.

The shutter is open for half of the time between frames."""
TKHD_MATRIX_AT = 40
"""Place of the matrix after the header of version 0 of a `tkhd` box of MP4."""


@dataclass(frozen=True, eq=False)
class Walk:
    """A video's frames before it is encoded, (H, W, 3) in [0, 1]; the part of each; its camera in mid-exposure."""

    frames: list[NDArray[np.float32]]
    parts: list[Part]
    cameras: list[Camera]
    fps: int


def walk(
    width: int, height: int, count: int, *, fps: int = 10, sub_frames: int = 3, samples: int = 1, seed: int = 0
) -> Walk:
    """Render a walk of `count` frames.

    sub_frames: pictures that are averaged for a frame of a moving camera; an odd number.
    samples: each pixel of a picture is the average of samples x samples rays. 2 is what `demo` has; with 1, frames are
    aliased.
    """
    surfaces = baked_still_life()
    rng = np.random.default_rng(seed)
    frames: list[NDArray[np.float32]] = []
    parts: list[Part] = []
    cameras: list[Camera] = []
    for part, angle, yaw, speed in _path(count):
        shake = rng.uniform(0, 0.5 / fps * SHAKE_RADIANS_PER_SECOND) * (part != "stop")
        hand = rng.normal(0, HAND_METRES, 3)
        shots = [
            _camera(width, height, angle + open_ * speed[0], yaw + open_ * (speed[1] + shake), hand)
            for open_ in (np.arange(sub_frames) + 0.5) / sub_frames - 0.5
        ]
        used = shots if part != "stop" else shots[sub_frames // 2 :][:1]
        pictures = [ray_caster.render(surfaces, shot, samples) for shot in used]
        frames.append(np.asarray(np.mean(pictures, axis=0), np.float32))
        parts.append(part)
        cameras.append(shots[sub_frames // 2])
    return Walk(frames, parts, cameras, fps)


def sliding(count: int, width: int = 64, height: int = 48) -> list[NDArray[np.float32]]:
    """Frames of a textured picture that slides by 3 pixels from frame to frame, (height, width, 3) in [0, 1]."""
    size = (height, width + 3 * count, 3)
    noise = ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 1, size), (1.5, 1.5, 0))
    picture = np.asarray((noise - noise.min()) / (noise.max() - noise.min()), np.float32)
    return [np.ascontiguousarray(picture[:, 3 * index :][:, :width]) for index in range(count)]


def _path(count: int) -> Iterator[tuple[Part, float, float, tuple[float, float]]]:
    """Yield part, angle on the ring, yaw against the middle, and what both change during a frame's exposure.

    The exposure takes half of the time between frames.
    """
    walked = sum(share for part, share in PARTS if part == "walk") * count
    turned = sum(share for part, share in PARTS if part == "turn") * count
    angle = yaw = 0.0
    ends = np.cumsum([share for _, share in PARTS]) * count
    for index in range(count):
        part = PARTS[int(np.searchsorted(ends, index + 0.5))][0]
        step, swing = 0.0, 0.0
        if part == "walk":
            step = WALK_RADIANS / walked
        elif part == "turn":
            begin = ends[1]
            swing = TURN_RADIANS / turned * (1 if index - begin < turned / 2 else -1)
        angle, yaw = angle + step, (yaw + swing if part == "turn" else 0.0)
        yield part, angle, yaw, (0.5 * step, 0.5 * swing)


def _camera(width: int, height: int, angle: float, yaw: float, hand: NDArray[np.float64]) -> Camera:
    focal = 0.5 * max(width, height) / np.tan(0.5 * ray_caster.FIELD_OF_VIEW_RADIANS)
    position = np.array([2.55 * np.cos(angle), 2.55 * np.sin(angle), 0.95]) + hand
    ahead = ray_caster.SCENE_CENTRE - position
    turned = np.array(
        [ahead[0] * np.cos(yaw) - ahead[1] * np.sin(yaw), ahead[0] * np.sin(yaw) + ahead[1] * np.cos(yaw), ahead[2]]
    )
    rotation, translation = look_at(position, position + turned, np.array([0.0, 0.0, 1.0]))
    return Camera(width, height, focal, focal, width / 2, height / 2, rotation, translation)


def write_walk(
    path: Path,
    frames: Sequence[NDArray[Any]],
    fps: int = 10,
    *,
    hlg: bool = False,
    turns: int = 0,
    bits_per_pixel: float | None = None,
) -> Path:
    """Write a video of frames (H, W, 3) in [0, 1]: H.264 of 8 bits, or HEVC of 10 bits and HLG.

    turns: counter-clockwise quarter turns of the stored pixels, which the file's display matrix undoes.
    bits_per_pixel: mean number of bits for a pixel of a frame; None for the encoder's constant quality 12.
    Returns the path.
    """
    import av

    with av.open(str(path), "w") as container:
        options = {"preset": "veryfast"} | ({"crf": "12"} if bits_per_pixel is None else {})
        stream = container.add_stream("libx265" if hlg else "libx264", rate=fps, options=options)
        if hlg:
            stream.codec_context.options = {**options, "x265-params": "log-level=none:pools=1:frame-threads=1"}
        first = np.rot90(frames[0], turns)
        stream.height, stream.width = (side + side % 2 for side in first.shape[:2])
        stream.pix_fmt = "yuv420p10le" if hlg else "yuv420p"
        context = stream.codec_context
        if bits_per_pixel is not None:
            context.bit_rate = round(bits_per_pixel * stream.height * stream.width * fps)
        context.color_range = 1
        context.colorspace, context.color_primaries, context.color_trc = (9, 9, 18) if hlg else (1, 1, 1)
        for index, image in enumerate(frames):
            turned = np.ascontiguousarray(np.rot90(image, turns))
            frame = hlg_frame(turned) if hlg else av.VideoFrame.from_ndarray(frame_planes(turned), format="yuv420p")
            frame.pts = index
            frame.time_base = Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    if turns:
        set_rotation(path, turns)
    return path


def set_rotation(path: Path, turns: int) -> None:
    """Write the display matrix of a clockwise rotation by quarter turns into the track header of an MP4 file."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4
    cosine, sine = round(np.cos(turns * np.pi / 2)), round(np.sin(turns * np.pi / 2))
    one, two = 1 << 16, 1 << 30
    matrix = (cosine * one, sine * one, 0, -sine * one, cosine * one, 0, 0, 0, two)
    struct.pack_into(">9i", data, at + TKHD_MATRIX_AT, *matrix)
    path.write_bytes(data)


def hlg_frame(image: NDArray[Any]) -> Any:
    """A frame of 10 bits in HLG and BT.2020 that `colours.display_rgb` brings back to the picture (H, W, 3) in [0, 1].

    The sides are rounded up to even numbers.
    """
    import av

    height, width, _ = image.shape
    image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    signal = hlg_signal(np.asarray(image, np.float64))
    weights = np.array(colours.LUMA_WEIGHTS_BY_MATRIX[9])
    luma = signal @ weights
    chroma = [(signal[:, :, channel] - luma) / (2 * (1 - weights[channel])) for channel in (2, 0)]
    small = [0.5 * (plane[0::2] + plane[1::2])[:, 0::2] for plane in chroma]
    planes = [64 + 876 * luma, *(512 + 896 * plane for plane in small)]
    frame = av.VideoFrame(image.shape[1], image.shape[0], "yuv420p10le")
    for plane, values in zip(frame.planes, planes, strict=True):
        lines = np.zeros((plane.height, plane.line_size // 2), np.uint16)
        lines[:, : values.shape[1]] = np.clip(np.rint(values), 0, 1023)
        plane.update(lines)
    return frame


def hlg_signal(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """The HLG signal of display values: the inverse of the conversion of `colours`, formula by formula."""
    light = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    most = np.maximum(light.max(axis=-1), 1e-6)
    peak, knee = colours.HDR_PEAK_NITS / colours.REFERENCE_WHITE_NITS, colours.HIGHLIGHT_KNEE
    a = -(knee**2) * (peak - 1) / (knee**2 - 2 * knee + peak)
    b = (knee**2 - 2 * knee * peak + peak) / (peak - 1)
    slope = (b**2 + 2 * b * knee + knee**2) / (b - a)
    opened = np.where(most <= knee, most, (b * most - a * slope) / (slope - most))
    wide = (light * (opened / most)[..., None]) @ np.linalg.inv(colours._REC2020_TO_REC709.astype(np.float64)).T
    display = np.maximum(wide, 0) / peak
    luminance = np.maximum(display @ np.array(colours.LUMA_WEIGHTS_BY_MATRIX[9]), 1e-9)
    gamma = colours.HLG_SYSTEM_GAMMA
    scene = display * (luminance ** ((1 - gamma) / gamma))[..., None]
    high = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.asarray(np.clip(np.where(scene <= 1 / 12, np.sqrt(3 * scene), high), 0, 1))
