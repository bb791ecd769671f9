# SPDX-License-Identifier: Apache-2.0
"""Self-test of photographs by several cameras: gains, mixes and vignettes, and Adam's step."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.layouts.columns import READBACK
from clsplat.reference import appearance, ppisp
from clsplat.selftest.harness import Array, CaseBench, StageOutcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import GainEntries, Gains, step_gains
from clsplat.stages.ppisp import (
    COLOUR_ENTRIES,
    VIGNETTE_ENTRIES,
    VIGNETTE_GAINS,
    PhotoLens,
    camera_gradient,
    develop,
)

PPISP_TAKEN = PhotoLens(photograph=1, lens=1, centre=(0.4375, 0.5625))
PPISP_STEP, PPISP_RATE, PPISP_MIX_RATE_FACTOR = 5, 0.03125, 0.125


def of_ppisp(bench: CaseBench) -> StageOutcome:
    """Test one of three photographs, through the second of two lenses, with the scene's blended image as the render."""
    device, camera, image = bench.device, bench.camera, bench.blended.image
    size = camera.width, camera.height
    entries = evenly(46, (3, COLOUR_ENTRIES), -0.125, 0.125).astype(np.float32)
    lenses = evenly(47, (2, VIGNETTE_ENTRIES), -0.5, 0.25).astype(np.float32)
    photograph = evenly(48, tuple(image.shape), 0.0, 1.0).astype(np.float32)
    by_image = evenly(49, tuple(image.shape), -0.25, 1.0).astype(np.float32)
    by_image[:, :, camera.width :] = 0  # like the gradient of the loss
    readback = upload(device, np.zeros(len(READBACK), np.uint32))

    def launch() -> tuple[Gains, Gains, DeviceArray, DeviceArray]:
        colours, vignettes = Gains.on(device, entries), Gains.on(device, lenses)
        target, gradient = upload(device, photograph), upload(device, by_image)
        develop(device, colours, vignettes, PPISP_TAKEN, target, *size)
        columns = camera_gradient(device, bench.work, PPISP_TAKEN, image, gradient, *size)
        step = (columns, PPISP_STEP, PPISP_RATE, readback)
        step_gains(device, colours, PPISP_TAKEN.photograph, *step, GainEntries(mix_rate=PPISP_MIX_RATE_FACTOR))
        step_gains(device, vignettes, PPISP_TAKEN.lens, *step, VIGNETTE_GAINS)
        return colours, vignettes, target, columns

    def take(results: tuple[Gains, Gains, DeviceArray, DeviceArray]) -> list[Array]:
        colours, vignettes, target, columns = results
        made = (colours.logs, colours.first, colours.second, vignettes.logs, columns)
        return [*(array.get() for array in made), cropped(target.get(), camera)]

    _, outcome = bench.twice(launch, take)
    got = dict(zip(("entries", "first", "second", "vignettes", "columns", "target"), outcome.arrays, strict=True))
    shown, wide, taken = (cropped(a, camera).astype(np.float64) for a in (image.get(), by_image, photograph))
    squared = ppisp.spread(*size, (PPISP_TAKEN.centre[0] * size[0], PPISP_TAKEN.centre[1] * size[1]))
    by_all = ppisp.gradient(shown, wide, squared)
    before, held = entries.astype(np.float64), lenses.astype(np.float64)
    by_entries, by_lenses = np.zeros_like(before), np.zeros_like(held)
    by_entries[1], by_lenses[1] = by_all[:COLOUR_ENTRIES], by_all[COLOUR_ENTRIES:]
    got["by lens"] = (np.log(2) * got["columns"][COLOUR_ENTRIES:].sum(axis=1, dtype=np.float64)).astype(np.float32)
    rates = PPISP_RATE * np.where(np.arange(COLOUR_ENTRIES) < 3, 1.0, PPISP_MIX_RATE_FACTOR)
    zeros = np.zeros_like(before)
    after, first, second = appearance.step(before, zeros, zeros, by_entries, PPISP_STEP, rates)
    through = appearance.step(
        held, np.zeros_like(held), np.zeros_like(held), by_lenses, PPISP_STEP, PPISP_RATE, centred=False
    )
    wanted = {
        "entries": after,
        "first": first,
        "second": second,
        "vignettes": through[0],
        "by lens": by_lenses[1],
        "target": ppisp.developed(taken, before[1], held[1], squared),
    }
    return outcome.compared({name: (got[name], value) for name, value in wanted.items()})
