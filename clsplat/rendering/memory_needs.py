# SPDX-License-Identifier: Apache-2.0
"""Device memory that frames and training steps need: the sizes of the stages' arrays, for the plan."""

from __future__ import annotations

from collections.abc import Iterable

from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device
from clsplat.device.layout import PAD, TILE, SlotFields
from clsplat.gaussians import floats_of
from clsplat.rendering.memory_plan import Need, Plan, plan
from clsplat.stages.device_camera import tiles_of
from clsplat.stages.loss import strips
from clsplat.stages.sort import scratch_bytes

_SOURCE = 16
"""Bytes of a photograph's pixel at most: RGBA in floats."""
_SMALL = 4096
"""Camera, background, totals and the like."""


def plan_frame(
    device: Device,
    gaussians: int,
    floats: int,
    camera: Camera,
    config: RasterizerConfig,
    features: int = 0,
    planes: int = 0,
) -> Plan:
    """Memory plan of a frame, without training. floats: parameters of a Gaussian (`ShStorage.floats`); features: floats
    of each Gaussian's that go into channels beside colour; planes: bytes of a pixel in further planes. Raises
    CapacityError."""
    beside = {"slot": 0, "statistics": 0, "features": features, "more": planes}
    return _plan(device, gaussians, floats, [camera], config, training=False, **beside)


def frame_pixels(device: Device, features: int = 0, planes: int = 0) -> int:
    """Pixels that a frame may have, for its planes to leave three quarters of the device's memory to the model and its
    pairs, and to be allocated at all."""
    each = 21 + (4 * (features + 4) if features else 0) + planes
    largest = max(12, 4 * (features + 2) if features else 0, planes)
    return min(device.budget // (4 * each), device.max_allocation // largest)


def plan_step(
    device: Device,
    gaussians: int,
    coefficients: int,
    cameras: Iterable[Camera],
    config: RasterizerConfig,
    *,
    fields: SlotFields,
    agreement: bool,
) -> Plan:
    """Memory plan of a training step, from any of the cameras. agreement: True if agreeing views are counted. Raises
    CapacityError."""
    floats = floats_of(coefficients)
    statistics = 4 * (5 * fields.contributions + agreement)  # contributions and two epochs of two statistics each
    return _plan(device, gaussians, floats, cameras, config, training=True, slot=fields.floats, statistics=statistics)


def _plan(
    device: Device,
    gaussians: int,
    floats: int,
    cameras: Iterable[Camera],
    config: RasterizerConfig,
    *,
    training: bool,
    slot: int,
    statistics: int,
    features: int = 0,
    more: int = 0,
) -> Plan:
    switches = config.switches()
    planes = loss = 0
    for camera in cameras:
        tiles_x, tiles_y = tiles_of(camera)
        pixels, stride = tiles_x * tiles_y * TILE * TILE, tiles_x * TILE
        scratch = 5 * 3 * 4 * camera.height * (stride + 2 * PAD) + 9 * 4 * camera.height * stride
        sums = 9 * 4 * camera.height * strips(device)
        # image, transmittance, stops; ranges, counts_by_tile; in training target, its source, image_gradient
        own = 20 * pixels + 12 * tiles_x * tiles_y + ((24 + _SOURCE) * pixels + sums if training else 0)
        own += 4 * (features + 4) * pixels if features else 0  # with median, first, count and index
        own += more * pixels
        loss = max(loss, scratch if training else 0)
        planes = max(planes, own)
    longest = max(gaussians, device.budget // 36)
    need = Need(
        gaussians=gaussians,
        floats=floats,
        models=4 if training else 1,
        slot=slot,
        planes=planes + loss,
        loss=loss,
        scratch=scratch_bytes(device, longest) + _SMALL,
        sorts_pairs=switches.depth_sort == "pairs",
        extra=statistics + 4 * features + (0 if switches.frustum_cull and switches.opacity_cull else 4),
    )
    return plan(need, device.budget, device.max_allocation, device.row_alignment)
