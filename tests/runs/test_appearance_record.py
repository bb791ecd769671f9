# SPDX-License-Identifier: Apache-2.0
"""appearance.json as `render` and `view` read it, and a model that is exposed by it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from compare import assert_close
from models import random_gaussians

from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.models.edit import exposed
from clsplat.runs.appearance import gains_of
from clsplat.runs.run import Run
from clsplat.spherical_harmonics import sh_basis

LOGS = {"a.jpg": [1.0, 0.0, -1.0], "x/b.jpg": [0.5, 0.5, 0.5], "y/b.jpg": [0.0, 0.0, 0.0], "other.png": [2.0, 2.0, 2.0]}


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(tmp_path / "run", TrainConfig(appearance="exposure"))
    rows = {name: {"log2_gains": logs} for name, logs in LOGS.items()}
    held_out = {"held.jpg": {"log2_gains": [-1.0, 0.0, 0.0]}}
    run.write_appearance({"kind": "exposure", "photographs": rows, "held_out": held_out})
    return run


def test_gains_by_name(run: Run) -> None:
    assert gains_of(run.path, "a.jpg") == gains_of(run.path, "a") == gains_of(run.model_path, "a") == (2.0, 1.0, 0.5)
    assert gains_of(run.path, "x/b.jpg") == gains_of(run.path, "x/b") == (2**0.5,) * 3
    assert gains_of(run.path, "held") == (0.5, 1.0, 1.0)


@pytest.mark.parametrize(
    ("photograph", "message"),
    [
        ("b", r"--appearance b: fits 2 photographs, x/b.jpg, y/b.jpg; name one$"),
        ("othr.png", r"is not a photograph in .*appearance.json, expected one of its 5, such as other.png"),
        ("", r"expected one of its 5, such as"),
    ],
)
def test_a_photograph_that_is_not_there(run: Run, photograph: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        gains_of(run.path, photograph)
    assert sum(name in str(error.value) for name in LOGS) <= 3


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"photographs": 1}', '{"photographs": {"a.jpg": {"log2_gains": [1, 2]}}}']
    + [json.dumps({"photographs": {"a.jpg": {"log2_gains": [1, 2, bad]}}}) for bad in (float("nan"), 99, "x", None)],
)
def test_a_damaged_record(run: Run, text: str) -> None:
    run.appearance_path.write_text(text, "utf-8")
    refuses(r"appearance.json: .*expected a file that clsplat train --appearance writes", gains_of, run.path, "a.jpg")


def test_a_run_without(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "plain", TrainConfig())
    for model in (run.path, tmp_path / "alone.ply"):
        refuses(r"has learnt no appearances \(no appearance.json\), expected a run of", gains_of, model, "a.jpg")


def test_colours_of_an_exposed_model() -> None:
    model, gains = random_gaussians(50), (2.0, 0.25, 1.0)
    rng = np.random.default_rng(1)
    directions = rng.normal(0, 1, (50, 3))
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 3)

    def colours(sh: np.ndarray) -> np.ndarray:
        return np.asarray(np.maximum(np.einsum("nk,nkc->nc", basis, sh.astype(np.float64)) + 0.5, 0))

    # Roundings of coefficients up to 8, sixteen in a sum.
    assert_close(colours(exposed(model, gains).sh), colours(model.sh) * gains, absolute=5e-6)
