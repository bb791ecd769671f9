# SPDX-License-Identifier: Apache-2.0
"""Rendering of arrays of Gaussians by one camera: projection, colours and pixels, and their gradients."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Float64
from clsplat.device.buffers import DeviceArray, Hosted, from_host, hosted
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library.checks import degree, floats, gradient
from clsplat.library.pixels import PixelPass, screen_gaussians
from clsplat.library.projection import GivenShapes, ProjectedView, full_gradient, hosted_gradients, image_gradients
from clsplat.library.session import LibrarySession
from clsplat.stages.ewa import EwaCamera, camera_gradients
from clsplat.stages.harmonics import (
    MAX_SH_BASIS_DEGREE,
    Harmonics,
    HarmonicsGradients,
    centre_array,
    harmonics,
    harmonics_grad,
)

MIN_EXPECTED_DEPTH_ALPHA = np.float32(1e-10)
"""Lower limit of the alpha by which an expected depth is divided. It avoids a division by zero in empty pixels."""


@dataclass(frozen=True, eq=False)
class Given:
    """The checked arrays of a call of `rasterize`.

    count: N, the number of Gaussians.
    cameras: C, the number of cameras.
    colors: (N, D) or (C, N, D); with sh_degree, SH coefficients (N, K, 3) or (C, N, K, 3).
    """

    count: int
    cameras: int
    means: Float32
    shapes: GivenShapes
    opacities: Float32
    colors: Float32
    sh_degree: int | None

    @classmethod
    def checked(
        cls,
        means: ArrayLike,
        quaternions: ArrayLike | None,
        scales: ArrayLike | None,
        covars: ArrayLike | None,
        opacities: ArrayLike,
        colors: ArrayLike,
        sh_degree: int | None,
        cameras: int,
    ) -> Given:
        """Check the arguments of a call of `rasterize`. Raises InputError, which names the argument."""
        centres = floats("means", means, ("N", 3))
        n = len(centres)
        shapes = GivenShapes.checked(n, covars, quaternions, scales)
        covers = floats("opacities", opacities, (n,))
        if sh_degree is None:
            values = floats("colors", colors, (n, "D"), (cameras, n, "D"))
        else:
            sh_degree = degree("sh_degree", sh_degree, MAX_SH_BASIS_DEGREE, ", or None")
            values = floats("colors", colors, (n, "K", 3), (cameras, n, "K", 3))
            check_coefficients(sh_degree, values.shape[-2])
        return cls(n, cameras, centres, shapes, covers, values, sh_degree)

    @property
    def channels(self) -> int:
        """Number D of a Gaussian's values that are blended, not counting its depth."""
        return int(self.colors.shape[-1])

    @property
    def by_camera(self) -> bool:
        """True if each camera has colors of its own."""
        return self.colors.ndim == (3 if self.sh_degree is None else 4)

    def colors_of(self, camera: int) -> Float32:
        """Return the colours (N, D) or SH coefficients (N, K, 3) for one camera. camera: its index."""
        return self.colors[camera] if self.by_camera else self.colors


def check_coefficients(sh_degree: int, found: int) -> None:
    """Raise InputError if `found`, the number of SH coefficients in colors, is too small for the degree."""
    if found < (wanted := (sh_degree + 1) ** 2):
        raise InputError(f"colors has {found} SH coefficients, expected {wanted} or more for sh_degree {sh_degree}")


class Gradients:
    """Gradients with respect to the arguments of a call of `rasterize`, summed over its cameras."""

    def __init__(self, given: Given, device: Device) -> None:
        self.given = given
        self.views = 0
        self.room = hosted_gradients(device, given.count, covariances=given.shapes.covariances is not None)
        self.opacities = np.zeros(given.count, np.float32)
        self.colors = None if given.sh_degree is not None else np.zeros_like(given.colors)
        self.coefficients: list[Hosted] = []
        self.viewmats: list[Float64] = []
        self.intrinsics: list[Float64] = []

    def sh(self, device: Device) -> tuple[DeviceArray, bool]:
        """Return the device array for the next camera's gradient with respect to the SH coefficients.

        The second result is True if the array holds the sum of earlier cameras, to which the gradient is to be added.
        """
        given = self.given
        add = bool(self.coefficients) and not given.by_camera
        if not add:
            self.coefficients.append(hosted(device, given.colors.shape[-3:]))
        return self.coefficients[-1].array, add

    def by_name(self, *, cameras: bool) -> dict[str, Any]:
        """Return the gradients on the host, by the names of the arguments of `rasterize`.

        cameras: True includes the gradients with respect to viewmats and intrinsics.
        """
        found = {name: one.get() for name, one in self.room.hosted.items()}
        if self.given.shapes.covariance_layout == "full":
            found["covars"] = full_gradient(found["covars"])
        found["opacities"] = self.opacities
        if self.colors is not None:
            found["colors"] = self.colors
        else:
            each = [one.get() for one in self.coefficients]
            found["colors"] = np.stack(each) if self.given.by_camera else each[0]
        if cameras:
            found |= {"viewmats": np.stack(self.viewmats), "intrinsics": np.stack(self.intrinsics)}
        return found


