# SPDX-License-Identifier: Apache-2.0
"""Comparisons whose messages say what differs, where and by how much.

Tests state the reasons for their tolerances. The bounds of stages are `STAGE_BOUNDS_ULP` in clsplat/selftest/result.py,
those of gradients GRADIENT_TOLERANCE in tests/stages/test_gradients.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def _pair(got: ArrayLike, wanted: ArrayLike, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = np.asarray(got, np.float64), np.asarray(wanted, np.float64)
    assert a.shape == b.shape, f"{name}: got shape {a.shape}, wanted {b.shape}"
    assert np.isfinite(b).all(), f"{name}: the wanted values are not all finite"
    assert np.isfinite(a).all(), f"{name}: {np.count_nonzero(~np.isfinite(a))} of {a.size} values are not finite"
    return a, b


def assert_close(
    got: ArrayLike, wanted: ArrayLike, relative: float = 0.0, absolute: float = 0.0, name: str = "array"
) -> None:
    """Fail unless every element is within absolute + relative * |wanted|."""
    a, b = _pair(got, wanted, name)
    if a.size == 0:
        return
    excess = np.abs(a - b) - (absolute + relative * np.abs(b))
    if (excess <= 0).all():
        return
    worst = tuple(int(i) for i in np.unravel_index(int(np.argmax(excess)), a.shape))
    raise AssertionError(
        f"{name}: {np.count_nonzero(excess > 0)} of {a.size} elements differ by more than {absolute:g} + "
        f"{relative:g} |wanted|; worst at {worst}: got {a[worst]:.9g}, wanted {b[worst]:.9g}"
    )


def assert_close_images(
    got: ArrayLike,
    wanted: ArrayLike,
    tolerance: float,
    flips: float = 0.0,
    flip_tolerance: float = 1.0,
    ignore: NDArray[np.bool_] | None = None,
    name: str = "image",
) -> None:
    """Fail unless all channels of two images (H, W) or (H, W, C) are within `tolerance`.

    flips: fraction of the pixels that may differ by up to `flip_tolerance`, because a threshold decided differently.
    ignore: mask (H, W) of pixels that are not compared, for scenes whose pixels near a threshold are known. It excludes
        `flips`.
    """
    assert ignore is None or flips == 0.0, "a mask and a flip ratio together would hide errors"
    a, b = _pair(got, wanted, name)
    assert a.ndim in (2, 3), f"{name}: an image has 2 or 3 axes, not {a.ndim}"
    error = np.abs(a - b)
    if error.ndim == 3:
        error = error.max(axis=2)
    if ignore is not None:
        assert ignore.shape == error.shape, f"{name}: mask {ignore.shape}, image {error.shape}"
        assert not ignore.all(), f"{name}: the mask hides every pixel"
        error = np.where(ignore, 0.0, error)
    over = np.count_nonzero(error > tolerance)
    worst = tuple(int(i) for i in np.unravel_index(int(np.argmax(error)), error.shape))
    where = f"worst at (row, column) {worst}: got {a[worst]}, wanted {b[worst]}, difference {error[worst]:.3g}"
    assert over <= flips * error.size, (
        f"{name}: {over} of {error.size} pixels differ by more than {tolerance:g}, allowed are "
        f"{int(flips * error.size)}; {where}"
    )
    assert error[worst] <= max(tolerance, flip_tolerance), f"{name}: a flip may not exceed {flip_tolerance:g}; {where}"


def relative_error(got: ArrayLike, wanted: ArrayLike) -> float:
    """|got - wanted| / |wanted| in the 2-norm of all elements; infinite if `wanted` is zero and `got` is not."""
    a, b = np.asarray(got, np.float64), np.asarray(wanted, np.float64)
    difference, norm = float(np.linalg.norm(a - b)), float(np.linalg.norm(b))
    if norm == 0.0:
        return 0.0 if difference == 0.0 else float("inf")
    return difference / norm


def assert_close_gradient(got: ArrayLike, wanted: ArrayLike, tolerance: float, name: str = "gradient") -> None:
    """Fail unless `relative_error` is at most `tolerance`.

    Fails too if the wanted gradient is zero, because the test would then show nothing.
    """
    a, b = _pair(got, wanted, name)
    assert b.any(), f"{name}: the wanted gradient is zero everywhere"
    error = relative_error(a, b)
    if error <= tolerance:
        return
    worst = tuple(int(i) for i in np.unravel_index(int(np.argmax(np.abs(a - b))), a.shape))
    raise AssertionError(
        f"{name}: relative error {error:.3g} (allowed {tolerance:g}); worst at {worst}: got {a[worst]:.9g}, "
        f"wanted {b[worst]:.9g}"
    )


def assert_close_gradients(
    got: Mapping[str, NDArray[Any]], wanted: Mapping[str, NDArray[Any]], tolerance: float
) -> None:
    """Compare gradients by name with `assert_close_gradient`."""
    for name, values in wanted.items():
        assert_close_gradient(got[name], values, tolerance, name=name)


def assert_slopes(
    loss: Callable[[dict[str, Any]], float], arrays: Mapping[str, NDArray[Any]], gradients: Mapping[str, NDArray[Any]],
    *, step: float, tolerance: float,
) -> None:  # fmt: skip
    """Fail unless gradients agree with central differences of the loss along a random direction of each array.

    The difference is relative to the norm of the gradient.
    """
    rng = np.random.default_rng(6)
    for name, gradient in gradients.items():
        direction = rng.standard_normal(gradient.shape)
        ends = [loss({**arrays, name: arrays[name] + by * direction}) for by in (step, -step)]
        error = abs((ends[0] - ends[1]) / (2 * step) - float((gradient * direction).sum()))
        assert error <= tolerance * np.linalg.norm(gradient), name


def similarity(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Scale, rotation and translation from the points `source` (N, 3) to `target` (N, 3) (Umeyama 1991)."""
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred = source - mean_source
    u, s, v = np.linalg.svd((target - mean_target).T @ centred)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ v))])
    rotation = u @ sign @ v
    scale = float((s * np.diag(sign)).sum() / (centred**2).sum())
    return scale, rotation, mean_target - scale * rotation @ mean_source


def assert_same_arrays(got: Mapping[str, NDArray[Any]], wanted: Mapping[str, NDArray[Any]]) -> None:
    """Fail unless there are the same names, and the arrays of each have the same bits."""
    assert got.keys() == wanted.keys()
    for name, values in wanted.items():
        assert_same_bits(got[name], values, name)


def assert_same_bits(got: NDArray[Any], wanted: NDArray[Any], name: str = "array") -> None:
    """Fail unless dtype, shape and bytes are equal. -0.0 and 0.0 differ; NaNs with the same payload are equal."""
    assert got.dtype == wanted.dtype, f"{name}: got {got.dtype}, wanted {wanted.dtype}"
    assert got.shape == wanted.shape, f"{name}: got shape {got.shape}, wanted {wanted.shape}"
    if got.size == 0:
        return
    width = got.dtype.itemsize
    a = np.ascontiguousarray(got).view(np.uint8).reshape(-1, width)
    b = np.ascontiguousarray(wanted).view(np.uint8).reshape(-1, width)
    different = (a != b).any(axis=1)
    if not different.any():
        return
    first = tuple(int(i) for i in np.unravel_index(int(np.argmax(different)), got.shape))
    raise AssertionError(
        f"{name}: {np.count_nonzero(different)} of {got.size} elements differ in bits; first at {first}: "
        f"got {got[first]!r}, wanted {wanted[first]!r}"
    )
