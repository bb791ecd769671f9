# SPDX-License-Identifier: Apache-2.0
"""Pixels of projected Gaussians that come as arrays, and their vector-Jacobian product."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.arrays import Float32
from clsplat.device.buffers import DeviceArray, Hosted, Workspace, from_host, hosted
from clsplat.device.context import Device
from clsplat.device.layout import TILE, WIDEST_SLOTS, SlotFields
from clsplat.errors import CapacityError
from clsplat.library.session import Session
from clsplat.rendering.build_flags import ALPHA_MAX
from clsplat.stages.blend import blend, blend_grad
from clsplat.stages.duplicate import MAX_PAIRS, Band, count, duplicate
from clsplat.stages.pixels import pixels_from_planes, planes_from_pixels
from clsplat.stages.project import Projected, Slots
from clsplat.stages.ranges import TileLists, tile_lists
from clsplat.stages.splats import COLOURS, ScreenGaussians, ScreenGradients, splats, splats_grad
from clsplat.stages.values import ValuePass, values, values_grad

Array = NDArray[Any] | DeviceArray


@dataclass(frozen=True, eq=False)
class Listed:
    """Projected Gaussians in the lists of an image's tiles; first_slots (n,): where each one's pairs begin."""

    projected: Projected
    lists: TileLists
    first_slots: DeviceArray


@dataclass(frozen=True, eq=False)
class PixelGradients:
    """Gradients by the arrays of `Pixels`: means2d (n, 2), conics (n, 3), opacities (n,), colours (n, D), zero for
    Gaussians in no pixel; absolute (n, 2): sums of the absolute values of the pixels' gradients by means2d, or None.
    `Hosted.array` is on the device, `Hosted.get` the same on the host."""

    means2d: Hosted
    conics: Hosted
    opacities: Hosted
    colours: Hosted
    absolute: Hosted | None = None


class ListedPixels:
    """An image of lists of projected Gaussians, with all that its gradient needs, until it is dropped.

    listing: makes the lists in the memory that it is given; the rest is of `Pixels`.
    """

    def __init__(
        self,
        session: Session,
        gaussians: ScreenGaussians,
        listing: Callable[[Workspace], Listed],
        size: tuple[int, int],
        background: Float32 | None,
        alpha_max: float,
        *,
        backward: bool,
    ) -> None:
        self._session, self._gaussians, self._alpha_max = session, gaussians, alpha_max
        self._given = background
        (width, height), depth = size, gaussians.width
        with session.lock:
            device, work = session.device, session.workspace(self)
            self._listed = listed = listing(work)
            behind = np.zeros(max(depth, COLOURS), np.float32)
            behind[:depth] = 0.0 if background is None else background
            self._background = from_host(device, behind)
            self._work, capped = work, session.capped(alpha_max)
            planes = (listed.projected.splats, self._background, width, height)
            self._blended = blended = blend(capped, work, listed.lists, *planes, record=backward or depth > COLOURS)
            self._image, self._alpha = hosted(device, (height, width, depth)), hosted(device, (height, width))
            pixels_from_planes(device, blended, self._image.array, self._alpha.array)
            if depth > COLOURS:
                rows = (listed.projected, gaussians.values, self._background, blended)
                values(capped, ValuePass(listed.lists, *rows), self._image.array)
            device.under_way.append((gaussians, self._background, self._image, self._alpha))  # until then they live

    @property
    def image(self) -> Float32:
        """(H, W, D): over the background. The same memory each time; waits for the device."""
        with self._session.lock:
            return self._image.get()

    @property
    def alpha(self) -> Float32:
        """(H, W): 0 to 1. The same memory each time; waits for the device."""
        with self._session.lock:
            return self._alpha.get()

    @property
    def tile_counts(self) -> NDArray[np.int32]:
        """(n,): tiles of 16 x 16 pixels that each Gaussian reaches, 0 where it is culled; a copy."""
        with self._session.lock:
            return self._listed.projected.tile_counts.get().view(np.int32)

    def gradient(
        self, d_image: NDArray[Any], d_alpha: NDArray[Any] | None = None, *, absolute: bool = False
    ) -> dict[str, Float32]:
        """The vector-Jacobian product: means2d (n, 2), conics (n, 3), opacities (n,), colours (n, D), background (D,)
        if there is one; absolute (n, 2): the sums of the absolute values of every pixel's gradient by means2d, if
        asked for.

        d_image (H, W, D), d_alpha (H, W): the loss's gradient by image and alpha, of which none is 0.
        """
        found = self.gradient_on_device(d_image, d_alpha, absolute=absolute)
        with self._session.lock:
            arrays = {name: array.get() for name, array in vars(found).items() if array is not None}
        if self._given is not None:
            arrays["background"] = self.background_gradient(d_image)
        return arrays

    def background_gradient(self, d_image: NDArray[Any]) -> Float32:
        """(D,): the loss's gradient by the background."""
        left = np.float32(1) - self.alpha
        by_row = np.matmul(left[:, None, :], np.asarray(d_image, np.float32))  # (H, 1, D)
        by_background: Float32 = by_row.sum(axis=(0, 1), dtype=np.float64).astype(np.float32)
        return by_background

    def gradient_on_device(
        self, d_image: NDArray[Any], d_alpha: NDArray[Any] | None = None, *, absolute: bool = False
    ) -> PixelGradients:
        """The result of `gradient` where it is, for stages that go on with it; what is given must not change before the
        device is done."""
        session, gaussians, listed = self._session, self._gaussians, self._listed
        n, depth = gaussians.count, gaussians.width
        fields = SlotFields(absolute=absolute)
        with session.lock:
            device, capped = session.device, session.capped(self._alpha_max)
            shapes = {"means2d": (n, 2), "conics": (n, 3), "opacities": (n,), "colours": (n, depth)}
            if absolute:
                shapes["absolute"] = (n, 2)
            found = PixelGradients(**{name: hosted(device, shape) for name, shape in shapes.items()})
            gradients = ScreenGradients(
                found.means2d.array,
                found.conics.array,
                found.opacities.array,
                found.colours.array,
                found.absolute.array if found.absolute else None,
            )
            by_image = placed(device, d_image)
            by_alpha = None if d_alpha is None else placed(device, d_alpha)
            if depth <= COLOURS:
                planes = planes_from_pixels(device, self._work, by_image, by_alpha)
                pixels = (listed.projected.splats, self._background, self._blended, planes)
                slots = blend_grad(capped, self._work, listed.lists, *pixels, fields=fields)
                splats_grad(device, listed.projected, Slots(slots, listed.first_slots), gradients, fields=fields)
            else:
                of_pass = ValuePass(listed.lists, listed.projected, gaussians.values, self._background, self._blended)
                given = (by_image, by_alpha, gradients)
                values_grad(capped, self._work, of_pass, listed.first_slots, *given, fields=fields)
            device.under_way.append((by_image, by_alpha, gaussians, found))
        return found


