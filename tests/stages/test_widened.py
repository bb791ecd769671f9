# SPDX-License-Identifier: Apache-2.0
"""Blending by two vectors of the shape in one: the bits of one at a time. Both are the same code without AVX-512."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from compare import assert_same_arrays, assert_same_bits
from pipeline import Pipeline, shaped
from quick import quick

from clsplat.config.rasterizer import BenchSwitches, RasterizerConfig
from clsplat.device.context import Device
from clsplat.layouts.columns import SlotFields

WAYS = {
    "default": (RasterizerConfig(), SlotFields()),
    "absolute and contributions": (RasterizerConfig(), SlotFields(absolute=True, contributions=True)),
    "nothing recorded": (BenchSwitches(record_cells=False), SlotFields()),
    "no early stop": (BenchSwitches(early_stop=False), SlotFields()),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", quick(["saturating", "random_cloud", "needles", "overlap"], "saturating", "needles"))
def test_no_bit_knows_of_the_width(device: Device, name: str, way: str) -> None:
    config, fields = WAYS[way]
    usual = shaped(device, 8, 1)
    wide, narrow = (
        Pipeline.run(each, scenes.NAMED[name](), config=config)
        for each in (usual, usual.with_switches({"NARROW": True}))
    )
    for array in ("image", "transmittance", "stops"):
        assert_same_bits(getattr(wide.frame.blended, array).get(), getattr(narrow.frame.blended, array).get(), array)
    gradient = np.random.default_rng(3).normal(size=(wide.camera.height, wide.camera.width, 3))
    gradient[:, : wide.camera.width // 3] = 0  # cells, and halves of them, that have none
    got, wanted = (pipeline.screened(gradient, fields) for pipeline in (wide, narrow))
    # a sum that is zero may be so with either sign
    assert_same_arrays(*({name: a + np.float32(0) for name, a in each.arrays().items()} for each, _ in (got, wanted)))
    shown = wide.visible  # nobody writes other rows
    screens = [screen.gradients.get()[shown] + np.float32(0) for _, screen in (got, wanted)]
    assert_same_bits(*screens, "screen")
    if fields.contributions:
        assert got[1].contributions is not None
        assert wanted[1].contributions is not None
        assert_same_bits(got[1].contributions.get()[shown], wanted[1].contributions.get()[shown], "contributions")
