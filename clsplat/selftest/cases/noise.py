# SPDX-License-Identifier: Apache-2.0
"""The noise of MCMC on means, and penalties on opacity and scale."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians
from clsplat.layouts.columns import SLOT_PLAIN
from clsplat.optimisation.step_noise import Exploration, step_key
from clsplat.reference.noise import displacements, penalty_grad
from clsplat.selftest.case import Arrays, Case, Given, Read, Wanted, exactly, fresh_readback
from clsplat.selftest.harness import CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import allocate_gaussians, upload_gaussians
from clsplat.stages.noise import highest_logit, noise
from clsplat.stages.project import Screen, Slots, project, project_grad

GEOMETRY_ARRAYS = ("quaternions", "log_scales", "opacity_logits")


def _random(rng: Generator, count: int) -> Given:
    """Gaussians of nearly any opacity, needles and discs among them."""
    explore = Exploration(amount=10 ** rng.uniform(-3, 3), key=step_key(0, int(rng.integers(1 << 30))))
    logits = rng.uniform(-9, 0, count).astype(np.float32)
    logits[0] = -7.0  # one moves
    return Given(
        explore=explore,
        quaternions=(rng.standard_normal((count, 4)) * 10 ** rng.uniform(-3, 3, (count, 1))).astype(np.float32),
        log_scales=rng.uniform(-9, 2, (count, 3)).astype(np.float32),
        opacity_logits=logits,
    )


def _frozen(bench: CaseBench) -> list[Given]:
    gaussians, logits = bench.frozen.gaussians, evenly(39, (bench.model.count,), -9.0, 0.0).astype(np.float32)
    explore = Exploration(amount=40.0, key=(0x9E3779B9, 0x85EBCA6B))
    return [
        Given(
            explore=explore,
            quaternions=gaussians.quaternions,
            log_scales=gaussians.log_scales,
            opacity_logits=logits,
        )
    ]


def _launch(device: Device, _: Workspace, given: Given) -> Read:
    count = len(given.opacity_logits)
    means, sh = np.zeros((count, 3), np.float32), np.zeros((count, 1, 3), np.float32)  # so that no digit is lost
    arrays = {name: getattr(given, name) for name in GEOMETRY_ARRAYS}
    held = upload_gaussians(device, Gaussians(means=means, sh=sh, **arrays))
    noise(device, given.explore, held, 0, fresh_readback(device))
    return lambda: {name: held[name].get() for name in ("means", *GEOMETRY_ARRAYS)}


def _twin(given: Given, got: Arrays) -> dict[str, Wanted]:
    quaternions, log_scales, logits = given.wide(*GEOMETRY_ARRAYS)
    wanted = displacements(given.explore, quaternions, log_scales, logits)
    stays = given.opacity_logits >= highest_logit(given.explore.dead)
    got |= {"moves": got["means"][~stays], "means of the opaque": got["means"][stays]}
    size = np.abs(wanted) + 0.1 * np.abs(wanted).max(initial=0)
    return {
        "means": Wanted(wanted, 5e-6),  # of 100 (o - dead), up to 16, a digit of o is 1e-6 of the weight
        "moves": Wanted(wanted[~stays], 1e-4, size[~stays]),
        "means of the opaque": exactly(np.zeros_like(got["means of the opaque"])),
        **{name: exactly(getattr(given, name)) for name in GEOMETRY_ARRAYS},
    }


NOISE_CASE = Case(
    sizes=(1, 63, 64, 65, 203),
    random=_random,
    launch=_launch,
    twin=_twin,
    frozen=_frozen,
    digested=("means",),
    by_shape=False,
)


def random_scene(rng: Generator, count: int) -> Given:
    """Gaussians with SH of degree 1 before a camera, and some behind it."""
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
    return Given(gaussians=gaussians, camera=camera, explore=Exploration(*10 ** rng.uniform(-3, 1, 2)))


def _launch_penalties(device: Device, work: Workspace, given: Given) -> Read:
    """The gradient of a loss that is 0."""
    model, camera_array = upload_gaussians(device, given.gaussians), upload(device, pack_camera(given.camera))
    projected = project(device, work, model, given.camera, camera_array)
    gradients = allocate_gaussians(device, model.count, model.coefficients, zero=True)
    slots = Slots(upload(device, np.zeros((model.count, SLOT_PLAIN), np.float32)))
    screen = Screen(upload(device, np.zeros((model.count, 2), np.float32)))
    project_grad(device, model, camera_array, projected, slots, gradients, screen, explore=given.explore)
    return lambda: {
        **{group: gradients[group].get() for group in PARAMETER_GROUPS},
        "shown": projected.tile_counts.get() > 0,
    }


def _twin_of_penalties(given: Given, got: Arrays) -> dict[str, Wanted]:
    gaussians, shown = given.gaussians, got.pop("shown")
    parts = penalty_grad(given.explore, *(getattr(gaussians, name).astype(np.float64) for name in GEOMETRY_ARRAYS[1:]))
    wanted: dict[str, Wanted] = {}
    for name, values in zip(GEOMETRY_ARRAYS[1:], parts, strict=True):
        got[f"{name} out of view"] = got[name][~shown]
        wanted |= {
            name: Wanted(values, 1e-6, sure=shown),
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
        Given(gaussians=bench.frozen.gaussians, camera=bench.camera, explore=Exploration(opacity=0.3125, scale=0.6875))
    ],
    digested=tuple(PARAMETER_GROUPS),
)
