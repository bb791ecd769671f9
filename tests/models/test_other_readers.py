# SPDX-License-Identifier: Apache-2.0
"""PlayCanvas' splat-transform reads what we write as we do, and we read what it writes as it does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from models import random_gaussians
from node import splat_transform, spz_flag
from test_packed_formats import ksplat

from clsplat.gaussians import Gaussians
from clsplat.models import formats


def as_they_read_it(path: Path) -> Gaussians:
    target = path.with_name("theirs.ply")
    splat_transform(path, target)
    return formats.load(target)


def assert_alike(ours: Gaussians, theirs: Gaussians, rotation: float = 1e-4) -> None:
    """Row by row; they round to float32 in other places."""
    assert len(ours) == len(theirs)
    for name in ("means", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=2e-6, atol=2e-6, err_msg=name)
    # A largest component that follows from three in float32 has 1e-4 where the three are nearly a unit vector
    a, b = (each.quaternions.astype(float) for each in (ours, theirs))
    lengths = [np.linalg.norm(each, axis=1, keepdims=True) for each in (a, b)]
    np.testing.assert_allclose(a / lengths[0], b / lengths[1], atol=rotation)
    opacity = [1 / (1 + np.exp(-each.opacity_logits.astype(float))) for each in (ours, theirs)]
    np.testing.assert_allclose(*opacity, atol=0.26 / 255)  # 0 and 255 are read a quarter of a step from the end


def model(degree: int = 3) -> Gaussians:
    found = random_gaussians(700, degree)
    found.sh *= 0.3
    return found


@pytest.mark.parametrize(
    ("suffix", "degree", "apart"),
    # A byte b is (b - 128) / 128 to us as to antimatter15's viewer, and 2 b / 255 - 1 to them: up to 1/128 apart
    [*((".compressed.ply", degree, ()) for degree in range(4)), (".splat", 3, (1 / 128,))],
)
def test_they_read_our_compressed_ply_and_splat(
    suffix: str, degree: int, apart: tuple[float, ...], tmp_path: Path
) -> None:
    path = tmp_path / f"ours{suffix}"
    formats.save(path, model(degree))
    assert_alike(formats.load(path), as_they_read_it(path), *apart)


def test_we_read_their_compressed_ply(tmp_path: Path) -> None:
    source, path = tmp_path / "model.ply", tmp_path / "written.compressed.ply"
    formats.save(source, model())
    splat_transform(source, path)
    assert_alike(formats.load(path), as_they_read_it(path))
    # and not only as they do: the middles of whole attributes are the model's
    ours, whole = formats.load(path), model()
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(ours, name).mean(axis=0), getattr(whole, name).mean(axis=0), atol=5e-3)


@pytest.mark.parametrize("level", range(3))
def test_they_read_our_ksplats_as_we_do(level: int, tmp_path: Path) -> None:
    """Files that the tests make by the specification: that they are ones is seen by another reader."""
    path = tmp_path / "made.ksplat"
    path.write_bytes(ksplat(random_gaussians(60, 2), level, (23, 37))[0])
    assert_alike(formats.load(path), as_they_read_it(path))


@pytest.mark.parametrize("antialiased", [False, True])
def test_they_see_that_our_spz_is_antialiased(antialiased: bool, tmp_path: Path) -> None:
    path = tmp_path / "ours.spz"
    formats.save(path, replace(model(), antialiased=antialiased))
    assert spz_flag(path) == (antialiased, 700)
