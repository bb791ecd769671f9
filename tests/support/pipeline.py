# SPDX-License-Identifier: Apache-2.0
"""The pipeline on a tiny scene, with all intermediate results on the host, for tests of the stages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
from compare import assert_close, assert_close_gradient, assert_close_gradients
from drivers import KEPT, label, why_not
from numpy.typing import NDArray
from scenes import Scene

from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.buffers import upload
from clsplat.device.context import Device, all_devices
from clsplat.device.selection import open_device
from clsplat.gaussians import Gaussians
from clsplat.layouts.columns import PLAIN_SLOTS, SPLAT, SlotFields
from clsplat.reference.render import forward, render_grad
from clsplat.rendering.rasterizer import ForwardPass, Rasterizer
from clsplat.selftest.harness import planes_of
from clsplat.stages.blend import Blended, blend_grad
from clsplat.stages.device_gaussians import DeviceGaussians, allocate_gaussians, download_gaussians, upload_gaussians
from clsplat.stages.project import Screen

BACKGROUND = (0.1, 0.2, 0.3)


COMMON_SHAPES = (8, 1), (1, 64)
"""Lanes and items of the shapes that the default driver is always tested in: one for CPUs, and one for GPUs."""
DEFAULT = [index for index in KEPT if open_device(str(index)) is open_device()]
"""Index of the default driver; none without a driver."""


EVERY_SHAPE = pytest.mark.parametrize(
    ("device", "every"),
    [pytest.param(index, every := index in DEFAULT, id=f"{label(index)}{'-every' if every else ''}") for index in KEPT],
    indirect=["device"],
)
"""Mark of a test that runs several shapes at once: all on the default driver, and two on others, since builds take most
of the time."""


def cpu_shape(device: Device) -> tuple[int, int]:
    """Lanes and items of the shape for CPUs in which a driver is tested.

    Drivers other than the default one are tested in the shape that they have by default if it is one for CPUs. Tests of
    the fixtures `device` and `shaped_device` then share kernels. tools/ci/digests.py tests every driver in (8, 1).
    """
    own = device.shape
    return COMMON_SHAPES[0] if device is open_device() or own.items > 1 else (own.lanes, own.items)


def shapes_of(device: Device, *more: tuple[int, int], every: bool = True) -> tuple[tuple[Any, ...], ...]:
    """Shapes in which a driver is tested: (lanes, items), or (lanes, items, True) for a Gaussian per work-item.

    The first is `cpu_shape`, the second that of COMMON_SHAPES for GPUs.

    every: for the default driver, also return the shape of one lane and one item, a mixed one, one with a Gaussian per
        work-item, and `more`. The one by Gaussian has a kernel of its own, and shares the others with the second shape.
        tools/ci/digests.py tests every driver in every shape.
    """
    two = cpu_shape(device), COMMON_SHAPES[1]
    return (*two, (1, 1), (8, 16), (1, 64, True), *more) if every and device is open_device() else two


def has_slow_parameters(index: int, shape: tuple[Any, ...] | None) -> bool:
    """Whether slow parameters of a test run on a driver, in a shape; None: in its own.

    Only the default driver has them, in COMMON_SHAPES. Each parameter builds its own kernels on each driver and in each
    shape, which takes nine tenths of such a test's time.
    """
    return index in DEFAULT and shape in {None, *COMMON_SHAPES}


@cache
def shaped(device: Device, lanes: int, items: int, by_gaussian: bool = False) -> Device:
    """The device in a shape; the same device if the shape is its own. All tests share the result, because each new
    device builds its kernels again.

    Skips the test if the driver would crash the process in this shape.
    """
    if (label := f"{lanes}x{items}{'g' if by_gaussian else ''}") == device.shape.label:
        return device
    if reason := why_not(all_devices().index(device.cl_device), lanes, items):
        pytest.skip(reason)
    return device.with_shape(label)


@dataclass
class Pipeline:
    """A rasterizer with one scene on its device."""

    rasterizer: Rasterizer
    gaussians: DeviceGaussians
    camera: Camera
    frame: ForwardPass

    @classmethod
    def run(
        cls,
        device: Device,
        scene: tuple[Gaussians, Camera],
        background: tuple[float, float, float] = BACKGROUND,
        config: RasterizerConfig | None = None,
        capacity: int | None = None,
    ) -> Pipeline:
        """Render the scene. capacity: maximum number of pairs in a band."""
        gaussians, camera = scene
        rasterizer = Rasterizer(device, config)
        rasterizer.capacity = rasterizer.capacity if capacity is None else capacity
        rasterizer.antialias(on=gaussians.antialiased)
        on_device = upload_gaussians(device, gaussians)
        frame = rasterizer.forward(on_device, camera, upload(device, np.array(background, np.float32)))
        return cls(rasterizer, on_device, camera, frame)

    def crop(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Planes (..., rows, stride) without their padding, with channels last."""
        image = planes[..., : self.camera.height, : self.camera.width]
        return np.ascontiguousarray(image.transpose(1, 2, 0)) if image.ndim == 3 else image

    @property
    def image(self) -> NDArray[np.float32]:
        return self.crop(self.frame.blended.image.get())

    def splat(self, *names: str) -> NDArray[np.float32]:
        """Columns of the splats, by their names in SPLAT."""
        columns = [SPLAT.index(name) for name in names]
        values: NDArray[np.float32] = self.frame.projected.splats.get()[:, columns]
        return values

    @property
    def visible(self) -> NDArray[np.bool_]:
        shown: NDArray[np.bool_] = self.frame.projected.tile_counts.get() > 0
        return shown

    def tiles_of(self) -> list[set[int]]:
        """For each Gaussian, the tiles whose lists contain it."""
        lists = self.frame.listed.lists
        ranges, listed = lists.ranges.get(), lists.gaussian_from_sorted.get()
        found: list[set[int]] = [set() for _ in range(self.gaussians.count)]
        for tile, (begin, end) in enumerate(ranges):
            for gaussian in listed[begin:end]:
                found[gaussian].add(tile)
        return found

    def backward(
        self, d_image: NDArray[np.float64], *, absolute: bool = False
    ) -> tuple[Gaussians, NDArray[np.float32]]:
        """Gradients of the parameters and of the means on the image from dL/dimage (H, W, 3)."""
        gradients, screen = self.screened(d_image, SlotFields(absolute=absolute))
        return gradients, screen.gradients.get()

    def screened(self, d_image: NDArray[np.float64], fields: SlotFields) -> tuple[Gaussians, Screen]:
        """Like `backward`, with all results of the view that density control uses."""
        device = self.rasterizer.device
        gradients = allocate_gaussians(device, self.gaussians.count, self.gaussians.coefficients, zero=True)
        by_image = upload(device, planes_of(d_image))
        screen = self.rasterizer.backward(self.gaussians, self.frame, by_image, gradients, fields=fields)
        return download_gaussians(gradients), screen

    def slots(
        self, by_image: NDArray[np.float32], fields: SlotFields = PLAIN_SLOTS, blended: Blended | None = None
    ) -> NDArray[np.float32]:
        """Slots of the frame's pairs, from dL/dimage in planes. blended: used instead of the frame's."""
        device, frame = self.rasterizer.device_of(self.camera), self.frame
        how = (frame.listed.lists, frame.inputs, blended or frame.blended, upload(device, by_image))
        values: NDArray[np.float32] = blend_grad(device, self.rasterizer.work, *how, fields=fields).get()
        return values


