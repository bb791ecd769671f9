# SPDX-License-Identifier: Apache-2.0
"""Images of Gaussians in JAX programs, with their gradient: `clsplat.jax.rasterize`."""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.jax.host import on_host, shape_like
from clsplat.library.camera_pass import check_coefficients
from clsplat.library.checks import Shape, check_shape, degree, plain
from clsplat.library.checks import sizes as check_sizes
from clsplat.library.projection import check_given, checked_planes
from clsplat.library.rasterize import Rasterization, check_channels, checked_modes
from clsplat.library.rasterize import rasterize as rasterize_numpy
from clsplat.stages.harmonics import MAX_SH_BASIS_DEGREE

MAX_CACHED_FORWARD_PASSES = 8
"""Maximum number of forward passes that are kept for their gradients. The gradient of an older
pass computes the pass again."""


class Rasterized(NamedTuple):
    """Images, and the projected Gaussians. All arrays except radii and tile_counts are differentiable.

    Attributes
    ----------
    images : (C, H, W, X) float32
        Colours over the background, then the depth in world units.
    alphas : (C, H, W, 1) float32
        0 to 1.
    means2d : (C, N, 2) float32
        Pixels.
    depths : (C, N) float32
        World units.
    conics : (C, N, 3) float32
        xx, xy, yy of the inverse 2D covariances, 1 / px^2.
    opacities : (C, N) float32
        Blended opacities, 0 to 1.
    radii : (C, N, 2) int32
        Pixels; 0 if culled.
    tile_counts : (C, N) int32
        Number of 16 x 16 pixel tiles that a Gaussian's ellipse reaches.
    """

    images: jax.Array
    alphas: jax.Array
    means2d: jax.Array
    depths: jax.Array
    conics: jax.Array
    opacities: jax.Array
    radii: jax.Array
    tile_counts: jax.Array


DIFFERENTIABLE_OUTPUTS = ("images", "alphas", "means2d", "depths", "conics", "opacities")
PROJECTED_OUTPUTS = ("means2d", "depths", "conics", "opacities")
REQUIRED_ARRAYS = ("means", "opacities", "colors", "viewmats", "intrinsics")


def rasterize(
    means: jax.Array,
    quaternions: jax.Array | None,
    scales: jax.Array | None,
    opacities: jax.Array,
    colors: jax.Array,
    viewmats: jax.Array,
    intrinsics: jax.Array,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: jax.Array | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    covars: jax.Array | None = None,
    alpha_max: float = 0.99,
    absolute_gradients: bool = False,
    means2d_probe: jax.Array | None = None,
    device: Device | str | None = None,
) -> Rasterized:
    """Render Gaussians in a JAX program, differentiable in all arrays.

    Parameters
    ----------
    means, quaternions, scales, opacities, colors, viewmats, intrinsics : jax.Array
        The arrays of `clsplat.rasterize`. Arrays of other dtypes are converted to float32.
    width, height : int
        Pixels, one size for all cameras.
    near_plane, far_plane, radius_clip, eps2d, sh_degree, render_mode, rasterize_mode, camera_model, alpha_max
        The settings of `clsplat.rasterize`. They are static under `jit`, like shapes.
    backgrounds, covars : jax.Array, optional
        The arrays of `clsplat.rasterize`.
    absolute_gradients : bool
        Make the gradient of means2d_probe the sum over pixels of the absolute gradients with respect to `means2d`.
    means2d_probe : (C, N, 2) jax.Array, optional
        An array of zeros whose values are not used. Its gradient is the gradient with respect to `means2d`, for density
        control.
    device : Device or str, optional
        An open OpenCL device, or a name as `clsplat devices` lists them. JAX's own devices are not used.

    Returns
    -------
    Rasterized
        Images and projected Gaussians.

    Raises
    ------
    InputError
        If a shape or setting is wrong. It is raised when the function is called or traced. If numbers are not finite or
        there is no such device, JAX raises its own error with the message when the program runs.

    Notes
    -----
    Calls `clsplat.rasterize` (Kerbl et al. 2023) through jax.pure_callback and jax.custom_vjp. There is no argument
    `differentiable`, since JAX knows if a gradient is needed.
    """
    arrays = {
        "means": means,
        "quaternions": quaternions,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "intrinsics": intrinsics,
        "backgrounds": backgrounds,
        "covars": covars,
        "means2d_probe": means2d_probe,
    }
    for name in REQUIRED_ARRAYS:
        if arrays[name] is None:
            raise InputError(f"{name} is None, expected an array")
    check_given(covars, quaternions, scales)
    floats = {name: jnp.asarray(array, jnp.float32) for name, array in arrays.items() if array is not None}
    for name, side in (("viewmats", 4), ("intrinsics", 3)):
        if floats[name].shape == (side, side):  # one camera: add the axis of cameras
            floats[name] = floats[name][None]
    if backgrounds is not None and floats["backgrounds"].shape == floats["colors"].shape[-1:]:
        floats["backgrounds"] = jnp.tile(floats["backgrounds"], (len(floats["viewmats"]), 1))
    static = StaticArguments(
        width=_side("width", width),
        height=_side("height", height),
        near_plane=plain(near_plane),
        far_plane=plain(far_plane),
        radius_clip=plain(radius_clip),
        eps2d=plain(eps2d),
        sh_degree=plain(sh_degree),
        render_mode=plain(render_mode),
        rasterize_mode=plain(rasterize_mode),
        camera_model=plain(camera_model),
        alpha_max=plain(alpha_max),
        absolute_gradients=plain(absolute_gradients),
        device=device,
    )
    made = _rasterize(static, floats)
    return Rasterized(*(made[name] for name in Rasterized._fields))


