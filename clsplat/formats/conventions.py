# SPDX-License-Identifier: Apache-2.0
"""What formats have in place of our conventions, there and back: axes, opacities and scales, transforms of nodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.reference.sh import sh_basis

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Signs = tuple[int, int, int]

UP_BACK: Signs = (1, -1, -1)
"""Between our x right, y down, z forward and x right, y up, z backward (RUB), either way: half a turn about x."""
LEFT_UP: Signs = (-1, -1, 1)
"""Between ours and x left, y up, z forward (LUF), either way: half a turn about z."""

FREE_COUNT = 1 << 20
"""A compressed file may have so many Gaussians whatever its length is, and beyond them one for each byte of it: more
than any model of a scene, whose positions alone take several bytes each, and less than what a bomb would ask for."""

_ODD = (
    *("", "y", "z", "x", "xy", "yz", "", "xz", ""),
    *("y", "xyz", "y", "z", "x", "z", "x"),
)
"""The axes that each of the 16 spherical harmonics (docs/conventions.md) changes its sign with."""


def sh_signs(signs: Signs) -> Float32:
    """(16,): what the coefficients are multiplied by when axes change their sign."""
    by_axis = dict(zip("xyz", signs, strict=True))
    return np.array([np.prod([by_axis[axis] for axis in odd]) for odd in _ODD], np.float32)


def quaternion_signs(signs: Signs) -> Float32:
    """(4,), for w x y z, when axes change their sign: of the world and of the Gaussian alike, which is the same
    ellipsoid as turning it, and exact. Right for a mirrored axis too."""
    handedness = int(np.prod(signs))
    return np.array([1, *(handedness * sign for sign in signs)], np.float32)


def flip(gaussians: Gaussians, signs: Signs) -> None:
    """Change the signs of axes, in place and exactly."""
    gaussians.means *= np.array(signs, np.float32)
    gaussians.quaternions *= quaternion_signs(signs)
    gaussians.sh *= sh_signs(signs)[: gaussians.sh.shape[1], None]
    gaussians.origin = gaussians.origin * np.array(signs, np.float64)


def world_means(gaussians: Gaussians, rows: slice = slice(None)) -> Float64:
    """Of some rows, counted from the world's own origin."""
    means: Float64 = gaussians.means[rows] + gaussians.origin
    return means


def opacities(logits: Float32) -> Float32:
    """In [0, 1]."""
    with np.errstate(over="ignore"):  # exp of a large number: the opacity is 0 then, as it should be
        return (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.float32)


def logits(opacity: Float32) -> Float32:
    """Of opacities in [0, 1]; 0 and 1, whose logits are infinite, count as float32's nearest others, halved."""
    p = np.clip(opacity.astype(np.float64), 2.0**-150, 1 - 2.0**-25)
    return (np.log(p) - np.log1p(-p)).astype(np.float32)


def byte_logits() -> Float32:
    """(256,): of opacities in steps of 1/255. The first and the last step are half as wide as others, and count as
    their middle, where the logit is finite and rounds to the same byte."""
    steps = np.arange(256, dtype=np.float64)
    steps[0], steps[-1] = 0.25, 254.75
    return logits((steps / 255).astype(np.float32))


def unit_quaternions(quaternions: Float32) -> Float32:
    """w x y z normalised; one of length 0 is no rotation."""
    q = quaternions.astype(np.float64)
    length = np.sqrt(np.square(q).sum(axis=1, keepdims=True))
    unit = np.where(length > 0, q / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])
    return unit.astype(np.float32)


def require_finite(path: Path, gaussians: Gaussians, *, writing: bool = False) -> None:
    """Raise InputError naming the first value that is not finite, as the reader of PLY does."""
    bad = ~np.isfinite(gaussians.means.sum(axis=1, dtype=np.float64))
    verb = "cannot be written: the model has" if writing else "has"
    if bad.any():
        raise InputError(
            f"{path}: {verb} {int(bad.sum())} of {len(gaussians)} Gaussians with a position that is not finite, "
            f"the first is {int(bad.argmax())}"
        )
    for name in ("quaternions", "log_scales", "opacity_logits", "sh"):
        values = getattr(gaussians, name)
        if not np.isfinite(values.sum(dtype=np.float64)):  # a single pass; the sum of finite float32 is finite
            row = int((~np.isfinite(values.reshape(len(values), -1)).all(axis=1)).argmax())
            raise InputError(f"{path}: {verb} {name.replace('_', ' ')} of Gaussian {row} that are not finite")


