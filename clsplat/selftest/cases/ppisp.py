# SPDX-License-Identifier: Apache-2.0
"""Case of photographs by several cameras: gains, mixes and vignettes, their gradient and their update by Adam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import appearance, ppisp
from clsplat.selftest.case import Arrays, Case, Inputs, Read, Wanted, fresh_readback, read_of
from clsplat.selftest.cases.appearance import (
    frozen_pictures,
    moment,
    pictures_read,
    random_gradient,
    random_moments,
    stepped,
    unchanged,
    uploaded,
)
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench
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
"""Limits in the kernel: octaves of a vignette, and absolute value of a mix."""
IS_GAIN = np.arange(COLOUR_ENTRIES) < 3
PPISP_PARTS = {"by gains": slice(3), "by mixes": slice(3, COLOUR_ENTRIES), "by lens": slice(COLOUR_ENTRIES, None)}
"""Parts of the gradient: with respect to a photograph's gains, its mixes, and a lens's vignette."""


def _random(rng: Generator, size: tuple[int, int]) -> Inputs:
    """Gains of 1/256 to 256, mixes and vignettes up to their limits, and principal points outside the picture too."""
    image, photograph = random_pictures(rng, size)
    by_image = random_gradient(rng, image)
    entries = np.concatenate([rng.uniform(-8, 8, (3, 3)), rng.uniform(-MAX_MIX, MAX_MIX, (3, 6))], axis=1)
    scale = float(np.abs(by_image).sum())
    return Inputs(
        image=image,
        photograph=photograph,
        by_image=by_image,
        taken=PhotoLens(1, 1, (rng.uniform(-0.5, 1.5), rng.uniform(-0.5, 1.5)), flat=bool(rng.random() < 0.9)),
        entries=entries.astype(np.float32),
        lenses=rng.uniform(-1, 0.2, (2, VIGNETTE_ENTRIES)).astype(np.float32),
        of_entries=random_moments(rng, entries.shape, scale),
        of_lenses=random_moments(rng, (2, VIGNETTE_ENTRIES), scale),
        number=int(rng.integers(1, 500)),
        rate=0.01,
    )


def _frozen(bench: CaseBench) -> list[Inputs]:
    """Inputs with three photographs and two lenses; photograph 1 is used, taken with lens 1."""
    learnt = Inputs(
        taken=PhotoLens(photograph=1, lens=1, centre=(0.4375, 0.5625)),
        entries=evenly(46, (3, COLOUR_ENTRIES), -0.125, 0.125).astype(np.float32),
        lenses=evenly(47, (2, VIGNETTE_ENTRIES), -0.5, 0.25).astype(np.float32),
        of_entries=np.zeros((2, 3, COLOUR_ENTRIES), np.float32),
        of_lenses=np.zeros((2, 2, VIGNETTE_ENTRIES), np.float32),
        number=5,
        rate=0.03125,
    )
    return [Inputs(**vars(frozen_pictures(bench, 48, 49)), **vars(learnt))]


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    first, second, *others = (upload(device, moment) for moment in (*given.of_entries, *given.of_lenses))
    colours = replace(Gains.on(device, given.entries), first=first, second=second)
    vignettes = replace(Gains.on(device, given.lenses), first=others[0], second=others[1])
    target, image, gradient = uploaded(device, given)
    develop(device, colours, vignettes, given.taken, target, *given.size)
    columns = camera_gradient(device, work, given.taken, image, gradient, *given.size)
    step = (columns, given.number, given.rate, fresh_readback(device))
    step_gains(device, colours, given.taken.photograph, *step, GainEntries(mix_rate=PPISP_MIX_RATE_FACTOR))
    step_gains(device, vignettes, given.taken.lens, *step, VIGNETTE_GAINS)
    made = {"entries": colours.logs, "gains": colours.gains, "first": first, "second": second}
    read = read_of(**made, vignettes=vignettes.logs, columns=columns)
    return lambda: {**read(), **pictures_read(given, target, gradient)}


def _sums(columns: Float32) -> Float64:
    """The gradient with respect to a photograph's entries and a lens's vignette, from column sums."""
    factors = np.full(len(columns), np.log(2))
    factors[3:COLOUR_ENTRIES] = 1.0
    sums: Float64 = factors * columns.sum(axis=1, dtype=np.float64)
    return sums


def _twin(given: Inputs, got: Arrays) -> dict[str, Wanted]:
    image, by_image, photograph, entries, lenses, of_entries, of_lenses = given.wide(
        *("image", "by_image", "photograph", "entries", "lenses", "of_entries", "of_lenses")
    )
    (width, height), taken, step = given.size, given.taken, (given.number, given.rate)
    squared = ppisp.spread(width, height, (taken.centre[0] * width, taken.centre[1] * height))
    squared *= taken.flat  # a panorama has no vignette
    own, vignette = entries[taken.photograph], lenses[taken.lens]
    wanted = ppisp.developed(photograph, own, vignette, squared)
    octaves, terms = (np.log2(ppisp.light(each, squared)) for each in (vignette, np.abs(vignette)))
    largest = np.maximum(np.abs(wanted), photograph / np.exp2(own[:3])).max(axis=2)
    sums, sizes = (ppisp.gradient(image, each, squared) for each in (by_image, np.abs(by_image)))
    sizes[3:COLOUR_ENTRIES] = np.repeat(np.abs(by_image).sum(axis=(0, 1)) * np.abs(image).max(), 2)
    found, by_entries, by_lenses = _sums(got["columns"]), np.zeros_like(entries), np.zeros_like(lenses)
    got |= {name: found[part] for name, part in PPISP_PARTS.items()}
    by_entries[taken.photograph], by_lenses[taken.lens] = found[:COLOUR_ENTRIES], found[COLOUR_ENTRIES:]
    rates = given.rate * np.where(IS_GAIN, 1.0, PPISP_MIX_RATE_FACTOR)
    after, first, second = appearance.step(entries, of_entries[0], of_entries[1], by_entries, given.number, rates)
    after[:, 3:] = np.clip(after[:, 3:], -MAX_MIX, MAX_MIX)
    through, _, _ = appearance.step(lenses, of_lenses[0], of_lenses[1], by_lenses, *step, centred=False)
    return {
        # a few roundings for each octave of the vignette
        "target": Wanted(wanted, 1.2e-6, (largest * (0.4 + terms))[:, :, None], np.abs(octaves) < MAX_FALLOFF_OCTAVES),
        # a few roundings of partial sums and of distances, relative to the sum of magnitudes
        **{name: Wanted(sums[part], 2e-6, sizes[part]) for name, part in PPISP_PARTS.items()},
        "entries": stepped(after, rates),
        "gains": Wanted(np.exp2(after), 1e-5, np.exp2(after), np.broadcast_to(IS_GAIN, after.shape)),
        "first": moment(first),
        "second": moment(second),
        "vignettes": stepped(through, given.rate),
        **unchanged(given),
    }


PPISP_CASE = Case(
    sizes=((16, 16), (17, 33), (40, 15), (1, 1)),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("entries", "first", "second", "vignettes", "columns", "target"),
)
