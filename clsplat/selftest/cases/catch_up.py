# SPDX-License-Identifier: Apache-2.0
"""The case of chunks that catch up on the steps of Adam that they missed."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.reference.catch_up import catch_up as reference
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback
from clsplat.selftest.cases.steps import ADAM_ENDS, ADAM_RATES, uploaded_groups
from clsplat.selftest.harness import Array, CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.adam import AdamStep
from clsplat.stages.bounds import ChunkList, padded_chunks
from clsplat.stages.catch_up import catch_up, step_table

STATE = ("parameters", "first", "second")


def _random(rng: Generator, count: int) -> Inputs:
    """Moments of any magnitude, some of them zero. Some chunks are not listed.

    last: the last step that each listed chunk has taken, by its number.
    first_step: the first step of the table, at most the first that any chunk missed.
    rates: learning rates by number of the step and by group.
    every: steps between updates of the higher SH bands.
    """
    span, before = int(rng.choice([1, 7, 40, 300])), int(rng.choice([0, 1, 100, 30_000]))
    chunks = -(-count // CHUNK_ROWS)
    last = {chunk: before + int(rng.integers(span)) for chunk in range(chunks) if chunk == 0 or rng.random() < 0.7}
    made: dict[str, Arrays] = {name: {} for name in STATE}
    for group, shape in group_shapes(count, int(rng.choice([1, 4, 9, 16]))).items():
        size = 10 ** rng.uniform(-9, 6, shape)  # well over Adam's epsilon
        made["parameters"][group] = rng.standard_normal(shape).astype(np.float32)
        made["first"][group] = (rng.standard_normal(shape) * size * (rng.random(shape) < 0.9)).astype(np.float32)
        made["second"][group] = (rng.uniform(0.1, 1.0, shape) * size**2).astype(np.float32)
    highest = {group: 10 ** rng.uniform(-5, -1) for group in PARAMETER_GROUPS}
    rates = {before + k: {group: rate * 0.99**k for group, rate in highest.items()} for k in range(1, span + 1)}
    return Inputs(arrays=made, first_step=before + 1, last=last, rates=rates, every=int(rng.choice([1, 3])))


def _frozen(bench: CaseBench) -> list[Inputs]:
    shapes = group_shapes(bench.model.count, bench.model.coefficients)
    made = {
        name: {
            group: evenly(90 + 8 * i + j, shapes[group], *ADAM_ENDS[name]).astype(np.float32)
            for j, group in enumerate(PARAMETER_GROUPS)
        }
        for i, name in enumerate(STATE)
    }
    last = dict.fromkeys(range(-(-bench.model.count // CHUNK_ROWS)), 6)
    return [Inputs(arrays=made, first_step=7, last=last, rates=dict.fromkeys(range(7, 27), ADAM_RATES), every=2)]


def _launch(device: Device, _: Workspace, given: Inputs) -> Read:
    config = OptimiserConfig(sh_rest_every=given.every)
    models, readback = uploaded_groups(device, given.arrays), fresh_readback(device)
    numbers = padded_chunks(np.array(list(given.last), np.uint32))
    last = np.zeros(len(numbers), np.uint32)
    last[: len(given.last)] = list(given.last.values())
    table = step_table(AdamStep(config, number, rates) for number, rates in given.rates.items())
    chunks, step = ChunkList(upload(device, numbers), models[0].count), max(given.rates)
    caught = upload(device, np.zeros(-(-models[0].count // CHUNK_ROWS), np.uint32))
    uploaded = upload(device, last), caught, step, upload(device, table), given.first_step
    catch_up(device, config, tuple(models), chunks, *uploaded, readback)
    by_name = dict(zip(given.arrays, models, strict=True))
    return lambda: {
        name: np.concatenate([model[g].get().ravel() for g in PARAMETER_GROUPS]) for name, model in by_name.items()
    }


def _twin(given: Inputs, got: Arrays) -> dict[str, Expected]:
    before = {
        group: tuple(arrays[group].astype(np.float64) for arrays in given.arrays.values()) for group in PARAMETER_GROUPS
    }
    after = reference(before, CHUNK_ROWS, given.last, given.rates, given.every)
    made: dict[str, list[Array]] = {name: [] for name in (*STATE, "moves", "listed")}
    for group, state in after.items():
        p = before[group][0]
        rows = np.isin(np.arange(len(p)) // CHUNK_ROWS, list(given.last))
        listed = np.broadcast_to(rows.reshape(-1, *[1] * (p.ndim - 1)), p.shape)
        for values, into in zip((*state, np.abs(state[0] - p) + np.abs(p), listed), made.values(), strict=True):
            into.append(values.ravel())
    parameters, first, second, moves, listed = (np.concatenate(found) for found in made.values())
    wanted = {
        # Each step rounds the parameter, to 6e-8 of it, as long as it moves: up to 150 steps. The betas in float32 are
        # off by 3e-8, which is 1e-6 of a movement of some 30 steps.
        "parameters": Expected(parameters, 1e-5, moves, listed),
        "first": Expected(first, 3e-5, np.abs(first), listed),  # 300 roundings, and beta1 off by 2.6e-8 in each
        "second": Expected(second, 3e-5, second, listed),  # likewise
    }
    for name in STATE:
        got[f"{name} of other chunks"] = got[name][~listed]
        wanted[f"{name} of other chunks"] = exactly(wanted[name].values[~listed])
    return wanted


CATCH_UP_CASE = Case(
    sizes=(1, 37, CHUNK_ROWS + 1, 9, CHUNK_ROWS, 2 * CHUNK_ROWS + 129, 65),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=STATE,
)
