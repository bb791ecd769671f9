# SPDX-License-Identifier: Apache-2.0
"""The stages that are neither projection nor blending: elementary functions, loss, Adam, noise, each by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from measuring import Result
from numpy.typing import NDArray
from planes import padded
from stress_learnt import BOUNDS as LEARNT
from stress_learnt import learnt, pictures

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import READBACK
from clsplat.optimisation.step_noise import Exploration, step_key
from clsplat.reference.adam import adam as exact_adam
from clsplat.reference.loss import alpha_loss, l1_dssim, masked_l1_dssim
from clsplat.reference.noise import displacements
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.blend import Blended
from clsplat.stages.device_camera import padded_size
from clsplat.stages.device_gaussians import allocate_gaussians
from clsplat.stages.loss import loss
from clsplat.stages.loss_terms import AlphaTerm
from clsplat.stages.noise import noise
from clsplat.stages.target import target

Array = NDArray[Any]

BOUNDS = {
    "exp": 2.4e-7,
    "log2": 2.4e-7,
    "sigmoid": 3.6e-7,
    "exp2": 2.1e-7,
    "loss": 1e-6,
    "loss gradient": 1e-5,
    "masked loss": 1e-6,
    "masked gradient": 1e-5,
    "alpha gradient": 1e-6,
    "adam": 1e-4,
    "noise": 5e-6,
    **LEARNT,
}
"""exp, sigmoid: 2 and 3 ulp; exp2: 0.8e-7 of its polynomial and rounding. log2: absolute under 1. loss: relative to at
least 1, a sum of partial sums. loss gradient: in norm; differences of pixels are exact to 1e-7 of the brightness, up to
1.5, and of the ripple of flat pictures that is more; with masks likewise, the loss relative to at least all
pixels over those that count too, as windows under the mask cancel. alpha gradient: one rounding. adam: of a step, as
beta2 in float32 is 1e-8 off in 1 - beta2 = 1e-3, 1e-5 of a step, and a few roundings. noise: in norm; of
100 (o - dead), up to 16, a digit of o is 1e-6 of the weight."""


def elementary(device: Device, rng: np.random.Generator, count: int) -> Result:
    """Largest errors: relative, of log2 relative to at least 1."""
    out = allocate(device, (4, count), np.float32)
    kernel = device.kernels("probe").probe_elementary

    def probe(x: Array) -> Array:
        launch_grid(device, kernel, (count,), upload(device, x.astype(np.float32)), out, count)
        return out.get().astype(float)

    def worst(row: int, low: float, high: float, function: Callable[[Array], Array], least: float = 0.0) -> float:
        x = rng.uniform(low, high, count).astype(np.float32)
        wanted = function(x.astype(float))
        return float((np.abs(probe(x)[row] - wanted) / np.maximum(np.abs(wanted), least)).max())

    return {
        "exp": worst(0, -87, 87, np.exp),
        "log2": worst(1, 1e-3, 1, np.log2, 1.0),
        "sigmoid": worst(2, -80, 80, lambda x: 1 / (1 + np.exp(-x))),
        "exp2": worst(3, -8.5, 0, np.exp2),
    }


def losses(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Largest errors over many pairs of pictures: the loss's, and its gradient's in norm."""
    worst = {"loss": 0.0, "loss gradient": 0.0}
    work = Workspace(device)

    for _ in range(many):
        x, y = pictures(rng)
        height, width, _ = x.shape
        result = loss(device, work, upload(device, padded(x)), upload(device, padded(y)), width, height, 0.2)
        wanted, gradient = l1_dssim(x.astype(float), y.astype(float), 0.2)
        got = result.gradient.get()[:, :height, :width].transpose(1, 2, 0)
        worst["loss"] = max(worst["loss"], abs(result.read()[0] - wanted) / max(1.0, wanted))
        size = float(np.linalg.norm(gradient))
        if size > 0:
            off = float(np.linalg.norm(got - gradient)) / size
            worst["loss gradient"] = max(worst["loss gradient"], off)
    return worst


