# SPDX-License-Identifier: Apache-2.0
"""`clsplat.rasterize`: images of arrays of Gaussians, and their vector-Jacobian product."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.library.camera_pass import CameraPass, Given, Gradients, PassSettings, ViewGradients
from clsplat.library.checks import choice, floats, gradient, number
from clsplat.library.projection import checked_cameras, checked_planes, stacked
from clsplat.library.session import session_of
from clsplat.rendering.build_flags import DEFAULT_ALPHA_MAX

RASTERIZE_RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
"""Render modes: colour, depth, expected depth (divided by alpha), and colour followed by either depth."""
RASTERIZE_FILTER_MODES = ("classic", "antialiased")


class Rasterization:
    """Images of C cameras and the projected Gaussians, on the host, with their vector-Jacobian products.

    The first access to an array waits for the device. The object keeps device memory for the vector-Jacobian products
    until it is deleted. For a Gaussian that is not visible, the rows of radii, means2d, depths, conics and tile_counts
    are 0.

    Attributes
    ----------
    images : (C, H, W, X) float32
        By render_mode, colours over the background, depth in world units, or both with the depth last. A list of
        (H, W, X) if the cameras' sizes differ.
    alphas : (C, H, W, 1) float32
        0 to 1, or a list like `images`.
    radii : (C, N, 2) int32
        Half sides of a Gaussian's bounding box in pixels.
    means2d : (C, N, 2) float32
        Pixels; the first pixel's centre is at 0.5.
    depths : (C, N) float32
        World units along the camera's axis.
    conics : (C, N, 3) float32
        a, b, c of the inverse 2D covariance, 1 / px^2.
    opacities : (C, N) float32
        0 to 1; with rasterize_mode "antialiased" compensated for the low-pass filter.
    colors2d : (C, N, D) float32
        The blended values without the depth.
    tile_counts : (C, N) int32
        Number of 16 x 16 pixel tiles that a Gaussian's ellipse reaches.
    """

    def __init__(self, views: Sequence[CameraPass], given: Given, device: Device) -> None:
        self._views, self._given, self._device = views, given, device

    @cached_property
    def images(self) -> Float32 | list[Float32]:
        """Images (C, H, W, X) float32: colours over the background, depth in world units, or both with the depth last.

        A list of (H, W, X) if the cameras' sizes differ.
        """
        return self._of_pixels(lambda view: view.image)

    @cached_property
    def alphas(self) -> Float32 | list[Float32]:
        """Alphas (C, H, W, 1) float32, 0 to 1, or a list like `images`."""
        return self._of_pixels(lambda view: view.alpha[:, :, None])

    @cached_property
    def radii(self) -> NDArray[np.int32]:
        """Radii (C, N, 2) int32: half sides of a Gaussian's bounding box in pixels, 0 if it is not visible."""
        return stacked([view.splats("radii") for view in self._views])

    @cached_property
    def means2d(self) -> Float32:
        """Means on the image (C, N, 2) float32, in pixels: the first pixel's centre is at 0.5. 0 if not visible."""
        return stacked([view.splats("means2d") for view in self._views])

    @cached_property
    def depths(self) -> Float32:
        """Depths (C, N) float32 along the camera's axis, in world units."""
        return stacked([view.depths for view in self._views])

    @cached_property
    def conics(self) -> Float32:
        """Conics (C, N, 3) float32: a, b, c of the inverse covariance on the image, 1 / px^2."""
        return stacked([view.splats("conics") for view in self._views])

    @cached_property
    def opacities(self) -> Float32:
        """Opacities (C, N) float32, with rasterize_mode "antialiased" after compensation for the low-pass filter."""
        return stacked([view.opacities for view in self._views])

    @cached_property
    def colors2d(self) -> Float32:
        """Blended values (C, N, D) float32 without the depth."""
        colors = stacked([view.colors for view in self._views])
        return colors.copy() if np.may_share_memory(colors, self._given.colors) else colors

    @cached_property
    def tile_counts(self) -> NDArray[np.int32]:
        """Numbers (C, N) int32 of 16 x 16 pixel tiles that a Gaussian's ellipse reaches."""
        return stacked([view.pixels.tile_counts for view in self._views])

    def vjp_pixels(
        self, d_images: ArrayLike | Sequence[ArrayLike], d_alphas: ArrayLike | Sequence[ArrayLike] | None = None
    ) -> dict[str, Float32]:
        """Compute gradients of the blended values from gradients of the images.

        Parameters
        ----------
        d_images : (C, H, W, X) array_like, or a sequence of (H, W, X)
            Gradient of the loss with respect to `images`.
        d_alphas : (C, H, W, 1) array_like, or a sequence of (H, W, 1), optional
            Gradient with respect to `alphas`. None means 0.

        Returns
        -------
        dict
            float32 gradients: "means2d" (C, N, 2); "conics" (C, N, 3), whose entry b counts as one variable;
            "opacities" (C, N), after compensation; "colors2d" (C, N, D). "depths" (C, N) if the images have depth, and
            "backgrounds" (C, D) if they were given. With `absolute_gradients` also "absolute" (C, N, 2), sums over
            pixels of absolute gradients with respect to means2d.

        Raises
        ------
        InputError
            If a shape is wrong.

        Notes
        -----
        NaN and infinite numbers propagate to the results that depend on them. Absolute gradients: AbsGS, Ye et al.
        2024.
        """
        by_alphas = [None] * len(self._views) if d_alphas is None else self._each("d_alphas", d_alphas)
        pairs = zip(self._views, self._each("d_images", d_images), by_alphas, strict=True)
        each = [view.pixel_gradients(d_image, d_alpha) for view, d_image, d_alpha in pairs]
        return {name: stacked([found[name] for found in each]) for name in each[0]}

    def vjp_projection(
        self,
        *,
        means2d: ArrayLike | None = None,
        conics: ArrayLike | None = None,
        opacities: ArrayLike | None = None,
        colors2d: ArrayLike | None = None,
        depths: ArrayLike | None = None,
        cameras: bool = True,
    ) -> dict[str, Any]:
        """Compute gradients of the arguments of `rasterize` from the gradients that `vjp_pixels` returns.

        Parameters
        ----------
        means2d, conics, opacities, colors2d, depths : array_like, optional
            Gradients as `vjp_pixels` returns them. None means 0.
        cameras : bool
            Also compute gradients of the view matrices and intrinsics.

        Returns
        -------
        dict
            "means" (N, 3); "quaternions" (N, 4) and "scales" (N, 3), or "covars" in the given shape; "opacities" (N,);
            "colors" in the given shape, all float32. With `cameras` also float64 "viewmats" (C, 4, 4) and "intrinsics"
            (C, 3, 3). In the first, all entries of the first three rows count as independent variables; the second is
            for fx, fy, cx and cy.

        Raises
        ------
        InputError
            If a shape is wrong.
        """
        given, count, n = self._given, len(self._views), self._given.count
        shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
            "means2d": (means2d, (count, n, 2)),
            "conics": (conics, (count, n, 3)),
            "opacities": (opacities, (count, n)),
            "colors2d": (colors2d, (count, n, given.channels)),
            "depths": (depths, (count, n)),
        }
        each = {name: gradient(name, array, shape) for name, (array, shape) in shapes.items()}
        taken = {name: array for name, array in each.items() if array is not None}
        gradients = Gradients(given, self._device)
        for index, view in enumerate(self._views):
            on_image = {name: array[index] for name, array in taken.items()}
            by_opacity, by_colour = on_image.pop("opacities", None), on_image.pop("colors2d", None)
            view.add_gradients(gradients, ViewGradients(on_image, by_opacity, by_colour), cameras=cameras)
        return gradients.by_name(cameras=cameras)

    def vjp(
        self,
        d_images: ArrayLike | Sequence[ArrayLike],
        d_alphas: ArrayLike | Sequence[ArrayLike] | None = None,
        *,
        cameras: bool = True,
    ) -> dict[str, Any]:
        """Compute gradients of all arguments of `rasterize`: `vjp_pixels`, then `vjp_projection`.

        Parameters
        ----------
        d_images, d_alphas
            Gradients with respect to `images` and `alphas`, as for `vjp_pixels`.
        cameras : bool
            Also compute gradients of the view matrices and intrinsics.

        Returns
        -------
        dict
            The result of `vjp_projection`, with "backgrounds" and "absolute" if `vjp_pixels` returns them.

        Raises
        ------
        InputError
            If a shape is wrong.
        """
        found = self.vjp_pixels(d_images, d_alphas)
        result = self.vjp_projection(
            means2d=found["means2d"],
            conics=found["conics"],
            opacities=found["opacities"],
            colors2d=found["colors2d"],
            depths=found.get("depths"),
            cameras=cameras,
        )
        return result | {name: found[name] for name in ("backgrounds", "absolute") if name in found}

    def _of_pixels(self, part: Callable[[CameraPass], Float32]) -> Float32 | list[Float32]:
        arrays = [part(view) for view in self._views]
        return stacked(arrays) if len({array.shape for array in arrays}) == 1 else arrays

    def _each(self, name: str, given: Any) -> list[Any]:
        if not hasattr(given, "__len__") or getattr(given, "ndim", 1) == 0:
            raise InputError(f"{name} is {given!r:.80}, expected {len(self._views)} images, one for each camera")
        if len(given) != len(self._views):
            raise InputError(f"{name} has {len(given)} images, expected {len(self._views)}, one for each camera")
        return list(given)


