# SPDX-License-Identifier: Apache-2.0
"""Stages of what is learnt beside the model, or compared with it: gains, mixes, vignettes, grids, depths, poses and
lenses."""

from __future__ import annotations

from typing import Any

import numpy as np
from measuring import Result
from numpy.typing import NDArray
from planes import padded
from stress_cases import DEGREE, anisotropy, edge_on, focal_lengths, off_centre, ordinary
from stress_projection import exact, in_order, on_image, random_sums

from clsplat.device.buffers import Workspace, upload
from clsplat.device.context import Device
from clsplat.reference import appearance, grid, ppisp
from clsplat.reference.depth import depth_loss
from clsplat.reference.pose import pose_gradient
from clsplat.reference.project import lens_grad, project
from clsplat.stages import project as stages_project
from clsplat.stages.appearance import Gains, gain_gradient, remove_gains
from clsplat.stages.blend import Blended
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import allocate_gaussians, download_gaussians, upload_gaussians
from clsplat.stages.grid import GRID_SHAPE, Grids, apply_grid, grid_gradient
from clsplat.stages.loss import loss
from clsplat.stages.loss_terms import DepthTerm
from clsplat.stages.pose import LENS_NUMBERS, lens_rows, pose_rows, sum_of, sums_of
from clsplat.stages.ppisp import COLOUR_ENTRIES, VIGNETTE_ENTRIES, PhotoLens, camera_gradient, develop

Array = NDArray[Any]

BOUNDS = {
    "exposed": 3e-7,
    "by gains": 1e-6,
    "developed": 1e-5,
    "by cameras": 2e-6,
    "grid colours": 2e-6,
    "by grid": 1e-5,
    "through grid": 1e-5,
    "nearness loss": 1e-6,
    "by nearness": 3e-7,
    "by pose": 1e-6,
    "by lens": 1e-5,
}
"""exposed: two roundings, of 2^log and of the quotient. developed: relative to the pixel's largest, some roundings of
an exponent of up to 16, of 5e-7 each. by gains, by cameras, by pose, by lens: relative to the sum of the terms'
magnitudes, a few roundings of partial sums, and for cameras of a distance's third power; a lens's terms have the error
of the shape on the screen too. grid colours: relative to the largest, a dozen roundings. by grid, through grid: in
norm, where the level's slope is sure; a hundred terms of either sign. nearness loss: relative, a sum of partial sums.
by nearness: a product."""
MOST_FALLOFF = 16.0
"""Octaves to which kernels hold a vignette."""
LEVEL = 1e-4
"""Distance from a level of luminance under which a rounding decides the slope."""
KINDS = (ordinary, anisotropy, edge_on, off_centre, focal_lengths)


def pictures(rng: np.random.Generator) -> tuple[Array, Array]:
    """A render and a photograph: noise, flat, dark, nearly the same."""
    height, width = (int(rng.choice([1, 5, 16, 17, 40])) for _ in range(2))
    y = rng.random((height, width, 3)) ** rng.choice([0.2, 1.0, 8.0])
    if rng.random() < 0.3:
        y[:] = rng.random(3)
    apart = 10 ** rng.uniform(-4, 0)
    x = np.clip(y + rng.normal(0, apart, y.shape), 0, 1.5)
    return x.astype(np.float32), np.clip(y, 0, 1).astype(np.float32)


def cropped(planes: Array, height: int, width: int) -> Array:
    """The image (H, W, C) in planes."""
    return planes[:, :height, :width].transpose(1, 2, 0)


