# SPDX-License-Identifier: Apache-2.0
"""Deep pictures of a shutter, a lens and an STMap: over each other the flat picture, at each depth the mean of the
samples'."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_same_bits
from quick import quick
from slices import flattened, in_front

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.pictures import ColourConfig, PictureConfig, SamplingConfig
from clsplat.frame.lens import ByMap, Warp
from clsplat.frame.pipeline import FramePipeline, FrameRequest
from clsplat.frame.samples import sample_cameras
from clsplat.gaussians import Gaussians
from clsplat.images.stmap import StMap
from clsplat.rendering.renderer import Renderer

BINS = 12
LINEAR = ColourConfig(colorspace="lin_rec709", model_colorspace="lin_rec709")
"""Then slices over each other are the flat picture: a curve of each slice's colours is none of their sum's."""
SCENE = scenes.random_cloud(1500, 8, 80, 60)
KINDS = {
    "shutter": SamplingConfig(5, shutter_angle=180),
    "lens": SamplingConfig(7, aperture=0.05, focus=3.0),
    "both, more than are merged at once": SamplingConfig(
        21, shutter_open=0.0, shutter_close=0.5, aperture=0.03, focus=2.5
    ),
}


def moving(time: float) -> Camera:
    """The scene's camera, which goes sideways."""
    camera = SCENE[1]
    return replace(camera, translation=camera.translation + np.array([0.3 * time, 0, 0]))


