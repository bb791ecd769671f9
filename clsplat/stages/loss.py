# SPDX-License-Identifier: Apache-2.0
"""Launches loss.cl, alpha_loss.cl and depth_loss.cl: L1 + D-SSIM, those of alpha and depth, and their gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid, launch_groups
from clsplat.device.layout import LOSS_COLUMNS, LOSS_GROUP_COLUMNS, LOSS_RING, TILE
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended

PIXEL_BYTES = 12
"""Bytes of the image's gradient, of each pixel with its padding."""
ALPHA_PIXEL_BYTES = 9
"""Bytes of the alpha loss, of each pixel with its padding: alpha, its gradient and, rounded up, its sums."""

DEPTH_PIXEL_BYTES = 17
"""Bytes of the depth loss, of each pixel with its padding: nearness, its gradient, its aim and weight, the sums."""

_LEAST_ROWS = 32
"""Rows of such a block, at least: ten more are worked out anew."""


@dataclass(frozen=True)
class _Blocks:
    """Blocks of pixels that the groups work on.

    rows, columns: of a block; groups: their number; field: floats from one derivative of a row that a group keeps to
    the next, if it keeps any; partials, sums: floats of these arrays. The sums have one order for a number of columns,
    and nothing else depends on what the blocks are.
    """

    rows: int
    columns: int
    groups: int
    field: int
    partials: int
    sums: int


