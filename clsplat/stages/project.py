# SPDX-License-Identifier: Apache-2.0
"""Launches project.cl and project_grad.cl: the projection of Gaussians to ellipses on the image, and its gradient."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.command_buffer import LaunchParameter, LaunchParameterWord
from clsplat.device.context import Device
from clsplat.device.launch import DEFAULT_GROUP_ITEMS, launch_groups, launch_items
from clsplat.device.profile import stage
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import PLAIN_SLOTS, SPLAT, SlotFields
from clsplat.optimisation.dropout import Thinning
from clsplat.optimisation.step_noise import NO_EXPLORATION, Exploration
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.stages.adam import AdamStep
from clsplat.stages.chunk_lists import ChunkList, ChunkNumbers
from clsplat.stages.device_camera import tiles_of
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, chunk_parts, parts
from clsplat.stages.region import region_build

CPU_STEP_ROWS = 128
"""Number of Gaussians per group of `project_step` on a CPU. Their gradients, 30 KiB, stay in the cache, and each array
is read in runs long enough for prefetching. With groups of a single vector a step takes 1.5 times as long."""

STEP_REGISTERS = 80
"""Maximum registers per item of `project_step`, where the driver accepts a limit. Adam is bound by memory latency, so
more items at a time help more than registers. Clang's code for NVIDIA spills nothing with 80, and 64 bytes with 72."""

COUNTING_REGISTERS, COUNTING_REGISTERS_OF_CHUNKS = 64, 72
"""Maximum registers per item of a projection that counts lists, where the driver accepts a limit: of the whole model,
and of some of its chunks. With as many, Clang's code for NVIDIA spills nothing; without a limit it has 116, which halve
the number of items at a time."""

SCREEN_GRADIENT_BYTES = 8
"""Bytes per Gaussian of the screen-space gradient; 4 more if contributions are kept."""


def gaussian_bytes(*, keeps_culled: bool) -> int:
    """Return the bytes per Gaussian of `Projected`: splat, tile count and, if `keeps_culled`, an entry of `shown`."""
    return 4 * (len(SPLAT) + 1 + keeps_culled)


@dataclass(frozen=True, eq=False)
class ListCounts:
    """Numbers of pairs of a tile and a Gaussian, which `project` counts for `stages.append.append`.

    lengths: (tiles + 1), the length of each tile's list, then the number of visible Gaussians.
    slots: (n,), for each Gaussian the number of pairs of earlier Gaussians in the same work-group.
    sums: (groups,), the number of pairs of each work-group.
    """

    lengths: DeviceArray
    slots: DeviceArray
    sums: DeviceArray


@dataclass(frozen=True, eq=False)
class Projected:
    """Projected Gaussians.

    splats: (n, SPLAT), in the columns of `layouts.columns.SPLAT`.
    tile_counts: (n), the number of tiles that each Gaussian reaches; 0 for a culled Gaussian.
    shown: (n), 0 for Gaussians without a splat, if frustum culling is switched off. Otherwise None, because Gaussians
    without a splat then have a tile count of 0.
    chunks: the chunks of the model whose Gaussians were projected; None for the whole model.
    list_counts: the numbers of pairs for lists by append; None if they were not counted.
    """

    splats: DeviceArray
    tile_counts: DeviceArray
    shown: DeviceArray | None = None
    chunks: ChunkList | None = None
    list_counts: ListCounts | None = None

    @property
    def chunk_defines(self) -> dict[str, object]:
        """Defines for kernels that run over the projected Gaussians and index the model's arrays. CHUNKS is set if only
        some chunks were projected: the kernel then finds rows by the list of chunks."""
        return {} if self.chunks is None else {"CHUNKS": True}

    @property
    def chunk_arguments(self) -> tuple[object, ...]:
        """Last arguments of kernels with `chunk_defines`: CHUNK_PARAMETERS of `kernels/shared/chunks.h`.

        The list of chunks is passed as a plain buffer, because the profile assumes that a kernel updates the arrays at
        the end of its arguments.
        """
        return () if self.chunks is None else (self.chunks.numbers.buffer, self.chunks.model_rows)

    def rows(self, start: int, stop: int) -> Projected:
        """Return the projected Gaussians of the rows [start, stop)."""
        if (start, stop) == (0, self.tile_counts.shape[0]):
            return self
        shown = None if self.shown is None else self.shown.rows(start, stop)
        return Projected(self.splats.rows(start, stop), self.tile_counts.rows(start, stop), shown)


