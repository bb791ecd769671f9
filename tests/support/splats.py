# SPDX-License-Identifier: Apache-2.0
"""Models for tests of formats, their differences, and checks of reading damaged files."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.spherical_harmonics import sh_basis


def lopsided(count: int = 500, degree: int = 3, seed: int = 0) -> Gaussians:
    """Random Gaussians with values like a model's, in a volume without symmetry: every change of axes is visible."""
    rng = np.random.default_rng(seed)

    def float32(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array, np.float32)

    means = rng.gamma([1, 2, 3], [1.0, 0.5, 0.4], (count, 3)) * [1, 1, 1.5] + [0.1, -0.4, 0.7]
    sh = rng.standard_normal((count, (degree + 1) ** 2, 3)) * 0.15
    sh[:, 0] = rng.uniform(-1.2, 1.6, (count, 3))
    return Gaussians(
        float32(means),
        float32(rng.standard_normal((count, 4)) * rng.uniform(0.5, 2, (count, 1))),
        float32(rng.uniform([-5, -4, -3], [-3, -2.5, -1.5], (count, 3))),
        float32(rng.uniform(-4, 6, count)),
        float32(sh),
    )


def with_origin(gaussians: Gaussians, *origin: float) -> Gaussians:
    return replace(gaussians, origin=np.array(origin, np.float64))


def read_plainly(path: Path) -> Gaussians:
    """Read a 3DGS PLY that has only floats, with NumPy and without checks. Logits are clamped to -30 to 30."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    names = [line.split()[2].decode() for line in data[:end].split(b"\n") if line.startswith(b"property float ")]
    table = np.frombuffer(data[end:], np.dtype([(name, "<f4") for name in names]))

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([table[name] for name in wanted], axis=1)

    rest = sum(name.startswith("f_rest") for name in names)
    sh = [columns("f_dc_0", "f_dc_1", "f_dc_2")]
    sh += [columns(*(f"f_rest_{index + channel * rest // 3}" for channel in range(3))) for index in range(rest // 3)]
    return Gaussians(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2"),
        np.clip(table["opacity"], -30, 30),
        np.stack(sh, axis=1),
    )


def rotations(gaussians: Gaussians) -> Rotation:
    return Rotation.from_quat(gaussians.quaternions[:, [1, 2, 3, 0]])


def opacity(gaussians: Gaussians) -> np.ndarray:
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def losses(a: Gaussians, b: Gaussians) -> dict[str, float]:
    """The largest difference between two models for each attribute; rotations in radians."""
    return {
        "means": float(np.abs(a.means + a.origin - (b.means + b.origin)).max()),
        "rotations": float((rotations(a).inv() * rotations(b)).magnitude().max()),
        "log_scales": float(np.abs(a.log_scales - b.log_scales).max()),
        "opacities": float(np.abs(opacity(a) - opacity(b)).max()),
        "sh0": float(np.abs(a.sh[:, 0] - b.sh[:, 0]).max()),
        "sh": float(np.abs(a.sh[:, 1:] - b.sh[:, 1:]).max(initial=0)),
    }


def assert_within(a: Gaussians, b: Gaussians, **bounds: float) -> None:
    assert len(a) == len(b)
    assert a.sh.shape == b.sh.shape
    found = losses(a, b)
    for name, bound in bounds.items():
        assert found[name] <= bound, f"{name}: {found[name]}, expected at most {bound}"


def covariances(gaussians: Gaussians) -> np.ndarray:
    turn = rotations(gaussians).as_matrix() * np.exp(gaussians.log_scales.astype(np.float64))[:, None]
    squares: np.ndarray = turn @ turn.transpose(0, 2, 1)
    return squares


def colours(gaussians: Gaussians, directions: np.ndarray) -> np.ndarray:
    """Colours (n, directions, 3) of Gaussians in directions, with the reference's SH basis."""
    basis = sh_basis(directions, gaussians.sh_degree)
    found: np.ndarray = np.einsum("dk,nkc->ndc", basis, gaussians.sh.astype(np.float64))
    return found


def damaged(data: bytes, *, step: int) -> Iterable[bytes]:
    """Yield the data truncated at every `step`th byte, and with that byte changed."""
    rng = np.random.default_rng(0)
    for at in range(0, len(data), step):
        yield data[:at]
        yield data[:at] + bytes([data[at] ^ int(rng.integers(1, 256))]) + data[at + 1 :]


def refused_of(read: Callable[[Path], Gaussians], path: Path, *, step: int) -> int:
    """Number of damaged versions of a file that `read` refuses. Fails unless it reads sound models from the others."""
    refused = 0
    for data in damaged(path.read_bytes(), step=step):
        path.write_bytes(data)
        refused += assert_refused_or_sound(read, path)
    return refused


def assert_refused_or_sound(read: Callable[[Path], Gaussians], path: Path) -> bool:
    """True if `read` refuses the file, with an error of one line that names it.

    Fails unless the model is complete and finite otherwise.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        message = ""
        try:
            model = read(path)
        except InputError as error:
            message = str(error)
    if message:
        assert str(path) in message, message
        assert "\n" not in message
        return True
    model.check()
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert np.isfinite(getattr(model, name)).all(), name
    return False
