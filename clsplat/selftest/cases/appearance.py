# SPDX-License-Identifier: Apache-2.0
"""Case of appearance: gains of photographs, their gradient and their update by Adam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator
from scipy.sparse import csr_array

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import appearance as reference
from clsplat.selftest.case import Arrays, Case, Inputs, Read, Wanted, exactly, fresh_readback, read_of
from clsplat.selftest.cases.loss import random_pictures
from clsplat.selftest.harness import CaseBench, cropped, planes_of
from clsplat.selftest.scenes import evenly
from clsplat.stages.appearance import Gains, gain_gradient, remove_gains, step_gains

GAINS_PHOTOGRAPH = 1


def random_gradient(rng: Generator, image: Float32) -> Float32:
    """A random gradient with respect to an image; its order of magnitude is random too."""
    return (rng.standard_normal(image.shape) * 10 ** rng.uniform(-9, 4)).astype(np.float32)


def random_moments(rng: Generator, shape: tuple[int, ...], size: float) -> Float32:
    """First and second moments of Adam, (2, *shape), for gradients near `size`; in a third of the cases zero."""
    moments = np.stack([rng.standard_normal(shape) * size, rng.uniform(0.1, 1, shape) * size**2])
    return (moments * (rng.random() > 1 / 3)).astype(np.float32)


def frozen_pictures(bench: CaseBench, photograph_seed: int, gradient_seed: int) -> Inputs:
    """The scene's blended image as the render, a photograph, and the loss's gradient with respect to the render."""
    image = bench.blended.image.get()
    photograph = evenly(photograph_seed, image.shape, 0.0, 1.0).astype(np.float32)
    by_image = evenly(gradient_seed, image.shape, -0.25, 1.0).astype(np.float32)
    planes = {"image": image, "photograph": photograph, "by_image": by_image}
    return Inputs(**{name: cropped(each, bench.camera) for name, each in planes.items()})


def _random(rng: Generator, size: tuple[int, int]) -> Inputs:
    """Gains of 1/256 to 256, and gradients of any magnitude."""
    image, photograph = random_pictures(rng, size)
    by_image = random_gradient(rng, image)
    pull = rng.choice([0.0, 1e-3, 1.0]) * rng.uniform(0, 0.5, (3, 3)) * np.abs(by_image).sum()
    return Inputs(
        image=image,
        photograph=photograph,
        by_image=by_image,
        logs=rng.uniform(-8, 8, (3, 3)).astype(np.float32),
        start=rng.uniform(-1, 1, (3, 3)).astype(np.float32),
        pull=pull.astype(np.float32),
        moments=random_moments(rng, (3, 3), float(np.abs(by_image).sum())),
        number=int(rng.integers(1, 500)),
        rate=0.05,
    )


def _frozen(bench: CaseBench) -> list[Inputs]:
    """Inputs with gains for three photographs, one of which is used."""
    ends = {41: (-1.0, 1.0), 43: (-1.0, 1.0), 44: (0.0, 0.5)}
    logs, start, pull = (evenly(seed, (3, 3), *ends[seed]).astype(np.float32) for seed in ends)
    pull[2] = pull[:, 2] = 0  # this photograph is not pulled
    learnt = Inputs(logs=logs, start=start, pull=pull, moments=np.zeros((2, 3, 3), np.float32), number=5, rate=0.03125)
    return [Inputs(**vars(frozen_pictures(bench, 45, 42)), **vars(learnt))]


def uploaded(device: Device, given: Inputs) -> list[DeviceArray]:
    """Planes of the photograph with alpha, the render, and the gradient; its padding rows, never written, are NaN."""
    planes, below = planes_of(given.photograph), planes_of(given.by_image)
    below[:, given.size[1] :] = np.nan
    return [upload(device, each) for each in (np.concatenate([planes, planes[:1]]), planes_of(given.image), below)]


def _launch(device: Device, work: Workspace, given: Inputs) -> Read:
    start, first, second = (upload(device, array) for array in (given.start, *given.moments))
    gains = replace(Gains.on(device, given.logs, csr_array(given.pull)), start=start, first=first, second=second)
    target, image, gradient = uploaded(device, given)
    remove_gains(device, gains, GAINS_PHOTOGRAPH, target)
    columns = gain_gradient(device, work, image, gradient, given.size[1])
    step_gains(device, gains, GAINS_PHOTOGRAPH, columns, given.number, given.rate, fresh_readback(device))
    read = read_of(logs=gains.logs, first=first, second=second, gains=gains.gains, columns=columns, start=start)
    return lambda: {**read(), **pictures_read(given, target, gradient)}


def pictures_read(given: Inputs, target: DeviceArray, gradient: DeviceArray) -> Arrays:
    """The photograph after the launch, and the planes that must not change: its alpha, and the gradient."""
    planes = target.get()
    return {
        "target": cropped(planes[:3], given.size),
        "alpha": planes[3],
        "gradient": cropped(gradient.get(), given.size),
    }


def unchanged(given: Inputs) -> dict[str, Wanted]:
    """The planes that must not change."""
    return {"alpha": exactly(planes_of(given.photograph)[0]), "gradient": exactly(given.by_image)}


def moment(values: Float64) -> Wanted:
    """A moment of Adam. The bound: beta2 in float32 is off by 1e-8, which is 1e-5 of 1 - beta2 = 1e-3."""
    return Wanted(values, 3e-5, np.abs(values).max())


def stepped(values: Float64, rate: float | Float64) -> Wanted:
    """Values after a step of Adam. The bound: beta2 is 1e-5 of a step, and a sum of 16 floats may nearly cancel."""
    return Wanted(values, 1e-4, rate + 1e-2 * np.abs(values))


def _twin(given: Inputs, got: Arrays) -> dict[str, Wanted]:
    image, by_image, photograph, logs, start, pull, moments = given.wide(
        *("image", "by_image", "photograph", "logs", "start", "pull", "moments")
    )
    got["by gains"] = np.log(2) * got["columns"].sum(axis=1, dtype=np.float64)
    gradients = np.zeros_like(logs)  # from the device's sums: their error does not count again
    gradients[GAINS_PHOTOGRAPH] = got["by gains"] + reference.pull(logs, start, pull)[GAINS_PHOTOGRAPH]
    after, first, second = reference.step(logs, moments[0], moments[1], gradients, given.number, given.rate)
    removed = reference.removed(photograph, logs[GAINS_PHOTOGRAPH])
    terms = np.log(2) * np.abs(image * by_image).sum(axis=(0, 1))
    return {
        "target": Wanted(removed, 3e-7, removed),  # two roundings: 2^log and a quotient
        "by gains": Wanted(reference.gradient(image, by_image), 1e-6, terms),  # a few roundings of partial sums
        "logs": stepped(after, given.rate),
        "gains": Wanted(np.exp2(after), 1e-5, np.exp2(after)),
        "first": moment(first),
        "second": moment(second),
        "start": exactly(given.start),
        **unchanged(given),
    }


APPEARANCE_CASE = Case(
    sizes=((17, 33), (16, 16), (1, 1), (40, 15)),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("logs", "first", "second", "gains", "columns", "target"),
)
