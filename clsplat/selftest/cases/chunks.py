# SPDX-License-Identifier: Apache-2.0
"""Cases of chunks: their bounds, and a step over some chunks of a model."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS, SLOT_PLAIN, SPLAT
from clsplat.models.edit import take
from clsplat.reference.bounds import bounds as reference
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback, read_of
from clsplat.selftest.cases.density import STATISTICS_CASE
from clsplat.selftest.cases.steps import ADAM_CASE, ADAM_ENDS, ADAM_RATES, random_scene, uploaded_groups
from clsplat.selftest.harness import Array, CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.adam import AdamStep
from clsplat.stages.bounds import ChunkList, bounds, padded_chunks
from clsplat.stages.density import add_contributions, add_statistics, new_statistics
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, host_gaussians, upload_gaussians
from clsplat.stages.project import Projected, Screen, Slots, project, project_grad, project_step

SIZES = (1, CHUNK_ROWS + 1, CHUNK_ROWS, 3 * CHUNK_ROWS + 129, 65)


def _some_chunks(rng: Generator, count: int) -> NDArray[np.uint32]:
    """The first chunk, and most of the others."""
    taken = rng.random(-(-count // CHUNK_ROWS)) < 0.7
    taken[0] = True
    return np.flatnonzero(taken).astype(np.uint32)


def _listed(device: Device, given: Inputs) -> ChunkList:
    return ChunkList(upload(device, padded_chunks(given.numbers)), len(given.gaussians))


def _random_bounds(rng: Generator, count: int) -> Inputs:
    """Means and log scales of any magnitude, infinite, or NaN. numbers: chunks whose bounds are measured."""
    gaussians = random_scene(rng, count).gaussians
    for array in (gaussians.means, gaussians.log_scales):
        values = array * 10 ** rng.uniform(-3, 9, (count, 1))
        strange = rng.choice([np.nan, np.inf, -np.inf], array.shape)
        array[:] = np.where(rng.random(array.shape) < 0.1, strange, values)
    return Inputs(gaussians=gaussians, numbers=_some_chunks(rng, count))


def _frozen_model(bench: CaseBench) -> Gaussians:
    """The scene's Gaussians, repeated to two chunks and a part of another one. Repetitions are not at one place."""
    count = bench.model.count
    rows = np.arange(2 * CHUNK_ROWS + count)
    gaussians = take(bench.frozen.gaussians, rows % count)
    gaussians.means[:, :2] += (evenly(110, (len(rows), 2), -0.5, 0.5) * (rows >= count)[:, None]).astype(np.float32)
    return gaussians


def _frozen_bounds(bench: CaseBench) -> list[Inputs]:
    gaussians = _frozen_model(bench)
    gaussians.means[::7], gaussians.log_scales[3::7] = np.nan, np.nan
    return [Inputs(gaussians=gaussians, numbers=np.array(listed, np.uint32)) for listed in ([0, 1, 2], [0, 2], [1])]


def _launch_bounds(device: Device, work: Workspace, given: Inputs) -> Read:
    found = bounds(device, work, upload_gaussians(device, given.gaussians), _listed(device, given)).copy()
    return lambda: {"bounds": found}


def _twin_of_bounds(given: Inputs, _: Arrays) -> dict[str, Expected]:
    wanted = reference(given.gaussians.means, given.gaussians.log_scales)[given.numbers]
    empty = np.array([3 * [np.inf] + 4 * [-np.inf]])
    unused = len(padded_chunks(given.numbers)) - len(wanted)
    return {"bounds": exactly(np.concatenate([wanted, *unused * [empty]]))}


BOUNDS_CASE = Case(
    sizes=SIZES,
    random=_random_bounds,
    launch=_launch_bounds,
    twin=_twin_of_bounds,
    frozen=_frozen_bounds,
    digested=("bounds",),
)


MOMENTS = ("first", "second")
CURRENT = ("current_totals", "current_largest")
"""Statistics of contributions that a view changes."""
BEGIN = 0.5
"""Their values before the view."""
STEP = 7
"""Number of the step of Adam."""
AREA = 2.0
"""Full-resolution pixels per pixel of the image, by which contributions are multiplied."""