def exposures(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Gains of 1/256 to 256 taken from a photograph, and their gradient by gradients of any size."""
    worst, work = {"exposed": 0.0, "by gains": 0.0}, Workspace(device)
    for _ in range(many):
        image, photograph = pictures(rng)
        height, width, _ = image.shape
        gains = Gains.on(device, rng.uniform(-8, 8, (3, 3)).astype(np.float32))
        logs = gains.logs.get()[1].astype(float)
        target = upload(device, padded(photograph))
        remove_gains(device, gains, 1, target)
        wanted = appearance.removed(photograph.astype(float), logs)
        off = np.abs(cropped(target.get(), height, width) - wanted) / np.maximum(wanted, 1e-30)
        worst["exposed"] = max(worst["exposed"], float(off.max()))
        by_image = (rng.standard_normal(image.shape) * 10 ** rng.uniform(-9, 4)).astype(np.float32)
        columns = gain_gradient(device, work, upload(device, padded(image)), upload(device, padded(by_image)), height)
        got = np.log(2) * columns.get().astype(float).sum(axis=1)
        wide = image.astype(float), by_image.astype(float)
        size = np.log(2) * np.abs(wide[0] * wide[1]).sum(axis=(0, 1))
        apart = np.abs(got - appearance.gradient(*wide)) / np.maximum(size, 1e-30)
        worst["by gains"] = max(worst["by gains"], float(apart.max()))
    return worst


def by_cameras(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Gains of 1/256 to 256, any mixes, and vignettes to where they are held, taken from a photograph, and the gradient
    by them, with principal points beside the picture."""
    worst, work = {"developed": 0.0, "by cameras": 0.0}, Workspace(device)
    for _ in range(many):
        image, photograph = pictures(rng)
        height, width, _ = image.shape
        centre = (float(rng.uniform(-0.5, 1.5)), float(rng.uniform(-0.5, 1.5)))
        gains, mixes = rng.uniform(-8, 8, (3, 3)), rng.uniform(-0.2, 0.2, (3, 6))
        entries = np.concatenate([gains, mixes], axis=1).astype(np.float32)
        lenses = rng.uniform(-1, 0.2, (2, VIGNETTE_ENTRIES)).astype(np.float32)
        taken = PhotoLens(1, 1, centre)
        squared = ppisp.spread(width, height, (centre[0] * width, centre[1] * height))
        target = upload(device, padded(photograph))
        develop(device, Gains.on(device, entries), Gains.on(device, lenses), taken, target, width, height)
        within = np.abs(np.log2(ppisp.light(lenses[1].astype(float), squared))) < MOST_FALLOFF
        wanted = ppisp.developed(photograph.astype(float), entries[1].astype(float), lenses[1].astype(float), squared)
        off = np.abs(cropped(target.get(), height, width) - wanted).max(axis=2)
        largest = np.maximum(
            np.abs(wanted).max(axis=2), (photograph / np.exp2(entries[1, :3].astype(float))).max(axis=2)
        )
        worst["developed"] = max(worst["developed"], float((off / np.maximum(largest, 1e-30))[within].max(initial=0.0)))
        by_image = (rng.standard_normal(image.shape) * 10 ** rng.uniform(-9, 4)).astype(np.float32)
        planes = upload(device, padded(image)), upload(device, padded(by_image))
        got = camera_gradient(device, work, taken, *planes, width, height).get().astype(float).sum(axis=1)
        got *= np.where((np.arange(12) < 3) | (np.arange(12) >= COLOUR_ENTRIES), np.log(2), 1.0)
        wide = image.astype(float), by_image.astype(float)
        size = ppisp.gradient(wide[0], np.abs(wide[1]), squared)
        size[3:COLOUR_ENTRIES] = np.repeat(np.abs(wide[1]).sum(axis=(0, 1)) * np.abs(wide[0]).max(), 2)
        apart = np.abs(got - ppisp.gradient(*wide, squared)) / np.maximum(size, 1e-30)
        worst["by cameras"] = max(worst["by cameras"], float(apart.max()))
    return worst


def grids(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Grids from next to none to wild ones."""
    worst, work = {"grid colours": 0.0, "by grid": 0.0, "through grid": 0.0}, Workspace(device)
    for _ in range(many):
        image, _ = pictures(rng)
        height, width, _ = image.shape
        values = grid.identity(GRID_SHAPE[:3]) + rng.standard_normal((2, *GRID_SHAPE)) * 10 ** rng.uniform(-4, 0.5)
        stored = values.astype(np.float32)
        held, planes = Grids.on(device, stored), upload(device, padded(image))
        wide, own = image.astype(float), stored[1].astype(float)
        seen, wanted = apply_grid(device, work, held, 1, planes, width, height), grid.apply(wide, own)
        off = np.abs(cropped(seen.get(), height, width) - wanted).max() / max(1.0, float(np.abs(wanted).max()))
        worst["grid colours"] = max(worst["grid colours"], float(off))
        by_seen = (rng.standard_normal(image.shape) * 10 ** rng.uniform(-6, 2)).astype(np.float32)
        gradient = upload(device, padded(by_seen))
        by_grid = grid_gradient(device, work, held, 1, planes, gradient, width, height, 0.0).get()
        by_image, exact_grid = grid.gradient(wide, own, by_seen.astype(float))
        levels = wide @ grid.LUMINANCE_WEIGHTS * (GRID_SHAPE[0] - 1)
        sure = np.abs(levels - np.rint(levels)) > LEVEL
        got = cropped(gradient.get(), height, width)[sure]
        for name, found, right in (("by grid", by_grid, exact_grid), ("through grid", got, by_image[sure])):
            size = float(np.linalg.norm(right))
            if size > 0:
                worst[name] = max(worst[name], float(np.linalg.norm(found - right)) / size)
    return worst


def depths(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Nearness of 1e-6 to 1e6 against known ones, of which some, all or none are known."""
    worst, work = {"nearness loss": 0.0, "by nearness": 0.0}, Workspace(device)
    for _ in range(many):
        image, _ = pictures(rng)
        height, width, _ = image.shape
        size = 10 ** rng.uniform(-6, 6)
        nearness, aims, weights = (rng.random((height, width, 1)).astype(np.float32) for _ in range(3))
        nearness, aims = (np.float32(size) * plane for plane in (nearness, aims))
        weights *= rng.random(weights.shape) < rng.choice([0.0, 0.1, 1.0])
        planes, left = upload(device, padded(image)), padded(nearness)[0]
        stops = np.full(left.shape, -1, np.int32)
        stops[:height, :width] = 0
        made = Blended(planes, upload(device, np.zeros_like(left)), upload(device, stops), None, upload(device, left))
        factor = float(10 ** rng.uniform(-3, 3) / size)
        known = DepthTerm(np.concatenate([padded(aims), padded(weights)]), factor)
        result = loss(device, work, planes, planes, width, height, 0.2, blended=made, terms=(known,))
        near, at, weighted = (plane[:, :, 0].astype(float) for plane in (nearness, aims, weights))
        wanted, gradient = depth_loss(near, at, weighted, factor)
        if wanted > 0:  # of equal pictures nothing else is lost, but for a few roundings of 1
            off = abs(result.read()[0] - wanted) / max(1.0, wanted)
            worst["nearness loss"] = max(worst["nearness loss"], off)
        got = cropped(result.gradient.get(), height, width)[:, :, 3]
        apart = np.abs(got - gradient) / np.maximum(np.abs(gradient), 1e-30)
        worst["by nearness"] = max(worst["by nearness"], float(apart.max()))
    return worst


def cameras(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Poses and lenses of views of needles, discs, off centre, through any lens; from sums as blending makes them."""
    worst, work = {"by pose": 0.0, "by lens": 0.0}, Workspace(device)
    for turn in range(many):
        made = KINDS[turn % len(KINDS)](rng, 300)
        count, camera, sums = len(made.gaussians), made.camera, random_sums(rng, 300)
        model, packed = upload_gaussians(device, made.gaussians), upload(device, pack_camera(camera))
        projected = stages_project.project(device, work, model, camera, packed)
        gradients = allocate_gaussians(device, count, model.coefficients, zero=True)
        screen, by_lens = work.array("screen", (count, 2)), work.array("lens", (count, LENS_NUMBERS))
        slots = stages_project.Slots(upload(device, sums))
        view = (packed, projected, slots, gradients, stages_project.Screen(screen))
        stages_project.project_grad(device, model, *view, by_lens=by_lens)
        rows = sums_of(work, count)
        pose_rows(device, model, packed, projected.tile_counts, gradients, rows)
        got = sum_of(device, work, rows).get()[0]
        shown, back = projected.tile_counts.get() > 0, download_gaussians(gradients)
        arrays = exact(made.gaussians)
        means, turns, sh = (np.asarray(arrays[name], float) for name in ("means", "quaternions", "sh"))
        by = {name: np.asarray(getattr(back, name), float) for name in ("means", "quaternions", "sh")}
        terms = np.array(
            [
                pose_gradient(means[[i]], turns[[i]], sh[[i]], camera, DEGREE, {name: by[name][[i]] for name in by})
                for i in np.flatnonzero(shown)
            ]
        )
        off = np.abs(got - terms.sum(axis=0)) / np.maximum(np.abs(terms).sum(axis=0), 1e-30)
        worst["by pose"] = max(worst["by pose"], float(off.max()))
        rows = sums_of(work, count, LENS_NUMBERS)
        lens_rows(device, projected.tile_counts, by_lens, rows)
        got = sum_of(device, work, rows).get()[0]
        seen = project(*in_order(arrays), camera, DEGREE)
        sums[~shown] = 0
        wanted = lens_grad(*in_order(arrays)[:3], camera, seen, on_image(seen, sums))
        size = np.abs(by_lens.get()[shown].astype(float)).sum(axis=0)
        off = np.abs(got - wanted) / np.maximum(size, 1e-30)
        worst["by lens"] = max(worst["by lens"], float(off.max()))
    return worst


def learnt(device: Device, rng: np.random.Generator, many: int) -> Result:
    """Largest errors of all of these."""
    found: Result = {}
    for each in (exposures, by_cameras, grids, depths, cameras):
        found |= each(device, rng, many)
    return found
