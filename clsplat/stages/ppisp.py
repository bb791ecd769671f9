# SPDX-License-Identifier: Apache-2.0
"""Launches ppisp.cl: the gains and colour mixes of a photograph, the vignette of its lens, and their gradients."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.profile import stage
from clsplat.layouts.columns import TILE
from clsplat.stages.appearance import GainEntries, Gains

COLOUR_ENTRIES, VIGNETTE_ENTRIES = 9, 3
"""Number of entries of a photograph, which are three gains and six mixes; and of a lens."""
VIGNETTE_GAINS = GainEntries(first_row=COLOUR_ENTRIES, centred=False)
"""Entries of a lens. In column sums they follow those of the photograph."""
PPISP_PIXEL_BYTES = 8
"""Bytes of the partial sums per pixel, padding included."""


@dataclass(frozen=True)
class PhotoLens:
    """Photograph and lens of a view, for the kernels.

    photograph, lens: rows in the arrays of their entries.
    centre: the principal point, as fractions of the image's width and height.
    flat: False for a panorama, which cannot have a vignette.
    """

    photograph: int
    lens: int
    centre: tuple[float, float]
    flat: bool = True

    def place(self, width: int, height: int) -> tuple[float, float, float]:
        """The principal point in pixels; then 1 / (half the image's diagonal)^2, or 0 for a panorama."""
        scale = 4 / (width**2 + height**2) if self.flat else 0.0
        return self.centre[0] * width, self.centre[1] * height, scale


@stage("appearance", develop=1)
def develop(
    device: Device, colours: Gains, vignettes: Gains, taken: PhotoLens, target: DeviceArray, width: int, height: int
) -> None:
    """Remove gains, mixes and vignette from a photograph of width x height pixels, in place.

    colours: (photographs, COLOUR_ENTRIES).
    vignettes: (lenses, VIGNETTE_ENTRIES).
    target: planes (3 or more, rows, stride) of the photograph, the first three of which are colours.
    """
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
    taken: PhotoLens,
    image: DeviceArray,
    gradient: DeviceArray,
    width: int,
    height: int,
    place: int = 0,
) -> DeviceArray:
    """Column sums (COLOUR_ENTRIES + VIGNETTE_ENTRIES, stride) of the gradient.

    Summed over the columns, and multiplied by ln 2 except for mixes, they are the gradient with respect to the entries.
    place: the view's number in the batch; each has its own array.
    """
    _, rows, stride = image.shape
    down, sums = rows // TILE, COLOUR_ENTRIES + VIGNETTE_ENTRIES
    partials = work.array("appearance_partials", (sums, down, stride))
    columns = work.array(f"appearance_columns_{place}", (sums, stride))
    sizes = (height, stride, rows * stride, down, *taken.place(width, height))
    kernel = device.kernels("ppisp").camera_sums
    launch_grid(device, kernel, (stride // device.shape.lanes, down), *sizes, image, gradient, partials)
    kernel = device.kernels("appearance", {"LANES": 1}).column_sums
    launch_grid(device, kernel, (stride, sums), stride, down, partials, columns)
    return columns
