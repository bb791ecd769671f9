# SPDX-License-Identifier: Apache-2.0
"""Pairs of tile lists that the projection counts (shared/list_counts.h), in every build and group size: the splats of
a projection that does not count, and the lengths of the lists by the radix sorts. There is a case too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import test_project_rays as rays
from pipeline import shaped
from quick import quick

from clsplat.camera import Camera
from clsplat.config.rasterizer import BenchSwitches
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.dropout import Thinning
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.selftest.case import faults
from clsplat.selftest.cases.primitives import LIST_COUNTS_CASE, expected_list_counts, read_list_counts
from clsplat.stages.chunk_lists import ChunkList, padded_chunks
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import upload_gaussians

CONFIGS = {
    "frustum culling off": BenchSwitches(frustum_cull=False),
    "square tile test": BenchSwitches(tile_test="square"),
    "box tile test": BenchSwitches(tile_test="box"),
}
BUILDS = (
    *("plain", "antialiased", "orthographic", "thinned", "chunks", "thinned chunks", "panorama", "panorama chunks"),
    *("fisheye", "antialiased fisheye", *CONFIGS),
)
"""What the kernels are built for. A model of chunks has a last chunk that is not full, and is not projected whole."""


def scene(build: str) -> tuple[Gaussians, Camera]:
    """Gaussians, some of them as wide as the picture and some without a finite colour, and the camera of a build."""
    chunks = build.endswith("chunks")
    count = 2 * CHUNK_ROWS + 100 if chunks else 500
    if build.endswith(("panorama", "panorama chunks", "fisheye")):
        camera = rays.fisheye(300, 250, 180) if build.endswith("fisheye") else rays.panorama(320, 160)
        gaussians = rays.all_around(count, 5)
    else:
        gaussians, camera = scenes.random_cloud(count, 5, 330, 270)
        if build == "orthographic":
            gaussians, camera = scenes.orthographic((gaussians, camera))
    gaussians.log_scales[::25] += 2.0
    gaussians.sh[7::41] = np.nan
    return replace(gaussians, antialiased=build.startswith("antialiased")), camera


def check(device: Device, build: str) -> dict[str, np.ndarray]:
    """Compare the counts of a build with those of the radix sorts. Returns what was counted."""
    gaussians, camera = scene(build)
    rasterizer = Rasterizer(device, CONFIGS.get(build), antialiased=gaussians.antialiased)
    built = rasterizer.device_of(camera)
    model, camera_array, chunks = upload_gaussians(device, gaussians), upload(device, pack_camera(camera)), None
    if build.endswith("chunks"):
        chunks = ChunkList(upload(device, padded_chunks(np.array([0, 2], np.uint32), 3)), model.count)
    thinning = Thinning(0.3, (3, 5)) if build.startswith("thinned") else None
    got = read_list_counts(built, Workspace(device), model, camera, camera_array, thinning, chunks)()
    for name, each in expected_list_counts(got).items():
        assert each.error_of(got[name]) == 0, f"{build}: {name}"
    return got


@pytest.mark.parametrize("items", quick((1, 2, 32, 64, 128, 256), 64))
@pytest.mark.parametrize("build", quick(BUILDS, "plain", "thinned chunks", "panorama", "frustum culling off"))
def test_counts_are_the_lengths_of_the_lists(device: Device, build: str, items: int) -> None:
    got = check(shaped(device, 1, items), build)
    counts = got["tile_counts"]
    assert counts.max() > 64, "boxes that a group shares"
    assert (counts == 1).any() and (counts == 0).any()


def test_vectors_do_not_count(device: Device) -> None:
    """A shape of several lanes counts a Gaussian an item."""
    check(shaped(device, 4, 64), "plain")


def test_the_case_finds_a_wrong_count(default_device: Device) -> None:
    device, given = shaped(default_device, 1, 64), LIST_COUNTS_CASE.random(np.random.default_rng(2), 300)
    assert faults(LIST_COUNTS_CASE.errors(device, given)) == []
    read = LIST_COUNTS_CASE.launch(device, Workspace(device), given)()
    for name in ("lengths", "slots", "sums"):
        spoilt = {key: values.copy() for key, values in read.items()}
        spoilt[name].flat[-1] += 1
        assert LIST_COUNTS_CASE.twin(given, spoilt)[name].error_of(spoilt[name]) == 1
