# SPDX-License-Identifier: Apache-2.0
"""sampling.cl against its twin, and the scales that it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close
from test_project_rays import all_around, fisheye, panorama

from clsplat.camera import Camera
from clsplat.device.buffers import Workspace, allocate
from clsplat.device.context import Device
from clsplat.reference.sampling import sampling_limits as twin
from clsplat.stages.device_camera import upload_cameras
from clsplat.stages.device_gaussians import host_gaussians, upload_gaussians
from clsplat.stages.sampling import limit_scales, sampling_limits


def cameras() -> list[Camera]:
    """One that sees all, one from nearer by, with a longer lens, that sees a part."""
    _, camera = scenes.random_cloud(1, 3, 48, 32)
    nearer = replace(camera, translation=camera.translation - [0.3, 0.1, 0.5], fx=3 * camera.fx, fy=2 * camera.fy)
    return [camera, nearer]


def rays() -> list[Camera]:
    """A fisheye with coefficients, one without, and a panorama that sees only what is farther than the others."""
    bent = replace(fisheye(60, 50, 190), radial=(0.04, -0.012, 0.004, -0.0006))
    return [bent, replace(fisheye(40, 40, 120), fy=30.0), replace(panorama(70, 35), near=4.0)]


@pytest.mark.parametrize("several", [rays, lambda: rays()[:1], lambda: [*cameras(), *rays()[:2]]])
def test_of_other_projections(device: Device, several: Callable[[], list[Camera]]) -> None:
    gaussians = all_around(300, 5)
    wanted = twin(gaussians.means.astype(np.float64), several())
    held, work, least = upload_gaussians(device, gaussians), Workspace(device), allocate(device, (300,), np.float32)
    sampling_limits(device, work, held, upload_cameras(device, several()), least)
    got, seen = least.get(), np.isfinite(wanted)
    assert seen.sum() > 50
    assert np.array_equal(seen, got > -1e29)
    assert_close(got[seen], wanted[seen], absolute=1e-5)  # as below; angles are good to 1e-7


@pytest.mark.parametrize("count", [1, 63, 64, 65, 300])
def test_the_least_scales(device: Device, count: int) -> None:
    gaussians, _ = scenes.random_cloud(count, 3, 48, 32)
    gaussians.means[0] = [1e3, 1e3, -1e3]  # in no picture
    gaussians.log_scales[1:2] = -20.0
    wanted = twin(gaussians.means.astype(np.float64), cameras())
    held, work, least = upload_gaussians(device, gaussians), Workspace(device), allocate(device, (count,), np.float32)
    sampling_limits(device, work, held, upload_cameras(device, cameras()), least)
    got = least.get()
    assert not np.isfinite(wanted[0])
    assert got[0] < -1e29
    assert_close(got[1:], wanted[1:], absolute=1e-5)  # three sums of four terms, and a logarithm
    assert count < 100 or np.isfinite(wanted[1:]).all()
    limit_scales(device, work, held, least)
    assert np.array_equal(held["log_scales"].get(), np.maximum(gaussians.log_scales, got[:, None]))


def test_a_model_on_the_host(default_device: Device) -> None:
    """In pieces, to the same bits."""
    gaussians, _ = scenes.random_cloud(300, 3, 48, 32)
    results = []
    rows = default_device.row_alignment
    for model in (upload_gaussians(default_device, gaussians), host_gaussians(gaussians, rows)):
        work, least = Workspace(default_device), allocate(default_device, (300,), np.float32)
        sampling_limits(default_device, work, model, upload_cameras(default_device, cameras()), least)
        limit_scales(default_device, work, model, least)
        results.append((least.get(), model["log_scales"].get()))
    for one, other in zip(*results, strict=True):
        assert np.array_equal(one, other)
