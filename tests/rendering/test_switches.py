# SPDX-License-Identifier: Apache-2.0
"""The rasterizer's switches: the default's bits are known, exact switches keep them, others lose a known amount."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from calls import refuses
from compare import assert_same_arrays, assert_same_bits
from golden_frames import FOCALS, checksums, pictures_of
from numpy.typing import NDArray
from pipeline import Pipeline, shaped
from quick import quick

from clsplat.cli.bench import BenchVerb
from clsplat.cli.main import parse
from clsplat.cli.train import TrainVerb
from clsplat.config.presets import RASTERIZER_PRESETS
from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.context import Device
from clsplat.device.source import kernel_root, kernel_source
from clsplat.rendering.build_flags import kernel_defines
from clsplat.sequence.task import digest_of

EXACT_OFF = {
    "constant extent": BenchSwitches(extent="constant"),
    "box": BenchSwitches(tile_test="box"),
    "square": BenchSwitches(tile_test="square"),
    "pairs by depth": BenchSwitches(depth_sort="pairs"),
    "all bits": BenchSwitches(key_bits="all"),
    "pairs by all bits": BenchSwitches(depth_sort="pairs", key_bits="all"),
    "rows": BenchSwitches(row_skip=False),
    "columns": BenchSwitches(column_skip=False),
    "early stop": BenchSwitches(early_stop=False),
    "record cells": BenchSwitches(record_cells=False),
    "frustum cull": BenchSwitches(frustum_cull=False),
    "all": BenchSwitches(
        extent="constant",
        tile_test="square",
        depth_sort="pairs",
        key_bits="all",
        row_skip=False,
        column_skip=False,
        early_stop=False,
        record_cells=False,
        frustum_cull=False,
    ),
}
"""Every exact switch turned off, alone and together."""

APPROXIMATE = {
    "3sigma": (RasterizerConfig(extent="3sigma"), 0.05),
    "no SH": (RasterizerConfig(sh_degree_limit=0), 1.0),
    "SH 2": (RasterizerConfig(sh_degree_limit=2), 1.0),
    "alpha 2/255": (RasterizerConfig(alpha_min=2 / 255), 0.1),
    "transmittance 1e-3": (RasterizerConfig(transmittance_min=1e-3), 0.1),
    "fast": (RASTERIZER_PRESETS["fast"], 0.2),
}
"""With the largest difference that a channel of the scenes' frames may have: see `test_approximate_switches`."""


def sheaf() -> scenes.Scene:
    """Ellipses of every size, direction and slimness, many far longer than the image."""
    gaussians, camera = scenes.random_cloud(2000, 5, 100, 70)
    rng = np.random.default_rng(5)
    gaussians.log_scales[:] = rng.uniform(-8, 3, gaussians.log_scales.shape)
    gaussians.opacity_logits[:] = rng.uniform(-6, 1, len(gaussians))
    return gaussians, camera


def wall() -> scenes.Scene:
    """Layers so wide that every tile is opaque long before its last Gaussian."""
    gaussians, camera = scenes.NAMED["saturating"]()
    gaussians.log_scales[:] += 1.5
    return gaussians, camera


NAMES = ("overlap", "saturating", "needles", "cloud", "sheaf", "wall", "off_frustum")


def scene(name: str) -> scenes.Scene:
    if name in ("sheaf", "wall"):
        return sheaf() if name == "sheaf" else wall()
    return scenes.random_cloud(1000, 8, 100, 70) if name == "cloud" else scenes.NAMED[name]()


def run(device: Device, name: str, config: RasterizerConfig) -> Pipeline:
    return Pipeline.run(device, scene(name), config=config)


def gradients(pipeline: Pipeline) -> dict[str, NDArray[np.float32]]:
    camera = pipeline.camera
    d_image = np.random.default_rng(2).random((camera.height, camera.width, 3)) - 0.5
    found, screen = pipeline.backward(d_image)
    return {**found.arrays(), "screen": np.where(pipeline.visible[:, None], screen, np.float32(0))}