@dataclass(frozen=True)
class PassSettings:
    """Settings that all cameras of a call of `rasterize` share.

    mode: one of RASTERIZE_RENDER_MODES.
    alpha_max: maximum of a Gaussian's alpha at a pixel.
    compensated: multiply opacities by factors that compensate for the low-pass filter.
    absolute: also compute sums over pixels of absolute gradients with respect to means2d.
    differentiable: keep data that speed up the gradient.
    """

    mode: str
    alpha_max: float
    compensated: bool = False
    absolute: bool = False
    differentiable: bool = True


@dataclass(frozen=True, eq=False)
class ViewGradients:
    """Gradients with respect to a camera's projected Gaussians, on the host. None counts as 0.

    on_image: gradients with respect to means2d, depths and conics, by these names.
    opacities: (N,), with respect to the compensated opacities.
    colors: (N, D), with respect to the blended colours.
    """

    on_image: dict[str, Float32]
    opacities: Float32 | None = None
    colors: Float32 | None = None


class CameraPass:
    """A camera's image of the Gaussians. The object keeps device memory for the gradient until it is deleted.

    given: the checked arrays of the call of `rasterize`.
    index: index of the camera.
    background: (D,) behind the blended values, or None for black.
    """

    def __init__(
        self,
        session: LibrarySession,
        given: Given,
        camera: EwaCamera,
        index: int,
        background: Float32 | None,
        settings: PassSettings,
    ) -> None:
        self._session, self._given, self._camera, self._index = session, given, camera, index
        self._settings, device = settings, session.device
        self.with_depth, self.with_colours = settings.mode.endswith("D"), settings.mode.startswith("RGB")
        with session.lock:
            means, covers = from_host(device, given.means), from_host(device, given.opacities)
            inputs = given.shapes.inputs(means, covers)
            self.projected = ProjectedView(session, inputs, camera, compensated=settings.compensated)
            self._colours: Float32 | Hosted = given.colors_of(index)
            self._harmonics = None
            if given.sh_degree is not None:
                centre = centre_array(device, camera.position)
                arrays = (means, from_host(device, self._colours))
                self._harmonics = Harmonics(*arrays, given.sh_degree, self.projected.arrays.radii, centre)
                self._colours = hosted(device, (given.count, 3))
                harmonics(device, self._harmonics, self._colours.array)
            factors = self.compensations
            self.opacities: Float32 = given.opacities.copy() if factors is None else given.opacities * factors
            """Opacities (N,) after compensation. They are a copy, as the caller may change its array."""
            splats, blended = self.projected.arrays, self.opacities if settings.compensated else covers
            flat = (splats.means2d, splats.conics, blended, self._values(), splats.depths, splats.radii)
            view = (screen_gaussians(device, *flat), (camera.width, camera.height), self._behind(background))
            self.pixels = PixelPass(session, *view, settings.alpha_max, backward=settings.differentiable)
        self._has_background = background is not None

    def _values(self) -> Float32 | DeviceArray:
        """Return the values to blend (N, X). The render mode says whether they are colours, the depth, or both."""
        if not self.with_depth:
            return self._colours.array if isinstance(self._colours, Hosted) else self._colours
        depths = self.depths[:, None]
        return np.concatenate([self.colors, depths], axis=1) if self.with_colours else depths

    def _behind(self, background: Float32 | None) -> Float32 | None:
        """Return the background (X,) behind the blended values, with 0 for the depth; None for black."""
        if background is None or not self.with_colours:
            return None
        return np.append(background, np.float32(0)) if self.with_depth else np.ascontiguousarray(background)

    def splats(self, name: str) -> NDArray[Any]:
        """Return an array of the projection: "means2d", "depths", "conics", "radii" or "compensations"."""
        with self._session.lock:
            return self.projected.get(name)

    @property
    def depths(self) -> Float32:
        """Depths (N,) in world units."""
        return self.splats("depths")

    @property
    def compensations(self) -> Float32 | None:
        """Factors (N,) by which opacities compensate for the low-pass filter; None without compensation."""
        return None if self.projected.arrays.compensations is None else self.splats("compensations")

    @property
    def colors(self) -> Float32:
        """The colours (N, D) to blend, without the depth."""
        if not isinstance(self._colours, Hosted):
            return self._colours
        with self._session.lock:
            return self._colours.get()

    @cached_property
    def alpha(self) -> Float32:
        """The image's alpha (H, W), 0 to 1."""
        return self.pixels.alpha

    @cached_property
    def image(self) -> Float32:
        """The blended image (H, W, X), with the values of the render mode. An expected depth is divided by alpha."""
        image = self.pixels.image
        if not self._settings.mode.endswith("ED"):
            return image
        image = image.copy()
        image[:, :, -1] /= np.maximum(self.alpha, MIN_EXPECTED_DEPTH_ALPHA)
        return image

    def pixel_gradients(self, d_image: ArrayLike, d_alpha: ArrayLike | None) -> dict[str, Float32]:
        """Compute the gradients that `Rasterization.vjp_pixels` returns, for this camera."""
        shape = (self._camera.height, self._camera.width)
        by_image = gradient("d_images", d_image, self.image.shape)
        assert by_image is not None, "`Rasterization.vjp_pixels` passes a gradient for each camera's image"
        by_alpha = gradient("d_alphas", d_alpha, (*shape, 1))
        by_alpha = None if by_alpha is None else by_alpha.reshape(shape)
        if self._settings.mode.endswith("ED"):
            left = np.maximum(self.alpha, MIN_EXPECTED_DEPTH_ALPHA)
            by_depth = by_image[:, :, -1] / left
            by_quotient = np.where(
                self.alpha > MIN_EXPECTED_DEPTH_ALPHA, -by_depth * self.image[:, :, -1], np.float32(0)
            )
            by_image = np.concatenate([by_image[:, :, :-1], by_depth[:, :, None]], axis=2)
            by_alpha = by_quotient if by_alpha is None else by_alpha + by_quotient
        found = self.pixels.gradient(by_image, by_alpha, absolute=self._settings.absolute)
        values = found.pop("colours")
        if self.with_depth:
            found["depths"] = np.ascontiguousarray(values[:, -1])
        given = self._given
        if not self.with_colours:
            found["colors2d"] = np.zeros((given.count, given.channels), np.float32)
        else:
            found["colors2d"] = np.ascontiguousarray(values[:, :-1]) if self.with_depth else values
        behind = found.pop("background", None)
        if self._has_background:
            zeros = np.zeros(given.channels, np.float32)
            found["backgrounds"] = zeros if behind is None else behind[: given.channels]
        return found

    def add_gradients(self, gradients: Gradients, projected: ViewGradients, *, cameras: bool) -> None:
        """Add this camera's gradients with respect to the arguments of `rasterize` to `gradients`.

        projected: gradients with respect to the projected Gaussians.
        cameras: True includes the gradients with respect to the view matrix and the intrinsics.
        """
        session, given, device = self._session, self._given, self._session.device
        on_image, compensations, by_opacity = projected.on_image, self.compensations, projected.opacities
        if by_opacity is not None:
            gradients.opacities += by_opacity if compensations is None else by_opacity * compensations
            if compensations is not None:
                on_image = {**on_image, "compensations": by_opacity * given.opacities}
        if gradients.colors is not None and projected.colors is not None:
            at = gradients.colors[self._index] if given.by_camera else gradients.colors
            at += projected.colors
        with session.lock:
            placed = image_gradients(device, on_image)
            device.under_way.append(placed)  # keeps the host's arrays alive until the device has read them
            room, add = gradients.room.arrays, gradients.views > 0
            by_camera = self.projected.gradient(placed, room, add=add, by_camera=cameras)
            by_centre = self._colours_back(gradients, room.means, projected.colors, cameras=cameras)
            gradients.views += 1
            if by_camera is None:
                return
            viewmat, intrinsics = camera_gradients(by_camera.get())
            if by_centre is not None:
                viewmat += self._camera.position_gradient(by_centre.get().astype(np.float64))
        gradients.viewmats.append(viewmat)
        gradients.intrinsics.append(intrinsics)

    def _colours_back(
        self, gradients: Gradients, d_means: DeviceArray, d_colours: Float32 | None, *, cameras: bool
    ) -> DeviceArray | None:
        """Propagate the gradient of SH colours to the coefficients and, through viewing directions, to the means.

        d_means: (N, 3), gradient with respect to the means. This camera's share is added to it.
        d_colours: (N, 3), gradient with respect to the colours; None means 0.
        Returns the gradient with respect to the camera's centre if `cameras` is True. Does nothing if colors are not SH
        coefficients.
        """
        session, count = self._session, self._given.count
        if self._harmonics is None:
            return None
        assert isinstance(self._colours, Hosted), "harmonics are computed on the device"
        placed = from_host(session.device, np.zeros((count, 3), np.float32) if d_colours is None else d_colours)
        session.device.under_way.append(placed)
        d_sh, add = gradients.sh(session.device)
        colours, into = (self._harmonics, self._colours.array, placed), HarmonicsGradients(d_sh, d_means)
        return harmonics_grad(
            session.device, session.scratch, *colours, into, add=add, add_directions=True, by_centre=cameras
        )
