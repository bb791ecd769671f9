# SPDX-License-Identifier: Apache-2.0
"""Device memory that frames and training steps need: the sums of the stages' byte counts, for the memory plan."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.gaussians import floats_of
from clsplat.layouts.columns import POSE_ROWS, TILE, SlotFields
from clsplat.rendering.memory_plan import Need, Plan, plan, plan_by_chunk
from clsplat.stages import append, blend, density, duplicate, loss, loss_terms, project, ranges, target
from clsplat.stages.device_camera import tiles_of
from clsplat.stages.duplicate import MAX_PAIRS_PER_BAND
from clsplat.stages.sort import scratch_bytes

_EXTRA_CHANNEL_PLANES = 4
"""Planes that a frame with extra channels needs in addition to its features: median, first, count and index."""
MODELS = 3
"""Number of arrays per parameter in a training step of one view: the parameter and Adam's two moments."""
_VISIBLE_MARK_BYTES = 4
"""Bytes per Gaussian, in a step of several views, for marks of the Gaussians that a view shows."""
_SMALL_ARRAYS_BYTES = 4096
"""Upper bound in bytes of the camera, background, totals and other small arrays together."""


@dataclass(frozen=True)
class StepMemory:
    """Settings and sizes that determine the device memory of a training step in addition to that of a frame.

    fields: the fields of a slot, which holds the gradient of a pair.
    photographs: number of pixels of all photographs that may stay on the device.
    turns: number of arrays for the partial sums of the loss, which successive steps use in turn (`stages.loss.loss`).
    masks: True if photographs have masks, or there is an alpha loss.
    row_bytes: bytes per Gaussian of the training's components.
    pixel_bytes: bytes per pixel of the training's components.
    by_chunk: True if a step may run over the chunks in view.
    pool: bytes for parameters and moments of the Gaussians on the device; None lets the plan choose.
    in_view: largest number of rows in the chunks that one view shows, as far as known.
    in_step: the same for all views of a step of several views.
    """

    fields: SlotFields
    photographs: int = 0
    turns: int = 1
    masks: bool = False
    row_bytes: int = 0
    pixel_bytes: int = 0
    by_chunk: bool = False
    pool: int | None = None
    in_view: int = 0
    in_step: int = 0


def plan_frame(
    device: Device,
    gaussians: int,
    floats: int,
    camera: Camera,
    config: RasterizerConfig,
    features: int = 0,
    planes: int = 0,
    moved: int = 0,
) -> Plan:
    """Plan the device memory for a frame without training. Raises CapacityError.

    floats: number of floats of a Gaussian's parameters (`ShStorage.floats`).
    features: floats of each Gaussian that are blended to extra channels.
    planes: bytes per pixel that the frame needs in addition to its channels, such as for a holdout.
    moved: number of sets of means at other frames, for the channels of motion.
    """
    need = _frame_need(device, gaussians, floats, _plane_bytes(camera, _pixel_bytes(features, planes)), config)
    return _plan(device, replace(need, row=need.row + 4 * (features + 3 * moved)))


def plan_step(
    device: Device,
    gaussians: int,
    coefficients: int,
    cameras: Iterable[Camera],
    config: RasterizerConfig,
    step: StepMemory,
    *,
    models: int = MODELS,
) -> Plan:
    """Plan the device memory for a training step with any of the cameras. Raises CapacityError.

    Arguments as for `step_need`.
    """
    return _plan(device, step_need(device, gaussians, coefficients, cameras, config, step, models=models))


