# SPDX-License-Identifier: Apache-2.0
"""Cases of a model's chunks: bounds, a training step over some chunks, catching up missed steps of Adam, and copies of
chunks to and from the slots of a pool."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from clsplat.chunks.division import chunks_of
from clsplat.chunks.store import record_type
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, Workspace, upload
from clsplat.device.context import Device
from clsplat.gaussians import PARAMETER_GROUPS, Gaussians, group_shapes
from clsplat.layouts.columns import CHUNK_ROWS, SLOT_PLAIN, SPLAT
from clsplat.models.edit import take
from clsplat.reference.bounds import bounds as bounds_twin
from clsplat.reference.catch_up import catch_up as catch_up_twin
from clsplat.reference.chunk_records import to_records, to_slots
from clsplat.selftest.case import Arrays, Case, Expected, Inputs, Read, exactly, fresh_readback, read_of
from clsplat.selftest.cases.density import STATISTICS_CASE
from clsplat.selftest.cases.steps import ADAM_CASE, ADAM_ENDS, ADAM_RATES, random_scene, uploaded_groups
from clsplat.selftest.harness import Array, CaseBench
from clsplat.selftest.scenes import evenly
from clsplat.stages.adam import AdamStep, adam, add_view
from clsplat.stages.bounds import bounds
from clsplat.stages.catch_up import StepTable, catch_up, step_table
from clsplat.stages.chunk_lists import ChunkList, padded_chunks
from clsplat.stages.chunk_records import copy_chunks
from clsplat.stages.density import add_contributions, add_statistics, new_statistics
from clsplat.stages.device_camera import pack_camera
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, host_gaussians, upload_gaussians
from clsplat.stages.project import Projected, Screen, Slots, ViewSlots, project, project_grad, project_step

SIZES = (1, CHUNK_ROWS + 1, CHUNK_ROWS, 3 * CHUNK_ROWS + 129, 65)


def _some_chunks(rng: Generator, count: int) -> NDArray[np.uint32]:
    """Numbers of chunks at random: the first and about 70 % of the others. count: number of rows of the model."""
    taken = rng.random(-(-count // CHUNK_ROWS)) < 0.7
    taken[0] = True
    return np.flatnonzero(taken).astype(np.uint32)


def _listed(device: Device, given: Inputs) -> ChunkList:
    return ChunkList(upload(device, padded_chunks(given.numbers)), len(given.gaussians))


def _random_bounds(rng: Generator, count: int) -> Inputs:
    """Random inputs for bounds of chunks: means and log scales of any magnitude, infinite, or NaN.

    numbers: numbers of the chunks whose bounds are computed.
    """
    gaussians = random_scene(rng, count).gaussians
    for array in (gaussians.means, gaussians.log_scales):
        values = array * 10 ** rng.uniform(-3, 9, (count, 1))
        strange = rng.choice([np.nan, np.inf, -np.inf], array.shape)
        array[:] = np.where(rng.random(array.shape) < 0.1, strange, values)
    return Inputs(gaussians=gaussians, numbers=_some_chunks(rng, count))


def _frozen_model(bench: CaseBench) -> Gaussians:
    """The scene's Gaussians, repeated until they fill two chunks and a part of a third. Copies are shifted at
    random."""
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
    wanted = bounds_twin(given.gaussians.means, given.gaussians.log_scales)[given.numbers]
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
STATE = ("parameters", *MOMENTS)
CURRENT = ("current_totals", "current_largest")
"""Names of the two statistics of contributions (sum and maximum over views) that the tested view updates."""
BEGIN = 0.5
"""Value of the statistics in CURRENT before the tested view updates them."""
STEP = 7
"""Number of the tested step of Adam. The first step of a training has number 1."""
AREA = 2.0
"""Factor of contributions: full-resolution pixels per pixel of the image."""


def _random_step(rng: Generator, count: int) -> Inputs:
    """Random inputs of a training step: a view of a model, and the state of Adam.

    numbers: the chunks that take part in the step.
    slots: (n, SLOT_PLAIN), one row for each of the n Gaussians. All slots of a Gaussian have the values of its row.
    contributions: (n,), the Gaussians' contributions to the image.
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
    numbers = np.array([0, *range(2, -(-count // CHUNK_ROWS))], np.uint32)  # all chunks but chunk 1
    return [
        Inputs(
            gaussians=gaussians,
            camera=bench.camera,
            moments=made,
            slots=slots,
            contributions=contributions,
            numbers=numbers,
            sparse=sparse,
        )
        for sparse in (False, True)
    ]


def _rows(given: Inputs) -> NDArray[np.int64]:
    """Return the model's rows, in ascending order, that are in the chunks which take part in the step."""
    rows = np.arange(len(given.gaussians))
    return rows[np.isin(rows // CHUNK_ROWS, given.numbers)]


def _slots(device: Device, projected: Projected, values: Array) -> Slots:
    """Fill the slots of all pairs with synthetic gradients.

    values: (rows, SLOT_PLAIN), for each row of the launch, the values of every slot of its Gaussian.
    """
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
    # A faulty kernel may make rows past the model visible, but statistics have no rows there.
    counts[len(rows) :] = 0
    some = Projected(some.splats, upload(device, counts), chunks=chunks)
    screen = Screen(upload(device, np.zeros((chunks.rows, 2), np.float32)), by_row)
    view = ViewSlots(camera_array, some, _slots(device, some, given.slots[rows]))
    step = AdamStep(OptimiserConfig(sparse=given.sparse), STEP, ADAM_RATES)
    read_batch = _launch_batch(device, given, chunks, view, screen, step)
    model = (held, *uploaded_groups(device, given.moments))
    project_step(device, step, model, view, screen, fresh_readback(device))
    statistics = new_statistics(device, held.count, contributions=True)
    statistics.load({name: np.full(held.count, BEGIN, np.float32) for name in CURRENT})
    add_statistics(device, statistics, given.camera, some, screen)
    add_contributions(device, statistics, some, by_row, AREA)

    return lambda: {
        **{name: _flat(each) for name, each in zip(("parameters", *MOMENTS), model, strict=True)},
        **{name: array.get() for name, array in statistics.named().items()},
        "counts": counts[: len(rows)],
        "counts past the model": past,
        "splats": some.splats.get()[: len(rows)],
        **read_batch(),
        **read_whole(),
    }


def _launch_batch(
    device: Device,
    given: Inputs,
    chunks: ChunkList,
    view: ViewSlots,
    screen: Screen,
    step: AdamStep,
) -> Read:
    """Take the step with kernels of a step of several views: gradients of the listed chunks, their sums, then Adam."""
    parameters, (first, second) = upload_gaussians(device, given.gaussians), uploaded_groups(device, given.moments)
    gradients, sums = (allocate_gaussians(device, chunks.rows, parameters.coefficients, zero=True) for _ in range(2))
    project_grad(device, parameters, view, gradients, screen)
    places = np.arange(chunks.numbers.shape[0], dtype=np.uint32)
    in_sums = ChunkList(upload(device, places[::-1].copy()), sums.count)  # another order than that of the view
    add_view(device, view.projected.tile_counts, gradients, sums, places=in_sums)
    listed = ChunkList(upload(device, chunks.numbers.get()[::-1].copy()), chunks.model_rows)
    adam(device, step, parameters, sums, first, second, chunks=listed)
    model = (parameters, first, second)
    return lambda: {f"batch {name}": _flat(each) for name, each in zip(STATE, model, strict=True)}


def _launch_whole(device: Device, given: Inputs, held: DeviceGaussians, camera_array: DeviceArray) -> Read:
    """Launch the projection of the whole model, and the gradient of this projection."""
    whole = project(device, Workspace(device), held, given.camera, camera_array)
    gradients = allocate_gaussians(device, held.count, held.coefficients, zero=True)
    screen = Screen(upload(device, np.zeros((held.count, 2), np.float32)))
    view = ViewSlots(camera_array, whole, _slots(device, whole, given.slots))
    project_grad(device, held, view, gradients, screen)
    arrays = {"whole counts": whole.tile_counts, "whole splats": whole.splats, "whole screen": screen.gradients}
    return lambda: {**read_of(arrays)(), **{g: gradients[g].get() for g in PARAMETER_GROUPS}}


def _flat(model: DeviceGaussians) -> Array:
    return np.concatenate([model[group].get().ravel() for group in PARAMETER_GROUPS])


def _twin_of_step(given: Inputs, got: Arrays) -> dict[str, Expected]:
    """Expect in the step's chunks the values that the twin computes by a step over the whole model.

    The twin gets the projection and its gradient from the device, because other stages test them.
    """
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
        # in each of the two projections, a division or a root may be off by 3 ulp
        "splats": Expected(splats[rows][shown][:, columns].astype(np.float64), 1e-5),
        **STATISTICS_CASE.twin(Inputs(views=[view], camera=given.camera), got),
    }
    added = np.where(view[1] > 0, np.float32(AREA) * given.contributions, 0).astype(np.float64)
    wanted["current_totals"] = Expected(BEGIN + added, 1e-6, BEGIN + added)  # one rounding of a sum
    wanted["current_largest"] = exactly(np.maximum(BEGIN, added))
    return wanted | _twin_of_adam(given, got, listed)


def _twin_of_adam(given: Inputs, got: Arrays, listed: NDArray[np.bool_]) -> dict[str, Expected]:
    gradients = {group: got.pop(group) for group in PARAMETER_GROUPS}
    for values in gradients.values():
        values[~listed] = 0
    model = host_gaussians(given.gaussians, len(listed))
    parameters = {group: model[group].get() for group in PARAMETER_GROUPS}
    arrays = {"parameters": parameters, "gradients": gradients, **given.moments}
    # "sparse" updates the elements with a gradient, "late" the rows of `visible`.
    rows = "sparse" if given.sparse else "late"
    step = Inputs(arrays=arrays, rows=rows, step=STEP, visible=listed, rates=ADAM_RATES)
    got["gradients"] = np.zeros(0)  # project_step keeps no gradients in memory
    of_batch: dict[str, Array] = {name: got[f"batch {name}"] for name in STATE}
    of_batch["gradients"] = np.zeros(0)
    wanted = {f"batch {name}": each for name, each in ADAM_CASE.twin(step, of_batch).items()}
    got.update({f"batch {name}": each for name, each in of_batch.items()})
    return {**wanted, **ADAM_CASE.twin(step, got)}


CHUNKS_CASE = Case(
    sizes=SIZES,
    random=_random_step,
    launch=_launch_step,
    twin=_twin_of_step,
    frozen=_frozen_steps,
    digested=("parameters", *MOMENTS, "gradient_sums", "seen", "radii", "current_totals", "current_largest"),
)


def _random_missed(rng: Generator, count: int) -> Inputs:
    """Random inputs of catch-up: a model of which some chunks take the steps of Adam that they missed.

    The moments have any magnitude, and some are zero.
    last: the last step that a chunk has taken, by the chunk's number. Only the chunks in `last` are caught up.
    first_step: number of the first step in `rates`. No chunk missed an earlier step.
    rates: learning rates by the step's number and by parameter group.
    every: number of steps between updates of the SH bands from degree 1 on.
    """
    span, before = int(rng.choice([1, 7, 40, 300])), int(rng.choice([0, 1, 100, 30_000]))
    chunks = -(-count // CHUNK_ROWS)
    last = {chunk: before + int(rng.integers(span)) for chunk in range(chunks) if chunk == 0 or rng.random() < 0.7}
    made: dict[str, Arrays] = {name: {} for name in STATE}
    for group, shape in group_shapes(count, int(rng.choice([1, 4, 9, 16]))).items():
        size = 10 ** rng.uniform(-9, 6, shape)  # moments far above Adam's epsilon
        made["parameters"][group] = rng.standard_normal(shape).astype(np.float32)
        made["first"][group] = (rng.standard_normal(shape) * size * (rng.random(shape) < 0.9)).astype(np.float32)
        made["second"][group] = (rng.uniform(0.1, 1.0, shape) * size**2).astype(np.float32)
    highest = {group: 10 ** rng.uniform(-5, -1) for group in PARAMETER_GROUPS}
    rates = {before + k: {group: rate * 0.99**k for group, rate in highest.items()} for k in range(1, span + 1)}
    return Inputs(arrays=made, first_step=before + 1, last=last, rates=rates, every=int(rng.choice([1, 3])))


def _frozen_missed(bench: CaseBench) -> list[Inputs]:
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


def _launch_catch_up(device: Device, _: Workspace, given: Inputs) -> Read:
    config = OptimiserConfig(sh_rest_every=given.every)
    models, readback = uploaded_groups(device, given.arrays), fresh_readback(device)
    numbers = padded_chunks(np.array(list(given.last), np.uint32))
    last = np.zeros(len(numbers), np.uint32)
    last[: len(given.last)] = list(given.last.values())
    table = step_table(AdamStep(config, number, rates) for number, rates in given.rates.items())
    chunks, step = ChunkList(upload(device, numbers), models[0].count), max(given.rates)
    caught = upload(device, np.zeros(-(-models[0].count // CHUNK_ROWS), np.uint32))
    uploaded = upload(device, last), caught, step, StepTable(upload(device, table), given.first_step)
    catch_up(device, config, tuple(models), chunks, *uploaded, readback)
    by_name = dict(zip(given.arrays, models, strict=True))
    return lambda: {
        name: np.concatenate([model[g].get().ravel() for g in PARAMETER_GROUPS]) for name, model in by_name.items()
    }


def _twin_of_catch_up(given: Inputs, got: Arrays) -> dict[str, Expected]:
    before = {
        group: tuple(arrays[group].astype(np.float64) for arrays in given.arrays.values()) for group in PARAMETER_GROUPS
    }
    after = catch_up_twin(before, CHUNK_ROWS, given.last, given.rates, given.every)
    made: dict[str, list[Array]] = {name: [] for name in (*STATE, "moves", "listed")}
    for group, state in after.items():
        p = before[group][0]
        rows = np.isin(np.arange(len(p)) // CHUNK_ROWS, list(given.last))
        listed = np.broadcast_to(rows.reshape(-1, *[1] * (p.ndim - 1)), p.shape)
        for values, into in zip((*state, np.abs(state[0] - p) + np.abs(p), listed), made.values(), strict=True):
            into.append(values.ravel())
    parameters, first, second, moves, listed = (np.concatenate(found) for found in made.values())
    wanted = {
        # Parameters move for up to 150 steps, and each step rounds them by 6e-8 of their size.
        # The betas in float32 are off by 3e-8, which changes a movement over some 30 steps by 1e-6 of it.
        "parameters": Expected(parameters, 1e-5, moves, listed),
        # In each of up to 300 steps a moment is rounded, and multiplied by a beta that is off by up to 2.6e-8.
        "first": Expected(first, 3e-5, np.abs(first), listed),
        "second": Expected(second, 3e-5, second, listed),
    }
    for name in STATE:
        got[f"{name} of other chunks"] = got[name][~listed]
        wanted[f"{name} of other chunks"] = exactly(wanted[name].values[~listed])
    return wanted


CATCH_UP_CASE = Case(
    sizes=(1, 37, CHUNK_ROWS + 1, 9, CHUNK_ROWS, 2 * CHUNK_ROWS + 129, 65),
    random=_random_missed,
    launch=_launch_catch_up,
    twin=_twin_of_catch_up,
    frozen=_frozen_missed,
    digested=STATE,
)


SPARE_SLOTS = 2
"""Number of the pool's slots that no copy uses."""
MADE_WORDS = 4999
"""Number of words that are repeated to fill records. No record's length is a multiple of it, so all records differ."""


def _records_of(words: NDArray[np.uint32], slots: NDArray[np.int64], coefficients: int) -> Inputs:
    """Make a pool of chunks and records, as inputs of copies from the pool to records and from records to the pool.

    slots: numbers of the pool's slots that are copied.
    words: 32-bit words, repeated to fill the pool, and in reverse order to fill the records.
    coefficients: number of SH coefficients of a Gaussian.
    """
    fields: dict[str, tuple[int, ...]] = {"logit": (), "mean": (3,), "rest": (coefficients - 1, 3)}
    record = record_type(fields)
    count, of_pool, width = len(slots), len(slots) + SPARE_SLOTS, record.itemsize // 4
    held = np.resize(words, (of_pool, width)).view(record).reshape(-1)
    return Inputs(
        record=record,
        slots=slots.astype(np.uint32),
        records=np.resize(words[::-1], (count, width)),
        caught=np.resize(words, of_pool),
        steps=np.resize(words[::-1], count),
        pool={name: np.ascontiguousarray(held[name]) for name in record.names or ()},
    )


def _random_records(rng: Generator, count: int) -> Inputs:
    """Records of random words, a third of them NaN, of a model of `count` rows. The slots are in random order."""
    chunks = chunks_of(count)
    words = rng.integers(0, 1 << 32, MADE_WORDS, dtype=np.uint32)
    words[::3] |= 0x7F800000  # NaN with random payloads
    slots = rng.permutation(chunks + SPARE_SLOTS)[:chunks]
    return _records_of(words, slots, int(rng.choice([1, 4, 16])))


def _frozen_records(bench: CaseBench) -> list[Inputs]:
    # The factor is odd, so no word occurs twice.
    words = np.arange(1, MADE_WORDS + 1, dtype=np.uint32) * np.uint32(2654435761)
    return [_records_of(words, np.array([3, 0, 4]), bench.model.coefficients)]


def _words_of(fields: Mapping[str, Array]) -> dict[str, NDArray[np.uint32]]:
    return {name: values.view(np.uint32).reshape(len(values), -1) for name, values in fields.items()}


def _launch_records(device: Device, _: Workspace, given: Inputs) -> Read:
    """Copy chunks from the slots to records, then other records to the slots."""
    crossing = np.concatenate([given.records.reshape(-1), given.steps])
    slots, read = upload(device, given.slots), upload(device, np.zeros_like(crossing))
    arrays, caught = {name: upload(device, values) for name, values in given.pool.items()}, upload(device, given.caught)
    copy_chunks(device, slots, read, given.record, arrays, caught, to_records=True)
    copy_chunks(device, slots, upload(device, crossing), given.record, arrays, caught, to_records=False)

    def after() -> Arrays:
        words = _words_of({name: array.get() for name, array in arrays.items()})
        records, steps = np.split(read.get(), [given.records.size])
        in_slots = {"pool": np.hstack(list(words.values())), "caught": caught.get()}
        return {"records": records.reshape(given.records.shape), "steps": steps, **in_slots}

    return after


def _twin_of_records(given: Inputs, _: Arrays) -> dict[str, Expected]:
    before = _words_of(given.pool) | {"caught": given.caught[:, None]}
    *records, steps = np.hsplit(to_records(given.slots, before), [given.records.shape[1]])
    after = to_slots(given.slots, np.column_stack([given.records, given.steps]), before)
    caught = after.pop("caught")
    return {
        "records": exactly(records[0]),
        "steps": exactly(steps[:, 0]),
        "pool": exactly(np.hstack(list(after.values()))),
        "caught": exactly(caught[:, 0]),
    }


CHUNK_RECORDS_CASE = Case(
    sizes=(1, 33 * CHUNK_ROWS, CHUNK_ROWS + 1, 9 * CHUNK_ROWS),
    random=_random_records,
    launch=_launch_records,
    twin=_twin_of_records,
    frozen=_frozen_records,
    digested=("records", "pool"),
    by_shape=False,
)