def shifted_map(width: int, height: int, zoom: float = 1.0) -> StMap:
    """Bends nothing, but for a part of a pixel, a zoom and a corner where nothing is seen."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    places = np.stack([0.5 + (x - 0.5) * zoom + 0.3 / width, 1 - (0.5 + (y - 0.5) * zoom)], axis=2).astype(np.float32)
    places[:8, :8] = np.nan
    return StMap(places, 0, 0, width, height, "")


def deep(
    pipeline: FramePipeline,
    camera: Camera,
    bins: int = BINS,
    at: Callable[[float], Camera] = moving,
    lens: ByMap | None = None,
) -> Float32:
    """(bins, H, W, 5)."""
    draw, *_ = pipeline.draw_deep(bins, FrameRequest(at, lens=lens))
    return draw(camera).transpose(0, 2, 3, 1)


def pipeline_of(sampling: SamplingConfig | None = None, gaussians: Gaussians = SCENE[0]) -> FramePipeline:
    config = PictureConfig(LINEAR, sampling=sampling or SamplingConfig())
    return FramePipeline(Renderer(), gaussians, config)


@pytest.mark.parametrize("kind", KINDS)
def test_flattened_it_is_the_mean(kind: str) -> None:
    pipeline, camera = pipeline_of(KINDS[kind]), moving(KINDS[kind].middle)
    slices, draw = deep(pipeline, camera), pipeline.draw(FrameRequest(moving))[0]
    flat = draw(camera, ("rgb", "alpha"))
    wanted = np.concatenate([flat["rgb"], flat["alpha"][:, :, None]], axis=2)
    # each sample's slices lose a few units of 6e-8, and so does each of two merges
    assert_close(flattened(slices), wanted, absolute=4e-6)
    there = slices[..., 3] > 0
    assert (slices[1:, ..., 4] > slices[:-1, ..., 4])[there[1:]].all() and not (there[1:] & ~there[:-1]).any()


@pytest.mark.parametrize("kind", quick(KINDS, next(iter(KINDS))))
def test_at_each_depth_it_is_the_mean_of_the_samples(kind: str) -> None:
    pipeline, camera = pipeline_of(KINDS[kind]), moving(KINDS[kind].middle)
    slices = deep(pipeline, camera)
    fine = [deep(pipeline_of(), each, 128) for each in sample_cameras(moving, KINDS[kind])[1]]
    total, merges = in_front(slices, np.inf), 1 + (len(fine) > 16)
    for depth in np.linspace(1.5, 6, 12):
        wanted = np.mean([in_front(each, float(depth)) for each in fine], axis=0)
        error = np.abs(in_front(slices, float(depth)) - wanted)
        # (74) allows the samples 1 / BINS, each merge as much again, and the finer slices 1 / 128
        assert (error <= (1 + merges) / BINS + 1 / 128 + 1e-5).all()
        assert error[total > 0.1].mean() < 0.02


def test_what_stands_still_stays_what_it_is() -> None:
    """A shutter before a camera that does not move: the slices of one sample, but for those under a slack."""
    still = deep(pipeline_of(SamplingConfig(6, shutter_angle=180)), moving(0), at=lambda _: moving(0))
    one = deep(pipeline_of(), moving(0))
    for depth in np.linspace(1.5, 6, 12):
        error = np.abs(in_front(still, float(depth)) - in_front(one, float(depth)))
        assert error.max() < 1 / (64 * BINS) + 1e-5  # (74): the least slack there is


@pytest.mark.parametrize("kind", ["shutter", "lens"])
def test_windows_have_the_same_bits(kind: str) -> None:
    pipeline, camera = pipeline_of(KINDS[kind]), moving(KINDS[kind].middle)
    whole = deep(pipeline, camera)
    assert_same_bits(deep(pipeline, camera.cropped(19, 21, 40, 30)), whole[:, 21:51, 19:59])


@pytest.mark.parametrize("zoom", [1.0, 1.7], ids=["one place a pixel", "four places"])
def test_bent(zoom: float) -> None:
    pipeline, camera = pipeline_of(), moving(0)
    source = ByMap(shifted_map(camera.width, camera.height, zoom))
    warp = Warp(source, camera)
    slices = deep(pipeline, camera, lens=source)
    assert not slices[:, :8, :8].any()
    # by hand: the mean of bilinear samples of the flat picture
    places, window = warp.of_window(camera)
    assert window is not None and window.window is not None and warp.samples == (1 if zoom == 1 else 2)
    flat = pipeline.draw(FrameRequest(moving))[0](window, ("rgb", "alpha"))
    straight = np.concatenate([flat["rgb"], flat["alpha"][:, :, None]], axis=2).astype(np.float64)
    at = np.nan_to_num(places - (window.window.x, window.window.y) - 0.5)
    x, y = np.floor(at[..., 0]).astype(int), np.floor(at[..., 1]).astype(int)
    u, v = (at[..., 0] - x)[..., None], (at[..., 1] - y)[..., None]
    wanted = (1 - v) * ((1 - u) * straight[y, x] + u * straight[y, x + 1])
    wanted += v * ((1 - u) * straight[y + 1, x] + u * straight[y + 1, x + 1])
    wanted[np.isnan(places[..., 0])] = 0
    k = warp.samples
    wanted = wanted.reshape(camera.height, k, camera.width, k, 4).mean(axis=(1, 3))
    assert_close(flattened(slices), wanted, absolute=4e-6)  # as above
    part = camera.cropped(5, 7, 33, 20)
    assert_same_bits(deep(pipeline, part, lens=source), slices[:, 7:27, 5:38])


def test_bent_and_blurred(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples are merged straight, then bent; in strips it is the same."""
    pipeline, camera = pipeline_of(KINDS["shutter"]), moving(0)
    source = ByMap(shifted_map(camera.width, camera.height))
    slices = deep(pipeline, camera, lens=source)
    flat = pipeline.draw(FrameRequest(moving, lens=source))[0](camera, ("rgb", "alpha"))
    assert np.abs(flattened(slices)[..., 3] - flat["alpha"]).mean() < 0.01  # that is between pixels by a cubic
    for module in ("deep", "strips"):
        monkeypatch.setattr(f"clsplat.frame.{module}.DEEP_MERGE_FLOATS", 1 << 16)
    monkeypatch.setattr("clsplat.frame.deep._WARP_BATCH_PIXELS", 200)
    assert_same_bits(deep(pipeline_of(KINDS["shutter"]), camera, lens=source), slices)
