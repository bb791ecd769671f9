# SPDX-License-Identifier: Apache-2.0
"""The core stages of the self-test: arithmetic, projection, tile lists, blending, the gradients of projection and
blending, and Adam. Each stage is compared with its float64 reference on a frozen scene.

The reference of a stage gets the device's output of the previous stage, so that errors do not add up. The bounds of the
errors are STAGE_BOUNDS_ULP of `selftest.result`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.launch import launch_items
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import SPLAT, TILE
from clsplat.reference import adam as reference_adam
from clsplat.reference import blend as reference_blend
from clsplat.reference import project as reference_project
from clsplat.reference.render import parameters, project_model
from clsplat.reference.tiles import touched_tiles
from clsplat.selftest.case import Inputs, fresh_readback
from clsplat.selftest.cases.steps import ADAM_CASE, uploaded_groups
from clsplat.selftest.harness import WHITENING_FACTOR, Array, CaseBench, StageOutcome, cropped
from clsplat.selftest.scenes import evenly, padded
from clsplat.selftest.synthetic_slots import SLOT_COLOURS, MadeUpSlots, slot_sums
from clsplat.stages.adam import AdamStep
from clsplat.stages.blend import blend, blend_grad, tile_items
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians
from clsplat.stages.duplicate import Pairs, count, duplicate
from clsplat.stages.project import Projected, Screen, project, project_grad, project_step
from clsplat.stages.ranges import tile_lists


def _arithmetic(bench: CaseBench) -> StageOutcome:
    device, n = bench.device, 4096
    a, b = evenly(21, (n,), 1.0, 2.0, 1 << 22), evenly(22, (n,), 1.0, 4.0, 1 << 20)
    c = evenly(23, (n,), -4.0, 4.0, 1 << 22)
    arrays = [upload(device, values.astype(np.float32)) for values in (a, b, c)]
    kernel = device.kernels("arithmetic").arithmetic

    def launch() -> DeviceArray:
        out = bench.work.array("arithmetic", (4, n))
        launch_items(device, kernel, n // device.shape.lanes, n, *arrays, out)
        return out

    _, outcome = bench.twice(launch, lambda out: [out.get()])
    (got,), trouble = outcome.arrays, outcome.trouble
    exact = {"division": a / b, "square root": np.sqrt(b), "fused multiply-add": a * b + c}
    errors = {}
    for (name, wanted), row in zip(exact.items(), got[:3], strict=True):
        error = np.abs(row.astype(np.float64) - wanted)
        errors[name] = (float(error.max()), float((error / np.spacing(np.abs(wanted).astype(np.float32))).max()))
    if (got[2] != exact["fused multiply-add"].astype(np.float32)).any():
        trouble = trouble or "fused multiply-adds are not rounded once"
    otherwise = [
        name for (name, wanted), row in zip(exact.items(), got, strict=False) if (row != wanted.astype(row.dtype)).any()
    ]
    if (got[3] != (a * 2.0**-140).astype(np.float32)).any():
        otherwise.append("denormal numbers")
    return StageOutcome([got[:3]], errors, outcome.ms, trouble, tuple(otherwise))


def _project(bench: CaseBench) -> StageOutcome:
    device, camera = bench.device, bench.camera
    columns = [index for index, name in enumerate(SPLAT) if name != "UNUSED"]

    def take(projected: Projected) -> list[Array]:
        counts = projected.tile_counts.get()
        return [projected.splats.get()[counts > 0][:, columns], counts]

    bench.projected, outcome = bench.twice(
        lambda: project(device, bench.work, bench.model, camera, bench.camera_array), take
    )
    gaussians = bench.frozen.gaussians
    wanted = project_model(gaussians, camera, gaussians.sh_degree)
    got, shown = bench.splats(), bench.visible & wanted.visible
    log2o = bench.projected.splats.get()[shown, SPLAT.index("LOG2O")]
    parts = {
        "mean": (got.means2d[shown], wanted.means2d[shown]),
        "whitening": (got.whitening[shown], wanted.whitening[shown]),
        "log2 of opacity": (log2o, np.log2(wanted.opacities[shown])),
        "depth": (got.depths[shown], wanted.depths[shown]),
        "colour": (got.colors[shown], wanted.colors[shown]),
        "extent": (got.half_extents[shown], wanted.half_extents[shown]),
    }
    touched = touched_tiles(wanted, camera.width, camera.height, TILE, reference_project.ALPHA_MIN * (1 + 1e-5))
    _, counts = outcome.arrays
    too_few = sum(len(tiles) > listed for tiles, listed in zip(touched, counts, strict=True))
    too_many = int((counts > _box_tiles(wanted, bench.tiles)).sum())
    return outcome.compared(parts, tile_counts=too_few + too_many)


def _box_tiles(projected: reference_project.ProjectedTwin, tiles: tuple[int, int]) -> NDArray[np.int64]:
    """Return an upper bound (n,) of the number of tiles that a Gaussian reaches; 0 if it is invisible.

    It counts the tiles of the Gaussian's bounding box, enlarged by half a pixel. tiles: numbers across and down.
    """
    low = np.floor((projected.means2d - projected.half_extents - 0.5) / TILE)
    high = np.floor((projected.means2d + projected.half_extents + 0.5) / TILE) + 1
    spans = np.clip(high, 0, tiles) - np.clip(low, 0, tiles)
    return np.where(projected.visible, spans.prod(axis=1), 0).astype(np.int64)


def _duplicate(bench: CaseBench) -> StageOutcome:
    device, work, projected = bench.device, bench.work, bench.projected

    def launch() -> Pairs:
        bench.counted = count(device, work, projected)
        return duplicate(device, work, projected.splats, bench.counted, bench.tiles, bench.band)

    bench.pairs, outcome = bench.twice(
        launch, lambda pairs: [pairs.tile_keys.get(), pairs.pair_ids.get(), bench.counted.first_slots.get()]
    )
    tile_keys, ids, first_slots = outcome.arrays
    counts, got = projected.tile_counts.get().astype(np.int64), bench.splats()
    order = got.order
    owners = np.repeat(order, counts[order])
    place = np.arange(len(owners)) - np.repeat(np.cumsum(counts[order]) - counts[order], counts[order])
    scanned = np.cumsum(counts) - counts
    wrong = int((first_slots != scanned).sum())
    if len(ids) != len(owners):
        return replace(outcome, trouble=f"{len(ids)} pairs were made, expected {len(owners)}")
    wrong += int((ids[:, 1] != owners).sum()) + int((ids[:, 0] != scanned[owners] + place).sum())
    # Each Gaussian's tiles must be in ascending order, and must include every tile that the Gaussian reaches.
    wrong += int((np.diff(tile_keys.astype(np.int64))[place[1:] > 0] <= 0).sum()) + int(
        (tile_keys >= bench.band.end).sum()
    )
    threshold = reference_project.ALPHA_MIN * (1 + 1e-5)
    touched = touched_tiles(got, bench.camera.width, bench.camera.height, TILE, threshold)
    listed = set(zip(owners.tolist(), tile_keys.tolist(), strict=True))
    missing = sum((gaussian, tile) not in listed for gaussian, tiles in enumerate(touched) for tile in tiles.tolist())
    return outcome.compared({}, pairs=wrong + missing)


def _ranges(bench: CaseBench) -> StageOutcome:
    bench.lists, outcome = bench.twice(
        lambda: tile_lists(bench.device, bench.work, bench.pairs, bench.band),
        lambda lists: [lists.ranges.get(), lists.gaussian_from_sorted.get(), lists.slot_from_sorted.get()],
    )
    tile_keys, ids = bench.pairs.tile_keys.get(), bench.pairs.pair_ids.get()
    order = np.argsort(tile_keys, kind="stable")
    ends = np.searchsorted(tile_keys[order], np.arange(bench.band.tiles), side="right")
    begins = np.searchsorted(tile_keys[order], np.arange(bench.band.tiles), side="left")
    wanted = np.where((ends > begins)[:, None], np.stack([begins, ends], axis=1), 0)
    exact = (wanted, ids[order, 1], ids[order, 0])
    wrong = sum(int((got != values).sum()) for got, values in zip(outcome.arrays, exact, strict=True))
    return outcome.compared({}, list_entries=wrong)


def _blend(bench: CaseBench) -> StageOutcome:
    device, camera = bench.device, bench.camera
    items = tile_items(device)
    bench.blended, outcome = bench.twice(
        lambda: blend(device, bench.work, bench.lists, bench.inputs, items=items),
        lambda blended: [blended.image.get(), blended.transmittance.get(), blended.stops.get()],
    )
    wanted, clear = bench.blend_reference()
    image, transmittance = (cropped(planes, camera)[clear] for planes in outcome.arrays[:2])
    exact = (wanted.image[clear], wanted.transmittance[clear])
    # Without `items`, a GPU divides the tiles of such a small frame among more work-items. The bits must be the same.
    other = blend(device, bench.work, bench.lists, bench.inputs)
    wrong = int((other.image.get() != outcome.arrays[0]).sum())
    parts = {"image": (image, exact[0]), "transmittance": (transmittance, exact[1])}
    return outcome.compared(parts, values_in_larger_groups=wrong)


def _pixels(bench: CaseBench, planes: Array) -> Float64:
    """Crop planes (3, rows, stride) to the camera's image (H, W, 3), in float64."""
    return cropped(planes, bench.camera).astype(np.float64)


