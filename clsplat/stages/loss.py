# SPDX-License-Identifier: Apache-2.0
"""Launches loss.cl: L1 + D-SSIM and its gradient, with the terms of `stages.loss_terms` added."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_groups
from clsplat.device.profile import stage
from clsplat.layouts.columns import LOSS_COLUMNS, LOSS_GROUP_COLUMNS, LOSS_GROUP_ROWS, LOSS_PARTS, LOSS_RING, TILE
from clsplat.stages.blend import tile_items
from clsplat.stages.loss_terms import Compared, RenderTerms
from clsplat.stages.target import is_photograph, sample_defines

LOSS_PIXEL_BYTES = 12
"""Bytes per pixel of the gradient with respect to the image, padding included."""

_MIN_BLOCK_ROWS = 32
"""Minimum number of rows in a block. In a smaller block, the ten rows shared with its neighbours cost too much."""


@dataclass(frozen=True)
class _Blocks:
    """Blocks of pixels that groups of the loss kernel process.

    rows, columns: size of a block in pixels.
    groups: number of groups; for groups of several items, which process one block each, a tuple of the numbers of
        blocks across, blocks down and channels.
    field: number of floats in a row of one of SSIM's three partial derivatives; not used for groups of several items.
    partials: number of floats in the array of partial derivatives.
    sums: number of floats in the array of the loss's partial sums.

    The order in which the loss is summed depends on `columns`. No other result depends on the blocks.
    """

    rows: int
    columns: int
    groups: int | tuple[int, int, int]
    field: int
    partials: int
    sums: int


def _blocks(device: Device, height: int, stride: int) -> _Blocks:
    shape = device.shape
    if tile_items(device) > 1:
        rows, columns = LOSS_GROUP_ROWS, LOSS_GROUP_COLUMNS
        across, down = -(-stride // columns), -(-height // rows)
        partials, sums = 9 * height * across * columns, 9 * down * across
        return _Blocks(rows, columns, (across, down, 3), 0, partials, sums)
    columns = -(-stride // (-(-stride // LOSS_COLUMNS) * TILE)) * TILE
    across = -(-stride // columns)
    # A channel has about shape.chunks blocks, or fewer.
    rows = max(-(-height * across // shape.chunks), _MIN_BLOCK_ROWS)
    blocks = 3 * -(-height // rows) * across
    groups = blocks if blocks < 3 * shape.chunks else shape.chunks
    field = 16 * ((columns // 16 + 2) | 1)  # odd: at power-of-two distances, rows evict each other from a cache
    return _Blocks(rows, columns, groups, field, partials=groups * LOSS_RING * 3 * field, sums=9 * height * across)


def scratch_bytes(device: Device, height: int, stride: int, sums_arrays: int = 1) -> int:
    """Bytes of the partial derivatives, and of `sums_arrays` arrays of the loss's partial sums."""
    blocks = _blocks(device, height, stride)
    return 4 * (blocks.partials + sums_arrays * blocks.sums)


