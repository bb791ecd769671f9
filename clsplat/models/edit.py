# SPDX-License-Identifier: Apache-2.0
"""Edits of a model on the host: crop, transform, thin out, merge. Inputs are never changed in place.

A similarity (4, 4) maps the world to a new one: x' = s Q x + t, where Q is a rotation, possibly with a reflection. A
Gaussian N(m, R S S R^T) becomes N(s Q m + t, Q R s S s S R^T Q^T). Its colour f, a function of the view direction,
becomes f(Q^T .). `transform_camera` transforms a camera in the same way, so that it sees the same image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import DEFAULT_NEAR_PLANE, Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.spherical_harmonics import SH_C0, sh_basis

MAX_WORLD_OFFSET_SIZES = 64.0
"""`transform` adds the model's origin to its means if the origin is at most this many standard deviations of the means
away from 0. Beyond that, float32 means would be too coarse (decision 0017)."""
TRANSFORM_SCALE_LIMITS = (1e-12, 1e12)
"""Smallest and largest scale of a transform; beyond them float32 means would be 0 or infinite."""
_INVISIBLE_LOGIT = -80.0
"""Logit of a Gaussian that is never drawn; exp(80) still fits float32."""
_SIMILARITY_TOLERANCE = 1e-6
"""Largest difference of Q^T Q from the identity. It allows matrices typed with six digits or stored as float32."""


def take(gaussians: Gaussians, rows: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Gaussians:
    """Select Gaussians by a slice, or by (n,) booleans or indices."""
    return replace(gaussians, **{name: array[rows] for name, array in gaussians.arrays().items()})


def in_box(gaussians: Gaussians, low: Sequence[float], high: Sequence[float]) -> NDArray[np.bool_]:
    """Mask (n,), True for Gaussians whose mean is in a box or on its faces. low, high (3,): in world coordinates."""
    means = gaussians.means + gaussians.origin
    return np.asarray(((means >= low) & (means <= high)).all(axis=1))


def in_sphere(gaussians: Gaussians, centre: Sequence[float], radius: float) -> NDArray[np.bool_]:
    """Mask (n,), True for Gaussians whose mean is at most `radius` from `centre` (3,), in world coordinates."""
    offsets = gaussians.means + (gaussians.origin - np.asarray(centre, np.float64))
    return np.asarray(np.linalg.norm(offsets, axis=1) <= radius)


def opaque(gaussians: Gaussians, least: float) -> NDArray[np.bool_]:
    """Mask (n,), True for Gaussians whose opacity is at least `least`."""
    if least >= 1:
        return np.zeros(len(gaussians), np.bool_)
    with np.errstate(divide="ignore"):  # if `least` is 0, its logit is -inf: all are selected
        return np.asarray(gaussians.opacity_logits >= np.log(least) - np.log1p(-least))


def drop_sh(gaussians: Gaussians, degree: int) -> Gaussians:
    """Drop the SH bands above `degree`, if there are any."""
    return replace(gaussians, sh=np.ascontiguousarray(gaussians.sh[:, : (degree + 1) ** 2]))


def without_empty_bands(gaussians: Gaussians) -> Gaussians:
    """Drop the highest SH bands if all their coefficients are 0, since a lossy format would not store exact zeros."""
    degree = gaussians.sh_degree
    while degree and not gaussians.sh[:, degree**2 :].any():
        degree -= 1
    return gaussians if degree == gaussians.sh_degree else drop_sh(gaussians, degree)


def exposed(gaussians: Gaussians, gains: Sequence[float]) -> Gaussians:
    """Multiply the colours of a model by `gains`.

    gains: three factors of at least 0, one for each channel, or the nine elements of a colour matrix row by row.
    """
    factors = np.asarray(gains, np.float64)
    if len(factors) == 9:
        return graded(gaussians, factors.reshape(3, 3), np.zeros(3))
    sh = gaussians.sh * factors
    sh[:, 0] += 0.5 * (factors - 1) / SH_C0  # colour = 0.5 + C0 SH
    return replace(gaussians, sh=np.ascontiguousarray(sh, np.float32))


def graded(gaussians: Gaussians, linear: Float64, shift: Float64) -> Gaussians:
    """Change colours to linear @ colour + shift, before they are clamped at 0. linear (3, 3), shift (3,)."""
    sh = np.einsum("cd,nkd->nkc", linear, gaussians.sh.astype(np.float64))
    sh[:, 0] += (linear @ np.full(3, 0.5) + shift - 0.5) / SH_C0  # colour = 0.5 + C0 SH
    return replace(gaussians, sh=np.ascontiguousarray(sh, np.float32))


def faded(gaussians: Gaussians, factor: float) -> Gaussians:
    """Multiply opacities by a factor from 0 to 1; 0 makes the model invisible."""
    if factor <= 0:
        return replace(gaussians, opacity_logits=np.full_like(gaussians.opacity_logits, _INVISIBLE_LOGIT))
    if factor >= 1:
        return gaussians
    # for factor f and logit l, the logit of f / (1 + exp(-l)) is log(f) - log(1 - f + exp(-l))
    logits = np.log(factor) - np.logaddexp(np.log1p(-factor), -gaussians.opacity_logits.astype(np.float64))
    return replace(gaussians, opacity_logits=logits.astype(np.float32))


def merge(models: Sequence[Gaussians]) -> Gaussians:
    """Concatenate models. Lower SH degrees are padded with zeros. Means become relative to the first model's origin.

    Raises InputError if only some of the models are antialiased, or only some are drawn along rays.
    """
    if len(models) == 1:
        return models[0]
    if len({model.antialiased for model in models}) > 1:
        raise InputError("some of the models are antialiased and some are not, expected models that are drawn alike")
    if len({model.by_rays for model in models}) > 1:
        raise InputError(
            "some of the models are drawn along rays and some are not, expected models that are drawn alike"
        )
    coefficients, origin = max(model.sh.shape[1] for model in models), models[0].origin

    def means(model: Gaussians) -> Float32:
        moved = model.origin - origin
        return (model.means + moved).astype(np.float32) if moved.any() else model.means

    def sh(model: Gaussians) -> Float32:
        return np.pad(model.sh, ((0, 0), (0, coefficients - model.sh.shape[1]), (0, 0)))

    parts = [replace(model, means=means(model), sh=sh(model)).arrays() for model in models]
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    near = min(model.near for model in models)
    first = models[0]
    return Gaussians(**whole, origin=origin, near=near, antialiased=first.antialiased, by_rays=first.by_rays)


def decompose(matrix: Float64, slack: float = _SIMILARITY_TOLERANCE) -> tuple[float, Float64, Float64]:
    """Scale s, rotation Q (3, 3) and translation t (3,) of a similarity (4, 4).

    slack: largest allowed difference of Q^T Q from the identity.
    Raises InputError if the matrix is not a similarity. Callers put the file's name and "has" before the message.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"a transform of {matrix.shape}, expected 4 x 4 finite numbers")
    linear = matrix[:3, :3]
    scale = float(np.abs(np.linalg.det(linear)) ** (1 / 3))
    if not TRANSFORM_SCALE_LIMITS[0] < scale < TRANSFORM_SCALE_LIMITS[1] or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise InputError(f"a transform that is not invertible (scale {scale:g}) or whose last row is not 0 0 0 1")
    turn = linear / scale
    if (off := float(np.abs(turn.T @ turn - np.eye(3)).max())) > slack:
        raise InputError(
            f"a transform that is not a similarity (its axes deviate by {off:.2g} from right angles or equal lengths), "
            "expected rotation, one scale and translation"
        )
    u, _, vt = np.linalg.svd(turn)  # u @ vt is the orthogonal matrix nearest to `turn`
    return scale, u @ vt, matrix[:3, 3]


