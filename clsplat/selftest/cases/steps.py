# SPDX-License-Identifier: Apache-2.0
"""Cases of parts of a training step: Adam, late Adam (settle), the noise of MCMC on means, and the penalties on opacity
and scale."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, group_shapes
from clsplat.layouts.columns import SLOT_PLAIN
from clsplat.optimisation.missed_steps import MOST_MISSED, MissedSteps
from clsplat.optimisation.step_noise import Exploration, step_key
from clsplat.reference.adam import adam as reference
from clsplat.reference.adam import missed_steps
from clsplat.reference.noise import displacements, penalty_grad
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback
from clsplat.selftest.harness import Array, CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.adam import AdamStep, adam
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, upload_gaussians
from clsplat.stages.noise import highest_logit, noise
from clsplat.stages.project import Screen, Slots, ViewSlots, project, project_grad
from clsplat.stages.settle import settle

ADAM_ENDS = {"parameters": (-1.0, 1.0), "gradients": (-0.5, 0.5), "first": (-0.25, 0.25), "second": (0.0625, 0.5)}
"""Arrays of a step of Adam, with the least and greatest of their values in the self-test."""
ADAM_RATES = {name: 2.0**-power for power, name in enumerate(PARAMETER_GROUPS, 3)}


def _random_step(rng: Generator, count: int) -> Inputs:
    """Random inputs of a step of Adam: gradients of 1e-15 to 1e6, with moments of any magnitude or zero.

    rows: the step updates all elements ("all"), elements with a gradient ("sparse"), or visible Gaussians ("late").
    """
    step = int(rng.choice([1, 2, 10, 1000, 30_000, 10_000_000]))
    later, rows = step > 1, str(rng.choice(["all", "sparse", "late"]))
    # Some vectors of consecutive rows are all visible, some partly, and some not at all.
    visible = (rng.random(count) < 0.5) | (np.arange(count) >= 2 * count // 3)
    visible[: count // 3] = False
    made: dict[str, Arrays] = {name: {} for name in ADAM_ENDS}
    for group, shape in group_shapes(count, int(rng.choice([4, 16]))).items():
        size = 10 ** rng.uniform(-15, 6, shape)
        values = {
            "parameters": rng.standard_normal(shape) * rng.choice([0.0, 1e-2, 1.0]),
            "gradients": rng.standard_normal(shape) * size,
            "first": rng.standard_normal(shape) * size * later,
            "second": rng.random(shape) * size**2 * later,
        }
        if rows != "all":
            values["gradients"][~visible] = 0.0
            values["gradients"][rng.random(shape) < 0.2] = 0.0
        for name, array in values.items():
            made[name][group] = array.astype(np.float32)
    return Inputs(arrays=made, rows=rows, step=step, visible=visible, rates=dict.fromkeys(PARAMETER_GROUPS, 1e-2))


def _frozen_steps(bench: CaseBench) -> list[Inputs]:
    shapes = group_shapes(bench.model.count, bench.model.coefficients)
    found = []
    for rows in ("all", "sparse"):
        made = {
            name: {
                group: evenly(60 + 8 * i + j, shapes[group], *ADAM_ENDS[name]).astype(np.float32)
                for j, group in enumerate(PARAMETER_GROUPS)
            }
            for i, name in enumerate(ADAM_ENDS)
        }
        if rows == "sparse":
            for values in made["gradients"].values():
                values[~bench.visible] = 0.0  # project_grad leaves zeros for invisible Gaussians
        found.append(Inputs(arrays=made, rows=rows, step=7, visible=bench.visible, rates=ADAM_RATES))
    return found


def uploaded_groups(device: Device, arrays: Mapping[str, Arrays]) -> list[DeviceGaussians]:
    """Upload several sets of arrays, such as parameters and moments, each with one array per parameter group."""
    found = []
    for groups in arrays.values():
        count, rest, _ = groups["sh_rest"].shape
        held = {group: upload(device, values) for group, values in groups.items()}
        found.append(DeviceGaussians(count, rest + 1, held))
    return found


def _launch_adam(device: Device, _: Workspace, given: Inputs) -> Read:
    models = uploaded_groups(device, given.arrays)
    config = OptimiserConfig(sparse=given.rows == "sparse", late=given.rows == "late")
    tile_counts = upload(device, 3 * given.visible.astype(np.uint32))
    parameters, gradients, first, second = models
    adam(device, AdamStep(config, given.step, given.rates), parameters, gradients, first, second, tile_counts)
    by_name = dict(zip(given.arrays, models, strict=True))
    return lambda: {
        name: np.concatenate([model[group].get().ravel() for group in PARAMETER_GROUPS])
        for name, model in by_name.items()
    }


def _twin_of_adam(given: Inputs, got: Arrays) -> dict[str, Expected]:
    moved = given.visible if given.rows == "late" else np.ones_like(given.visible)
    made: dict[str, list[Array]] = {name: [] for name in ("parameters", "first", "second", "steps", "terms", "rows")}
    for group, rate in given.rates.items():
        p, g, m, v = (arrays[group].astype(np.float64) for arrays in given.arrays.values())
        after = reference(p, g, m, v, given.step, rate)
        rows = np.broadcast_to(moved.reshape(-1, *[1] * (p.ndim - 1)), p.shape)
        if given.rows == "sparse":
            rows = g != 0
        steps, terms = np.maximum(np.abs(after[0] - p), rate), np.abs(m) + np.abs(g)
        kept = (np.where(rows, new, old) for new, old in zip(after, (p, m, v), strict=True))
        for values, found in zip((*kept, steps, terms, rows), made.values(), strict=True):
            found.append(values.ravel())
    parameters, first, second, steps, terms, rows = (np.concatenate(found) for found in made.values())
    wanted = {
        # beta2 in float32 is off by 1e-8. This is 1e-5 of 1 - beta2 = 1e-3, and so 1e-5 of a step.
        "parameters": Expected(parameters, 1e-4, steps + 1e-2 * np.abs(parameters), rows),
        "first": Expected(first, 1e-6, terms, rows),  # a few roundings
        "second": Expected(second, 3e-5, second, rows),
        "gradients": exactly(np.zeros_like(got["gradients"])),
    }
    for name in ("parameters", "first", "second"):
        got[f"{name} that must not change"] = got[name][~rows]
        wanted[f"{name} that must not change"] = exactly(wanted[name].values[~rows])
    return wanted


ADAM_CASE = Case(
    sizes=(1, 7, 8, 9, 2, 63, 64, 65, 100),
    random=_random_step,
    launch=_launch_adam,
    twin=_twin_of_adam,
    frozen=_frozen_steps,
    digested=tuple(ADAM_ENDS),
)


def _random_missed(rng: Generator, count: int) -> Inputs:
    """Random inputs of late Adam: rows that missed 0 to MOST_MISSED steps up to step `step`, with moments of any
    magnitude, some of them zero.

    common_step: the last step that all rows have taken.
    rates: learning rates of each step after `common_step`, by parameter group.
    every: number of steps between updates of the SH bands from degree 1 on.
    """
    span, every = int(rng.choice([1, 7, 40, MOST_MISSED])), int(rng.choice([1, 2]))
    common_step = int(rng.choice([0, 1, 100, 30_000]))
    last = common_step + rng.integers(0, span + 1, count)
    last[0] = common_step
    made: dict[str, Arrays] = {name: {} for name in ("parameters", "first", "second")}
    for group, shape in group_shapes(count, int(rng.choice([1, 16]))).items():
        size = 10 ** rng.uniform(-9, 6, shape)  # moments far above Adam's epsilon
        made["parameters"][group] = rng.standard_normal(shape).astype(np.float32)
        made["first"][group] = (rng.standard_normal(shape) * size * (rng.random(shape) < 0.9)).astype(np.float32)
        made["second"][group] = (rng.uniform(0.1, 1.0, shape) * size**2).astype(np.float32)
    fall = 0.99 ** np.arange(span)
    rates = {group: 10 ** rng.uniform(-5, -1) * fall for group in PARAMETER_GROUPS}
    return Inputs(
        arrays=made,
        common_step=common_step,
        step=common_step + span,
        last=last.astype(np.uint32),
        rates=rates,
        every=every,
        visible=rng.random(count) < 0.7,
        all_rows=bool(rng.random() < 0.5),
    )


def _launch_settle(device: Device, _: Workspace, given: Inputs) -> Read:
    config = OptimiserConfig(sh_rest_every=given.every)
    missed = MissedSteps(config, tuple(PARAMETER_GROUPS))
    for index, number in enumerate(range(given.common_step + 1, given.step + 1)):
        step = AdamStep(config, number, {group: rates[index] for group, rates in given.rates.items()})
        missed.add(step.scales)
    models, last = uploaded_groups(device, given.arrays), upload(device, given.last)
    counts = None if given.all_rows else upload(device, 3 * given.visible.astype(np.uint32))
    table, readback = upload(device, missed.rounded()), fresh_readback(device)
    settle(device, config, tuple(models), given.step, last, table, readback, counts)
    by_name = dict(zip(given.arrays, models, strict=True))
    return lambda: {
        "last": last.get(),
        **{name: np.concatenate([model[g].get().ravel() for g in PARAMETER_GROUPS]) for name, model in by_name.items()},
    }


def _twin_of_settle(given: Inputs, got: Arrays) -> dict[str, Expected]:  # noqa: ARG001  # all twins have these arguments
    taken = np.ones_like(given.visible) if given.all_rows else given.visible
    made: dict[str, list[Array]] = {name: [] for name in ("parameters", "first", "second", "moves")}
    for group, rates in given.rates.items():
        every = given.every if group == "sh_rest" else 1
        after = [arrays[group].astype(np.float64) for arrays in given.arrays.values()]
        before = after[0].copy()
        for row in np.flatnonzero(taken):
            numbers = [number for number in range(given.last[row] + 1, given.step + 1) if number % every == 0]
            due = [rates[number - given.common_step - 1] for number in numbers]
            found = missed_steps(after[0][row], after[1][row], after[2][row], int(given.last[row]) // every, due)
            for array, values in zip(after, found, strict=True):
                array[row] = values
        for values, into in zip((*after, np.abs(after[0] - before) + np.abs(before)), made.values(), strict=True):
            into.append(values.ravel())
    parameters, first, second, moves = (np.concatenate(found) for found in made.values())
    mark = given.step + (not given.all_rows)
    return {
        # The bound covers one rounding of the sum, and a few roundings of the movement.
        # The betas in float32 are off by 3e-8, which changes a sum over some 30 steps by 1e-6 of it.
        "parameters": Expected(parameters, 3e-6, moves),
        "first": Expected(first, 2e-5, np.abs(first)),  # float32 beta1 is off by 2.6e-8, beta1^256 by 7e-6
        "second": Expected(second, 1e-5, second),  # float32 beta2 is off by 1.3e-8, beta2^256 by 3e-6
        "last": exactly(np.where(taken, mark, given.last).astype(np.uint32)),
    }


SETTLE_CASE = Case(
    sizes=(1, 63, 64, 65, 2, 9),
    random=_random_missed,
    launch=_launch_settle,
    twin=_twin_of_settle,
    by_shape=False,
)


GEOMETRY_ARRAYS = ("quaternions", "log_scales", "opacity_logits")


def _random_noise(rng: Generator, count: int) -> Inputs:
    """Random Gaussians of nearly any opacity and shape, including needles and discs."""
    explore = Exploration(amount=10 ** rng.uniform(-3, 3), key=step_key(0, int(rng.integers(1 << 30))))
    logits = rng.uniform(-9, 0, count).astype(np.float32)
    logits[0] = -7.0  # the first Gaussian is so faint that the noise moves it
    return Inputs(
        explore=explore,
        quaternions=(rng.standard_normal((count, 4)) * 10 ** rng.uniform(-3, 3, (count, 1))).astype(np.float32),
        log_scales=rng.uniform(-9, 2, (count, 3)).astype(np.float32),
        opacity_logits=logits,
    )


def _frozen_noise(bench: CaseBench) -> list[Inputs]:
    gaussians, logits = bench.frozen.gaussians, evenly(39, (bench.model.count,), -9.0, 0.0).astype(np.float32)
    explore = Exploration(amount=40.0, key=(0x9E3779B9, 0x85EBCA6B))
    return [
        Inputs(
            explore=explore,
            quaternions=gaussians.quaternions,
            log_scales=gaussians.log_scales,
            opacity_logits=logits,
        )
    ]


def _launch_noise(device: Device, _: Workspace, given: Inputs) -> Read:
    count = len(given.opacity_logits)
    # The means are 0, so that adding the noise rounds nothing.
    means, sh = np.zeros((count, 3), np.float32), np.zeros((count, 1, 3), np.float32)
    held = upload_gaussians(device, Gaussians(means, given.quaternions, given.log_scales, given.opacity_logits, sh))
    noise(device, given.explore, held, 0, fresh_readback(device))
    return lambda: {name: held[name].get() for name in ("means", *GEOMETRY_ARRAYS)}


def _twin_of_noise(given: Inputs, got: Arrays) -> dict[str, Expected]:
    quaternions, log_scales, logits = given.wide(*GEOMETRY_ARRAYS)
    wanted = displacements(given.explore, quaternions, log_scales, logits)
    stays = given.opacity_logits >= highest_logit(given.explore.dead)
    got |= {"moved means": got["means"][~stays], "means that must not move": got["means"][stays]}
    size = np.abs(wanted) + 0.1 * np.abs(wanted).max(initial=0)
    return {
        "means": Expected(wanted, 5e-6),  # an ulp of the opacity o changes the noise by 1e-6 of itself
        "moved means": Expected(wanted[~stays], 1e-4, size[~stays]),
        "means that must not move": exactly(np.zeros_like(got["means that must not move"])),
        **{name: exactly(getattr(given, name)) for name in GEOMETRY_ARRAYS},
    }


NOISE_CASE = Case(
    sizes=(1, 63, 64, 65, 203),
    random=_random_noise,
    launch=_launch_noise,
    twin=_twin_of_noise,
    frozen=_frozen_noise,
    digested=("means",),
)


def random_scene(rng: Generator, count: int) -> Inputs:
    """A random camera, and Gaussians with SH of degree 1, most of them in front of the camera and some behind it."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    camera = Camera(70, 50, 60.0, 65.0, 30.0, 27.0, rotation, rng.normal(size=3))
    depths = rng.uniform(1.0, 6.0, count) * np.where(np.arange(count) % 5 == 3, -1, 1)
    local = np.concatenate([rng.uniform(-0.4, 0.4, (count, 2)) * depths[:, None], depths[:, None]], axis=1)
    arrays = (
        *((local - camera.translation) @ rotation, rng.normal(size=(count, 4)), rng.uniform(-5, -1, (count, 3))),
        *(rng.uniform(-6, 6, count), rng.normal(0, 0.3, (count, 4, 3))),
    )
    means, quaternions, log_scales, logits, sh = (np.ascontiguousarray(each, np.float32) for each in arrays)
    gaussians = Gaussians(means, quaternions, log_scales, logits, sh)
    return Inputs(gaussians=gaussians, camera=camera, explore=Exploration(*10 ** rng.uniform(-3, 1, 2)))