def _blocks(device: Device, height: int, stride: int) -> _Blocks:
    shape = device.shape
    if shape.items > 1:
        rows = min(max(shape.items // 16, 1), 16)  # as in loss.cl
        groups = 3 * -(-height // rows) * -(-stride // LOSS_GROUP_COLUMNS)
        return _Blocks(rows, LOSS_GROUP_COLUMNS, groups, 0, partials=9 * height * stride, sums=3 * groups)
    columns = -(-stride // (-(-stride // LOSS_COLUMNS) * TILE)) * TILE
    across = -(-stride // columns)
    rows = max(-(-height * across // shape.chunks), _LEAST_ROWS)  # so three blocks a piece of work, or fewer
    blocks = 3 * -(-height // rows) * across
    groups = blocks if blocks < 3 * shape.chunks else shape.chunks
    field = 16 * ((columns // 16 + 2) | 1)  # odd: rows that are a power of two apart drive each other out of a cache
    return _Blocks(rows, columns, groups, field, partials=groups * LOSS_RING * 3 * field, sums=9 * height * across)


def scratch_bytes(device: Device, height: int, stride: int, turns: int = 1) -> int:
    """Bytes of the partial derivatives and, of each turn, the partial sums."""
    blocks = _blocks(device, height, stride)
    return 4 * (blocks.partials + turns * blocks.sums)


@dataclass(frozen=True, eq=False)
class Loss:
    """gradient (3, rows, stride), one plane more each with alpha's loss and depth's; sums (3, ...): partial sums of
    SSIM, of |x - y| and of its square, in one row with those of further losses behind them where they are there;
    samples: that count, masked: that do not, in whose windows SSIM is counted all the same; copy: the sums where a copy
    to the host is under way; further: weight, divisor and number of the sums of each further loss."""

    gradient: DeviceArray
    sums: DeviceArray
    samples: int
    weight: float
    copy: Callable[[], NDArray[Any]] | None = None
    masked: int = 0
    further: tuple[tuple[float, float, int], ...] = ()

    def fetched(self) -> Loss:
        """The same, its sums on their way to the host: `read` then does not wait for what comes behind them."""
        return self.copied(self.sums.begin_get())

    def copied(self, copy: Callable[[], NDArray[Any]]) -> Loss:
        """The same, its sums on the host from a function that waits for them."""
        return Loss(self.gradient, self.sums, self.samples, self.weight, copy, self.masked, self.further)

    def read(self) -> tuple[float, float]:
        """(loss, mean squared error); waits for the device."""
        sums = (self.copy() if self.copy is not None else self.sums.get()).reshape(-1)
        own = sums.size - sum(count for *_, count in self.further)
        ssim, absolute, squared = sums[:own].reshape(3, -1).sum(axis=1, dtype=np.float64) / self.samples
        unlike = 1 - ssim if not self.masked else (self.samples + self.masked) / self.samples - ssim
        value = (1 - self.weight) * absolute + self.weight * unlike
        for weight, divisor, count in self.further:
            value += weight * sums[own : own + count].sum(dtype=np.float64) / divisor
            own += count
        return float(value), float(squared)


@dataclass(frozen=True, eq=False)
class DepthAims:
    """Known depths that the render's nearness is compared with: planes (2, rows, stride) float32 of nearness and
    weight, 0 where it is not known; factor: of the sum of weighted differences, in the loss."""

    planes: NDArray[np.float32]
    factor: float


@stage("loss")
def loss(
    device: Device,
    work: Workspace,
    image: DeviceArray,
    target: DeviceArray,
    width: int,
    height: int,
    weight: float,
    turn: int = 0,
    *,
    kept: int | None = None,
    blended: Blended | None = None,
    alpha_weight: float = 0.0,
    depth: DepthAims | None = None,
) -> Loss:
    """(1 - weight) L1 + weight (1 - SSIM) of planes (3, rows, stride), zero right of and below the image. turn: those
    of another turn keep their sums.

    kept: pixels that count, where others are zero in both pictures: the means are over these. alpha_weight: with a
    fourth plane in `target`, the alpha, this times the mean absolute difference of the render's is added. depth: the
    weighted differences of the render's nearness are added too.
    """
    _, rows, stride = image.shape
    every, blocks, items = 3 * width * height, _blocks(device, height, stride), device.shape.items
    samples = every if kept is None else max(3 * kept, 1)
    alphas = rows // TILE * stride if target.shape[0] == 4 else 0
    partials = work.array("loss_partials", (blocks.partials,))
    nears = rows // TILE * stride if depth is not None else 0
    gradient = work.array("image_gradient", (3 + bool(alphas) + bool(nears), rows, stride))
    own = blocks.sums // 3 * 3
    sums = work.array(f"loss_sums{turn or ''}", (own + alphas + nears,) if alphas or nears else (3, own // 3))
    further: tuple[tuple[float, float, int], ...] = ()
    sizes, pictures, results = (width, height, stride, rows * stride), (image, target), (partials, gradient, sums)
    weights = ((1 - weight) / samples, weight / samples)
    if items == 1:
        kernel = device.kernels("loss").loss
        block = (blocks.columns, blocks.rows, blocks.field)
        launch_groups(device, kernel, blocks.groups, 1, *sizes, *block, *weights, *pictures, *results)
    else:
        kernels = device.kernels("loss")
        launch_groups(device, kernels.loss_ssim, blocks.groups, items, *sizes, *pictures, partials, sums)
        launch_groups(device, kernels.loss_grad, blocks.groups, items, *sizes, *weights, *pictures, *results)
    if alphas:
        assert blended is not None, "the alpha loss is of a render"
        planes = (blended.stops, blended.transmittance, target, gradient)
        scale = alpha_weight / (samples / 3)
        kernel = device.kernels("alpha_loss").alpha_loss
        launch_grid(device, kernel, (stride, rows // TILE), stride, rows, own, scale, *planes, sums)
        further += ((alpha_weight, samples / 3, alphas),)
    if depth is not None:
        assert blended is not None, "the depth loss is of a render"
        assert blended.nearness is not None, "with its nearness"
        aims = work.array("depth_aims", (2, rows, stride))
        aims.send(depth.planes)
        planes = (blended.stops, blended.nearness, aims, gradient)
        sizes, behind = (stride, rows, 3 + bool(alphas), own + alphas), (depth.factor, *planes, sums)
        launch_grid(device, device.kernels("depth_loss").depth_loss, (stride, rows // TILE), *sizes, *behind)
        further += ((depth.factor, 1.0, nears),)
    masked = 0 if kept is None else every - 3 * kept
    return Loss(gradient, sums, samples, weight, masked=masked, further=further)
