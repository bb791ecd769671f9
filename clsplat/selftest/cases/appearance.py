# SPDX-License-Identifier: Apache-2.0
"""Gains of photographs, their gradient and Adam's step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from scipy.sparse import csr_array

from clsplat.arrays import Float32
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import appearance as reference
from clsplat.selftest.case import Arrays, Case, Read, Wanted, exactly, fresh_readback, read_of, wide
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench, cropped, planes_of
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import Gains, gain_gradient, remove_gains, step_gains

GAINS_PHOTOGRAPH = 1


@dataclass(frozen=True, eq=False)
class GainInputs:
    """Gains of three photographs, of which one is compared with a render (H, W, 3).

    by_image: the loss's gradient by the render.
    first, second: Adam's moments.
    """

    logs: Float32
    start: Float32
    pull: Float32
    photograph: Float32
    image: Float32
    by_image: Float32
    first: Float32
    second: Float32
    number: int
    rate: float


def random_gradient(rng: Generator, image: Float32) -> Float32:
    """A gradient of any size by an image."""
    return (rng.standard_normal(image.shape) * 10 ** rng.uniform(-9, 4)).astype(np.float32)


def random_moments(rng: Generator, *sums: Float32) -> list[Float32]:
    """Moments of Adam, first and second for each array that is as large as its gradients; zero in one of three."""
    kept = rng.random() > 1 / 3
    return [
        (kept * values).astype(np.float32)
        for each in sums
        for values in (rng.standard_normal(each.shape) * each, rng.uniform(0.1, 1, each.shape) * np.square(each))
    ]


def _random(rng: Generator, size: tuple[int, int]) -> GainInputs:
    """Gains of 1/256 to 256, and gradients of any size."""
    image, photograph = random_pictures(rng, size)
    by_image = random_gradient(rng, image)
    logs, start = rng.uniform(-8, 8, (3, 3)), rng.uniform(-1, 1, (3, 3))
    pull = rng.choice([0.0, 1e-3, 1.0]) * rng.uniform(0, 0.5, (3, 3)) * np.abs(by_image).sum()
    moments = random_moments(rng, np.full((3, 3), np.abs(by_image).sum(), np.float32))
    arrays = (each.astype(np.float32) for each in (logs, start, pull))
    return GainInputs(*arrays, photograph, image, by_image, *moments, int(rng.integers(1, 500)), 0.05)


def _frozen(bench: CaseBench) -> list[GainInputs]:
    """One of three photographs, with the scene's blended image as the render."""
    camera, shape = bench.camera, tuple(bench.blended.image.shape)
    logs, start, pull = (
        evenly(seed, (3, 3), low, high).astype(np.float32)
        for seed, low, high in ((41, -1.0, 1.0), (43, -1.0, 1.0), (44, 0.0, 0.5))
    )
    pull[2] = pull[:, 2] = 0  # a photograph without pull
    pictures = (evenly(45, shape, 0.0, 1.0), bench.blended.image.get(), evenly(42, shape, -0.25, 1.0))
    images = (cropped(each.astype(np.float32), camera) for each in pictures)
    return [GainInputs(logs, start, pull, *images, *np.zeros((2, 3, 3), np.float32), 5, 0.03125)]


def _launch(device: Device, work: Workspace, given: GainInputs) -> Read:
    height, width, _ = given.image.shape
    gains = Gains.on(device, given.logs, csr_array(given.pull))
    start, first, second = (upload(device, array) for array in (given.start, given.first, given.second))
    gains = replace(gains, start=start, first=first, second=second)
    planes = planes_of(given.photograph)
    target, image = upload(device, np.concatenate([planes, planes[:1]])), upload(device, planes_of(given.image))
    below = planes_of(given.by_image)
    below[:, height:] = np.nan  # the loss leaves it unwritten
    gradient = upload(device, below)
    remove_gains(device, gains, GAINS_PHOTOGRAPH, target)
    columns = gain_gradient(device, work, image, gradient, height)
    step_gains(device, gains, GAINS_PHOTOGRAPH, columns, given.number, given.rate, fresh_readback(device))
    kept = read_of(logs=gains.logs, first=gains.first, second=gains.second, gains=gains.gains, columns=columns)

    def read() -> Arrays:
        found, planes = kept(), target.get()
        found |= {"target": cropped(planes[:3], (width, height)), "alpha": planes[3], "start": gains.start.get()}
        found["gradient"] = cropped(gradient.get(), (width, height))
        return {**found, "by gains": np.log(2) * found["columns"].sum(axis=1, dtype=np.float64)}

    return read


def _twin(given: GainInputs, got: Arrays) -> dict[str, Wanted]:
    image, by_image, photograph, logs, start, pull = wide(
        given.image, given.by_image, given.photograph, given.logs, given.start, given.pull
    )
    by_logs = np.log(2) * got["columns"].sum(axis=1, dtype=np.float64)  # so that no error counts twice
    gradients = np.zeros_like(logs)
    gradients[GAINS_PHOTOGRAPH] = by_logs + reference.pull(logs, start, pull)[GAINS_PHOTOGRAPH]
    after, first, second = reference.step(logs, *wide(given.first, given.second), gradients, given.number, given.rate)
    removed = reference.removed(photograph, logs[GAINS_PHOTOGRAPH])
    return {
        "target": Wanted(removed, removed),
        "alpha": exactly(planes_of(given.photograph)[0]),
        "by gains": Wanted(reference.gradient(image, by_image), np.log(2) * np.abs(image * by_image).sum(axis=(0, 1))),
        "logs": Wanted(after, given.rate + 1e-2 * np.abs(after)),
        "gains": Wanted(np.exp2(after), np.exp2(after)),
        "first": Wanted(first, np.abs(first).max()),
        "second": Wanted(second, np.abs(second).max()),
        "start": exactly(given.start),
        "gradient": exactly(given.by_image),
    }


MOMENT_BOUND = (3e-5, "beta2 in float32 is 1e-8 off in 1 - beta2 = 1e-3")
STEP_BOUND = (1e-4, "relative to a step; beta2 is 1e-5 of one, and a sum of 16 floats nearly cancels")
APPEARANCE_CASE = Case(
    sizes=((17, 33), (16, 16), (1, 1), (40, 15)),
    random=_random,
    launch=_launch,
    twin=_twin,
    bounds={
        "target": (3e-7, "two roundings, of 2^log and of the quotient"),
        "by gains": (1e-6, "relative to the sum of the magnitudes, a few roundings of partial sums"),
        "logs": STEP_BOUND,
        "gains": (1e-5, "that of the logs"),
        "first": MOMENT_BOUND,
        "second": MOMENT_BOUND,
    },
    frozen=_frozen,
    digested=("logs", "first", "second", "gains", "columns", "target"),
    by_shape=False,
)
