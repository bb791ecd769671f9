# SPDX-License-Identifier: Apache-2.0
"""Launches ppisp.cl: a photograph's gains and mixes of colours, its lens's vignette, and the gradient by them."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.layout import TILE
from clsplat.device.profile import stage
from clsplat.stages.appearance import Gains

COLOURS, VIGNETTE = 9, 3
"""Entries of a photograph, three gains and six mixes; those of a lens."""
PIXEL_BYTES = 8
"""Bytes of each pixel with its padding: its share of the partial sums."""


@dataclass(frozen=True)
class Taken:
    """How a photograph was taken. photograph, lens: their rows; centre: the principal point, in parts of the picture's
    width and height; flat: False for a panorama, which has no vignette."""

    photograph: int
    lens: int
    centre: tuple[float, float]
    flat: bool = True

    def place(self, width: int, height: int) -> tuple[float, float, float]:
        """The principal point in pixels, and one over the square of half the picture's diagonal, or 0."""
        scale = 4 / (width**2 + height**2) if self.flat else 0.0
        return self.centre[0] * width, self.centre[1] * height, scale


@stage("appearance")
def develop(
    device: Device, colours: Gains, vignettes: Gains, taken: Taken, target: DeviceArray, width: int, height: int
) -> None:
    """Take gains, mixes and vignette from planes (3 or more, rows, stride) of a photograph of width x height pixels, of
    which three are colours. colours: (photographs, COLOURS); vignettes: (lenses, VIGNETTE)."""
    _, rows, stride = target.shape
    kernel = device.kernels("ppisp").develop
    of_view = (taken.photograph, taken.lens, stride, rows * stride, *taken.place(width, height))
    launch_grid(
        device,
        kernel,
        (stride // device.shape.lanes, rows),
        *of_view,
        colours.gains,
        colours.logs,
        vignettes.logs,
        target,
    )


@stage("appearance")
def camera_gradient(
    device: Device,
    work: Workspace,
    taken: Taken,
    image: DeviceArray,
    gradient: DeviceArray,
    width: int,
    height: int,
    place: int = 0,
) -> DeviceArray:
    """Sums (COLOURS + VIGNETTE, stride), those of each `place` in a batch in an array of their own: their sums over x
    are the gradients by the entries, over ln 2 but for the mixes."""
    _, rows, stride = image.shape
    down, sums = rows // TILE, COLOURS + VIGNETTE
    partials = work.array("appearance_partials", (sums, down, stride))
    columns = work.array(f"appearance_columns_{place}", (sums, stride))
    sizes = (height, stride, rows * stride, down, *taken.place(width, height))
    kernel = device.kernels("ppisp").camera_sums
    launch_grid(device, kernel, (stride // device.shape.lanes, down), *sizes, image, gradient, partials)
    kernel = device.kernels("appearance", LANES=1).column_sums
    launch_grid(device, kernel, (stride, sums), stride, down, partials, columns)
    return columns
