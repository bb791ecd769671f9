# SPDX-License-Identifier: Apache-2.0
"""Case of the pairs that the projection counts for lists by append (kernels/shared/list_counts.h)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.layouts.columns import SPLAT
from clsplat.optimisation.dropout import Thinning
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, read_of
from clsplat.selftest.cases.steps import random_scene
from clsplat.stages.chunk_lists import ChunkList
from clsplat.stages.device_camera import pack_camera, tiles_of
from clsplat.stages.device_gaussians import DeviceGaussians, upload_gaussians
from clsplat.stages.duplicate import Band, count, duplicate
from clsplat.stages.project import ListCounts, project
from clsplat.stages.ranges import tile_lists


def group_counts(tile_counts: NDArray[np.integer], items: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return `ListCounts.slots` and `ListCounts.sums` for work-groups of `items` work-items.

    tile_counts: (n,), the number of tiles of each Gaussian.
    """
    groups = np.pad(tile_counts.astype(np.int64), (0, -len(tile_counts) % items)).reshape(-1, items)
    before = (np.cumsum(groups, axis=1) - groups).ravel()[: len(tile_counts)]
    return before.astype(np.uint32), groups.sum(axis=1).astype(np.uint32)


def upload_list_counts(
    device: Device, tile_counts: NDArray[np.integer], tile_indices: NDArray[np.integer], tiles: int
) -> ListCounts:
    """Upload the numbers that the projection would count for Gaussians in these tiles.

    tile_counts: (n,), the number of tiles of each Gaussian.
    tile_indices: (pairs,), the tile of each pair, in any order.
    tiles: number of tiles of the image.
    """
    lengths = [*np.bincount(tile_indices, minlength=tiles), np.count_nonzero(tile_counts)]
    arrays = (np.array(lengths, np.uint32), *group_counts(tile_counts, device.shape.items))
    return ListCounts(*(upload(device, array) for array in arrays))


def read_list_counts(
    device: Device,
    work: Workspace,
    model: DeviceGaussians,
    camera: Camera,
    camera_array: DeviceArray,
    thinning: Thinning | None = None,
    chunks: ChunkList | None = None,
) -> Read:
    """Project the model twice: with counts for lists by append, and without. Make the lists of the latter by the radix
    sorts."""
    inputs = (model, camera, camera_array, thinning, chunks)
    counted, plain_work = project(device, work, *inputs, counts_lists=True), Workspace(device)
    plain, tiles = project(device, plain_work, *inputs), tiles_of(camera)
    assert counted.list_counts is not None
    found, band = counted.list_counts, Band(0, tiles[0] * tiles[1])
    totals = count(device, plain_work, plain)
    lists = tile_lists(device, plain_work, duplicate(device, plain_work, plain.splats, totals, tiles, band), band)
    arrays = {
        **{"splats": counted.splats, "tile_counts": counted.tile_counts},
        **{"lengths": found.lengths, "slots": found.slots, "sums": found.sums},
        **{"plain splats": plain.splats, "plain tile_counts": plain.tile_counts, "ranges": lists.ranges},
    }
    if counted.shown is not None and plain.shown is not None:
        arrays |= {"shown": counted.shown, "plain shown": plain.shown}
    return lambda: {**read_of(arrays)(), "items": np.array(device.shape.items), "visible": np.array(totals.visible)}


def expected_list_counts(got: Arrays) -> Mapping[str, Expected]:
    """Expect the splats of the projection that does not count, and the lengths of the lists by the radix sorts.

    got: results of `read_list_counts`. Rows of invisible Gaussians, which are not written, become 0.
    """
    tile_counts, items = got["plain tile_counts"], int(got.pop("items"))
    for name in ("splats", "plain splats"):
        got[name] = np.where((tile_counts > 0)[:, None], got[name], 0)
        got[name][:, SPLAT.index("UNUSED") :] = 0
    slots, sums = group_counts(tile_counts, items)
    lengths = [*np.diff(got.pop("ranges"), axis=1).ravel(), int(got.pop("visible"))]
    wanted = {"lengths": np.array(lengths, np.uint32), "slots": slots, "sums": sums}
    wanted |= {name.removeprefix("plain "): got.pop(name) for name in list(got) if name.startswith("plain ")}
    return {name: exactly(values) for name, values in wanted.items()}


def _random(rng: Generator, rows: int) -> Inputs:
    """A random view of a picture so large that some boxes of tiles are wide."""
    given = random_scene(rng, rows)
    given.camera = Camera(210, 150, 180.0, 195.0, 90.0, 81.0, given.camera.rotation, given.camera.translation)
    return given


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    camera_array = upload(device, pack_camera(given.camera))
    return read_list_counts(device, work, upload_gaussians(device, given.gaussians), given.camera, camera_array)


LIST_COUNTS_CASE = Case(
    sizes=(1, 63, 65, 700, 2, 64, 255, 256, 257, 1025),
    random=_random,
    launch=_launch,
    twin=lambda _, got: expected_list_counts(got),
    digested=("splats", "tile_counts", "lengths"),
)