def _side(name: str, given: Any) -> int:
    if np.ndim(given):
        raise InputError(f"{name} is {given!r:.80}, expected a whole number: all cameras have one size in JAX")
    return check_sizes(name, given, 1)[0]


@dataclass(frozen=True)
class StaticArguments:
    """The arguments of `clsplat.jax.rasterize` that are not arrays. They are static under `jit`."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    render_mode: str
    rasterize_mode: str
    camera_model: str
    alpha_max: float
    absolute_gradients: bool
    device: Device | str | None

    def run(self, arrays: dict[str, Any]) -> Rasterization:
        """Call `clsplat.rasterize` with these settings and with arrays.

        arrays: NumPy arrays by argument name. Names of arguments that are None are absent.
        """
        return rasterize_numpy(
            arrays["means"],
            arrays.get("quaternions"),
            arrays.get("scales"),
            arrays["opacities"],
            arrays["colors"],
            arrays["viewmats"],
            arrays["intrinsics"],
            self.width,
            self.height,
            near_plane=self.near_plane,
            far_plane=self.far_plane,
            radius_clip=self.radius_clip,
            eps2d=self.eps2d,
            sh_degree=self.sh_degree,
            backgrounds=arrays.get("backgrounds"),
            render_mode=self.render_mode,
            rasterize_mode=self.rasterize_mode,
            camera_model=self.camera_model,
            covars=arrays.get("covars"),
            alpha_max=self.alpha_max,
            absolute_gradients=self.absolute_gradients,
            device=self.device,
        )

    def shapes(self, arrays: dict[str, Any]) -> dict[str, jax.ShapeDtypeStruct]:
        """Return the shape and dtype of each result of `clsplat.rasterize`, by name.

        arrays: the call's arrays by argument name, which may be tracers.
        Raises InputError, which names the argument, for a wrong shape or setting.
        """
        sizes = {name: array.shape for name, array in arrays.items()}
        checked_modes(self.render_mode, self.rasterize_mode, self.alpha_max)
        checked_planes(self.near_plane, self.far_plane, self.eps2d, self.radius_clip, self.camera_model)
        check_shape("means", sizes["means"], ("N", 3))
        check_shape("viewmats", sizes["viewmats"], ("C", 4, 4))
        count, views = sizes["means"][0], sizes["viewmats"][0]
        highest = self.sh_degree
        if highest is not None:
            highest = degree("sh_degree", highest, MAX_SH_BASIS_DEGREE, ", or None")
        colors: Shape = (count, "D") if highest is None else (count, "K", 3)
        check_shape("colors", sizes["colors"], colors, (views, *colors))
        if highest is not None:
            check_coefficients(highest, sizes["colors"][-2])
        values = sizes["colors"][-1]
        check_channels(values)
        expected: dict[str, Shape] = {
            "quaternions": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
            "intrinsics": (views, 3, 3),
            "backgrounds": (views, values),
            "means2d_probe": (views, count, 2),
        }
        for name, shape in expected.items():
            if name in sizes:
                check_shape(name, sizes[name], shape)
        if "covars" in sizes:
            check_shape("covars", sizes["covars"], (count, 3, 3), (count, 6))
        channels = {"RGB": values, "D": 1, "ED": 1}.get(self.render_mode, values + 1)
        results = {
            "images": (views, self.height, self.width, channels),
            "alphas": (views, self.height, self.width, 1),
            "means2d": (views, count, 2),
            "depths": (views, count),
            "conics": (views, count, 3),
            "opacities": (views, count),
            "radii": (views, count, 2),
            "tile_counts": (views, count),
        }
        return {
            name: jax.ShapeDtypeStruct(shape, jnp.float32 if name in DIFFERENTIABLE_OUTPUTS else jnp.int32)
            for name, shape in results.items()
        }


class PendingForwards:
    """Results of forward passes, by the number of the pass. Each is kept until its gradient is computed.

    most: largest number of results that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._numbers = itertools.count()
        self._results: OrderedDict[int, Rasterization] = OrderedDict()
        self._lock = threading.Lock()

    def add(self, result: Rasterization) -> np.int32:
        """Store the result of a forward pass, and return its number. If there are too many, the oldest is deleted."""
        with self._lock:
            number = next(self._numbers) % 2**31
            self._results[number] = result
            while len(self._results) > self._most:
                self._results.popitem(last=False)
        return np.int32(number)

    def pop(self, number: int) -> Rasterization | None:
        """Remove the result with this number, and return it; None if it has been deleted."""
        with self._lock:
            return self._results.pop(number, None)