def _blend_grad(bench: CaseBench) -> StageOutcome:
    device, camera, splats = bench.device, bench.camera, bench.splats()
    _, clear = bench.blend_reference()
    planes = padded(camera, 31, -0.5, 0.5)
    exact = planes.copy()
    exact[:, : camera.height, : camera.width] *= clear

    def launch(gradient: DeviceArray) -> DeviceArray:
        return blend_grad(device, bench.work, bench.lists, bench.inputs, bench.blended, gradient)

    given = upload(device, planes)
    _, outcome = bench.twice(lambda: launch(given), lambda slots: [slots.get()])
    got = slot_sums(bench, launch(upload(device, exact)).get())
    background = bench.frozen.background.astype(np.float64)
    wanted = reference_blend.blend_grad(splats, camera.width, camera.height, background, _pixels(bench, exact))
    shown = splats.visible
    moments = _moments(splats, wanted)
    parts = {
        "sum of g": (got[shown, :1], moments[shown, :1]),
        "first moments": (got[shown, 1:3], moments[shown, 1:3]),
        "second moments": (got[shown, 3:6], moments[shown, 3:6]),
        "colour": (got[shown, SLOT_COLOURS], wanted.colors[shown]),
    }
    return outcome.compared(parts)


def _moments(splats: reference_project.ProjectedTwin, wanted: reference_blend.BlendGradients) -> Float64:
    """Compute from the twin's gradients the sums (n, 6) that the slots of each Gaussian must add up to.

    They are sums of g, and the first and second moments of g, by equations (49) and (25) to (29) of docs/gradients.md.

    wanted: the twin's gradients with respect to the projected Gaussians `splats`.
    """
    l11, l12, l22 = (WHITENING_FACTOR * splats.whitening).T
    gx, gy = -(WHITENING_FACTOR**2) * wanted.means2d.T
    u = gx / l11
    v = (gy - l12 * u) / l22
    dxx, dxy, dyy = -2 * wanted.conics[:, 0], -wanted.conics[:, 1], -2 * wanted.conics[:, 2]
    uu = l11 * l11 * dxx + 2 * l11 * l12 * dxy + l12 * l12 * dyy
    uv = l22 * (l11 * dxy + l12 * dyy)
    return np.stack([wanted.opacities * splats.opacities, u, v, uu, uv, l22 * l22 * dyy], axis=1)


