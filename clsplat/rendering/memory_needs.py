# SPDX-License-Identifier: Apache-2.0
"""Device memory that frames and training steps need: the sums of the bytes that the stages state, for the plan."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.device.layout import POSE_ROWS, TILE, SlotFields
from clsplat.gaussians import floats_of
from clsplat.rendering.memory_plan import Need, Plan, plan
from clsplat.stages import blend, density, duplicate, loss, pose, project, ranges, sampling, target
from clsplat.stages.device_camera import tiles_of
from clsplat.stages.duplicate import MAX_PAIRS
from clsplat.stages.sort import scratch_bytes

_CHANNEL_PLANES = 4
"""Planes of a frame with channels beside those of its features: median, first, count and index."""
_MODELS = 3
"""Arrays of a training step for each parameter: itself and two moments."""
_SHOWN = 4
"""Bytes of each Gaussian where a step has several views: of the mark that any of them shows it."""
_SMALL = 4096
"""Bytes of camera, background, totals and the like."""


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
    """Memory plan of a frame, without training. floats: parameters of a Gaussian (`ShStorage.floats`); features: floats
    of each Gaussian's that go into channels beside colour; planes: bytes of a pixel in further planes; moved: how
    many means there are that motion goes to. Raises CapacityError."""
    need = _frame_need(device, gaussians, floats, _plane_bytes(camera, _pixel_bytes(features, planes)), config)
    return _plan(device, replace(need, row=need.row + 4 * (features + 3 * moved)))


def plan_step(
    device: Device,
    gaussians: int,
    coefficients: int,
    cameras: Iterable[Camera],
    config: RasterizerConfig,
    *,
    fields: SlotFields,
    agreement: bool,
    photographs: int = 0,
    turns: int = 1,
    antialiased: bool = False,
    models: int = _MODELS,
    masks: bool = False,
    lens: bool = False,
    further: int = 0,
) -> Plan:
    """Memory plan of a training step, from any of the cameras. agreement: True if agreeing views are counted;
    photographs: pixels of all that may stay on the device; turns: of `loss`; antialiased: of the model; models: arrays
    for each parameter, where they are not those of a step of one view; masks: photographs have masks, or an alpha loss;
    lens: gradients by the lens are wanted; further: bytes of a pixel in further planes. Raises CapacityError."""
    planes, extra = 0, masks * (target.MASK_BYTES + loss.ALPHA_PIXEL_BYTES + turns)
    for camera in cameras:
        pixels = _plane_bytes(camera, _pixel_bytes(planes=further) + target.PIXEL_BYTES + loss.PIXEL_BYTES + extra)
        planes = max(planes, pixels + loss.scratch_bytes(device, camera.height, tiles_of(camera)[0] * TILE, turns))
    frame = _frame_need(device, gaussians, floats_of(coefficients), planes, config)
    screen = project.SCREEN_BYTES + 4 * fields.contributions
    statistics = density.gaussian_bytes(agreement=agreement, contributions=fields.contributions)
    step = replace(
        frame,
        row=frame.row
        + screen
        + statistics
        + (_SHOWN if models > _MODELS else 0)
        + sampling.GAUSSIAN_BYTES * antialiased
        + 4 * pose.LENS * lens,
        banded=frame.banded + 4 * fields.floats,
        model=models * frame.model,
        pair=frame.pair + blend.gradient_pair_bytes(fields),
        most_pairs=min(device.max_allocation // (4 * fields.floats), MAX_PAIRS),
        photographs=0 if device.shares_memory else (target.SOURCE_BYTES + masks * target.MASK_BYTES) * photographs,
    )
    return _plan(device, step)


def frame_pixels(device: Device, features: int = 0, planes: int = 0) -> int:
    """Pixels that a frame may have, for its planes to leave three quarters of the device's memory to the model and its
    pairs, and to be allocated at all."""
    per_pixel = _pixel_bytes(features, planes) + 1  # with its share of the tile's
    largest = max(12, 4 * (features + 2) if features else 0, planes)
    return min(device.budget // (4 * per_pixel), device.max_allocation // largest)


def _pixel_bytes(features: int = 0, planes: int = 0) -> int:
    return blend.PIXEL_BYTES + (4 * (features + _CHANNEL_PLANES) if features else 0) + planes


def _plane_bytes(camera: Camera, pixel_bytes: int) -> int:
    tiles_x, tiles_y = tiles_of(camera)
    return tiles_x * tiles_y * (TILE * TILE * pixel_bytes + ranges.TILE_BYTES + duplicate.TILE_BYTES)


def _frame_need(device: Device, gaussians: int, floats: int, planes: int, config: RasterizerConfig) -> Need:
    """The need of a frame without channels. planes: bytes of all that is as large as the image."""
    switches = config.switches()
    keeps_culled = not (switches.frustum_cull and switches.opacity_cull)
    pair = duplicate.pair_bytes(sorts_pairs=switches.depth_sort == "pairs") + ranges.PAIR_BYTES
    return Need(
        gaussians=gaussians,
        row=project.gaussian_bytes(keeps_culled=keeps_culled) + duplicate.GAUSSIAN_BYTES,
        banded=duplicate.BAND_BYTES,
        model=4 * floats,
        widest=4 * max(floats - floats_of(1), 4),  # of the higher SH bands, or quaternions
        pair=pair,
        most_pairs=min(device.max_allocation // 4, MAX_PAIRS),
        planes=planes,
        scratch=scratch_bytes(device, max(gaussians, device.budget // pair)) + _SMALL,
    )


def _plan(device: Device, need: Need) -> Plan:
    return plan(need, device.budget, device.max_allocation, max(device.row_alignment, POSE_ROWS))
