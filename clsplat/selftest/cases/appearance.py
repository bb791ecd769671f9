# SPDX-License-Identifier: Apache-2.0
"""Cases of the colour models: removal of a photograph's own colours, the gradient, and the update by Adam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module

import numpy as np
from numpy.random import Generator
from scipy.sparse import csr_array

from clsplat.arrays import Float32, Float64
from clsplat.config.colour_models import COLOUR_MODELS, GAIN_ENTRIES, ColourModel
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import appearance as reference
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback, read_of
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench, cropped, planes_of
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import (
    GainEntries,
    Gains,
    PhotoLens,
    develop,
    entry_gradient,
    step_gains,
)

MIX_RATE_FACTOR = 0.125
"""Learning rate of colour mixes, divided by that of gains."""
MAX_FALLOFF_OCTAVES, MAX_MIX = 16.0, 0.2
"""Limits in the kernels: the largest change of brightness by a vignette, in octaves, and the largest magnitude of a
colour mix."""


def random_gradient(rng: Generator, image: Float32) -> Float32:
    """A random gradient with respect to an image, of a random order of magnitude."""
    return (rng.standard_normal(image.shape) * 10 ** rng.uniform(-9, 4)).astype(np.float32)


def random_moments(rng: Generator, shape: tuple[int, ...], size: float) -> Float32:
    """First and second moments of Adam, (2, *shape), for gradients near `size`. In a third of the calls all are 0."""
    moments = np.stack([rng.standard_normal(shape) * size, rng.uniform(0.1, 1, shape) * size**2])
    return (moments * (rng.random() > 1 / 3)).astype(np.float32)


def _random(model: ColourModel, rng: Generator, size: tuple[int, int]) -> Inputs:
    """Random inputs of a colour model.

    Gains are 1/256 to 256, and colour mixes are at most MAX_MIX in magnitude. Gradients have any magnitude. Principal
    points are inside and outside the picture.
    """
    image, photograph = random_pictures(rng, size)
    by_image = random_gradient(rng, image)
    scale = float(np.abs(by_image).sum())
    ends = np.where(np.arange(model.entries) < GAIN_ENTRIES, 8.0, MAX_MIX)
    return Inputs(
        image=image,
        photograph=photograph,
        by_image=by_image,
        taken=PhotoLens(1, 1, (rng.uniform(-0.5, 1.5), rng.uniform(-0.5, 1.5)), flat=bool(rng.random() < 0.9)),
        entries=rng.uniform(-ends, ends, (3, model.entries)).astype(np.float32),
        start=rng.uniform(-1, 1, (3, model.entries)).astype(np.float32),
        pull=(rng.choice([0.0, 1e-3, 1.0]) * rng.uniform(0, 0.5, (3, 3)) * scale).astype(np.float32),
        lenses=rng.uniform(-1, 0.2, (2, model.lens_entries)).astype(np.float32),
        of_entries=random_moments(rng, (3, model.entries), scale),
        of_lenses=random_moments(rng, (2, model.lens_entries), scale),
        number=int(rng.integers(1, 500)),
        rate=float(rng.choice([0.01, 0.05])),
    )


def _frozen(model: ColourModel, bench: CaseBench) -> list[Inputs]:
    """Inputs from the self-test's scene, with three photographs and two lenses: photograph 1 and lens 1 are used.

    In a colour model that has gains alone, the gradient has a term that pulls the gains of photographs 0 and 1 towards
    their initial values `start`.
    """
    pulled = model.sums == GAIN_ENTRIES
    seeds, end = ((45, 42, 41), 1.0) if pulled else ((48, 49, 46), 0.125)
    image = bench.blended.image.get()
    photograph = evenly(seeds[0], image.shape, 0.0, 1.0).astype(np.float32)
    by_image = evenly(seeds[1], image.shape, -0.25, 1.0).astype(np.float32)
    image, photograph, by_image = (cropped(each, bench.camera) for each in (image, photograph, by_image))
    entries = evenly(seeds[2], (3, model.entries), -end, end).astype(np.float32)
    pull = pulled * evenly(44, (3, 3), 0.0, 0.5).astype(np.float32)
    pull[2] = pull[:, 2] = 0
    given = Inputs(
        image=image,
        photograph=photograph,
        by_image=by_image,
        taken=PhotoLens(photograph=1, lens=1, centre=(0.4375, 0.5625)),
        entries=entries,
        start=evenly(43, (3, model.entries), -1.0, 1.0).astype(np.float32) if pulled else entries,
        pull=pull,
        lenses=evenly(47, (2, model.lens_entries), -0.5, 0.25).astype(np.float32),
        of_entries=np.zeros((2, 3, model.entries), np.float32),
        of_lenses=np.zeros((2, 2, model.lens_entries), np.float32),
        number=5,
        rate=0.03125,
    )
    return [given]


def _gains(device: Device, entries: Float32, moments: Sequence[Float32], pull: csr_array | None = None) -> Gains:
    first, second = (upload(device, moment) for moment in moments)
    return replace(Gains.on(device, entries, pull), first=first, second=second)


def _launch(model: ColourModel, device: Device, work: Workspace, given: Inputs) -> Read:
    colours = _gains(device, given.entries, given.of_entries, csr_array(given.pull))
    colours = replace(colours, start=upload(device, given.start))
    lenses = _gains(device, given.lenses, given.of_lenses) if model.of_lens else None
    planes, below = planes_of(given.photograph), planes_of(given.by_image)
    below[:, given.size[1] :] = np.nan  # rows of padding are never written, and must not be read
    target = upload(device, np.concatenate([planes, planes[:1]]))  # the fourth plane is alpha
    image, gradient = upload(device, planes_of(given.image)), upload(device, below)
    develop(device, model, colours, lenses, given.taken, target, given.size)
    columns = entry_gradient(device, work, model, given.taken, image, gradient, given.size)
    step = (columns, given.number, given.rate, fresh_readback(device))
    step_gains(device, colours, given.taken.photograph, *step, GainEntries(mix_rate=MIX_RATE_FACTOR))
    made = {"entries": colours.logs, "start": colours.start, "gains": colours.gains, "columns": columns}
    made |= {"first": colours.first, "second": colours.second}
    if lenses is not None:
        step_gains(device, lenses, given.taken.lens, *step, GainEntries.of_lens(model))
        made["lenses"] = lenses.logs
    read = read_of(made)
    return lambda: {**read(), **_pictures_read(given, target, gradient)}


def _pictures_read(given: Inputs, target: DeviceArray, gradient: DeviceArray) -> Arrays:
    """Read the photograph after the launch, and the planes that must not change: alpha and the gradient."""
    planes, by_image = target.get(), cropped(gradient.get(), given.size)
    return {"target": cropped(planes[:3], given.size), "alpha": planes[3], "gradient": by_image}


def moment(values: Float64) -> Expected:
    """Expect these values of a moment of Adam.

    The bound covers the error of beta2: in float32 it is off by 1e-8, which is 1e-5 of 1 - beta2 = 1e-3.
    """
    return Expected(values, 3e-5, np.abs(values).max())


def stepped(values: Float64, rate: float | Float64) -> Expected:
    """Expect these values after a step of Adam with learning rate `rate`.

    The bound covers the error of beta2, which is 1e-5 of a step, and gradients that are nearly cancelling sums of 16
    floats.
    """
    return Expected(values, 1e-4, rate + 1e-2 * np.abs(values))


def _developed(model: ColourModel, given: Inputs, squared: Float64) -> Expected:
    """Expect the photograph from which the colour model has removed gains, colour mixes and vignette.

    squared: (H, W), squared distances of the pixels from the principal point.
    """
    twin = import_module(f"clsplat.reference.{model.stem}")
    photograph, entries, lenses = given.wide("photograph", "entries", "lenses")
    own, lens = entries[given.taken.photograph], lenses[given.taken.lens]
    wanted = twin.developed(photograph, own, lens, squared)
    if model.sums == GAIN_ENTRIES:
        return Expected(wanted, 3e-7, wanted)  # the bound covers the roundings of a gain and of a quotient
    white, none = np.ones_like(photograph), np.zeros_like(own)
    octaves, most = (np.log2(twin.developed(white, none, each, squared)) for each in (lens, -np.abs(lens)))
    largest = np.maximum(np.abs(wanted), photograph / np.exp2(own[:GAIN_ENTRIES])).max(axis=2, keepdims=True)
    # the bound covers a few roundings for each octave of the vignette
    return Expected(wanted, 1.2e-6, largest * (0.4 + most), np.abs(octaves) < MAX_FALLOFF_OCTAVES)


def _twin(model: ColourModel, given: Inputs, got: Arrays) -> dict[str, Expected]:
    image, by_image, entries, start, pull, lenses, of_entries, of_lenses = given.wide(
        *("image", "by_image", "entries", "start", "pull", "lenses", "of_entries", "of_lenses")
    )
    (width, height), taken, count = given.size, given.taken, model.entries
    squared = reference.spread(width, height, (taken.centre[0] * width, taken.centre[1] * height))
    squared *= taken.flat  # a panorama has no vignette
    terms = import_module(f"clsplat.reference.{model.stem}").terms(image, by_image, squared)
    is_gain = np.arange(count) < GAIN_ENTRIES
    is_log = np.concatenate([is_gain, np.full(model.lens_entries, fill_value=True)])
    found = np.where(is_log, np.log(2), 1.0) * got["columns"].sum(axis=1, dtype=np.float64)
    got |= {"by gains": found[:GAIN_ENTRIES], "by the rest": found[GAIN_ENTRIES:]}
    sums, sizes = terms.sum(axis=(0, 1)), np.abs(terms).sum(axis=(0, 1))
    by_entries, by_lenses = np.zeros_like(entries), np.zeros_like(lenses)
    # These gradients are the device's sums, so that the error of the sums does not count again.
    by_entries[taken.photograph] = found[:count] + reference.pull(entries, start, pull)[taken.photograph]
    by_lenses[taken.lens] = found[count:]
    rates = given.rate * np.where(is_gain, 1.0, MIX_RATE_FACTOR)
    mean = start.mean(axis=0)
    after, first, second = reference.step(
        entries, of_entries[0], of_entries[1], by_entries, given.number, rates, mean=mean
    )
    after[:, GAIN_ENTRIES:] = np.clip(after[:, GAIN_ENTRIES:], -MAX_MIX, MAX_MIX)
    lenses, _, _ = reference.step(lenses, of_lenses[0], of_lenses[1], by_lenses, given.number, given.rate)
    return {
        "target": _developed(model, given, squared),
        # the bound covers a few roundings of partial sums and of distances, relative to the sum of magnitudes
        "by gains": Expected(sums[:GAIN_ENTRIES], 1e-6, sizes[:GAIN_ENTRIES]),
        "by the rest": Expected(sums[GAIN_ENTRIES:], 2e-6, sizes[GAIN_ENTRIES:]),
        "entries": stepped(after, rates),
        "gains": Expected(np.exp2(after), 1e-5, np.exp2(after), np.broadcast_to(is_gain, after.shape)),
        "first": moment(first),
        "second": moment(second),
        "start": exactly(given.start),
        "alpha": exactly(planes_of(given.photograph)[0]),
        "gradient": exactly(given.by_image),
        **({"lenses": stepped(lenses, given.rate)} if model.of_lens else {}),
    }


COLOUR_CASES = {
    name: Case(
        sizes=((17, 33), (16, 16), (1, 1), (40, 15)),
        random=partial(_random, model),
        launch=partial(_launch, model),
        twin=partial(_twin, model),
        frozen=partial(_frozen, model),
        digested=("entries", "first", "second", "lenses" if model.of_lens else "gains", "columns", "target"),
    )
    for name, model in COLOUR_MODELS.items()
}