def _project_grad(bench: CaseBench) -> StageOutcome:
    """Test the gradient of projection with synthetic slots, so that errors in the gradient of blending do not
    matter."""
    device, n = bench.device, bench.model.count
    coefficients = bench.model.coefficients
    made, visible = MadeUpSlots.of(bench), bench.visible

    def launch() -> tuple[DeviceGaussians, Screen]:
        gradients = allocate_gaussians(device, n, coefficients, zero=True)
        screen = Screen(bench.work.array("screen", (n, 2)))
        project_grad(device, bench.model, made.view, gradients, screen)
        return gradients, screen

    def take(results: tuple[DeviceGaussians, Screen]) -> list[Array]:
        return [*(results[0][group].get() for group in PARAMETER_GROUPS), results[1].gradients.get()[visible]]

    _, outcome = bench.twice(launch, take)
    *by_group, on_image = outcome.arrays
    model, camera = bench.frozen.gaussians, bench.camera
    on_twin = (project_model(model, camera, model.sh_degree), made.on_image(bench))
    wanted = reference_project.project_grad(parameters(model), camera, model.sh_degree, *on_twin)
    got = dict(zip(PARAMETER_GROUPS, by_group, strict=True))
    parts = {name: (got[name][visible], wanted[name][visible]) for name in got if name in wanted}
    sh = np.concatenate([got["sh_dc"][:, None], got["sh_rest"]], axis=1)
    parts["SH"] = (sh[visible], wanted["sh"][visible])
    parts["means on the image"] = (on_image, made.d_means(bench)[visible])
    return outcome.compared(parts)


