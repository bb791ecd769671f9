# SPDX-License-Identifier: Apache-2.0
"""The self-test's stage of photographs by several cameras: gains, mixes and vignettes, and Adam's step."""

from __future__ import annotations

import numpy as np

from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.layout import READBACK
from clsplat.reference import appearance, ppisp
from clsplat.selftest.harness import Array, Bench, Outcome, cropped
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import Gains, step_gains
from clsplat.stages.ppisp import COLOURS, VIGNETTE, Taken, camera_gradient, develop

TAKEN = Taken(photograph=1, lens=1, centre=(0.4375, 0.5625))
STEP, RATE, SLOW = 5, 0.03125, 0.125


def of_ppisp(bench: Bench) -> Outcome:
    """A photograph of three through the second of two lenses, whose picture is what the scene's blending has made."""
    device, camera, image = bench.device, bench.camera, bench.blended.image
    size = camera.width, camera.height
    entries = evenly(46, (3, COLOURS), -0.125, 0.125).astype(np.float32)
    lenses = evenly(47, (2, VIGNETTE), -0.5, 0.25).astype(np.float32)
    photograph = evenly(48, tuple(image.shape), 0.0, 1.0).astype(np.float32)
    by_image = evenly(49, tuple(image.shape), -0.25, 1.0).astype(np.float32)
    by_image[:, :, camera.width :] = 0  # like the gradient of the loss
    readback = upload(device, np.zeros(len(READBACK), np.uint32))

    def launch() -> tuple[Gains, Gains, DeviceArray, DeviceArray]:
        colours, vignettes = Gains.on(device, entries), Gains.on(device, lenses)
        target, gradient = upload(device, photograph), upload(device, by_image)
        develop(device, colours, vignettes, TAKEN, target, *size)
        columns = camera_gradient(device, bench.work, TAKEN, image, gradient, *size)
        step_gains(device, colours, TAKEN.photograph, columns, STEP, RATE, readback, slow=SLOW)
        step_gains(device, vignettes, TAKEN.lens, columns, STEP, RATE, readback, at=COLOURS, centred=False)
        return colours, vignettes, target, columns

    def take(results: tuple[Gains, Gains, DeviceArray, DeviceArray]) -> list[Array]:
        colours, vignettes, target, columns = results
        made = (colours.logs, colours.first, colours.second, vignettes.logs, columns)
        return [*(array.get() for array in made), cropped(target.get(), camera)]

    _, outcome = bench.twice(launch, take)
    got = dict(zip(("entries", "first", "second", "vignettes", "columns", "target"), outcome.arrays, strict=True))
    shown, wide, taken = (cropped(a, camera).astype(np.float64) for a in (image.get(), by_image, photograph))
    squared = ppisp.spread(*size, (TAKEN.centre[0] * size[0], TAKEN.centre[1] * size[1]))
    by_all = ppisp.gradient(shown, wide, squared)
    before, held = entries.astype(np.float64), lenses.astype(np.float64)
    by_entries, by_lenses = np.zeros_like(before), np.zeros_like(held)
    by_entries[1], by_lenses[1] = by_all[:COLOURS], by_all[COLOURS:]
    got["by lens"] = (np.log(2) * got["columns"][COLOURS:].sum(axis=1, dtype=np.float64)).astype(np.float32)
    rates = RATE * np.where(np.arange(COLOURS) < 3, 1.0, SLOW)
    zeros = np.zeros_like(before)
    after, first, second = appearance.step(before, zeros, zeros, by_entries, STEP, rates)
    through = appearance.step(held, np.zeros_like(held), np.zeros_like(held), by_lenses, STEP, RATE, centred=False)
    wanted = {
        "entries": after,
        "first": first,
        "second": second,
        "vignettes": through[0],
        "by lens": by_lenses[1],
        "target": ppisp.developed(taken, before[1], held[1], squared),
    }
    return outcome.compared({name: (got[name], value) for name, value in wanted.items()})