def transform(gaussians: Gaussians, matrix: Float64, slack: float = _SIMILARITY_TOLERANCE) -> Gaussians:
    """Transform a model by a similarity (4, 4) of the world. A pure translation keeps rotations and SH bit for bit.

    slack: largest allowed difference of Q^T Q from the identity, where Q is the matrix's rotation.
    Raises InputError if the matrix is not a similarity, like `decompose`.
    """
    scale, turn, shift = decompose(matrix, slack)
    upright = np.allclose(turn, np.eye(3), rtol=0, atol=1e-12)  # no rotation, up to float64 rounding
    linear = scale * turn
    origin = linear @ gaussians.origin + shift
    with np.errstate(invalid="ignore"):  # Gaussians with non-finite values are dropped later
        means = gaussians.means.astype(np.float64) @ linear.T
        spread = float(means.std(axis=0).max())
        if np.isnan(spread) and (finite := np.isfinite(means).all(axis=1)).any():
            spread = float(means[finite].std(axis=0).max())
    if np.linalg.norm(origin) <= MAX_WORLD_OFFSET_SIZES * spread:
        means, origin = means + origin, np.zeros(3)
    return Gaussians(
        means.astype(np.float32),
        gaussians.quaternions if upright else _rotated(gaussians.quaternions, turn),
        (gaussians.log_scales + np.log(scale)).astype(np.float32),
        gaussians.opacity_logits,
        gaussians.sh if upright else rotate_sh(gaussians.sh, turn),
        origin,
        scale * gaussians.near,
        gaussians.antialiased,
        gaussians.by_rays,
    )


