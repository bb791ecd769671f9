# SPDX-License-Identifier: Apache-2.0
"""`clsplat.jax.rasterize`."""

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
from clsplat.library.checks import Shape, check_shape, degree, plain
from clsplat.library.checks import sizes as check_sizes
from clsplat.library.projection import check_given, checked_planes
from clsplat.library.rasterize import Rasterization, check_channels, checked_modes
from clsplat.library.rasterize import rasterize as rasterize_numpy
from clsplat.library.view import check_coefficients
from clsplat.stages.harmonics import HIGHEST

KEPT = 8
"""Forward passes that stay on the device for a gradient; of older ones the gradient makes them again, bit for bit."""


class Rasterized(NamedTuple):
    """Images, and the Gaussians on them; float32 where nothing else is said.

    images (C, H, W, X); alphas (C, H, W, 1); means2d (C, N, 2), pixels; depths (C, N), world units; conics (C, N, 3),
    1 / pixels^2: the inverse 2D covariances' xx, xy, yy; opacities (C, N), those that are drawn; radii (C, N, 2) int32,
    pixels, 0 where culled; tile_counts (C, N) int32. There is a gradient by all but the last two.
    """

    images: jax.Array
    alphas: jax.Array
    means2d: jax.Array
    depths: jax.Array
    conics: jax.Array
    opacities: jax.Array
    radii: jax.Array
    tile_counts: jax.Array


WITH_GRADIENT = ("images", "alphas", "means2d", "depths", "conics", "opacities")
PROJECTED = ("means2d", "depths", "conics", "opacities")
REQUIRED = ("means", "opacities", "colors", "viewmats", "intrinsics")


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
    """`clsplat.rasterize` in a program of JAX, with the gradient of all its arrays.

    The arguments are those of `clsplat.rasterize` but for `differentiable`, which JAX knows, and one size of all
    cameras; all that are no arrays are static under `jit`, and so are shapes.
    Arrays of other dtypes become float32. means2d_probe (C, N, 2): zeros, which are not used; its gradient is that of
    the loss by `means2d` (with absolute_gradients, the sum of what pixels add to it, each without its sign), as
    density control wants it. device: of OpenCL, open or by its name; JAX's own
    devices have no part in it.

    Raises InputError for wrong shapes and settings when it is called or traced. Arrays with numbers that are not
    finite, and a device that is not there, are found when the program runs, and JAX raises an error of its own with
    that message.

    Source: `clsplat.rasterize`, by jax.pure_callback and jax.custom_vjp.
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
    settings = {
        "near_plane": near_plane,
        "far_plane": far_plane,
        "radius_clip": radius_clip,
        "eps2d": eps2d,
        "sh_degree": sh_degree,
        "render_mode": render_mode,
        "rasterize_mode": rasterize_mode,
        "camera_model": camera_model,
        "alpha_max": alpha_max,
        "absolute_gradients": absolute_gradients,
        "device": device,
    }
    for name in REQUIRED:
        if arrays[name] is None:
            raise InputError(f"{name} is None, expected an array")
    check_given(covars, quaternions, scales)
    floats = {name: jnp.asarray(array, jnp.float32) for name, array in arrays.items() if array is not None}
    for name, side in (("viewmats", 4), ("intrinsics", 3)):
        if floats[name].shape == (side, side):  # of one camera
            floats[name] = floats[name][None]
    if backgrounds is not None and floats["backgrounds"].shape == floats["colors"].shape[-1:]:
        floats["backgrounds"] = jnp.tile(floats["backgrounds"], (len(floats["viewmats"]), 1))
    static = tuple((name, plain(value)) for name, value in settings.items())
    return Rasterized(**_rasterize(Call(_side("width", width), _side("height", height), static), floats))


def _side(name: str, given: Any) -> int:
    if np.ndim(given):
        raise InputError(f"{name} is {given!r:.80}, expected a whole number: all cameras have one size in JAX")
    return check_sizes(name, given, 1)[0]


@dataclass(frozen=True)
class Call:
    """All of a call that is no array."""

    width: int
    height: int
    settings: tuple[tuple[str, Any], ...]

    def run(self, arrays: dict[str, Any]) -> Rasterization:
        """The NumPy call; the arrays by their names, without those that are not there."""
        given: dict[str, Any] = {"quaternions": None, "scales": None, **arrays, **dict(self.settings)}
        given.pop("means2d_probe", None)
        return rasterize_numpy(**given, width=self.width, height=self.height)

    def shapes(self, arrays: dict[str, Any]) -> dict[str, jax.ShapeDtypeStruct]:
        """Shapes and dtypes of the results. Raises InputError, which names the argument, for arrays of shapes that
        `rasterize` does not take."""
        settings, sizes = dict(self.settings), {name: array.shape for name, array in arrays.items()}
        checked_modes(*(settings[name] for name in ("render_mode", "rasterize_mode", "alpha_max")))
        planes = ("near_plane", "far_plane", "eps2d", "radius_clip", "camera_model")
        checked_planes(*(settings[name] for name in planes))
        check_shape("means", sizes["means"], ("N", 3))
        check_shape("viewmats", sizes["viewmats"], ("C", 4, 4))
        count, views = sizes["means"][0], sizes["viewmats"][0]
        highest = settings["sh_degree"]
        if highest is not None:
            highest = degree("sh_degree", highest, HIGHEST, ", or None")
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
        channels = {"RGB": values, "D": 1, "ED": 1}.get(settings["render_mode"], values + 1)
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
            name: jax.ShapeDtypeStruct(shape, jnp.float32 if name in WITH_GRADIENT else jnp.int32)
            for name, shape in results.items()
        }


class Kept:
    """The forward passes that wait for their gradient, by a number that is made with each."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._numbers = itertools.count()
        self._results: OrderedDict[int, Rasterization] = OrderedDict()
        self._lock = threading.Lock()

    def add(self, result: Rasterization) -> np.int32:
        """Keep one, in place of the oldest where there are too many."""
        with self._lock:
            number = next(self._numbers) % 2**31
            self._results[number] = result
            while len(self._results) > self._most:
                self._results.popitem(last=False)
        return np.int32(number)

    def pop(self, number: int) -> Rasterization | None:
        """Take one out, if it is still there."""
        with self._lock:
            return self._results.pop(number, None)