_kept = PendingForwards(MAX_CACHED_FORWARD_PASSES)


def _results(result: Rasterization, shapes: dict[str, jax.ShapeDtypeStruct]) -> dict[str, Any]:
    return {name: np.asarray(getattr(result, name), shape.dtype) for name, shape in shapes.items()}


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rasterize(call: StaticArguments, arrays: dict[str, Any]) -> Any:
    shapes = call.shapes(arrays)
    return on_host(lambda arrays: _results(call.run(arrays), shapes), shapes, arrays)


def _forward(call: StaticArguments, arrays: dict[str, Any]) -> Any:
    shapes = call.shapes(arrays)

    def run(arrays: dict[str, Any]) -> Any:
        # copies, since the gradient reads the arrays later, when XLA may have reused their memory
        result = call.run({name: np.array(array) for name, array in arrays.items()})
        return _results(result, shapes), _kept.add(result)

    results, number = on_host(run, (shapes, jax.ShapeDtypeStruct((), jnp.int32)), arrays)
    return results, (arrays, number)


def _backward(call: StaticArguments, residuals: Any, cotangents: dict[str, Any]) -> Any:
    arrays, number = residuals

    def gradient(arrays: dict[str, Any], number: Any, d: dict[str, Any]) -> dict[str, Any]:
        result = _kept.pop(int(number)) or call.run(arrays)
        pixels = result.vjp_pixels(d["images"], d["alphas"])
        projected = {name: d[name] + pixels.get(name, 0) for name in PROJECTED_OUTPUTS}
        gradients = pixels | result.vjp_projection(
            means2d=projected["means2d"],
            conics=projected["conics"],
            opacities=projected["opacities"],
            colors2d=pixels["colors2d"],
            depths=projected["depths"],
        )
        gradients["means2d_probe"] = pixels.get("absolute", projected["means2d"])
        return {name: np.asarray(gradients[name], np.float32) for name in arrays}

    wanted = {name: cotangents[name] for name in DIFFERENTIABLE_OUTPUTS}
    shapes = {name: shape_like(array) for name, array in arrays.items()}
    return (on_host(gradient, shapes, arrays, number, wanted),)


_rasterize.defvjp(_forward, _backward)
