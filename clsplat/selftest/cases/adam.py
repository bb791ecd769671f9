# SPDX-License-Identifier: Apache-2.0
"""Adam's step of all Gaussians, and of those in view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.random import Generator

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.reference.adam import adam as reference
from clsplat.selftest.case import Arrays, Case, Given, Read, Wanted, exactly
from clsplat.selftest.harness import Array, CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.device_gaussians import DeviceGaussians

ADAM_ENDS = {"parameters": (-1.0, 1.0), "gradients": (-0.5, 0.5), "first": (-0.25, 0.25), "second": (0.0625, 0.5)}
"""Arrays of a step, and where their values in the self-test end."""
ADAM_RATES = {name: 2.0**-power for power, name in enumerate(PARAMETER_GROUPS, 3)}


def _random(rng: Generator, count: int) -> Given:
    """Gradients of 1e-15 to 1e6, from moments of any size or none, all in view or some."""
    step = int(rng.choice([1, 2, 10, 1000, 30_000, 10_000_000]))
    later, sparse = step > 1, bool(rng.random() < 0.5)
    visible = (rng.random(count) < 0.5) | (np.arange(count) >= 2 * count // 3)  # whole vectors among them
    visible[: count // 3] = False
    made: dict[str, Arrays] = {name: {} for name in ADAM_ENDS}
    for group, shape in group_shapes(count, 4).items():
        size = 10 ** rng.uniform(-15, 6, shape)
        values = {
            "parameters": rng.standard_normal(shape) * rng.choice([0.0, 1e-2, 1.0]),
            "gradients": rng.standard_normal(shape) * size,
            "first": rng.standard_normal(shape) * size * later,
            "second": rng.random(shape) * size**2 * later,
        }
        if sparse:
            values["gradients"][~visible] = 0.0
        for name, array in values.items():
            made[name][group] = array.astype(np.float32)
    return Given(arrays=made, sparse=sparse, step=step, visible=visible, rates=dict.fromkeys(PARAMETER_GROUPS, 1e-2))


def _frozen(bench: CaseBench) -> list[Given]:
    shapes = group_shapes(bench.model.count, bench.model.coefficients)
    found = []
    for sparse in (False, True):
        made = {
            name: {
                group: evenly(60 + 8 * i + j, shapes[group], *ADAM_ENDS[name]).astype(np.float32)
                for j, group in enumerate(PARAMETER_GROUPS)
            }
            for i, name in enumerate(ADAM_ENDS)
        }
        if sparse:
            for values in made["gradients"].values():
                values[~bench.visible] = 0.0  # as project_grad leaves them
        found.append(Given(arrays=made, sparse=sparse, step=7, visible=bench.visible, rates=ADAM_RATES))
    return found


def uploaded_groups(device: Device, arrays: Mapping[str, Arrays]) -> list[DeviceGaussians]:
    """Arrays by group as on the device."""
    found = []
    for groups in arrays.values():
        count, rest, _ = groups["sh_rest"].shape
        held = {group: upload(device, values) for group, values in groups.items()}
        found.append(DeviceGaussians(count, rest + 1, held))
    return found


def _launch(device: Device, _: Workspace, given: Given) -> Read:
    models = uploaded_groups(device, given.arrays)
    config, moving = OptimiserConfig(sparse=given.sparse), upload(device, 3 * given.visible.astype(np.uint32))
    parameters, gradients, first, second = models
    adam(device, AdamStep(config, given.step, given.rates), parameters, gradients, first, second, moving)
    by_name = dict(zip(given.arrays, models, strict=True))
    return lambda: {
        name: np.concatenate([model[group].get().ravel() for group in PARAMETER_GROUPS])
        for name, model in by_name.items()
    }


def _twin(given: Given, got: Arrays) -> dict[str, Wanted]:
    moved = given.visible if given.sparse else np.ones_like(given.visible)
    made: dict[str, list[Array]] = {name: [] for name in ("parameters", "first", "second", "steps", "terms", "rows")}
    for group, rate in given.rates.items():
        p, g, m, v = (arrays[group].astype(np.float64) for arrays in given.arrays.values())
        after = reference(p, g, m, v, given.step, rate)
        rows = np.broadcast_to(moved.reshape(-1, *[1] * (p.ndim - 1)), p.shape)
        steps, terms = np.maximum(np.abs(after[0] - p), rate), np.abs(m) + np.abs(g)
        kept = (np.where(rows, new, old) for new, old in zip(after, (p, m, v), strict=True))
        for values, found in zip((*kept, steps, terms, rows), made.values(), strict=True):
            found.append(values.ravel())
    parameters, first, second, steps, terms, rows = (np.concatenate(found) for found in made.values())
    wanted = {
        # of a step: beta2 in float32 is 1e-8 off in 1 - beta2 = 1e-3, 1e-5 of a step
        "parameters": Wanted(parameters, 1e-4, steps + 1e-2 * np.abs(parameters), rows),
        "first": Wanted(first, 1e-6, terms, rows),  # a few roundings
        "second": Wanted(second, 3e-5, second, rows),
        "gradients": exactly(np.zeros_like(got["gradients"])),
    }
    for name in ("parameters", "first", "second"):
        got[f"{name} out of view"] = got[name][~rows]
        wanted[f"{name} out of view"] = exactly(wanted[name].values[~rows])
    return wanted


ADAM_CASE = Case(
    sizes=(1, 7, 8, 9, 2, 63, 64, 65, 100),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=tuple(ADAM_ENDS),
)
