# SPDX-License-Identifier: Apache-2.0
"""Deep pictures merged into one, against the float64 twin and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_close, assert_same_bits
from slices import flattened, in_front

from clsplat.arrays import Float32
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import DEEP_PICTURES
from clsplat.reference.deep_merge import deep_merge as twin
from clsplat.stages.deep_merge import deep_merge


def random_pictures(count: int, bins: int, height: int, width: int, seed: int = 0) -> tuple[Float32, Float32]:
    """Pictures (P, bins, H, W, 5) whose pixels have 0 to `bins` slices, and weights (P, H, W) of the sum 1."""
    random = np.random.default_rng(seed)
    shape = (count, bins, height, width)
    alpha = (random.uniform(0.02, 0.95, shape) * min(1, 8 / bins)).astype(np.float32)  # so that light is left
    depth = np.cumsum(random.uniform(0.01, 1, shape), axis=1).astype(np.float32)
    depth[:, :, ::3] = np.round(depth[:, :, ::3]) + np.arange(bins, dtype=np.float32)[:, None, None]  # equal ones too
    colours = random.uniform(-0.2, 1.5, (*shape, 3)).astype(np.float32) * alpha[..., None]
    pictures = np.concatenate([colours, alpha[..., None], depth[..., None]], axis=4)
    slices = random.integers(0, bins + 1, (count, height, width))
    pictures[np.arange(bins)[None, :, None, None] >= slices[:, None]] = 0
    weights = random.uniform(0.1, 1, (count, height, width))
    return pictures, (weights / weights.sum(axis=0)).astype(np.float32)


def merged(device: Device, pictures: Float32, weights: Float32) -> Float32:
    """(bins, H, W, 5) by the kernel."""
    count, bins, height, width, floats = pictures.shape
    planes = np.ascontiguousarray(pictures.transpose(0, 1, 4, 2, 3)).reshape(count, bins, floats, -1)
    arrays = (upload(device, planes), upload(device, np.ascontiguousarray(weights.reshape(count, -1))))
    got = deep_merge(device, Workspace(device), *arrays).get()
    return np.asarray(got.reshape(bins, floats, height, width).transpose(0, 2, 3, 1))


@pytest.mark.parametrize(("count", "bins"), [(1, 1), (1, 5), (2, 1), (3, 7), (DEEP_PICTURES, 4), (2, 40)])
def test_against_the_twin(device: Device, count: int, bins: int) -> None:
    pictures, weights = random_pictures(count, bins, 5, 13)
    got, wanted = merged(device, pictures, weights), twin(pictures.astype(np.float64), weights.astype(np.float64))
    # light is a float32 sum of up to 16 products: where it is this near to a threshold, a slice may begin elsewhere
    sure = wanted.margin > 1e-6
    assert sure.mean() > 0.9
    assert_close(got[:, sure, 4], wanted.slices[:, sure, 4])
    # a slice's colour is a sum of up to 16 x bins products, over light that has lost as many
    assert_close(got[:, sure, :4], wanted.slices[:, sure, :4], absolute=1e-5)


def test_at_any_depth_it_is_the_mean(default_device: Device) -> None:
    pictures, weights = random_pictures(8, 6, 10, 20)
    got = merged(default_device, pictures, weights)
    total = (weights * in_front(pictures, np.inf)).sum(axis=0)
    for depth in (*np.linspace(0, 6, 30), np.inf):
        wanted = (weights * in_front(pictures, depth)).sum(axis=0)
        error = np.abs(in_front(got, depth) - wanted)
        # (74): the slack of a pixel is no more than this; behind all of it there is none
        assert (error <= (total / 6 if depth < np.inf else 0) + 1e-6).all()


def test_colours_add_up(default_device: Device) -> None:
    pictures, weights = random_pictures(5, 6, 10, 20)

    wanted = sum(weight[:, :, None] * flattened(picture) for picture, weight in zip(pictures, weights, strict=True))
    got = flattened(merged(default_device, pictures, weights))
    assert_close(got, np.asarray(wanted), absolute=2e-6)  # 30 float32 sums


def test_the_same_picture_twice_is_itself(default_device: Device) -> None:
    """Equal slices are merged again: where each takes more than the slack, nothing is lost."""
    pictures, _ = random_pictures(1, 4, 6, 9)
    pictures = np.concatenate([pictures, pictures])
    got = merged(default_device, pictures, np.full((2, 6, 9), 0.5, np.float32))
    taken = pictures[0, ..., 3] * np.concatenate([np.ones((1, 6, 9)), np.cumprod(1 - pictures[0, :-1, ..., 3], axis=0)])
    plain = ((taken == 0) | (taken > 1 / 64)).all(axis=0)
    assert plain.mean() > 0.3
    assert_close(got[:, plain], pictures[0][:, plain], absolute=1e-6)


def test_a_pixel_that_nothing_counts_in(default_device: Device) -> None:
    pictures, weights = random_pictures(3, 4, 2, 8)
    weights[:, :, ::2] = 0
    got = merged(default_device, pictures, weights)
    assert not got[:, :, ::2].any() and np.isfinite(got).all()


def test_the_order_of_equal_depths_is_that_of_the_pictures(default_device: Device) -> None:
    pictures = np.zeros((2, 1, 1, 1, 5), np.float32)
    pictures[:, 0, 0, 0] = [[0.5, 0, 0, 0.5, 2], [0, 1, 0, 1, 2]]
    got = merged(default_device, pictures, np.full((2, 1, 1), 0.5, np.float32))
    assert_same_bits(got[0, 0, 0], np.array([0.25, 0.5, 0, 0.75, 2], np.float32))