def test_default_bits_are_the_stored_ones(device: Device) -> None:
    wanted = json.loads((Path(__file__).parents[1] / "golden" / "frames.json").read_text())["checksums"]
    assert checksums(device) == wanted, "see tools/ci/make_golden.py if the change is meant to change bits"


@pytest.mark.slow
@pytest.mark.parametrize("kind", FOCALS)
def test_the_same_pictures_in_every_shape(default_device: Device, kind: str) -> None:
    """Every channel and deep slices. tools/ci/digests.py has the other shapes, and every driver."""
    wanted = pictures_of(default_device, (kind,))
    for shape in ((8, 16), (4, 1)):
        assert pictures_of(shaped(default_device, *shape), (kind,)) == wanted


def test_every_define_is_looked_at_by_a_kernel() -> None:
    texts = [kernel_source(path.stem) for path in kernel_root().glob("*.cl")]
    for config in (*EXACT_OFF.values(), *(config for config, _ in APPROXIMATE.values())):
        for name in kernel_defines(config):
            assert any(name in text for text in texts), name


def test_default_is_the_plain_text() -> None:
    assert kernel_defines(RasterizerConfig()) == {}
    assert RASTERIZER_PRESETS["exact"] == RASTERIZER_PRESETS["default"] == RasterizerConfig()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("switch", quick(EXACT_OFF, "square", "pairs by all bits", "early stop", "all"))
def test_exact_switches_change_no_bit(default_device: Device, switch: str, name: str) -> None:
    device = shaped(default_device, 8, 1)
    wanted, got = run(device, name, RasterizerConfig()), run(device, name, EXACT_OFF[switch])
    for array in ("image", "transmittance"):
        assert_same_bits(getattr(got.frame.blended, array).get(), getattr(wanted.frame.blended, array).get(), array)
    # a sum that is zero may be so with either sign
    assert_same_arrays(*({name: a + np.float32(0) for name, a in gradients(each).items()} for each in (got, wanted)))


@pytest.mark.parametrize(
    ("name", "extent"),
    [
        ("sheaf", "opacity"),
        *(pytest.param(name, "opacity", marks=pytest.mark.slow) for name in ("off_frustum", "cloud")),
        *(pytest.param("sheaf", extent, marks=pytest.mark.slow) for extent in ("constant", "3sigma")),
    ],
)
def test_culling_that_is_off_lists_more_gaussians(device: Device, name: str, extent: Any) -> None:
    config = BenchSwitches(extent=extent)
    default, got = (run(device, name, replace(config, frustum_cull=on)) for on in (True, False))
    assert_same_bits(got.frame.blended.image.get(), default.frame.blended.image.get())
    projected, counted = got.frame.projected, got.frame.listed.counted
    np.testing.assert_array_equal(projected.tile_counts.get(), default.frame.projected.tile_counts.get())
    assert projected.shown is not None
    shown = projected.shown.get() > 0
    assert counted.visible == shown.sum() == len(counted.gaussian_from_visible.get())
    gaussians, camera = scene(name)
    depths = gaussians.means.astype(np.float64) @ camera.rotation[2] + camera.translation[2]
    # alpha-min itself may fall either way in float32; no scene has an opacity or a depth so near
    faint = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64))) <= config.alpha_min
    np.testing.assert_array_equal(shown, default.visible | ((depths > camera.near) & ~faint))
    assert np.isfinite(got.splat("RED", "GREEN", "BLUE")[shown]).all()
    assert counted.visible > default.frame.listed.counted.visible


def test_culling_that_is_off_in_bands(default_device: Device) -> None:
    frames = []
    for config in (RasterizerConfig(), BenchSwitches(frustum_cull=False)):
        frames.append(Pipeline.run(default_device, scene("sheaf"), config=config, capacity=20_000).frame)
        assert len(frames[-1].bands) > 1
    assert_same_bits(frames[1].blended.image.get(), frames[0].blended.image.get())


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (4, 1), (8, 16)], ids=str)
def test_exact_switches_in_every_shape(default_device: Device, shape: tuple[int, int]) -> None:
    wanted = run(shaped(default_device, *shape), "saturating", RasterizerConfig())
    got = run(shaped(default_device, *shape), "saturating", EXACT_OFF["all"])
    assert_same_bits(got.frame.blended.image.get(), wanted.frame.blended.image.get())


