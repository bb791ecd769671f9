# SPDX-License-Identifier: Apache-2.0
"""Deep pictures merged into one: every number of pictures and slices, and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from compare import assert_close, assert_same_bits
from slices import flattened, in_front

from clsplat.arrays import Float32
from clsplat.device.buffers import Workspace
from clsplat.device.context import Device
from clsplat.layouts.columns import DEEP_PICTURES
from clsplat.selftest.case import Inputs, faults
from clsplat.selftest.cases.pictures import DEEP_MERGE_CASE, launch_deep_merge, random_deep_pictures


def random_pictures(count: int, bins: int, height: int, width: int) -> tuple[Float32, Float32]:
    given = random_deep_pictures(np.random.default_rng(0), (width, height), count, bins)
    return given.pictures, given.weights


def merged(device: Device, pictures: Float32, weights: Float32) -> Float32:
    """(bins, H, W, 5) by the kernel."""
    return launch_deep_merge(device, Workspace(device), Inputs(pictures=pictures, weights=weights))()["slices"]


@pytest.mark.parametrize(("count", "bins"), [(1, 1), (1, 5), (2, 1), (3, 7), (DEEP_PICTURES, 4), (2, 40)])
def test_every_number_of_pictures_and_slices(device: Device, count: int, bins: int) -> None:
    given = random_deep_pictures(np.random.default_rng(0), (13, 5), count, bins)
    assert faults(DEEP_MERGE_CASE.errors(device, given)) == []


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
