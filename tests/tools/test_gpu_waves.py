# SPDX-License-Identifier: Apache-2.0
"""Counts of waves of neighbouring Gaussians, for the model of a GPU's step."""

from __future__ import annotations

import numpy as np
import pytest
from gpu_waves import FORESHORTENED, REFINE_FROM, WAVE, refined, spans, waves_in, widths

from clsplat.bench.workload import Subject, synthetic
from clsplat.camera import Camera
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.device.source import kernel_root
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import SPLAT
from clsplat.rendering.rasterizer import Rasterizer
from clsplat.stages.device_gaussians import upload_gaussians

CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0, np.eye(3), np.zeros(3))


def test_tiles_of_each_row_are_the_kernels(default_device: Device) -> None:
    """Of boxes that are listed whole, and of larger ones, whose rows are tested."""
    subject = synthetic(400, 320, 240)
    frame = Rasterizer(default_device).forward(
        upload_gaussians(default_device, subject.gaussians),
        subject.camera,
        upload(default_device, np.zeros(3, np.float32)),
        backward=False,
    )
    splats, pairs = frame.projected.splats.get(), frame.projected.tile_counts.get()
    rows, boxes = spans(splats, pairs > 0, (20, 15))
    assert (boxes > 16).sum() > 50
    of_row = widths(splats, rows, boxes, (20, 15))
    assert (boxes >= pairs).all()
    assert (of_row.sum(1) != pairs).mean() < 0.01, "float64 here rounds differently at a tile's edge"
    assert ((of_row > 0).sum(1) <= rows).all()


def test_waves_of_a_frame() -> None:
    """Gaussians of 1 and 3 x 2 tiles, one of 7 x 6, which is wide, and one that is culled; the last alone in a wave."""
    splats = np.zeros((33, len(SPLAT)), np.float32)
    column = {name: SPLAT.index(name) for name in ("PIXEL_X", "PIXEL_Y", "HALF_W", "HALF_H", "L11", "L22", "DEPTH")}
    given = [(8, 8, 4, 4), (24, 16, 17, 4), (8, 8, 1000, 1000), (8, 8, 4, 4)]
    for place, at in enumerate(given):
        splats[place, list(column.values())] = (*at, 1, 1, 5 + place)
    splats[32, list(column.values())] = (104, 96, 50, 47, 1, 1, 1)  # narrow in each row but those at its middle
    pairs = np.zeros(33, np.int64)
    pairs[[0, 1, 3, 32]] = (1, 6, 1, 20)
    refines = np.arange(33) == 32
    found = waves_in(refines, splats, pairs, (20, 20))
    (of_wide,) = widths(splats[32:], np.array([6]), np.array([42]), (20, 20))
    assert (of_wide <= 7).all()
    assert of_wide.sum() < 42
    assert found == {
        "refined": 0.5,
        "wave_rows": 1.0,  # 2 in the first wave, and none in the second
        "wave_tested": 0.0,
        "wave_tiles": 3.0,  # in two rows of three
        "own_pairs": 4.0,
        "all_tested": 3.0,
        "all_pairs": 13.0,
        "sorted_rows": 6.0,  # all four are in one wave
        "sorted_tested": 6.0,
        "sorted_tiles": float(np.maximum(of_wide, [3, 3, 0, 0, 0, 0]).sum()),
        "wide": round(1 / 33, 6),
        "wide_rows": 6.0,
        "wide_columns": 7.0,
    }


@pytest.mark.parametrize(
    ("mean", "log_scales", "refines"),
    [
        ((0, 0, 4), (-3.0, -3.0, -3.0), False),
        ((0, 0, 4), (1.5, -9.0, -9.0), True),  # its short axis is the low-pass alone
        ((0, 0, 4), (-3.0, -9.0, -9.0), False),
        ((0, 0, -4), (1.5, -9.0, -9.0), False),
    ],
    ids=["round", "needle", "short needle", "behind"],
)
def test_thin_gaussians_are_refined(mean: tuple[float, ...], log_scales: tuple[float, ...], refines: bool) -> None:
    turned = np.array([[0.92, 0.2, 0.3, 0.1]], np.float32)
    single = np.float32([[0]])
    gaussians = Gaussians(
        np.float32([mean]), turned, np.float32([log_scales]), single[0], np.zeros((1, 1, 3), np.float32)
    )
    assert refined(Subject("one", gaussians, CAMERA)).tolist() == [refines]


def test_an_axis_along_the_view_is_refined() -> None:
    plain = np.array([[1, 0, 0, 0]], np.float32)
    gaussians = Gaussians(
        np.float32([[0, 0, 4]]),
        plain,
        np.float32([[-3, -3, -3]]),
        np.zeros(1, np.float32),
        np.zeros((1, 1, 3), np.float32),
    )
    assert refined(Subject("one", gaussians, CAMERA)).tolist() == [True]


def test_sizes_are_the_kernels() -> None:
    text = (kernel_root() / "shared/place.h").read_text()
    assert f"#define REFINE_FROM {REFINE_FROM}f\n" in text
    assert f"#define FORESHORTENED {FORESHORTENED}f\n" in text
    assert WAVE == 32