_kept = Kept(KEPT)


def _results(result: Rasterization, shapes: dict[str, jax.ShapeDtypeStruct]) -> dict[str, Any]:
    return {name: np.asarray(getattr(result, name), shape.dtype) for name, shape in shapes.items()}


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rasterize(call: Call, arrays: dict[str, Any]) -> Any:
    shapes = call.shapes(arrays)
    return on_host(lambda arrays: _results(call.run(arrays), shapes), shapes, arrays)


def _forward(call: Call, arrays: dict[str, Any]) -> Any:
    shapes = call.shapes(arrays)

    def run(arrays: dict[str, Any]) -> Any:
        # copies: the library reads arrays in place until the gradient, and XLA's memory is another's by then
        result = call.run({name: np.array(array) for name, array in arrays.items()})
        return _results(result, shapes), _kept.add(result)

    results, number = on_host(run, (shapes, jax.ShapeDtypeStruct((), jnp.int32)), arrays)
    return results, (arrays, number)


def _backward(call: Call, residuals: Any, cotangents: dict[str, Any]) -> Any:
    arrays, number = residuals

    def gradient(arrays: dict[str, Any], number: Any, d: dict[str, Any]) -> dict[str, Any]:
        result = _kept.pop(int(number)) or call.run(arrays)
        pixels = result.vjp_pixels(d["images"], d["alphas"])
        projected = {name: d[name] + pixels.get(name, 0) for name in PROJECTED}
        gradients = pixels | result.vjp_projection(**projected, colors2d=pixels["colors2d"])
        gradients["means2d_probe"] = pixels.get("absolute", projected["means2d"])
        return {name: np.asarray(gradients[name], np.float32) for name in arrays}

    wanted = {name: cotangents[name] for name in WITH_GRADIENT}
    shapes = {name: shape_like(array) for name, array in arrays.items()}
    return (on_host(gradient, shapes, arrays, number, wanted),)


_rasterize.defvjp(_forward, _backward)
