# SPDX-License-Identifier: Apache-2.0
"""Bounds of chunks, and launches over some chunks of a model: the rows of a launch over the whole model, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from numpy.typing import NDArray
from pipeline import BACKGROUND
from quick import quick

from clsplat.camera import Camera
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians
from clsplat.layouts.columns import CHUNK_ROWS, READBACK, SPLAT, SlotFields
from clsplat.optimisation.dropout import Thinning
from clsplat.reference import bounds as reference
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.adam import AdamStep
from clsplat.stages.bounds import bounds
from clsplat.stages.chunk_lists import ChunkList, send_chunks
from clsplat.stages.density import add_contributions, add_statistics, new_statistics
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians
from clsplat.stages.project import ViewSlots, project, project_step

COUNTS = (1, CHUNK_ROWS - 1, CHUNK_ROWS, CHUNK_ROWS + 1, 5 * CHUNK_ROWS + 77)
SHOWN = np.array([0, 2, 5], np.uint32)
"""Chunks of the largest model that its camera shows. The last one has 77 rows."""
FIELDS = SlotFields(absolute=True, contributions=True)
WRITTEN = [column for column, name in enumerate(SPLAT) if name != "UNUSED"]


def chunk_list(work: Workspace, numbers: NDArray[np.uint32], rows: int) -> ChunkList:
    return send_chunks(work, "chunks", np.asarray(numbers, np.uint32), rows)


def cloud() -> tuple[Gaussians, Camera]:
    """Gaussians of which those in the chunks of SHOWN are in view."""
    gaussians, camera = scenes.random_cloud(COUNTS[-1], 7, 150, 90, degree=2)
    hidden = ~np.isin(np.arange(COUNTS[-1]) // CHUNK_ROWS, SHOWN)
    gaussians.means[hidden] -= 100 * camera.rotation[2].astype(np.float32)
    return gaussians, camera


def rows_of(numbers: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Rows of the largest model in these chunks."""
    every = np.arange(COUNTS[-1])
    return every[np.isin(every // CHUNK_ROWS, numbers)]


@pytest.mark.parametrize("count", quick(COUNTS, *COUNTS))
def test_bounds_are_those_of_numpy(shaped_device: Device, count: int) -> None:
    gaussians, _ = scenes.random_cloud(count, 3, 70, 50, degree=0)
    gaussians.means[::7] *= 100
    if count > 1:
        gaussians.means[1], gaussians.log_scales[count // 2] = np.nan, np.nan
    held, work = upload_gaussians(shaped_device, gaussians), Workspace(shaped_device)
    chunks = -(-count // CHUNK_ROWS)
    got = bounds(shaped_device, work, held, chunk_list(work, np.arange(chunks), count))
    assert_same_bits(got[:chunks], reference.bounds(gaussians.means, gaussians.log_scales).astype(np.float32))


def test_bounds_of_some_chunks_and_of_none(shaped_device: Device) -> None:
    gaussians, _ = cloud()
    gaussians.means[3 * CHUNK_ROWS : 4 * CHUNK_ROWS] = np.nan
    held, work = upload_gaussians(shaped_device, gaussians), Workspace(shaped_device)
    every = reference.bounds(gaussians.means, gaussians.log_scales).astype(np.float32)
    got = bounds(shaped_device, work, held, chunk_list(work, [1, 3, 5], len(gaussians)))
    assert_same_bits(got, every[[1, 3, 5]])
    assert np.isinf(got[1, :6]).all()
    assert not np.isfinite(bounds(shaped_device, work, held, chunk_list(work, [], len(gaussians)))).any()


def test_lists_have_few_lengths(device: Device) -> None:
    work, lengths = Workspace(device), set()
    for count in range(1, 1025):
        chunks = chunk_list(work, np.arange(count), 1 << 20)
        length = chunks.numbers.shape[0]
        assert count <= length <= count * 5 / 4
        assert chunks.rows == CHUNK_ROWS * length
        lengths.add(length)
    assert len(lengths) <= 8 + 4 * 8


@pytest.mark.parametrize("thinned", [False, True])
def test_projection_of_some_chunks(shaped_device: Device, *, thinned: bool) -> None:
    gaussians, camera = cloud()
    rasterizer, work = Rasterizer(shaped_device), Workspace(shaped_device)
    held = upload_gaussians(shaped_device, gaussians)
    camera_array, _ = rasterizer.send(camera, np.zeros(3, np.float32))
    thinning = Thinning(0.4, (3, 4)) if thinned else None
    whole = project(shaped_device, work, held, camera, camera_array, thinning)
    counts, splats = whole.tile_counts.get(), whole.splats.get()
    assert (counts > 0).sum() > 100
    for numbers in (SHOWN, np.array([1, 2], np.uint32), np.array([5], np.uint32), np.zeros(0, np.uint32)):
        chunks = chunk_list(work, numbers, len(gaussians))
        some = project(shaped_device, Workspace(shaped_device), held, camera, camera_array, thinning, chunks)
        rows, got = rows_of(numbers), some.tile_counts.get()
        assert got.shape == (chunks.rows,)
        assert_same_bits(got[: len(rows)], counts[rows])
        assert not got[len(rows) :].any(), "rows past the model have no tiles"
        shown = np.flatnonzero(counts[rows])
        assert_same_bits(some.splats.get()[shown][:, WRITTEN], splats[rows[shown]][:, WRITTEN])


@pytest.mark.parametrize("optimiser", [OptimiserConfig(sparse=True), OptimiserConfig(sparse=True, sh_rest_every=3)])
def test_a_step_over_the_chunks_in_view(shaped_device: Device, optimiser: OptimiserConfig) -> None:
    """Model, moments, statistics and counts, after a sparse step over all rows and one over the chunks in view."""
    gaussians, camera = cloud()
    results = []
    for numbers in (None, SHOWN, np.array([0, 1, 2, 5], np.uint32)):
        rasterizer = Rasterizer(shaped_device)
        rng = np.random.default_rng(1)
        model = (
            upload_gaussians(shaped_device, gaussians),
            *(allocate_gaussians(shaped_device, len(gaussians), 9) for _ in "mv"),
        )
        for each, low in zip(model[1:], (-0.1, 0.0), strict=True):
            for group in PARAMETER_GROUPS:
                each[group].set(rng.uniform(low, 0.1, each[group].shape).astype(np.float32))
        chunks = None if numbers is None else chunk_list(rasterizer.work, numbers, len(gaussians))
        background = upload(shaped_device, np.array(BACKGROUND, np.float32))
        frame = rasterizer.forward(model[0], camera, background, chunks=chunks)
        image_gradient = upload(shaped_device, rng.normal(0, 1, frame.blended.image.shape).astype(np.float32))
        slots = rasterizer.pair_gradients(frame, image_gradient, fields=FIELDS)
        rows = len(gaussians) if chunks is None else chunks.rows
        screen = rasterizer.screen(rows, FIELDS)
        readback = upload(shaped_device, np.zeros(len(READBACK), np.uint32))
        step = AdamStep(optimiser, 6, {group: 10.0**-index for index, group in enumerate(PARAMETER_GROUPS, 1)})
        view = (ViewSlots(frame.camera_array, frame.projected, slots), screen, readback)
        project_step(shaped_device, step, model, *view)
        statistics = new_statistics(shaped_device, len(gaussians), contributions=True)
        statistics.current_totals.fill(1.0)
        statistics.current_largest.fill(0.0)
        add_statistics(shaped_device, statistics, camera, frame.projected, screen)
        add_contributions(shaped_device, statistics, frame.projected, screen.contributions, 2.0)
        arrays = {f"{k} {group}": each[group].get() for k, each in enumerate(model) for group in PARAMETER_GROUPS}
        arrays |= {name: array.get() for name, array in statistics.named().items()}
        results.append({**arrays, "image": frame.blended.image.get(), "readback": readback.get()})
    moved = (results[0]["0 means"] != gaussians.means).any(axis=1)
    assert moved.sum() > 100
    assert results[0]["seen"].sum() >= moved.sum()
    for other in results[1:]:
        for name, values in results[0].items():
            assert_same_bits(other[name], values, name)
