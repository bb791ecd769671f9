# SPDX-License-Identifier: Apache-2.0
"""A frame's channels other than colour (depth, normals, motion, ...): float64 twin of features.cl and channels.cl.

Equation numbers refer to docs/channels.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Float64, Int64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference.blend import layers
from clsplat.reference.cameras import pixel_from_world
from clsplat.reference.project import Seen, rotation_matrices, view_directions
from clsplat.reference.render import parameters


@dataclass(frozen=True, eq=False)
class ChannelsTwin:
    """Channels of a frame: eqs. (60) to (67). In pixels without Gaussians, index is -1, doubt infinite, and the rest 0.

    features: the blended features by channel, (H, W) or (H, W, 2 to 3).
    median: (H, W), depth at which the transmittance falls to one half.
    first: (H, W), depth of the first Gaussian.
    count: (H, W), number of Gaussians.
    index: (H, W), index of the Gaussian with the largest blending weight.
    doubt: (H, W), the smallest distance of a transmittance from one half, or of the largest weight from the second
        largest, if that is smaller. Where it is small, rounding may change median or index.
    """

    features: dict[str, Float64]
    median: Float64
    first: Float64
    count: Int64
    index: Int64
    doubt: Float64


def normals(means: Float64, quaternions: Float64, log_scales: Float64, camera: Camera) -> Float64:
    """Return each Gaussian's normal (N, 3), its axis of smallest scale, pointing towards the camera: eq. (62).

    Of axes with equal scales the first is taken.
    """
    axes = rotation_matrices(quaternions)[np.arange(len(means)), :, np.argmin(log_scales, axis=1)]
    away = (view_directions(means, camera)[0] * axes).sum(axis=1)
    return np.where(away[:, None] > 0, -axes, axes)


def motions(means: Float64, camera: Camera, after: Camera, moved: Float64 | None = None) -> Float64:
    """Return the motion (N, 2) in pixels of means from one camera to another, of any projection: eq. (64).

    In a panorama the motion is the shorter way around.

    after: the camera after the motion.
    moved: the means after the motion; None if only the camera moves.
    """
    to = means if moved is None else moved
    (here, _), (there, depths) = pixel_from_world(camera, means), pixel_from_world(after, to)
    if camera.model.wraps:
        # A panorama wraps around the middle of the whole frame, even if only a window of the frame is rendered.
        frame = camera.window or camera
        here[:, 0] = camera.model.wrapped(replace(camera, width=frame.width), here[:, 0])
        turned = (there[:, 0] - after.cx) / after.fx - (here[:, 0] - camera.cx) / camera.fx
        there[:, 0] -= np.round(turned / (2 * np.pi)) * after.model.turn(after)
    seen = (depths > after.near) & np.isfinite(here + there).all(axis=1)
    return np.where(seen[:, None], there - here, 0.0)


def features(
    projected: Seen, gaussians: Gaussians, camera: Camera, after: Camera, before: Camera | None = None
) -> dict[str, Float64]:
    """Return the values of Gaussians that are blended to channels: arrays (N, 1 to 3), keyed by channel.

    after: the camera at the end of the forward motion.
    before: the camera at the end of the backward motion; None for `after`.
    """
    arrays = parameters(gaussians)
    means = arrays["means"]
    return {
        "depth": projected.depths[:, None],
        "normal": normals(means, arrays["quaternions"], arrays["log_scales"], camera),
        "position": means,
        "motion": motions(means, camera, after),
        "backward": motions(means, camera, before or after),
    }


def channels(
    projected: Seen, gaussians: Gaussians, camera: Camera, after: Camera, earlier: Camera | None = None
) -> ChannelsTwin:
    """Blend a frame's channels front to back.

    after: the camera at the end of the forward motion.
    earlier: the camera at the end of the backward motion; None for `after`.
    """
    width, height = camera.width, camera.height
    by_name = features(projected, gaussians, camera, after, earlier)
    rows = np.concatenate(list(by_name.values()), axis=1)
    sums, total = np.zeros((height, width, rows.shape[1])), np.zeros((height, width))
    median, first, largest, second = (np.zeros((height, width)) for _ in range(4))
    count, index = np.zeros((height, width), np.int64), np.full((height, width), -1, np.int64)
    doubt = np.full((height, width), np.inf)
    for layer in layers(projected, width, height):
        box, added, before, after_it = layer.box, layer.added, layer.before, layer.after
        weight = np.where(added, before * layer.alpha, 0.0)
        depth = projected.depths[layer.gaussian]
        sums[box] += weight[:, :, None] * rows[layer.gaussian]
        total[box] += weight
        median[box] = np.where(added & (before > 0.5) & (after_it <= 0.5), depth, median[box])
        doubt[box] = np.where(added, np.minimum(doubt[box], np.abs(after_it - 0.5)), doubt[box])
        first[box] = np.where(added & (count[box] == 0), depth, first[box])
        count[box] += added
        heavier = weight > largest[box]
        second[box] = np.where(heavier, largest[box], np.maximum(second[box], weight))
        index[box] = np.where(heavier, layer.gaussian, index[box])
        largest[box] = np.maximum(largest[box], weight)
    some = total > 0
    ends = np.cumsum([values.shape[1] for values in by_name.values()])[:-1]
    blended = dict(zip(by_name, np.split(sums, ends, axis=2), strict=True))
    scales = dict.fromkeys(by_name, total) | {"normal": np.linalg.norm(blended["normal"], axis=2)}
    means = {name: sum_ / np.where(scales[name] > 0, scales[name], 1.0)[:, :, None] for name, sum_ in blended.items()}
    return ChannelsTwin(
        features={name: mean if mean.shape[2] > 1 else mean[:, :, 0] for name, mean in means.items()},
        median=median,
        first=first,
        count=count,
        index=index,
        doubt=np.minimum(doubt, np.where(some, largest - second, np.inf)),
    )
