# SPDX-License-Identifier: Apache-2.0
"""Launches pixels.cl: conversion between the planes of blending and arrays of pixels with interleaved values."""

from __future__ import annotations

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_items
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended
from clsplat.stages.device_camera import padded_size


@stage("pixels")
def pixels_from_planes(device: Device, blended: Blended, pixels: DeviceArray, alpha: DeviceArray) -> None:
    """Fill alpha (height, width), and of pixels (height, width, depth) the first three values, or all if depth is
    less."""
    height, width, depth = pixels.shape
    kernel, stride = device.kernels("pixels").pixels_from_planes, blended.transmittance.shape[1]
    planes = (blended.image, blended.transmittance)
    launch_items(device, kernel, width * height, width, height, depth, stride, *planes, pixels, alpha)


@stage("pixels")
def planes_from_pixels(
    device: Device, work: Workspace, d_pixels: DeviceArray, d_alpha: DeviceArray | None = None
) -> DeviceArray:
    """Make the image gradient (3, rows, stride) for `blend_grad` from d_pixels (height, width, depth), depth 1 to 3.

    d_alpha: (height, width); adds a fourth plane, the gradient with respect to the transmittance.
    The padding of the planes is not written.
    """
    height, width, depth = d_pixels.shape
    rows, stride = padded_size(width, height)
    given = [] if d_alpha is None else [d_alpha]
    planes = work.array("image_gradient", (3 + len(given), rows, stride))
    kernel = device.kernels("pixels", {"ALPHA_GRADIENT": True} if given else {}).planes_from_pixels
    launch_items(device, kernel, width * height, width, height, depth, stride, d_pixels, *given, planes)
    return planes