def rasterize(
    means: ArrayLike,
    quaternions: ArrayLike | None,
    scales: ArrayLike | None,
    opacities: ArrayLike,
    colors: ArrayLike,
    viewmats: ArrayLike,
    intrinsics: ArrayLike,
    width: int | Sequence[int],
    height: int | Sequence[int],
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: ArrayLike | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    covars: ArrayLike | None = None,
    alpha_max: float = DEFAULT_ALPHA_MAX,
    absolute_gradients: bool = False,
    differentiable: bool = True,
    device: Device | str | None = None,
) -> Rasterization:
    """Render N Gaussians to images of C cameras.

    Parameters
    ----------
    means : (N, 3) array_like
        World units.
    quaternions : (N, 4) array_like or None
        w, x, y, z, of any length but 0. None if covars are given.
    scales : (N, 3) array_like or None
        Standard deviations in world units. None if covars are given.
    opacities : (N,) array_like
        0 to 1.
    colors : (N, D) or (C, N, D) array_like
        D at least 1. With sh_degree, SH coefficients (N, K, 3) or (C, N, K, 3); the first (sh_degree + 1)^2 are used.
    viewmats : (C, 4, 4) or (4, 4) array_like
        Camera from world.
    intrinsics : (C, 3, 3) or (3, 3) array_like
        Pixels.
    width, height : int or sequence of int
        Pixels; a number for all cameras, or one for each.
    near_plane, far_plane : float
        World units. Gaussians whose depth is not strictly between these are not drawn.
    radius_clip : float
        Pixels. Gaussians whose radii are at most this are not drawn.
    eps2d : float
        Low-pass filter in px^2, which is added to both variances on the image.
    sh_degree : int, optional
        Degree of the spherical harmonics, 0 to 4. None if colors are not SH coefficients.
    backgrounds : (C, D) or (D,) array_like, optional
        Black if None.
    render_mode : str
        "RGB", "D" (depth), "ED" (expected depth: depth divided by alpha), "RGB+D" or "RGB+ED". Depths are along the
        camera's axis.
    rasterize_mode : str
        "classic", or "antialiased": lower opacities to compensate for eps2d.
    camera_model : str
        "pinhole", "ortho" or "fisheye".
    covars : (N, 3, 3) or (N, 6) array_like, optional
        Symmetric covariances, or xx, xy, xz, yy, yz, zz, instead of quaternions and scales.
    alpha_max : float
        Maximum of a Gaussian's alpha at a pixel.
    absolute_gradients : bool
        Also compute sums of the absolute gradients of means2d.
    differentiable : bool
        False saves time and memory if only images are needed. A gradient can still be computed, with the same bits, but
        takes longer.
    device : Device or str, optional
        An open device, or a name as `clsplat devices` lists them.

    Returns
    -------
    Rasterization
        Images and projected Gaussians, with their `vjp`.

    Raises
    ------
    InputError
        If a shape is wrong, a setting is out of range, or numbers are not finite. The message names the argument.
    DeviceError
        If there is no such device, or it fails.

    Notes
    -----
    Kerbl et al. 2023, with gsplat's conventions (docs/library.md). If the device shares the host's memory, float32
    arrays are read in place and must not change before the last gradient. Other arrays are converted.
    """
    cap = checked_modes(render_mode, rasterize_mode, alpha_max)
    compensated = rasterize_mode == "antialiased"
    settings = PassSettings(render_mode, cap, compensated, absolute_gradients, differentiable)
    planes = checked_planes(near_plane, far_plane, eps2d, radius_clip, camera_model)
    cameras = checked_cameras(viewmats, intrinsics, width, height, planes)
    count = len(cameras)
    if count == 0:
        raise InputError("viewmats has no matrix, expected 1 or more")
    given = Given.checked(means, quaternions, scales, covars, opacities, colors, sh_degree, count)
    check_channels(given.channels)
    behind = _backgrounds(backgrounds, count, given.channels)
    session = session_of(device)
    views = [CameraPass(session, given, camera, index, behind[index], settings) for index, camera in enumerate(cameras)]
    return Rasterization(views, given, session.device)


def _backgrounds(given: ArrayLike | None, count: int, channels: int) -> list[Float32 | None]:
    """Return the background (D,) of each of `count` cameras. Raises InputError.

    given: one background (D,) for all cameras, or (C, D); None for black.
    """
    if given is None:
        return [None] * count
    rows = floats("backgrounds", given, (count, channels), (channels,))
    return list(np.broadcast_to(rows, (count, channels)))


def check_channels(channels: int) -> None:
    """Raise InputError if colors has no channel."""
    if channels < 1:
        raise InputError(f"colors has {channels} channels, expected 1 or more")


def checked_modes(render_mode: str, rasterize_mode: str, alpha_max: float) -> float:
    """Check render_mode, rasterize_mode and alpha_max, and return alpha_max as a float.

    Raises InputError, which names the argument.
    """
    choice("render_mode", render_mode, RASTERIZE_RENDER_MODES)
    choice("rasterize_mode", rasterize_mode, RASTERIZE_FILTER_MODES)
    return number("alpha_max", alpha_max, 1 / 255, 1 - 1e-6)