def moved(points: Float64, matrix: Float64) -> Float64:
    """Transform points (N, 3) by a similarity (4, 4)."""
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def scaling(factor: float) -> Float64:
    """Matrix (4, 4) that scales the world about its origin."""
    return np.diag([factor, factor, factor, 1.0])


def turning(degrees: Sequence[float]) -> Float64:
    """Matrix (4, 4) that rotates the world about x, then y, then z, by `degrees` (3,) and the right-hand rule."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    return matrix


def shifting(offset: Sequence[float]) -> Float64:
    """Matrix (4, 4) that translates the world by `offset` (3,)."""
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def transform_camera(camera: Camera, matrix: Float64) -> Camera:
    """Transform a camera like a model, so that it sees the same image. A reflection mirrors the camera's axes too."""
    scale, turn, shift = decompose(matrix)
    rotation = camera.rotation @ turn.T
    translation = scale * camera.translation - rotation @ shift
    # DEFAULT_NEAR_PLANE stands for the model's near plane, which `transform` scales
    near = DEFAULT_NEAR_PLANE if camera.near == DEFAULT_NEAR_PLANE else scale * camera.near
    return replace(camera, rotation=rotation, translation=translation, near=near, far=scale * camera.far)


def _rotated(quaternions: Float32, rotation: Float64) -> Float32:
    """Rotate quaternions w x y z (n, 4) by a matrix (3, 3), without change of their lengths.

    If the matrix has a reflection, its negative is used, which gives the same covariances.
    """
    from scipy.spatial.transform import Rotation

    proper = rotation if np.linalg.det(rotation) > 0 else -rotation
    x, y, z, w = Rotation.from_matrix(proper).as_quat()
    # Hamilton product of (w, x, y, z) and each quaternion
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray((quaternions.astype(np.float64) @ product.T).astype(np.float32))


def rotate_sh(sh: Float32, turn: Float64) -> Float32:
    """Rotate SH coefficients (n, K, 3) by the matrix Q = `turn` (3, 3): a rotation, possibly with a reflection.

    `sh_rotations` has the matrices of the bands, Wigner's D-matrices in the real basis.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    turned = sh.copy()
    for band, matrix in enumerate(sh_rotations(turn, degree)[1:], start=1):
        rows = slice(band**2, (band + 1) ** 2)
        turned[:, rows] = np.einsum("ij,njc->nic", matrix, sh[:, rows].astype(np.float64))
    return turned


def sh_rotations(turn: Float64, degree: int) -> list[Float64]:
    """Matrices (2 l + 1, 2 l + 1) that rotate the SH bands l = 0 to `degree` by Q = `turn`.

    Each maps the coefficients c of a function f(d) to the coefficients c' of f(Q^T d).

    Each band is closed under rotation (Wigner 1931), so c' follows from values in enough directions d: B c' = B_Q c.
    Rows of B are the basis at d, rows of B_Q the basis at Q^T d. With many directions B has a condition number near 1,
    and c' is exact to float64 rounding.
    """
    at = np.arange(64) + 0.5  # Fibonacci points on the sphere
    z, angle = 1 - at / 32, np.pi * (1 + 5**0.5) * at
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    here, there = sh_basis(directions, degree), sh_basis(directions @ turn, degree)
    bands = (slice(band**2, (band + 1) ** 2) for band in range(degree + 1))
    return [np.asarray(np.linalg.lstsq(here[:, rows], there[:, rows], rcond=None)[0], np.float64) for rows in bands]
