# SPDX-License-Identifier: Apache-2.0
"""A model that changes: at samples, between them and beyond, with Gaussians that keep their numbers and without."""

from __future__ import annotations

import warnings
import weakref
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from calls import no_warnings, refuses, warned
from compare import assert_same_bits
from models import random_gaussians
from tiny import hidden_model

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.models.series import CACHED_SAMPLES_PAIR, CACHED_SAMPLES_SINGLE, ModelSeries, between, follows

MODEL = hidden_model(60)
STEP = np.array([0.02, 0.0, -0.03], np.float32)


def tracked(index: int) -> Gaussians:
    """The model at a sample: it moves, turns, and becomes brighter."""
    sh = MODEL.sh.copy()
    sh[:, 0] += np.float32(0.01 * index)
    return replace(MODEL, means=MODEL.means + np.float32(index * index) * STEP / 4, sh=sh)


def apart(index: int) -> Gaussians:
    """Models that were trained frame by frame: alike, and each in an order of its own."""
    return edit.take(tracked(index), np.random.default_rng(index).permutation(len(MODEL)))


def assert_same(found: Gaussians, wanted: Gaussians) -> None:
    for name, array in wanted.arrays().items():
        assert_same_bits(found.arrays()[name], array)


def series(count: int = 6, read: object = tracked, first: int = 1, **more: bool) -> ModelSeries:
    return ModelSeries(range(first, first + count), read, "capture.####.ply", **more)  # type: ignore[arg-type]


def test_samples_are_their_own() -> None:
    made = series()
    for index in (0, 3, 1, 5):
        assert_same(made.at(1 + index), tracked(index))
    assert (made.count, len(made.kind)) == (60, 0)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.875])
def test_between_two_in_straight_lines(share: float) -> None:
    """The shares are exact in binary, so that float64's sums round once, to float32."""
    before, after = tracked(2), tracked(3)
    found = series().at(3 + share)
    np.testing.assert_array_equal(
        found.means, np.float32((1 - share) * before.means.astype(float) + share * after.means)
    )
    np.testing.assert_array_equal(found.log_scales, before.log_scales)
    same = (found.quaternions / np.linalg.norm(before.quaternions, axis=1, keepdims=True) ** -1).sum(axis=1)
    assert np.isfinite(same).all()
    unit = before.quaternions / np.linalg.norm(before.quaternions, axis=1, keepdims=True)
    np.testing.assert_allclose(found.quaternions, unit, atol=1e-7)  # float32's rounding


def test_rotations_go_the_shorter_way() -> None:
    before = replace(MODEL, quaternions=np.tile(np.float32([1, 0, 0, 0]), (60, 1)))
    after = replace(
        MODEL, quaternions=np.tile(np.float32([0, 0, 0, -2]), (60, 1))
    )  # half a turn, of any sign and length
    half = np.sqrt(0.5)
    np.testing.assert_allclose(np.abs(between(before, after, 0.5).quaternions), [[half, 0, 0, half]] * 60, atol=1e-7)
    turned = replace(before, quaternions=-before.quaternions)
    np.testing.assert_array_equal(between(before, turned, 0.5).quaternions, before.quaternions)


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_without_numbers_the_nearer_sample(share: float) -> None:
    assert_same(series(read=apart).at(2 + share), apart(1 + round(share)))


def sorted_by_place(seed: int) -> Gaussians:
    """Other Gaussians of the same shape, in the order of their places."""
    made = random_gaussians(4000, 1, seed=seed)
    return edit.take(made, np.lexsort(np.floor(made.means * 4).T))


def test_which_keep_their_numbers() -> None:
    assert follows(tracked(0), tracked(3))
    assert not follows(apart(0), apart(1))
    assert not follows(tracked(0), edit.take(tracked(0), slice(59)))
    assert not follows(sorted_by_place(1), sorted_by_place(2))
    still = replace(MODEL, log_scales=np.zeros_like(MODEL.log_scales))
    assert follows(still, still), "of equal scales none differ"
    one = edit.take(MODEL, slice(1))
    assert follows(one, replace(one, means=one.means + 1))