class Pixels(ListedPixels):
    """One camera's pixels, from arrays of projected Gaussians, with all that the gradient needs, until it is dropped.

    means2d (n, 2) in pixels, the first pixel's middle at 0.5; conics (n, 3), the inverse covariance's a, b, c;
    opacities (n,) in [0, 1]; colours (n, D), D of at least 1; depths (n,), by which the Gaussians are sorted, ties by
    index; radii (n, 2) int32: one that is 0 culls; each on the session's device or on the host, where what is float32
    and C-contiguous is not copied. The colours must not change before the last `gradient`. background (D,) float32 or
    None for black; alpha_max: the cap of alpha, below 1; backward: True if there is likely to be a `gradient`,
    which is quicker then.

    A Gaussian takes part in a pixel where its alpha is at least 1/255, and not behind the one that would leave 1e-4 or
    less of the pixel's light. One whose mean is over 1e9 pixels away, or whose a or c is not from 1e-15 to 1e15, is
    culled. Raises CapacityError for more pairs of tiles and Gaussians than the device has room for.
    """

    def __init__(
        self,
        session: Session,
        means2d: Array,
        conics: Array,
        opacities: Array,
        colours: Array,
        depths: Array,
        radii: Array,
        width: int,
        height: int,
        background: Float32 | None = None,
        alpha_max: float = ALPHA_MAX,
        *,
        backward: bool = True,
    ) -> None:
        device = session.device
        arrays = (means2d, conics, opacities, depths, colours)
        with session.lock:
            gaussians = ScreenGaussians(placed(device, radii, np.int32), *(placed(device, array) for array in arrays))

            def listing(work: Workspace) -> Listed:
                return listed_by_depth(device, work, gaussians, width, height)

            super().__init__(session, gaussians, listing, (width, height), background, alpha_max, backward=backward)


def placed(device: Device, array: Array, dtype: DTypeLike = np.float32) -> DeviceArray:
    """An array for kernels that read it: as it is on the device, or one that is on the host, in place if it can be."""
    return array if isinstance(array, DeviceArray) else from_host(device, np.asarray(array, dtype))


def listed_by_depth(device: Device, work: Workspace, gaussians: ScreenGaussians, width: int, height: int) -> Listed:
    """Lists of an image's tiles, each front to back. Waits for the device. Raises CapacityError."""
    projected = splats(device, work, gaussians, width, height)
    counted = count(device, work, projected)
    most = min(device.max_allocation // (4 * WIDEST_SLOTS.floats), MAX_PAIRS)
    if counted.pairs > most:
        raise CapacityError(
            f"the Gaussians reach {counted.pairs:,} tiles of {TILE}x{TILE} pixels, counted for each, and {device.name} "
            f"has room for {most:,}: use fewer or smaller Gaussians, or a smaller image"
        )
    tiles = (-(-width // TILE), -(-height // TILE))
    band = Band(0, tiles[0] * tiles[1])
    pairs = duplicate(device, work, projected.splats, counted, tiles, band)
    return Listed(projected, tile_lists(device, work, pairs, band), counted.first_slots)
