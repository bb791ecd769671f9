# SPDX-License-Identifier: Apache-2.0
"""Photographs by several cameras: gains, mixes and vignettes, their gradient and Adam's step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import appearance, ppisp
from clsplat.selftest.case import Arrays, Case, Read, Wanted, exactly, fresh_readback, wide
from clsplat.selftest.cases.appearance import MOMENT_BOUND, STEP_BOUND, random_gradient, random_moments
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench, cropped, planes_of
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

PPISP_MIX_RATE_FACTOR = 0.125
MAX_FALLOFF_OCTAVES, MAX_MIX = 16.0, 0.2
"""Octaves at which the kernel holds a vignette, and the largest mix."""


@dataclass(frozen=True, eq=False)
class PpispInputs:
    """Colour entries of photographs and vignettes of lenses, of which one each is compared with a render (H, W, 3).

    by_image: the loss's gradient by the render.
    moments: Adam's first and second of the entries, and of the vignettes.
    """

    taken: PhotoLens
    entries: Float32
    lenses: Float32
    photograph: Float32
    image: Float32
    by_image: Float32
    moments: list[Float32]
    number: int
    rate: float

    @property
    def squared(self) -> Float64:
        """Squared distances (H, W) from the principal point."""
        height, width, _ = self.image.shape
        return ppisp.spread(width, height, (self.taken.centre[0] * width, self.taken.centre[1] * height))


def _random(rng: Generator, size: tuple[int, int]) -> PpispInputs:
    """Gains of 1/256 to 256, any mixes, vignettes to where they are held, principal points beside the picture."""
    image, photograph = random_pictures(rng, size)
    by_image = random_gradient(rng, image)
    entries = np.concatenate([rng.uniform(-8, 8, (3, 3)), rng.uniform(-0.2, 0.2, (3, 6))], axis=1)
    lenses = rng.uniform(-1, 0.2, (2, VIGNETTE_ENTRIES))
    taken = PhotoLens(1, 1, (float(rng.uniform(-0.5, 1.5)), float(rng.uniform(-0.5, 1.5))))
    ones = (np.full(each.shape, np.abs(by_image).sum(), np.float32) for each in (entries, lenses))
    arrays = (each.astype(np.float32) for each in (entries, lenses))
    step = random_moments(rng, *ones), int(rng.integers(1, 500)), 0.01
    return PpispInputs(taken, *arrays, photograph, image, by_image, *step)


def _frozen(bench: CaseBench) -> list[PpispInputs]:
    """One of three photographs, through the second of two lenses, with the scene's blended image as the render."""
    shape = tuple(bench.blended.image.shape)
    entries = evenly(46, (3, COLOUR_ENTRIES), -0.125, 0.125).astype(np.float32)
    lenses = evenly(47, (2, VIGNETTE_ENTRIES), -0.5, 0.25).astype(np.float32)
    pictures = (evenly(48, shape, 0.0, 1.0), bench.blended.image.get(), evenly(49, shape, -0.25, 1.0))
    images = (cropped(each.astype(np.float32), bench.camera) for each in pictures)
    moments = [np.zeros_like(each) for each in (entries, entries, lenses, lenses)]
    taken = PhotoLens(photograph=1, lens=1, centre=(0.4375, 0.5625))
    return [PpispInputs(taken, entries, lenses, *images, moments, 5, 0.03125)]


def _launch(device: Device, work: Workspace, given: PpispInputs) -> Read:
    height, width, _ = given.image.shape
    firsts = [upload(device, moment) for moment in given.moments]
    colours = replace(Gains.on(device, given.entries), first=firsts[0], second=firsts[1])
    vignettes = replace(Gains.on(device, given.lenses), first=firsts[2], second=firsts[3])
    planes = planes_of(given.photograph)
    target, image = upload(device, np.concatenate([planes, planes[:1]])), upload(device, planes_of(given.image))
    below = planes_of(given.by_image)
    below[:, height:] = np.nan  # the loss leaves it unwritten
    gradient, taken = upload(device, below), given.taken
    develop(device, colours, vignettes, taken, target, width, height)
    columns = camera_gradient(device, work, taken, image, gradient, width, height)
    step = (columns, given.number, given.rate, fresh_readback(device))
    step_gains(device, colours, taken.photograph, *step, GainEntries(mix_rate=PPISP_MIX_RATE_FACTOR))
    step_gains(device, vignettes, taken.lens, *step, VIGNETTE_GAINS)

    def read() -> Arrays:
        made = {"entries": colours.logs, "first": colours.first, "second": colours.second, "vignettes": vignettes.logs}
        found = {name: array.get() for name, array in {**made, "columns": columns, "gains": colours.gains}.items()}
        by_gains, by_mixes, by_lens = np.split(_sums(found["columns"]), (3, COLOUR_ENTRIES))
        found |= {"by gains": by_gains, "by mixes": by_mixes, "by lens": by_lens, "alpha": target.get()[3]}
        shown = {
            name: cropped(array.get(), (width, height)) for name, array in (("gradient", gradient), ("all", target))
        }
        return {
            **found,
            "gradient": shown["gradient"],
            "target": shown["all"][:, :, :3],
            "gains": found["gains"][:, :3],
        }

    return read


