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
    """Copy the image of `blended` to pixels (height, width, D), and its alpha to alpha (height, width).

    The first min(D, 3) values of each pixel are set to its colour, and the others are not written.
    """
    height, width, depth = pixels.shape
    kernel, stride = device.kernels("pixels").pixels_from_planes, blended.transmittance.shape[1]
    planes = (blended.image, blended.transmittance)
    launch_items(device, kernel, width * height, width, height, depth, stride, *planes, pixels, alpha)


@stage("pixels")
def planes_from_pixels(
    device: Device, work: Workspace, d_pixels: DeviceArray, d_alpha: DeviceArray | None = None
) -> DeviceArray:
    """Return the image gradient (3, rows, stride) for `blend_grad`, from the gradient with respect to pixels.

    d_pixels: (height, width, D), with 1 to 3 values per pixel. Planes without a value are zero.
    d_alpha: (height, width), the gradient with respect to alpha. With it the result has a fourth plane, the gradient
    with respect to the transmittance.

    The padding of the planes is not written.
    """
    height, width, depth = d_pixels.shape
    rows, stride = padded_size(width, height)
    given = [] if d_alpha is None else [d_alpha]
    planes = work.array("image_gradient", (3 + len(given), rows, stride))
    kernel = device.kernels("pixels", {"ALPHA_GRADIENT": True} if given else {}).planes_from_pixels
    launch_items(device, kernel, width * height, width, height, depth, stride, d_pixels, *given, planes)
    return planes
