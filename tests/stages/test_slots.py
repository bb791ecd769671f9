# SPDX-License-Identifier: Apache-2.0
"""Launches over slots of a pool, which have the chunks of a model in any order: the rows of launches over the model's
chunks, to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_same_bits
from numpy.typing import NDArray
from quick import quick

from clsplat.camera import Camera
from clsplat.chunks.store import ChunkStore
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS, SLOT_PLAIN, SPLAT
from clsplat.optimisation.dropout import Thinning
from clsplat.selftest.case import fresh_readback
from clsplat.stages.adam import AdamStep
from clsplat.stages.bounds import bounds
from clsplat.stages.catch_up import StepTable, catch_up, step_table
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers, send_chunks
from clsplat.stages.chunk_pool import ChunkPool
from clsplat.stages.density import (
    add_statistics,
    new_statistics,
    new_values,
    pooled_statistics,
    statistics_fields,
)
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import (
    CopiedRows,
    DeviceGaussians,
    HostGaussians,
    by_field,
    chunk_parts,
    fields_of,
    host_gaussians,
    parts,
    pooled,
    to_device,
)
from clsplat.stages.project import Projected, Screen, Slots, ViewSlots, project, project_step

COUNT = 5 * CHUNK_ROWS + 77
LISTED = np.array([0, 2, 3, 5], np.uint32)
"""Chunks over which launches run; the last one has 77 rows."""
WRITTEN = [column for column, name in enumerate(SPLAT) if name != "UNUSED"]
RATES = {group: 10.0**-index for index, group in enumerate(PARAMETER_GROUPS, 2)}
Models = tuple[DeviceGaussians, ...]


class Model:
    """A model with moments, whole on the device, and streamed through a pool."""

    def __init__(self, device: Device, slots: int = 5) -> None:
        self.device, self.work, rng = device, Workspace(device), np.random.default_rng(3)
        gaussians, self.camera = scenes.random_cloud(COUNT, 7, 150, 90, degree=2)
        moments = []
        for low, high in ((-0.1, 0.1), (1e-4, 0.1)):
            made = {group: rng.uniform(low, high, shape) for group, shape in group_shapes(COUNT, 9).items()}
            sh = np.concatenate([made["sh_dc"][:, None], made["sh_rest"]], axis=1)
            groups = ("means", "quaternions", "log_scales", "opacity_logits")
            moments.append(Gaussians(*(made[group].astype(np.float32) for group in groups), sh.astype(np.float32)))
        host = [host_gaussians(each, COUNT) for each in (gaussians, *moments)]
        self.whole: Models = tuple(to_device(device, each) for each in host)
        store = ChunkStore(COUNT, fields_of(9) | statistics_fields(contributions=True))
        CopiedRows(by_field(host), values=new_values()).to_store(store)
        self.pool = ChunkPool(device, store, slots * CHUNK_ROWS)
        self.streamed: tuple[HostGaussians, ...] = pooled(self.pool, 9)
        self.chunks = send_chunks(self.work, "chunks", LISTED, COUNT)

    def both(self) -> list[tuple[Models, ChunkList]]:
        """The whole model and its chunks; the rows of the slots and a list of slots."""
        self.pool.place(np.array([4, 5, 1, 3]), changes=False)
        self.slots = self.pool.place(LISTED, changes=True)
        assert (np.diff(self.slots.astype(int)) < 0).any(), "the slots rise"
        slots = send_chunks(self.work, "slots", self.slots, self.pool.rows, self.pool.store.starts[LISTED])
        return [(self.whole, self.chunks), (tuple(model.in_pool for model in self.streamed), slots)]

    def check(self) -> None:
        """Compare all rows of parameters and moments."""
        for kind, (whole, streamed) in enumerate(zip(self.whole, self.streamed, strict=True)):
            for group in PARAMETER_GROUPS:
                assert_same_bits(streamed[group].get(), whole[group].get(), f"{kind} {group}")


def seen(
    device: Device, model: DeviceGaussians, chunks: ChunkList, camera: Camera, thinning: Thinning | None = None
) -> tuple[DeviceArray, Projected]:
    camera_array = upload(device, pack_camera(camera))
    return camera_array, project(device, Workspace(device), model, camera, camera_array, thinning, chunks)


def made_slots(device: Device, counts: NDArray[np.uint32]) -> Slots:
    """A slot for each Gaussian with tiles, and none for the others."""
    values = np.random.default_rng(5).standard_normal((len(counts), SLOT_PLAIN)).astype(np.float32)
    starts = np.cumsum(counts, dtype=np.int64) - counts
    every = np.repeat(values, counts.astype(np.int64), axis=0)
    return Slots(upload(device, every), upload(device, starts.astype(np.uint32)))


def test_bounds(shaped_device: Device) -> None:
    """Of the last chunk too, behind whose rows the slot has copies of one."""
    model = Model(shaped_device)
    wanted, got = (bounds(shaped_device, model.work, each[0], chunks) for each, chunks in model.both())
    assert np.isfinite(wanted[: len(LISTED)]).all()
    assert_same_bits(got, wanted)


@pytest.mark.parametrize("thinning", [None, Thinning(0.4, (3, 4))])
@pytest.mark.parametrize("projection", quick(["perspective", "fisheye"], "perspective"))
def test_projection(shaped_device: Device, projection: str, thinning: Thinning | None) -> None:
    """Thinning goes by a row's number in the model."""
    model = Model(shaped_device)
    camera = model.camera if projection == "perspective" else replace(model.camera, projection=projection)
    device = shaped_device if projection == "perspective" else shaped_device.with_switches(camera.model.defines)
    (_, wanted), (_, got) = (seen(device, each[0], chunks, camera, thinning) for each, chunks in model.both())
    counts = wanted.tile_counts.get()
    assert (counts > 0).sum() > 100
    assert_same_bits(got.tile_counts.get(), counts)
    shown = np.flatnonzero(counts)
    assert shown.max() < 3 * CHUNK_ROWS + 77, "a row behind the model's last one is shown"
    assert_same_bits(got.splats.get()[shown][:, WRITTEN], wanted.splats.get()[shown][:, WRITTEN])