@pytest.mark.slow
def test_switches_that_are_off_do_more_work(default_device: Device) -> None:
    device = shaped(default_device, 8, 1)
    pairs = {
        name: run(device, "cloud", config).frame.listed.lists.gaussian_from_sorted.shape[0]
        for name, config in {"default": RasterizerConfig(), **EXACT_OFF}.items()
    }
    assert pairs["constant extent"] > pairs["default"]
    assert pairs["box"] > pairs["default"]
    assert pairs["square"] > pairs["box"]
    assert pairs["all"] > max(pairs["square"], pairs["constant extent"])
    assert pairs["rows"] == pairs["pairs by depth"] == pairs["default"]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("switch", quick(APPROXIMATE, "3sigma", "fast"))
def test_approximate_switches(default_device: Device, switch: str, name: str) -> None:
    """3sigma leaves out alpha of at most exp(-4.5) a Gaussian; alpha_min up to 2/255 a Gaussian, of which several lie
    at a pixel; transmittance_min the last Gaussian of a pixel, whose weight is at most 1e-3 / (1 - 0.99). Bands of SH
    are worth what they hold."""
    device = shaped(default_device, 8, 1)
    config, bound = APPROXIMATE[switch]
    wanted, got = run(device, name, RasterizerConfig()), run(device, name, config)
    difference = np.abs(got.image - wanted.image).max()
    assert difference <= bound
    if name == "cloud":
        assert difference > 0, "the switch does something"
    assert all(np.isfinite(values).all() for values in gradients(got).values())


@pytest.mark.slow
def test_approximate_switches_in_every_shape_and_on_every_device(device: Device, default_device: Device) -> None:
    config = RasterizerConfig("3sigma", sh_degree_limit=1, alpha_min=3 / 255, transmittance_min=1e-2)
    wanted = run(shaped(default_device, 8, 1), "cloud", config)
    for lanes, items in ((1, 64), (8, 1)):
        got = run(shaped(device, lanes, items), "cloud", config)
        assert_same_bits(got.frame.blended.image.get(), wanted.frame.blended.image.get())


@pytest.mark.slow
def test_gradient_of_bands_left_out_is_zero(default_device: Device) -> None:
    got = gradients(run(shaped(default_device, 8, 1), "overlap", RasterizerConfig(sh_degree_limit=1)))["sh"]
    assert got[:, 1:4].any()
    assert not got[:, 4:].any()


@pytest.mark.parametrize(
    "change",
    [
        *({"sh_degree_limit": 4}, {"sh_tolerance": -0.1}, {"sh_tolerance": float("nan")}),
        *({"alpha_min": 0.0}, {"alpha_min": float("nan")}, {"transmittance_min": 1.0}),
    ],
)
def test_values_that_make_no_sense(change: dict[str, float]) -> None:
    refuses("expected", replace(RasterizerConfig(), **change).check)


def test_a_user_s_command_has_the_six_settings_that_approximate(capsys: pytest.CaptureFixture[str]) -> None:
    six = ["extent", "sh_degree_limit", "sh_tolerance", "sh_storage", "alpha_min", "transmittance_min"]
    assert [setting.name for setting in fields(RasterizerConfig)] == six
    both = ["S", "-o", "R", "--rasterizer.sh-degree-limit", "1"]
    assert isinstance(parse(["train", *both]), TrainVerb)
    for flags in (["--rasterizer.no-row-skip"], ["--rasterizer.extent", "constant"]):
        with pytest.raises(SystemExit):
            parse(["train", *both, *flags])
        assert flags[0] in capsys.readouterr().err
        assert isinstance(parse(["bench", *flags]), BenchVerb)


def test_default_settings_have_the_digest_of_every_version() -> None:
    """A frame's stamp says how it was made: nothing, where no setting differs from its default."""
    assert digest_of(RasterizerConfig()) == digest_of({})
    assert digest_of(RasterizerConfig(alpha_min=2 / 255)) == digest_of({"alpha_min": f"{2 / 255:.12g}"})
