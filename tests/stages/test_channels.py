# SPDX-License-Identifier: Apache-2.0
"""features.cl and channels.cl against the float64 twin, closed forms and themselves in other shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from compare import assert_close, assert_same_bits
from numpy.typing import NDArray
from pipeline import Pipeline
from quick import quick

from clsplat.camera import Camera
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.reference import channels as twin
from clsplat.reference import render as reference
from clsplat.stages.channels import Features, Motion, channels, features
from clsplat.stages.device_camera import pack_camera

ALL = Features.of(("normal", "position", "motion", "backward"))
SCENES = {
    "overlap": scenes.NAMED["overlap"],
    "saturating": scenes.NAMED["saturating"],
    "cloud": lambda: scenes.random_cloud(600, 8, 70, 50),
}


def moved(camera: Camera) -> Camera:
    """A step to the side, up and forward, and a little longer a lens."""
    return replace(camera, translation=camera.translation + np.array([-0.07, 0.03, -0.05]), fx=1.02 * camera.fx)


def earlier(camera: Camera) -> Camera:
    """A step to the other side, and a turn."""
    return replace(camera.moved(np.array([0.0, 0.02, -0.01, 0.05, 0.0, 0.03])), cx=camera.cx - 0.5)


def run(device: Device, scene: tuple[Gaussians, Camera], wanted: Features = ALL) -> dict[str, NDArray[np.float32]]:
    """The channels on the host, cropped; (H, W, fields)."""
    pipeline = Pipeline.run(device, scene)
    rasterizer, frame, camera = pipeline.rasterizer, pipeline.frame, pipeline.camera
    device, work = rasterizer.device, rasterizer.work
    after = upload(device, pack_camera(moved(camera)))
    before = upload(device, pack_camera(earlier(camera)))
    motion = Motion(after, before)
    rows = features(device, work, wanted, pipeline.gaussians, frame.camera_array, frame.projected, motion)
    found = channels(device, work, wanted, rows, frame.listed.lists, frame.inputs, frame.blended)
    means, whole = pipeline.crop(found.means.get()), pipeline.crop(found.whole.get())
    result = {name: means[:, :, at : at + width] for name, at, width in fields(wanted)}
    result.update(median=means[:, :, -2], first=means[:, :, -1], count=whole[:, :, 0], index=whole[:, :, 1])
    result["alpha"] = 1 - pipeline.crop(frame.blended.transmittance.get())
    return result


def fields(wanted: Features) -> list[tuple[str, int, int]]:
    widths = {"depth": 1, "normal": 3, "position": 3, "motion": 2, "backward": 2}
    return [(name, at, widths[name]) for name, at in wanted.offsets.items()]


@pytest.mark.parametrize("name", quick(SCENES, "overlap"))
def test_against_the_twin(shaped_device: Device, name: str) -> None:
    gaussians, camera = scene = SCENES[name]()
    got = run(shaped_device, scene)
    forward = reference.forward(gaussians, camera)
    wanted = twin.channels(forward.projected, gaussians, camera, moved(camera), earlier(camera))
    margin = forward.blended.margin
    # Where a Gaussian may be in or out, or another the heaviest, there is nothing to compare.
    sure = (margin > 1e-4) & (wanted.doubt > 1e-5)
    assert sure.mean() > 0.9
    assert_same_bits(got["count"][sure], wanted.count[sure].astype(np.int32))
    assert_same_bits(got["index"][sure], wanted.index[sure].astype(np.int32))
    # Depths of single Gaussians: what float32 leaves of camera coordinates of a few units.
    assert_close(got["median"][sure], wanted.median[sure], relative=1e-6, absolute=1e-6)
    assert_close(got["first"][sure], wanted.first[sure], relative=1e-6, absolute=1e-6)
    solid = sure & (1 - forward.blended.transmittance > 0.5)
    assert solid.any()
    # The bound, relative to what a value is made of: a coordinate or a motion near zero is a sum that cancels.
    for field in ("depth", "normal", "position", "motion", "backward"):
        of = wanted.features[field].reshape(*solid.shape, -1)[solid]
        size = np.abs(of).max(axis=1, keepdims=True)
        assert_close(got[field][solid] / size, of / size, absolute=1e-4, name=field)


def test_what_is_not_wanted_is_not_there(default_device: Device) -> None:
    scene = scenes.random_cloud(300, 3, 40, 30)
    everything = run(default_device, scene)
    for wanted in (
        Features.of(()),
        Features.of(("motion",)),
        Features.of(("backward",)),
        Features.of(("position", "normal")),
    ):
        got = run(default_device, scene, wanted)
        assert set(got) - {"median", "first", "count", "index", "alpha"} == set(wanted.names)
        for name, values in got.items():
            assert_same_bits(values, everything[name])


def test_a_wall(shaped_device: Device) -> None:
    # A sheet, two units away and tilted 45 degrees to it, of one large flat Gaussian: closed forms.
    half = np.sqrt(0.5)
    gaussians = scenes.make_gaussians(
        np.array([[0.0, 0.0, 2.0]]),
        np.array([[np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0]]),  # 45 degrees about x
        np.log([[3.0, 3.0, 1e-3]]),
        np.array([0.9]),
        np.zeros((1, 1, 3)),
    )
    got = run(shaped_device, (gaussians, scenes.straight_camera(20, 12)))
    middle = {name: values[6, 10] for name, values in got.items()}
    assert middle["count"] == 1
    assert middle["index"] == 0
    assert_close(middle["depth"], [2.0], relative=1e-6)
    assert_close(middle["first"], 2.0, relative=1e-6)
    assert_close(middle["median"], 2.0, relative=1e-6)  # it stops nine tenths
    assert_close(middle["normal"], [0.0, half, -half], absolute=1e-6)  # z of the sheet turns to (0, -s, s), away
    assert_close(middle["position"], [0.0, 0.0, 2.0], absolute=1e-6)


def test_nothing_there(shaped_device: Device) -> None:
    gaussians, camera = scenes.one()
    gaussians.means[:, 2] = -5.0
    got = run(shaped_device, (gaussians, camera))
    for name, values in got.items():
        assert (values == (-1 if name == "index" else 0)).all(), name


@pytest.mark.smoke
def test_behind_the_other_camera(device: Device) -> None:
    gaussians, camera = scenes.one()
    pipeline = Pipeline.run(device, (gaussians, camera))
    rasterizer, frame = pipeline.rasterizer, pipeline.frame
    passed = replace(camera, translation=camera.translation - np.array([0.0, 0.0, 100.0]))
    after = upload(rasterizer.device, pack_camera(passed))
    wanted = Features.of(("motion",))
    of = (pipeline.gaussians, frame.camera_array, frame.projected, Motion(after))
    rows = features(rasterizer.device, rasterizer.work, wanted, *of).get()
    assert_same_bits(rows[:, 1:], np.zeros((1, 2), np.float32))


def test_unknown_features() -> None:
    with pytest.raises(ValueError, match="no such features: colour"):
        Features.of(("colour",))