@dataclass(eq=False)
class Loss:
    """A loss and its gradient.

    gradient: (3, rows, stride), with an additional plane for each of the alpha and depth terms.
    sums: (3, ...), partial sums of SSIM, of |x - y| and of (x - y)^2, where x is the render and y the target. With
    further terms the array has one axis, and the partial sums of these terms follow.
    samples: number of colour samples, three per pixel, that no mask excludes.
    weight: weight of 1 - SSIM; L1 has the weight 1 - weight.
    masked: number of masked samples. The mean of SSIM still includes the windows around them.
    copy: function that waits for a copy of the sums to the host and returns it; None if no copy has been started.
    further: weight, divisor and number of partial sums of each loss term other than L1 and D-SSIM.
    """

    gradient: DeviceArray
    sums: DeviceArray
    samples: int
    weight: float
    copy: Callable[[], NDArray[Any]] | None = None
    masked: int = 0
    further: tuple[tuple[float, float, int], ...] = ()

    def fetched(self) -> Loss:
        """Start a copy of the sums to the host, and return the loss with this copy. Then `read` does not wait for
        later launches."""
        return self.copied(self.sums.begin_get())

    def copied(self, copy: Callable[[], NDArray[Any]]) -> Loss:
        """Return this loss with `copy`, the function from which `read` gets the sums."""
        return Loss(self.gradient, self.sums, self.samples, self.weight, copy, self.masked, self.further)

    def read(self) -> tuple[float, float]:
        """Wait for the device, and return the loss and the mean squared error."""
        sums = (self.copy() if self.copy is not None else self.sums.get()).reshape(-1)
        own = sums.size - sum(count for *_, count in self.further)
        ssim, absolute, squared = sums[:own].reshape(3, -1).sum(axis=1, dtype=np.float64) / self.samples
        unlike = 1 - ssim if not self.masked else (self.samples + self.masked) / self.samples - ssim
        value = (1 - self.weight) * absolute + self.weight * unlike
        for weight, divisor, count in self.further:
            value += weight * sums[own : own + count].sum(dtype=np.float64) / divisor
            own += count
        return float(value), float(squared)


@stage("loss")
def loss(
    device: Device,
    work: Workspace,
    image: DeviceArray,
    target: DeviceArray,
    size: tuple[int, int],
    weight: float,
    sums_index: int = 0,
    *,
    kept: int | None = None,
    further: RenderTerms | None = None,
) -> Loss:
    """Compute (1 - weight) L1 + weight (1 - SSIM) of an image and its target.

    image: planes (3, rows, stride), whose padding must be zero.
    target: planes like the image's; or a photograph (height, width, 3), uint8 or float32, if several items share a
    tile (`tile_items`).
    size: width and height in pixels, without padding.
    sums_index: index of the array for the loss's sums. A call's sums can be read until the next call with this index.
    kept: number of pixels that no mask excludes, over which the means are taken; None for all pixels. Excluded pixels
        are zero in both images.
    further: loss terms to add. Each has a plane of the gradient, after the colours, and its own partial sums.
    """
    (width, height), (_, rows, stride) = size, image.shape
    terms = () if further is None else further.terms
    every, blocks, items = 3 * width * height, _blocks(device, height, stride), tile_items(device)
    samples = every if kept is None else max(3 * kept, 1)
    partials = work.array("loss_partials", (blocks.partials,))
    gradient = work.array("image_gradient", (3 + len(terms), rows, stride))
    own, each = blocks.sums // 3 * 3, rows // TILE * stride
    sums = work.array(f"loss_sums{sums_index or ''}", (own + each * len(terms),) if terms else (3, own // 3))
    sizes, pictures, results = (width, height, stride, rows * stride), (image, target), (partials, gradient, sums)
    weights = ((1 - weight) / samples, weight / samples)
    defines: dict[str, object] = {"ITEMS": items}
    if items == 1:
        kernel = device.kernels("loss", defines).loss
        block = (blocks.columns, blocks.rows, blocks.field)
        launch_groups(device, kernel, blocks.groups, 1, *sizes, *block, *weights, *pictures, *results)
    else:
        if is_photograph(target):
            defines |= {"PHOTOGRAPH": True, **sample_defines(target)}
        kernels, items = device.kernels("loss", defines), min(items, LOSS_PARTS)
        launch_groups(device, kernels.loss_ssim, blocks.groups, items, *sizes, *pictures, partials, sums)
        launch_groups(device, kernels.loss_grad, blocks.groups, items, *sizes, *weights, *pictures, *results)
    if further is not None:
        compared = Compared(device, work, further.blended, target, gradient, sums, samples / 3)
        for number, term in enumerate(terms):
            term.launch(compared, 3 + number, own + each * number)
    scales = tuple((*term.scale(samples / 3), each) for term in terms)
    masked = 0 if kept is None else every - 3 * kept
    return Loss(gradient, sums, samples, weight, masked=masked, further=scales)
