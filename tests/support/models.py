# SPDX-License-Identifier: Apache-2.0
"""Small random models for tests of files, and paths of real data."""

from pathlib import Path

import numpy as np
import pytest
from needs import SCENES, require

from clsplat.gaussians import Gaussians


def real_file(name: str) -> Path:
    """A file or folder of the real data. Skips the test if it is missing."""
    path = SCENES / name
    if not path.exists():
        require("scenes")
        pytest.skip(f"CLSPLAT_SCENES has no {name}")
    return path


def random_gaussians(count: int, degree: int = 3, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape).astype(np.float32)

    return Gaussians(
        normal(count, 3), normal(count, 4), normal(count, 3), normal(count), normal(count, (degree + 1) ** 2, 3)
    )


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        left, right = getattr(a, name), getattr(b, name)
        assert left.dtype == right.dtype == np.float32, name
        assert left.flags.c_contiguous, name
        assert right.flags.c_contiguous, name
        np.testing.assert_array_equal(left, right, err_msg=name)
