# SPDX-License-Identifier: Apache-2.0
"""Chunks found in view by way of groups of chunks, against a look at each chunk."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import scenes
from stress_culling import KINDS, rows_of

from clsplat.arrays import Bool, Float32, Float64
from clsplat.camera import Camera
from clsplat.chunks import bounds_table
from clsplat.chunks.bounds import ChunkBounds, rounded_share
from clsplat.chunks.bounds_table import BoundsTable
from clsplat.chunks.culling import PictureBorders, visible

CHUNKS = 1003
"""Chunks of a table. The last group of each level has fewer members than others."""
UPDATES = 40


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds_table, "GROUP", 4)
    monkeypatch.setattr(bounds_table, "MOST_ON_TOP", 20)


def of(numbers: np.ndarray) -> np.ndarray:
    return np.asarray(numbers, np.uint32)


def boxes(rng: np.random.Generator, camera: Camera) -> Float32:
    """Bounds (CHUNKS, 7), most at a border of the picture: runs of chunks with the same place, or near each other."""
    means, _, log_scales, _, distances = rows_of(rng, camera, CHUNKS)
    run = np.arange(CHUNKS) // 11 * 11
    apart = distances[run, None] * 10.0 ** rng.uniform(-9, 0, (CHUNKS, 1)) * rng.choice([0.0, 1.0], (CHUNKS, 1))
    lowest = means.min(axis=1)[run] + apart * rng.standard_normal((CHUNKS, 3))
    side = np.ptp(means, axis=1)[run] * rng.choice([0.0, 1e-3, 1.0], (CHUNKS, 1))
    largest = log_scales.max(axis=(1, 2))[run] + rng.normal(0, 0.3, CHUNKS)
    return np.column_stack([lowest, lowest + side, largest]).astype(np.float32)


def each_chunk(found: Float32, moved: Float64, picture: PictureBorders) -> np.ndarray:
    """The chunks in view, each looked at."""
    rows = found.astype(np.float64)
    bounds = ChunkBounds.of_sides(rows[:, :3], rows[:, 3:6], rows[:, 6]).with_rounding(UPDATES)
    bounds = bounds.widened(*(rounded_share(UPDATES) * moved))
    return np.flatnonzero(visible(picture, bounds))


class Looks:
    """`visible` of a picture, which counts the chunks and groups that are looked at."""

    def __init__(self, picture: PictureBorders) -> None:
        self.picture, self.number = picture, 0

    def __call__(self, bounds: ChunkBounds) -> Bool:
        self.number += len(bounds)
        return visible(self.picture, bounds)


NONE_MISSED = np.zeros((2, CHUNKS))


@pytest.mark.parametrize("kind", KINDS)
def test_the_chunks_are_those_of_a_look_at_each(kind: str) -> None:
    """Of any camera, with movements of each chunk and with bounds of all sorts."""
    rng = np.random.default_rng(sum(kind.encode()))
    kept = 0
    for case in range(24):
        camera = KINDS[kind](rng)
        found = boxes(rng, camera)
        if case % 4 == 1:
            found[rng.integers(CHUNKS, size=9), rng.integers(7, size=9)] = rng.choice([np.nan, np.inf, -np.inf], 9)
        if case % 4 == 2:
            found[rng.integers(CHUNKS, size=9), 6] = rng.choice([20.0, 100.0, 800.0], 9)
        scale = np.array([[10.0 ** rng.uniform(-6, 0)], [0.1]]) * (case % 3 > 0)
        moved, hidden = scale * rng.random((2, CHUNKS)), scale * rng.random((2, CHUNKS))
        table = BoundsTable(CHUNKS, UPDATES)
        table.measure(of(np.arange(CHUNKS)), found)
        table.move(of(np.arange(CHUNKS)), moved)
        picture = PictureBorders.of(camera)
        got = table.seen(
            partial(visible, picture),
            lambda chunks, by=hidden: by[:, chunks],
            hidden.max(axis=1, keepdims=True),
        )
        np.testing.assert_array_equal(got, each_chunk(found, moved + hidden, picture))
        kept += len(got)
    assert 0.1 * 60 * CHUNKS < kept < 0.9 * 60 * CHUNKS


def beside_and_in_view() -> tuple[Float32, Float32, PictureBorders]:
    """Bounds (7,) of a small box far beside a picture, and of one in it."""
    camera = scenes.tilted_camera(640, 400)
    places = [np.linalg.inv(camera.rotation) @ (place - camera.translation) for place in ([900.0, 0, 5], [0.0, 0, 5])]
    beside, inside = (np.append(np.tile(place, 2), -3.0).astype(np.float32) for place in places)
    return beside, inside, PictureBorders.of(camera)


def test_chunks_that_are_not_measured_are_in_view() -> None:
    beside, _, picture = beside_and_in_view()
    table, looks = BoundsTable(CHUNKS, 0), Looks(picture)
    assert len(table.seen(looks)) == CHUNKS
    numbers = of(np.delete(np.arange(CHUNKS), [500, 1002]))
    table.measure(numbers, np.tile(beside, (len(numbers), 1)))
    assert table.seen(looks).tolist() == [500, 1002]


def test_a_chunk_that_comes_into_view_is_found() -> None:
    """After a measurement, a movement, or steps that it has missed; other chunks are not looked at."""
    beside, inside, picture = beside_and_in_view()
    table = BoundsTable(CHUNKS, 0)
    table.measure(of(np.arange(CHUNKS)), np.tile(beside, (CHUNKS, 1)))

    def seen(hidden: Float64 = NONE_MISSED) -> tuple[list[int], int]:
        looks = Looks(picture)
        found = table.seen(looks, lambda chunks: hidden[:, chunks], hidden.max(axis=1, keepdims=True))
        return found.tolist(), looks.number

    assert seen() == ([], 16)
    for chunk in (0, 517, 1002):
        table.measure(of([chunk]), inside[None])
        found, looks = seen()
        assert found == [chunk]
        assert looks <= 16 + 3 * 4
        table.measure(of([chunk]), beside[None])
        assert seen() == ([], 16)
        table.move(of([chunk]), np.array([[100.0], [0.0]]))
        assert seen()[0] == []
        table.move(of([chunk]), np.array([[900.0], [0.0]]))
        assert seen()[0] == [chunk]
        table.measure(of([chunk]), beside[None])
        assert seen() == ([], 16)
        missed = np.zeros((2, CHUNKS))
        missed[1, chunk] = 10.0
        assert seen(missed)[0] == [chunk]


def test_a_model_without_chunks() -> None:
    beside, _, picture = beside_and_in_view()
    table = BoundsTable(0, 0)
    table.measure(of([]), beside[None][:0])
    table.move(of([]), np.zeros((2, 0)))
    assert len(table.seen(Looks(picture))) == 0