def thinning_numbers(thinning: Thinning | None) -> tuple[float, ...]:
    """Return the kernel arguments for dropout of Gaussians, which change from step to step; empty without dropout."""
    if thinning is None:
        return ()
    return (*map(LaunchParameterWord, (*thinning.key, thinning.threshold)), LaunchParameter(thinning.factor))


def _projected_parts(
    work: Workspace, gaussians: AnyGaussians, projected: Projected, chunks: ChunkList | ChunkNumbers | None
) -> Iterator[tuple[int, DeviceGaussians, Projected]]:
    """Yield, for each part of the model that is on the device at once, its first row, the part, and its projection."""
    if isinstance(chunks, ChunkNumbers):
        for start, stop, (part,), slots in chunk_parts(work, chunks, gaussians):
            yield start, part, replace(projected.rows(start, stop), chunks=slots)
        return
    for start, stop, (part,) in parts(work, gaussians):
        yield start, part, projected if chunks is not None else projected.rows(start, stop)


@stage("project")
def project(
    device: Device,
    work: Workspace,
    gaussians: AnyGaussians,
    camera: Camera,
    camera_array: DeviceArray,
    thinning: Thinning | None = None,
    chunks: ChunkList | ChunkNumbers | None = None,
    *,
    counts_lists: bool = False,
) -> Projected:
    """Project Gaussians to splats, and count the tiles that each splat reaches (Kerbl et al. 2023, section 4).

    thinning: random dropout of Gaussians in a step of training; None projects all.
    chunks: the chunks whose Gaussians are projected and have rows in the result. None projects the whole model.
    counts_lists: True to count the pairs of each tile's list too, for `append`. The model must be on the device.
    """
    n = gaussians.count if chunks is None else chunks.rows
    splats = work.array("splats", (n, len(SPLAT)))
    tile_counts = work.array("tile_counts", (n,), np.uint32)
    rays = device.switched("RAYS")
    keeps_culled = not rays and device.switched("NO_FRUSTUM_CULL")
    shown = work.array("shown", (n,), np.uint32) if keeps_culled else None
    listed = chunks if isinstance(chunks, ChunkList) else None
    list_counts = _list_counts(device, work, n, tiles_of(camera)) if counts_lists else None
    projected = Projected(splats, tile_counts, shown, listed, list_counts)
    for start, part, out in _projected_parts(work, gaussians, projected, chunks):
        defines = {**out.chunk_defines, **({"SH_DEGREES": True} if "sh_degrees" in part.arrays else {})}
        if part["sh_rest"].dtype == np.float16:
            defines["SH_HALF"] = True
        of_thinning, thinned = _thinned(thinning, start, out.chunks)
        defines.update(of_thinning)
        rows, lanes, counted, registers = out.tile_counts.shape[0], _lanes(device), out.list_counts, 0
        if counted is not None:
            assert rows == n, "a streamed model has no passes by capacity"
            lanes, defines["COUNTS_LISTS"] = 1, True
            registers = COUNTING_REGISTERS if out.chunks is None else COUNTING_REGISTERS_OF_CHUNKS
        stem = "project_rays" if rays else "project"
        kernel = getattr(device.kernels(stem, {**defines, "LANES": lanes}, registers), stem)
        arguments = (
            rows,
            part.coefficients,
            *((camera.width, camera.height) if rays else tiles_of(camera)),
            camera_array,
            *(part[group] for group in PARAMETER_GROUPS),
            out.splats,
            out.tile_counts,
            *(() if out.shown is None else (out.shown,)),
            *([part["sh_degrees"]] if "sh_degrees" in part.arrays else []),
            *thinned,
            *out.chunk_arguments,
            *(() if counted is None else (counted.lengths, counted.slots, counted.sums)),
        )
        if counted is None:
            launch_items(device, kernel, -(-rows // lanes), *arguments)
        else:
            launch_groups(device, kernel, counted.sums.shape[0], device.shape.items, *arguments)
    return projected


def _thinned(
    thinning: Thinning | None, start: int, chunks: ChunkList | None
) -> tuple[dict[str, object], tuple[object, ...]]:
    """Return the defines and the kernel arguments for dropout of Gaussians in a part of a model. Both are empty without
    dropout.

    start: the part's first row in the model. chunks: the part's chunks; None for consecutive rows.
    """
    if thinning is None:
        return {}, ()
    if chunks is None or chunks.first_rows is None:
        return {"THINNED": True}, (start, *thinning_numbers(thinning))
    return {"THINNED": True, "FIRST_ROWS": True}, (0, *thinning_numbers(thinning), chunks.first_rows.buffer)


def _list_counts(device: Device, work: Workspace, n: int, tiles: tuple[int, int]) -> ListCounts:
    """Arrays for the pairs of `n` Gaussians. tiles: numbers of tiles across and down."""
    lengths = work.array("list_counts", (tiles[0] * tiles[1] + 1,), np.uint32)
    lengths.fill(0)
    groups = -(-n // device.shape.items)
    return ListCounts(
        lengths, work.array("first_slots", (n,), np.uint32), work.array("slot_group_sums", (groups,), np.uint32)
    )


@dataclass(frozen=True, eq=False)
class Slots:
    """Gradients of the pairs of a tile and a Gaussian, from `blend_grad`.

    values: (pairs, fields.floats), or (n, fields.floats) if already summed by Gaussian.
    first_slots: (n), the first slot of each Gaussian; None if `values` are already summed.
    """

    values: DeviceArray
    first_slots: DeviceArray | None = None
    fields: SlotFields = PLAIN_SLOTS

    def rows(self, start: int, stop: int) -> Slots:
        """Return the slots of the Gaussians [start, stop)."""
        if self.first_slots is None:
            return replace(self, values=self.values.rows(start, stop))
        first_slots = self.first_slots.rows(start, stop)
        return self if first_slots is self.first_slots else replace(self, first_slots=first_slots)


@dataclass(frozen=True, eq=False)
class ViewSlots:
    """A view's camera on the device, the Gaussians that it projects, and the slots of their pairs."""

    camera_array: DeviceArray
    projected: Projected
    slots: Slots


@dataclass(frozen=True, eq=False)
class Screen:
    """Screen-space results of one view. Only the rows of visible Gaussians are written.

    gradients: (n, 2), with respect to the means on the image, in pixels.
    contributions: (n,), sums of the blending weights over the image's pixels; None if not requested.
    """

    gradients: DeviceArray
    contributions: DeviceArray | None = None


@stage("project_grad", add_slots=1)
def add_slots(
    device: Device,
    work: Workspace,
    tile_counts: DeviceArray,
    slots: Slots,
    sums: DeviceArray | None,
) -> DeviceArray:
    """Add the slots of a band's pairs to each Gaussian's sums (n, floats), and return the sums.

    tile_counts: (n,), the number of tiles of the band that each Gaussian reaches.
    sums: the result for the previous band. Call the function for the bands in order, first with None.
    """
    (n,) = tile_counts.shape
    if sums is None:
        sums = work.array("slot_sums", (n, slots.values.shape[1]))
        sums.fill(0.0)
    kernel, items = device.kernels("project_grad", slots.fields.defines).add_slots, n if slots.values.shape[0] else 0
    launch_items(device, kernel, items, n, tile_counts, slots.first_slots, slots.values, sums)
    return sums


@stage("project_grad")
def project_grad(
    device: Device,
    gaussians: DeviceGaussians,
    view: ViewSlots,
    gradients: DeviceGaussians,
    screen: Screen,
    *,
    sh_rest: bool = True,
    explore: Exploration = NO_EXPLORATION,
    by_lens: DeviceArray | None = None,
    region: TrainedRegion | None = None,
) -> None:
    """Compute `gradients` and `screen` of the visible Gaussians from the slots of their pairs.

    gradients: filled with the gradients in the parameters' shapes; rows of invisible Gaussians are not written.
    sh_rest: also compute the gradient of the higher SH bands.
    explore: penalties on opacity and scale, whose gradients are added.
    by_lens: (n, 4), filled with each Gaussian's gradient with respect to the logs of the focal lengths and to the
    principal point in pixels. The camera must have an image plane.
    region: the region in which Gaussians get gradients, in the coordinates of the means; None for everywhere. Visible
    Gaussians outside it get zeros.

    If only some chunks of `gaussians` were projected, the gradients have the rows of `view.projected`.
    """
    in_region, bounds = region_build(region)
    defines = _defines(device, gaussians, view, explore, sh_rest=sh_rest) | in_region
    defines |= {} if by_lens is None else {"LENS": True}
    n = view.projected.tile_counts.shape[0]
    launch_items(
        device,
        device.kernels("project_grad", defines).project_grad,
        -(-n // _lanes(device)) if view.slots.values.shape[0] else 0,
        n,
        *_inputs(gaussians, view),
        *(model[group] for model in (gaussians, gradients) for group in PARAMETER_GROUPS),
        screen.gradients,
        *([screen.contributions] if view.slots.fields.contributions else []),
        *([] if by_lens is None else [by_lens]),
        *explore.weights,
        *view.projected.chunk_arguments,
        *bounds,
    )


def step_numbers(step: AdamStep, explore: Exploration) -> tuple[float, ...]:
    """Return the arguments of the kernel of `project_step` that change from step to step.

    They are the penalty weights; 1 / sqrt(1 - beta2^t), first for all groups but sh_rest, then for sh_rest; and the
    learning rate / (1 - beta1^t) of each group. Here t is the number of a group's updates, including this step's. The
    numbers of sh_rest are 0 if the step does not update it.
    """
    rates, number, every = step.rates, step.number, step.config.sh_rest_every
    shrunk, root = of_rest, root_of_rest = step.corrections(number)
    if every > 1:
        of_rest, root_of_rest = (inf, 0.0) if number % every else step.corrections(number // every)
    by_group = [rates[group] / (of_rest if group == "sh_rest" else shrunk) for group in PARAMETER_GROUPS]
    return (*explore.weights, root, root_of_rest, *by_group)


@stage("project_grad", project_step=18)
def project_step(
    device: Device,
    step: AdamStep,
    model: tuple[DeviceGaussians, ...],
    view: ViewSlots,
    screen: Screen,
    readback: DeviceArray,
    *,
    explore: Exploration = NO_EXPLORATION,
    region: TrainedRegion | None = None,
) -> None:
    """Do the work of `project_grad` and `stages.adam.adam` in one kernel, which keeps no gradients in memory.

    model: parameters, first and second moments. If only some chunks were projected, only their Gaussians take the step.
    The other arguments are as in `project_grad` and `adam`.
    """
    parameters, config = model[0], step.config
    n = view.projected.tile_counts.shape[0]
    in_region, bounds = region_build(region)
    defines = _defines(device, parameters, view, explore, sh_rest=step.updates_sh_rest) | {"ADAM": True} | in_region
    if config.sparse:
        defines["SPARSE"] = True
    if config.late:
        defines["VISIBLE"] = True
    numbers = [LaunchParameter(number) for number in step_numbers(step, explore)]
    weights = len(explore.weights)
    arguments = (
        n,
        *_inputs(parameters, view),
        screen.gradients,
        *([screen.contributions] if view.slots.fields.contributions else []),
        *numbers[:weights],
        *bounds,
        *(config.beta1, config.beta2, config.epsilon),
        *numbers[weights:],
        *(PARAMETER_GROUPS["means"].limit ** 2, PARAMETER_GROUPS["sh_dc"].limit ** 2),
        readback.buffer,  # a plain buffer: the profile must not count readback's bytes, which are rarely written
        *(arrays[group] for arrays in model for group in PARAMETER_GROUPS),
        *view.projected.chunk_arguments,
    )
    if _lanes(device) > 1:
        kernel = device.kernels("project_grad", {"ROWS": CPU_STEP_ROWS, **defines}).project_step
        launch_groups(device, kernel, -(-n // CPU_STEP_ROWS), 1, *arguments)
    else:
        kernel = device.kernels("project_grad", {"ROWS": DEFAULT_GROUP_ITEMS, **defines}, STEP_REGISTERS).project_step
        launch_items(device, kernel, n, *arguments)


def _lanes(device: Device) -> int:
    """Number of Gaussians per work-item. Gaussians that are evaluated along rays are computed with one lane."""
    return 1 if device.switched("RAYS") else device.shape.lanes


def _defines(
    device: Device, gaussians: DeviceGaussians, view: ViewSlots, explore: Exploration, *, sh_rest: bool
) -> dict[str, object]:
    """The defines that `project_grad` and `project_step` share."""
    wanted = {"ADDED_UP": view.slots.first_slots is None, "NO_SH_REST": not sh_rest and gaussians.coefficients > 1}
    wanted |= {"PENALTIES": bool(explore.weights)}
    defines = {**view.slots.fields.defines, **{name: True for name, needed in wanted.items() if needed}}
    return {**defines, **view.projected.chunk_defines, **({"LANES": 1} if device.switched("RAYS") else {})}


def _inputs(gaussians: DeviceGaussians, view: ViewSlots) -> tuple[object, ...]:
    """The arguments that `project_grad` and `project_step` share, after the number of rows."""
    # If the slots are already summed, the kernel does not use first_slots, and tile_counts is a placeholder.
    projected, slots = view.projected, view.slots
    counts = (projected.tile_counts, slots.first_slots or projected.tile_counts, slots.values, projected.splats)
    return (gaussians.coefficients, view.camera_array, *counts)