def _adam(bench: CaseBench) -> StageOutcome:
    """Test Adam in its own kernel (adam.cl), and fused with the gradient of projection (`project_step`)."""
    outcome = ADAM_CASE.outcome(bench)
    assert ADAM_CASE.frozen is not None
    wrong = sum(_steps_off(bench, given) for given in ADAM_CASE.frozen(bench))
    return replace(outcome, trouble=outcome.trouble or (f"{wrong} elements of project_step wrong" if wrong else ""))


def _steps_off(bench: CaseBench, given: Inputs) -> int:
    """Count the elements in which `project_step` differs from float64 Adam with the gradients of `project_grad`."""
    device, (n, coefficients) = bench.device, (bench.model.count, bench.model.coefficients)
    view = MadeUpSlots.of(bench).view
    gradients = allocate_gaussians(device, n, coefficients, zero=True)
    screen = Screen(bench.work.array("screen", (n, 2)))
    project_grad(device, bench.model, view, gradients, screen)
    before = {"parameters": {group: bench.model[group].get() for group in PARAMETER_GROUPS}}
    before |= {kind: dict(given.arrays[kind]) for kind in ("first", "second")}
    parameters, first, second = uploaded_groups(device, before)
    sparse = given.rows == "sparse"
    readback, step = fresh_readback(device), AdamStep(OptimiserConfig(sparse=sparse), given.step, given.rates)
    project_step(device, step, (parameters, first, second), view, screen, readback)
    wrong = int(readback.get().sum())
    for group, rate in given.rates.items():
        p, m, v = (before[kind][group].astype(np.float64) for kind in before)
        g = gradients[group].get().astype(np.float64)
        exact = reference_adam.adam(p, g, m, v, given.step, rate)
        stepped = g != 0 if sparse else np.ones_like(g, np.bool_)
        for kind, model, wanted in zip(before, (parameters, first, second), exact, strict=True):
            got = model[group].get()
            # beta2 in float32 is off by 1e-8. So 1 - beta2, a step and a new moment are off by 1e-5 of their size.
            off = np.abs(got - wanted) > 1e-5 * np.abs(wanted) + 1e-4 * (rate if kind == "parameters" else g**2 + 1e-6)
            wrong += int(off[stepped].sum()) + int((got[~stepped] != before[kind][group][~stepped]).sum())
    return wrong


CORE_STAGES: dict[str, Callable[[CaseBench], StageOutcome]] = {
    "arithmetic": _arithmetic,
    "project": _project,
    "duplicate": _duplicate,
    "ranges": _ranges,
    "blend": _blend,
    "blend_grad": _blend_grad,
    "project_grad": _project_grad,
    "adam": _adam,
}