def _random_step(rng: Generator, count: int) -> Inputs:
    """A view of a model, and a step of Adam.

    numbers: chunks that take part in the step.
    slots: (n, SLOT_PLAIN), the values of each slot of a Gaussian.
    contributions: (n,), to the image.
    """
    scene = random_scene(rng, count)
    shapes = group_shapes(count, scene.gaussians.sh.shape[1])
    made = {name: {g: rng.uniform(*ADAM_ENDS[name], shape) for g, shape in shapes.items()} for name in MOMENTS}
    return Inputs(
        gaussians=scene.gaussians,
        camera=scene.camera,
        moments={name: {g: values.astype(np.float32) for g, values in by.items()} for name, by in made.items()},
        numbers=_some_chunks(rng, count),
        slots=(rng.integers(-512, 513, (count, SLOT_PLAIN)) / 1024).astype(np.float32),
        contributions=rng.random(count).astype(np.float32),
        sparse=bool(rng.random() < 0.5),
    )


def _frozen_steps(bench: CaseBench) -> list[Inputs]:
    gaussians = _frozen_model(bench)
    count = len(gaussians)
    shapes = group_shapes(count, bench.model.coefficients)
    made = {
        name: {
            group: evenly(120 + 8 * i + j, shapes[group], *ADAM_ENDS[name]).astype(np.float32)
            for j, group in enumerate(PARAMETER_GROUPS)
        }
        for i, name in enumerate(MOMENTS)
    }
    slots = evenly(111, (count, SLOT_PLAIN), -1.0, 1.0).astype(np.float32)
    contributions = evenly(112, (count,), 0.0, 1.0).astype(np.float32)
    numbers = np.array([0, *range(2, -(-count // CHUNK_ROWS))], np.uint32)  # all but one
    of_view: dict[str, object] = {"gaussians": gaussians, "camera": bench.camera, "moments": made}
    of_view |= {"slots": slots, "contributions": contributions, "numbers": numbers}
    return [Inputs(**of_view, sparse=sparse) for sparse in (False, True)]


def _rows(given: Inputs) -> NDArray[np.int64]:
    """Rows of the model, in order, that take part in the step."""
    rows = np.arange(len(given.gaussians))
    return rows[np.isin(rows // CHUNK_ROWS, given.numbers)]


def _slots(device: Device, projected: Projected, values: Array) -> Slots:
    """Slots of all pairs. values: those of a Gaussian's slots, by rows of the launch."""
    counts = projected.tile_counts.get().astype(np.int64)
    every = np.repeat(values, counts[: len(values)], axis=0)
    if len(every) == 0:
        every = np.zeros((1, SLOT_PLAIN), np.float32)
    return Slots(upload(device, every), upload(device, (np.cumsum(counts) - counts).astype(np.uint32)))


def _launch_step(device: Device, work: Workspace, given: Inputs) -> Read:
    held, chunks, rows = upload_gaussians(device, given.gaussians), _listed(device, given), _rows(given)
    camera_array = upload(device, pack_camera(given.camera))
    read_whole = _launch_whole(device, given, held, camera_array)
    some = project(device, work, held, given.camera, camera_array, chunks=chunks)
    counts, contributions = some.tile_counts.get(), np.zeros(chunks.rows, np.float32)
    contributions[: len(rows)] = given.contributions[rows]
    by_row = upload(device, contributions)
    past = counts[len(rows) :].copy()
    counts[len(rows) :] = 0  # if a broken kernel shows rows past the model, statistics would be written past its end
    some = Projected(some.splats, upload(device, counts))
    screen = Screen(upload(device, np.zeros((chunks.rows, 2), np.float32)), by_row)
    view = (camera_array, some, _slots(device, some, given.slots[rows]), screen)
    step = AdamStep(OptimiserConfig(sparse=given.sparse), STEP, ADAM_RATES)
    model = (held, *uploaded_groups(device, given.moments))
    project_step(device, step, model, *view, fresh_readback(device), chunks=chunks)
    statistics = new_statistics(device, held.count, contributions=True)
    statistics.load({name: np.full(held.count, BEGIN, np.float32) for name in CURRENT})
    add_statistics(device, statistics, given.camera, some, screen, chunks)
    add_contributions(device, statistics, some, by_row, AREA, chunks)

    return lambda: {
        **{name: _flat(each) for name, each in zip(("parameters", *MOMENTS), model, strict=True)},
        **{name: array.get() for name, array in statistics.named().items()},
        "counts": counts[: len(rows)],
        "counts past the model": past,
        "splats": some.splats.get()[: len(rows)],
        **read_whole(),
    }


def _launch_whole(device: Device, given: Inputs, held: DeviceGaussians, camera_array: DeviceArray) -> Read:
    """Projection and gradient of the whole model."""
    whole = project(device, Workspace(device), held, given.camera, camera_array)
    gradients = allocate_gaussians(device, held.count, held.coefficients, zero=True)
    screen = Screen(upload(device, np.zeros((held.count, 2), np.float32)))
    project_grad(device, held, camera_array, whole, _slots(device, whole, given.slots), gradients, screen)
    arrays = {"whole counts": whole.tile_counts, "whole splats": whole.splats, "whole screen": screen.gradients}
    return lambda: {**read_of(**arrays)(), **{g: gradients[g].get() for g in PARAMETER_GROUPS}}


def _flat(model: DeviceGaussians) -> Array:
    return np.concatenate([model[group].get().ravel() for group in PARAMETER_GROUPS])


def _twin_of_step(given: Inputs, got: Arrays) -> dict[str, Expected]:
    """What a step over the whole model does to the rows that take part. Its projection and gradient are the device's,
    which other stages test."""
    rows, counts = _rows(given), got.pop("whole counts")
    listed = np.isin(np.arange(len(counts)), rows)
    columns = [index for index, name in enumerate(SPLAT) if name != "UNUSED"]
    splats, screen = (got.pop(name) for name in ("whole splats", "whole screen"))
    shown = counts[rows] > 0
    got["splats"] = got["splats"][shown][:, columns]
    view = (splats, counts * listed, screen)
    wanted = {
        "counts": exactly(counts[rows]),
        "counts past the model": exactly(np.zeros_like(got["counts past the model"])),
        # a division or a root that is off by 3 ulp, in either projection
        "splats": Expected(splats[rows][shown][:, columns].astype(np.float64), 1e-5),
        **STATISTICS_CASE.twin(Inputs(views=[view], camera=given.camera), got),
    }
    added = np.where(view[1] > 0, np.float32(AREA) * given.contributions, 0).astype(np.float64)
    wanted["current_totals"] = Expected(BEGIN + added, 1e-6, BEGIN + added)  # a rounding of the sum
    wanted["current_largest"] = exactly(np.maximum(BEGIN, added))
    return wanted | _twin_of_adam(given, got, listed)


def _twin_of_adam(given: Inputs, got: Arrays, listed: NDArray[np.bool_]) -> dict[str, Expected]:
    gradients = {group: got.pop(group) for group in PARAMETER_GROUPS}
    for values in gradients.values():
        values[~listed] = 0
    model = host_gaussians(given.gaussians, len(listed))
    parameters = {group: model[group].get() for group in PARAMETER_GROUPS}
    arrays = {"parameters": parameters, "gradients": gradients, **given.moments}
    rows = "sparse" if given.sparse else "late"  # which are those with a gradient, and those of `visible`
    step = Inputs(arrays=arrays, rows=rows, step=STEP, visible=listed, rates=ADAM_RATES)
    got["gradients"] = np.zeros(0)  # which Adam by itself sets to zero
    return dict(ADAM_CASE.twin(step, got))


CHUNKS_CASE = Case(
    sizes=SIZES,
    random=_random_step,
    launch=_launch_step,
    twin=_twin_of_step,
    frozen=_frozen_steps,
    digested=("parameters", *MOMENTS, "gradient_sums", "seen", "radii", "current_totals", "current_largest"),
)
