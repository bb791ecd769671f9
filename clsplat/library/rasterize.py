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
from clsplat.library.checks import choice, floats, gradient, number
from clsplat.library.projection import checked_cameras, stacked
from clsplat.library.session import session_of
from clsplat.library.view import Given, Gradients, View
from clsplat.rendering.build_flags import ALPHA_MAX

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
"""Colour, depth, expected depth, and both: depth is the last channel."""
RASTERIZE_MODES = ("classic", "antialiased")


class Rasterization:
    """Images of C cameras, and what belongs to them, on the host; its arrays wait for the device when they are first
    looked at. It holds device memory, for the vector-Jacobian products, until it is dropped."""

    def __init__(self, views: Sequence[View], given: Given, device: Device) -> None:
        self._views, self._given, self._device = views, given, device

    @cached_property
    def images(self) -> Float32 | list[Float32]:
        """(C, H, W, X) float32: colours over the background, the depth behind them, in world units; a list of (H, W, X)
        where cameras have several sizes."""
        return self._of_pixels(lambda view: view.image)

    @cached_property
    def alphas(self) -> Float32 | list[Float32]:
        """(C, H, W, 1) float32, 0 to 1, or a list as of `images`."""
        return self._of_pixels(lambda view: view.alpha[:, :, None])

    @cached_property
    def radii(self) -> NDArray[np.int32]:
        """(C, N, 2) int32: half sides in pixels of the box that a Gaussian is in, 0 where it is not seen."""
        return stacked([view.splats("radii") for view in self._views])

    @cached_property
    def means2d(self) -> Float32:
        """(C, N, 2) float32: pixels, the first pixel's middle at 0.5; 0 where not seen, as all that follows."""
        return stacked([view.splats("means2d") for view in self._views])

    @cached_property
    def depths(self) -> Float32:
        """(C, N) float32: world units along the camera's axis."""
        return stacked([view.depths for view in self._views])

    @cached_property
    def conics(self) -> Float32:
        """(C, N, 3) float32: a, b, c of the inverse covariance on the image, per squared pixel."""
        return stacked([view.splats("conics") for view in self._views])

    @cached_property
    def opacities(self) -> Float32:
        """(C, N) float32: opacities on the image; with rasterize_mode "antialiased" compensated for the low-pass."""
        return stacked([view.opacities for view in self._views])

    @cached_property
    def colors2d(self) -> Float32:
        """(C, N, D) float32: the values that are blended, but for the depth."""
        colors = stacked([view.colors for view in self._views])
        return colors.copy() if np.may_share_memory(colors, self._given.colors) else colors

    @cached_property
    def tile_counts(self) -> NDArray[np.int32]:
        """(C, N) int32: tiles of 16 x 16 pixels that a Gaussian's ellipse reaches."""
        return stacked([view.pixels.tile_counts for view in self._views])

    def vjp_pixels(
        self, d_images: ArrayLike | Sequence[ArrayLike], d_alphas: ArrayLike | Sequence[ArrayLike] | None = None
    ) -> dict[str, Float32]:
        """The loss's gradients by what is blended, from those by `images` and `alphas`, of the same shapes.

        means2d (C, N, 2), conics (C, N, 3), of b as one number; opacities (C, N), the compensated ones; colors2d
        (C, N, D); depths (C, N) where images have depth; backgrounds (C, D) where they were given; absolute (C, N, 2)
        where absolute_gradients was: sums over pixels of absolute gradients by means2d (AbsGS, Ye et al. 2024).
        Numbers that are not finite pass, to what they have a part in. Raises InputError for other shapes.
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
        """The loss's gradients by the arguments of `rasterize`, from those of `vjp_pixels`; any may be missing.

        means (N, 3), quaternions (N, 4), scales (N, 3) or in their place covars as given, opacities (N,), colors in
        the given shape; and, with `cameras`, float64 viewmats (C, 4, 4) and intrinsics (C, 3, 3), all numbers of the
        first three rows and fx, fy, cx, cy taken as free. Raises InputError for other shapes.
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
            view.add_gradients(gradients, {name: array[index] for name, array in taken.items()}, cameras=cameras)
        return gradients.by_name(cameras=cameras)

    def vjp(
        self,
        d_images: ArrayLike | Sequence[ArrayLike],
        d_alphas: ArrayLike | Sequence[ArrayLike] | None = None,
        *,
        cameras: bool = True,
    ) -> dict[str, Any]:
        """`vjp_pixels` and from there `vjp_projection`: gradients by all arguments of `rasterize`, and by the
        backgrounds where they were given."""
        found = self.vjp_pixels(d_images, d_alphas)
        others: dict[str, Any] = {name: found.pop(name) for name in ("backgrounds", "absolute") if name in found}
        return {**self.vjp_projection(**found, cameras=cameras), **others}

    def _of_pixels(self, part: Callable[[View], Float32]) -> Float32 | list[Float32]:
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
    alpha_max: float = ALPHA_MAX,
    absolute_gradients: bool = False,
    differentiable: bool = True,
    device: Device | str | None = None,
) -> Rasterization:
    """Images of N Gaussians as C cameras see them (Kerbl et al. 2023; gsplat's conventions, docs/library.md).

    means (N, 3): world units. quaternions (N, 4): w x y z, of any length but 0. scales (N, 3): standard deviations,
    world units. opacities (N,): 0 to 1. colors: (N, D) or (C, N, D), D of at least 1, or with sh_degree SH coefficients
    (N, K, 3) or (C, N, K, 3), of which (sh_degree + 1)^2 count. viewmats (C, 4, 4) or (4, 4): camera from world.
    intrinsics (C, 3, 3) or (3, 3): pixels. width, height: pixels, of all cameras or of each. Arrays of float32 are read
    in place where the device shares the host's memory, and must not change before the last gradient; others are
    converted to it.

    near_plane, far_plane: world units. radius_clip: pixels, up to which a Gaussian's radii are too small to be seen.
    eps2d: px^2, added to both variances on the image. backgrounds (C, D) or (D,): black if None. render_mode: one of
    RENDER_MODES; depths are along the axis. rasterize_mode: "antialiased" lowers opacities by what eps2d widens.
    camera_model: pinhole, ortho or fisheye. covars (N, 3, 3), symmetric, or (N, 6), xx, xy, xz, yy, yz, zz: in place of
    quaternions and scales, which are None then. alpha_max: the cap of a Gaussian's alpha. absolute_gradients:
    gradients by means2d have their absolute sums too. differentiable: False for images alone, which takes less; their
    gradient, of the same bits, is slower then. device: an open one, or a name as `clsplat devices` lists them.

    Raises InputError, which names the argument, for other shapes, settings out of range and arrays with numbers that
    are not finite. Raises DeviceError.
    """
    cap = checked_modes(render_mode, rasterize_mode, alpha_max)
    cameras = checked_cameras(
        viewmats,
        intrinsics,
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        eps2d=eps2d,
        radius_clip=radius_clip,
        camera_model=camera_model,
    )
    count = len(cameras)
    if count == 0:
        raise InputError("viewmats has no matrix, expected 1 or more")
    given = Given.checked(means, quaternions, scales, covars, opacities, colors, sh_degree, count)
    check_channels(given.channels)
    behind: list[Float32 | None] = [None] * count
    if backgrounds is not None:
        rows = floats("backgrounds", backgrounds, (count, given.channels), (given.channels,))
        behind = list(np.broadcast_to(rows, (count, given.channels)))
    session = session_of(device)
    views = [
        View(
            session,
            given,
            camera,
            index,
            behind[index],
            cap,
            render_mode,
            compensated=rasterize_mode == "antialiased",
            absolute=absolute_gradients,
            differentiable=differentiable,
        )
        for index, camera in enumerate(cameras)
    ]
    return Rasterization(views, given, session.device)


def check_channels(channels: int) -> None:
    """Raise InputError where colors has none."""
    if channels < 1:
        raise InputError(f"colors has {channels} channels, expected 1 or more")


def checked_modes(render_mode: str, rasterize_mode: str, alpha_max: float) -> float:
    """The cap of alpha. Raises InputError, which names the argument."""
    choice("render_mode", render_mode, RENDER_MODES)
    choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    return number("alpha_max", alpha_max, 1 / 255, 1 - 1e-6)