@pytest.mark.parametrize("sparse", quick([False, True], False))
def test_a_step_of_adam(shaped_device: Device, *, sparse: bool) -> None:
    """And its statistics."""
    model, results = Model(shaped_device), []
    whole = new_statistics(shaped_device, COUNT, contributions=True)
    streamed = pooled_statistics(model.pool)
    before = model.whole[0]["means"].get()
    step = AdamStep(OptimiserConfig(sparse=sparse), 6, RATES)
    for (models, chunks), statistics in zip(model.both(), (whole, streamed.on_device), strict=True):
        camera_array, projected = seen(shaped_device, models[0], chunks, model.camera)
        screen = Screen(upload(shaped_device, np.zeros((chunks.rows, 2), np.float32)))
        slots, readback = made_slots(shaped_device, projected.tile_counts.get()), fresh_readback(shaped_device)
        project_step(shaped_device, step, models, ViewSlots(camera_array, projected, slots), screen, readback)
        add_statistics(shaped_device, statistics, model.camera, projected, screen)
        results.append({"screen": screen.gradients.get(), "readback": readback.get()})
    moved = np.flatnonzero((model.whole[0]["means"].get() != before).any(axis=1))
    assert set((moved // CHUNK_ROWS).tolist()) == set(LISTED.tolist())
    for result, statistics in zip(results, (whole, streamed), strict=True):
        result |= {name: array.get() for name, array in statistics.named().items()}
    assert results[0]["seen"].sum() > 100
    assert np.isinf(results[0]["whole_totals"]).all()
    for name, values in results[0].items():
        assert_same_bits(results[1][name], values, name)
    model.check()


def test_catching_up(shaped_device: Device) -> None:
    """Each chunk by another number of steps; a second call changes nothing."""
    model, config = Model(shaped_device), OptimiserConfig()
    steps = [AdamStep(config, number, RATES) for number in range(4, 10)]
    table = StepTable(upload(shaped_device, step_table(steps)), 4)
    last = np.full(model.chunks.numbers.shape, 9, np.uint32)
    last[: len(LISTED)] = [3, 8, 5, 4]
    caught = upload(shaped_device, np.zeros(6, np.uint32))
    for _ in range(2):
        for (models, chunks), noted in zip(model.both(), (caught, model.pool.caught), strict=True):
            readback = fresh_readback(shaped_device)
            given = (upload(shaped_device, last), noted, 9, table, readback)
            catch_up(shaped_device, config, models, chunks, *given)
            assert not readback.get().any()
        model.check()
    assert model.pool.caught.get()[model.slots].tolist() == [9] * len(LISTED)
    assert caught.get().tolist() == [9, 0, 9, 9, 0, 9]


@pytest.mark.parametrize("slots", quick([1, 3], 3))
def test_more_chunks_than_slots(shaped_device: Device, slots: int) -> None:
    """A projection and a step, some chunks at a time."""
    model, step = Model(shaped_device, slots), AdamStep(OptimiserConfig(), 6, RATES)
    camera_array = upload(shaped_device, pack_camera(model.camera))
    numbers = ChunkNumbers(LISTED)
    for thinning in (Thinning(0.4, (3, 4)), None):
        _, whole = seen(shaped_device, model.whole[0], model.chunks, model.camera, thinning)
        work = Workspace(shaped_device)
        some = project(shaped_device, work, model.streamed[0], model.camera, camera_array, thinning, numbers)
        counts = whole.tile_counts.get()
        assert_same_bits(some.tile_counts.get(), counts[: numbers.rows])
    pairs, readback = made_slots(shaped_device, counts), fresh_readback(shaped_device)
    screen = Screen(upload(shaped_device, np.zeros((len(counts), 2), np.float32)))
    project_step(shaped_device, step, model.whole, ViewSlots(camera_array, whole, pairs), screen, readback)
    listed = []
    for start, stop, part, chunks in chunk_parts(model.work, numbers, *model.streamed, changes=True):
        of_part = LISTED[start // CHUNK_ROWS : stop // CHUNK_ROWS]
        assert (model.pool.slots_of(of_part) == chunks.numbers.get()).all()
        listed += of_part.tolist()
        projected = replace(some.rows(start, stop), chunks=chunks)
        view, of_screen = (
            ViewSlots(camera_array, projected, pairs.rows(start, stop)),
            screen.gradients.rows(start, stop),
        )
        project_step(shaped_device, step, part, view, Screen(of_screen), readback)
    assert sorted(listed) == LISTED.tolist()
    assert not readback.get().any()
    model.check()


@pytest.mark.parametrize("slots", [1, 4, 6])
def test_parts_of_a_streamed_model(default_device: Device, slots: int) -> None:
    """All rows in order, as many chunks at a time as there are slots, whatever the slots had before; changes stay."""
    model, begins = Model(default_device, slots), []
    model.pool.place(np.array([5]), changes=False)
    for start, stop, part in parts(model.work, *model.streamed, keep=True):
        begins.append(start)
        for of_part, whole in zip(part, model.whole, strict=True):
            assert of_part.count == stop - start
            for group in PARAMETER_GROUPS:
                assert_same_bits(of_part[group].get(), whole[group].get_rows(start, stop), group)
        part[1]["sh_rest"].set(-part[1]["sh_rest"].get())
    assert begins == list(range(0, COUNT, CHUNK_ROWS * slots))
    assert stop == COUNT
    model.whole[1]["sh_rest"].set(-model.whole[1]["sh_rest"].get())
    model.check()