def test_beyond_the_ends_means_go_on_as_they_did() -> None:
    made, last = series(), tracked(5)
    np.testing.assert_array_equal(made.at(6.5).means, np.float32(2 * last.means - made.at(5.5).means))
    np.testing.assert_array_equal(made.at(7).means, np.float32(2 * last.means - tracked(4).means))
    np.testing.assert_array_equal(made.at(0).means, np.float32(2 * tracked(0).means - tracked(1).means))
    for frame in (-3, 0, 6.5):
        held = series(held=True).at(frame)
        assert_same(held, tracked(0 if frame <= 1 else 5))
        assert_same(series(read=apart).at(frame), apart(0 if frame <= 1 else 5))
    assert_same(series(1).at(9), tracked(0))


def test_moved_means() -> None:
    made = series()
    for start, end in ((2, 3), (3, 2), (2.25, 3.25), (6, 7), (1, 0)):
        moved = made.moved(start, end)
        assert_same_bits(moved.means, made.at(end).means)
        assert_same_bits(moved.sh, made.at(start).sh)
    without = series(read=apart)
    assert_same(warned("capture.####.ply: Gaussians do not keep their order", without.moved, 2, 3), apart(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is told once
        assert_same(without.moved(3, 4), apart(2))


def test_far_origins_count() -> None:
    """Means that count from other places in the world are the same means."""
    shift = np.array([64.0, 0.0, -32.0])
    other = replace(tracked(1), origin=shift, means=(tracked(1).means - shift).astype(np.float32))
    assert follows(tracked(0), other)
    np.testing.assert_allclose(between(tracked(0), other, 1.0).means, tracked(1).means, atol=1e-5)  # float32 at 64


def test_samples_are_read_once_and_few_are_held() -> None:
    reads: Counter[int] = Counter()
    alive: list[weakref.ref[Gaussians]] = []

    def read(index: int) -> Gaussians:
        reads[index] += 1
        made = tracked(index)
        alive.append(weakref.ref(made))
        return made

    made = series(24, read)
    assert sum(each() is not None for each in alive) == 1
    made.expect([float(frame) for frame in range(1, 25)])
    most = 0
    for frame in range(1, 25):
        made.at(frame)
        alone = sum(each() is not None for each in alive)
        assert alone <= CACHED_SAMPLES_SINGLE
        if frame < 24:
            made.at(frame + 0.25)
        most = max(most, sum(each() is not None for each in alive))
    assert reads == dict.fromkeys(range(24), 1)
    assert most <= CACHED_SAMPLES_PAIR


def test_the_next_that_is_expected_is_read_ahead() -> None:
    reads: list[int] = []

    def read(index: int) -> Gaussians:
        reads.append(index)
        return tracked(index)

    made = series(9, read)
    made.expect([1.0, 4.0, 7.0])
    made.at(1)
    made.at(4)
    made.at(4)
    made.at(7)
    assert reads == [0, 3, 6], "nothing between"


def test_trouble_is_told_at_its_frame() -> None:
    def read(index: int) -> Gaussians:
        if index == 2:
            raise InputError("capture.0003.ply: ends early")
        return replace(tracked(index), antialiased=index == 4)

    made = series(read=read)
    with no_warnings():
        made.expect([1.0, 2.0, 3.0])
        made.at(2)
        refuses("ends early", made.at, 3)
        refuses("frame 5 is antialiased, frame 1 is not antialiased", made.at, 5)


def test_one_near_plane_in_all_frames() -> None:
    made = series(read=lambda index: replace(tracked(index), near=0.001 * (1 + index)))
    assert [made.at(frame).near for frame in (1, 2, 6)] == [0.001] * 3


def test_what_a_frame_is_made_of() -> None:
    made = series()
    cases = {1: (0,), 1.5: (0, 1), 2: (1,), 6: (5,), 6.5: (4, 5), 0.5: (0, 1), -4: (0, 1)}
    assert {frame: made.sources(frame) for frame in cases} == cases
    assert series(held=True).sources(9) == (5,)
    assert series(1).sources(9) == (0,)
