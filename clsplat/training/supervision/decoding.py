# SPDX-License-Identifier: Apache-2.0
"""Decoding of photographs to the sizes that the warm-up needs, or reading of their decoded pixels from the disk cache.
Uses no OpenCL.

Threads that read ahead: `host_photographs.py`. The cache: `decoded_store.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.errors import InputError, system_trouble
from clsplat.training.supervision.decoded_store import DecodedStore, key_of

if TYPE_CHECKING:
    from clsplat.scenes.scene import View

HDR_SUFFIXES = (".exr", ".hdr", ".tif", ".tiff")
"""Endings of picture files whose values may be outside 0 to 1, which 8 bits cannot hold."""
DECODING_PIXEL_BYTES, UNDISTORTING_PIXEL_BYTES = 40, 120
"""Approximate peak of memory, in bytes per pixel of the file: to decode and resize a photograph; to undistort it as
well."""


class PhotographError(InputError):
    """Error for a photograph that cannot be decoded, or whose file has changed, while training runs."""


def stored(image: Float32, *, rounds: bool) -> NDArray[Any]:
    """Convert an image (H, W, 3 to 5) to uint8 if that is exact, else to float32.

    rounds: True to round the values to uint8 even if that is not exact. An image with a value outside 0 to 1 stays
        float32.
    """
    levels = np.rint(image * 255)
    fits = 0 <= levels.min() <= levels.max() <= 255
    if fits and (rounds or np.array_equal(levels * np.float32(1 / 255), image)):  # as target.cl converts back
        return levels.astype(np.uint8)
    return np.ascontiguousarray(image, np.float32)


@dataclass(frozen=True, eq=False)
class Decoder:
    """Decoder of the training views' photographs.

    rounds: True to round pixels to 8 bits.
    factors: divisors of the photographs' width and height in the course of the training, largest first.
    store: cache of decoded pixels on the disk, if there is one.
    """

    views: Sequence[View]
    rounds: bool = False
    factors: tuple[float, ...] = ()
    store: DecodedStore | None = None

    def size(self, index: int, factor: float) -> tuple[int, int]:
        """Width and height of view `index` at 1/factor of its size."""
        camera = self.views[index].camera
        return max(int(camera.width / factor), 1), max(int(camera.height / factor), 1)

    def pixels(self, index: int, factor: float, *, keeps: bool) -> dict[float, NDArray[Any]]:
        """Read view `index` at 1/`factor` of its size from `store`, or else decode its file. Returns pixels (H, W, C),
        keyed by the divisor of the size.

        keeps: True to return also the larger sizes that the training needs later, if the file has to be decoded.
        Raises PhotographError.
        """
        store = self.store
        if store is not None and (found := store.read(self._key(index, factor))) is not None:
            return {factor: self._shown(index, found)}
        later = keeps or (store is not None and store.writable)
        wanted = [factor, *(each for each in self.factors if later and each < factor)]
        images = self._decoded(index, wanted)
        if store is not None:
            for each, image in images.items():
                store.write(self._key(index, each), image)
        return {each: self._shown(index, images[each]) for each in (images if keeps else (factor,))}

    def _shown(self, index: int, image: NDArray[Any]) -> NDArray[Any]:
        """The pixels of a view, with those left out that do not show the region of the training."""
        mask = self.views[index].region_mask
        return image if mask is None else mask.masked(image)

    def _decoded(self, index: int, factors: Sequence[float]) -> dict[float, NDArray[Any]]:
        view = self.views[index]
        try:
            view.check_unchanged()
            try:
                sizes = [self.size(index, factor) for factor in factors]
                images = view.load_sizes(sizes, reduce=self.rounds)
            finally:
                view.check_unchanged()  # a file that was replaced meanwhile may cause any error
        except InputError as error:
            raise PhotographError(str(error)) from None
        except OSError as error:
            raise PhotographError(system_trouble(error)) from None
        made = [stored(image, rounds=self.rounds) for image in images]
        return dict(zip(factors, made, strict=True))

    def _key(self, index: int, factor: float) -> bytes:
        """Digest of everything that the pixels of a view at this size depend on."""
        view, size = self.views[index], self.size(index, factor)
        stamps = view.stamps or view.stamped().stamps
        camera = view.camera
        intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        bent = (camera.projection, [float(value) for value in camera.radial])
        mask = None if view.mask is None else asdict(view.mask.use)
        files = [str(Path(path).absolute()) for path in view.files]
        return key_of((files, stamps, asdict(view.lens), intrinsics, bent, view.upright, mask, self.rounds, size))

    def largest(self) -> int:
        """Upper limit of the bytes that any view's pixels take at full size."""
        return max(
            view.camera.width
            * view.camera.height
            * (5 if view.ignores else 4)
            * (1 if self.rounds and view.path.suffix.lower() not in HDR_SUFFIXES else 4)
            for view in self.views
        )

    def working(self) -> int:
        """Approximate upper limit of the bytes that decoding any photograph needs in addition to its pixels."""
        return max(
            view.lens.width
            * view.lens.height
            * (DECODING_PIXEL_BYTES if view.lens.is_pinhole else UNDISTORTING_PIXEL_BYTES)
            for view in self.views
        )