def _launch_penalties(device: Device, work: Workspace, given: Inputs) -> Read:
    """Compute the gradient of the penalties alone, with slots of zeros as the loss's gradient."""
    model, camera_array = upload_gaussians(device, given.gaussians), upload(device, pack_camera(given.camera))
    projected = project(device, work, model, given.camera, camera_array)
    gradients = allocate_gaussians(device, model.count, model.coefficients, zero=True)
    slots = Slots(upload(device, np.zeros((model.count, SLOT_PLAIN), np.float32)))
    screen = Screen(upload(device, np.zeros((model.count, 2), np.float32)))
    project_grad(device, model, ViewSlots(camera_array, projected, slots), gradients, screen, explore=given.explore)
    return lambda: {
        **{group: gradients[group].get() for group in PARAMETER_GROUPS},
        "shown": projected.tile_counts.get() > 0,
    }


def _twin_of_penalties(given: Inputs, got: Arrays) -> dict[str, Expected]:
    gaussians, shown = given.gaussians, got.pop("shown")
    parts = penalty_grad(given.explore, *(getattr(gaussians, name).astype(np.float64) for name in GEOMETRY_ARRAYS[1:]))
    wanted: dict[str, Expected] = {}
    for name, values in zip(GEOMETRY_ARRAYS[1:], parts, strict=True):
        got[f"{name} out of view"] = got[name][~shown]
        wanted |= {
            name: Expected(values, 1e-6, compared=shown),
            f"{name} out of view": exactly(np.zeros_like(values[~shown])),
        }
    others = [group for group in PARAMETER_GROUPS if group not in GEOMETRY_ARRAYS[1:]]
    return wanted | {group: exactly(np.zeros_like(got[group])) for group in others}


PENALTIES_CASE = Case(
    sizes=(1, 7, 8, 9, 63, 64, 65, 203),
    random=random_scene,
    launch=_launch_penalties,
    twin=_twin_of_penalties,
    frozen=lambda bench: [
        Inputs(gaussians=bench.frozen.gaussians, camera=bench.camera, explore=Exploration(opacity=0.3125, scale=0.6875))
    ],
    digested=tuple(PARAMETER_GROUPS),
)
