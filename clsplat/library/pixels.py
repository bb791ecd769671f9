# SPDX-License-Identifier: Apache-2.0
"""Images blended from arrays of projected Gaussians, and their vector-Jacobian product.

A Gaussian's alpha at a pixel is at most DEFAULT_ALPHA_MAX of `rendering.build_flags`, unless the caller gives another
maximum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.arrays import Float32
from clsplat.device.buffers import DeviceArray, Hosted, Workspace, from_host, hosted
from clsplat.device.context import Device
from clsplat.errors import CapacityError
from clsplat.layouts.columns import TILE, WIDEST_SLOTS, SlotFields
from clsplat.library.session import LibrarySession
from clsplat.rendering.build_flags import DEFAULT_ALPHA_MAX
from clsplat.stages.blend import ImageInputs, blend, blend_grad
from clsplat.stages.duplicate import MAX_PAIRS_PER_BAND, Band, count, duplicate
from clsplat.stages.pixels import pixels_from_planes, planes_from_pixels
from clsplat.stages.project import Projected, Slots
from clsplat.stages.ranges import TileLists, tile_lists
from clsplat.stages.splats import SPLAT_VALUES, ScreenGaussians, ScreenGradients, splats, splats_grad
from clsplat.stages.values import ValuePass, values, values_grad

Array = NDArray[Any] | DeviceArray


@dataclass(frozen=True, eq=False)
class Listed:
    """Projected Gaussians, and for each tile of an image the list of its Gaussians.

    first_slots: (n,), index of a Gaussian's first slot. A slot is the row that holds the gradient of a pair.
    """

    projected: Projected
    lists: TileLists
    first_slots: DeviceArray


@dataclass(frozen=True, eq=False)
class PixelGradients:
    """Gradients with respect to the arrays of `PixelPass`; zero for Gaussians that contribute to no pixel.

    means2d: (n, 2).
    conics: (n, 3).
    opacities: (n,).
    colours: (n, D).
    absolute: (n, 2), sums over pixels of the absolute gradients with respect to means2d; None unless requested.

    `Hosted.array` is the array on the device; `Hosted.get` returns it on the host.
    """

    means2d: Hosted
    conics: Hosted
    opacities: Hosted
    colours: Hosted
    absolute: Hosted | None = None


class ListedPixels:
    """An image from projected Gaussians and tile lists. The object keeps memory for its gradient until it is deleted.

    listing: function that makes the tile lists. Its argument is the workspace that provides the arrays for them.
    gaussians, size, background, alpha_max, backward: as in `PixelPass`.
    """

    def __init__(
        self,
        session: LibrarySession,
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
            behind = np.zeros(max(depth, SPLAT_VALUES), np.float32)
            behind[:depth] = 0.0 if background is None else background
            self._background = from_host(device, behind)
            self._work, capped = work, session.capped(alpha_max)
            self._inputs = ImageInputs(listed.projected.splats, self._background, width, height)
            record = backward or depth > SPLAT_VALUES
            self._blended = blended = blend(capped, work, listed.lists, self._inputs, record=record)
            self._image, self._alpha = hosted(device, (height, width, depth)), hosted(device, (height, width))
            pixels_from_planes(device, blended, self._image.array, self._alpha.array)
            if depth > SPLAT_VALUES:
                rows = (listed.projected, gaussians.values, self._background, blended)
                values(capped, ValuePass(listed.lists, *rows), self._image.array)
            # `under_way` keeps the host's arrays alive until the device has finished
            device.under_way.append((gaussians, self._background, self._image, self._alpha))

    @property
    def image(self) -> Float32:
        """The image (H, W, D) over the background, not a copy. Waits for the device."""
        with self._session.lock:
            return self._image.get()

    @property
    def alpha(self) -> Float32:
        """Alpha (H, W), 0 to 1, not a copy. Waits for the device."""
        with self._session.lock:
            return self._alpha.get()

    @property
    def tile_counts(self) -> NDArray[np.int32]:
        """Number (n,) of 16 x 16 pixel tiles that each Gaussian reaches; 0 if it is culled. Returns a copy."""
        with self._session.lock:
            return self._listed.projected.tile_counts.get().view(np.int32)

    def gradient(
        self, d_image: NDArray[Any], d_alpha: NDArray[Any] | None = None, *, absolute: bool = False
    ) -> dict[str, Float32]:
        """Compute the vector-Jacobian product.

        d_image: (H, W, D), the gradient of the loss with respect to the image.
        d_alpha: (H, W), the gradient of the loss with respect to alpha; None means 0.
        absolute: also compute sums over pixels of absolute gradients.
        Returns gradients by name: means2d (n, 2), conics (n, 3), opacities (n,), colours (n, D), and background (D,) if
        the pass has a background. With `absolute` also absolute (n, 2): sums over pixels of the absolute gradients
        with respect to means2d.
        """
        found = self.gradient_on_device(d_image, d_alpha, absolute=absolute)
        with self._session.lock:
            arrays = {name: array.get() for name, array in vars(found).items() if array is not None}
        if self._given is not None:
            arrays["background"] = self.background_gradient(d_image)
        return arrays

    def background_gradient(self, d_image: NDArray[Any]) -> Float32:
        """Return the gradient (D,) of the loss with respect to the background. d_image: as for `gradient`."""
        left = np.float32(1) - self.alpha
        by_row = np.matmul(left[:, None, :], np.asarray(d_image, np.float32))  # (H, 1, D)
        by_background: Float32 = by_row.sum(axis=(0, 1), dtype=np.float64).astype(np.float32)
        return by_background

    def gradient_on_device(
        self, d_image: NDArray[Any], d_alpha: NDArray[Any] | None = None, *, absolute: bool = False
    ) -> PixelGradients:
        """Compute the gradients that `gradient` returns, except the background's, and leave them on the device.

        The arguments, as for `gradient`, must not change before the device has finished.
        """
        session, gaussians, listed = self._session, self._gaussians, self._listed
        n, depth = gaussians.count, gaussians.width
        fields = SlotFields(absolute=absolute)
        with session.lock:
            device, capped = session.device, session.capped(self._alpha_max)
            found = PixelGradients(
                means2d=hosted(device, (n, 2)),
                conics=hosted(device, (n, 3)),
                opacities=hosted(device, (n,)),
                colours=hosted(device, (n, depth)),
                absolute=hosted(device, (n, 2)) if absolute else None,
            )
            gradients = ScreenGradients(
                found.means2d.array,
                found.conics.array,
                found.opacities.array,
                found.colours.array,
                found.absolute.array if found.absolute else None,
            )
            by_image = placed(device, d_image)
            by_alpha = None if d_alpha is None else placed(device, d_alpha)
            if depth <= SPLAT_VALUES:
                planes = planes_from_pixels(device, self._work, by_image, by_alpha)
                pixels = (self._inputs, self._blended, planes)
                slots = blend_grad(capped, self._work, listed.lists, *pixels, fields=fields)
                splats_grad(device, listed.projected, Slots(slots, listed.first_slots, fields), gradients)
            else:
                of_pass = ValuePass(listed.lists, listed.projected, gaussians.values, self._background, self._blended)
                given = (by_image, by_alpha, gradients)
                values_grad(capped, self._work, of_pass, listed.first_slots, *given, fields=fields)
            device.under_way.append((by_image, by_alpha, gaussians, found))
        return found


class PixelPass(ListedPixels):
    """The image of a camera from projected Gaussians. The object keeps memory for its gradient until it is deleted.

    gaussians: Gaussians on the session's device. Their values must not change before the last `gradient`.
    size: width and height, pixels.
    background: (D,) float32, or None for black.
    alpha_max: maximum of a Gaussian's alpha at a pixel, below 1.
    backward: True keeps data that speed up `gradient`.

    A Gaussian contributes to a pixel if its alpha there is at least 1/255. Blending ends before the Gaussian that would
    leave a transmittance of 1e-4 or less. A Gaussian is culled if its mean is over 1e9 pixels away, or if a or c of
    its conic is outside 1e-15 to 1e15. Raises CapacityError if the device has no memory for the (tile, Gaussian) pairs.
    """

    def __init__(
        self,
        session: LibrarySession,
        gaussians: ScreenGaussians,
        size: tuple[int, int],
        background: Float32 | None = None,
        alpha_max: float = DEFAULT_ALPHA_MAX,
        *,
        backward: bool = True,
    ) -> None:
        def listing(work: Workspace) -> Listed:
            return listed_by_depth(session.device, work, gaussians, *size)

        super().__init__(session, gaussians, listing, size, background, alpha_max, backward=backward)


def screen_gaussians(
    device: Device, means2d: Array, conics: Array, opacities: Array, colours: Array, depths: Array, radii: Array
) -> ScreenGaussians:
    """Put projected Gaussians on the device, from device or host arrays. The caller must hold the session's lock.

    means2d: (n, 2), pixels; the first pixel's centre is at 0.5.
    conics: (n, 3), a, b, c of the inverse covariance.
    opacities: (n,), 0 to 1.
    colours: (n, D), D at least 1.
    depths: (n,). Gaussians are blended in order of depth, and those of equal depth in order of their index.
    radii: (n, 2) int32; a radius of 0 culls the Gaussian.

    If the device shares the host's memory, C-contiguous float32 host arrays are not copied.
    """
    arrays = (means2d, conics, opacities, depths, colours)
    return ScreenGaussians(placed(device, radii, np.int32), *(placed(device, array) for array in arrays))


def placed(device: Device, array: Array, dtype: DTypeLike = np.float32) -> DeviceArray:
    """Return an array on the device. A device array is returned as it is. A host array is copied only if necessary."""
    return array if isinstance(array, DeviceArray) else from_host(device, np.asarray(array, dtype))


def listed_by_depth(device: Device, work: Workspace, gaussians: ScreenGaussians, width: int, height: int) -> Listed:
    """List the Gaussians of each tile of an image, front to back. Waits for the device.

    work: workspace that provides the arrays of the lists. width, height: of the image, in pixels.
    Raises CapacityError if the device has no memory for the (tile, Gaussian) pairs.
    """
    projected = splats(device, work, gaussians, width, height)
    counted = count(device, work, projected)
    most = min(device.max_allocation // (4 * WIDEST_SLOTS.floats), MAX_PAIRS_PER_BAND)
    if counted.pairs > most:
        raise CapacityError(
            f"there are {counted.pairs:,} pairs of a Gaussian and a tile of {TILE}x{TILE} pixels that it reaches, and "
            f"{device.name} has room for {most:,}: use fewer or smaller Gaussians, or a smaller image"
        )
    tiles = (-(-width // TILE), -(-height // TILE))
    band = Band(0, tiles[0] * tiles[1])
    pairs = duplicate(device, work, projected.splats, counted, tiles, band)
    return Listed(projected, tile_lists(device, work, pairs, band), counted.first_slots)