def _sums(columns: Float32) -> Float64:
    """Gradient by the entries and the vignette from column sums."""
    mixes = (np.arange(len(columns)) >= 3) & (np.arange(len(columns)) < COLOUR_ENTRIES)
    return np.where(mixes, 1.0, np.log(2)) * columns.sum(axis=1, dtype=np.float64)


def _twin(given: PpispInputs, got: Arrays) -> dict[str, Wanted]:
    image, by_image, photograph, entries, lenses = wide(
        given.image, given.by_image, given.photograph, given.entries, given.lenses
    )
    squared, taken, vignette = given.squared, given.taken, lenses[given.taken.lens]
    of_photograph = entries[taken.photograph]
    wanted = ppisp.developed(photograph, of_photograph, vignette, squared)
    falloff, terms = (np.log2(ppisp.light(each, squared)) for each in (vignette, np.abs(vignette)))
    largest = np.maximum(np.abs(wanted), photograph / np.exp2(of_photograph[:3])).max(axis=2)
    sums = ppisp.gradient(image, by_image, squared)
    sizes = ppisp.gradient(image, np.abs(by_image), squared)
    sizes[3:COLOUR_ENTRIES] = np.repeat(np.abs(by_image).sum(axis=(0, 1)) * np.abs(image).max(), 2)
    by_entries, by_lenses, found = np.zeros_like(entries), np.zeros_like(lenses), _sums(got["columns"])
    by_entries[taken.photograph], by_lenses[taken.lens] = found[:COLOUR_ENTRIES], found[COLOUR_ENTRIES:]
    rates = given.rate * np.where(np.arange(COLOUR_ENTRIES) < 3, 1.0, PPISP_MIX_RATE_FACTOR)
    moments = wide(*given.moments)
    after, first, second = appearance.step(entries, *moments[:2], by_entries, given.number, rates)
    after[:, 3:] = np.clip(after[:, 3:], -MAX_MIX, MAX_MIX)
    through, _, _ = appearance.step(lenses, *moments[2:], by_lenses, given.number, given.rate, centred=False)
    parts = {"by gains": slice(3), "by mixes": slice(3, COLOUR_ENTRIES), "by lens": slice(COLOUR_ENTRIES, None)}
    return {
        "target": Wanted(wanted, (largest * (0.4 + terms))[:, :, None], np.abs(falloff) < MAX_FALLOFF_OCTAVES),
        "alpha": exactly(planes_of(given.photograph)[0]),
        **{name: Wanted(sums[part], sizes[part]) for name, part in parts.items()},
        "entries": Wanted(after, rates + 1e-2 * np.abs(after)),
        "gains": Wanted(np.exp2(after[:, :3]), np.exp2(after[:, :3])),
        "first": Wanted(first, np.abs(first).max()),
        "second": Wanted(second, np.abs(second).max()),
        "vignettes": Wanted(through, given.rate + 1e-2 * np.abs(through)),
        "gradient": exactly(given.by_image),
    }


PARTIAL_SUM_BOUND = (2e-6, "relative to the sum of the magnitudes: a few roundings of partial sums and of distances")
PPISP_CASE = Case(
    sizes=((16, 16), (17, 33), (40, 15), (1, 1)),
    random=_random,
    launch=_launch,
    twin=_twin,
    bounds={
        "target": (1.2e-6, "relative to the pixel's largest, some roundings for each octave of the vignette"),
        "by gains": PARTIAL_SUM_BOUND,
        "by mixes": PARTIAL_SUM_BOUND,
        "by lens": PARTIAL_SUM_BOUND,
        "entries": STEP_BOUND,
        "gains": (1e-5, "that of the entries"),
        "first": MOMENT_BOUND,
        "second": MOMENT_BOUND,
        "vignettes": STEP_BOUND,
    },
    frozen=_frozen,
    digested=("entries", "first", "second", "vignettes", "columns", "target"),
)