def masked_losses(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Largest errors of the loss with masks and alpha, of any part that counts, by pixel and by transmittance."""
    worst = {"masked loss": 0.0, "masked gradient": 0.0, "alpha gradient": 0.0}
    work, weight, behind = Workspace(device), 0.5, np.array([0.1, 0.5, 0.9], np.float32)
    background = upload(device, behind)
    for _ in range(many):
        x, y = pictures(rng)
        height, width, _ = x.shape
        rows, stride = padded_size(width, height)
        counts = (rng.random((height, width, 1)) < rng.choice([0.0, 0.1, 0.5, 1.0])).astype(np.float32)
        counts[0, 0] = 1
        alpha = (rng.random((height, width, 1)) ** rng.choice([0.0, 1.0, 8.0])).astype(np.float32)
        left = np.zeros((rows, stride), np.float32)
        left[:height, :width] = rng.random((height, width)) ** rng.choice([0.0, 1.0, 8.0])
        stops = np.full((rows, stride), -1, np.int32)
        stops[:height, :width] = 0
        made = Blended(upload(device, padded(x)), upload(device, left), upload(device, stops), None)
        photograph = np.concatenate([y, alpha, counts], axis=2)
        planes = target(device, work, photograph, background, made, alpha=True)
        kept, terms = int(counts.sum()), (AlphaTerm(weight),)
        result = loss(device, work, made.image, planes, width, height, 0.2, kept=kept, blended=made, terms=terms)
        got, mask = result.gradient.get()[:, :height, :width].transpose(1, 2, 0), counts[:, :, 0].astype(float)
        truth = alpha.astype(float) * y + (1 - alpha.astype(float)) * behind.astype(float)
        own, gradient = masked_l1_dssim(x.astype(float), truth, mask, 0.2)
        apart = 1 - left[:height, :width].astype(float) - alpha[:, :, 0]
        of_alpha, by_left = alpha_loss(left[:height, :width].astype(float), alpha[:, :, 0].astype(float), mask, weight)
        wanted = own + of_alpha
        size = max(1.0, wanted, height * width / float(counts.sum()))
        worst["masked loss"] = max(worst["masked loss"], abs(result.read()[0] - wanted) / size)
        close = np.abs(x - truth).min(axis=2) < 1e-6  # a rounding decides the sign there
        for name, part, exact in (
            ("masked gradient", got[:, :, :3][(mask > 0) & ~close], gradient[(mask > 0) & ~close]),
            ("alpha gradient", got[:, :, 3][np.abs(apart) > 1e-6], by_left[np.abs(apart) > 1e-6]),
        ):
            size = float(np.linalg.norm(exact))
            if size > 0:
                worst[name] = max(worst[name], float(np.linalg.norm(part - exact)) / size)
            elif part.any():
                worst[name] = float("inf")
    return worst


def steps(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Largest error, in steps, over steps of Adam with gradients of 1e-20 to 1e6, from moments of any size."""
    worst, count, rate = 0.0, 200, 1e-2
    shapes = group_shapes(count, 4)
    counts = upload(device, np.ones(count, np.uint32))
    rates = dict.fromkeys(PARAMETER_GROUPS, rate)
    for _ in range(many):
        p, g, m, v = (allocate_gaussians(device, count, 4, zero=True) for _ in range(4))
        step = int(rng.choice([1, 2, 10, 1000, 30_000, 10_000_000]))
        wanted = {}
        for group in PARAMETER_GROUPS:
            size = 10 ** rng.uniform(-15, 6, shapes[group])
            gradient = (rng.standard_normal(shapes[group]) * size).astype(np.float32)
            first = (rng.standard_normal(shapes[group]) * size * (step > 1)).astype(np.float32)
            second = (rng.random(shapes[group]) * size**2 * (step > 1)).astype(np.float32)
            for array, values in ((g, gradient), (m, first), (v, second)):
                array[group].set(values)
            before = (gradient.astype(float), first.astype(float), second.astype(float))
            wanted[group] = exact_adam(np.zeros(shapes[group]), *before, step, rate)[0]
        adam(device, AdamStep(OptimiserConfig(), step, rates), p, g, m, v, counts)
        for group in PARAMETER_GROUPS:
            off = np.abs(p[group].get() - wanted[group]) / np.maximum(np.abs(wanted[group]), rate)
            worst = max(worst, float(off.max()))
    return {"adam": worst}


def exploration(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Largest error in norm of the noise on Gaussians of any opacity, needles and discs among them."""
    worst, count = 0.0, 200
    readback = upload(device, np.zeros(len(READBACK), np.uint32))
    for _ in range(many):
        explore = Exploration(amount=10 ** rng.uniform(-3, 3), key=step_key(0, int(rng.integers(1 << 30))))
        model = allocate_gaussians(device, count, 1, zero=True)
        values = {
            "quaternions": rng.standard_normal((count, 4)) * 10 ** rng.uniform(-3, 3, (count, 1)),
            "log_scales": rng.uniform(-9, 2, (count, 3)),
            "opacity_logits": rng.uniform(-9, 0, count),
        }
        exact = {group: array.astype(np.float32).astype(float) for group, array in values.items()}
        for group, array in exact.items():
            model[group].set(array.astype(np.float32))
        noise(device, explore, model, 0, readback)
        wanted = displacements(explore, exact["quaternions"], exact["log_scales"], exact["opacity_logits"])
        worst = max(worst, float(np.linalg.norm(model["means"].get() - wanted) / np.linalg.norm(wanted)))
    return {"noise": worst}


def stages(device: Device, seed: int, many: int) -> Result:
    """Errors by name, with their bounds and what is over one."""
    rng = np.random.default_rng([seed, 77])
    found = {
        **elementary(device, rng, 1000 * many),
        **losses(device, rng, many),
        **masked_losses(device, rng, many),
        **steps(device, rng, many),
        **exploration(device, rng, many),
        **learnt(device, rng, many),
    }
    faults = [f"{name} {error:.2g} over {BOUNDS[name]:g}" for name, error in found.items() if not error <= BOUNDS[name]]
    return {"errors": found, "faults": faults}