def require_count(path: Path, count: int, size: int) -> None:
    """Raise InputError for a count that a compressed file of `size` bytes does not have."""
    if count < 1:
        raise InputError(f"{path}: has {count} Gaussians, expected at least one")
    if count > max(FREE_COUNT, size):
        raise InputError(f"{path}: says that it has {count} Gaussians in {size} bytes; is it damaged?")


def concatenated(parts: Sequence[Gaussians]) -> Gaussians:
    """One model, of the highest degree among them; its means count from the first one's origin."""
    if len(parts) == 1:
        return parts[0]
    origin = parts[0].origin
    width = max(part.sh.shape[1] for part in parts)
    means = [
        part.means if (part.origin == origin).all() else (world_means(part) - origin).astype(np.float32)
        for part in parts
    ]
    padded = [np.pad(part.sh, ((0, 0), (0, width - part.sh.shape[1]), (0, 0))) for part in parts]
    return Gaussians(
        np.concatenate(means),
        np.concatenate([part.quaternions for part in parts]),
        np.concatenate([part.log_scales for part in parts]),
        np.concatenate([part.opacity_logits for part in parts]),
        np.concatenate(padded),
        origin,
    )


def place(gaussians: Gaussians, matrix: Float64, where: str) -> None:
    """Apply the matrix (4, 4) of a node: a rotation, one scale for all axes, and a translation, which becomes the
    origin where adding it would blur the means (docs/decisions/0017). Raises InputError, which begins with `where`, for
    a matrix that is anything else."""
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: its transform is not finite")
    linear, translation = matrix[:3, :3], matrix[:3, 3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not 1e-12 < scale < 1e12 or not np.allclose(linear.T @ linear / scale**2, np.eye(3), atol=1e-4):
        raise InputError(
            f"{where}: its transform is no rotation with a positive scale, the same along all axes, as Gaussians need"
        )
    rotation = linear / scale
    if not np.allclose(rotation, np.eye(3), rtol=0, atol=1e-12):
        gaussians.means = (gaussians.means @ (linear.T)).astype(np.float32)
        gaussians.quaternions = _multiply(_quaternion(rotation), gaussians.quaternions)
        _rotate_sh(gaussians.sh, rotation)
    elif scale != 1:
        gaussians.means *= np.float32(scale)
    gaussians.log_scales += np.float32(np.log(scale))
    if not translation.any():
        return
    largest = float(np.abs(gaussians.means).max(initial=0))
    if float(np.abs(translation).max()) > 64 * largest:
        gaussians.origin = gaussians.origin + translation
    else:
        gaussians.means = (gaussians.means + translation).astype(np.float32)


def _quaternion(rotation: Float64) -> Float64:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def _multiply(left: Float64, right: Float32) -> Float32:
    """Hamilton's product of one quaternion and (N, 4)."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: Float32 = (right @ matrix.T).astype(np.float32)
    return product


def _rotate_sh(sh: Float32, rotation: Float64) -> None:
    """In place: afterwards a direction d has the colour that `rotation`^-1 d had. Bands do not mix; each one's matrix
    follows from its values at more directions than it has coefficients."""
    directions = np.random.default_rng(0).standard_normal((64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degree = round(sh.shape[1] ** 0.5) - 1
    here, there = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    for band in range(1, degree + 1):
        columns = slice(band**2, (band + 1) ** 2)
        turn = np.linalg.lstsq(here[:, columns], there[:, columns], rcond=None)[0]
        sh[:, columns] = np.einsum("ij,njc->nic", turn, sh[:, columns])