def steady(scene: Scene, seed: int = 1) -> NDArray[np.float64]:
    """Random dL/dimage (H, W, 3), which is 0 in pixels where a threshold may decide differently in float32."""
    gaussians, camera = scene
    d_image = np.random.default_rng(seed).standard_normal((camera.height, camera.width, 3))
    d_image[forward(gaussians, camera).blended.margin < 1e-4] = 0
    return d_image


def assert_gradients(run: Pipeline, scene: Scene, fields: SlotFields = PLAIN_SLOTS) -> None:
    """Fail unless a frame's gradients for `steady`, and its contributions, agree with the twin's."""
    d_image, shown = steady(scene), run.visible
    got, screen = run.screened(d_image, fields)
    wanted = render_grad(*scene, d_image, BACKGROUND)
    assert_close_gradients(got.arrays(), wanted.parameters, 1e-4)
    on_image = wanted.abs_means2d if fields.absolute else wanted.means2d
    assert_close_gradient(screen.gradients.get()[shown], on_image[shown], 1e-4)
    if screen.contributions is not None:
        # Weights are as precise as frames, with errors of at most 2e-5 per pixel. The bound is 1e-4 of a Gaussian's
        # sum, and a few pixels at the ellipse's edge, of weight 1/255, where a threshold may decide differently.
        contributions = screen.contributions.get()[shown]
        assert_close(contributions, wanted.contributions[shown], relative=1e-4, absolute=4 / 255)
