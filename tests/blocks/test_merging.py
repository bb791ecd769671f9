# SPDX-License-Identifier: Apache-2.0
"""The merge of the blocks' models: every Gaussian of the ground once, in the blocks' order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refusal
from compare import assert_same_bits
from models import random_gaussians

from clsplat.blocks.merging import CellModel, write_merged
from clsplat.gaussians import Gaussians
from clsplat.models.codec import ply_file, values
from clsplat.models.edit import take
from clsplat.models.formats import ply
from clsplat.optimisation.trained_region import TrainedRegion

AXES = np.array([[0.8, 0.0, 0.6], [-0.6, 0.0, 0.8]])
FAR = np.array([512345.5, 431.125, 5412345.25])


def split(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, depth: int) -> list[TrainedRegion]:
    """Cells of a k-d split of a rectangle, at random places."""
    if depth == 0:
        return [TrainedRegion(AXES, low, high)]
    axis = int(rng.integers(2))
    at = float(np.clip(rng.normal(), np.maximum(low, -3)[axis], np.minimum(high, 3)[axis]))
    if not low[axis] < at < high[axis]:
        return split(low, high, rng, depth - 1)
    below, above = high.copy(), low.copy()
    below[axis] = above[axis] = at
    return split(low, below, rng, depth - 1) + split(above, high, rng, depth - 1)


def cells(seed: int, origin: np.ndarray) -> list[TrainedRegion]:
    everywhere = np.full(2, np.inf)
    found = split(-everywhere, everywhere, np.random.default_rng(seed), 4)
    shift = AXES @ origin
    return [TrainedRegion(AXES, cell.low + shift, cell.high + shift) for cell in found]


def model_on_edges(count: int, found: list[TrainedRegion], origin: np.ndarray, seed: int) -> Gaussians:
    """Gaussians of which a third have a mean on an edge between cells, up to a few units in the last place."""
    model, rng = random_gaussians(count, degree=1, seed=seed), np.random.default_rng(seed)
    edges = np.array([[x, y] for cell in found for x in (*cell.low, 0.3) for y in (*cell.high, -0.2)])
    edges = edges[np.isfinite(edges).all(axis=1)] if len(edges) else edges
    places = rng.normal(size=(count, 2))
    local = (edges - AXES @ origin)[rng.integers(len(edges), size=count)] if len(edges) else places
    on_edge = rng.random(count) < 1 / 3
    flat = np.where(on_edge[:, None], local, places)
    model.means = (flat @ AXES + np.outer(rng.normal(size=count), [0, 1, 0])).astype(np.float32)
    for _ in range(2):
        model.means = np.nextafter(
            model.means, np.float32(1) * rng.choice([-9, 9], model.means.shape), dtype=np.float32
        )
    return replace(model, origin=origin, near=0.005)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("origin", [np.zeros(3), FAR], ids=["near", "far"])
def test_every_gaussian_comes_once_in_the_order_of_the_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int, origin: np.ndarray
) -> None:
    """All cells cut from one model: the merge has each of its rows once, with every bit, exact means too."""
    for module in (ply, ply_file, values):  # 500 rows in several blocks of rows
        monkeypatch.setattr(module, "IO_BLOCK_ROWS", 64)
    found = cells(seed, origin)
    model = model_on_edges(500, found, origin, seed)
    model.save(tmp_path / "whole.ply")
    count = write_merged(tmp_path / "merged.ply", [CellModel(tmp_path / "whole.ply", cell) for cell in found])
    merged = Gaussians.load(tmp_path / "merged.ply")
    rows = np.concatenate([np.flatnonzero(cell.contains(model.means, origin)) for cell in found])
    assert count == len(merged) == len(model)
    assert sorted(rows.tolist()) == list(range(500)), "each row in exactly one cell"
    for name, array in take(model, rows).arrays().items():
        assert_same_bits(merged.arrays()[name], array, name)
    assert merged.near == 0.005
    np.testing.assert_array_equal(merged.origin, origin)


def test_rows_outside_the_own_cell_are_left_out(tmp_path: Path) -> None:
    """Also those that the other block has moved into this cell: each block's own Gaussians count in its cell."""
    low, high = np.full(2, -np.inf), np.full(2, np.inf)
    west, east = high.copy(), low.copy()
    west[0] = east[0] = 0.0
    cut = [TrainedRegion(np.eye(3)[[0, 2]], low, west), TrainedRegion(np.eye(3)[[0, 2]], east, high)]
    models = [random_gaussians(40, degree=0, seed=seed) for seed in (1, 2)]
    for model, name in zip(models, "ab", strict=True):
        model.save(tmp_path / f"{name}.ply")
    write_merged(tmp_path / "m.ply", [CellModel(tmp_path / f"{n}.ply", c) for n, c in zip("ab", cut, strict=True)])
    wanted = [models[0].means[models[0].means[:, 0] < 0], models[1].means[models[1].means[:, 0] >= 0]]
    assert_same_bits(Gaussians.load(tmp_path / "m.ply").means, np.concatenate(wanted))


def test_models_of_two_plans_are_refused(tmp_path: Path) -> None:
    everywhere = TrainedRegion(AXES, np.full(2, -np.inf), np.full(2, np.inf))
    random_gaussians(5, degree=1).save(tmp_path / "a.ply")
    random_gaussians(5, degree=2).save(tmp_path / "b.ply")
    models = [CellModel(tmp_path / name, everywhere) for name in ("a.ply", "b.ply")]
    assert "b.ply: SH degree" in refusal(lambda: write_merged(tmp_path / "m.ply", models))
    nowhere = TrainedRegion(AXES, np.full(2, 1e6), np.full(2, 2e6))
    assert "have no Gaussians in their cells" in refusal(
        lambda: write_merged(tmp_path / "m.ply", [CellModel(tmp_path / "a.ply", nowhere)])
    )
    assert not (tmp_path / "m.ply").exists()