def step_need(
    device: Device,
    gaussians: int,
    coefficients: int,
    cameras: Iterable[Camera],
    config: RasterizerConfig,
    step: StepMemory,
    *,
    models: int = MODELS,
) -> Need:
    """Return the device memory that a training step with any of the cameras needs, whatever the device's limit is.

    coefficients: number of SH coefficients per colour channel.
    models: number of arrays per parameter. The default is the number for a step of one view.
    """
    planes, extra = 0, step.masks * (target.MASK_PIXEL_BYTES + loss_terms.ALPHA_PIXEL_BYTES + step.turns)
    for camera in cameras:
        pixels = _plane_bytes(
            camera, _pixel_bytes(planes=step.pixel_bytes) + target.TARGET_PIXEL_BYTES + loss.LOSS_PIXEL_BYTES + extra
        )
        planes = max(planes, pixels + loss.scratch_bytes(device, camera.height, tiles_of(camera)[0] * TILE, step.turns))
    frame = _frame_need(device, gaussians, floats_of(coefficients), planes, config)
    fields = step.fields
    # Without a memory limit, lists may be made by append or by sort; memory is planned for both.
    appends = device.shape.items > 1 and device.memory.limit is None
    screen = project.SCREEN_GRADIENT_BYTES + 4 * fields.contributions
    statistics = density.gaussian_bytes(contributions=fields.contributions)
    return replace(
        frame,
        row=frame.row + screen + statistics + (_VISIBLE_MARK_BYTES if models > MODELS else 0) + step.row_bytes,
        banded=frame.banded + 4 * fields.floats,
        model=models * frame.model,
        pair=frame.pair + blend.gradient_pair_bytes(device, fields) + (append.APPEND_PAIR_BYTES if appends else 0),
        most_pairs=min(device.max_allocation // (4 * fields.floats), MAX_PAIRS_PER_BAND),
        photographs=0
        if device.shares_memory
        else (target.SOURCE_PIXEL_BYTES + step.masks * target.MASK_PIXEL_BYTES) * step.photographs,
        statistics=statistics,
        held=0 if step.by_chunk else None,  # bounds and lists of chunks take no device memory: they are in main memory
        pool=step.pool,
        in_view=step.in_view,
        in_step=step.in_step,
        gradients=frame.model if step.by_chunk and models > MODELS else 0,
    )


def plan_view(device: Device, previous: Plan, in_view: int, in_step: int) -> Plan:
    """Plan steps over the chunks in view again, with memory for views of up to `in_view` rows, and for steps of up to
    `in_step` rows. Raises CapacityError.

    previous: the last plan of these steps.
    """
    need = replace(previous.need, in_view=in_view, in_step=in_step)
    return plan_by_chunk(need, previous.allowed, device.max_allocation)


def frame_pixels(device: Device, features: int = 0, planes: int = 0) -> int:
    """Largest number of pixels of a frame that the device's memory allows.

    All planes together may take at most a quarter of the memory, so that the rest is left for the model and its pairs.
    A plane must fit in one allocation.

    features, planes: as for `plan_frame`.
    """
    per_pixel = _pixel_bytes(features, planes) + 1  # + 1 byte: a pixel's share of the arrays with a row for each tile
    largest = max(12, 4 * (features + 2) if features else 0, planes)
    return min(device.budget // (4 * per_pixel), device.max_allocation // largest)


def _pixel_bytes(features: int = 0, planes: int = 0) -> int:
    return blend.BLEND_PIXEL_BYTES + (4 * (features + _EXTRA_CHANNEL_PLANES) if features else 0) + planes


def _plane_bytes(camera: Camera, pixel_bytes: int) -> int:
    tiles_x, tiles_y = tiles_of(camera)
    return tiles_x * tiles_y * (TILE * TILE * pixel_bytes + ranges.RANGE_TILE_BYTES + duplicate.BAND_TILE_BYTES)


def _frame_need(device: Device, gaussians: int, floats: int, planes: int, config: RasterizerConfig) -> Need:
    """The memory need of a frame without extra channels.

    floats: number of floats of a Gaussian's parameters.
    planes: bytes of all arrays that are as large as the image.
    """
    switches = config.switches()
    pair = duplicate.pair_bytes(sorts_pairs=switches.depth_sort == "pairs") + ranges.TILE_SORT_PAIR_BYTES
    return Need(
        gaussians=gaussians,
        row=project.gaussian_bytes(keeps_culled=not switches.frustum_cull) + duplicate.DUPLICATE_GAUSSIAN_BYTES,
        banded=duplicate.BAND_GAUSSIAN_BYTES,
        model=4 * floats,
        widest=4 * max(floats - floats_of(1), 4),  # the largest array: higher SH bands, or quaternions
        pair=pair,
        most_pairs=min(device.max_allocation // 4, MAX_PAIRS_PER_BAND),
        planes=planes,
        scratch=scratch_bytes(device, max(gaussians, device.budget // pair)) + _SMALL_ARRAYS_BYTES,
    )


def _plan(device: Device, need: Need) -> Plan:
    return plan(need, device.budget, device.max_allocation, max(device.row_alignment, POSE_ROWS))
